"""Checks of the Mat that a user gives to a preconditioner, and of its solutions."""

from __future__ import annotations

import numpy as np
from petsc4py import PETSc

ASYMMETRY = 1e-8  # a smaller ||A - A'|| / ||A|| counts as rounding


def check_coordinates(P: PETSc.Mat) -> None:
    """ValueError on all ranks if the attribute ``coordinates`` of the Mat is wrong; collective.

    Allowed are finite numbers, a row per local block row. The attribute may also be missing on all ranks.
    """
    points = P.getAttr("coordinates")
    count = P.getLocalSize()[0] // P.getBlockSize()
    wrong = ""
    if points is not None:
        try:
            points = np.asarray(points, dtype=float)
        except (TypeError, ValueError):
            wrong = "are no numbers"
        else:
            if points.shape not in {(count, d) for d in (1, 2, 3)}:
                wrong = f"have the shape {points.shape}"
            elif not np.isfinite(points).all():
                wrong = "have a NaN or infinity"
    comm = P.comm.tompi4py()
    found = comm.allgather((points is not None, wrong, count))
    for rank, (given, wrong, count) in enumerate(found):
        if wrong or given != found[0][0]:
            raise ValueError(
                f"coordinates of the Mat {wrong or 'are missing'} on rank {rank}; allowed are finite numbers of shape "
                f"({count}, 1), ({count}, 2) or ({count}, 3), a row per local block row"
            )


def is_symmetric(P: PETSc.Mat) -> bool:
    """Whether P is symmetric. If the Mat does not know it, compare u'(P v) with v'(P u) for two random vectors."""
    known, symmetric = P.isSymmetricKnown()
    if known:
        return symmetric
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
    return bool(P.comm.tompi4py().bcast(abs(values[0] - values[1]) <= ASYMMETRY * size or not np.isfinite(size)))


def residual_norm(A: PETSc.Mat, b: PETSc.Vec, x: PETSc.Vec) -> float:
    """||b - A x||; nan or inf if x is no number."""
    residual = b.duplicate()
    A.mult(x, residual)
    residual.aypx(-1.0, b)
    norm = residual.norm()
    residual.destroy()
    return norm
