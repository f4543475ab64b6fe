"""The interface that `Newton` expects of a form of its systems."""

from __future__ import annotations

from typing import Protocol

from petsc4py import PETSc

from pctt.ccp.cone import Array
from pctt.ccp.problem import ConeProblem


class NewtonForm(Protocol):
    """The Newton system in certain unknowns x, for one set of barrier blocks after another.

    Attributes
    ----------
    problem : the cone problem
    matrix : the system's matrix, a function; it is positive definite where it is symmetric
    symmetric : whether the present matrix is
    mends : whether the residual of a solve is one of momenta, dv = G' dg - r_v, which the next step of a method with
        momenta of its own mends; or it is one of velocities, (B + C) dg + G dv = q, where it opens what should touch
    """

    problem: ConeProblem
    matrix: PETSc.Mat
    symmetric: bool
    mends: bool

    def load(self, problem: ConeProblem) -> None:
        """Take another problem with the same contacts between the same bodies."""

    def update(self, barrier: Array, inverse: Array | None = None, symmetric: bool = True) -> None:
        """Make the matrix for the barrier blocks B (nc, 3, 3), or from ``inverse`` = (B + C)^-1 if the caller has it
        more accurately. ``symmetric`` says whether the blocks are."""

    def entries(self) -> PETSc.Mat:
        """The matrix, or its sparse part, as one that preconditioners can read; collective."""

    @property
    def speed(self) -> float:
        """What a residual of 1 changes the velocities of contacts by, about."""

    def right_hand_side(self, q: Array, r_v: Array | None, uncoupled: Array | None) -> Array:
        """The right-hand side for the unknowns. ``uncoupled`` is (B + C)^-1 q, if the caller has it more accurately."""

    def impulses(self, x: Array, q: Array, uncoupled: Array | None) -> Array:
        """dg (nc, 3) of a solution."""

    def momenta(self, x: Array, dg: Array, r_v: Array) -> Array:
        """dv (6m,) of a solution."""

    def destroy(self) -> None: ...
