"""The contact map of bodies that joints couple: joints are eliminated, so that solvers see contacts alone.

With B the rows of the joints in the mass-scaled velocities and e >= 0 what they yield (0: not at all), joints turn the
inverse mass I into I - B' (B B' + e)^-1 B = R R, with R = I - K symmetric. The map is G R in the place of G. Impulses
of joints have no sign and need no cone; what is left is the same cone problem of the contacts.
"""

from __future__ import annotations

import copy

import numpy as np
from mpi4py import MPI

from dem.arrays import Floats, Ints
from dem.contact_map.map import BlockRows, ContactMap, shaped


class JointedMap(ContactMap):
    """A `ContactMap` with the coupling of joints, for methods that need products alone.

    here, slot : own rows of jointed bodies, and their places among all of these
    coupling : K (6 n, 6 n) of the n jointed bodies, the same on all ranks
    free : the map without joints, perhaps with moments
    """

    has_rows = False

    def __init__(self, known: ContactMap, here: Ints, slot: Ints, coupling: Floats):
        super().__init__(known.comm, known.given, known.halo, known.body, known.precision)
        self.free, self.rows, self._here, self._slot, self._coupling = known, known.rows, here, slot, coupling

    def only(self, contacts: Ints) -> JointedMap:
        other = copy.copy(self)
        other.free = self.free.only(contacts)
        other.rows = other.free.rows
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

    @property
    def block_rows(self) -> BlockRows:  # type: ignore[override]
        """Joints would fill the rows; ValueError."""
        raise ValueError("a contact map with joints has no sparse rows: allowed are methods that need products alone")
