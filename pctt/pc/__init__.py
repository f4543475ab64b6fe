"""Preconditioners for ``-pc_type python -pc_python_type pctt.pc.NAME``."""

from pctt.pc.body_schur import BodySchur
from pctt.pc.tensor_train import TensorTrain
from pctt.pc.two_level import TwoLevel

PRECONDITIONERS = (TensorTrain, BodySchur, TwoLevel)  # those that -help describes

__all__ = ["PRECONDITIONERS", "BodySchur", "TensorTrain", "TwoLevel"]
