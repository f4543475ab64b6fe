"""Whether a symmetric approximate inverse is positive definite, before conjugate gradients are given it."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from mpi4py import MPI

from pctt.tt.train import Array

Product = Callable[[Array], Array]
STEPS = 12  # on trains that a search with trains of rank 8 took for positive, 1 to 9 were enough
CERTAIN = 0.7  # bound of ||I - S X||_F, an estimate that is off by a third at times
NOTHING = 1e-24  # part of a square that is rounding


def has_inertia_of(residual: float) -> bool:
    """Whether ||I - S X||_F = `residual` < 1 for symmetric S and X, with room for an estimate: then X has as many
    negative eigenvalues as S. (On the way from S^-1 to X, S^-1 - t (S^-1 - X) = S^-1 (I - t (I - S X)) is never
    singular.)"""
    return residual < CERTAIN


def finds_negative(X: Product, A: Product, size: int, comm: MPI.Comm, steps: int = STEPS) -> bool:
    """Whether a few steps of Lanczos' method find a direction y with y'X y <= 0.

    The method is that for X A, self-adjoint in the inner product of A whatever the signs of X. A pivot of its
    tridiagonal matrix is negative if and only if a Ritz value is, and then y = A v has y'X y < 0 for the Ritz vector v.
    Where X is near A^-1, all eigenvalues but the wrong ones are near one, so that these are found at once. A that is
    not positive itself counts as found; collective.

    X, A : symmetric; this rank's part of a product from its part (`size`,) of a vector
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
