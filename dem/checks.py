"""Checks of a user's arguments; each raises ValueError with the name of the quantity."""

from __future__ import annotations

import difflib
from collections.abc import Callable, Iterable
from dataclasses import fields
from functools import wraps
from inspect import Parameter, signature
from typing import Any, TypeVar, cast

import numpy as np

from dem.arrays import ArrayLike, Floats, Ints

Function = TypeVar("Function", bound=Callable[..., Any])

MOST = 1e150  #: squares of greater numbers overflow


def nearest(name: str, known: Iterable[str], dash: str = "", alike: float = 0.61) -> str:
    """Return the end of a message: the known name that the user may have meant, if the two are ``alike`` (of
    `difflib`), or that is the beginning of the name and not of a group with underscores."""
    begun = (each for each in known if len(each) > 2 and name.startswith(each) and name[len(each) :][:1] != "_")
    begins = sorted(begun, key=len, reverse=True)
    close = begins or difflib.get_close_matches(name, sorted(known), n=1, cutoff=alike)
    return f"; did you mean {dash}{close[0]}?" if close else ""


def known_arguments(**groups: type) -> Callable[[Function], Function]:
    """A function that says by which names it takes arguments: TypeError for another one, which the fields of the
    dataclasses `groups` may have, the arguments of these names."""
    homes = {field.name: group for group, kind in groups.items() for field in fields(kind)}

    def decorated(function: Function) -> Function:
        kinds = {name: each.kind for name, each in signature(function).parameters.items() if name != "self"}

        @wraps(function)
        def checked(*given: Any, **named: Any) -> Any:
            for name in set() if Parameter.VAR_KEYWORD in kinds.values() else named.keys() - kinds:
                meant = f"; {homes[name]} has it: {homes[name]}={{{name!r}: ...}}" if name in homes else ""
                names = (name for name, kind in kinds.items() if kind is not Parameter.VAR_POSITIONAL)
                allowed = f"allowed are {', '.join(names)}{meant or nearest(name, kinds)}"
                what = function.__qualname__.removesuffix(".__init__").rpartition(".")[2]
                raise TypeError(f"{what}: there is no argument {name!r}; {allowed}")
            return function(*given, **named)

        return cast(Function, checked)

    return decorated


def function_or_none(name: str, given: Any) -> None:
    """Raise ValueError unless this is a function, or None."""
    if given is not None and not callable(given):
        raise ValueError(f"{name} {short(given)}: allowed is a function")


def new_name(what: str, name: Any, taken: Iterable[str]) -> None:
    """Raise ValueError unless this is a name that none of `what` has yet."""
    if not isinstance(name, str) or not name or name in taken:
        raise ValueError(f"{what} need distinct names, got {name!r}")


def short(values: Any) -> str:
    """What a user gave, in a few words."""
    text = repr(values.tolist() if isinstance(values, np.ndarray) else values)
    return text if len(text) <= 60 else f"{text[:57]}..."


def numbers(name: str, values: Any) -> Floats:
    """Return `values` as a float array; ValueError for texts and other things, rows of unlike lengths, and complex
    numbers."""
    try:
        array = np.asarray(values)
        if array.dtype.kind == "O" and None in array.ravel().tolist():  # which would be NaN
            raise TypeError
        return array.astype(np.float64, casting="unsafe" if array.dtype.kind in "OUS" else "same_kind", copy=False)
    except (TypeError, ValueError):
        raise ValueError(f"{name}: allowed are real numbers, got {short(values)}") from None


def number(name: str, value: Any) -> float:
    """Return one number, which may be infinite or NaN."""
    array = numbers(name, value)
    if array.ndim:
        raise ValueError(f"{name}: allowed is one number, got {short(value)}")
    return float(array)


def finite(name: str, values: ArrayLike) -> Floats:
    """Return `values` as a float array; ValueError if a number is NaN or infinite, or has no finite square."""
    array = numbers(name, values)
    good = np.abs(array) <= MOST
    if not good.all():
        wrong = array[~good].flat[0]
        what = f"allowed is up to {MOST:g}, got {wrong:g}" if np.isfinite(wrong) else "NaN or infinite number"
        raise ValueError(f"{name}: {what}" + (f" in row {np.argwhere(~good)[0, 0]}" if array.ndim else ""))
    return array


def positive(name: str, values: ArrayLike) -> Floats:
    """Return `values` as a float array; ValueError unless all are finite and above zero."""
    array = finite(name, values)
    if (array <= 0.0).any():
        raise ValueError(f"{name} must be positive, got {array.min():g}")
    return array


def positive_or_inf(name: str, value: float) -> None:
    """Raise ValueError unless a number is above zero; inf is."""
    value = number(name, value)
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
        value = number(name, value)
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


def vector(name: str, values: ArrayLike, count: int = 3) -> Floats:
    """Return so many finite numbers."""
    array = finite(name, values)
    if array.shape not in ((count,), (1, count)):
        raise ValueError(f"{name} must be {count} numbers, got {short(values)}")
    return array.reshape(count).copy()


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
    array = vector(name, values, 4)
    return not_zero(name, array) / np.linalg.norm(array)


def check_fields(instance: Any, **checks: Callable[[str, Any], Floats]) -> None:
    """Put numbers, or tuples of numbers, that have passed a check of this module into fields of a frozen dataclass; a
    field of the type float takes one number."""
    for name, check in checks.items():
        full, given = f"{type(instance).__name__}.{name}", getattr(instance, name)
        one = instance.__dataclass_fields__[name].type == "float"
        value = check(full, number(full, given) if one else given).tolist()
        object.__setattr__(instance, name, tuple(value) if isinstance(value, list) else value)
