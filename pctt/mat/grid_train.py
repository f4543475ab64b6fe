"""A matrix A = shift I + scale T with a train T whose rows are the points of a grid, and arithmetic with it."""

from __future__ import annotations

from copy import copy
from functools import cached_property
from typing import Any

import numpy as np
from mpi4py import MPI

from dem.exchange import on_first
from pctt.mat.product import TrainProduct, places_of_rows
from pctt.tt.cross import Cross
from pctt.tt.grid import GridDigits, bases
from pctt.tt.train import Array, Train, decompose, identity, zeros


class GridTrain:
    """A = shift I + scale T, the same on all ranks. Methods return another matrix and change none.

    digits : of the grid
    rows : the row at each point of the grid, or None if the rows are in the order of the points
    order : name of the order of the rows
    counts : number of rows of each rank
    error : relative to ||A - shift I||_F; of an inverse X of a matrix A, ||b - A X b|| / ||b|| for a random b
    origin : where the error is from, in words
    symmetric : whether T is symmetric up to rounding
    residual : of an inverse, ||I - S X||_F / ||T||_F in train arithmetic, for the train S = I + T; otherwise None
    found : index sets for the start of the compression of a similar matrix, if there are any
    """

    found: Cross | None = None
    residual: float | None = None

    def __init__(
        self, comm: MPI.Comm, counts: Array, digits: GridDigits, rows: Array | None, order: str, train: Train,
        shift: float, scale: float, error: float, symmetric: bool, origin: str,
    ) -> None:  # fmt: skip
        self.comm, self.counts, self.digits, self.rows, self.order = comm, np.asarray(counts), digits, rows, order
        self.train, self.shift, self.scale = train, shift, scale
        self.error, self.symmetric, self.origin = error, symmetric, origin

    def _with(self, **changes: Any) -> GridTrain:
        other = copy(self)
        vars(other).update(changes)
        return other

    @property
    def ranks(self) -> tuple[int, ...]:
        """r_0, ..., r_d of T."""
        return self.train.ranks

    @property
    def bytes(self) -> int:
        """Bytes of the cores of T, which every rank has."""
        return 8 * self.train.storage

    def scaled(self, factor: float) -> GridTrain:
        """factor A."""
        return self._with(shift=factor * self.shift, scale=factor * self.scale) if factor else self.zero()

    def shifted(self, more: float) -> GridTrain:
        """A + more I."""
        return self._with(shift=self.shift + more)

    def zero(self) -> GridTrain:
        """The zero matrix on the same grid."""
        nothing = zeros(self.train.rows, self.train.columns)
        return self._with(train=nothing, shift=0.0, scale=1.0, error=0.0, symmetric=True, origin="exact", residual=None)

    def plus(self, factor: float, other: GridTrain, eps: float, max_rank: int) -> GridTrain:
        """A + factor times another matrix on the same grid, rounded. ValueError if the grid is not the same."""
        same = np.array_equal(self.counts, other.counts) and self.digits.modes == other.digits.modes
        if not same or not np.array_equal(self._places, other._places):
            raise ValueError("a sum of trains on different grids; allowed are trains with the same grid and rows")
        mine, others = self.scale * self.train, factor * other.scale * other.train

        def total() -> tuple[Train, float, float]:
            train, left = rounded(mine + others, eps, max_rank)
            norm = (mine + others).norm()
            parts = [left * norm, self.error * mine.norm(), other.error * others.norm()]
            return train, train.norm(), float(np.linalg.norm(parts))

        train, norm, left = on_first(self.comm, total)
        return self._with(
            train=train, shift=self.shift + factor * other.shift, scale=1.0, error=left / norm if norm else 0.0,
            symmetric=self.symmetric and other.symmetric, origin="bound for a sum", residual=None,
        )  # fmt: skip

    def rounded(self, eps: float, max_rank: int) -> GridTrain:
        """The matrix as c (I + T) with lower rank and accuracy, without evaluating entries.

        If shift is not positive, T has its factor, and shift and scale stay as they are.
        """
        # results may differ in the last bit: all ranks take the first one's
        train, left = on_first(self.comm, lambda: rounded(self.train, eps, max_rank))
        error = float(np.hypot(self.error, left))
        if self.shift <= 0 or self.shift == self.scale:
            return self._with(train=train, error=error)
        return self._with(train=(self.scale / self.shift) * train, scale=self.shift, error=error)

    def norm(self) -> float:
        """||A||_F, of the rows of the grid without padded ones."""
        shift, T = identity(self.train.rows), self.train
        if self.digits.padded != self.digits.shape:
            inside = _inside(self.digits)
            shift, T = _diagonal(inside), _diagonal(inside) @ T @ _diagonal(inside)
        return on_first(self.comm, lambda: (self.shift * shift + self.scale * T).norm())

    @cached_property
    def _places(self) -> Array:
        return places_of_rows(self.digits, self.rows)

    def entries(self, i: Array, j: Array) -> Array:
        """The entries (p,) at rows i and columns j of the Mat."""
        place = self._places
        return self.shift * (i == j) + self.scale * self.train.entries(place[i], place[j])

    def product(self, train: Train) -> TrainProduct:
        """The product with a train, with rows in the order of the Mat."""
        return TrainProduct(self.comm, self.counts, self._places, self.digits.size, train)

    def words(self) -> str:
        """Ranks, bytes, compression, error."""
        less = 8 * float(self.digits.rows) ** 2 / self.bytes
        return (
            f"{self.order} order, {len(self.train)} modes, ranks {'-'.join(map(str, self.ranks))}, {self.bytes} bytes "
            f"({less:.3g} times less than dense), error {self.error:.2g} {self.origin}"
        )


def rounded(train: Train, eps: float, max_rank: int) -> tuple[Train, float]:
    """A rounded train, and what it leaves out, relative to its norm."""
    coarse = train.round(eps, max_rank)
    return coarse, float((coarse - train).norm() / (train.norm() or 1.0))


def _inside(digits: GridDigits) -> Train:
    """The train of a vector: 1 at the points of the grid, 0 at those that fill it up."""
    cores: list[Array] = []
    for n, padded in zip(digits.shape, digits.padded):
        if padded > 1:
            cores += decompose((np.arange(padded) < n).astype(float), 1e-14, modes=bases(n)).cores
    cores = cores or [np.ones((1, 1, 1))]
    return Train([*cores[:-1], np.repeat(cores[-1], digits.block, axis=1)])


def _diagonal(vector: Train) -> Train:
    """The diagonal matrix of a vector."""
    return Train(core[:, :, None] * np.eye(core.shape[1])[:, :, None] for core in vector.cores)
