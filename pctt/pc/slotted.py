"""The blocks of a Mat by slots, for the compression into a train.

Slots are those of ``slots.py``. An empty slot stands for a row of the identity. Block scaling uses L_i L_i' = P_ii,
where L_i^-T is the Cholesky factor of P_ii^-1. The matrix becomes I + T with T_ij = L_i^-1 P_ij L_j^-T. Only T, which
has no diagonal, is compressed. So the identity stays exact, and a train of rank zero is block Jacobi.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
from mpi4py import MPI
from petsc4py import PETSc

from pctt.block_diagonal import inverse_diagonal_blocks
from pctt.mat.product import TrainProduct
from pctt.pc.slots import Slots
from pctt.tt.train import Train

CSR = tuple[np.ndarray, np.ndarray, np.ndarray]  # row pointers, columns, values of this rank's rows


class SlottedMatrix:
    """Local block rows of a Mat P, their slots, and their scaling.

    ``scale`` reads the diagonal blocks of P. ``list_blocks``, called once per pattern, and ``load`` read all blocks.
    Both take the rows of P in CSR format (``P.getValuesCSR()``).

    Attributes
    ----------
    size : number of slots of all ranks
    places : (rows,) slot of each block row of all ranks
    rows, columns : (nb,) slots of the local off-diagonal blocks
    root : (n, bs, bs) R_i = L_i^-1 of each local block row; identities without scaling
    """

    def __init__(self, P: PETSc.Mat, slots: Slots, comm: MPI.Comm, scaled: bool):
        self.comm, self.block, self.scaled = comm, P.getBlockSize(), scaled
        count = P.getLocalSize()[0] // self.block
        self._counts = np.array(comm.allgather(count))
        self._total = int(self._counts.sum())
        self.size, self._slots = slots.size, slots.slots
        self.places = self._gathered(self._slots)
        self.root = np.tile(np.eye(self.block), (count, 1, 1))
        self._csr: tuple[np.ndarray, ...] | None = None  # the pattern that is listed

    def lists(self, csr: CSR) -> bool:
        """Whether `list_blocks` has seen this pattern; collective. A Mat may get another one with as many nonzeros."""
        same = self._csr is not None and all(map(np.array_equal, self._csr, csr[:2]))
        return self.comm.allreduce(same, op=MPI.LAND)

    def list_blocks(self, csr: CSR) -> None:
        """Find the blocks of P: ``rows`` and ``columns``."""
        self._csr = csr[:2]
        own = int(self._counts[: self.comm.rank].sum())  # the first block row of this rank
        pattern = self._pattern(csr)
        self._order = pattern.data - 1  # index of each entry of the blocks in P's values, -1 if P does not store it
        row = np.repeat(np.arange(len(self._slots)), np.diff(pattern.indptr))
        self._pointers, self._column = pattern.indptr, pattern.indices
        self._kept = pattern.indices != own + row if self.scaled else np.ones(len(row), bool)
        self.rows = self._slots[row[self._kept]]
        self.columns = self.places[pattern.indices[self._kept]]
        if not self.scaled:  # empty slots hold a multiple of the identity; each rank has a share of them
            empty = np.setdiff1d(np.arange(self.size), self.places)
            empty = np.array_split(empty, self.comm.size)[self.comm.rank]
            self._empty = len(empty)
            self.rows, self.columns = np.append(self.rows, empty), np.append(self.columns, empty)

    def scale(self, P: PETSc.Mat) -> None:
        """Compute the roots of the present diagonal blocks of P.

        Raises numpy.linalg.LinAlgError on the ranks that have a block that is not positive definite.
        """
        if not self.scaled:
            return
        self.root = np.linalg.cholesky(inverse_diagonal_blocks(P)).transpose(0, 2, 1)

    def load(self, P: PETSc.Mat, csr: CSR) -> np.ndarray:
        """The present blocks (nb, bs, bs) of P at ``rows`` and ``columns``, with scaling multiplied by the roots of
        ``scale``."""
        blocks = np.append(csr[2], 0.0)[self._order]
        if not self.scaled:
            typical = P.getDiagonal().sum() / P.getSize()[0]
            return np.concatenate([blocks, np.tile(typical * np.eye(self.block), (self._empty, 1, 1))])
        everywhere = self._gathered(self.root)
        if self.block == 1:  # scipy drops stored zeros from products of matrices of single numbers
            scaled = np.repeat(self.root, np.diff(self._pointers), axis=0) * blocks * everywhere[self._column]
            return scaled[self._kept]
        shape = (self.block * len(self._slots), self.block * self._total)
        rows = sp.bsr_matrix((blocks, self._column, self._pointers), shape=shape)
        scaled = _diagonal(self.root) @ rows @ _diagonal(everywhere.transpose(0, 2, 1))
        return scaled.data[self._kept]  # scipy keeps the order of the blocks, because each has one factor

    def _pattern(self, csr: CSR) -> sp.bsr_matrix:
        """The pattern of the blocks of this rank's rows. Its values are the numbers of P's values, from 1."""
        indptr, indices, values = csr
        shape = (len(indptr) - 1, self.block * self._total)
        numbers = np.arange(1, len(values) + 1, dtype=np.int32)
        rows = sp.csr_matrix((numbers, indices, indptr), shape=shape)
        return rows.tobsr((self.block, self.block))

    def _gathered(self, local: np.ndarray) -> np.ndarray:
        """Rows (n, ...) of all ranks, in the order of the global block rows."""
        if self.comm.size == 1:
            return local
        width = int(np.prod(local.shape[1:]))
        out = np.empty((self._total, *local.shape[1:]), local.dtype)
        self.comm.Allgatherv(np.ascontiguousarray(local), [out, self._counts * width])
        return out

    def scaled_vector(self, x: np.ndarray) -> np.ndarray:
        """This rank's part (n bs,) of L^-1 x."""
        return np.matmul(self.root, x.reshape(-1, self.block, 1)).ravel()

    def unscaled(self, z: np.ndarray) -> np.ndarray:
        """This rank's part (n bs,) of L^-T z."""
        return np.matmul(self.root.transpose(0, 2, 1), z.reshape(-1, self.block, 1)).ravel()

    def product(self, train: Train) -> TrainProduct:
        """The product with a train of the slots, with rows in the order of the Mat."""
        slots = np.add.outer(self.places * self.block, np.arange(self.block)).ravel()
        return TrainProduct(self.comm, self._counts * self.block, slots, self.size * self.block, train)


def _diagonal(blocks: np.ndarray) -> sp.bsr_matrix:
    """The block diagonal matrix of blocks (n, bs, bs)."""
    size = len(blocks) * blocks.shape[1]
    return sp.bsr_matrix((blocks, np.arange(len(blocks)), np.arange(len(blocks) + 1)), shape=(size, size))
