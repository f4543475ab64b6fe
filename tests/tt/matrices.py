"""Sparse test matrices as triplets of blocks, and their dense form."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy.sparse as sp
from mpi4py import MPI

from pctt import tt


class Triplets(NamedTuple):
    rows: np.ndarray
    columns: np.ndarray
    blocks: np.ndarray  # (nb, b, b)
    slots: int

    def dense(self, slots: int | None = None) -> np.ndarray:
        n, b = slots or self.slots, self.blocks.shape[1]
        out = np.zeros((n, b, n, b))
        np.add.at(out, (self.rows, slice(None), self.columns), self.blocks.astype(float))
        return out.reshape(n * b, n * b)

    def hierarchy(self, modes: tuple[int, ...], keep: slice | np.ndarray = slice(None), **options: object):
        A = tt.SparseHierarchy(
            self.rows[keep], self.columns[keep], modes, self.blocks.shape[1], **options  # type: ignore[arg-type]
        )
        A.set_values(self.blocks[keep])
        return A

    def part(self, modes: tuple[int, ...], bounds: list[int] | np.ndarray):
        """On several ranks: rank r has the rows from bounds[r - 1] to bounds[r]."""
        comm = MPI.COMM_WORLD
        owner = np.searchsorted(bounds[: comm.size - 1], self.rows, "right")
        return self.hierarchy(modes, owner == comm.rank, reduce=comm.allreduce, agree=comm.bcast)


def scattered(rng: np.random.Generator, slots: int, number: int, block: int) -> Triplets:
    """Random blocks at random places, which may coincide."""
    rows, columns = rng.integers(0, slots, (2, number))
    return Triplets(rows, columns, rng.standard_normal((number, block, block)), slots)


def positive(rng: np.random.Generator, slots: int, block: int, reach: int = 3) -> Triplets:
    """Symmetric positive definite, with random blocks between neighbours: I + 0.3 of a matrix of norm below 1."""
    i, j = np.nonzero(np.abs(np.subtract.outer(np.arange(slots), np.arange(slots))) <= reach)
    A = np.zeros((slots, block, slots, block))
    A[i, :, j, :] = rng.standard_normal((len(i), block, block))
    A = A.reshape(slots * block, -1)
    A = A + A.T
    A = np.eye(len(A)) + 0.3 * A / np.linalg.norm(A, 2)
    return Triplets(i, j, A.reshape(slots, block, slots, block)[i, :, j, :], slots)


def of_sparse(matrix: sp.spmatrix) -> Triplets:
    """Blocks of size 1."""
    coo = sp.coo_matrix(matrix)
    return Triplets(coo.row, coo.col, coo.data.reshape(-1, 1, 1).astype(float), coo.shape[0])


def laplacian(n: int) -> sp.spmatrix:
    return sp.diags([-np.ones(n - 1), 2 * np.ones(n), -np.ones(n - 1)], [-1, 0, 1])
