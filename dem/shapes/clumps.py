"""Shapes of grains that are unions of spheres: mass, centre and moments, in the frame of the principal axes.

The integrals over balls are exact. What two or more of them share counts once: it is taken off again by columns along
z, in which the integrals are exact, and by the midpoint rule over CELLS x CELLS of them across what is shared. So
clumps whose spheres do not overlap are exact. The volume of a lens of two balls comes out to 1e-5 of the lens, and the
moments are as good (tests/dem/test_clump.py).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from dem import quaternion
from dem.arrays import Floats
from dem.bodies import CLUMP
from dem.compiled import loop
from dem.shapes.forms import Form

if TYPE_CHECKING:
    from dem.shapes import Clump

CELLS = 1000


@dataclass(frozen=True, eq=False, repr=False)
class ClumpForm(Form):
    """The form of a `Clump`; the volume is that of the union."""

    center: Floats  #: (k, 3) of the spheres [m]
    radius: Floats  #: (k,) [m]
    BASE: ClassVar[int] = CLUMP
    SCALES: ClassVar[bool] = False

    @property
    def arm(self) -> float:
        return float(np.linalg.norm(self.center, axis=1).max())

    @property
    def size(self) -> Floats:
        """As of `Form`."""
        around = float((np.linalg.norm(self.center, axis=1) + self.radius).max())
        return np.array([around, np.cbrt(0.75 * self.volume / np.pi), self.radius.max()])

    def described(self) -> dict[str, Any]:
        """As of `Form`: spheres."""
        return {"centres": self.center.tolist(), "radii": self.radius.tolist()}


@cache
def form(shape: Clump) -> ClumpForm:
    """The form of a clump; the same object for equal clumps."""
    center, radius = np.array(shape.centres), np.array(shape.radii)
    middle = center.mean(axis=0)
    volume, place, tensor = union(center - middle, radius)
    moments, turn = quaternion.principal(tensor)
    place = place + middle
    own = quaternion.rotate(quaternion.conjugate(turn), center - place)
    return ClumpForm(volume, moments, place, turn, own, radius)


def union(center: Floats, radius: Floats) -> tuple[float, Floats, Floats]:
    """Volume [m^3], centre (3,) [m] and inertia tensor (3, 3) about it over the density [m^5] of the union of balls of
    centres (k, 3) and radii (k,)."""
    volumes = 4.0 / 3.0 * np.pi * radius**3
    second = np.einsum("k,ka,kb->ab", volumes, center, center) + np.sum(0.2 * volumes * radius**2) * np.eye(3)
    volume, first = float(volumes.sum()), volumes @ center
    if len(box := _shared(center, radius)):
        over = overcounted(center, radius, box.min(axis=0)[0], box.max(axis=0)[1], CELLS)
        volume, first = volume - float(over[0]), first - over[1:4]
        second = second - over[[4, 5, 6, 5, 7, 8, 6, 8, 9]].reshape(3, 3)
    place = first / volume
    second = second - volume * np.outer(place, place)
    return volume, place, np.trace(second) * np.eye(3) - second


def _shared(center: Floats, radius: Floats) -> Floats:
    """Boxes (m, 2, 3) about what each two balls that overlap share."""
    i, j = np.triu_indices(len(radius), 1)
    apart = np.linalg.norm(center[i] - center[j], axis=1)
    both = apart < (radius[i] + radius[j]) * (1.0 - 1e-12)
    i, j = i[both], j[both]
    low = np.maximum(center[i] - radius[i, None], center[j] - radius[j, None])
    high = np.minimum(center[i] + radius[i, None], center[j] + radius[j, None])
    return np.stack([low, high], axis=1)


@loop
def overcounted(center, radius, low, high, cells):
    """Integrals of 1, x, y, z, xx, xy, xz, yy, yz, zz (10,) over the balls of centres (k, 3) and radii (k,), less
    those over their union, from columns between the corners low and high (3,)."""
    out = np.zeros(10)
    start, end = np.empty(len(radius)), np.empty(len(radius))
    hx, hy = (high[0] - low[0]) / cells, (high[1] - low[1]) / cells
    for m in range(cells):
        x = low[0] + (m + 0.5) * hx
        for n in range(cells):
            y = low[1] + (n + 0.5) * hy
            found = 0
            for k in range(len(radius)):
                square = radius[k] ** 2 - (x - center[k, 0]) ** 2 - (y - center[k, 1]) ** 2
                if square > 0.0:
                    half = np.sqrt(square)
                    to = found
                    while to > 0 and start[to - 1] > center[k, 2] - half:
                        start[to], end[to] = start[to - 1], end[to - 1]
                        to -= 1
                    start[to], end[to] = center[k, 2] - half, center[k, 2] + half
                    found += 1
            if found < 2:
                continue
            reached = start[0]
            one, z, zz = 0.0, 0.0, 0.0
            for k in range(found):  # of each interval, in the order of their starts, what those before it cover
                a, b = start[k], min(end[k], reached)
                if b > a:
                    one, z, zz = one + b - a, z + 0.5 * (b**2 - a**2), zz + (b**3 - a**3) / 3.0
                reached = max(reached, end[k])
            out[0] += one
            out[1], out[2], out[3] = out[1] + x * one, out[2] + y * one, out[3] + z
            out[4], out[5], out[6] = out[4] + x * x * one, out[5] + x * y * one, out[6] + x * z
            out[7], out[8], out[9] = out[7] + y * y * one, out[8] + y * z, out[9] + zz
    return out * hx * hy
