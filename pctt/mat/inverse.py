"""A direct solver: the inverse of a symmetric positive definite matrix as a Mat that multiplies with a train."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from petsc4py import PETSc

from dem.exchange import on_first
from pctt.blocks import refuse_unready
from pctt.mat.entries import has_entries, multiplies
from pctt.mat.grid_train import GridTrain
from pctt.mat.order import layout_of
from pctt.mat.tensor_train import MAX_RANK, MISSED, Options, compressed, compressed_entries, mat_of
from pctt.petsc import own_errors
from pctt.tt.inverse import invert_positive


def inverse(A: PETSc.Mat, eps: float = 1e-6, max_rank: int = MAX_RANK) -> PETSc.Mat:
    """Return the inverse X of a symmetric positive definite A; ``X.mult(b, x)`` solves A x = b. Collective.

    Parameters
    ----------
    A : a Mat of `from_entries` or `load`, or any Mat with entries (see docs/trains.md)
    eps : ||I - S X||_F <= eps ||S - I||_F for the train S of A / c, where c is the mean of the diagonal. If A is no
        train, S has an error of eps too. A smaller eps is taken where eps does not show that X is positive.
    max_rank : largest allowed rank of both trains

    Notes
    -----
    X is a Mat like those of `from_entries`. Its context has the figures ``ranks``, ``bytes``, ``residual``
    (||I - S X||_F / ||S - I||_F) and ``error`` (||b - A X b|| / ||b|| for a random b, with the product of A).

    ValueError on all ranks if A is not symmetric, not positive definite, or if max_rank does not allow eps.

    >>> from pctt.mat import from_entries
    >>> A = from_entries(lambda i, j: (i == j) + 0.1 / (1.0 + abs(i - j)), (64,))
    >>> X = inverse(A, 1e-8)
    >>> X.getPythonContext().error < 1e-8
    True
    """
    refuse_unready("pctt.mat.inverse", A)
    comm = A.comm.tompi4py()
    options = Options(eps, max_rank)
    options.check(comm)
    matrix = _train_of(A, options)
    if not matrix.symmetric:
        raise ValueError("pctt.mat.inverse: the matrix is not symmetric; allowed are symmetric matrices")
    if matrix.shift <= 0:
        raise ValueError("pctt.mat.inverse: the matrix is not positive definite: the mean of its diagonal is <= 0")
    with PETSc.Log.Event("TTInvert"):
        # 6 sweeps were enough for 1e-13
        found = on_first(comm, lambda: invert_positive(matrix.train, max_rank, eps, worth=0.0, sweeps=12))
    if found is None:
        raise ValueError("pctt.mat.inverse: the matrix is not positive definite")
    if found.residual > eps:
        raise ValueError(
            f"pctt.mat.inverse: a residual of {found.residual:.1e} is left at rank {max(found.applied.ranks) + 1}, "
            f"{eps:.1e} was asked for; allowed is a max_rank above {max_rank} or a larger eps, unless the matrix is "
            "nearly singular or not positive definite"
        )
    c = 1.0 / matrix.shift
    X = replace(
        matrix, train=found.applied, shift=c, scale=c, residual=found.residual, found=None, function=None,
        origin=f"of a solve with a random right side; inverse I + Z with residual {found.residual:.2g}",
    )  # fmt: skip
    return mat_of(replace(X, error=_error_of_solve(A, matrix, X)), options)


def _train_of(A: PETSc.Mat, options: Options) -> GridTrain:
    """c (I + T) for A, as accurate as eps asks for. ValueError on all ranks if there is none."""
    known = compressed(A)
    if known is not None:
        return known.rounded(0.5 * options.eps if known.error <= options.eps else 0.0, options.max_rank)
    if not has_entries(A):
        raise ValueError(
            f"pctt.mat.inverse: a Mat of type {A.getType()} without entries; allowed are trains, dense Mats, and Mats "
            "with the attribute entries"
        )
    with own_errors(), PETSc.Log.Event("TTCompress"):
        matrix = compressed_entries(A, layout_of(A), options.eps, options.max_rank)
    if matrix.error > MISSED * options.eps:
        raise ValueError(
            f"pctt.mat.inverse: the train of the matrix has an error of {matrix.error:.1e} at rank "
            f"{max(matrix.ranks)}, {options.eps:.1e} was asked for; allowed is a max_rank above {options.max_rank} "
            "or a larger eps"
        )
    return matrix


def _error_of_solve(A: PETSc.Mat, matrix: GridTrain, X: GridTrain) -> float:
    """||b - A X b|| / ||b|| for a random b. The product is that of A, or that of its train if A has none."""
    x, b = A.createVecs()
    b.array_w[:] = np.random.default_rng(A.comm.rank).standard_normal(b.getLocalSize())
    x.array_w[:] = X.times(b.array_r)
    r = b.duplicate()
    if multiplies(A):
        A.mult(x, r)
    else:
        r.array_w[:] = matrix.times(x.array_r)
    r.aypx(-1.0, b)
    error = float(r.norm() / b.norm())
    for vec in (x, b, r):
        vec.destroy()
    return error
