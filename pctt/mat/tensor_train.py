"""A matrix given by its entries on a grid as a tensor train, in PETSc a Mat of type python."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import replace

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from pctt.context import Context
from pctt.mat.entries import Entries, is_symmetric
from pctt.mat.order import digits_of
from pctt.mat.product import TrainProduct
from pctt.petsc import own_errors
from pctt.tt.cross import Cross, compress_cross
from pctt.tt.entries import EntryMatrix
from pctt.tt.train import Array, Train

MAX_RANK = 200
ROUNDING = 0.1  # of a symmetric part, over eps


class CompressedEntries:
    """The train T of a matrix A = c (I + T) by its entries, c the mean of the diagonal: what Mat and PC share.

    shift, scale : A = shift I + scale T; both are c, or 0 and 1 where the mean is not positive
    error : ||A - c (I + T)||_F / ||A - c I||_F, estimated from entries that the compression has not seen
    """

    def __init__(
        self, P: PETSc.Mat, eps: float, max_rank: int, order: str = "auto", name: str = "order",
        start: CompressedEntries | None = None, seed: int = 0,
    ) -> None:  # fmt: skip
        """EntriesError or ValueError, on all ranks alike, for bad entries or a bad grid; collective."""
        comm = P.comm.tompi4py()
        self.entries = Entries.of(P)
        self.digits, self.rows, self.order = digits_of(P, order, name)
        self.counts = np.array(comm.allgather(P.getLocalSize()[0]))
        self.comm = comm
        matrix = EntryMatrix(self.entries, self.digits, self.rows, comm.bcast)
        self.shift, self.scale = matrix.shift, 1 / matrix.scale
        known = start.found if start is not None and start.digits.modes == self.digits.modes else None
        self.found: Cross = compress_cross(matrix, max_rank, eps, known, rng=np.random.default_rng(seed))
        self.symmetric = is_symmetric(self.entries, self.digits.rows)
        if self.symmetric:
            train = comm.bcast(self.train.symmetric_part(ROUNDING * eps))
            self.found = replace(self.found, train=train)

    def rounded(self, eps: float, max_rank: int) -> CompressedEntries:
        """The same of lower rank and accuracy, without looking at an entry."""
        coarse = copy(self)
        train = self.train.round(eps, max_rank)
        left = float((train - self.train).norm() / (self.train.norm() or 1.0))
        coarse.found = replace(self.found, train=train, error=float(np.hypot(self.error, left)))
        return coarse

    @property
    def train(self) -> Train:
        return self.found.train

    @property
    def error(self) -> float:
        return self.found.error

    def product(self, train: Train) -> TrainProduct:
        """With the rows in the order of the Mat's."""
        return TrainProduct(self.comm, self.counts, self.digits, self.rows, train)

    def words(self) -> str:
        """Ranks, bytes, compression, error."""
        size = 8 * self.train.storage
        return (
            f"{self.order} order, {len(self.train)} modes, ranks {'-'.join(map(str, self.train.ranks))}, {size} bytes "
            f"({8 * float(self.digits.rows) ** 2 / size:.3g} times less than dense), error {self.error:.2g} estimated "
            f"from fresh entries, {self.found.evaluations} entries evaluated"
        )


class TensorTrain(Context):
    """Context of a Mat whose products are those of a train; see `from_entries`.

    A Mat that is made by hand, of type python and ``pctt.mat.TensorTrain``, needs the attribute ``entries``, and
    ``grid`` or ``coordinates``, before ``setUp``.
    """

    without = PETSc.Mat.Type.AIJ

    def __init__(self, eps: float = 1e-8, max_rank: int = MAX_RANK) -> None:
        self.eps, self.max_rank = eps, max_rank
        self.compressed: CompressedEntries | None = None

    def setUp(self, mat: PETSc.Mat) -> None:
        self.compressed = CompressedEntries(mat, self.eps, self.max_rank)
        if self.compressed.error > 10 * self.eps and self.compressed.comm.rank == 0:
            warnings.warn(
                f"pctt.mat.TensorTrain: an error of {self.compressed.error:.1e} is left at rank {self.max_rank}, "
                f"{self.eps:.1e} was asked for",
                stacklevel=2,
            )
        self._product = self.compressed.product(self.compressed.train)
        self._transposed: TrainProduct | None = None
        mat.setOption(PETSc.Mat.Option.SYMMETRIC, self.compressed.symmetric)

    def mult(self, mat: PETSc.Mat, x: PETSc.Vec, y: PETSc.Vec) -> None:
        self._times(self._product, x, y)

    def multTranspose(self, mat: PETSc.Mat, x: PETSc.Vec, y: PETSc.Vec) -> None:
        assert self.compressed is not None
        if self._transposed is None:
            symmetric = self.compressed.symmetric
            self._transposed = self._product if symmetric else self.compressed.product(self.compressed.train.T)
        self._times(self._transposed, x, y)

    def _times(self, product: TrainProduct, x: PETSc.Vec, y: PETSc.Vec) -> None:
        assert self.compressed is not None
        with PETSc.Log.Event("TTMult"):
            local = x.array_r
            y.array_w[:] = self.compressed.shift * local + self.compressed.scale * product(local)

    def getDiagonal(self, mat: PETSc.Mat, diagonal: PETSc.Vec) -> None:
        assert self.compressed is not None
        here = np.arange(*mat.getOwnershipRange())
        diagonal.array_w[:] = self.compressed.entries.own(here, here)

    def view(self, mat: PETSc.Mat, viewer: PETSc.Viewer | None = None) -> None:
        if viewer is not None and viewer.getType() == PETSc.Viewer.Type.ASCII and self.compressed is not None:
            viewer.printfASCII(f"  tensor train: {self.compressed.words()}\n")


def compressed(P: PETSc.Mat) -> CompressedEntries | None:
    """What P multiplies with, if it is a Mat of this module."""
    context = P.getPythonContext() if P.getType() == PETSc.Mat.Type.PYTHON else None
    return context.compressed if isinstance(context, TensorTrain) else None


def from_entries(
    entries: Callable[[Array, Array], Array],
    grid: Sequence[int],
    eps: float = 1e-8,
    max_rank: int = MAX_RANK,
    comm: MPI.Comm | PETSc.Comm | None = None,
) -> PETSc.Mat:
    """The matrix A(i, j) = entries(i, j) of the points of a grid as a Mat that multiplies as a tensor train.

    entries : takes rows and columns, integer arrays (p,), and gives (p,) numbers; called on all ranks alike
    grid : (n_1, n_2, ...), the shape of a vector as an array: row i is at numpy.unravel_index(i, grid)
    eps : error relative to ||A - c I||_F, c the mean of the diagonal, at which the compression ends
    max_rank : cap of the ranks

    The Mat keeps the function as its attribute ``entries``: preconditioners of `pctt.pc` and errors come from it.
    EntriesError (a ValueError), on all ranks alike, for entries that are no finite numbers; ValueError for a bad grid.

    >>> A = from_entries(lambda i, j: (i == j) + 0.1 / (1.0 + abs(i - j)), (64,))
    >>> A.getPythonContext().compressed.error < 1e-8
    True
    """
    shape = tuple(int(n) for n in grid)
    if not shape or min(shape) < 1:
        raise ValueError(f"a grid of shape {shape}; allowed are whole numbers >= 1")
    rows = int(np.prod(shape, dtype=np.int64))
    mat = PETSc.Mat().create(comm=comm or PETSc.COMM_WORLD)
    mat.setSizes(((PETSc.DECIDE, rows), (PETSc.DECIDE, rows)))
    mat.setType(PETSc.Mat.Type.PYTHON)
    mat.setPythonContext(TensorTrain(eps, max_rank))
    mat.setAttr("entries", entries)
    mat.setAttr("grid", shape)
    with own_errors():
        mat.setUp()
    return mat
