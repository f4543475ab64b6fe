"""Options: fields of dataclasses, of scenes and of the programs, which read them by `pctt.options`."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable
from typing import Any, Union

#: The allowed values in words and a test of a value; or, of a scene, a function of `dem.checks`, such as `positive`,
#: which raises ValueError for a name and a bad value.
Check = Union[tuple[str, Callable[[Any], bool]], Callable[[str, Any], Any]]


def option(
    default: Any, help: str, *, unit: str = "", choices: Iterable[str] = (), check: Check | None = None, name: str = ""
) -> Any:
    """Return a dataclass field that is an option: its default, and its meaning, unit and choices, which `-help` shows.

    ``name`` is that of the option, if it is not the prefix of the group and the name of the field."""
    metadata = {"help": help, "unit": unit, "choices": tuple(choices), "check": check, "name": name}
    return dataclasses.field(default=default, metadata=metadata)
