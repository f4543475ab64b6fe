"""Distributed matrices of small dense blocks: the local rows as arrays, and PETSc Mats made from them."""

from __future__ import annotations

import operator
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.sparse as sp
from mpi4py import MPI
from numpy.typing import NDArray
from petsc4py import PETSc

Array = NDArray[np.float64]


@dataclass(frozen=True)
class BlockRows:
    """Local block rows of G in block CSR format: one row of 3 x 6 blocks per contact, one block column per body.

    Attributes
    ----------
    indptr : (nc + 1,) index of the first block of each contact, and the number of blocks
    indices : (nnz,) global block columns (bodies)
    blocks : (nnz, 3, 6)
    columns : number of block columns that this rank owns
    """

    indptr: np.ndarray
    indices: np.ndarray
    blocks: Array
    columns: int

    @property
    def rows(self) -> int:
        return len(self.indptr) - 1


def shaped(name: str, x: Array, rows: int, width: int) -> Array:
    """x as an array (rows, width), of this shape or flat. ValueError for others, on this rank alone: products are too
    frequent to ask the other ranks."""
    if x.shape not in ((rows, width), (rows * width,)):
        raise ValueError(f"{name} of the shape {x.shape}; allowed is {(rows, width)}")
    return x.reshape(rows, width)


HUB = 500  # a body with more contacts is a hub: its columns of G would fill N


def without_hubs(comm: MPI.Comm, G: BlockRows) -> tuple[BlockRows, np.ndarray]:
    """G without the columns of the bodies that have more than HUB contacts, and these bodies (global block columns)."""
    bodies, count = np.unique(G.indices, return_counts=True)
    columns = comm.allreduce(G.columns)
    # a body with more than HUB contacts has more than HUB / ranks on some rank
    often = comm.allreduce(set(bodies[count > HUB / comm.size].tolist()), op=operator.or_)
    candidates = np.array(sorted(often), dtype=np.int64)
    here = np.bincount(G.indices, minlength=columns)[candidates]
    hubs = candidates[comm.allreduce(here) > HUB]
    if len(hubs) == 0:
        return G, hubs
    kept = ~np.isin(G.indices, hubs)
    before = np.concatenate([[0], np.cumsum(kept)])
    return BlockRows(before[G.indptr], G.indices[kept], G.blocks[kept], G.columns), hubs


def diagonal_blocks(G: BlockRows) -> Array:
    """The diagonal blocks of G G' (nc, 3, 3)."""
    products = G.blocks @ G.blocks.transpose(0, 2, 1)
    shape = (G.rows, len(products))
    add = sp.csr_matrix((np.ones(len(products)), np.arange(len(products)), G.indptr), shape=shape)
    return (add @ products.reshape(-1, 9)).reshape(-1, 3, 3)


def block_matrix(comm: MPI.Comm, G: BlockRows) -> PETSc.Mat:
    """G as a Mat (3Nc x 6M) with block size 3."""
    indices = (2 * G.indices[:, None] + [0, 1]).ravel()
    blocks = G.blocks.reshape(-1, 3, 2, 3).transpose(0, 2, 1, 3)
    return block_csr_matrix(comm, 3 * G.rows, 6 * G.columns, 2 * G.indptr, indices, blocks)


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
