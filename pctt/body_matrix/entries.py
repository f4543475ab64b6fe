"""The Newton matrix in the velocities of the bodies, K = I + G' B^-1 G: a 6 x 6 block per body and per pair in contact.

G is the mass-scaled contact map (3Nc x 6M) in block rows (`BlockRows`). B is block diagonal with a 3 x 3
block per contact. Each rank multiplies the rows of its own contacts. It sends the blocks of bodies that other ranks own
to these ranks, by a pattern that is computed once. The blocks are always added in the same order.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
from mpi4py import MPI
from petsc4py import PETSc

from dem.contact_map import BlockRows
from dem.exchange import exchange, offsets
from pctt.block_diagonal import set_diagonal_blocks
from pctt.blocks import new_matrix
from pctt.body_matrix.stiff_part import StiffPart

ADD = PETSc.InsertMode.ADD_VALUES


class BodyMatrix:
    """K as a Mat of block size 6 (``mat``), and its ``stiff_part``, which factorisations use."""

    def __init__(self, comm: MPI.Comm, G: BlockRows):
        self.comm = comm
        # 64 bits, because each pair of bodies gets a number
        self.bodies, column = np.unique(np.asarray(G.indices, np.int64), return_inverse=True)
        self._column = column.ravel()
        self.load(G)
        self._index(G)

    def load(self, G: BlockRows) -> None:
        """Take a G of the same structure."""
        self.G = G
        shape = (3 * G.rows, 6 * len(self.bodies))
        self._rows = sp.bsr_matrix((G.blocks, self._column, G.indptr), shape=shape) if len(G.blocks) else None
        self._columns = None if self._rows is None else self._rows.T.tobsr()

    def _product(self, inverse: np.ndarray) -> sp.bsr_matrix:
        """G' B^-1 G of the contacts and bodies of this rank, for the blocks B^-1 (nc, 3, 3)."""
        if self._columns is None:
            return sp.bsr_matrix((0, 0), blocksize=(6, 6))
        count = len(inverse)
        weight = sp.bsr_matrix((inverse, np.arange(count), np.arange(count + 1)), shape=(3 * count, 3 * count))
        return self._columns @ (weight @ self._rows)

    def _index(self, G: BlockRows) -> None:
        """Find the owners of the blocks to which this rank's contacts contribute, and the pattern of the own rows."""
        starts = offsets(self.comm, G.columns)
        first, own = int(starts[self.comm.rank]), G.columns
        local = self._product(np.tile(np.eye(3), (G.rows, 1, 1)))
        row = np.repeat(self.bodies, np.diff(local.indptr))
        column = self.bodies[local.indices]
        self._owner = np.searchsorted(starts, row, side="right") - 1
        self._away = self._owner != self.comm.rank
        home = ~self._away
        away = {"row": row[self._away], "column": column[self._away]}
        received = exchange(self.comm, away, self._owner[self._away]).values()
        diagonal = np.arange(first, first + own)
        total = max(int(starts[-1]), 1)
        names = [r * total + c for r, c in ((row[home], column[home]), received, (diagonal, diagonal))]
        every = np.unique(np.concatenate(names))
        self._own_places, self._received_places, self._diagonal_places = (np.searchsorted(every, n) for n in names)
        row, column = np.divmod(every, total)
        indptr = np.searchsorted(row, np.arange(first, first + own + 1))
        self._indptr, self._indices = indptr.astype(PETSc.IntType), column.astype(PETSc.IntType)
        sizes = ((6 * own, PETSc.DETERMINE), (6 * own, PETSc.DETERMINE))
        self.mat = new_matrix(self.comm, sizes, 6, (self._indptr, self._indices))
        self.mat.setOption(PETSc.Mat.Option.SYMMETRIC, True)
        self._stiff: dict[bool, StiffPart] = {}  # by whether it is symmetric

    def update(self, inverse: np.ndarray) -> None:
        """Compute K for the blocks B^-1 (nc, 3, 3)."""
        blocks = self._product(inverse).data.reshape(-1, 6, 6)
        self._values = np.zeros((len(self._indices), 6, 6))
        self._values[self._own_places] = blocks[~self._away] if self._away.any() else blocks
        if self.comm.size > 1:
            received = exchange(self.comm, {"block": blocks[self._away]}, self._owner[self._away])
            np.add.at(self._values, self._received_places, received["block"])
        self._values[self._diagonal_places] += np.eye(6)
        if len(self._indices):
            self.mat.setValuesBlockedCSR(self._indptr, self._indices, self._values.ravel())
        self.mat.assemble()
        set_diagonal_blocks(self.mat, self._values[self._diagonal_places])

    def stiff_part(self, least: float, symmetric: bool = True) -> PETSc.Mat:
        """K without the blocks between two bodies whose entries are all below ``least`` (in units of the mass), as AIJ.

        The Mat is kept and gets new values at the next call; there is one for each value of ``symmetric``.
        """
        if symmetric not in self._stiff:
            self._stiff[symmetric] = StiffPart(
                self.mat, self._indptr, self._indices, self._diagonal_places, symmetric
            )
        return self._stiff[symmetric].update(self._values, least)

    def places(self, points: np.ndarray) -> np.ndarray:
        """Places (n, 3) of this rank's bodies: the means of their contact points. ``points`` (nc, 3); collective."""
        sums = self.mat.createVecRight()
        counts = sums.duplicate()
        if len(points):
            contact = np.repeat(np.arange(len(points)), np.diff(self.G.indptr))
            body = np.asarray(self.G.indices, np.int64)
            index = (6 * body[:, None] + np.arange(3)).astype(PETSc.IntType)
            sums.setValues(index.ravel(), points[contact].ravel(), ADD)
            counts.setValues(index.ravel(), np.ones(index.size), ADD)
        for vec in (sums, counts):
            vec.assemble()
        places = sums.array_r.reshape(-1, 6)[:, :3] / np.maximum(counts.array_r.reshape(-1, 6)[:, :3], 1)
        sums.destroy()
        counts.destroy()
        return places

    def destroy(self) -> None:
        self.mat.destroy()
        for part in self._stiff.values():
            part.destroy()
