"""The Newton matrix in the bodies' velocities, K = I + G' B^-1 G, a 6 x 6 block per body and per pair in contact.

G is the mass-scaled contact map (3Nc x 6M) in block rows (``pctt.blocks.BlockRows``), B block diagonal with a 3 x 3
block per contact. Each rank multiplies its own contacts' rows; PETSc adds the blocks of bodies that other ranks own.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
from petsc4py import PETSc

from pctt.blocks import BlockRows

ADD = PETSc.InsertMode.ADD_VALUES


class BodyMatrix:
    """K as a Mat of block size 6 (``mat``), and ``enlarged``, a copy with its diagonal blocks multiplied by 1 + shift,
    which incomplete factorisations need: without, they break down late in an interior point iteration."""

    def __init__(self, comm: PETSc.Comm, G: BlockRows):
        self.load(G)
        self.mat = _structure(comm, G)
        first, last = self.mat.getOwnershipRange()
        self._own = np.arange(first // 6, last // 6, dtype=PETSc.IntType)[:, None]
        self._ones = np.tile(np.eye(6).ravel(), (len(self._own), 1))
        self._enlarged: PETSc.Mat | None = None

    def load(self, G: BlockRows) -> None:
        """Take a G of the same structure."""
        self.bodies, column = np.unique(G.indices, return_inverse=True)
        shape = (3 * G.rows, 6 * len(self.bodies))
        self._rows = sp.bsr_matrix((G.blocks, column, G.indptr), shape=shape) if len(G.blocks) else None
        self._columns = None if self._rows is None else self._rows.T.tobsr()

    def update(self, inverse: np.ndarray) -> None:
        """K for the blocks B^-1 (nc, 3, 3)."""
        self.mat.zeroEntries()
        if self._rows is not None:
            count = len(inverse)
            weight = sp.bsr_matrix((inverse, np.arange(count), np.arange(count + 1)), shape=(3 * count, 3 * count))
            local = self._columns @ (weight @ self._rows)
            indptr, indices = local.indptr.astype(PETSc.IntType), self.bodies[local.indices].astype(PETSc.IntType)
            self.mat.setValuesBlockedIJV(indptr, indices, local.data.ravel(), ADD, self.bodies.astype(PETSc.IntType))
        if len(self._own):
            self.mat.setValuesBlockedRCV(self._own, self._own, self._ones, ADD)
        self.mat.assemble()

    def enlarged(self, shift: float) -> PETSc.Mat:
        """A copy of K whose diagonal blocks are multiplied by 1 + shift, kept and renewed at each call."""
        if self._enlarged is None:
            self._enlarged = self.mat.duplicate(copy=True)
        else:
            self.mat.copy(self._enlarged, PETSc.Mat.Structure.SAME_NONZERO_PATTERN)
        if len(self._own):
            diagonal = np.linalg.inv(self.mat.invertBlockDiagonal().reshape(-1, 6, 6))
            self._enlarged.setValuesBlockedRCV(self._own, self._own, shift * diagonal.reshape(-1, 36), ADD)
        self._enlarged.assemble()
        return self._enlarged

    def places(self, points: np.ndarray) -> np.ndarray:
        """Places of this rank's bodies (n, 3): the means of their contact points (nc, 3); collective."""
        sums = self.mat.createVecRight()
        counts = sums.duplicate()
        if self._rows is not None:
            contact = np.repeat(np.arange(len(points)), np.diff(self._rows.indptr))
            body = self.bodies[self._rows.indices]
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
        if self._enlarged is not None:
            self._enlarged.destroy()


def _structure(comm: PETSc.Comm, G: BlockRows) -> PETSc.Mat:
    """An empty K, preallocated by the number of contacts of each body."""
    degree = PETSc.Vec().createMPI((G.columns, PETSc.DETERMINE), comm=comm)
    degree.setValues(G.indices.astype(PETSc.IntType), np.ones(len(G.indices)), ADD)
    degree.assemble()
    most = (degree.array_r + 1).astype(PETSc.IntType)
    total = degree.getSize()
    degree.destroy()
    K = PETSc.Mat().create(comm)
    K.setSizes(((6 * G.columns, PETSc.DETERMINE), (6 * G.columns, PETSc.DETERMINE)))
    K.setBlockSize(6)
    K.setType(PETSc.Mat.Type.BAIJ)
    K.setPreallocationNNZ((np.minimum(most, max(G.columns, 1)), np.minimum(most, max(total - G.columns, 1))))
    K.setOption(PETSc.Mat.Option.SYMMETRIC, True)
    return K
