"""Mats that are given by functions: `-mat_type python -mat_python_type pctt.mat.TensorTrain`."""

from pctt.mat.tensor_train import TensorTrain, from_entries

__all__ = ["TensorTrain", "from_entries"]
