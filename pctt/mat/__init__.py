"""Mats that are given by functions: `-mat_type python -mat_python_type pctt.mat.TensorTrain`."""

from pctt.mat.differences import from_differences
from pctt.mat.files import load, save
from pctt.mat.inverse import inverse
from pctt.mat.tensor_train import TensorTrain, axpy, from_entries

__all__ = ["TensorTrain", "axpy", "from_differences", "from_entries", "inverse", "load", "save"]
