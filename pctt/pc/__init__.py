"""Preconditioners for ``-pc_type python -pc_python_type pctt.pc.NAME``."""

from pctt.pc.block_icc import BlockICC
from pctt.pc.tensor_train import TensorTrain

__all__ = ["BlockICC", "TensorTrain"]
