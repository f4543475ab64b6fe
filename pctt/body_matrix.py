"""The Newton matrix in the velocities of the bodies, K = I + G' H G: a 6 x 6 block per body and per pair in contact.

G is the mass-scaled contact map (3Nc x 6M), H = (B + C)^-1 block diagonal with a 3 x 3 block per contact. Products of K
are those of the map. Preconditioners that need entries get a matrix, and factorisations the part of it that is worth
factorising: late in an interior point iteration a third of the contacts have opened, and a factor of the rest costs
half and is as good a preconditioner.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from dem.compiled import loop
from dem.contact_map import BlockRows, ContactMap
from dem.exchange import exchange, offsets
from pctt.blocks import Array, new_matrix, set_diagonal_blocks, symmetric_shell


def inverse_blocks(blocks: Array) -> Array:
    """The inverses of positive definite blocks (nc, 3, 3), also of those that rounding has made singular."""
    floor = 1e-14 * np.trace(blocks, axis1=1, axis2=2)  # some tens of roundings of the largest entry
    return np.linalg.inv(blocks + floor[:, None, None] * np.eye(3))


class BodyOperator:
    """K for a sequence of contact maps with the same structure.

    Attributes
    ----------
    mat : K as a shell of block size 6
    """

    def __init__(self, contact_map: ContactMap):
        self._matrix: BodyMatrix | None = None
        self.load(contact_map)
        self.mat = symmetric_shell(contact_map.comm, 6 * contact_map.columns, 6, self._product)
        self._x, self._y = self.mat.createVecs()

    def load(self, contact_map: ContactMap) -> None:
        """Take another map of the same structure."""
        self.contact_map, self._loaded = contact_map, False

    def update(self, inverse: Array, symmetric: bool = True) -> None:
        """Take the blocks H (nc, 3, 3) of K, which may be unsymmetric, or those (nc, 6, 6) of contacts with moments: K
        is then multiplied by its entries, as no loop has these blocks."""
        self._inverse, self._made = inverse, False
        if inverse.shape[1] == 3:
            self._weight = self.contact_map.weights(inverse, symmetric)
            set_diagonal_blocks(self.mat, self.contact_map.body_blocks(self._weight), symmetric)
        else:
            set_diagonal_blocks(self.mat, self.entries().diagonal_blocks, symmetric)

    def _product(self, v: Array, out: Array) -> None:
        if self._inverse.shape[1] == 3:
            self.contact_map.through(self._weight, v, out)
        else:
            self._x.array[:] = v.ravel()
            self.entries().mat.mult(self._x, self._y)
            out[:] = self._y.array_r.reshape(out.shape)

    def entries(self) -> BodyMatrix:
        """The entries of K with its present values; collective."""
        if self._matrix is None:
            parts = self._inverse.shape[1] // 3
            self._matrix = BodyMatrix(self.contact_map.comm, self.contact_map.block_rows, parts)
        elif not self._loaded:
            self._matrix.load(self.contact_map.block_rows)
        if not self._made:
            self._matrix.update(self._inverse)
        self._loaded = self._made = True
        return self._matrix

    def destroy(self) -> None:
        for thing in (self.mat, self._x, self._y):
            thing.destroy()
        if self._matrix is not None:
            self._matrix.destroy()


class Part(NamedTuple):
    """Rows of a matrix in block CSR format, every diagonal block among the ``blocks`` (nnz, 6, 6); global columns."""

    indptr: np.ndarray
    indices: np.ndarray
    blocks: Array


class BodyMatrix:
    """The blocks of K in this rank's block rows, and Mats made from them.

    Each rank multiplies the rows of its own contacts. It sends the blocks of bodies that other ranks own to these
    ranks, by a pattern that is computed once. The blocks are always added in the same order.

    parts : block rows of G for each contact, which are so many times as many as contacts: 2 with moments
    """

    def __init__(self, comm: MPI.Comm, G: BlockRows, parts: int = 1):
        self.comm, self._parts = comm, parts
        self._whole: PETSc.Mat | None = None
        # 64 bits, because each pair of bodies gets a number
        self.bodies, column = np.unique(np.asarray(G.indices, np.int64), return_inverse=True)
        self._column = column.ravel()
        self.load(G)
        self._index(G)

    def load(self, G: BlockRows) -> None:
        """Take a G of the same structure."""
        self.G, self._blocks = G, np.ascontiguousarray(G.blocks)

    def _product(self, inverse: Array) -> Array:
        """The blocks of G' H G of the contacts and bodies of this rank, for the blocks H (nc, 3 parts, 3 parts)."""
        out = np.zeros((self._pairs, 6, 6))
        _add_products(self._starts, self._blocks, np.ascontiguousarray(inverse), self._place, out)
        return out

    def _index(self, G: BlockRows) -> None:
        """Find the owners of the blocks to which this rank's contacts contribute, and the pattern of the own rows."""
        starts = offsets(self.comm, G.columns)
        self._first, own = int(starts[self.comm.rank]), G.columns
        self._starts = np.asarray(G.indptr, np.int64)
        pairs, place = np.unique(_pairs(self._starts, self._column, self._parts), return_inverse=True)
        self._place, self._pairs = place.ravel(), len(pairs)
        row, column = (self.bodies[each] for each in np.divmod(pairs, max(len(self.bodies), 1)))
        self._owner = np.searchsorted(starts, row, side="right") - 1
        self._away = self._owner != self.comm.rank
        home, diagonal = ~self._away, self._first + np.arange(own)
        away = {"row": row[self._away], "column": column[self._away]}
        received = exchange(self.comm, away, self._owner[self._away])
        self._total = max(int(starts[-1]), 1)
        named = ((row[home], column[home]), (received["row"], received["column"]), (diagonal, diagonal))
        names = [r * self._total + c for r, c in named]
        every = np.unique(np.concatenate(names))
        self._own_places, self._received_places, self._diagonal = (np.searchsorted(every, n) for n in names)
        self._row, self._indices = np.divmod(every, self._total)
        self._sizes = ((6 * own, PETSc.DETERMINE), (6 * own, PETSc.DETERMINE))

    def update(self, inverse: Array) -> None:
        """Compute K for the blocks H (nc, 3 parts, 3 parts)."""
        blocks = self._product(inverse)
        self._values = np.zeros((len(self._indices), 6, 6))
        self._values[self._own_places] = blocks[~self._away] if self._away.any() else blocks
        if self.comm.size > 1:
            received = exchange(self.comm, {"blocks": blocks[self._away]}, self._owner[self._away])
            np.add.at(self._values, self._received_places, received["blocks"])
        self._values[self._diagonal] += np.eye(6)
        self._current = False

    @property
    def diagonal_blocks(self) -> Array:
        """Those of this rank's bodies (n, 6, 6)."""
        blocks: Array = self._values[self._diagonal]
        return blocks

    def _indptr(self, rows: np.ndarray) -> np.ndarray:
        """Where each of this rank's block rows begins in the sorted ``rows`` of blocks."""
        return np.searchsorted(rows, self._first + np.arange(len(self._diagonal) + 1))

    @property
    def mat(self) -> PETSc.Mat:
        """K as a BAIJ Mat of block size 6, with the present values; collective."""
        pattern = [x.astype(PETSc.IntType) for x in (self._indptr(self._row), self._indices)]
        if self._whole is None:
            self._whole = new_matrix(self.comm, self._sizes, 6, tuple(pattern))
            self._whole.setOption(PETSc.Mat.Option.SYMMETRIC, True)
        if not self._current:
            if len(self._indices):
                self._whole.setValuesBlockedCSR(*pattern, self._values.ravel())
            self._whole.assemble()
            self._current = True
        return self._whole

    def stiff_part(self, least: float) -> Part:
        """This rank's rows of K without the blocks between two bodies whose entries are all below ``least`` (in units
        of the mass)."""
        kept = np.abs(self._values).max(axis=(1, 2), initial=0.0) >= least
        kept[self._diagonal] = True
        return Part(self._indptr(self._row[kept]), self._indices[kept], self._values[kept])

    def places(self, points: Array) -> Array:
        """Places (n, 3) of this rank's bodies: the means of their contact points. ``points`` (nc, 3); collective."""
        sums = PETSc.Vec().createMPI(self._sizes[0], bsize=6, comm=self.comm)  # of points, and their number
        if len(points):
            contact = np.repeat(np.arange(len(points)), np.diff(self.G.indptr))
            index = 6 * np.asarray(self.G.indices)[:, None] + np.arange(4)
            values = np.column_stack([points[contact], np.ones(len(contact))])
            sums.setValues(index.astype(PETSc.IntType).ravel(), values.ravel(), PETSc.InsertMode.ADD_VALUES)
        sums.assemble()
        found = sums.array_r.reshape(-1, 6)
        places = found[:, :3] / np.maximum(found[:, 3:4], 1)
        sums.destroy()
        return places

    def destroy(self) -> None:
        if self._whole is not None:
            self._whole.destroy()


@loop
def _pairs(starts, column, parts):
    """Of each pair of blocks of a contact, in the order of `_add_products`, the row and the column as one number."""
    count, bodies, k = (len(starts) - 1) // parts, 0, 0
    for each in column:
        bodies = max(bodies, each + 1)
    for c in range(count):
        blocks = 0
        for p in range(parts):
            blocks += starts[p * count + c + 1] - starts[p * count + c]
        k += blocks * blocks
    out, k = np.empty(k, np.int64), 0
    for c in range(count):
        for p in range(parts):
            for f in range(starts[p * count + c], starts[p * count + c + 1]):
                for q in range(parts):
                    for e in range(starts[q * count + c], starts[q * count + c + 1]):
                        out[k] = column[e] * bodies + column[f]
                        k += 1
    return out


@loop
def _add_products(starts, blocks, H, place, out):
    """out += the blocks of G' H G, for block rows of G from ``starts`` on and blocks H (nc, 3 parts, 3 parts)."""
    count, parts, k, HG = len(H), H.shape[1] // 3, 0, np.empty((3, 6))
    for c in range(count):
        for p in range(parts):
            for f in range(starts[p * count + c], starts[p * count + c + 1]):
                for q in range(parts):
                    for i in range(3):
                        x, y, z = H[c, 3 * q + i, 3 * p], H[c, 3 * q + i, 3 * p + 1], H[c, 3 * q + i, 3 * p + 2]
                        for n in range(6):
                            HG[i, n] = x * blocks[f, 0, n] + y * blocks[f, 1, n] + z * blocks[f, 2, n]
                    for e in range(starts[q * count + c], starts[q * count + c + 1]):
                        to = out[place[k]]
                        k += 1
                        for m in range(6):
                            x, y, z = blocks[e, 0, m], blocks[e, 1, m], blocks[e, 2, m]
                            for n in range(6):
                                to[m, n] += x * HG[0, n] + y * HG[1, n] + z * HG[2, n]
