"""The Newton system of the bodies, K = I + G' (B + C)^-1 G (6M x 6M, block size 6), in mass-scaled velocities: the
Schur complement of the bodies.

    K dv = G' (B + C)^-1 q - r_v,    dg = (B + C)^-1 (q - G dv).

The residual of an inexact solve of K stays in the momenta: nothing multiplies it. K is smaller than the contact system
and far better conditioned once contacts open or slide.

For Coulomb's law (B + C)^-1 is not symmetric, and K is not either.
"""

from __future__ import annotations

import numpy as np
from petsc4py import PETSc

from pctt.body_matrix import BodyOperator, inverse_blocks
from pctt.ccp.cone import Array, times
from pctt.ccp.newton.fronts import Fronts, places_in
from pctt.ccp.problem import ConeProblem

LEAST = 0.1  # drop tolerance of a factor: entries of a block between bodies [mass] that it is better off without


class BodyForm:
    """The `NewtonForm` of the module."""

    mends = True

    def __init__(self, problem: ConeProblem):
        assert problem.contact_map is not None
        self.problem = problem
        self.operator = BodyOperator(problem.contact_map)
        self.matrix = self.operator.mat
        self._places: Array | None = None
        self._placed = False
        self.symmetric = True

    def load(self, problem: ConeProblem) -> None:
        assert problem.contact_map is not None
        self.problem = problem
        self.operator.load(problem.contact_map)
        self._places, self._placed = None, False

    def update(self, barrier: Array, inverse: Array | None = None, symmetric: bool = True) -> None:
        if inverse is None:
            inverse = inverse_blocks(barrier + self.problem.compliance_blocks)
        self._inverse, self.symmetric = inverse, symmetric
        self.operator.update(inverse, symmetric)

    def entries(self) -> PETSc.Mat:
        """K as a matrix that preconditioners can read, with the places of the bodies; collective."""
        entries = self.operator.entries()
        mat = entries.mat
        if not self._placed and self.places() is not None:
            mat.setAttr("coordinates", self.places())
            self._placed = True
        return mat

    def places(self) -> Array | None:
        """Places (n, 3) of this rank's bodies, if the problem has those of its contacts; collective."""
        if self._places is None and self.problem.point is not None:
            self._places = self.operator.entries().places(self.problem.point)
        return self._places

    def stiff_part(self) -> PETSc.Mat:
        """What is worth factorising of K, in scalar rows: a new Mat, which the caller destroys."""
        return self.operator.entries().stiff_mat(LEAST, self.symmetric)

    def fronts(self, precision: type[np.floating]) -> Fronts:
        """The factors of this part, which is symmetric and on one rank."""
        part, points = self.operator.entries().stiff_part(LEAST), self.places()
        return Fronts(part, places_in(part) if points is None else points, precision)

    @property
    def speed(self) -> float:
        return float(self.problem.mean_diagonal**0.5)

    def right_hand_side(self, q: Array, r_v: Array | None, uncoupled: Array | None) -> Array:
        push = self.problem.momentum(times(self._inverse, q) if uncoupled is None else uncoupled)
        return push if r_v is None else push - r_v

    def impulses(self, x: Array, q: Array, uncoupled: Array | None) -> Array:
        if uncoupled is None:
            return times(self._inverse, q - self.problem.velocity_of(x))
        return uncoupled - times(self._inverse, self.problem.velocity_of(x))

    def momenta(self, x: Array, dg: Array, r_v: Array) -> Array:
        return x

    def destroy(self) -> None:
        self.operator.destroy()
