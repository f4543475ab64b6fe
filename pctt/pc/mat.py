"""The base of the preconditioners; checks of the Mat that a user gives to one, and of the preconditioner."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import scipy.sparse as sp
from mpi4py import MPI
from petsc4py import PETSc

from dem.exchange import on_all
from pctt.blocks import block_csr_matrix, refuse_unready, symmetric_shell
from pctt.mat.entries import diagonal, given, has_entries
from pctt.mat.order import Places
from pctt.options import describe, read
from pctt.petsc import Context, given_options, on_coordinates, warn
from pctt.tt.conjugate import ConjugateGradients
from pctt.tt.train import Array


class Preconditioner(Context):
    """What the python PCs of this package share: options, points of the rows, warnings, and what a view shows."""

    name: str  #: for ``-pc_python_type``
    options_class: type
    options_prefix: str
    without = PETSc.PC.Type.NONE
    forget: Callable[..., None]  #: lets the next set-up begin anew, as for a matrix of another structure
    report: Callable[..., list[str]]  #: lines for ``-ksp_view``

    def create(self, pc: PETSc.PC) -> None:
        super().create(pc)
        self.options: Any = self.options_class()
        self.prefix = ""
        self.places = Places()
        self._given: list[str] = []  # the names of options that are given
        self._warned: set[str] = set()
        self._points: np.ndarray | None = None
        self._on_coordinates = on_coordinates(pc, self._take_points)

    def destroy(self, pc: PETSc.PC) -> None:
        self._on_coordinates = on_coordinates(pc, None)  # the function refers to this context
        super().destroy(pc)

    def _take_points(self, points: np.ndarray) -> None:
        """The points (n, d) of this rank's block rows, from ``PCSetCoordinates``."""
        self._points = points
        self.forget()

    def setFromOptions(self, pc: PETSc.PC) -> None:
        """Read the options with the prefix of the PC, for the next set-up; OptionError for a bad value or a misspelt
        name."""
        self.prefix = pc.getOptionsPrefix() or ""
        prefix = self.prefix + self.options_prefix
        given = given_options(self.options_class, prefix)
        self.options, self._given = read(self.options_class, given, prefix), [*given]
        if PETSc.Options().hasName("help"):
            PETSc.Sys.Print("\n".join(map(str, describe(self.options_class, prefix))), comm=pc.comm)

    def square(self, pc: PETSc.PC) -> PETSc.Mat:
        """The Mat of the PC; ValueError on all ranks if it is not ready for use, or not square."""
        refuse_unready(self.name, *pc.getOperators())
        P = pc.getOperators()[1]
        rows, columns = P.getSize()
        if rows != columns:
            raise ValueError(f"{self.name}: the matrix has {rows} rows and {columns} columns; allowed is a square one")
        return P

    def warn(self, comm: MPI.Comm, words: str, kind: str = "") -> None:
        """Warn, once in the life of this preconditioner; or once of this kind. Collective.

        Python's filter shows a text once, so it names the options' prefix, which tells the solvers of a program apart.
        """
        if (kind or words) not in self._warned:
            self._warned.add(kind or words)
            warn(comm, f"{self.name}{f' of {self.prefix}' if self.prefix else ''}: {words}")

    def view(self, pc: PETSc.PC, viewer: PETSc.Viewer | None = None) -> None:
        if viewer is not None and viewer.getType() == PETSc.Viewer.Type.ASCII:
            for line in pc.comm.tompi4py().bcast(self.report()):
                viewer.printfASCII(f"  {line}\n")


def is_symmetric(P: PETSc.Mat) -> bool:
    """Whether P is symmetric. If the Mat does not say so, compare u'(P v) with v'(P u) for two random vectors.

    A Mat that says it is not symmetric is tried too: SLEPc's spectral transformations say so of any matrix whose
    symmetry is not known.
    """
    known, symmetric = P.isSymmetricKnown()
    if known and symmetric:
        return True
    u, v = P.createVecs()
    product = u.duplicate()
    rng = np.random.default_rng(P.comm.rank)
    values = []
    u.array_w[:], v.array_w[:] = rng.standard_normal((2, u.getLocalSize()))
    for one, other in ((u, v), (v, u)):
        P.mult(one, product)
        values.append(other.dot(product))
    size = product.norm(PETSc.NormType.NORM_INFINITY) * P.getSize()[0] ** 0.5  # squares of small numbers would vanish
    for vec in (u, v, product):
        vec.destroy()
    return bool(P.comm.tompi4py().bcast(abs(values[0] - values[1]) <= 1e-8 * size or not np.isfinite(size)))


def finds_negative(X: PETSc.Mat, A: PETSc.Mat, steps: int = 12) -> bool:
    """Whether a few steps of conjugate gradients for A with the preconditioner X find a y with y'X y <= 0. Collective.

    The residuals r are orthogonal in the form of X. So the first r with r'X r <= 0 shows that X is not positive on the
    Krylov space, and the method ends with this reason. If X is near A^-1, all eigenvalues of X A except the wrong ones
    are near one, so the method finds the wrong ones quickly: 1 to 9 steps were enough for indefinite trains that a
    search with trains of rank 8 took for positive. If A itself is not positive, the result is True too.

    X, A : symmetric, with products
    """
    w, b = A.createVecs()
    w.array_w[:] = np.random.default_rng(A.comm.rank).standard_normal(w.getLocalSize())
    A.mult(w, b)
    squares = [w.dot(b)]
    X.mult(b, w)
    squares.append(w.dot(b))
    if not min(squares) > 0:  # the method takes two negative forms for positive ones
        return True
    reason, _ = _conjugate_gradients(A, X, PETSc.PC.Type.MAT, b, steps)
    return reason < 0 and reason != PETSc.KSP.ConvergedReason.DIVERGED_MAX_IT


def iterations_with_the_diagonal(A: PETSc.Mat, scale: Array, most: int = 500) -> int:
    """About how many iterations conjugate gradients to 1e-8 take with the diagonal; `most` at most. Collective.

    They are extrapolated from the first six.
    """
    probe, digits, count = 6, 8.0, len(scale)
    scale = np.where(scale > 0, scale, 1.0)
    b = A.createVecLeft()
    b.array_w[:] = np.random.default_rng(A.comm.rank).standard_normal(count) * np.sqrt(scale)
    first = A.getOwnershipRange()[0]
    rows = np.arange(count + 1)
    D = block_csr_matrix(A.comm, count, count, rows, first + rows[:-1], scale.reshape(-1, 1, 1))
    _, norms = _conjugate_gradients(A, D, PETSc.PC.Type.JACOBI, b, probe)
    D.destroy()
    found = float(np.log10(norms[0] / max(norms[-1], 1e-16 * norms[0])))
    return int(A.comm.tompi4py().bcast(min(most, probe * digits / max(found, probe * digits / most))))


def conjugate_gradients(
    A: PETSc.Mat, b: Array, solve: Callable[[Array], Array] | None = None, each: float = 0.0, x: Array | None = None,
    sign: float = 1.0,
) -> ConjugateGradients:  # fmt: skip
    """The method for A, step by step, with this rank's parts of all vectors; the norms are the same on all ranks."""
    comm, (vec, image) = A.comm.tompi4py(), A.createVecs()

    def times(p: Array) -> Array:
        vec.array_w[:] = p
        A.mult(vec, image)
        return image.array_r.copy()

    def dot(p: Array, q: Array) -> float:
        return float(comm.bcast(comm.allreduce(float(np.dot(p, q)))))

    return ConjugateGradients(times, b, solve, each, dot, x, sign)


def null_vectors(A: PETSc.Mat, P: PETSc.Mat) -> list[Array]:
    """This rank's parts of vectors that P takes to zero, of the null space of P or A and the constant. Collective."""
    spaces = [one.getNullSpace() for one in (P, A)]
    basis: list[PETSc.Vec] = next((space.getVecs() for space in spaces if space.handle), [])
    x, y = P.createVecs()
    found = []
    for vec in (None, *basis):
        x.set(1.0) if vec is None else vec.copy(x)
        P.mult(x, y)
        size = P.norm(PETSc.NormType.FROBENIUS) * x.norm()
        if P.comm.tompi4py().bcast(0 < size < np.inf and y.norm() <= 1e-12 * size):
            found.append(x.array_r.copy())
    x.destroy()
    y.destroy()
    return found


def has_negative_diagonal(P: PETSc.Mat) -> bool:
    """Whether all diagonal entries are negative, as in a negative definite matrix. P has entries, or is stored."""
    entries = diagonal(P) if has_entries(P) else P.getDiagonal().array_r
    return on_all(P.comm.tompi4py(), (entries < 0).all())


def negated(A: PETSc.Mat) -> PETSc.Mat:
    """A new Mat that is -A, with what the user has said about A. If A is not stored, its products are those of A."""
    function, kind = given(A, "entries"), A.getType().removeprefix("seq").removeprefix("mpi")
    if function is None and kind.startswith(("aij", "baij", "sbaij", "dense")):
        other = A.duplicate(copy=True)
        other.scale(-1.0)
    else:
        x, y = A.createVecs()

        def times(v: Array, out: Array) -> None:
            x.array_w[:] = v
            A.mult(x, y)
            out[:] = -y.array_r

        other = symmetric_shell(A.comm.tompi4py(), A.getLocalSize()[0], A.getBlockSize(), times)
        if function is not None:
            other.setAttr("entries", lambda i, j: -np.asarray(function(i, j)))
    for name in ("coordinates", "grid", "key"):
        other.setAttr(name, given(A, name))
    return other


def replaced_blocks(P: PETSc.Mat) -> Array | None:
    """The diagonal blocks of a stored Mat, where some diagonal entry is zero or no finite number: `without_singular`.
    None otherwise."""
    diagonal = P.getDiagonal().array_r
    if on_all(P.comm.tompi4py(), ((diagonal != 0) & np.isfinite(diagonal)).all()):
        return None
    size, here = P.getBlockSize(), P.getLocalSize()[0]
    indptr, indices, values = P.getDiagonalBlock().getValuesCSR()
    near = sp.csr_matrix((values, indices, indptr), shape=(here, here)).tocoo()
    inside = near.row // size == near.col // size
    row, column = near.row[inside], near.col[inside]
    blocks = np.zeros((here // size, size, size))
    blocks[row // size, row % size, column % size] = near.data[inside]
    return without_singular(blocks)


def without_singular(blocks: Array) -> Array:
    """These blocks (n, bs, bs) with identities in place of singular ones, as PCJACOBI has ones in place of zeros, and
    NaN in place of infinite ones, whose inverses would be zero and residuals too."""
    finite = np.isfinite(blocks).all(axis=(1, 2))
    size = blocks.shape[1]
    singular = np.linalg.matrix_rank(np.where(finite[:, None, None], blocks, np.eye(size))) < size
    return np.where(singular[:, None, None], np.eye(size), np.where(finite[:, None, None], blocks, np.nan))


def _conjugate_gradients(A: PETSc.Mat, M: PETSc.Mat, kind: str, b: PETSc.Vec, steps: int) -> tuple[int, Array]:
    """Why the method ends, and the norms r'M^-1 r of its residuals. ``kind`` is the preconditioner that M makes."""
    ksp, x = PETSc.KSP().create(A.comm), b.duplicate()
    ksp.setOperators(A, M)
    ksp.setType(PETSc.KSP.Type.CG)
    ksp.setNormType(PETSc.KSP.NormType.NATURAL)
    ksp.setTolerances(rtol=1e-12, atol=0.0, max_it=steps)
    ksp.setConvergenceHistory()
    ksp.pc.setType(kind)
    ksp.solve(b, x)
    found = ksp.getConvergedReason(), ksp.getConvergenceHistory().copy()
    for thing in (ksp, x, b):
        thing.destroy()
    return found
