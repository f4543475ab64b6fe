"""Images of what is in a periodic cell, for regions that reach over its boundaries."""

from __future__ import annotations

from itertools import product

import numpy as np

from dem.arrays import Floats, Ints

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
        least, most = low - reach - point.max(axis=0), high + reach - point.min(axis=0)
        inverse = np.linalg.inv(lattice[np.ix_(axes, axes)])
        ends = np.stack([least[axes, None] * inverse, most[axes, None] * inverse])
        first, last = ends.min(axis=0).sum(axis=0), ends.max(axis=0).sum(axis=0)
        slack = 1e-9  # of rounding; the box decides
        for number in product(*map(np.arange, np.ceil(first - slack), np.floor(last + slack) + 1.0)):
            step = np.zeros(3)
            step[axes] = number
            place = point + step @ lattice
            row = np.flatnonzero(((place >= low - reach) & (place <= high + reach)).all(axis=1))
            rows.append(row)
            steps.append(np.tile(step, (len(row), 1)))
    return np.concatenate(rows), np.concatenate(steps)


def about(lattice: Floats) -> Floats:
    """The ways (k, 3) to the next images of a lattice (3, 3) on all sides, and to the point itself [m]."""
    steps = [np.arange(-1.0, 2.0) if vector.any() else np.zeros(1) for vector in lattice]
    vectors: Floats = np.array(list(product(*steps))) @ lattice
    return vectors


def nearest_image(vector: Floats, lattice: Floats) -> Floats:
    """Vectors (n, 3) [m] less the repetitions of the lattice (3, 3) that are nearest to them along each axis."""
    out = vector.copy()
    for axis in (2, 1, 0):  # what is behind a sheared boundary is moved along x too
        if lattice[axis, axis]:
            out -= np.round(out[:, axis] / lattice[axis, axis])[:, None] * lattice[axis]
    return out
