"""Products with the contact map as a PETSc block matrix. They are used if numba is missing, and for comparison."""

from __future__ import annotations

from functools import cached_property

import numpy as np
from mpi4py import MPI

from pctt.blocks import Array, BlockRows, block_matrix, diagonal_blocks
from pctt.contact_map.rows import CompactRows, block_rows


class AssembledMap:
    """The contact map G of all ranks. It has the members of `FreeMap` that need no compiled loops. Products are
    collective."""

    free = False

    def __init__(self, comm: MPI.Comm, given: BlockRows | CompactRows):
        self.comm, self.given = comm, given
        self.rows, self.columns = given.rows, given.columns
        self._G = block_matrix(comm, self.block_rows)
        self._bodies, self._contacts = self._G.createVecs()

    def velocities(self, v: Array) -> Array:
        """G v (nc, 3)."""
        self._bodies.array[:] = v.ravel()
        self._G.mult(self._bodies, self._contacts)
        return self._contacts.array.reshape(-1, 3).copy()

    def momenta(self, g: Array) -> Array:
        """G' g (columns, 6)."""
        self._contacts.array[:] = g.ravel()
        self._G.multTranspose(self._contacts, self._bodies)
        return self._bodies.array.reshape(-1, 6).copy()

    def add_delassus(self, g: Array, y: Array) -> None:
        """y += G G' g; y (nc, 3)."""
        self._contacts.array[:] = g.ravel()
        self._G.multTranspose(self._contacts, self._bodies)
        self._G.mult(self._bodies, self._contacts)
        y += self._contacts.array.reshape(-1, 3)

    def contact_blocks(self) -> Array:
        """The diagonal blocks of G G' (nc, 3, 3)."""
        return diagonal_blocks(self.block_rows)

    def scaled(self, size: Array) -> ScaledRows:
        """The map with its rows multiplied by ``size`` (nc, 3); it is valid until this map is destroyed."""
        return ScaledRows(self, size)

    @cached_property
    def block_rows(self) -> BlockRows:
        """The rows as 3 x 6 blocks."""
        return block_rows(self.comm, self.given)

    def destroy(self) -> None:
        for thing in (self._G, self._bodies, self._contacts):
            thing.destroy()


class ScaledRows:
    """A map with its rows multiplied by ``size`` (nc, 3)."""

    def __init__(self, whole: AssembledMap, size: Array):
        self.whole, self.size = whole, size

    def add_delassus(self, g: Array, y: Array) -> None:
        out = np.zeros_like(y)
        self.whole.add_delassus(g * self.size, out)
        out *= self.size
        y += out
