"""Parts that a scene names, and of which a run may change some numbers: loads, springs, joints and sources.

A class says which fields a run may change (`CHANGED`) and which a checkpoint keeps (`KEPT`); `dem.model.changes` does
the rest alike for all of them.
"""

from __future__ import annotations

import dataclasses
from typing import Any, ClassVar, TypeVar

P = TypeVar("P", bound="Named")


class Named:
    """A part of a scene with a name, a frozen dataclass that refuses bad values when it is made."""

    CHANGED: ClassVar[tuple[str, ...]]  #: the fields that a run may change
    KEPT: ClassVar[tuple[str, ...]]  #: the fields that follow from changes

    def changed(self: P, time: float, tally: Any, **values: Any) -> P:
        """The part with other values of `CHANGED` from the time [s] on; `tally`: what has come of a source so far."""
        return dataclasses.replace(self, **values)  # type: ignore[type-var]
