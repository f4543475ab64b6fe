"""Preconditioners for ``-pc_type python -pc_python_type pctt.pc.NAME``."""

from pctt.pc.tensor_train import TensorTrain

__all__ = ["TensorTrain"]
