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
from dem.world import World

#: Bits of a Morton code per axis; three of them fill a signed 64 bit integer.
BITS = 21

#: Bits of a splitter that one reduction settles: 63 / 9 = 7 reductions of 511 numbers per splitter.
DIGIT = 9


def curve_codes(points: Floats, low: Floats, high: Floats) -> Ints:
    """Morton codes (n,) of points (n, 3) on an integer grid over the box from `low` (3,) to `high` (3,)."""
    # One cell size for all axes: a flat box must not get flat cells.
    cell = max(float((high - low).max()), np.finfo(float).tiny) / (2**BITS - 1)
    grid = np.clip(np.floor((points - low) / cell), 0, 2**BITS - 1).astype(np.int64)
    # Spread the bits of each coordinate to every third place, halving the stride of what is moved each time.
    for shift, mask in (
        (32, 0x1F00000000FFFF),
        (16, 0x1F0000FF0000FF),
        (8, 0x100F00F00F00F00F),
        (4, 0x10C30C30C30C30C3),
        (2, 0x1249249249249249),
    ):
        grid = (grid | (grid << shift)) & mask
    return grid[:, 0] | (grid[:, 1] << 1) | (grid[:, 2] << 2)


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
    for shift in range(3 * BITS - DIGIT, -1, -DIGIT):
        candidates = cuts[:, None] + (np.arange(1, 2**DIGIT) << shift)
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
    if comm.size > 1:
        codes = curve_codes(grains.position, low, high)
        cuts = splitters(comm, codes, grains.weight + 1.0)
        owner = np.searchsorted(cuts, codes, side="right")
        grains = Bodies(**exchange(comm, grains.columns(), owner))
    codes = curve_codes(grains.position, low, high)
    world.set_grains(grains.take(np.lexsort((grains.id, codes))))


def imbalance(world: World) -> float:
    """Greatest load of a rank over the mean load, in contacts plus grains; collective."""
    load = float(world.grains.weight.sum() + len(world.grains))
    return world.comm.allreduce(load, MPI.MAX) * world.comm.size / world.comm.allreduce(load)


def rebalance(world: World, tolerance: float = 1.1) -> bool:
    """Redistribute if the imbalance of the last search exceeds `tolerance`; say if it did; collective."""
    if world.comm.size == 1 or imbalance(world) <= tolerance:
        return False
    redistribute(world)
    return True
