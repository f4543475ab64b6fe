"""The Newton operator in the velocities of the bodies, K = I + G' H G: a function, and for preconditioners that need
entries a matrix."""

from __future__ import annotations

import numpy as np
from petsc4py import PETSc

from dem.contact_map import ContactMap
from pctt.block_diagonal import set_diagonal_blocks
from pctt.blocks import Array
from pctt.body_matrix.entries import BodyMatrix
from pctt.shell import symmetric_shell


def inverse_blocks(blocks: Array) -> Array:
    """The inverses of positive definite blocks (nc, 3, 3), also of those that rounding has made singular."""
    floor = 1e-14 * np.trace(blocks, axis1=1, axis2=2)
    return np.linalg.inv(blocks + floor[:, None, None] * np.eye(3))


class BodyOperator:
    """K for a sequence of contact maps with the same structure.

    Attributes
    ----------
    mat : K as a shell of block size 6
    """

    def __init__(self, contact_map: ContactMap):
        self.contact_map = contact_map
        self._matrix: BodyMatrix | None = None
        self.mat = symmetric_shell(contact_map.comm, 6 * contact_map.columns, 6, self._product)

    def load(self, contact_map: ContactMap) -> None:
        """Take another map of the same structure."""
        self.contact_map = contact_map
        self._loaded = False

    def update(self, inverse: Array, symmetric: bool = True) -> None:
        """Take the blocks H (nc, 3, 3) of K, which may be unsymmetric."""
        self._inverse, self._made = inverse, False
        self.mat.setOption(PETSc.Mat.Option.SYMMETRIC, symmetric)
        self._weight = self.contact_map.weights(inverse, symmetric)
        set_diagonal_blocks(self.mat, self.contact_map.body_blocks(self._weight))
        self.mat.stateIncrease()

    def _product(self, v: Array, out: Array) -> None:
        self.contact_map.through(self._weight, v, out)

    def entries(self) -> BodyMatrix:
        """The matrix of K with its present values; collective."""
        if self._matrix is None:
            self._matrix = BodyMatrix(self.contact_map.comm, self.contact_map.block_rows)
        elif not self._loaded:
            self._matrix.load(self.contact_map.block_rows)
        self._loaded = True
        if not self._made:
            self._matrix.update(self._inverse)
            self._made = True
        return self._matrix

    def destroy(self) -> None:
        self.mat.destroy()
        if self._matrix is not None:
            self._matrix.destroy()
