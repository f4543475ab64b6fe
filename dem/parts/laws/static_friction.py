"""Static friction: a contact that sticks has a greater coefficient of friction than one that slides.

A contact that stuck in the last step has the static coefficient in this one, one that slid that of sliding, and so has
a new one, unless its bodies are at rest on each other. A contact sticks if its impulse is inside the cone that it had:
if what is left to the boundary is more than the impulse that the slip is worth, of which a part RESTS of what friction
bears counts as none. So a contact that begins to slide does so with the static coefficient for one step.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from dem import checks
from dem.arrays import Floats
from dem.parts.laws import ContactState, Law, Solved, coefficient

STEEP = 5.0  #: coefficients above are none of materials, and up to 90 they may be angles
RESTS = 0.01  #: solvers leave a slip of that order: so slides only what friction would not stop in this part of a step
ROUNDING = 1e-12  #: a new contact is at rest below this slip [m/s]


@dataclass(frozen=True)
class StaticFriction(Law):
    """The law of two coefficients of friction; ValueError for a static one below that of sliding."""

    static_friction: Any = coefficient(checks.not_negative, 0.0)  #: of contacts that stick; 0: as `friction`

    KEEPS = True  # 1: it stuck, -1: it slid

    def refuse(self) -> None:
        low = (np.asarray(self.static_friction) > 0.0) & (np.asarray(self.static_friction) < self.friction)
        if np.any(low):
            raise ValueError(
                f"static_friction must be 0, or at least the friction of {np.max(self.friction):g}, "
                f"got {np.asarray(self.static_friction)[low].min():g}"
            )

    def doubt(self, radius: float) -> str:
        most = max(self.friction, self.static_friction)
        words = f"friction {most:g}: is it an angle in degrees, of which the tangent is the coefficient?"
        return words if STEEP < most <= 90.0 else ""

    def acts(self) -> bool:
        return bool(np.any(self.static_friction))

    def cone(self, met: ContactState, kept: Floats, friction: Floats) -> Floats:
        sticks = (kept > 0.0) | ((kept == 0.0) & (met.slip < ROUNDING))
        return np.where(sticks, np.maximum(friction, self.static_friction[met.pair]), friction)

    def keep(self, met: ContactState, kept: Floats, solved: Solved) -> Floats:
        normal, *tangents = solved.impulse.T
        bears = solved.friction * normal
        left = np.maximum(bears - np.hypot(*tangents), RESTS * bears)
        return np.where(solved.slip <= met.mobility * left, 1.0, -1.0)
