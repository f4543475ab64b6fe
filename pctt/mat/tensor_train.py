"""A matrix that is given by its entries on a grid, as a tensor train; for PETSc it is a Mat of type python."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import replace
from math import prod

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
from pctt.tt.work import Work

MAX_RANK = 200
ROUNDING = 0.1  # tolerance for rounding a symmetric part, divided by eps


class CompressedEntries:
    """The train T of a matrix A = c (I + T) that is given by its entries; c is the mean of the diagonal.

    Both the Mat and the PC use it.

    shift, scale : A = shift I + scale T; both are c, or 0 and 1 if the mean is not positive
    error : ||A - c (I + T)||_F / ||A - c I||_F, estimated from entries that the compression has not used
    """

    def __init__(
        self, P: PETSc.Mat, eps: float, max_rank: int, order: str = "auto", name: str = "order",
        start: CompressedEntries | None = None, seed: int = 0, work: Work | None = None,
    ) -> None:  # fmt: skip
        """Collective; on all ranks EntriesError or ValueError for bad entries or a bad grid, TooMuchWorkError at the
        limit of `work`."""
        comm = P.comm.tompi4py()
        self.entries = Entries.of(P)
        self.digits, self.rows, self.order = digits_of(P, order, name)
        self.counts = np.array(comm.allgather(P.getLocalSize()[0]))
        self.comm = comm
        matrix = EntryMatrix(self.entries, self.digits, self.rows, comm.bcast)
        self.shift, self.scale = matrix.shift, 1 / matrix.scale
        known = start.found if start is not None and start.digits.modes == self.digits.modes else None
        self.found: Cross = compress_cross(matrix, max_rank, eps, known, rng=np.random.default_rng(seed), work=work)
        self.symmetric = is_symmetric(self.entries, self.digits.rows)
        if self.symmetric:
            train = comm.bcast(self.train.symmetric_part(ROUNDING * eps))
            self.found = replace(self.found, train=train)

    def rounded(self, eps: float, max_rank: int) -> CompressedEntries:
        """The same matrix with lower rank and accuracy, without evaluating entries."""
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
        """The product with a train, with rows in the order of the Mat."""
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
    """The context of a Mat that multiplies with a train; see `from_entries`.

    You can also make such a Mat yourself, of type python and ``pctt.mat.TensorTrain``. Then give it the attributes
    ``entries`` and ``grid`` or ``coordinates`` before ``setUp``.
    """

    without = PETSc.Mat.Type.AIJ
    compressed: CompressedEntries  #: after ``setUp``

    def __init__(self, eps: float = 1e-8, max_rank: int = MAX_RANK) -> None:
        self.eps, self.max_rank = eps, max_rank

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
        if self._transposed is None:
            symmetric = self.compressed.symmetric
            self._transposed = self._product if symmetric else self.compressed.product(self.compressed.train.T)
        self._times(self._transposed, x, y)

    def _times(self, product: TrainProduct, x: PETSc.Vec, y: PETSc.Vec) -> None:
        with PETSc.Log.Event("TTMult"):
            local = x.array_r
            y.array_w[:] = self.compressed.shift * local + self.compressed.scale * product(local)

    def getDiagonal(self, mat: PETSc.Mat, diagonal: PETSc.Vec) -> None:
        here = np.arange(*mat.getOwnershipRange())
        diagonal.array_w[:] = self.compressed.entries.own(here, here)

    def view(self, mat: PETSc.Mat, viewer: PETSc.Viewer | None = None) -> None:
        if viewer is not None and viewer.getType() == PETSc.Viewer.Type.ASCII and hasattr(self, "compressed"):
            viewer.printfASCII(f"  tensor train: {self.compressed.words()}\n")


def compressed(P: PETSc.Mat) -> CompressedEntries | None:
    """The compressed entries of P, if P is a Mat of this module; otherwise None."""
    context = P.getPythonContext() if P.getType() == PETSc.Mat.Type.PYTHON else None
    return getattr(context, "compressed", None) if isinstance(context, TensorTrain) else None


def from_entries(
    entries: Callable[[Array, Array], Array],
    grid: Sequence[int],
    eps: float = 1e-8,
    max_rank: int = MAX_RANK,
    comm: MPI.Comm | PETSc.Comm | None = None,
) -> PETSc.Mat:
    """The matrix A(i, j) = entries(i, j) for the points of a grid, as a Mat that multiplies with a tensor train.

    entries : takes rows and columns, integer arrays (p,), and returns numbers (p,); all ranks call it
    grid : (n_1, n_2, ...), the shape of a vector as an array: row i is at numpy.unravel_index(i, grid)
    eps : the compression ends at this error relative to ||A - c I||_F, where c is the mean of the diagonal
    max_rank : largest allowed rank

    The Mat keeps the function as its attribute ``entries``, and the preconditioners of `pctt.pc` use it. Raises
    EntriesError (a ValueError) on all ranks if entries are not finite numbers, and ValueError for a bad grid.

    >>> A = from_entries(lambda i, j: (i == j) + 0.1 / (1.0 + abs(i - j)), (64,))
    >>> A.getPythonContext().compressed.error < 1e-8
    True
    """
    shape = tuple(int(n) for n in grid)
    if not shape or min(shape) < 1:
        raise ValueError(f"a grid of shape {shape}; allowed are whole numbers >= 1")
    rows = prod(shape)
    mat = PETSc.Mat().create(comm=comm or PETSc.COMM_WORLD)
    mat.setSizes(((PETSc.DECIDE, rows), (PETSc.DECIDE, rows)))
    mat.setType(PETSc.Mat.Type.PYTHON)
    mat.setPythonContext(TensorTrain(eps, max_rank))
    mat.setAttr("entries", entries)
    mat.setAttr("grid", shape)
    with own_errors():
        mat.setUp()
    return mat
