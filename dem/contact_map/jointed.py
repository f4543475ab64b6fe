"""The contact map of bodies that joints couple: joints are eliminated, so that solvers see contacts alone.

With B the rows of the joints in the mass-scaled velocities and e >= 0 what they yield (0: not at all), joints turn the
inverse mass I into I - B' (B B' + e)^-1 B = R R, with R = I - K symmetric. The map is G R in the place of G. Impulses
of joints have no sign and need no cone; what is left is the same cone problem of the contacts.
"""

from __future__ import annotations

import numpy as np
from mpi4py import MPI

from dem.arrays import Floats, Ints
from dem.contact_map.map import BlockRows, ContactMap, Some, shaped


class JointedMap(ContactMap):
    """A `ContactMap` with the coupling of joints, for methods that need products alone.

    here, slot : own rows of jointed bodies, and their places among all of these
    coupling : K (6 n, 6 n) of the n jointed bodies, the same on all ranks
    free : the map without joints
    """

    def __init__(
        self, known: ContactMap, here: Ints, slot: Ints, coupling: Floats,
        precision: type[np.floating] = np.float64,
    ):  # fmt: skip
        super().__init__(known.comm, known.given, known.halo, known.body, precision)
        self.free, self._here, self._slot, self._coupling = known, here, slot, coupling

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

    def free_momenta(self, g: Floats) -> Floats:
        """G' g (columns, 6) of the contacts without joints; collective."""
        return super().momenta(g)

    def velocities(self, v: Floats) -> Floats:
        """G R v (nc, 3)."""
        return super().velocities(self.coupled(shaped("velocities of bodies", v, self.columns, 6)))

    def momenta(self, g: Floats) -> Floats:
        """R G' g (columns, 6)."""
        return self.coupled(super().momenta(g))

    def add_delassus(self, g: Floats, y: Floats) -> None:
        """y += G R R G' g; y (nc, 3) is C-contiguous."""
        y = shaped("velocities of contacts", y, self.rows, 3)
        y += self.velocities(self.momenta(g))

    def image(self) -> Floats:
        """Memory for an image: momenta R G' x (columns, 6)."""
        return np.zeros((self.columns, 6), self.precision)

    def find_image(self, x: Floats, image: Floats, some: Some) -> None:
        self._collect(x, self._m, some)
        image[:] = self.coupled(self._left())

    def find_velocities(self, image: Floats, last: Floats, beta: float, before: Floats, y: Floats, some: Some) -> None:
        z = image + self.precision(beta) * (image - last)
        self._enter(self._root, self.coupled(z))
        self._set_velocities(before, y, some)

    def energy_of_step(self, new: Floats, image: Floats, last: Floats, beta: float) -> float:
        step = new - image - self.precision(beta) * (image - last)
        return float(np.vdot(step, step))

    def scaled(self, size: Floats, precision: type[np.floating] = np.float64) -> JointedMap:
        """The map with its rows multiplied by ``size`` (nc, 3)."""
        known = self.free.scaled(size, precision)
        return JointedMap(known, self._here, self._slot, self._coupling, precision)

    @property
    def block_rows(self) -> BlockRows:  # type: ignore[override]
        """Joints would fill the rows; ValueError."""
        raise ValueError("a contact map with joints has no sparse rows: allowed are methods that need products alone")
