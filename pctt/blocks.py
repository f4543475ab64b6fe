"""Distributed matrices of small dense blocks: their local rows as arrays, and PETSc Mats made of them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from mpi4py import MPI
from numpy.typing import NDArray
from petsc4py import PETSc


@dataclass(frozen=True)
class BlockRows:
    """Local block rows of G in block CSR: one row of 3 x 6 blocks per contact, one block column per body.

    Attributes
    ----------
    indptr : (nc + 1,) start of each contact's blocks
    indices : (nnz,) global block columns (bodies)
    blocks : (nnz, 3, 6)
    columns : number of block columns that this rank owns
    """

    indptr: np.ndarray
    indices: np.ndarray
    blocks: NDArray[np.float64]
    columns: int

    @property
    def rows(self) -> int:
        return len(self.indptr) - 1


def block_matrix(comm: MPI.Comm, G: BlockRows) -> PETSc.Mat:
    """G as a Mat (3Nc x 6M) of block size 3."""
    indices = (2 * G.indices[:, None] + [0, 1]).ravel()
    blocks = G.blocks.reshape(-1, 3, 2, 3).transpose(0, 2, 1, 3)
    return block_csr_matrix(comm, 3 * G.rows, 6 * G.columns, 2 * G.indptr, indices, blocks)


def square_block_matrix(comm: MPI.Comm, rows: sp.bsr_matrix) -> PETSc.Mat:
    """A square Mat of block size 3 from this rank's block rows (3nc x 3Nc)."""
    shape = (rows.shape[0] // 3, rows.shape[1] // 3)
    columns = rows.indices.copy()  # sorted in place
    order = sp.csr_matrix((np.arange(len(columns)), columns, rows.indptr), shape=shape)
    order.sort_indices()  # PETSc wants sorted columns; sorting positions is much faster than sorting blocks
    count = rows.shape[0]
    return block_csr_matrix(comm, count, count, rows.indptr, order.indices, rows.data[order.data])


def block_csr_matrix(
    comm: MPI.Comm, rows: int, columns: int, indptr: np.ndarray, indices: np.ndarray, blocks: NDArray[np.float64]
) -> PETSc.Mat:
    """A BAIJ Mat of block size 3 from local block CSR arrays; ``rows`` and ``columns`` are local scalar sizes."""
    csr = (indptr.astype(PETSc.IntType), indices.astype(PETSc.IntType), np.ascontiguousarray(blocks).ravel())
    size = ((rows, PETSc.DETERMINE), (columns, PETSc.DETERMINE))
    mat = PETSc.Mat().create(comm)
    mat.setSizes(size)
    mat.setBlockSize(3)
    mat.setType(PETSc.Mat.Type.BAIJ)
    mat.setPreallocationCSR(csr)
    return mat
