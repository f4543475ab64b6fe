"""The product of a train with a distributed vector. All ranks have the cores of the train."""

from __future__ import annotations

import warnings

import numpy as np
from mpi4py import MPI

from pctt.tt.apply import Apply
from pctt.tt.grid import GridDigits
from pctt.tt.train import Array, Train

LONG = 1_000_000  # several ranks that gather longer vectors cause a warning


def places_of_rows(digits: GridDigits, order: Array | None) -> Array:
    """The place of each row of the Mat among the rows of a train.

    order : row at each point of the grid, or None
    """
    if order is None:
        return digits.places
    places = np.empty(digits.rows, np.int64)
    places[order] = digits.places
    return places


class TrainProduct:
    """This rank's rows of y = T x, from its rows of x.

    train : matrix train with the modes of `digits`; in single precision, products have errors of about 1e-6
    counts : number of rows of each rank
    order : row at each point of the grid, or None

    Every rank gathers x and multiplies with its part of the rows of the train. If the order of the rows in the train
    differs from the order in the Mat, the ranks also gather the product.

    flops : operations of a product on this rank
    """

    def __init__(
        self, comm: MPI.Comm, counts: Array, digits: GridDigits, order: Array | None, train: Train,
    ) -> None:  # fmt: skip
        self.comm, self.counts = comm, np.asarray(counts)
        rows = digits.rows
        if comm.size > 1 and rows > LONG and comm.rank == 0:
            warnings.warn(f"pctt: each of {comm.size} ranks gathers whole vectors of {rows} numbers", stacklevel=2)
        places = places_of_rows(digits, order)
        first = int(self.counts[: comm.rank].sum())
        self.mine = slice(first, first + int(self.counts[comm.rank]))
        ranks = np.linspace(0, digits.size, comm.size + 1).astype(int)
        self.same = bool((np.diff(places) == 1).all()) and digits.size == rows
        if self.same:
            bounds = (self.mine.start, self.mine.stop)
        else:
            bounds = (int(ranks[comm.rank]), int(ranks[comm.rank + 1]))
            self.places, self.places_here = places, places[self.mine]
        self.parts = np.diff(ranks)
        self.whole = np.empty(rows)
        self.product = np.empty(digits.size)
        self.apply = Apply(train, digits.size, bounds)

    @property
    def flops(self) -> int:
        return self.apply.flops

    def __call__(self, x: Array) -> Array:
        """The product; the array is valid until the next call."""
        if self.comm.size > 1:
            self.comm.Allgatherv(np.ascontiguousarray(x), [self.whole, self.counts])
            x = self.whole
        if self.apply.dtype == float:
            return self._times(x)
        largest = float(np.abs(x).max(initial=0.0)) or 1.0  # single precision overflows at 1e38
        return np.multiply(largest, self._times(x / largest), dtype=float)

    def _times(self, x: Array) -> Array:
        if self.same:
            self.apply.x[:] = x
            return self.apply.product()
        self.apply.x[self.places] = x
        y = self.apply.product()
        if self.comm.size == 1:
            return y[self.places]
        self.comm.Allgatherv(np.ascontiguousarray(y, dtype=float), [self.product, self.parts])
        return self.product[self.places_here]
