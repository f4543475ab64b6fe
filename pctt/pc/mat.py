"""Checks of the Mat that a user gives to a preconditioner, and of its solutions."""

from __future__ import annotations

import numpy as np
from petsc4py import PETSc

ASYMMETRY = 1e-8  # a smaller ||A - A'|| / ||A|| counts as rounding


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
    return bool(P.comm.tompi4py().bcast(abs(values[0] - values[1]) <= ASYMMETRY * size or not np.isfinite(size)))


def residual_norm(A: PETSc.Mat, b: PETSc.Vec, x: PETSc.Vec) -> float:
    """||b - A x||; nan or inf if x is no number."""
    residual = b.duplicate()
    A.mult(x, residual)
    residual.aypx(-1.0, b)
    norm = residual.norm()
    residual.destroy()
    return norm
