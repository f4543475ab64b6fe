"""Cohesion: a constant force c [N] with which bodies attract each other up to a range of their gap.

The impulses g of a contact are then in a friction cone that is shifted along its axis: h = g + (c dt, 0, 0) is in the
cone, so that g_n >= -c dt and |g_t| <= mu (g_n + c dt). In h the problem of a step is that without cohesion, with
N h + r - N (c dt, 0, 0) for N g + r: the free velocities of the bodies have what the attraction gives them. So all
solvers take it as it is; what they find, and what the memory keeps, is h. Springs of contacts bear h: bodies that rest
on each other overlap by c / k more.

Source: the shifted cone is that of contact dynamics: Radjai, Richefeu, "Contact dynamics as a nonsmooth discrete
element method", Mech. Mater. 41 (2009).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from dem import checks
from dem.arrays import Floats
from dem.parts.laws import ContactState, Law, coefficient


@dataclass(frozen=True)
class Cohesion(Law):
    """The law of a constant force; ValueError for cohesion without a range."""

    cohesion: Any = coefficient(checks.not_negative, 0.0)  #: force with which bodies attract each other [N]
    cohesion_range: Any = coefficient(checks.not_negative, 0.0)  #: gap up to which they do [m]

    def refuse(self) -> None:
        if np.any((np.asarray(self.cohesion) > 0.0) & (np.asarray(self.cohesion_range) == 0.0)):
            raise ValueError("cohesion: needs a cohesion_range above zero, as touching bodies have gaps of about zero")

    def acts(self) -> bool:
        return bool(np.any(self.cohesion))

    def reach(self) -> float:
        return float(self.cohesion_range[self.cohesion > 0.0].max(initial=0.0))

    def strongest(self, radius: Floats) -> Any:
        return self.cohesion.max()

    def attraction(self, met: ContactState, kept: Floats) -> Floats | None:
        return np.where(met.gap <= self.cohesion_range[met.pair], self.cohesion[met.pair], 0.0)
