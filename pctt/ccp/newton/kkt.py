"""The Newton system with multipliers, 5 unknowns per contact (5Nc x 5Nc, block size 5), symmetric and quasi-definite.

The barrier block B = sum_i k_i v_i v_i' of a contact has entries without bound. Its two stiffest directions get
unknowns of their own, the changes w_i of their multipliers, as the paper's two constraints per contact have before
they are eliminated:

    [ N + C + k_1 v_1 v_1'   d V  ] [dg]   [q]
    [ d V'                -d^2 K^-1 ] [w ] = [0],     V = (v_2, v_3),  K = diag(k_2, k_3),

d^2 = mean diag N. All entries stay bounded as contacts open or stick.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
from petsc4py import PETSc

from pctt.block_diagonal import put_diagonal_blocks
from pctt.blocks import square_block_matrix
from pctt.ccp.cone import TINY, Array
from pctt.ccp.delassus import rows_in_blocks
from pctt.ccp.problem import ConeProblem
from pctt.options import OptionError


class KKTForm:
    """The `NewtonForm` of the module."""

    symmetric = True
    definite = False

    def __init__(self, problem: ConeProblem):
        if problem.has_hubs:
            raise OptionError("-ccp_newton kkt: a body has too many contacts; allowed are contact and body")
        self.problem = problem
        small = rows_in_blocks(problem.N)
        self._indptr, self._indices = small.indptr, small.indices
        self.matrix = square_block_matrix(problem.comm, self._padded(small.data))
        self.matrix.setOption(PETSc.Mat.Option.SYMMETRIC, True)
        if problem.point is not None:
            self.matrix.setAttr("coordinates", problem.point)

    def _padded(self, blocks: Array) -> sp.bsr_matrix:
        wide = np.zeros((len(blocks), 5, 5))
        wide[:, :3, :3] = blocks
        shape = (5 * (len(self._indptr) - 1), 5 * self.problem.size)
        return sp.bsr_matrix((wide, self._indices, self._indptr), shape=shape)

    def load(self, problem: ConeProblem) -> None:
        other = KKTForm(problem)
        other.matrix.copy(self.matrix, PETSc.Mat.Structure.SAME_NONZERO_PATTERN)
        other.destroy()
        self.problem = problem

    def update(self, barrier: Array, inverse: Array | None = None, symmetric: bool = True) -> None:
        """Put the barrier blocks (nc, 3, 3) in."""
        k, V = np.linalg.eigh(barrier)
        scale = np.sqrt(self.problem.mean_diagonal)
        blocks = np.zeros((len(barrier), 5, 5))
        weakest = V[:, :, 0]
        blocks[:, :3, :3] = self.problem.diagonal_blocks
        blocks[:, :3, :3] += np.maximum(k[:, 0], 0.0)[:, None, None] * weakest[:, :, None] * weakest[:, None, :]
        blocks[:, :3, 3:] = scale * V[:, :, 1:]
        blocks[:, 3:, :3] = scale * V[:, :, 1:].transpose(0, 2, 1)
        blocks[:, [3, 4], [3, 4]] = -(scale**2) / np.maximum(k[:, 1:], TINY**0.5)
        put_diagonal_blocks(self.matrix, blocks)

    def entries(self) -> PETSc.Mat:
        return self.matrix

    def right_hand_side(self, q: Array, r_v: Array | None, uncoupled: Array | None) -> Array:
        out = np.zeros((len(q), 5))
        out[:, :3] = q if r_v is None else q + self.problem.velocity_of(r_v)
        return out.ravel()

    def impulses(self, x: Array, q: Array, uncoupled: Array | None) -> Array:
        return np.ascontiguousarray(x.reshape(-1, 5)[:, :3])

    def destroy(self) -> None:
        self.matrix.destroy()
