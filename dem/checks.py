"""Checks of a user's arguments; each raises ValueError with the name of the quantity."""

from __future__ import annotations

import difflib
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np

from dem.arrays import ArrayLike, Floats, Ints


def nearest(name: str, known: Iterable[str], dash: str = "", alike: float = 0.6) -> str:
    """Return the end of a message: the known name that the user may have meant, if the two are ``alike`` (of
    `difflib`), or that is the beginning of the name."""
    begins = sorted((each for each in known if len(each) > 2 and name.startswith(each)), key=len, reverse=True)
    close = begins or difflib.get_close_matches(name, sorted(known), n=1, cutoff=alike)
    return f"; did you mean {dash}{close[0]}?" if close else ""


def finite(name: str, values: ArrayLike) -> Floats:
    """Return `values` as a float array; ValueError if a number is NaN or infinite."""
    array = np.asarray(values, dtype=np.float64)
    if not np.isfinite(array).all():
        raise ValueError(f"{name}: NaN or infinite number")
    return array


def points(name: str, values: ArrayLike) -> Floats:
    """Return `values` (m) as a float array; ValueError unless all are finite, and their squares."""
    array = finite(name, values)
    if (most := float(np.abs(array).max(initial=0.0))) > 1e150:
        raise ValueError(f"{name} must be from -1e150 to 1e150 m, as squares beyond overflow, got {most:g}")
    return array


def positive(name: str, values: ArrayLike) -> Floats:
    """Return `values` as a float array; ValueError unless all are finite and above zero."""
    array = finite(name, values)
    if (array <= 0.0).any():
        raise ValueError(f"{name} must be positive, got {array.min():g}")
    return array


def positive_or_inf(name: str, value: float) -> None:
    """Raise ValueError unless a number is above zero; inf is."""
    if not value > 0.0:
        raise ValueError(f"{name} must be positive, or inf, got {value:g}")


def not_negative(name: str, values: ArrayLike) -> Floats:
    """Return `values` as a float array; ValueError unless all are finite and not below zero."""
    array = finite(name, values)
    if (array < 0.0).any():
        raise ValueError(f"{name} must not be negative, got {array.min():g}")
    return array


def between(low: float, high: float = np.inf) -> Callable[[str, float], None]:
    """Return a check that a number is not below `low` and not above `high`."""

    def check(name: str, value: float) -> None:
        if not low <= value <= high:
            allowed = f"at least {low:g}" if high == np.inf else f"from {low:g} to {high:g}"
            raise ValueError(f"{name} must be {allowed}, got {value:g}")

    return check


def zero_or_one(name: str, value: float) -> None:
    """Raise ValueError unless a number is 0 or 1."""
    if value not in (0.0, 1.0):
        raise ValueError(f"{name} must be 0 or 1, got {value:g}")


def rows(name: str, values: ArrayLike, count: int, *row: int) -> Floats:
    """Return `values` as finite numbers (count, *row); one row stands for all."""
    array = finite(name, values)
    shape(name, array, count, *row)
    return np.broadcast_to(array, (count, *row)).copy()


def shape(name: str, array: Floats, count: int, *row: int) -> None:
    """Raise ValueError unless an array has the shape (count, *row), or that of one row."""
    if array.shape not in (row, (count, *row)):
        raise ValueError(f"{name} must have shape {row} or {(count, *row)}, got {array.shape}")


def vector(name: str, values: ArrayLike) -> Floats:
    """Return three finite numbers."""
    return rows(name, values, 1, 3)[0]


def seed(name: str, value: Any) -> int:
    """Return a whole number from 0 on, of which random numbers are made."""
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or value < 0:
        raise ValueError(f"{name} {value!r}: allowed is a whole number from 0 on")
    return int(value)


def counts(name: str, values: ArrayLike) -> Ints:
    """Return three whole numbers above zero."""
    array = vector(name, values)
    if (array < 1.0).any() or (array % 1.0).any():
        raise ValueError(f"{name}: allowed are whole numbers >= 1, got {', '.join(f'{x:g}' for x in array)}")
    return array.astype(np.int64)


def unit_vector(name: str, values: ArrayLike) -> Floats:
    """Return three finite numbers, not all zero, scaled to unit length. A vector of that length, to rounding, comes
    back."""
    array = vector(name, values)
    length = np.linalg.norm(array)
    if length == 0.0:
        raise ValueError(f"{name} is the zero vector")
    return array if abs(length - 1.0) < 1e-15 else array / length


def not_zero(name: str, values: ArrayLike) -> Floats:
    """Return `values` as a float array; ValueError if one of the quaternions in its rows is zero."""
    array = finite(name, values)
    if (np.linalg.norm(np.atleast_1d(array), axis=-1) == 0.0).any():
        raise ValueError(f"{name}: zero quaternion")
    return array


def unit_quaternion(name: str, values: ArrayLike) -> Floats:
    """Return one quaternion (4,), scaled to unit norm."""
    array = rows(name, values, 1, 4)
    size = np.linalg.norm(array, axis=1, keepdims=True)
    if size[0, 0] == 0.0:
        raise ValueError(f"{name}: zero quaternion")
    return (array / size)[0]


def check_fields(instance: Any, **checks: Callable[[str, Any], Floats]) -> None:
    """Put numbers, or tuples of numbers, that have passed a check of this module into fields of a frozen dataclass."""
    for name, check in checks.items():
        value = check(f"{type(instance).__name__}.{name}", getattr(instance, name)).tolist()
        object.__setattr__(instance, name, tuple(value) if isinstance(value, list) else value)
