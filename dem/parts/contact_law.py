"""The law of contacts: the coefficients of each pair of materials (docs/contact_laws.md)."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import MISSING, dataclass, field, fields, replace
from typing import Any

import numpy as np

from dem import checks


def _coefficient(check: Callable[[str, Any], Any], default: Any = MISSING) -> Any:
    return field(default=default, metadata={"check": check})


@dataclass(frozen=True)
class ContactLaw:
    """The coefficients of the contacts of two materials, or tables (materials, materials) of those of all pairs.

    ValueError for a coefficient that fails its check, and for cohesion without a range.
    """

    friction: Any = _coefficient(checks.not_negative)  #: of Coulomb's law
    stiffness: Any = _coefficient(checks.positive_or_inf, None)  #: inf: rigid; None: what the scene needs [N/m]
    restitution: Any = _coefficient(checks.between(0.0, 1.0), 0.0)  #: of impacts
    cohesion: Any = _coefficient(checks.not_negative, 0.0)  #: force with which bodies attract each other [N]
    cohesion_range: Any = _coefficient(checks.not_negative, 0.0)  #: gap up to which they do [m]
    rolling: Any = _coefficient(checks.not_negative, 0.0)  #: greatest moment against it, over the normal force [m]
    spinning: Any = _coefficient(checks.not_negative, 0.0)  #: the same about the normal [m]
    touching: Any = _coefficient(checks.between(0.0, 1.0), 1.0)  #: 0: the two never touch, and go through each other

    def __post_init__(self) -> None:
        for name, check in CHECKS.items():
            value = getattr(self, name)
            if not (value is None or isinstance(value, np.ndarray)):
                check(name, value)
        if np.any((np.asarray(self.cohesion) > 0.0) & (np.asarray(self.cohesion_range) == 0.0)):
            raise ValueError("cohesion: needs a cohesion_range above zero, as touching bodies have gaps of about zero")

    @property
    def parts(self) -> int:
        """How often a contact has three numbers: forces, and moments if contacts resist them."""
        return 2 if self.resists else 1

    @property
    def resists(self) -> bool:
        """Whether contacts of any pair resist rolling or spinning."""
        return bool(np.any(self.rolling) or np.any(self.spinning))


CHECKS = {each.name: each.metadata["check"] for each in fields(ContactLaw)}


def law(values: Mapping[str, float | None], before: ContactLaw | None = None) -> ContactLaw:
    """The law with these coefficients; None, and what is not given: as `before`. ValueError for a bad one."""
    for name in values:
        if name not in CHECKS:
            allowed = f"allowed are {', '.join(CHECKS)}{checks.nearest(name, CHECKS)}"
            raise ValueError(f"{name}: no such coefficient of contacts; {allowed}")
    given = {name: float(value) for name, value in values.items() if value is not None}
    return replace(before, **given) if before else ContactLaw(**given)


def tables(
    count: int, usual: ContactLaw, others: Mapping[tuple[int, int], ContactLaw], stiffness: float
) -> ContactLaw:
    """The tables of so many materials, with the `usual` law but in the pairs of `others`, and this `stiffness` [N/m]
    where none is stated."""

    def table(name: str) -> np.ndarray:
        found = np.full((count, count), getattr(usual, name), dtype=float)  # None is NaN
        for (i, j), other in others.items():
            found[i, j] = found[j, i] = getattr(other, name)
        return np.where(np.isnan(found), stiffness, found)

    return ContactLaw(**{name: table(name) for name in CHECKS})
