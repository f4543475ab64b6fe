"""The contact map of bodies that joints couple: joints are eliminated, so that solvers see contacts alone.

With B the rows of the joints in the mass-scaled velocities and e >= 0 what they yield (0: not at all), joints turn the
inverse mass I into I - B' (B B' + e)^-1 B = R R, with R = I - K symmetric. The map is G R in the place of G. Impulses
of joints have no sign and need no cone; what is left is the same cone problem of the contacts.
"""

from __future__ import annotations

import copy
from functools import cached_property

import numpy as np
import scipy.sparse as sp
from mpi4py import MPI

from dem.arrays import Floats, Ints
from dem.contact_map.map import BlockRows, ContactMap, shaped
from dem.exchange import offsets

ROUNDING = 1e-14  # of the coupling of bodies that no chain of joints joins


class JointedMap(ContactMap):
    """A `ContactMap` with the coupling of joints. Its products are those of contacts, and of K.

    here, slot : own rows of jointed bodies, and their places among all of these
    coupling : K (6 n, 6 n) of the n jointed bodies, the same on all ranks
    free : the map without joints, perhaps with moments
    """

    couples = True

    def __init__(self, known: ContactMap, here: Ints, slot: Ints, coupling: Floats):
        super().__init__(known.comm, known.given, known.halo, known.body, known.precision)
        self.free, self.rows, self._here, self._slot, self._coupling = known, known.rows, here, slot, coupling

    def only(self, contacts: Ints) -> JointedMap:
        other = copy.copy(self)
        other.free = self.free.only(contacts)
        other.rows = other.free.rows
        other.__dict__.pop("block_rows", None)
        return other

    def gathered(self, v: Floats) -> Floats:
        """The rows (n, 6) of the jointed bodies among those (columns, 6) of all ranks; collective."""
        out = np.zeros((len(self._coupling) // 6, 6))
        out[self._slot] = v[self._here]
        self.comm.Allreduce(MPI.IN_PLACE, out)
        return out

    def coupled(self, v: Floats) -> Floats:
        """R v for mass-scaled velocities v (columns, 6); collective."""
        out = v.copy()
        change = (self._coupling @ self.gathered(v).ravel()).reshape(-1, 6)
        out[self._here] -= change[self._slot].astype(v.dtype)
        return out

    def of(self, known: ContactMap) -> JointedMap:
        """The same joints in another map of these bodies."""
        return JointedMap(known, self._here, self._slot, self._coupling)

    def velocities(self, v: Floats) -> Floats:
        """G R v (rows, 3)."""
        return self.free.velocities(self.coupled(shaped("velocities of bodies", v, self.columns, 6)))

    def momenta(self, g: Floats) -> Floats:
        """R G' g (columns, 6)."""
        return self.coupled(self.free.momenta(g))

    def add_delassus(self, g: Floats, y: Floats) -> None:
        """y += G R R G' g; y (rows, 3) is C-contiguous."""
        y = shaped("velocities of contacts", y, self.rows, 3)
        y += self.velocities(self.momenta(g))

    def image(self) -> Floats:
        """Memory for an image: momenta R G' x (columns, 6)."""
        return np.zeros((self.columns, 6), self.precision)

    def find_image(self, x: Floats, image: Floats) -> None:
        self.free._collect(x, self._m)
        image[:] = self.coupled(self._left())

    def find_velocities(self, image: Floats, last: Floats, beta: float, before: Floats, y: Floats) -> None:
        z = image + self.precision(beta) * (image - last)
        self.free._enter(self._root, self.coupled(z))
        self.free._set_velocities(before, y)

    def energy_of_step(self, new: Floats, image: Floats, last: Floats, beta: float) -> float:
        step = new - image - self.precision(beta) * (image - last)
        return float(np.vdot(step, step))

    def contact_blocks(self) -> Floats:
        """Those of the map without joints: a scale for unknowns."""
        return self.free.contact_blocks()

    def scaled(self, size: Floats, precision: type[np.floating] = np.float64) -> JointedMap:
        """The map with its rows multiplied by ``size`` (rows, 3)."""
        return self.of(self.free.scaled(size, precision))

    @cached_property
    def block_rows(self) -> BlockRows:
        """The rows of G R: contacts of a jointed body have a block for each body that joints join it with; collective
        at its first use."""
        free, number = self.free.block_rows, np.zeros(len(self._coupling) // 6, np.int64)
        number[self._slot] = offsets(self.comm, self.columns)[self.comm.rank] + self._here
        self.comm.Allreduce(MPI.IN_PLACE, number)
        bodies, place = np.unique(np.concatenate([free.indices, number]), return_inverse=True)
        size, place = 6 * len(bodies), place.ravel()
        jointed = (6 * place[len(free.indices) :, None] + np.arange(6)).ravel()
        row, column = np.nonzero(np.abs(self._coupling) > ROUNDING)
        K = sp.csr_matrix((self._coupling[row, column], (jointed[row], jointed[column])), shape=(size, size))
        R = (sp.identity(size, format="csr") - K).tobsr((6, 6))
        G = sp.bsr_matrix((free.blocks, place[: len(free.indices)], free.indptr), shape=(3 * free.rows, size))
        rows = (G @ R).tobsr((3, 6))
        rows.sort_indices()
        return BlockRows(rows.indptr.astype(np.int64), bodies[rows.indices], rows.data, self.columns)
