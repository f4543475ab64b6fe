"""The Newton system of the contacts, S = N + C + B (3Nc x 3Nc, block size 3): the paper's Schur complement.

N's structure and values are copied once per cone problem; a Newton step writes the diagonal blocks alone. Bodies with
very many contacts (a press, a drum) would fill N: they enter as a low-rank term U U' (``MATLRC``), and
preconditioners get the sparse part with the full diagonal blocks.
"""

from __future__ import annotations

import numpy as np
from petsc4py import PETSc

from pctt.ccp.cone import Array
from pctt.ccp.problem import ConeProblem
from pctt.pc.block_diagonal import set_diagonal_blocks


class ContactSystem:
    """S dg = q + G r_v, dv = G' dg - r_v.

    Attributes
    ----------
    matrix : S
    preconditioned : the Mat that preconditioners are made from; S itself but for a low-rank term
    """

    def __init__(self, problem: ConeProblem):
        self.problem = problem
        self.preconditioned = problem.N.duplicate(copy=True)
        self._low_rank = problem.low_rank is not None
        if self._low_rank:
            self._sparse = problem.N.duplicate(copy=True)
            self.matrix = _with_low_rank(self._sparse, problem.low_rank)
        else:
            self._sparse = self.matrix = self.preconditioned
        for mat in (self._sparse, self.preconditioned):
            mat.setOption(PETSc.Mat.Option.SYMMETRIC, True)
        describe(self.preconditioned, problem)
        first, last = self.preconditioned.getOwnershipRange()
        self._block_rows = np.arange(first // 3, last // 3, dtype=PETSc.IntType)[:, None]

    def load(self, problem: ConeProblem) -> None:
        """Take another problem with the same contacts between the same bodies."""
        self.problem = problem
        same = PETSc.Mat.Structure.SAME_NONZERO_PATTERN
        problem.N.copy(self.preconditioned, same)
        if self._low_rank:
            problem.N.copy(self._sparse, same)
            self.matrix.destroy()
            self.matrix = _with_low_rank(self._sparse, problem.low_rank)
        describe(self.preconditioned, problem)

    def update(self, barrier: Array, inverse: Array | None = None) -> None:
        """Put the barrier blocks (nc, 3, 3) in."""
        self.preconditioned.setAttr("barrier", barrier + self.problem.compliance_blocks)
        blocks = self.problem.diagonal_blocks + barrier
        self._put(self.preconditioned, blocks)
        set_diagonal_blocks(self.preconditioned, blocks)
        if self._low_rank:
            self._put(self._sparse, self.problem.sparse_diagonal_blocks + barrier)
            self.matrix.assemble()

    def _put(self, mat: PETSc.Mat, blocks: Array) -> None:
        if len(blocks):  # petsc4py divides by their number
            mat.setValuesBlockedRCV(self._block_rows, self._block_rows, blocks.reshape(-1, 9))
        mat.assemble()

    def right_hand_side(self, q: Array, r_v: Array | None, alone: Array | None = None) -> Array:
        return q.ravel() if r_v is None else (q + self.problem.velocity_of(r_v)).ravel()

    def impulses(self, x: Array, q: Array, alone: Array | None = None) -> Array:
        """dg (nc, 3) of a solution."""
        return x.reshape(-1, 3).copy()

    def momentum(self, x: Array, dg: Array, r_v: Array) -> Array:
        """dv of a solution."""
        return self.problem.momentum(dg) - r_v

    def tolerance(self, tol: float) -> float:
        """The norm of this system's residual that leaves velocities as wrong as momenta (sqrt J) by ``tol``."""
        return tol * float(np.sqrt(self.problem.mean_diagonal))

    def destroy(self) -> None:
        self.matrix.destroy()
        if self._low_rank:
            self._sparse.destroy()
            self.preconditioned.destroy()


def _with_low_rank(A: PETSc.Mat, U: PETSc.Mat) -> PETSc.Mat:
    """A + U U'."""
    ones = U.createVecRight()  # petsc4py of 3.22 does not take None
    ones.set(1.0)
    mat = PETSc.Mat().createLRC(A, U, ones, U)
    ones.destroy()
    return mat


def describe(mat: PETSc.Mat, problem: ConeProblem) -> None:
    """What preconditioners may ask for: the places and names of the contacts, and what S is made of."""
    for name in ("point", "key", "contact_map"):
        value = getattr(problem, name)
        if value is not None:
            mat.setAttr("coordinates" if name == "point" else name, value)
