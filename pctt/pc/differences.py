"""A fast transform as preconditioner, where the entries of a matrix on a grid depend on differences of points only."""

from __future__ import annotations

from collections.abc import Callable
from itertools import product
from math import prod

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from pctt.mat.entries import Entries, is_symmetric
from pctt.mat.order import Places, digits_of
from pctt.tt.differences import FastTransform, best
from pctt.tt.train import Array

PAIRS = 512  # random pairs of points that are compared with moved and with reflected ones
ALIKE = 1e-6  # entries with a smaller relative difference count as equal
NOTHING = 1e-12  # relative to the largest entry of the sample
CHUNK = 1 << 20  # entries that are evaluated at a time


class DifferencesInverse:
    """The inverse of the fast transform that is nearest to a matrix whose entries depend on differences.

    transform : see `pctt.tt.differences.FastTransform`
    iterations : those of conjugate gradients on a part of the grid, to 1e-8
    shape : that of the grid
    """

    def __init__(
        self, comm: MPI.Comm, counts: Array, order: Array | None, transform: FastTransform, iterations: int,
    ) -> None:  # fmt: skip
        self.comm, self.counts, self.order = comm, counts, order
        self.transform, self.iterations, self.shape = transform, iterations, transform.shape
        first = int(counts[: comm.rank].sum())
        self._mine = slice(first, first + int(counts[comm.rank]))
        self._whole = np.empty(int(counts.sum()))

    @classmethod
    def of(cls, P: PETSc.Mat, order: str, name: str, places: Places | None = None) -> DifferencesInverse | None:
        """For a Mat with entries; None if they do not depend on differences, or are not symmetric and positive.

        order, name, places : as in `digits_of`. Collective; EntriesError or ValueError on all ranks.
        """
        if P.getBlockSize() > 1:
            return None
        comm, entries = P.comm.tompi4py(), Entries.of(P)
        digits, rows, _ = digits_of(P, order, name, places)
        even = depend_on_differences(entries, digits.shape, rows, np.random.default_rng(0))
        if even is None or not is_symmetric(entries, digits.rows):
            return None
        differences = means_of_differences(entries, digits.shape, rows, even)
        # what other ranks find best may differ by rounding
        found = comm.bcast(best(differences) if comm.rank == 0 else None)
        if found is None:
            return None
        transform = FastTransform(differences, found[0])
        if not comm.bcast(transform.positive):
            return None
        counts = np.array(comm.allgather(P.getLocalSize()[0]))
        return cls(comm, counts, rows, transform, found[1])

    def __call__(self, x: Array) -> Array:
        """This rank's part of the product, from its part of x. Every rank transforms the whole vector."""
        if self.comm.size > 1:
            self.comm.Allgatherv(np.ascontiguousarray(x), [self._whole, self.counts])
            x = self._whole
        if self.order is None:
            return self.transform.solve(x)[self._mine]
        self._whole[self.order] = self.transform.solve(x[self.order])
        return self._whole[self._mine]

    @property
    def flops(self) -> int:
        """Operations of this rank in a product: two transforms."""
        return int(5 * len(self._whole) * np.log2(max(2, len(self._whole))))

    def words(self) -> str:
        return f"{self.transform.name} of a grid of {' x '.join(map(str, self.shape))}"


def depend_on_differences(
    entries: Callable[[Array, Array], Array], shape: tuple[int, ...], order: Array | None, rng: np.random.Generator,
) -> bool | None:  # fmt: skip
    """Whether entries at random pairs are those at pairs of the same difference elsewhere; collective.

    None: they are not. True: they also keep their values if coordinates of the difference change their signs.
    The offsets of the pairs are of all sizes, so that steep kernels show.
    """
    places = []
    signs = rng.choice([-1, 1], (len(shape), PAIRS))
    joint = rng.random(PAIRS)
    for n, sign in zip(shape, signs):
        reach = np.minimum((n ** np.where(rng.random(PAIRS) < 0.5, joint, rng.random(PAIRS))).astype(int) - 1, n - 1)
        offset = rng.integers(0, reach + 1)
        here, there = rng.integers(0, n - offset, (2, PAIRS))
        places.append([here, here + offset, there, there + offset])
        places[-1] += [np.where(sign > 0, there, there + offset), np.where(sign > 0, there + offset, there)]
    points = [np.ravel_multi_index(axis, shape) for axis in zip(*places)]
    i, j, moved_i, moved_j, turned_i, turned_j = points if order is None else [order[p] for p in points]
    here, moved, turned = entries(i, j), entries(moved_i, moved_j), entries(turned_i, turned_j)
    if not _alike(here, moved):
        return None
    return _alike(here, turned)


def _alike(a: Array, b: Array) -> bool:
    largest = np.maximum(np.abs(a), np.abs(b))
    return bool((np.abs(a - b) <= ALIKE * largest + NOTHING * largest.max(initial=0.0)).all())


def means_of_differences(
    entries: Callable[[Array, Array], Array], shape: tuple[int, ...], order: Array | None, even: bool
) -> Array:
    """The means (n_1, ..., n_D) of the entries over the signs of the coordinates of differences; collective.

    even : all signs give the same entries
    """
    size = prod(shape)
    out = np.zeros(size)
    turns = [(1,) * len(shape)] if even else [(1, *signs) for signs in product((1, -1), repeat=len(shape) - 1)]
    for first in range(0, size, CHUNK):
        points = np.arange(first, min(first + CHUNK, size))
        distance = np.unravel_index(points, shape)
        for signs in turns:
            i = np.ravel_multi_index(tuple(x if s > 0 else 0 * x for x, s in zip(distance, signs)), shape)
            j = np.ravel_multi_index(tuple(x if s < 0 else 0 * x for x, s in zip(distance, signs)), shape)
            out[points] += entries(i, j) if order is None else entries(order[i], order[j])
    return out.reshape(shape) / len(turns)
