"""Inverse square root of a symmetric positive definite matrix, as a train: the always positive inverse Z Z'.

Coupled Newton-Schulz iteration (Higham, "Functions of Matrices", 2008, section 6.7) on Y = c S, Z = I,

    R = I - Z Y,   Y <- Y (I + R/2),   Z <- (I + R/2) Z,   Z -> (c S)^(-1/2),

rounded after every product; it converges where the eigenvalues of c S lie between 0 and 3, the limit being
exact up to the rounding. A product Z (Z' x) is positive whatever the rounding did, which an approximate
inverse of low rank need not be. It costs two products instead of one and, per iteration, three products of
trains with ranks r^2 before rounding: for r = 4 about three times an alternating inverse of rank 10, for r =
10 about fifty times.
"""

from __future__ import annotations

import numpy as np

from pctt.tt.inverse import lowest
from pctt.tt.train import Train, identity


def inverse_root(S: Train, max_rank: int = 4, iterations: int = 12, eps: float = 1e-8) -> tuple[Train, float]:
    """Z with Z Z' near the inverse of S, of ranks at most `max_rank`, and ||I - Z Y||_F / ||I||_F when it stopped.

    The iteration stops where that residual falls no more; eps rounds and is the residual that is small
    enough.

    >>> from pctt.tt.train import decompose_matrix
    >>> A = 3 * np.eye(64) - np.diag(np.ones(63), 1) - np.diag(np.ones(63), -1)
    >>> Z, error = inverse_root(decompose_matrix(A, [4, 4, 4]), max_rank=8)
    >>> bool(np.linalg.norm(np.eye(64) - A @ Z.full() @ Z.full().T) < 1e-3)
    True
    """
    one = identity(S.rows, S.dtype)
    largest = -lowest(-S, rank=4, sweeps=4)  # a lower bound, hence the 2 that 3 allows
    Y, Z = (2 / largest) * S, one
    best, least = Z, np.inf
    for _ in range(iterations):
        R = (one - Z @ Y).round(eps, 2 * max_rank)
        error = R.norm() / S.shape[0] ** 0.5
        if error >= least:
            break
        best, least = Z, error
        if error <= eps:
            break
        step = one + 0.5 * R
        Y, Z = (Y @ step).round(eps, max_rank), (step @ Z).round(eps, max_rank)
    return (2 / largest) ** 0.5 * best, float(least)
