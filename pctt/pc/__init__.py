"""Preconditioners for ``-pc_type python -pc_python_type pctt.pc.NAME``."""

from pctt.pc.body_schur import BodySchur
from pctt.pc.tensor_train import TensorTrain
from pctt.pc.two_level import TwoLevel

__all__ = ["BodySchur", "TensorTrain", "TwoLevel"]
