"""Products of trains with distributed vectors, and matrices A = shift I + scale T with a train T of a grid.

All ranks have the cores of the trains, and gather whole vectors.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from mpi4py import MPI
from numpy.typing import DTypeLike

from dem.exchange import on_first
from pctt.mat.entries import Combination, Entry
from pctt.mat.order import Layout
from pctt.petsc import warn
from pctt.tt.apply import Apply
from pctt.tt.cross import Cross
from pctt.tt.quantise import GridDigits, bases
from pctt.tt.train import Array, Train, decompose, identity, zeros


class WholeVectors:
    """Gathers a distributed vector on every rank.

    counts : number of rows of each rank
    mine : the rows of this rank
    """

    def __init__(self, comm: MPI.Comm, counts: Array) -> None:
        self.comm, self.counts = comm, np.asarray(counts)
        first = int(self.counts[: comm.rank].sum())
        self.mine = slice(first, first + int(self.counts[comm.rank]))

    def __call__(self, x: Array) -> Array:
        """All of x, from this rank's part, of a vector (n,) or of several (k, n)."""
        if self.comm.size == 1:
            return x
        columns, rows = x[None] if x.ndim == 1 else x, int(self.counts.sum())
        parts = np.empty(len(columns) * rows)
        self.comm.Allgatherv(np.ascontiguousarray(columns), [parts, len(columns) * self.counts])
        if len(columns) > 1:
            ends = len(columns) * np.cumsum(self.counts)[:-1]
            blocks = np.split(parts, ends)
            parts = np.concatenate([b.reshape(len(columns), n) for b, n in zip(blocks, self.counts)], axis=1)
        return parts.reshape(*x.shape[:-1], rows)


class TrainProduct:
    """This rank's rows of y = T x, from its rows of x.

    counts : number of rows of each rank
    slots : (rows,) slot of each row of all ranks in the train; other slots get zeros
    size : number of slots
    flops : operations of this rank in a product

    Every rank gathers x and multiplies with its part of the rows of the train. If the slots of the ranks overlap, they
    also gather the product.
    """

    def __init__(self, comm: MPI.Comm, counts: Array, slots: Array, size: int) -> None:
        self.comm, self.size = comm, size
        rows = len(slots)
        if comm.size > 1 and rows > 1_000_000:
            each = 70.0 * rows  # measured at 4 million rows, 2 and 3 ranks, with a Mat, its preconditioner and CG
            warn(
                comm,
                f"pctt: each of {comm.size} ranks gathers whole vectors of {rows} numbers, and takes about "
                f"{each:.1e} bytes in a solve; fewer ranks take less in all",
            )
        self._gather = WholeVectors(comm, counts)
        parts = np.split(slots, np.cumsum(counts)[:-1])
        ranges = [(int(s.min()), int(s.max()) + 1) if len(s) else (0, 0) for s in parts]
        filled = sorted(r for r in ranges if r[1])
        self._apart = all(a[1] <= b[0] for a, b in zip(filled[:-1], filled[1:]))
        if self._apart:
            bounds = ranges[comm.rank]
        else:
            edges = np.linspace(0, size, comm.size + 1).astype(int)
            bounds = int(edges[comm.rank]), int(edges[comm.rank + 1])
            self._gather_product = WholeVectors(comm, np.diff(edges))
        self._bounds = bounds
        self._slots = slice(None) if rows == size and _consecutive(slots) else slots
        here = slots[self._gather.mine] - (bounds[0] if self._apart else 0)
        self._here = slice(None) if self._apart and _consecutive(here) else here
        self._dtype: DTypeLike = float

    def set_train(self, train: Train) -> None:
        """Multiply with this matrix train of `size` rows and columns from now on."""
        self.train = train
        self._applies: dict[tuple[np.dtype, int], Apply] = {}

    def use(self, dtype: DTypeLike) -> None:
        """Multiply in single or double precision from now on; products in single precision have errors of 1e-6."""
        self._dtype = dtype

    def _apply(self, columns: int = 1) -> Apply:
        """The product with so many vectors at a time: that of the train with the identity as one more core."""
        key = np.dtype(self._dtype), columns
        if key not in self._applies:
            cores = list(self.train.astype(key[0]).cores)
            if columns > 1:
                cores.append(np.eye(columns, dtype=key[0]).reshape(1, columns, columns, 1))
            bounds = columns * self._bounds[0], columns * self._bounds[1]
            self._applies = {known: apply for known, apply in self._applies.items() if known[1] == 1}
            self._applies[key] = Apply(Train(cores), columns * self.size, bounds)
        return self._applies[key]

    @property
    def flops(self) -> int:
        return self._apply().flops

    def __call__(self, x: Array) -> Array:
        """The product with a vector (n,), or with several (k, n); the array is valid until the next call."""
        columns = 1 if x.ndim == 1 else len(x)
        apply, x, largest = self._apply(columns), self._gather(x), 1.0
        if apply.dtype != float:
            largest = float(np.abs(x).max(initial=0.0)) or 1.0  # single precision overflows at 1e38
            x = x / largest
        apply.x.reshape(-1, columns)[self._slots] = x.reshape(columns, -1).T
        y = apply.product().reshape(-1, columns).T
        if apply.dtype != float:
            y = np.multiply(largest, y, dtype=float)
        y = (y if self._apart else self._gather_product(y))[:, self._here]
        return y.reshape(*x.shape[:-1], y.shape[1])


def _consecutive(numbers: Array) -> bool:
    return bool((np.diff(numbers) == 1).all())


@dataclass(frozen=True, eq=False)
class GridTrain:
    """A = shift I + scale T, the same on all ranks. Methods return another matrix and change none.

    layout : of the rows
    error : relative to ||A - shift I||_F; of an inverse X of a matrix A, ||b - A X b|| / ||b|| for a random b
    origin : where the error is from, in words
    symmetric : whether T is symmetric up to rounding
    residual : of an inverse, ||I - S X||_F / ||T||_F in train arithmetic, for the train S = I + T; otherwise None
    found : index sets for the start of the compression of a similar matrix, if there are any
    function : the exact entries; None if those of the train count as exact
    """

    layout: Layout
    train: Train
    shift: float
    scale: float
    error: float
    symmetric: bool
    origin: str
    found: Cross | None = None
    residual: float | None = None
    function: Entry | None = None

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
        if factor == 0:
            return self.zero()
        entries = self._combination.scaled(factor)
        return replace(self, shift=factor * self.shift, scale=factor * self.scale, function=entries)

    def shifted(self, more: float) -> GridTrain:
        """A + more I."""
        return replace(self, shift=self.shift + more, function=self._combination.plus(1.0, Combination(more, ())))

    def zero(self) -> GridTrain:
        """The zero matrix on the same grid."""
        nothing = zeros(self.train.rows, self.train.columns)
        return GridTrain(self.layout, nothing, 0.0, 1.0, 0.0, True, "exact", self.found, function=Combination(0.0, ()))

    def plus(self, factor: float, other: GridTrain, eps: float, max_rank: int) -> GridTrain:
        """A + factor times another matrix on the same grid, rounded. ValueError if the grid is not the same."""
        if not self.layout.agrees(other.layout):
            raise ValueError("a sum of trains on different grids; allowed are trains with the same grid and rows")
        mine, others = self.scale * self.train, factor * other.scale * other.train

        def total() -> tuple[Train, float, float]:
            train, left = rounded(mine + others, eps, max_rank)
            norm = (mine + others).norm()
            parts = [left * norm, self.error * mine.norm(), other.error * others.norm()]
            return train, train.norm(), float(np.linalg.norm(parts))

        train, norm, left = on_first(self.layout.comm, total)
        return GridTrain(
            self.layout, train, self.shift + factor * other.shift, 1.0, left / norm if norm else 0.0,
            self.symmetric and other.symmetric, "bound for a sum", self.found,
            function=self._combination.plus(factor, other._combination),
        )  # fmt: skip

    def rounded(self, eps: float, max_rank: int) -> GridTrain:
        """The matrix as c (I + T) with lower rank and accuracy, without evaluating entries.

        If shift is not positive, T has its factor, and shift and scale stay as they are.
        """
        # results may differ in the last bit: all ranks take the first one's
        train, left = on_first(self.layout.comm, lambda: rounded(self.train, eps, max_rank))
        error = float(np.hypot(self.error, left))
        if self.shift <= 0 or self.shift == self.scale:
            return replace(self, train=train, error=error)
        return replace(self, train=(self.scale / self.shift) * train, scale=self.shift, error=error)

    def norm(self) -> float:
        """||A||_F, of the rows of the grid without padded ones."""
        shift, T, digits = identity(self.train.rows), self.train, self.layout.digits
        if digits.padded != digits.shape:
            shift = _inside(digits)
            T = shift @ T @ shift
        return on_first(self.layout.comm, lambda: (self.shift * shift + self.scale * T).norm())

    @property
    def _combination(self) -> Combination:
        return Combination.of_function(self.function or self.entries)

    def entries(self, i: Array, j: Array) -> Array:
        """The entries (p,) of the train at rows i and columns j of the Mat."""
        slots = self.layout.slots
        return self.shift * (i == j) + self.scale * self.train.entries(slots[i], slots[j])

    def product(self, train: Train) -> TrainProduct:
        """The product with a train, with rows in the order of the Mat."""
        layout = self.layout
        product = TrainProduct(layout.comm, layout.counts, layout.slots, layout.digits.size)
        product.set_train(train)
        return product

    @cached_property
    def _product(self) -> TrainProduct:
        return self.product(self.train)

    @cached_property
    def _transposed(self) -> TrainProduct:
        return self._product if self.symmetric else self.product(self.train.T)

    def times(self, x: Array, transposed: bool = False) -> Array:
        """This rank's part of A x, or of A' x, from its part of x."""
        return self.shift * x + self.scale * (self._transposed if transposed else self._product)(x)

    @property
    def flops(self) -> int:
        """Operations of this rank in `times`."""
        return self._product.flops + 3 * int(self.layout.counts[self.layout.comm.rank])

    def words(self) -> str:
        """Ranks, bytes, compression, error."""
        less = 8 * float(self.layout.digits.rows) ** 2 / self.bytes
        return (
            f"{self.layout.order} order, {len(self.train)} modes, ranks {'-'.join(map(str, self.ranks))}, "
            f"{self.bytes} bytes ({less:.3g} times less than dense), error {self.error:.2g} {self.origin}"
        )


def rounded(train: Train, eps: float, max_rank: int) -> tuple[Train, float]:
    """A rounded train, and what it leaves out, relative to its norm."""
    coarse = train.round(eps, max_rank)
    return coarse, float((coarse - train).norm() / (train.norm() or 1.0))


def _inside(digits: GridDigits) -> Train:
    """The diagonal matrix with 1 at the points of the grid, and 0 at those that fill it up."""
    cores: list[Array] = []
    for n, padded in zip(digits.shape, digits.padded):
        if padded > 1:
            cores += decompose((np.arange(padded) < n).astype(float), 1e-14, modes=bases(n)).cores
    cores[-1] = np.repeat(cores[-1], digits.block, axis=1)
    return Train(core[:, :, None] * np.eye(core.shape[1])[:, :, None] for core in cores)
