"""The Newton system with the multipliers as unknowns, 3Nc + m rows for m constraints: the paper's 5Nc x 5Nc matrix."""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import scipy.sparse as sp
from petsc4py import PETSc

from pctt.arrays import Array
from pctt.blocks import new_matrix, set_diagonal_blocks, symmetric_shell
from pctt.ccp.delassus import rows_in_blocks
from pctt.ccp.newton.forms import ContactForm
from pctt.ccp.newton.kkt import KKT

if TYPE_CHECKING:
    from pctt.ccp.problem import ConeProblem


class KKTForm(ContactForm):
    """The system with the matrix of `KKT`, unsymmetric as in the paper; a contact and its multipliers are a block of
    3 + k rows.

    The rows of multipliers are multiplied by |df| / -f, and the unknowns are |df| dlam. So all unknowns but dg, and all
    residuals, are velocities, E is the identity, and an inexact solve leaves at most sqrt(1 + k) times its residual in
    S dg. A symmetric scaling has no such bound. A preconditioner that reads entries gets an AIJ Mat.
    """

    def __init__(self, problem: ConeProblem):
        super().__init__(problem)
        self.symmetric = False
        self._constraints = 0  # of a contact, of the present matrix

    def fits(self, kkt: KKT) -> bool:
        return self._constraints in (0, kkt.f.shape[1])

    @cached_property
    def _mat(self) -> PETSc.Mat:
        nc, size, _ = self._local.shape
        return symmetric_shell(self.problem.comm, nc * size, size, self._product, self._transposed)

    def linearise(self, kkt: KKT) -> None:
        nc, k = kkt.f.shape
        self._constraints = k
        self.size = np.sqrt(np.square(kkt.df).sum(axis=2))
        along = kkt.df / self.size[:, :, None]
        self.row = self.size / -kkt.f
        self._local = np.zeros((nc, 3 + k, 3 + k))
        self._local[:, :3, :3] = kkt.M + self.problem.compliance_blocks
        self._local[:, :3, 3:] = along.transpose(0, 2, 1)
        self._local[:, 3:, :3] = -(kkt.lam * self.row)[:, :, None] * kkt.df
        self._local[:, 3:, 3:] = np.eye(k)
        self.blocks, self._made, self._current = self._local.copy(), False, False
        self.blocks[:, :3, :3] = kkt.M + self.problem.diagonal_blocks

    def _take_values(self) -> None:
        set_diagonal_blocks(self._mat, self.blocks, symmetric=False)

    def _product(self, x: Array, out: Array) -> None:
        self._multiply(self._local, x, out)

    def _transposed(self, x: Array, out: Array) -> None:
        self._multiply(self._local.transpose(0, 2, 1), x, out)

    def _multiply(self, local: Array, x: Array, out: Array) -> None:
        x, out = x.reshape(local.shape[:2]), out.reshape(local.shape[:2])
        y = np.zeros((len(x), 3))
        self.problem.operator.add_delassus(np.ascontiguousarray(x[:, :3]), y)
        out[:] = np.einsum("cij,cj->ci", local, x)
        out[:, :3] += y

    def _with_N(self, old: PETSc.Mat | None) -> PETSc.Mat:  # noqa: N802 - as in formulas
        rows, size = self._rows_of_N(), self.matrix.getBlockSize()
        csr = (rows.indptr.astype(PETSc.IntType), rows.indices.astype(PETSc.IntType), rows.data)
        if old is None:
            return new_matrix(self.problem.comm, self.matrix.getSizes(), size, csr, PETSc.Mat.Type.AIJ)
        old.setValuesCSR(*csr)
        old.assemble()
        return old

    def _rows_of_N(self) -> sp.csr_matrix:  # noqa: N802 - as in formulas
        """N among the rows of this rank, with zeros where the diagonal blocks of the matrix will be."""
        N, size = rows_in_blocks(self.problem.N), self.matrix.getBlockSize()
        first = self.matrix.getOwnershipRange()[0] // size
        contact, corner, whole = np.arange(len(N.indptr) - 1), np.arange(3), np.arange(size)
        row = np.repeat(contact, np.diff(N.indptr))
        places = [
            np.broadcast_arrays((size * c)[:, None, None] + n[:, None], (size * d)[:, None, None] + n)
            for c, d, n in ((row, N.indices.astype(int), corner), (contact, first + contact, whole))
        ]
        i, j = (np.concatenate([pair[axis].ravel() for pair in places]) for axis in (0, 1))
        values = np.concatenate([N.data.ravel(), np.zeros(len(contact) * size**2)])
        rows = sp.csr_matrix((values, (i, j)), shape=(size * len(contact), self.matrix.getSize()[1]))
        rows.sort_indices()
        return rows

    def right_side(self, r_g: Array, r_lam: Array) -> Array:
        return np.hstack([r_g, self.row * r_lam]).ravel()

    def changes(self, x: Array, r_lam: Array) -> tuple[Array, Array]:
        x = x.reshape(self._local.shape[:2])
        return x[:, :3].copy(), x[:, 3:] / self.size
