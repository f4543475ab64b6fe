"""Places for many grains: a lattice whose points are moved at random, and dense random packings of spheres."""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Sequence

import numpy as np
from mpi4py import MPI

from dem import checks
from dem.arrays import Floats, Rule
from dem.contact.broad import close_pairs
from dem.geometry.insertion import inserted
from dem.parts.cell import Cell
from dem.parts.sizes import Sizes
from dem.parts.sizes import sizes as sizes_of
from dem.quaternion import length

SPARSE = 0.1  #: solid fraction up to which spheres are put at random places one after another
SWELL = 1e-4  #: by how much radii are larger while overlaps are removed, so that none is left
GROWTH = 1.03  #: of the radii from stage to stage
TRIES = 100  #: places for a sphere
WAIT = 10.0  #: seconds after which the program says how far it is


def perturbed(x: Floats, y: Floats, z: Floats, perturbation: float, seed: int) -> Rule:
    """Return points (nx ny nz, 3) of the lattice with these coordinates per axis, each moved by up to `perturbation`
    [m] per axis; z goes on from row to row."""
    count = len(x) * len(y) * len(z)
    shift = uniform(-1.0, 1.0, (count, 3), seed)

    def make(first: int, end: int) -> Floats:
        i, j, k = np.unravel_index(np.arange(first, end), (len(x), len(y), len(z)))
        return np.stack([x[i], y[j], z[k]], axis=-1) + perturbation * shift[first:end]

    return Rule(count, make)


def uniform(low: float, high: float, shape: tuple[int, ...], seed: int) -> Rule:
    """Return the array of this shape that `default_rng(seed).uniform` gives, of which any rows are made without the
    others: of the generator PCG64 every number takes one step, and it can jump (`advance`)."""
    width, seed = math.prod(shape[1:]), checks.seed("seed", seed)

    def make(first: int, end: int) -> Floats:
        generator = np.random.Generator(np.random.PCG64(seed).advance(first * width))
        return generator.uniform(low, high, (end - first, *shape[1:]))

    return Rule(shape[0], make)


def random_packing(
    lengths: Sequence[float], radius: float | Sequence[float] | Sizes, fraction: float, *,
    periodic: Sequence[bool] = (False, False, False), seed: int = 0, most: int = 20000,
) -> tuple[Floats, Floats]:  # fmt: skip
    """Return centres (n, 3) and radii (n,) [m] of spheres without overlaps in the box from zero to the `lengths` (3,)
    [m], with at least this solid `fraction`: up to about 0.6 where all axes are periodic. Walls leave more room between
    spheres: equal ones reach 0.50 in a box of 10 radii, 0.55 in one of 20, 0.58 in one of 40.

    Along `periodic` axes the box repeats itself; others have walls, which spheres do not cross. Spheres of a tenth of
    the volume are put at random places; then they grow from step to step, and what overlaps is pushed apart (Jodrey,
    Tory, Physical Review A 32 (1985); Lubachevsky, Stillinger, J. Stat. Phys. 60 (1990)). ValueError if `most` rounds
    of that leave overlaps, as the fraction is too high. The first rank says every WAIT seconds how far it is.
    """
    box = checks.vector("lengths of a packing", checks.positive("lengths of a packing", lengths))
    fraction = checks.number("solid fraction", fraction)
    if not 0.0 < fraction < 0.74:
        raise ValueError(f"solid fraction must be between 0 and 0.74, got {fraction:g}")
    sizes = sizes_of(radius)
    if np.shape(periodic) != (3,):
        raise ValueError(f"periodic {periodic!r}: allowed are three, for x, y and z, such as (True, True, False)")
    if 2.0 * sizes.ends[1] * (2.0 if any(periodic) else 1.0) > box.min():
        raise ValueError(f"spheres of radius {sizes.ends[1]:g} m do not fit into a box with a side of {box.min():g} m")
    random = np.random.default_rng(checks.seed("seed of a packing", seed))
    wanted = fraction * box.prod()
    radii = sizes.at(random.random(int(np.ceil(1.2 * wanted / (4 / 3 * np.pi * sizes.ends[0] ** 3))) + 1))
    radii = radii[: 1 + int(np.searchsorted(np.cumsum(4 / 3 * np.pi * radii**3), wanted * (1.0 - 1e-12)))]
    radii = np.sort(radii)[::-1].copy()  # large ones find no place among small ones
    cell = Cell(np.where(periodic, box, np.inf))
    part = min((SPARSE / fraction) ** (1 / 3), 1.0)
    low = np.where(periodic, 0.0, radii[:, None])
    place = low[:, None] + random.random((len(radii), TRIES, 3)) * (box - 2.0 * low)[:, None]
    free = np.ones(place.shape[:2], bool)
    taken = inserted(place, free, part * radii, np.zeros((0, 3)), np.zeros(0), cell.period)
    if (taken < 0).any():
        raise ValueError(f"no place for {np.count_nonzero(taken < 0)} of {len(radii)} spheres: the box is too small")
    position, left = place[np.arange(len(radii)), taken], most
    progress = _Progress(len(radii), math.ceil(-math.log(part) / math.log(GROWTH)))
    while part < 1.0:
        part = min(GROWTH * part, 1.0)
        progress.begin()
        position, left = _apart(position, part * radii * (1.0 + SWELL), box, cell, left, progress)
    order = random.permutation(len(radii))
    return position[order], radii[order]


class _Progress:
    """Says on the terminal how far a packing is. The overlaps of a stage fall exponentially; the last one or two stages
    take as long as all others."""

    def __init__(self, count: int, stages: int) -> None:
        self._words, self._stages, self._stage = f"packing {count} spheres", stages, 0
        self._told = time.monotonic()

    def begin(self) -> None:
        """A stage begins."""
        self._stage += 1
        self._since, self._first = time.monotonic(), 0.0

    def look(self, overlap: float, enough: float) -> None:
        """The greatest overlap after a round, and that with which the stage ends."""
        now = time.monotonic()
        self._first = max(self._first, overlap)
        if now - self._told < WAIT or MPI.COMM_WORLD.rank > 0:
            return
        self._told = now
        fallen = math.log(self._first / overlap) if overlap > enough else 0.0
        left = (now - self._since) * math.log(overlap / enough) / fallen if fallen > 0.0 else 0.0
        more = f", which takes about {left:.0f} s more" if left else ""
        sys.stderr.write(f"{self._words}: stage {self._stage} of {self._stages}{more}\n")
        sys.stderr.flush()


def _apart(
    position: Floats, radius: Floats, box: Floats, cell: Cell, most: int, progress: _Progress
) -> tuple[Floats, int]:
    """The places (n, 3) of spheres moved until overlaps are less than SWELL radii, and how many of the rounds are left.

    Spheres that overlap are pushed apart by a part of the overlap, and go on for a part of the way of the last round.
    """
    displacement = np.zeros_like(position)
    for rounds in range(most, 0, -1):
        one, other, apart = _pairs(position, radius, cell)
        distance = length(apart)
        reach = radius[one] + radius[other]
        deep = reach - distance
        push = (np.maximum(deep, 0.0) / np.maximum(distance, 1e-300))[:, None] * apart
        shift = np.zeros_like(position)
        for k in range(3):
            shift[:, k] = np.bincount(other, push[:, k], len(position)) - np.bincount(one, push[:, k], len(position))
        walls = np.where(cell.axes, 0.0, np.clip(position, radius[:, None], box - radius[:, None]) - position)
        if (deep < SWELL * reach / 2.0).all() and (np.abs(walls) < SWELL * radius[:, None] / 2.0).all():
            return position, rounds
        progress.look(float((deep / reach).max(initial=0.0)), SWELL / 2.0)
        displacement = 0.8 * displacement + 0.15 * (shift + 2.0 * walls)
        position = cell.wrapped(position + displacement)
    raise ValueError(f"a packing of {len(radius)} spheres still overlaps by {(deep / reach).max():.1e} of their size: "
                     "take a lower solid fraction")  # fmt: skip


def _pairs(position: Floats, radius: Floats, cell: Cell) -> tuple[Floats, Floats, Floats]:
    """Rows (m,) and (m,) of spheres that touch, and the ways (m, 3) from the first to the second or its image."""
    source, moved, reach = [], [], 2.0 * radius.max()
    for vector in cell.image_vectors:  # the first are those in the box
        image = position + vector
        near = (((image > -reach) & (image < cell.period + reach)) | ~cell.axes).all(axis=1)
        source.append(np.flatnonzero(near))
        moved.append(image[near])
    row, place = np.concatenate(source), np.concatenate(moved)
    pairs = close_pairs(place, radius[row])
    pairs = pairs[pairs[:, 0] < len(position)]  # the first is in the box; a pair across a face is found from both
    one, other = row[pairs[:, 0]], row[pairs[:, 1]]
    once = (pairs[:, 1] < len(position)) | (one < other)
    apart = place[pairs[:, 1]] - place[pairs[:, 0]]
    return one[once], other[once], apart[once]
