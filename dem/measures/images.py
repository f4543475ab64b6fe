"""Images of what is in a periodic cell, for regions that reach over its boundaries."""

from __future__ import annotations

from itertools import product

import numpy as np

from dem.arrays import Floats, Ints
from dem.compiled import loop

MOST = 10_000  #: repetitions of a cell that a region may reach over: each takes a pass over all grains


def images(
    point: Floats, lattice: Floats, low: Floats, high: Floats, reach: float = 0.0
) -> tuple[Ints, Floats]:
    """Rows (m,) and numbers of repetitions (m, 3) of all images of points (n, 3) that lie in the box from `low` to
    `high` (3,), or within `reach` of it [m]; a point itself is its image of no repetition.

    The lattice (3, 3) has the way to the next image along each axis [m], zeros without a period; beside its own
    component a way has at most one along x. Along axes without a period the box may be infinite. ValueError, which does
    not depend on the points, for a box that is larger than MOST cells."""
    axes = np.flatnonzero(lattice.any(axis=1))
    cells = np.prod((high - low)[axes] / lattice[axes, axes])
    if not cells <= MOST:
        raise ValueError(f"region: it reaches over {cells:.3g} periodic cells; allowed are at most {MOST}")
    rows, steps = [np.zeros(0, np.int64)], [np.zeros((0, 3))]
    if len(point):
        least, most = _extremes(point)
        least, most = low - reach - most, high + reach - least
        back = np.linalg.inv(lattice[np.ix_(axes, axes)])
        ends = np.stack([least[axes, None] * back, most[axes, None] * back])
        first, last = ends.min(axis=0).sum(axis=0), ends.max(axis=0).sum(axis=0)
        slack = 1e-9  # of rounding; the box decides
        for number in product(*map(np.arange, np.ceil(first - slack), np.floor(last + slack) + 1.0)):
            step = np.zeros(3)
            step[axes] = number
            row = _inside(point, step @ lattice, low - reach, high + reach)
            rows.append(row)
            steps.append(np.full((len(row), 3), step))
    return np.concatenate(rows), np.concatenate(steps)


@loop
def _extremes(point: Floats) -> tuple[Floats, Floats]:
    """The least and the greatest coordinates (3,) of points (n, 3): of short rows numpy takes twenty times as long."""
    least, most = point[0].copy(), point[0].copy()
    for n in range(len(point)):
        for k in range(3):
            least[k], most[k] = min(least[k], point[n, k]), max(most[k], point[n, k])
    return least, most


@loop
def _inside(point: Floats, way: Floats, low: Floats, high: Floats) -> Ints:
    """The rows of the points (n, 3) that a way (3,) brings into a box."""
    rows, count = np.empty(len(point), np.int64), 0
    for n in range(len(point)):
        x, y, z = point[n, 0] + way[0], point[n, 1] + way[1], point[n, 2] + way[2]
        rows[count] = n
        count += low[0] <= x <= high[0] and low[1] <= y <= high[1] and low[2] <= z <= high[2]
    return rows[:count]


def about(lattice: Floats) -> Floats:
    """The ways (k, 3) to the next images of a lattice (3, 3) on all sides, and to the point itself [m]."""
    steps = [np.arange(-1.0, 2.0) if way.any() else np.zeros(1) for way in lattice]
    ways: Floats = np.array(list(product(*steps))) @ lattice
    return ways


def nearest_image(vector: Floats, lattice: Floats) -> Floats:
    """Vectors (n, 3) [m] less the repetitions of the lattice (3, 3) that are nearest to them along each axis."""
    out = vector.copy()
    for axis in (2, 1, 0):  # what is behind a sheared boundary is moved along x too
        if lattice[axis, axis]:
            out -= np.round(out[:, axis] / lattice[axis, axis])[:, None] * lattice[axis]
    return out
