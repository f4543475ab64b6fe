"""The law of contacts: the coefficients of each pair of materials (docs/contact_laws.md)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any, cast

import numpy as np

from dem import checks
from dem.arrays import Floats
from dem.parts.laws import ContactState, Law, Solved
from dem.parts.laws.bridges import Bridges
from dem.parts.laws.cohesion import Cohesion
from dem.parts.laws.rolling import Rolling
from dem.parts.laws.static_friction import StaticFriction


@dataclass(frozen=True)
class ContactLaw(Rolling, StaticFriction, Bridges, Cohesion):
    """The coefficients of the contacts of two materials, or tables (materials, materials) of those of all pairs.

    Its methods sum up those of all laws, and `kept` (nc, columns) has a column of each that keeps something.
    ValueError for a coefficient that fails its check, and for those that do not go together.
    """

    def __post_init__(self) -> None:
        for name, check in CHECKS.items():
            value = getattr(self, name)
            if not (value is None or isinstance(value, np.ndarray)):
                check(name, value)
        for law in LAWS:
            law.refuse(self)

    def doubt(self, radius: float) -> str:
        return "; ".join(filter(None, (law.doubt(self, radius) for law in LAWS)))

    @cached_property
    def acting(self) -> list[type[Law]]:
        """The laws that add something."""
        return [law for law in LAWS if law.acts(self)]

    @property
    def parts(self) -> int:
        """How often a contact has three numbers: forces, and moments if contacts resist them."""
        return 2 if self.resists else 1

    @cached_property
    def columns(self) -> int:
        """How many numbers of a contact laws keep beside its impulses."""
        return sum(law.KEEPS for law in self.acting)

    @property
    def resists(self) -> bool:
        """Whether contacts of any pair resist rolling or spinning."""
        return any(law.RESISTS for law in self.acting)

    @cached_property
    def bounces(self) -> bool:
        """Whether bodies of any pair bounce."""
        return bool(self.restitution.any())

    @cached_property
    def attracts(self) -> bool:
        """Whether bodies of any pair attract each other."""
        return bool(self.strongest(np.ones(1)) > 0.0)

    def reach(self) -> float:
        return max((law.reach(self) for law in self.acting), default=0.0)

    def strongest(self, radius: Floats) -> Any:
        return sum(law.strongest(self, radius) for law in self.acting)

    def attraction(self, met: ContactState, kept: Floats) -> Floats | None:
        found = [law.attraction(self, met, column) for law, column in self._each(kept)]
        pulls = [pull for pull in found if pull is not None]
        return np.sum(pulls, axis=0) if pulls else None

    def cone(self, met: ContactState, kept: Floats, friction: Floats) -> Floats:
        for law, column in self._each(kept):
            friction = law.cone(self, met, column, friction)
        return friction

    def moments(self, met: ContactState) -> tuple[Floats, Floats] | None:
        return next((found for law in self.acting if (found := law.moments(self, met)) is not None), None)

    def keep(self, met: ContactState, kept: Floats, solved: Solved) -> Floats:
        found = [law.keep(self, met, column, solved) for law, column in self._each(kept) if law.KEEPS]
        return np.stack(found, axis=1) if found else kept

    def _each(self, kept: Floats) -> list[tuple[type[Law], Floats]]:
        """The laws that act, each with its column of `kept`."""
        columns = iter(kept.T)
        return [(law, next(columns) if law.KEEPS else np.zeros(len(kept))) for law in self.acting]


LAWS = cast("tuple[type[Law], ...]", ContactLaw.__bases__)
CHECKS = {each.name: each.metadata["check"] for each in fields(ContactLaw)}
#: The coefficients that a run may change: no list of pairs, time step or spring depends on them.
CHANGED = ("friction", "static_friction", "restitution", "rolling", "spinning", "rolling_coefficient",
           "spinning_coefficient")  # fmt: skip


def law(
    values: Mapping[str, float | None], before: ContactLaw | None = None, beside: Sequence[str] = ()
) -> ContactLaw:
    """Return the law with these coefficients; None, and what is not given: as `before`. ValueError for a bad one;
    `beside` are arguments that the user may have meant."""
    for name in values:
        if name not in CHECKS:
            allowed = f"allowed are {', '.join(CHECKS)}{checks.nearest(name, (*CHECKS, *beside))}"
            raise ValueError(f"{name}: no such coefficient of contacts; {allowed}")
    given = {name: checks.number(name, value) for name, value in values.items() if value is not None}
    if before is None and "friction" not in given:
        raise ValueError("friction None: allowed is a number >= 0")
    return replace(before, **given) if before else ContactLaw(**given)


def changed(both: ContactLaw, i: int, j: int, values: Mapping[str, float]) -> ContactLaw:
    """Return tables with other coefficients, of `CHANGED`, of the materials i and j. ValueError for a bad one, and
    where a law begins or ends to act: contacts would keep other numbers."""
    law(values, ContactLaw(**{name: float(getattr(both, name)[i, j]) for name in CHECKS}))
    tables = {name: getattr(both, name).copy() for name in values}
    for name, table in tables.items():
        table[i, j] = table[j, i] = values[name]
    found = replace(both, **tables)
    if found.acting != both.acting or found.bounces != both.bounces:
        given = ", ".join(f"{name} {value:g}" for name, value in values.items())
        raise ValueError(f"{given}: this law begins or ends to act, which is for the scene to say; allowed are others")
    return found


def tables(
    count: int, usual: ContactLaw, others: Mapping[tuple[int, int], ContactLaw], stiffness: float
) -> ContactLaw:
    """Return the tables of so many materials, with the `usual` law but in the pairs of `others`, and this `stiffness`
    [N/m] where none is stated."""

    def table(name: str) -> np.ndarray:
        found = np.full((count, count), getattr(usual, name), dtype=float)  # None is NaN
        for (i, j), other in others.items():
            found[i, j] = found[j, i] = getattr(other, name)
        return np.where(np.isnan(found), stiffness, found)

    return ContactLaw(**{name: table(name) for name in CHECKS})
