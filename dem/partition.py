"""Slabs: which rank owns which grains.

Grains are ordered along a Morton (Z-order) curve, and every rank owns a contiguous piece of it that carries
its share of the contacts. Nothing of the size of the whole system is gathered for that.
"""

from __future__ import annotations

import numpy as np
from mpi4py import MPI

from dem.arrays import Floats, Ints
from dem.bodies import Bodies
from dem.exchange import exchange
from dem.morton import BITS, Frame, morton_codes
from dem.world import World


def splitters(comm: MPI.Comm, codes: Ints, weights: Floats, pieces: int) -> Ints:
    """Codes (pieces - 1,) at which the curve is cut into pieces of equal weight; collective.

    codes (n,), weights (n,): of the local grains, in any order. Cut k is the greatest code with at most the
    fraction (k + 1) / pieces of the weight below it, found digit by digit from weighted histograms.
    """
    order = np.argsort(codes)
    ordered = codes[order]
    cumulative = np.concatenate([[0.0], np.cumsum(weights[order])])
    total = comm.allreduce(float(cumulative[-1]))
    target = total * np.arange(1, pieces) / pieces
    cuts = np.zeros(pieces - 1, dtype=np.int64)
    digit = 9  # bits that one reduction settles: 63 / 9 = 7 reductions of 511 numbers per splitter
    for shift in range(3 * BITS - digit, -1, -digit):
        candidates = cuts[:, None] + (np.arange(1, 2**digit) << shift)
        below = cumulative[np.searchsorted(ordered, candidates)]
        comm.Allreduce(MPI.IN_PLACE, below)
        cuts += np.count_nonzero(below <= target[:, None], axis=1) << shift
    return cuts


def frame_of_most(comm: MPI.Comm, positions: Floats) -> Frame:
    """The cube about all positions (n, 3) of the ranks but those that are far away, whose codes are those of its faces:
    the others would share one cell with all others. Collective.

    Along each axis it leaves out what is further from the middle half of the positions than 16 times its width."""
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    if len(positions):
        low, high = positions.min(axis=0), positions.max(axis=0)
    comm.Allreduce(MPI.IN_PLACE, low, MPI.MIN)
    comm.Allreduce(MPI.IN_PLACE, high, MPI.MAX)
    width = np.maximum(high - low, np.finfo(float).tiny)
    for axis in range(3):
        codes = ((positions[:, axis] - low[axis]) / width[axis] * 2.0**53).astype(np.int64)
        first, _, third = low[axis] + splitters(comm, codes, np.ones(len(codes)), 4) / 2.0**53 * width[axis]
        low[axis], high[axis] = max(low[axis], 17 * first - 16 * third), min(high[axis], 17 * third - 16 * first)
    return Frame.between(low, high)


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


def imbalance(world: World) -> float:
    """Greatest load of a rank over the mean load, in contacts plus grains; collective."""
    greatest, _, mean = _loads(world)
    return greatest / mean


def rebalance(world: World, tolerance: float = 1.05) -> bool:
    """Redistribute if a rank has more than `tolerance` times the mean load of the last search, and the load of the
    heaviest grain beside it, as no cut divides that; say if it did; collective."""
    greatest, heaviest, mean = _loads(world)
    if world.comm.size == 1 or greatest <= tolerance * mean + heaviest:
        return False
    redistribute(world)
    return True


def _loads(world: World) -> Floats:
    """The greatest load of a rank, the greatest of a grain and the mean load of the ranks; collective."""
    comm, load = world.comm, world.grains.weight + 1.0
    most, total = np.array([load.sum(), load.max(initial=0.0)]), np.array([load.sum()])
    comm.Allreduce(MPI.IN_PLACE, most, MPI.MAX)
    comm.Allreduce(MPI.IN_PLACE, total, MPI.SUM)
    return np.append(most, total / comm.size)
