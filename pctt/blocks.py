"""PETSc Mats of small dense blocks, distributed by rows, from arrays."""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy.sparse as sp
from mpi4py import MPI
from numpy.typing import NDArray
from petsc4py import PETSc

Array = NDArray[np.float64]


def square_block_matrix(comm: MPI.Comm, rows: sp.bsr_matrix) -> PETSc.Mat:
    """A square Mat from this rank's block rows (b nc x b Nc); b is the block size of the rows and of the Mat."""
    size = rows.blocksize[0]
    shape = (rows.shape[0] // size, rows.shape[1] // size)
    columns = rows.indices.copy()  # the sort below changes them in place
    order = sp.csr_matrix((np.arange(len(columns)), columns, rows.indptr), shape=shape)
    order.sort_indices()  # PETSc needs sorted columns; sorting positions is much faster than sorting blocks
    count = rows.shape[0]
    return block_csr_matrix(comm, count, count, rows.indptr, order.indices, rows.data[order.data])


def block_csr_matrix(
    comm: MPI.Comm, rows: int, columns: int, indptr: np.ndarray, indices: np.ndarray, blocks: Array
) -> PETSc.Mat:
    """A BAIJ Mat from local block CSR arrays with ``blocks`` (nb, b, b).

    ``rows`` and ``columns`` are the local sizes in scalar rows and columns.
    """
    csr = (indptr.astype(PETSc.IntType), indices.astype(PETSc.IntType), np.ascontiguousarray(blocks).ravel())
    return new_matrix(comm, ((rows, PETSc.DETERMINE), (columns, PETSc.DETERMINE)), blocks.shape[-1], csr)


def new_matrix(
    comm: MPI.Comm, sizes: Any, block: int, csr: tuple[np.ndarray, ...], kind: str = PETSc.Mat.Type.BAIJ
) -> PETSc.Mat:
    """A Mat of this type with the pattern ``csr`` of the local rows, and its values if they are the third array."""
    mat = PETSc.Mat().create(comm)
    mat.setSizes(sizes)
    mat.setBlockSize(block)
    mat.setType(kind)
    mat.setPreallocationCSR(csr)
    return mat
