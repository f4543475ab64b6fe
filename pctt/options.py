"""Options of the project: fields of dataclasses, with values from the PETSc options database.

A group of options is a frozen dataclass. The ``metadata`` of each field has ``help`` and, if needed, ``unit``,
``choices`` and ``check``. The field ``name`` of a group with the prefix ``scene_`` is the option ``-scene_name``.
"""

from __future__ import annotations

import dataclasses
import math
import numbers
import sys
import typing
from collections.abc import Callable, Iterable, Mapping
from functools import cache, lru_cache
from typing import Any, TypeVar

from dem.checks import MOST, nearest
from dem.checks import function_or_none as function_or_none
from dem.checks import known_arguments as known_arguments
from dem.checks import short as short
from dem.options import option as option

Group = TypeVar("Group")


class OptionError(ValueError):
    """A bad option. The message names the option, its value and the allowed values."""


def number(default: Any, why: str, check: Any = None) -> Any:
    """Return a dataclass field that steers a method and is set from Python only; ``why`` is its derivation or
    measurement, ``check`` what `refuse_bad` allows, in words, and a test of a value."""
    checked = {} if check is None else {"check": check}
    return dataclasses.field(default=default, metadata={"help": why, "python_only": True, **checked})


def _named(group: type, prefix: str) -> dict[str, dataclasses.Field]:
    """The fields of the database by the names of their options."""
    fields = [f for f in dataclasses.fields(group) if not f.metadata.get("python_only")]
    return {f.metadata.get("name") or prefix + f.name: f for f in fields}


POSITIVE = ("a positive number", lambda x: math.isfinite(x) and x > 0)
NOT_NEGATIVE = ("a number >= 0", lambda x: math.isfinite(x) and x >= 0)
FRACTION = ("a number between 0 and 1, both excluded", lambda x: 0 < x < 1)
PART = ("a number above 0, up to 1", lambda x: 0 < x <= 1)
AT_LEAST_ONE = ("a whole number >= 1", lambda x: x >= 1)
COUNT = ("a whole number >= 0", lambda x: x >= 0)


def word_or_number(word: str, test: Callable[[float], bool]) -> Callable[[str], bool]:
    """Return the test of a text that it is a word, or a number that passes a test."""

    def passes(text: str) -> bool:
        try:
            return text == word or test(float(text))
        except ValueError:
            return False

    return passes


@dataclasses.dataclass(frozen=True)
class Description:
    """One option as ``-help`` shows it."""

    name: str
    default: Any
    unit: str = ""
    help: str = ""
    choices: tuple[str, ...] = ()

    def __str__(self) -> str:
        default = str(self.default).lower() if isinstance(self.default, bool) else self.default
        default = "none" if default in (None, "") else default
        unit = f" {self.unit}" if self.unit else ""
        choices = f" (one of: {', '.join(self.choices)})" if self.choices else ""
        return f"  -{self.name} <{default}{unit}>: {self.help}{choices}"


def describe(group: type, prefix: str = "") -> list[Description]:
    """Return the options of a group, in the order of its fields, which may be plain ones of a user's scene."""
    shown = ("unit", "help", "choices")
    return [
        Description(name, f.default, **{key: f.metadata[key] for key in shown if key in f.metadata})
        for name, f in _named(group, prefix).items()
    ]


def read(group: type[Group], database: Mapping[str, str | None], prefix: str = "") -> Group:
    """Return a group with the values in the database; raises OptionError for a bad value.

    ``database`` maps names without the dash to strings, as `pctt.petsc.options_database` does.
    """
    types, values = _hints(group), {}
    for name, f in _named(group, prefix).items():
        if name in database:
            text, kind = database[name] or "", _kind(types[f.name])  # None stands for an option without a value
            try:
                values[f.name] = _truth(text) if kind is bool else kind(text)
            except ValueError:
                raise OptionError(f"{f'-{name} {text}'.rstrip()}: allowed is {_allowed(kind, f.metadata)}") from None
            _refuse(f"-{name} {text}".rstrip(), values[f.name], kind, f.metadata)
    return group(**values)


def made(group: type[Group], values: Mapping[str, Any]) -> Group:
    """Return a group with these values of fields, of the right types or not; OptionError for a name that it does not
    have."""
    known = [f.name for f in dataclasses.fields(group)]  # type: ignore[arg-type]
    for name in values:
        if name not in known:
            meant = nearest(name, known) or _of_meaning(group, name.replace("_", ""))
            raise OptionError(f"{name}: no such setting; allowed are {', '.join(known)}{meant}")
    return group(**values)


def instance(group: type[Group], name: str, given: Any, of: str = "") -> Group:
    """Return what is given for a group: it itself, a group with the values of a dict, or that of the defaults for None.
    OptionError for anything else, with its ``name`` and what it is ``of``."""
    if given is None or isinstance(given, Mapping):
        given = made(group, given or {})
    if not isinstance(given, group):
        raise OptionError(f"{name} {given!r}: allowed{of} is a dict or a {group.__name__}")
    try:
        _refuse_bad_once(given)
    except TypeError:  # an array has no hash
        refuse_bad(given)
    return given


def _of_meaning(group: Any, words: str) -> str:
    """As of `nearest`, the setting whose meaning begins with these words without blanks."""
    means = {f.name: f.metadata.get("help", "").replace(" ", "") for f in dataclasses.fields(group)}
    return "".join(f"; did you mean {name}?" for name, text in means.items() if text.startswith(words))


def refuse_bad(group: Any) -> None:
    """Raise OptionError for a value of a group, made in Python, that `read` would refuse, or that has another type."""
    kinds = _hints(type(group))
    for f in dataclasses.fields(group):
        value, kind = getattr(group, f.name), _kind(kinds[f.name])
        if value is not f.default and kind in _TYPES:
            if not isinstance(value, _TYPES[kind]):
                raise OptionError(f"{f.name} {value!r}: allowed is {_allowed(kind, f.metadata)}")
            _refuse(f"{f.name} {value}", value, kind, f.metadata)


_refuse_bad_once = lru_cache(64)(refuse_bad)  #: steps ask for the same again and again

_hints: Callable[[Any], dict[str, Any]] = cache(typing.get_type_hints)

#: What an option of each type may be in Python.
_TYPES: dict[Any, type] = {int: numbers.Integral, float: numbers.Real, bool: bool, str: str}


def _kind(hint: Any) -> Any:
    """The X of Optional[X]; of any other hint itself."""
    kinds = typing.get_args(hint)
    return next(kind for kind in kinds if kind is not type(None)) if type(None) in kinds else hint


def _allowed(kind: Any, metadata: Mapping[str, Any]) -> str:
    check, choices = metadata.get("check"), metadata.get("choices")
    kinds = {int: "a whole number", float: "a number", bool: "true or false", str: "a text"}
    return f"one of {', '.join(choices)}" if choices else check[0] if isinstance(check, tuple) else kinds[kind]


def _refuse(given: str, value: Any, kind: Any, metadata: Mapping[str, Any]) -> None:
    """OptionError for a value of the right type that is none of the choices or fails the check."""
    choices, check = metadata.get("choices"), metadata.get("check")
    if choices and value not in choices:
        raise OptionError(f"{given}: allowed is {_allowed(kind, metadata)}{nearest(value, choices)}")
    most = math.inf if callable(check) else sys.float_info.max  # the scene itself calls a check that is a function
    finite = ("a finite number", lambda x: kind is not float or -most <= x <= most)
    allowed, test = check if isinstance(check, tuple) else finite
    if not test(value):
        raise OptionError(f"{given}: allowed is {allowed}")
    if kind is float and MOST < abs(value) < math.inf:
        raise OptionError(f"{given}: allowed is {allowed}, and up to {MOST:g}")


def _truth(text: str) -> bool:
    if text.lower() in ("", "1", "true", "yes", "on"):
        return True
    if text.lower() in ("0", "false", "no", "off"):
        return False
    raise ValueError(text)


def no_such_option(name: str, known: Iterable[str]) -> OptionError:
    """Return the error for an unknown name; its message has the nearest known name."""
    return OptionError(f"-{name}: no such option{nearest(name, known, '-', 0.5) or '; -help lists the options'}")
