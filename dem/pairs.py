"""Coefficients of contacts per pair of materials: one table for all laws of contact (docs/contact_laws.md)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from dem import checks
from dem.arrays import Floats

#: What each coefficient may be.
CHECKS: dict[str, Any] = {
    "friction": checks.not_negative,
    "stiffness": checks.positive_or_inf,
    "restitution": checks.between(0.0, 1.0),
    "cohesion": checks.not_negative,
    "cohesion_range": checks.not_negative,
    "rolling": checks.not_negative,
    "spinning": checks.not_negative,
}


@dataclass(frozen=True)
class Pairs:
    """The coefficients of all pairs of materials; each array is (materials, materials) and symmetric."""

    friction: Floats  #: of Coulomb's law
    stiffness: Floats  #: of contacts; inf: rigid [N/m]
    restitution: Floats  #: of impacts
    cohesion: Floats  #: force with which bodies attract each other [N]
    cohesion_range: Floats  #: gap up to which they do [m]
    rolling: Floats  #: greatest moment that resists rolling, over the normal force [m]
    spinning: Floats  #: greatest moment that resists turning about the normal, over the normal force [m]

    def __post_init__(self) -> None:
        """ValueError for cohesion without a range."""
        if ((self.cohesion > 0.0) & (self.cohesion_range == 0.0)).any():
            raise ValueError("cohesion: needs a cohesion_range above zero, as touching bodies have gaps of about zero")

    @property
    def parts(self) -> int:
        """How often a contact has three numbers: forces, and moments if contacts resist them."""
        return 2 if self.resists else 1

    @property
    def resists(self) -> bool:
        """Whether contacts of any pair resist rolling or spinning."""
        return bool(self.rolling.any() or self.spinning.any())


def checked(given: Mapping[str, float | None]) -> dict[str, float]:
    """The coefficients that are not None; ValueError for a bad one."""
    for name, value in given.items():
        if value is not None:
            CHECKS[name](name, value)
    return {name: float(value) for name, value in given.items() if value is not None}


def tables(count: int, usual: Mapping[str, float], others: Mapping[tuple[int, int], Mapping[str, float]]) -> Pairs:
    """Of so many materials, with the `usual` coefficients but in the pairs of `others`."""
    found = {field.name: np.full((count, count), usual[field.name]) for field in fields(Pairs)}
    for (i, j), given in others.items():
        for name, value in given.items():
            found[name][i, j] = found[name][j, i] = value
    return Pairs(**found)
