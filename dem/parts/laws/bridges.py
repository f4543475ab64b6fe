"""Capillary bridges: liquid of a volume V between two bodies, which pulls them together once they have touched.

A bridge forms when the bodies touch, and pulls with

    F(s) = 2 pi R gamma cos(theta) / (1 + 1.05 x + 2.5 x^2),    x = s sqrt(R / V),

at a gap s, with the mean radius R = 2 / (1 / r + 1 / r'), until it ruptures at s = (1 + theta / 2) V^(1/3). Then the
two must touch again: what comes near without touching is not pulled, and a cycle of touch and separation costs the
integral of F. All bridges of a pair of materials have the same volume; the liquid is not followed.

Source: Willett, Adams, Johnson, Seville, "Capillary bridges between two spherical bodies", Langmuir 16 (2000), for the
force, within 4 % for V < 1e-3 R^3 and theta < 50 degrees; Lian, Thornton, Adams, "A theoretical study of the liquid
bridge forces between two rigid spherical bodies", J. Colloid Interface Sci. 161 (1993), for the rupture.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from dem import checks
from dem.arrays import Bools, Floats
from dem.parts.laws import ContactState, Law, Solved, coefficient

TOUCH = 1e-3  #: bodies touch at gaps below this part of that of rupture, or press with this part of the pull


@dataclass(frozen=True)
class Bridges(Law):
    """The law of capillary bridges; ValueError for a volume without surface tension."""

    bridge_volume: Any = coefficient(checks.not_negative, 0.0)  #: of the liquid of a contact [m^3]
    surface_tension: Any = coefficient(checks.not_negative, 0.0)  #: of the liquid [N/m]
    contact_angle: Any = coefficient(checks.between(0.0, math.pi / 2), 0.0)  #: of the liquid on the surfaces [rad]

    KEEPS = True  # 1: there is a bridge

    def refuse(self) -> None:
        if np.any((np.asarray(self.bridge_volume) > 0.0) & (np.asarray(self.surface_tension) == 0.0)):
            raise ValueError("bridge_volume: needs a surface_tension above zero")

    def acts(self) -> bool:
        return bool(np.any(self.bridge_volume))

    def reach(self) -> float:
        return float(self._rupture().max())

    def strongest(self, radius: Floats) -> Any:
        wets = np.where(self.bridge_volume > 0.0, self.surface_tension * np.cos(self.contact_angle), 0.0)
        return 2.0 * np.pi * radius * wets.max()

    def attraction(self, met: ContactState, kept: Floats) -> Floats | None:
        there = self._bridged(met, kept)
        radius, volume = np.where(there, met.radius, 0.0), np.where(there, self.bridge_volume[met.pair], 1.0)
        x = np.maximum(met.gap, 0.0) * np.sqrt(radius / volume)
        wets = (self.surface_tension * np.cos(self.contact_angle))[met.pair]
        force: Floats = 2.0 * np.pi * radius * wets / (1.0 + 1.05 * x + 2.5 * x**2)
        return force

    def keep(self, met: ContactState, kept: Floats, solved: Solved) -> Floats:
        pressed = TOUCH * met.dt * 2.0 * np.pi * met.radius * self.surface_tension[met.pair]
        touched = (solved.impulse[:, 0] > pressed) & (self.bridge_volume[met.pair] > 0.0)
        return np.where(self._bridged(met, kept) | touched, 1.0, 0.0)

    def _bridged(self, met: ContactState, kept: Floats) -> Bools:
        """Which contacts (nc,) have a bridge in a step: not those of two large bodies, whose radius is infinite."""
        rupture = self._rupture()[met.pair]
        wet = (rupture > 0.0) & (met.gap <= rupture) & np.isfinite(met.radius)
        return wet & ((kept > 0.0) | (met.gap <= TOUCH * rupture))

    def _rupture(self) -> Floats:
        """The gaps at which bridges rupture (materials, materials) [m]."""
        return (1.0 + 0.5 * self.contact_angle) * np.cbrt(self.bridge_volume)
