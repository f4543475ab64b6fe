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


def splitters(comm: MPI.Comm, codes: Ints, weights: Floats) -> Ints:
    """Codes (size - 1,) at which the curve is cut into pieces of equal weight; collective.

    codes (n,), weights (n,): of the local grains, in any order. Cut k is the greatest code with at most the
    fraction (k + 1) / size of the weight below it, found digit by digit from weighted histograms.
    """
    order = np.argsort(codes)
    ordered = codes[order]
    cumulative = np.concatenate([[0.0], np.cumsum(weights[order])])
    total = comm.allreduce(float(cumulative[-1]))
    target = total * np.arange(1, comm.size) / comm.size
    cuts = np.zeros(comm.size - 1, dtype=np.int64)
    digit = 9  # bits that one reduction settles: 63 / 9 = 7 reductions of 511 numbers per splitter
    for shift in range(3 * BITS - digit, -1, -digit):
        candidates = cuts[:, None] + (np.arange(1, 2**digit) << shift)
        below = cumulative[np.searchsorted(ordered, candidates)]
        comm.Allreduce(MPI.IN_PLACE, below)
        cuts += np.count_nonzero(below <= target[:, None], axis=1) << shift
    return cuts


def redistribute(world: World) -> None:
    """Give every rank its piece of the curve, sorted by Morton code and then by id; collective."""
    comm, grains = world.comm, world.grains
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    if len(grains):
        low, high = grains.position.min(axis=0), grains.position.max(axis=0)
    comm.Allreduce(MPI.IN_PLACE, low, MPI.MIN)
    comm.Allreduce(MPI.IN_PLACE, high, MPI.MAX)
    frame = Frame.between(low, high)
    if comm.size > 1:
        codes = morton_codes(grains.position, frame)
        cuts = splitters(comm, codes, grains.weight + 1.0)
        owner = np.searchsorted(cuts, codes, side="right")
        grains = Bodies(**exchange(comm, grains.columns(), owner))
    codes = morton_codes(grains.position, frame)
    world.set_grains(grains.take(np.lexsort((grains.id, codes))))


def imbalance(world: World) -> float:
    """Greatest load of a rank over the mean load, in contacts plus grains; collective."""
    load = float(world.grains.weight.sum() + len(world.grains))
    loads = world.comm.allgather(load)
    return max(loads) * len(loads) / sum(loads)


def rebalance(world: World, tolerance: float = 1.1) -> bool:
    """Redistribute if the imbalance of the last search exceeds `tolerance`; say if it did; collective."""
    if world.comm.size == 1 or imbalance(world) <= tolerance:
        return False
    redistribute(world)
    return True
