"""Checks of the Mat that a user gives to a preconditioner, of the preconditioner, and of solutions."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from pctt.tt.train import Array


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
    size = product.norm()
    for vec in (u, v, product):
        vec.destroy()
    return bool(P.comm.tompi4py().bcast(abs(values[0] - values[1]) <= 1e-8 * size or not np.isfinite(size)))


def residual_norm(A: PETSc.Mat, b: PETSc.Vec, x: PETSc.Vec) -> float:
    """||b - A x||; nan or inf if x is no number."""
    residual = b.duplicate()
    A.mult(x, residual)
    residual.aypx(-1.0, b)
    norm = residual.norm()
    residual.destroy()
    return norm


def product_with(P: PETSc.Mat) -> Callable[[Array], Array]:
    """The product with P, of this rank's part of a vector."""
    x, y = P.createVecs()

    def times(v: Array) -> Array:
        x.array_w[:] = v
        P.mult(x, y)
        return y.array_r.copy()

    return times


def finds_negative(
    X: Callable[[Array], Array], A: Callable[[Array], Array], size: int, comm: MPI.Comm, steps: int = 12
) -> bool:
    """Whether a few steps of Lanczos' method find a direction y with y'X y <= 0. Collective.

    The method works on X A, which is self-adjoint in the inner product of A for any signs of X. Its tridiagonal matrix
    has a negative pivot if and only if it has a negative Ritz value. Then y = A v has y'X y < 0 for the Ritz vector v.
    If X is near A^-1, all eigenvalues except the wrong ones are near one, so the method finds the wrong ones quickly:
    1 to 9 steps were enough for indefinite trains that a search with trains of rank 8 took for positive. If A itself is
    not positive, the result is True too.

    X, A : symmetric products; each gives this rank's part of the product from its part (`size`,) of a vector
    """

    def dot(u: Array, v: Array) -> float:
        return float(comm.allreduce(float(u @ v)))

    w = np.random.default_rng(comm.rank).standard_normal(size)
    v, beta, pivot = np.zeros(size), 0.0, np.inf
    Aw = A(w)
    square = dot(w, Aw)
    for _ in range(steps):
        if not square > 0:
            return True
        beta = float(np.sqrt(square)) if np.isfinite(pivot) else 0.0
        old, v, Av = v, w / np.sqrt(square), Aw / np.sqrt(square)
        w = X(Av)
        alpha = dot(w, Av)
        pivot = alpha - beta**2 / pivot
        if not pivot > 0:
            return True
        w = w - alpha * v - beta * old
        Aw = A(w)
        square = dot(w, Aw)
        if abs(square) <= 1e-24 * alpha**2:  # rounding
            return False  # the space is invariant
    return False


def iterations_with_the_diagonal(A: PETSc.Mat, diagonal: Array, most: int = 500) -> int:
    """About how many iterations conjugate gradients to 1e-8 take with the diagonal; `most` at most. Collective.

    They are extrapolated from the first six.
    """
    probe, digits = 6, 8.0
    times, comm = product_with(A), A.comm.tompi4py()

    def dot(u: Array, v: Array) -> float:
        return float(comm.allreduce(float(u @ v)))

    r = np.random.default_rng(A.comm.rank).standard_normal(len(diagonal)) * np.sqrt(np.abs(diagonal))
    p = r / diagonal
    first = square = dot(r, p)
    for _ in range(probe):
        q = times(p)
        curvature = dot(p, q)
        if not curvature > 0:
            break
        r = r - square / curvature * q
        z = r / diagonal
        square, before = dot(r, z), square
        p = z + square / before * p
    found = 0.5 * float(np.log10(abs(first) / max(abs(square), 1e-32 * abs(first))))
    return int(comm.bcast(min(most, probe * digits / max(found, probe * digits / most))))
