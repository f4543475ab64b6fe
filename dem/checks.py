"""Checks of a user's arguments; each raises ValueError with the name of the quantity."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dem.arrays import ArrayLike, Floats


def finite(name: str, values: ArrayLike) -> Floats:
    """`values` as a float array; ValueError if a number is NaN or infinite."""
    array = np.asarray(values, dtype=np.float64)
    if not np.isfinite(array).all():
        raise ValueError(f"{name}: NaN or infinite number")
    return array


def positive(name: str, values: ArrayLike) -> Floats:
    """`values` as a float array; ValueError unless all are finite and above zero."""
    array = finite(name, values)
    if (array <= 0.0).any():
        raise ValueError(f"{name} must be positive, got {array.min():g}")
    return array


def not_negative(name: str, values: ArrayLike) -> Floats:
    """`values` as a float array; ValueError unless all are finite and not below zero."""
    array = finite(name, values)
    if (array < 0.0).any():
        raise ValueError(f"{name} must not be negative, got {array.min():g}")
    return array


def positive_column(name: str, values: ArrayLike, count: int) -> Floats:
    """`values` as positive numbers (count,); a single one stands for all."""
    array = positive(name, values)
    if array.shape not in ((), (count,)):
        raise ValueError(f"{name} must have shape () or ({count},), got {array.shape}")
    return np.broadcast_to(array, (count,)).copy()


def rows(name: str, values: ArrayLike, count: int, width: int) -> Floats:
    """`values` as finite rows (count, width); one row (width,) stands for all."""
    array = finite(name, values)
    if array.shape not in ((width,), (count, width)):
        raise ValueError(f"{name} must have shape ({width},) or ({count}, {width}), got {array.shape}")
    return np.broadcast_to(array, (count, width)).copy()


def finite_vector(name: str, values: Sequence[float]) -> tuple[float, ...]:
    """Three finite numbers as a tuple."""
    return tuple(rows(name, values, 1, 3)[0].tolist())


def unit_vector(name: str, values: Sequence[float]) -> tuple[float, ...]:
    """Three finite numbers, not all zero, scaled to unit length. A vector of that length, to rounding, comes back."""
    vector = np.array(finite_vector(name, values))
    length = np.linalg.norm(vector)
    if length == 0.0:
        raise ValueError(f"{name} is the zero vector")
    return tuple((vector / (1.0 if abs(length - 1.0) < 1e-15 else length)).tolist())


def unit_quaternions(name: str, values: ArrayLike, count: int) -> Floats:
    """Rows (count, 4), scaled to unit norm; one row (4,) stands for all."""
    array = rows(name, values, count, 4)
    norm = np.linalg.norm(array, axis=1, keepdims=True)
    if (norm == 0.0).any():
        raise ValueError(f"{name}: zero quaternion")
    return array / norm


def unit_quaternion(name: str, values: ArrayLike) -> tuple[float, ...]:
    """One quaternion as a tuple of unit norm."""
    return tuple(unit_quaternions(name, values, 1)[0].tolist())
