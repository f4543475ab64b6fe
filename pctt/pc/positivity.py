"""Tests whether a symmetric approximate inverse is positive definite, before conjugate gradients use it."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from mpi4py import MPI

from pctt.tt.train import Array

Product = Callable[[Array], Array]
STEPS = 12  # 1 to 9 were enough for indefinite trains that a search with trains of rank 8 took for positive
CERTAIN = 0.7  # bound of ||I - S X||_F; below 1, because the estimate is sometimes wrong by a third
NOTHING = 1e-24  # a smaller part of a square counts as rounding


def has_inertia_of(residual: float) -> bool:
    """Whether ||I - S X||_F = `residual` is safely below 1 for symmetric S and X. There is a margin, because the
    residual may be an estimate.

    Then X has as many negative eigenvalues as S: on the line from S^-1 to X the matrix
    S^-1 - t (S^-1 - X) = S^-1 (I - t (I - S X)) is never singular.
    """
    return residual < CERTAIN


def finds_negative(X: Product, A: Product, size: int, comm: MPI.Comm, steps: int = STEPS) -> bool:
    """Whether a few steps of Lanczos' method find a direction y with y'X y <= 0. Collective.

    The method works on X A, which is self-adjoint in the inner product of A for any signs of X. Its tridiagonal matrix
    has a negative pivot if and only if it has a negative Ritz value. Then y = A v has y'X y < 0 for the Ritz vector v.
    If X is near A^-1, all eigenvalues except the wrong ones are near one, so the method finds the wrong ones quickly.
    If A itself is not positive, the result is True too.

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
        if abs(square) <= NOTHING * alpha**2:
            return False  # the space is invariant
    return False
