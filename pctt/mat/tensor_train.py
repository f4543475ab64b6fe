"""A matrix that is given by its entries on a grid, as a tensor train; for PETSc it is a Mat of type python."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from math import prod
from typing import Any

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from dem.exchange import on_first, refuse
from pctt.blocks import refuse_unready
from pctt.mat.entries import Entries, Entry, diagonal, given, is_symmetric
from pctt.mat.grid_train import GridTrain, rounded
from pctt.mat.order import Layout, layout_of, whole_numbers
from pctt.options import AT_LEAST_ONE, FRACTION, OptionError, describe, option, read, refuse_bad
from pctt.petsc import Context, given_options, on_axpy, on_getinfo, own_errors, warn
from pctt.tt.cross import EntryMatrix, compress_cross
from pctt.tt.train import Train
from pctt.tt.work import Work

ROUNDING = 0.1  # tolerance for rounding a symmetric part or a sum, divided by eps
MISSED = 10  # an error above this times eps is told
PREFIX, MAX_RANK = "mat_tt_", 200


@dataclass(frozen=True)
class Options:
    """Options ``-mat_tt_*`` of a Mat that is a train, after the prefix of the Mat."""

    eps: float = option(
        1e-8, "the compression ends at this error relative to ||A - c I||_F; c is the mean of the diagonal",
        check=FRACTION,
    )  # fmt: skip
    max_rank: int = option(MAX_RANK, "largest allowed rank", check=AT_LEAST_ONE)

    def check(self, comm: MPI.Comm) -> None:
        """ValueError on all ranks if a value is not allowed or differs between ranks; collective."""
        wrong = ""
        try:
            refuse_bad(self)
        except OptionError as error:
            wrong = str(error)
        refuse(comm, wrong)
        found = comm.allgather(repr(self))
        if len(set(found)) > 1:
            raise ValueError(f"eps or max_rank differ between ranks: {', '.join(found)}")

    def given_for(self, mat: PETSc.Mat) -> Options:
        """These options with those of the database; OptionError for a bad value or a misspelt name."""
        prefix = (mat.getOptionsPrefix() or "") + PREFIX
        given = given_options(Options, prefix)
        found = dataclasses.asdict(read(Options, given, prefix))
        return dataclasses.replace(self, **{name: found[name] for name in found if prefix + name in given})


def compressed_entries(
    P: PETSc.Mat, layout: Layout, eps: float, max_rank: int, start: GridTrain | None = None, work: Work | None = None
) -> GridTrain:
    """A = c (I + T) for a matrix A that is given by its entries; c is the mean of the diagonal. Collective.

    Both the Mat and the PC use it. If the mean is not positive, shift is 0 and scale is 1. The error is estimated from
    entries that the compression has not used. On all ranks ValueError for bad entries, TooMuchWorkError at the limit
    of `work`.

    start : an earlier result for a similar matrix
    """
    entries = Entries.of_mat(P)
    matrix = EntryMatrix(entries, layout.digits, layout.rows, layout.comm.bcast)
    known = start.found if start is not None and start.layout.digits.modes == layout.digits.modes else None
    found = compress_cross(matrix, max_rank, eps, known, work=work)
    train, error = found.train, found.error
    symmetric = is_symmetric(entries, layout.digits.rows)
    if symmetric:
        train, left = on_first(layout.comm, lambda: _symmetric(found.train, eps, max_rank))
        error = float(np.hypot(error, left))
    return GridTrain(
        layout, train, matrix.shift, 1 / matrix.scale, error, symmetric,
        f"estimated from fresh entries, {found.evaluations} entries evaluated", found, function=given(P, "entries"),
    )  # fmt: skip


def _symmetric(train: Train, eps: float, max_rank: int) -> tuple[Train, float]:
    """The symmetric part with ranks at most `max_rank`, and what this cap leaves out, relative to the norm."""
    whole = train.symmetric_part(ROUNDING * eps)
    return rounded(whole, 0.0, max_rank) if max(whole.ranks) > max_rank else (whole, 0.0)


class TensorTrain(Context):
    """The context of a Mat that multiplies with a train; see `from_entries`.

    You can also make such a Mat yourself, of type python and ``pctt.mat.TensorTrain``. Then give it the attributes
    ``entries`` and ``grid`` or ``coordinates`` before ``setUp``. Its options are ``-mat_tt_*``.

    compressed : the matrix, after ``setUp``
    options : eps and max_rank
    """

    without = PETSc.Mat.Type.AIJ
    compressed: GridTrain

    def __init__(self, eps: float = 1e-8, max_rank: int = MAX_RANK) -> None:
        self.options = Options(eps, max_rank)

    def create(self, mat: PETSc.Mat) -> None:
        super().create(mat)
        self._operations: tuple[Any, ...] = (on_axpy(mat, axpy), on_getinfo(mat, self._info))

    def destroy(self, mat: PETSc.Mat) -> None:
        self._operations = ()  # they refer to this context
        super().destroy(mat)

    def _info(self) -> tuple[float, float]:
        return float(self.compressed.train.storage), float(self.bytes)

    # -- figures --------------------------------------------------------------------------------------------

    @property
    def ranks(self) -> tuple[int, ...]:
        """The ranks r_0, ..., r_d of the train."""
        return self.compressed.ranks

    @property
    def bytes(self) -> int:
        """Bytes of the train, which every rank has."""
        return self.compressed.bytes

    @property
    def error(self) -> float:
        """The error relative to ||A - c I||_F; of an inverse X, ||b - A X b|| / ||b|| for a random b."""
        return self.compressed.error

    @property
    def residual(self) -> float | None:
        """Of an inverse: ||I - S X||_F / ||S - I||_F for the train S of the matrix; otherwise None."""
        return self.compressed.residual

    # -- set-up ---------------------------------------------------------------------------------------------

    def setFromOptions(self, mat: PETSc.Mat) -> None:
        """Read the options; OptionError for a bad value or a misspelt name. They have no effect after ``setUp``."""
        self.options = self.options.given_for(mat)
        if PETSc.Options().hasName("help"):
            lines = describe(Options, (mat.getOptionsPrefix() or "") + PREFIX)
            PETSc.Sys.Print("\n".join(map(str, lines)), comm=mat.comm)

    def setUp(self, mat: PETSc.Mat) -> None:
        """ValueError on all ranks for bad options, entries or a bad grid. It does nothing if there is a train."""
        if not hasattr(self, "compressed"):
            self.options = self.options.given_for(mat)
            self.options.check(mat.comm.tompi4py())
            found = compressed_entries(mat, layout_of(mat), self.options.eps, self.options.max_rank)
            if found.error > MISSED * self.options.eps:
                warn(
                    found.layout.comm,
                    f"pctt.mat.TensorTrain: an error of {found.error:.1e} is left at rank {self.options.max_rank}, "
                    f"{self.options.eps:.1e} was asked for",
                )
            self.compressed = found
        self.take(mat, self.compressed)

    def take(self, mat: PETSc.Mat, matrix: GridTrain) -> None:
        """Become another matrix."""
        self.compressed = matrix
        mat.setAttr("entries", matrix.function or matrix.entries)
        mat.setOption(PETSc.Mat.Option.SYMMETRIC, matrix.symmetric)

    # -- products and entries -------------------------------------------------------------------------------

    def mult(self, mat: PETSc.Mat, x: PETSc.Vec, y: PETSc.Vec) -> None:
        with PETSc.Log.Event("TTMult"):
            y.array_w[:] = self.compressed.times(x.array_r)
            PETSc.Log.logFlops(self.compressed.flops)

    def multTranspose(self, mat: PETSc.Mat, x: PETSc.Vec, y: PETSc.Vec) -> None:
        with PETSc.Log.Event("TTMult"):
            y.array_w[:] = self.compressed.times(x.array_r, transposed=True)
            PETSc.Log.logFlops(self.compressed.flops)

    def getDiagonal(self, mat: PETSc.Mat, vec: PETSc.Vec) -> None:
        vec.array_w[:] = diagonal(mat)

    # -- arithmetic -----------------------------------------------------------------------------------------

    def scale(self, mat: PETSc.Mat, factor: float) -> None:
        self.take(mat, self.compressed.scaled(factor))

    def shift(self, mat: PETSc.Mat, more: float) -> None:
        self.take(mat, self.compressed.shifted(more))

    def zeroEntries(self, mat: PETSc.Mat) -> None:
        self.take(mat, self.compressed.zero())

    def diagonalScale(self, mat: PETSc.Mat, left: PETSc.Vec | None, right: PETSc.Vec | None) -> None:
        """ValueError on all ranks for vectors that are not constant, because they would change the ranks."""
        for vec in filter(None, (left, right)):
            least, largest = vec.min()[1], vec.max()[1]
            if least != largest:
                raise ValueError(
                    f"pctt.mat.TensorTrain: diagonalScale by a vector with values from {least:g} to {largest:g}; "
                    "allowed are constant vectors (otherwise scale the function of the entries)"
                )
            self.scale(mat, least)

    def norm(self, mat: PETSc.Mat, kind: int) -> float:
        """The Frobenius norm of the train; ValueError for other norms."""
        if kind != PETSc.NormType.FROBENIUS:
            raise ValueError(f"pctt.mat.TensorTrain: a norm of type {kind}; allowed is PETSc.NormType.FROBENIUS")
        return self.compressed.norm()

    def duplicate(self, mat: PETSc.Mat, what: int) -> PETSc.Mat:
        """A copy, or without MAT_COPY_VALUES the zero matrix on the same grid."""
        other = mat_of(self.compressed if what == 1 else self.compressed.zero(), self.options)
        _copy_places(mat, other)
        return other

    def copy(self, mat: PETSc.Mat, other: PETSc.Mat, structure: int) -> None:
        """ValueError on all ranks if the other Mat is not a train with the same distribution of rows."""
        context = _context(other)
        if context is None or not np.array_equal(context.compressed.layout.counts, self.compressed.layout.counts):
            raise ValueError(
                f"pctt.mat.TensorTrain: a copy into a Mat of type {other.getType()}; allowed is a Mat of "
                "pctt.mat.TensorTrain with the same rows on each rank, for example a duplicate"
            )
        context.options = self.options
        context.take(other, self.compressed)
        _copy_places(mat, other)

    # -- words ----------------------------------------------------------------------------------------------

    def view(self, mat: PETSc.Mat, viewer: PETSc.Viewer | None = None) -> None:
        """ValueError for a viewer that would have to save the train."""
        if viewer is None or not hasattr(self, "compressed"):
            return
        if viewer.getType() == PETSc.Viewer.Type.ASCII:
            viewer.printfASCII(f"  tensor train: {self.compressed.words()}\n")
        elif viewer.getType() in ("binary", "hdf5", "vtk", "matlab"):
            raise ValueError(
                f"pctt.mat.TensorTrain: a viewer of type {viewer.getType()} does not save trains; "
                "pctt.mat.save(mat, path) does"
            )


def _context(mat: PETSc.Mat) -> TensorTrain | None:
    """The context of a Mat of this module that is set up; otherwise None."""
    context = mat.getPythonContext() if mat.getType() == PETSc.Mat.Type.PYTHON else None
    return context if isinstance(context, TensorTrain) and hasattr(context, "compressed") else None


def _copy_places(mat: PETSc.Mat, other: PETSc.Mat) -> None:
    for name in ("grid", "coordinates"):
        other.setAttr(name, given(mat, name))


def compressed(P: PETSc.Mat) -> GridTrain | None:
    """The train of P, if P is a Mat of this module; otherwise None."""
    context = _context(P)
    return None if context is None else context.compressed


def mat_of(matrix: GridTrain, options: Options) -> PETSc.Mat:
    """A new Mat for a train. Collective."""
    layout, context = matrix.layout, TensorTrain()
    rows, here = layout.digits.rows, int(layout.counts[layout.comm.rank])
    context.compressed, context.options = matrix, options
    mat = PETSc.Mat().create(comm=layout.comm)
    mat.setSizes(((here, rows), (here, rows)), layout.digits.block)
    mat.setType(PETSc.Mat.Type.PYTHON)
    mat.setPythonContext(context)
    if layout.order == "grid" and layout.rows is None:
        mat.setAttr("grid", layout.digits.shape)
    mat.setUp()
    return mat


def axpy(Y: PETSc.Mat, factor: float, X: PETSc.Mat) -> None:
    """Put Y + factor X in the place of Y, for a train Y; X is a train on the same grid, or any Mat that is c I.

    ``Y.axpy(factor, X)`` does the same for two trains; other Mats it refuses in PETSc's words, or with a segmentation
    fault in PETSc 3.18, as for any Mat of type python. The sum of two trains is rounded to a tenth of eps of Y, with
    ranks at most its max_rank. ValueError on all ranks for other Mats. Collective.

    >>> A = from_entries(lambda i, j: (i == j) + 0.1 / (1.0 + abs(i - j)), (64,))
    >>> B = A.duplicate(copy=True)
    >>> axpy(B, -1.0, A)
    >>> B.norm() < 1e-8 * A.norm()
    True
    """
    refuse_unready("pctt.mat.axpy", Y, X)
    context, matrix = _context(Y), compressed(X)
    if context is None:
        raise ValueError(f"pctt.mat.axpy: Y is a Mat of type {Y.getType()}; allowed is a Mat of pctt.mat.TensorTrain")
    mine, options = context.compressed, context.options
    if Y == X:
        total = mine.scaled(1.0 + factor)
    elif matrix is None:
        total = mine.shifted(factor * _multiple_of_identity(X))
    else:
        total = mine.plus(factor, matrix, ROUNDING * options.eps, options.max_rank)
    context.take(Y, total)
    Y.stateIncrease()


def _multiple_of_identity(X: PETSc.Mat) -> float:
    """c, if X is c I. ValueError on all ranks otherwise; collective."""
    try:
        diagonal = X.getDiagonal()
        c, largest = diagonal.min()[1], diagonal.max()[1]
        v, w = X.createVecs()
        v.array_w[:] = np.random.default_rng(X.comm.rank).standard_normal(v.getLocalSize())
        X.mult(v, w)
        w.axpy(-c, v)
        multiple = c == largest and w.norm() <= 1e-14 * abs(c) * v.norm()
    except PETSc.Error:
        multiple = False
    if not multiple:
        raise ValueError(
            f"pctt.mat.axpy: X is a Mat of type {X.getType()}; allowed is a Mat of pctt.mat.TensorTrain, or a multiple "
            "of the identity"
        )
    return float(c)


def from_entries(
    entries: Entry, grid: Sequence[int], eps: float = 1e-8, max_rank: int = MAX_RANK,
    comm: MPI.Comm | PETSc.Comm | None = None, prefix: str = "",
) -> PETSc.Mat:  # fmt: skip
    """Return the matrix A(i, j) = entries(i, j) for the points of a grid, as a Mat that multiplies with a tensor train.

    entries : takes rows and columns, integer arrays (p,), and returns numbers (p,); all ranks call it
    grid : (n_1, n_2, ...), the shape of a vector as an array: row i is at numpy.unravel_index(i, grid)
    eps : the compression ends at this error relative to ||A - c I||_F, where c is the mean of the diagonal
    max_rank : largest allowed rank
    prefix : of the options of the Mat, -PREFIXmat_tt_eps and -PREFIXmat_tt_max_rank, which win over the arguments

    The Mat keeps the function as its attribute ``entries``, and the preconditioners of `pctt.pc` use it. Raises
    ValueError on all ranks if entries are not finite numbers, for a bad grid, and for other bad arguments.

    >>> A = from_entries(lambda i, j: (i == j) + 0.1 / (1.0 + abs(i - j)), (64,))
    >>> A.getPythonContext().error < 1e-8
    True
    """
    mat = PETSc.Mat().create(comm=comm or PETSc.COMM_WORLD)
    shape = whole_numbers(grid)
    wrong = f"a grid of shape {grid!r}; allowed is a tuple of whole numbers >= 1" if shape is None else ""
    rows = prod(shape or ())
    if rows >= 2**31:  # because pairs of rows are keys of 64 bits
        wrong = f"a grid of shape {grid!r} with {rows} points; allowed are fewer than 2^31"
    refuse(mat.comm.tompi4py(), wrong)
    if prefix:
        mat.setOptionsPrefix(prefix)
    mat.setSizes(((PETSc.DECIDE, rows), (PETSc.DECIDE, rows)))
    mat.setType(PETSc.Mat.Type.PYTHON)
    mat.setPythonContext(TensorTrain(eps, max_rank))
    mat.setAttr("entries", entries)
    mat.setAttr("grid", shape)
    with own_errors():
        mat.setUp()
    return mat
