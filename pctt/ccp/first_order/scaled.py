"""The cone problem in unknowns of equal size, and the arithmetic on them that first-order methods share."""

from __future__ import annotations

from functools import cached_property

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from pctt.ccp import cone
from pctt.ccp.cone import Array
from pctt.ccp.problem import ConeProblem
from pctt.ccp.result import Limits


class ScaledProblem:
    """min 1/2 x'Ax + b'x over friction cones, where the diagonal of A is about one.

    x = S g, A = S^-1 N S^-1, b = S^-1 r. The diagonal S has two values per contact, the roots of its normal and
    of its mean tangential entry of diag N: the cones stay friction cones, of friction mu s_t / s_n. This is
    diagonal preconditioning by a metric in which the projection is still exact.

    With ``coulomb`` it is Coulomb's law, in the same variables: x is a solution if the projected step from x along the
    gradient *with its opening* (mu |y_t|, 0, 0) leads back to x. The natural residual measures how far it leads away.

    In single ``precision`` products with a contact map move half of the bytes.
    """

    def __init__(self, problem: ConeProblem, coulomb: bool = False, precision: type[np.floating] = np.float64):
        self.problem, self.opening, self.precision = problem, float(coulomb), precision
        blocks = problem.diagonal_blocks
        size = np.empty_like(problem.r)
        size[:, 0] = blocks[:, 0, 0]
        size[:, 1] = size[:, 2] = 0.5 * (blocks[:, 1, 1] + blocks[:, 2, 2])
        self._scale = np.sqrt(np.where(size > 0, size, problem.mean_diagonal))
        self._shrink = 1.0 / self._scale
        self.mu = self._rounded(problem.mu * self._scale[:, 1] / self._scale[:, 0])
        self.b = self._rounded(problem.r * self._shrink)
        self._compliance = self._rounded(problem.compliance * self._shrink**2)
        self._operator = problem.operator.scaled(self._shrink, precision)

    def _rounded(self, x: Array) -> Array:
        return x.astype(self.precision, copy=False)

    def start(self, guess: Array) -> Array:
        """The scaled point of a first guess of the impulses (nc, 3), in the cones."""
        return self.project(self._rounded(guess * self._scale))

    def impulse(self, x: Array) -> Array:
        return x * self._shrink

    def product(self, x: Array, out: Array | None = None) -> Array:
        """A x (nc, 3)."""
        out = np.multiply(self._compliance, x, out=out)
        self._operator.add_delassus(x, out)
        return out

    def gradient(self, x: Array, out: Array | None = None) -> Array:
        """A x + b (nc, 3)."""
        if self.problem.softness:
            out = self.product(x, out)
            out += self.b
            return out
        out = np.empty_like(x) if out is None else out
        out[:] = self.b
        self._operator.add_delassus(x, out)
        return out

    def project(self, x: Array) -> Array:
        """x moved to the nearest point of the cones, in place."""
        return cone.project(x, self.mu, out=x)

    def projected_move(self, x: Array, y: Array, step: float) -> Array:
        """P(x - step y) - x (nc, 3)."""
        return cone.projected_move(x, y, step, self.mu)

    def dots(self, *pairs: tuple[Array, Array]) -> Array:
        """Scalar products of pairs of arrays over all contacts, in one reduction over the ranks."""
        return self.sums(*(float(np.vdot(x, y)) for x, y in pairs))

    def sums(self, *parts: float) -> Array:
        """Sums of numbers over the ranks, in one reduction; of a buffer, which takes a tenth of the time of objects."""
        out = np.array(parts, dtype=float)
        self.problem.comm.Allreduce(MPI.IN_PLACE, out)
        return out

    def matrix(self) -> PETSc.Mat:
        """A as a Mat of its own."""
        A = self.problem.N.duplicate(copy=True)
        shrink = A.createVecLeft()
        shrink.array[:] = self._shrink.ravel()
        A.diagonalScale(shrink, shrink)
        shrink.destroy()
        return A

    @cached_property
    def blocks(self) -> Array:
        """The 3 x 3 diagonal blocks of A (nc, 3, 3)."""
        return self.problem.diagonal_blocks * (self._shrink[:, :, None] * self._shrink[:, None, :])

    def block_steps(self) -> Array:
        """1 over the largest eigenvalue of each contact's block of A, per unknown (nc, 3)."""
        largest = np.linalg.eigvalsh(self.blocks)[:, -1]
        return np.repeat(1.0 / np.where(largest > 0, largest, 1.0), 3).reshape(-1, 3)

    def residuals(self, limits: Limits, x: Array, gradient: Array) -> tuple[float, float]:
        """The natural residual of the impulse of x, in its own units, and the residual that the tolerance is for."""
        g, y = self.impulse(x), gradient * self._scale
        natural = self.problem.natural_residual(g, y, bool(self.opening))
        return natural, limits.residual(natural, self.problem, g, y)

    def largest_curvature(self, steps: int = 10) -> float:
        """Estimate from below of the largest eigenvalue of A: ``steps`` power iterations from b."""
        x = self.b
        curvature = 1.0
        for _ in range(steps):
            norm = np.sqrt(self.dots((x, x))[0])
            if not norm > 0:
                break
            Ax = self.product(x / norm)
            curvature = self.dots((x, Ax))[0] / norm
            x = Ax
        return max(curvature, 1.0)  # the mean of diag A is 1
