"""The Newton system of the contacts, S = N + C + B (3Nc x 3Nc, block size 3): the paper's Schur complement.

S is a function, S g = N g + (C + B) g, and its entries are made only for a preconditioner that reads them: N's
structure and values are copied once per cone problem, and a Newton step writes the diagonal blocks alone. Bodies with
very many contacts (a press, a drum) would fill N: preconditioners get it without the columns of these bodies, with the
full diagonal blocks.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
from petsc4py import PETSc

from dem.contact_map.loops import local_product, pack
from pctt.blocks import put_diagonal_blocks, set_diagonal_blocks, symmetric_shell
from pctt.ccp.cone import Array
from pctt.ccp.delassus import GivenMatrix
from pctt.ccp.problem import ConeProblem


class ContactForm:
    """The `NewtonForm` of the module: S dg = q + G r_v, dv = G' dg - r_v."""

    mends = False
    speed = 1.0

    def __init__(self, problem: ConeProblem):
        self.problem, self.symmetric = problem, True
        self._entries: PETSc.Mat | None = None
        self._N: Array | None = None
        self.matrix = symmetric_shell(problem.comm, problem.r.size, 3, self._product)

    def load(self, problem: ConeProblem) -> None:
        self.problem, self._loaded, self._N = problem, False, None

    def update(self, barrier: Array, inverse: Array | None = None, symmetric: bool = True) -> None:
        self._blocks, self._made, self.symmetric = self.problem.diagonal_blocks + barrier, False, symmetric
        self._local = np.empty((len(barrier), 6))
        pack(barrier + self.problem.compliance_blocks, self._local)
        set_diagonal_blocks(self.matrix, self._blocks)

    def _product(self, g: Array, out: Array) -> None:
        g, out = g.reshape(-1, 3), out.reshape(-1, 3)
        local_product(self._local, g, out)
        PETSc.Log.logFlops(5 * g.size)
        self.problem.operator.add_delassus(g, out)

    def entries(self) -> PETSc.Mat:
        """S without the columns of hubs (BAIJ), with the places and names of the contacts that preconditioners may have
        as attributes; collective."""
        if self._entries is None:
            self._entries = self.problem.N.duplicate(copy=True)
            self._entries.setOption(PETSc.Mat.Option.SYMMETRIC, True)
        elif not self._loaded:
            self.problem.N.copy(self._entries, PETSc.Mat.Structure.SAME_NONZERO_PATTERN)
        self._loaded = True
        if not self._made:
            put_diagonal_blocks(self._entries, self._blocks)
            for name, value in (("coordinates", self.problem.point), ("key", self.problem.key)):
                if value is not None:
                    self._entries.setAttr(name, value)
            self._made = True
        return self._entries

    def dense(self) -> Array:
        """S of a problem on one rank (3Nc, 3Nc)."""
        if self._N is None:
            self._N = _dense(self.problem)
        matrix, here = self._N.copy(), np.arange(len(self._blocks))
        matrix.reshape(len(here), 3, len(here), 3)[here, :, here] = self._blocks
        return matrix

    def right_hand_side(self, q: Array, r_v: Array | None, uncoupled: Array | None) -> Array:
        return q.ravel() if r_v is None else (q + self.problem.velocity_of(r_v)).ravel()

    def impulses(self, x: Array, q: Array, uncoupled: Array | None) -> Array:
        return x.reshape(-1, 3).copy()

    def momenta(self, x: Array, dg: Array, r_v: Array) -> Array:
        return self.problem.momentum(dg) - r_v

    def destroy(self) -> None:
        self.matrix.destroy()
        if self._entries is not None:
            self._entries.destroy()


def _dense(problem: ConeProblem) -> Array:
    """N of a problem on one rank, without compliance."""
    if isinstance(problem.operator, GivenMatrix):
        indptr, indices, values = problem.operator.mat.getValuesCSR()
        return sp.csr_matrix((values, indices, indptr), shape=(problem.r.size,) * 2).toarray()
    G = problem.operator.block_rows
    rows = sp.bsr_matrix((G.blocks, G.indices, G.indptr), shape=(problem.r.size, 6 * G.columns))
    return (rows @ rows.T).toarray()
