"""Shapes of grains that a scene describes: what clumps, polyhedra and others have in common."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any, ClassVar

import numpy as np

from dem.arrays import Floats, frozen


@dataclass(frozen=True, eq=False, repr=False)
class Form:
    """A shape of grains that a scene describes, of density 1 in the frame with its origin at the centre of mass and the
    principal axes. There is one for all grains that are alike."""

    volume: float  #: [m^3]
    moments: Floats  #: (3,) principal moments over the density [m^5]
    place: Floats  #: (3,) the origin in the frame in which it was given [m]
    turn: Floats  #: (4,) the axes in it
    BASE: ClassVar[int]  #: the kind of the form of number n is BASE + n, see `dem.bodies`
    SCALES: ClassVar[bool]  #: whether each grain has a scale of its own

    def __repr__(self) -> str:
        return f"<{type(self).__name__} of {self.volume:.4g} m^3>"  # which ranks of other processors have, too

    @property
    def arm(self) -> float:
        """How far the centre of a sphere of its surface is from the origin, at most [m]; 0 if it has no spheres."""
        return 0.0

    @property
    def size(self) -> Floats:
        """(3,) radii of the sphere about the origin that encloses it, of the ball of its volume, and of the largest
        sphere in it, as of `dem.bodies.Bodies` [m]."""
        raise NotImplementedError

    def grown(self, scale: Floats, density: Floats) -> tuple[Floats, Floats, Floats]:
        """Sizes (n, 3), as of `dem.bodies.Bodies` [m], masses (n,) [kg] and principal moments (n, 3) [kg m^2] of grains
        that are the form times a scale (n,), of densities (n,) [kg/m^3]."""
        times, rho = scale[:, None], density[:, None]
        return times * self.size, (rho * times**3 * self.volume)[:, 0], rho * times**5 * self.moments

    def described(self) -> dict[str, Any]:
        """Its surface as files have it: `centres` (k, 3) and `radii` (k,) of spheres [m], or `vertices` (v, 3) [m] and
        `triangles` (t, 3), rows of these."""
        raise NotImplementedError


@cache
def arms(forms: tuple[Form, ...]) -> Floats:
    """Return the arms (forms,) of forms [m]."""
    return frozen(np.array([form.arm for form in forms], float))
