"""Slabs: which rank owns which grains.

Grains are ordered along a Morton (Z-order) curve, and every rank owns a contiguous piece of it that carries
its share of the contacts. Nothing of the size of the whole system is gathered for that.
"""

from __future__ import annotations

import numpy as np
from mpi4py import MPI

from dem.arrays import Floats, Ints
from dem.bodies import Bodies
from dem.exchange import exchange, reduced
from dem.geometry.morton import BITS, Frame, morton_codes
from dem.model.world import World


def splitters(comm: MPI.Comm, codes: Ints, weights: Floats, pieces: int, part: float = 1e-3) -> Ints:
    """Return codes (pieces - 1,) at which the curve is cut into pieces of equal weight, but for this `part` of a piece;
    collective.

    codes (n,), weights (n,): of the local grains, in any order; weights are whole numbers, so that sums are the same on
    any number of ranks. Cut k has at most the fraction (k + 1) / pieces of the weight below it. It is found digit by
    digit from histograms of weights and grains, and is the greatest such code, or one with few grains between them.
    """
    order = np.argsort(codes)
    ordered = codes[order]
    cumulative = np.concatenate([[0.0], np.cumsum(weights[order])])
    cuts, below, shift, found = np.zeros(pieces - 1, np.int64), np.zeros((2, pieces - 1)), 3 * BITS, False
    digit = max(4, 12 - pieces.bit_length())  # bits that one reduction settles: of few pieces more at once
    while shift > 0 and not found:
        step, shift = min(shift, digit), max(shift - digit, 0)
        last = cuts[:, None] + (np.arange(2**step) << shift) + ((1 << shift) - 1)  # codes of each cell
        rows = np.append(np.searchsorted(ordered, last, side="right"), len(codes))
        up_to = np.stack([cumulative[rows], rows])
        comm.Allreduce(MPI.IN_PLACE, up_to)
        target = up_to[0, -1] * np.arange(1, pieces) / pieces
        cells = np.concatenate([below[:, :, None], up_to[:, :-1].reshape(2, pieces - 1, -1)], axis=2)
        cell = np.count_nonzero(cells[0, :, 1:-1] <= target[:, None], axis=1)
        cuts += cell << shift
        below, beyond = (cells[:, np.arange(pieces - 1), cell + k] for k in (0, 1))
        weight, grains = beyond - below
        found = bool(((weight <= part * target[0]) | (grains <= 1.0)).all())
    return cuts


def frame_of_most(comm: MPI.Comm, positions: Floats) -> Frame:
    """Return the cube about all positions (n, 3) of the ranks but those that are far away, whose codes are those of its
    faces: the others would share one cell with all others. Collective.

    Along each axis it leaves out what is further from the middle half of the positions than 16 times its width."""
    ends = np.full((2, 3), np.inf)
    if len(positions):
        ends = np.array([positions.min(axis=0), -positions.max(axis=0)])
    comm.Allreduce(MPI.IN_PLACE, ends, MPI.MIN)
    low, high = ends[0], -ends[1]
    # the quarters along the three axes are cuts of one curve, on which the axes follow each other
    width, axis, length = np.maximum(high - low, np.finfo(float).tiny), np.arange(3) << 61, 2.0**61
    codes = ((positions - low) / width * 2.0**53).astype(np.int64).clip(0, 2**53 - 1) << 8
    cuts = splitters(comm, (codes + axis).ravel(), np.ones(codes.size), 12, 0.1)
    first, third = (low + (cuts[k::4] - axis) / length * width for k in (0, 2))
    return Frame.between(np.maximum(low, 17 * first - 16 * third), np.minimum(high, 17 * third - 16 * first))


def redistribute(world: World) -> None:
    """Give every rank its piece of the curve, sorted by Morton code and then by id; collective."""
    comm, grains = world.comm, world.grains
    if not world.slabs[-1]:
        return  # before the first grain of a source, or after the last
    frame = frame_of_most(comm, grains.position)
    if comm.size > 1:
        codes = morton_codes(grains.position, frame)
        cuts = splitters(comm, codes, grains.weight + 1.0, comm.size)
        owner = np.searchsorted(cuts, codes, side="right")
        grains = Bodies(**exchange(comm, grains.columns(), owner))
    codes = morton_codes(grains.position, frame)
    world.set_grains(grains.take(np.lexsort((grains.id, codes))))


def rebalance(world: World, tolerance: float = 1.05) -> bool:
    """Redistribute if a rank has more than `tolerance` times the mean load of the last search, and the load of the
    heaviest grain beside it, as no cut divides that; say if it did; collective."""
    if world.comm.size == 1:
        return False
    load = world.grains.weight + 1.0
    (total,), (greatest, heaviest) = reduced(world.comm, [load.sum()], [load.sum(), load.max(initial=0.0)])
    if greatest <= tolerance * (total / world.comm.size) + heaviest:
        return False
    redistribute(world)
    return True
