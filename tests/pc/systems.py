"""Matrices of contacts, and small dense ones."""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
from mpi4py import MPI
from petsc4py import PETSc

from dem.contact_map import BlockRows
from pctt.blocks import square_block_matrix


def contacts(count: int, bodies: int, seed: int = 0) -> tuple[BlockRows, np.ndarray]:
    """A random contact map on one rank (contacts of two bodies, some of one) and barrier blocks."""
    rng = np.random.default_rng(seed)
    pairs = np.stack([rng.permutation(bodies)[:2] for _ in range(count)])
    single = rng.random(count) < 0.2
    indptr = np.concatenate([[0], np.cumsum(np.where(single, 1, 2))])
    keep = np.stack([np.ones(count, bool), ~single], axis=1)
    indices = np.sort(pairs, axis=1)[keep]
    root = rng.standard_normal((count, 3, 3))
    barrier = root @ root.transpose(0, 2, 1) + 0.1 * np.eye(3)
    return BlockRows(indptr, indices, rng.standard_normal((len(indices), 3, 6)), bodies), barrier


def contact_matrix(G: BlockRows, barrier: np.ndarray) -> PETSc.Mat:
    """S = G G' + B, BAIJ of block size 3."""
    rows = sp.bsr_matrix((G.blocks, G.indices, G.indptr), shape=(3 * G.rows, 6 * G.columns))
    B = sp.bsr_matrix((barrier, np.arange(G.rows), np.arange(G.rows + 1)))
    return square_block_matrix(MPI.COMM_WORLD, sp.bsr_matrix(rows @ rows.T + B, blocksize=(3, 3)))


def dense(mat: PETSc.Mat) -> np.ndarray:
    """All of a sequential Mat."""
    copy = mat.convert("dense", PETSc.Mat())
    return copy.getDenseArray().copy()


def spd(size: int, seed: int) -> np.ndarray:
    """A well-conditioned symmetric positive definite matrix without zeros."""
    root = np.random.default_rng(seed).standard_normal((size, size))
    return root @ root.T + size * np.eye(size)
