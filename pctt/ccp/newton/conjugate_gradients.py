"""Conjugate gradients with block Jacobi for the matrices of bodies, in compiled loops: beside the product with the
matrix an iteration passes twice over the bodies. (Those of PETSc pass nine times, and take twice as long.)

Source: Hestenes and Stiefel (1952); Saad, Iterative Methods, algorithm 9.1.
"""

from __future__ import annotations

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from dem.compiled import loop
from pctt.arrays import Array
from pctt.blocks import shell_of
from pctt.ccp.newton.krylov import Solve, part_left


class ConjugateGradients:
    """Solves systems of one shell matrix of 6 x 6 blocks after another, on all ranks of ``comm``."""

    def __init__(self, comm: MPI.Comm):
        self.comm = comm
        self._inverse: Array | None = None

    def renew(self) -> None:
        """The matrix has new values."""
        self._inverse = None

    def solve(self, A: PETSc.Mat, b: PETSc.Vec, x: PETSc.Vec, rtol: float, most: int) -> Solve:
        """x = A^-1 b from zero, in at most so many iterations."""
        shell = shell_of(A)
        assert shell is not None
        assert shell.blocks is not None
        if self._inverse is None:
            self._inverse = np.empty((len(shell.blocks), 21), np.float32)
            _invert(shell.blocks, self._inverse)
        x.zeroEntries()
        found, r = x.array_w.reshape(-1, 6), b.array_r.reshape(-1, 6).copy()
        p, q, z = np.zeros((3, *r.shape))
        left, bent = self._sums(*_advance(0.0, (p, q), self._inverse, (found, r, z)))
        aim, slope, count, words = rtol**2 * left, 0.0, 0, "converged_rtol"
        while left > aim and count < most:
            _turn(slope, z, p)
            shell.product(p.ravel(), q.ravel())
            (curvature,) = self._sums(float(np.vdot(p, q)))
            if not 0.0 < curvature < np.inf:
                words = "diverged_indefinite_mat"
                break
            last = bent
            left, bent = self._sums(*_advance(bent / curvature, (p, q), self._inverse, (found, r, z)))
            slope, count = bent / last, count + 1
        residual = b.duplicate()
        A.mult(x, residual)
        true = part_left(residual, b, x)
        return Solve(true <= 2 * rtol, words if left <= aim else "diverged_its", count, 0.0, 0.0, true, rtol)

    def _sums(self, *parts: float) -> list[float]:
        """Over all ranks."""
        return list(parts) if self.comm.size == 1 else self.comm.allreduce(np.array(parts)).tolist()


@loop
def _invert(blocks, out):
    """The lower triangles (n, 21) of the inverses of symmetric positive definite blocks (n, 6, 6), by elimination
    without pivots."""
    A = np.empty((6, 6))
    for b in range(len(blocks)):
        for i in range(6):
            for j in range(6):
                A[i, j] = blocks[b, i, j]
        for k in range(6):
            inverse = 1.0 / A[k, k]
            for i in range(6):
                factor = A[i, k] * inverse
                if i != k:
                    for j in range(6):
                        A[i, j] -= factor * A[k, j]
                    A[i, k] = -factor
            for j in range(6):
                A[k, j] *= inverse
            A[k, k] = inverse
        n = 0
        for i in range(6):
            for j in range(i + 1):
                out[b, n] = A[i, j]
                n += 1


@loop
def _advance(step, way, P, now):
    """x += step p, r -= step q and z = P r, of rows (n, 6) and the lower triangles P (n, 21) of blocks; the sums r'r
    and r'z."""
    (p, q), (x, r, z) = way, now
    size = bent = 0.0
    for i in range(len(r)):
        for k in range(6):
            x[i, k] += step * p[i, k]
        a, b, c = r[i, 0] - step * q[i, 0], r[i, 1] - step * q[i, 1], r[i, 2] - step * q[i, 2]
        d, e, f = r[i, 3] - step * q[i, 3], r[i, 4] - step * q[i, 4], r[i, 5] - step * q[i, 5]
        u = P[i, 0] * a + P[i, 1] * b + P[i, 3] * c + P[i, 6] * d + P[i, 10] * e + P[i, 15] * f
        v = P[i, 1] * a + P[i, 2] * b + P[i, 4] * c + P[i, 7] * d + P[i, 11] * e + P[i, 16] * f
        w = P[i, 3] * a + P[i, 4] * b + P[i, 5] * c + P[i, 8] * d + P[i, 12] * e + P[i, 17] * f
        h = P[i, 6] * a + P[i, 7] * b + P[i, 8] * c + P[i, 9] * d + P[i, 13] * e + P[i, 18] * f
        m = P[i, 10] * a + P[i, 11] * b + P[i, 12] * c + P[i, 13] * d + P[i, 14] * e + P[i, 19] * f
        n = P[i, 15] * a + P[i, 16] * b + P[i, 17] * c + P[i, 18] * d + P[i, 19] * e + P[i, 20] * f
        r[i, 0], r[i, 1], r[i, 2], r[i, 3], r[i, 4], r[i, 5] = a, b, c, d, e, f
        z[i, 0], z[i, 1], z[i, 2], z[i, 3], z[i, 4], z[i, 5] = u, v, w, h, m, n
        size += a * a + b * b + c * c + d * d + e * e + f * f
        bent += a * u + b * v + c * w + d * h + e * m + f * n
    return size, bent


@loop
def _turn(slope, z, p):
    """p = z + slope p."""
    for i in range(len(p)):
        for k in range(6):
            p[i, k] = z[i, k] + slope * p[i, k]
