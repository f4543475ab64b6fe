"""The Delassus matrix: as it was given, or N = G G' from the block rows of G, over the ranks.

PETSc multiplies only scalar formats; on one block row per contact scipy's block product is several times
faster (n = 16, 134,547 contacts, one core: 0.45 s against 1.4 s and a slow conversion), so each rank
multiplies its own block rows and PETSc gets the finished block CSR arrays. A row of N needs all contacts of
its two bodies: those of other ranks come through the owners of the bodies' columns.
"""

from __future__ import annotations

import copy

import numpy as np
import scipy.sparse as sp
from mpi4py import MPI
from petsc4py import PETSc

from pctt.blocks import BlockRows, block_csr_matrix, shaped, square_block_matrix
from pctt.ccp.cone import Array
from pctt.exchange import offsets, send_rows


def rows_in_blocks(N: PETSc.Mat) -> sp.bsr_matrix:
    """This rank's rows of a Mat of type AIJ, BAIJ, SBAIJ or dense in 3 x 3 blocks, their columns global."""
    plain = N.getType() in ("seqaij", "mpiaij", "seqbaij", "mpibaij")
    rows = N if plain else N.convert(PETSc.Mat.Type.AIJ, PETSc.Mat())
    indptr, indices, values = rows.getValuesCSR()
    if not plain:
        rows.destroy()
    shape = (N.getLocalSize()[0], N.getSize()[1])
    return sp.csr_matrix((values, indices, indptr), shape=shape).tobsr((3, 3))


class GivenMatrix:
    """N itself, of a problem that knows no bodies, with the members of `ContactMap` that it can have: impulses take the
    place of momenta, and N g that of the velocities of contacts. A copy in 3 x 3 blocks (BAIJ) of a Mat of type AIJ,
    BAIJ, SBAIJ or dense. ValueError on all ranks if it has a NaN or an infinite number."""

    def __init__(self, comm: MPI.Comm, N: PETSc.Mat):
        rows = rows_in_blocks(N)
        if comm.allreduce(not np.isfinite(rows.data).all(), MPI.LOR):
            raise ValueError("N has a NaN or an infinite number")
        self.rows, self._first = len(rows.indptr) - 1, N.getOwnershipRange()[0] // 3
        self._local: sp.bsr_matrix = rows
        self._size: Array | float = 1.0
        self.mat = square_block_matrix(comm, rows)
        self._in, self._out = self.mat.createVecs()

    def velocities(self, g: Array) -> Array:
        """N g (nc, 3)."""
        self._in.array[:] = shaped("impulses", g, self.rows, 3).ravel()
        self.mat.mult(self._in, self._out)
        return self._out.array.reshape(-1, 3).copy()

    def momenta(self, g: Array) -> Array:
        """g (nc, 3)."""
        return shaped("impulses", g, self.rows, 3).copy()

    def add_delassus(self, g: Array, y: Array) -> None:
        """y += N g; y (nc, 3)."""
        y += self._size * self.velocities(self._size * g)

    def contact_blocks(self) -> Array:
        """The diagonal blocks of N (nc, 3, 3)."""
        row = np.repeat(np.arange(self.rows), np.diff(self._local.indptr))
        near = self._first + row == self._local.indices
        out = np.zeros((self.rows, 3, 3))
        out[row[near]] = self._local.data[near]
        return out

    def scaled(self, size: Array, precision: type[np.floating] = np.float64) -> GivenMatrix:
        """N with rows and columns multiplied by ``size`` (nc, 3), for products with impulses of this precision; it is
        valid until this object is destroyed."""
        other = copy.copy(self)
        other._size = size.astype(precision, copy=False)
        return other

    def structure(self) -> tuple[np.ndarray, ...]:
        """Arrays of this rank that are equal where the places of the blocks are."""
        return self._local.indptr, self._local.indices

    def destroy(self) -> None:
        for thing in (self.mat, self._in, self._out):
            thing.destroy()


def delassus(comm: MPI.Comm, G: BlockRows) -> PETSc.Mat:
    """N = G G' as a Mat (3Nc x 3Nc) of block size 3, rows distributed as those of G."""
    first = offsets(comm, G.rows)[comm.rank]
    contact = np.repeat(np.arange(first, first + G.rows), np.diff(G.indptr))
    bodies, column = np.unique(G.indices, return_inverse=True)
    left = sp.bsr_matrix((G.blocks, column, G.indptr), shape=(3 * G.rows, 6 * len(bodies)))
    if comm.size == 1:
        right, names = left, np.arange(G.rows)
    else:
        far_contact, far_body, far_blocks = _neighbours(comm, G, contact, bodies)
        all_contacts = np.concatenate([contact, far_contact])
        all_columns = np.concatenate([column, np.searchsorted(bodies, far_body)])
        names, row = np.unique(all_contacts, return_inverse=True)
        order = np.lexsort((all_columns, row))
        indptr = np.concatenate([[0], np.cumsum(np.bincount(row, minlength=len(names)))])
        right = sp.bsr_matrix(
            (np.concatenate([G.blocks, far_blocks])[order], all_columns[order], indptr),
            shape=(3 * len(names), 6 * len(bodies)),
        )
    total = comm.allreduce(G.rows)
    if G.rows == 0:
        return block_csr_matrix(comm, 0, 0, np.zeros(1), np.zeros(0), np.zeros((0, 3, 3)))
    near = left @ right.T
    # contacts of bodies that are not in G (fixed, or kept apart) need a diagonal block all the same
    lonely = np.flatnonzero(np.diff(G.indptr) == 0)
    columns = np.insert(names[near.indices] if len(near.indices) else near.indices, near.indptr[lonely], first + lonely)
    blocks = np.insert(near.data.reshape(-1, 3, 3), near.indptr[lonely], 0.0, axis=0)
    indptr = near.indptr + np.searchsorted(lonely, np.arange(G.rows + 1))
    shape = (3 * G.rows, 3 * total)
    return square_block_matrix(comm, sp.bsr_matrix((blocks, columns, indptr), shape=shape))


def _neighbours(
    comm: MPI.Comm, G: BlockRows, contact: np.ndarray, bodies: np.ndarray
) -> tuple[np.ndarray, np.ndarray, Array]:
    """Blocks of G of other ranks in the columns ``bodies`` that this rank touches: contact, body, block."""
    starts = offsets(comm, G.columns)
    owner = np.searchsorted(starts, G.indices, side="right") - 1
    away = owner != comm.rank
    entries = (contact, G.indices, G.blocks)
    # to the owners of the bodies ...
    (contact_in, body_in, blocks_in), source_in = send_rows(comm, [e[away] for e in entries], owner[away])
    # ... who hold all blocks of a column, and answer each rank that touches it with those of the others
    home = ~away
    all_contact = np.concatenate([contact[home], contact_in])
    all_body = np.concatenate([G.indices[home], body_in])
    all_blocks = np.concatenate([G.blocks[home], blocks_in])
    source = np.concatenate([np.full(home.sum(), comm.rank), source_in])
    order = np.argsort(all_body, kind="stable")
    sorted_body = all_body[order]
    asked = np.unique(np.stack([body_in, source_in], axis=1), axis=0)  # (body, asking rank)
    begin = np.searchsorted(sorted_body, asked[:, 0], side="left")
    count = np.searchsorted(sorted_body, asked[:, 0], side="right") - begin
    shift = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
    pick = order[np.repeat(begin, count) + shift]
    asking = np.repeat(asked[:, 1], count)
    useful = source[pick] != asking
    pick, asking = pick[useful], asking[useful]
    answer, _ = send_rows(comm, [all_contact[pick], all_body[pick], all_blocks[pick]], asking)
    touched = np.isin(body_in, bodies)  # an owner may have no contact of its own at a body
    own = (contact_in[touched], body_in[touched], blocks_in[touched])
    return tuple(np.concatenate(pair) for pair in zip(answer, own))  # type: ignore[return-value]
