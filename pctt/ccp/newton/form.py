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
    matrix : the system's matrix; it may be a function
    symmetric : whether the present matrix is
    definite : whether it is positive definite where it is symmetric
    """

    problem: ConeProblem
    matrix: PETSc.Mat
    symmetric: bool
    definite: bool

    def load(self, problem: ConeProblem) -> None:
        """Take another problem with the same contacts between the same bodies."""

    def update(self, barrier: Array, inverse: Array | None = None, symmetric: bool = True) -> None:
        """Make the matrix for the barrier blocks B (nc, 3, 3), or from ``inverse`` = (B + C)^-1 if the caller has it
        more accurately. ``symmetric`` says whether the blocks are."""

    def entries(self) -> PETSc.Mat:
        """The matrix, or its sparse part, as one that preconditioners can read; collective."""

    def right_hand_side(self, q: Array, r_v: Array | None, uncoupled: Array | None) -> Array:
        """The right-hand side for the unknowns. ``uncoupled`` is (B + C)^-1 q, if the caller has it more accurately."""

    def impulses(self, x: Array, q: Array, uncoupled: Array | None) -> Array:
        """dg (nc, 3) of a solution."""

    def destroy(self) -> None: ...
