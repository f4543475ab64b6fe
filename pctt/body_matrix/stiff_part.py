"""The part of a body matrix that is worth factorising.

Late in an interior point iteration a third of the contacts have opened. A factor of the rest costs half and is as good
a preconditioner. This holds for incomplete factors too.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
from mpi4py import MPI
from petsc4py import PETSc

from pctt.blocks import new_matrix

EXCESS = 1.15  # largest ratio of the blocks in a kept pattern to the wanted blocks


class StiffPart:
    """An AIJ Mat with some of the blocks of a block matrix: the diagonal blocks, and those with an entry of at least
    ``least``. AIJ, because Cholesky has no code for blocks.

    The pattern is kept while it has all these blocks and few others. Then the symbolic part of a factor can be kept
    too.

    whole : the block matrix
    indptr, indices : block CSR pattern of this rank's block rows
    diagonal : indices of the diagonal blocks
    symmetric : whether the matrix is symmetric
    """

    def __init__(
        self,
        whole: PETSc.Mat,
        indptr: np.ndarray,
        indices: np.ndarray,
        diagonal: np.ndarray,
        symmetric: bool,
    ):
        self.comm: MPI.Comm = whole.comm.tompi4py()
        self._indptr, self._indices, self._diagonal = indptr, indices, diagonal
        self._size, self._sizes = whole.getBlockSize(), whole.getSizes()
        self._symmetric = symmetric
        self.mat: PETSc.Mat = None  # before the first `update`

    def update(self, values: np.ndarray, least: float) -> PETSc.Mat:
        """The Mat for the blocks ``values`` (n, size, size) of the whole matrix."""
        wanted = np.abs(values).max(axis=(1, 2), initial=0.0) >= least
        wanted[self._diagonal] = True
        if self.mat is None or not self._holds(wanted):
            self._take_pattern(wanted)
        rows = self._scalar_rows(values[self._kept])
        self.mat.setValuesCSR(rows.indptr.astype(PETSc.IntType), rows.indices.astype(PETSc.IntType), rows.data)
        self.mat.assemble()
        return self.mat

    def _holds(self, wanted: np.ndarray) -> bool:
        """Whether the kept pattern has these blocks on all ranks, and few others."""
        counts = [int((wanted & ~self._kept).sum()), int(wanted.sum()), int(self._kept.sum())]
        missing, needed, kept = self.comm.allreduce(np.array(counts))
        return bool(missing == 0 and kept <= EXCESS * needed)

    def _take_pattern(self, kept: np.ndarray) -> None:
        self.destroy()
        self._kept, before = kept, np.concatenate([[0], np.cumsum(kept)])
        self._kept_indptr = before[self._indptr].astype(PETSc.IntType)
        self._kept_indices = self._indices[kept].astype(PETSc.IntType)
        rows = self._scalar_rows(np.ones((int(kept.sum()), self._size, self._size)))
        pattern = (rows.indptr.astype(PETSc.IntType), rows.indices.astype(PETSc.IntType))
        self.mat = new_matrix(self.comm, self._sizes, self._size, pattern, PETSc.Mat.Type.AIJ)
        self.mat.setOption(PETSc.Mat.Option.SYMMETRIC, self._symmetric)

    def _scalar_rows(self, blocks: np.ndarray) -> sp.csr_matrix:
        (own, _), (_, columns) = self._sizes
        return sp.bsr_matrix((blocks, self._kept_indices, self._kept_indptr), shape=(own, columns)).tocsr()

    def destroy(self) -> None:
        if self.mat is not None:
            self.mat.destroy()
            self.mat = None
