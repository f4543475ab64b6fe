"""Pairs with clumps as pairs of their spheres, for the narrow phase."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from dem.arrays import Floats, Ints
from dem.bodies import CLUMP, PLANE, POLYHEDRON, Bodies
from dem.compiled import inlined, loop
from dem.shapes.clumps import ClumpForm
from dem.shapes.forms import Form


class Members(NamedTuple):
    """The spheres of the clumps of a table of bodies."""

    start: Ints  #: (rows + 1,) of the spheres of each body; those that are no clumps have none
    row: Ints  #: (m,) of the body
    number: Ints  #: (m,) distinct, and not those of other primitives; the first sphere has the id of its clump
    center: Floats  #: (m, 3) in the frame of the body [m]
    radius: Floats  #: (m,) [m]

    def now(self, position: Floats, turn: Floats) -> Floats:
        """Centres (m, 3) of the spheres of bodies with these positions (rows, 3) and quaternions (rows, 4)."""
        return _placed(self.row, self.center, position, turn)


@loop
def _placed(row, center, position, turn):
    """Points `center` (m, 3) of bodies in the rows (m,) in the world."""
    out = np.empty((len(row), 3))
    for n in range(len(row)):
        i = row[n]
        w, a, b, c = turn[i, 0], turn[i, 1], turn[i, 2], turn[i, 3]
        x, y, z = center[n, 0], center[n, 1], center[n, 2]
        u, v, t = 2 * (b * z - c * y), 2 * (c * x - a * z), 2 * (a * y - b * x)
        out[n, 0] = position[i, 0] + (x + w * u + b * t - c * v)
        out[n, 1] = position[i, 1] + (y + w * v + c * u - a * t)
        out[n, 2] = position[i, 2] + (z + w * t + a * v - b * u)
    return out


def spheres(forms: Sequence[Form]) -> tuple[list[Floats], list[Floats]]:
    """Centres (k, 3) and radii (k,) of the spheres of each of some forms; those that are no clumps have none [m]."""
    none = np.zeros((0, 3)), np.zeros(0)
    each = [(form.center, form.radius) if isinstance(form, ClumpForm) else none for form in forms]
    return [center for center, _ in each], [radius for _, radius in each]


def more_numbers(forms: Sequence[Form], grains: int) -> int:
    """How many numbers the spheres of so many grains take beyond those that have the ids of their clumps."""
    return grains * (max([1, *map(len, spheres(forms)[1])]) - 1)


def members(table: Bodies, forms: Sequence[Form], first: int) -> Members | None:
    """The spheres of all clumps of a table of grains; the numbers beyond the ids go from `first` on. None in scenes
    without."""
    centers, radii = spheres(forms)
    if not any(map(len, radii)):
        return None
    clump = np.flatnonzero((table.shape >= CLUMP) & (table.shape < POLYHEDRON))
    which = table.shape[clump] - CLUMP
    many = np.array([len(radius) for radius in radii])
    count = np.zeros(len(table), np.int64)
    count[clump] = many[which]
    start = np.concatenate([[0], np.cumsum(count)])
    row = np.repeat(np.arange(len(table)), count)
    k = np.arange(len(row)) - start[row]
    of_form = np.repeat((np.cumsum(many) - many)[which], many[which]) + k
    number = np.where(k == 0, table.id[row], first + table.id[row] * (many.max() - 1) + k - 1)
    return Members(start, row, number, np.concatenate(centers)[of_form], np.concatenate(radii)[of_form])


@loop
def spread(i, j, reach, start, first, kind, center, radius):
    """Pairs of rows and their reach, of which spheres stand for clumps, from the pairs i, j (m,) with their `reach`
    (m,): body n has the spheres `start` (rows + 1,) of those in the rows from `first` on. Of pairs with clumps those
    of spheres are left out that are further apart than their reach."""
    count = 0
    for p in range(len(i)):
        a, b = _ends(i[p], start, first)
        c, d = _ends(j[p], start, first)
        for m in range(a, b):
            for n in range(c, d):
                count += _near(m, n, reach[p], first, kind, center, radius)
    one, two, far = np.empty(count, np.int64), np.empty(count, np.int64), np.empty(count)
    to = 0
    for p in range(len(i)):
        a, b = _ends(i[p], start, first)
        c, d = _ends(j[p], start, first)
        for m in range(a, b):
            for n in range(c, d):
                if _near(m, n, reach[p], first, kind, center, radius):
                    one[to], two[to], far[to] = m, n, reach[p]
                    to += 1
    return one, two, far


@inlined
def _ends(row, start, first):
    """The first row of the spheres of a clump and that after the last; else the row itself and the next."""
    low, high = row, row + 1
    if row < len(start) - 1 and start[row + 1] > start[row]:
        low, high = first + start[row], first + start[row + 1]
    return low, high


@inlined
def _near(m, n, reach, first, kind, center, radius):
    """Whether the spheres about two primitives are within reach; of pairs without a sphere of a clump it is known."""
    near = True
    if (m >= first or n >= first) and kind[m] != PLANE and kind[n] != PLANE:
        u, v, w = center[n, 0] - center[m, 0], center[n, 1] - center[m, 1], center[n, 2] - center[m, 2]
        most = (radius[m] + radius[n] + reach) * (1.0 + 1e-9)
        near = u * u + v * v + w * w <= most * most
    return near
