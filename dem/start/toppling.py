"""How fast smooth bodies that are no balls turn, and how hard they press, as they topple from their longest axis.

A body of the greatest radius a, half thickness c, mass m and the moment I about the axis across both has lost the
height a - c where it lies flat, and turns with w^2 = 2 m g (a - c) / I, if nothing holds it. There its centre is at its
lowest, at a minimum of the curvature (a^2 - c^2) / c over its angle, as that of an ellipsoid: the ground presses it up
with m w^2 (a^2 - c^2) / c beside its weight. It does not stop there, as what has edges does, so what springs and long
steps take of its energy is missing when it rises.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from dem.arrays import Floats
from dem.bodies import CONVEX
from dem.contact.ahead import FURTHEST
from dem.motion import Dynamic
from dem.shapes import placed
from dem.shapes.convex import Convex, ConvexForm

if TYPE_CHECKING:
    from dem.scene import Scene

OVERLAP = 0.0005  #: half thicknesses of an overlap by what presses beside the weight: 3 % of the energy are lost


class Toppling(NamedTuple):
    """Of the smooth bodies of a scene that forces move, where they are flat."""

    half: Floats  #: (n,) half thicknesses [m]
    turn: Floats  #: (n,) [rad/s]
    speed: Floats  #: (n,) with which the place where they touch goes along their surfaces, at least [m/s]
    force: Floats  #: (n,) by which they press, beside their weight [N]

    @property
    def dt(self) -> float:
        """The step [s] in which contacts are foreseen to its end; inf if nothing topples."""
        moves = self.speed > 0.0
        return float((FURTHEST * self.half[moves] / self.speed[moves]).min(initial=np.inf))

    @property
    def stiffness(self) -> float:
        """With which they overlap by OVERLAP [N/m]; 0 if nothing topples."""
        return self.overlap(OVERLAP)

    def overlap(self, stiffness: float) -> float:
        """How far they overlap with a stiffness [N/m], in half thicknesses."""
        return float((self.force / (stiffness * self.half)).max(initial=0.0))


def toppling(scene: Scene) -> Toppling:
    """That of the grains that stand for all, and of large bodies of one shape."""
    grains, large, gravity = scene.expected(), scene.large(), math.hypot(*scene.gravity)
    smooth = [k for k, form in enumerate(scene.forms) if isinstance(form, ConvexForm) and form.shape.rounding > 0.0]
    of = grains.take(np.isin(grains.shape - CONVEX, smooth))
    rows = [n for n, body in enumerate(scene.large_bodies) if isinstance(body.motion, Dynamic) and len(body.shapes) == 1
            and isinstance(shape := body.shapes[0], Convex) and shape.rounding > 0.0]  # fmt: skip
    sizes = np.array([placed(scene.large_bodies[n].shapes[0])[3] for n in rows]).reshape(-1, 3)
    a, _, c = np.concatenate([of.size, sizes]).T
    mass = np.concatenate([of.mass, large.mass[rows]])
    moment = np.sort(np.concatenate([of.inertia, large.inertia[rows]]), axis=1)[:, 1]
    square = 2.0 * mass * gravity * (a - c) / moment
    return Toppling(c, np.sqrt(square), a * np.sqrt(square), mass * square * (a**2 - c**2) / c)
