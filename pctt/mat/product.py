"""The product of a train with a distributed vector. All ranks have the cores of the train."""

from __future__ import annotations

import numpy as np
from mpi4py import MPI
from numpy.typing import DTypeLike

from pctt.petsc import warn
from pctt.tt.apply import Apply
from pctt.tt.grid import GridDigits
from pctt.tt.train import Array, Train

LONG = 1_000_000  # several ranks that gather longer vectors cause a warning
BYTES = 70  # of each rank for a row, with a Mat, its preconditioner and CG (measured at 4 million rows, 2 and 3 ranks)


def places_of_rows(digits: GridDigits, order: Array | None) -> Array:
    """The slot of each row of a Mat in a train.

    order : row at each point of the grid, or None
    """
    if order is None:
        return digits.places
    places = np.empty(digits.rows, np.int64)
    places[order] = digits.places
    return places


class TrainProduct:
    """This rank's rows of y = T x, from its rows of x.

    counts : number of rows of each rank
    slots : (rows,) slot of each row of all ranks in the train; other slots get zeros
    size : number of slots
    train : matrix train; `set_train` takes another one with the same modes
    flops : operations of this rank in a product

    Every rank gathers x and multiplies with its part of the rows of the train. If the slots of the ranks overlap, they
    also gather the product.
    """

    def __init__(self, comm: MPI.Comm, counts: Array, slots: Array, size: int, train: Train) -> None:
        self.comm, self.counts, self.size = comm, np.asarray(counts), size
        rows = len(slots)
        if comm.size > 1 and rows > LONG:
            warn(
                comm,
                f"pctt: each of {comm.size} ranks gathers whole vectors of {rows} numbers, and takes about "
                f"{BYTES * rows:.1e} bytes in a solve; fewer ranks take less in all",
            )
        ends = np.cumsum(self.counts)
        mine = slice(int(ends[comm.rank] - self.counts[comm.rank]), int(ends[comm.rank]))
        ranges = [(int(s.min()), int(s.max()) + 1) if len(s) else (0, 0) for s in np.split(slots, ends[:-1])]
        filled = sorted(r for r in ranges if r[1])
        self._apart = all(a[1] <= b[0] for a, b in zip(filled[:-1], filled[1:]))
        if self._apart:
            bounds = ranges[comm.rank]
        else:
            edges = np.linspace(0, size, comm.size + 1).astype(int)
            bounds, self._shares = (int(edges[comm.rank]), int(edges[comm.rank + 1])), np.diff(edges)
            self._product = np.empty(size)
        self._bounds = bounds
        self._slots = None if rows == size and bool((np.diff(slots) == 1).all()) else slots
        here = slots[mine] - (bounds[0] if self._apart else 0)
        self._here = None if self._apart and bool((np.diff(here) == 1).all()) else here
        self._whole = np.empty(rows) if comm.size > 1 else None
        self._dtype: DTypeLike = train.dtype
        self.set_train(train)

    def set_train(self, train: Train) -> None:
        self.train = train
        self._applies: dict[np.dtype, Apply] = {}

    def use(self, dtype: DTypeLike) -> None:
        """Multiply in single or double precision from now on; products in single precision have errors of 1e-6."""
        self._dtype = dtype

    @property
    def _apply(self) -> Apply:
        dtype = np.dtype(self._dtype)
        if dtype not in self._applies:
            self._applies[dtype] = Apply(self.train.astype(dtype), self.size, self._bounds)
        return self._applies[dtype]

    @property
    def flops(self) -> int:
        return self._apply.flops

    def __call__(self, x: Array) -> Array:
        """The product; the array is valid until the next call."""
        if self._whole is not None:
            self.comm.Allgatherv(np.ascontiguousarray(x), [self._whole, self.counts])
            x = self._whole
        if self._apply.dtype == float:
            return self._times(x)
        largest = float(np.abs(x).max(initial=0.0)) or 1.0  # single precision overflows at 1e38
        return np.multiply(largest, self._times(x / largest), dtype=float)

    def _times(self, x: Array) -> Array:
        apply = self._apply
        apply.x[slice(None) if self._slots is None else self._slots] = x
        y = apply.product()
        if not self._apart:
            self.comm.Allgatherv(np.ascontiguousarray(y, dtype=float), [self._product, self._shares])
            y = self._product
        return y if self._here is None else y[self._here]
