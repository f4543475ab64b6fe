"""The inverse mass of the bodies of a contact map: a block for each body, and what couples bodies beside contacts.

Solvers see contacts alone, as what constraints hold and the size of a cell are in the inverse mass M^-1. A coupling
acts by few numbers that all ranks know, the shared coordinates s of impulses: M^-1 is the blocks of the other bodies,
and a small matrix of s. An image of impulses (see `dem.contact_map.ContactMap`) has s behind the momenta of the bodies.
"""

from __future__ import annotations

import copy
from functools import cached_property
from typing import NamedTuple, TypeVar

import numpy as np
import scipy.sparse as sp
from mpi4py import MPI

from dem.arrays import Floats, Ints
from dem.contact_map import loops
from dem.contact_map.rows import BlockRows, CompactRows
from dem.exchange import offsets, summed

Mass = TypeVar("Mass", bound="InverseMass")

ROUNDING = 1e-14  # of the coupling of bodies that no chain of constraints joins


class InverseMass:
    """M^-1 = R R, with a block R for each body whose rows this rank owns, in the format of `CompactRows.root`."""

    couples = False  #: whether more than contacts couples bodies
    shared = 0  #: number of rows (6,) of the shared coordinates
    more = 0  #: columns of this rank beside those of bodies
    axes = 0  #: along which a cell changes its size: 3, or 0

    def __init__(self, root: Floats, precision: type[np.floating] = np.float64):
        self.precision, self._roots = precision, root
        self.none = np.zeros(0, precision)  #: the rates of no cell

    @cached_property
    def root(self) -> Floats:
        """R."""
        return np.ascontiguousarray(self._roots, dtype=self.precision)

    @property
    def square(self) -> Floats:
        """M^-1, a new array."""
        return loops.squared(self._roots).astype(self.precision, copy=False)

    @cached_property
    def unshared(self) -> Floats:
        """M^-1 of the bodies that are in no shared coordinate, else zero."""
        return self.square

    def rounded(self: Mass, precision: type[np.floating]) -> Mass:
        """The same in this precision."""
        if precision is self.precision:
            return self
        other = copy.copy(self)
        for name in ("root", "unshared"):
            other.__dict__.pop(name, None)
        other.precision, other.none = precision, np.zeros(0, precision)
        return other

    def scale(self, v: Floats, out: Floats) -> None:
        """out = R v for the own bodies, of mass-scaled velocities v (columns, 6)."""
        loops.scale(self.root, v, out)

    def momenta(self, m: Floats, pushed: Floats) -> Floats:
        """R m (columns, 6) of impulses that give bodies the momenta m, and a cell the push (axes,) of this rank;
        collective where bodies are coupled."""
        out = np.empty((len(self.root), 6), self.precision)
        loops.scale(self.root, m, out)
        return out

    def share(self, m: Floats, pushed: Floats, s: Floats) -> None:
        """s (shared, 6) = the shared coordinates of such impulses; collective where bodies are coupled."""

    def add_bodies(self, s: Floats, w: Floats) -> None:
        """w += the velocities of the own bodies by s."""

    def rates(self, s: Floats) -> Floats:
        """The rates (axes,) of a cell by s."""
        return self.none

    def rates_of(self, v: Floats) -> Floats:
        """The rates (axes,) of mass-scaled velocities v (columns, 6); collective."""
        return self.none

    @property
    def mobility(self) -> Floats:
        """That of the rates (axes,)."""
        return self.none

    def energy(self, s: Floats) -> float:
        """s' M^-1 s, on one rank."""
        return 0.0

    def rows(self, comm: MPI.Comm, given: CompactRows, known: BlockRows) -> BlockRows:
        """The rows of G from those of the bodies alone; collective."""
        return known


class ConstrainedMass(InverseMass):
    """The inverse mass of bodies that constraints couple, such as joints.

    With B the rows of constraints in the mass-scaled velocities and e >= 0 what they yield (0: not at all), they turn
    the inverse mass I into I - B' (B B' + e)^-1 B = (I - K)^2 with K symmetric: R is then R (I - K). The shared
    coordinates are the mass-scaled momenta of these bodies. Impulses of constraints have no sign and need no cone;
    what is left is the same cone problem of the contacts.

    here, slot : own rows of constrained bodies, and their places among all of these
    coupling : K (6 n, 6 n) of the n constrained bodies, the same on all ranks
    """

    couples = True

    def __init__(self, comm: MPI.Comm, root: Floats, here: Ints, slot: Ints, coupling: Floats):
        super().__init__(root)
        self.comm, self.here, self.slot, self.coupling = comm, here, slot, coupling
        self.shared = len(coupling) // 6
        self._given = root[here]

    @cached_property
    def unshared(self) -> Floats:
        out = self.square
        out[self.here] = 0.0
        return out

    def uncoupled(self, z: Floats) -> Floats:
        """(I - K) z for z (shared, 6) of all constrained bodies."""
        x = z.astype(float, copy=False)
        return x - (self.coupling @ x.ravel()).reshape(-1, 6)

    def gathered(self, v: Floats) -> Floats:
        """The rows (shared, 6) of the constrained bodies among those v (columns, 6) of all ranks; collective."""
        return self._all(v[self.here])

    def _all(self, own: Floats) -> Floats:
        """The rows (shared, 6) of all constrained bodies from the own ones (k, 6); collective."""
        out = np.zeros((self.shared, 6))
        out[self.slot] = own
        return summed(self.comm, out)

    def held(self, v: Floats) -> Floats:
        """(I - K) v (columns, 6) of mass-scaled velocities; collective."""
        out = v.copy()
        out[self.here] = self.uncoupled(self.gathered(v))[self.slot]
        return out

    def scale(self, v: Floats, out: Floats) -> None:
        super().scale(self.held(v), out)

    def momenta(self, m: Floats, pushed: Floats) -> Floats:
        return self.held(super().momenta(m, pushed))

    def share(self, m: Floats, pushed: Floats, s: Floats) -> None:
        s[:] = self._all(self._scaled(m[self.here]))

    def add_bodies(self, s: Floats, w: Floats) -> None:
        w[self.here] += self._scaled(self.uncoupled(self.uncoupled(s))[self.slot])

    def _scaled(self, m: Floats) -> Floats:
        """R m (k, 6) of the own constrained bodies."""
        out = np.empty((len(m), 6))
        loops.scale(self._given, m.astype(float, copy=False), out)
        return out

    def energy(self, s: Floats) -> float:
        z = self.uncoupled(s)
        return float(np.vdot(z, z)) if self.comm.rank == 0 else 0.0

    def rows(self, comm: MPI.Comm, given: CompactRows, known: BlockRows) -> BlockRows:
        """Contacts of a constrained body have a block for each body that constraints couple it with."""
        number = np.zeros(self.shared, np.int64)
        number[self.slot] = offsets(comm, known.columns)[comm.rank] + self.here
        comm.Allreduce(MPI.IN_PLACE, number)
        bodies, place = np.unique(np.concatenate([known.indices, number]), return_inverse=True)
        size, place = 6 * len(bodies), place.ravel()
        coupled = (6 * place[len(known.indices) :, None] + np.arange(6)).ravel()
        row, column = np.nonzero(np.abs(self.coupling) > ROUNDING)
        K = sp.csr_matrix((self.coupling[row, column], (coupled[row], coupled[column])), shape=(size, size))
        R = (sp.identity(size, format="csr") - K).tobsr((6, 6))
        G = sp.bsr_matrix((known.blocks, place[: len(known.indices)], known.indptr), shape=(3 * known.rows, size))
        found = (G @ R).tobsr((3, 6))
        found.sort_indices()
        return BlockRows(found.indptr.astype(np.int64), bodies[found.indices], found.data, known.columns)


class CellStep(NamedTuple):
    """What a step knows of its cell."""

    root: Floats  #: (3,) root of the mobilities of E; 0 along an axis whose rate is given [1 / (m sqrt(kg))]
    free: Floats  #: (3,) E without contacts [1/s]


class CellMass(InverseMass):
    """The inverse mass of bodies in a periodic cell whose size follows from the step: the rates of its periods are
    unknowns beside the velocities of the bodies.

    With the rates E (3,) of the periods, the relative velocity of a contact has the part F E l, of its frame F and the
    way l from centre to centre, component by component. With a mobility of E, the map has three more columns, and the
    cell is a body that touches all contacts: its row is behind those of the bodies of the last rank. The shared
    coordinates are its push, the sum of the impulses with the ways [N s m].
    """

    couples, shared, axes = True, 1, 3

    def __init__(self, comm: MPI.Comm, root: Floats, cell: CellStep):
        super().__init__(root)
        self.comm, self.cell = comm, cell
        self.more = int(comm.rank == comm.size - 1)

    def momenta(self, m: Floats, pushed: Floats) -> Floats:
        out = np.zeros((len(self.root) + self.more, 6), self.precision)
        loops.scale(self.root, m, out)
        push = summed(self.comm, pushed)  # [N s m]
        if self.more:
            out[-1, :3] = self.cell.root * push
        return out

    def share(self, m: Floats, pushed: Floats, s: Floats) -> None:
        s[0, :3] = summed(self.comm, pushed)

    def rates(self, s: Floats) -> Floats:
        return self._rounded(self.cell.root**2 * s[0, :3])

    def _rounded(self, rate: Floats) -> Floats:
        return rate.astype(self.precision)

    def rate_of(self, v: Floats) -> Floats:
        """E (3,), the same on all ranks, of mass-scaled velocities (columns, 6); collective."""
        rate = self.cell.root * v.reshape(-1, 6)[-1, :3] if self.more else np.empty(3)
        return np.asarray(self.comm.bcast(rate, self.comm.size - 1))

    def rates_of(self, v: Floats) -> Floats:
        return self._rounded(self.rate_of(v))

    @property
    def mobility(self) -> Floats:
        return self._rounded(self.cell.root**2)

    def energy(self, s: Floats) -> float:
        step = s[0, :3] * self.cell.root
        return float(step @ step) if self.more else 0.0

    def rows(self, comm: MPI.Comm, given: CompactRows, known: BlockRows) -> BlockRows:
        """The rows of the bodies, with a block of the cell for each contact."""
        count, columns = given.rows, known.columns + self.more
        blocks, way = np.zeros((count, 3, 6)), given.arm[:, :3] - given.arm[:, 3:]
        blocks[:, :, :3] = given.frame.reshape(-1, 3, 3) * (way * self.cell.root)[:, None]
        ends, last = known.indptr[1 : count + 1], offsets(comm, columns)[-1] - 1
        indptr = known.indptr + np.minimum(np.arange(len(known.indptr)), count)
        indices, blocks = np.insert(known.indices, ends, last), np.insert(known.blocks, ends, blocks, axis=0)
        return BlockRows(indptr, indices, blocks, columns)
