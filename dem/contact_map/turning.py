"""The contact map of contacts that resist rolling and spinning: beside the velocities at the contact points it has the
velocities with which bodies turn against each other."""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np
from mpi4py import MPI

from dem.arrays import Floats, Ints
from dem.compiled import loop
from dem.contact_map import loops
from dem.contact_map.halo import Halo
from dem.contact_map.map import ContactMap
from dem.contact_map.mass import InverseMass
from dem.contact_map.rows import BlockRows, CompactRows, root_blocks


class TurningMap(ContactMap):
    """A `ContactMap` with twice as many rows: arrays of contacts are (2 nc, 3), first normal and tangents of all
    contacts, then, for impulses, moments about the normal and the two tangents, in units of force times a length.

    turn : (nc, 9) the frames of the contacts times those lengths [m]: the turning velocities are turn (w_b - w_a)
    """

    def __init__(
        self, comm: MPI.Comm, given: CompactRows, turn: Floats, halo: Halo, body: np.ndarray,
        precision: type[np.floating] = np.float64, mass: InverseMass | None = None,
    ):  # fmt: skip
        super().__init__(comm, given, halo, body, precision, mass)
        self._turn_source, self._turn = turn, self._floats(turn)
        self.contacts, self.rows = given.rows, 2 * given.rows

    def with_mass(self, mass: InverseMass) -> TurningMap:
        """The same rows between bodies of another inverse mass."""
        return TurningMap(self.comm, self.source, self._turn_source, self.halo, self.body, self.precision, mass)

    def part(self, contacts: Ints) -> TurningMap:
        """The map of these contacts alone, ascending, which shares the bodies with this one. Collective."""
        given, turn, body = self.source.only(contacts), self._turn_source[contacts], self.body[contacts]
        return TurningMap(self.comm, given, turn, self.halo, body, self.precision, self.mass)

    def turning(self, v: Floats) -> Floats:
        """The turning velocities (nc, 3) of the velocities (rows, 6) of all rows of a table of the halo, without a
        message."""
        y = np.zeros((self.contacts, 3))
        set_turning(self._turn, self.body, y, y, v)
        return y

    def sums_of_moments(self, g: Floats, contacts: Ints, sums: Floats) -> None:
        """sums (rows, 6) += the moments g (nc, 3) of these contacts, by rows of a table of the halo; no message."""
        add_moments(self._turn[contacts], self.body[contacts], g[contacts], sums)

    def _take(self, contacts: Ints) -> None:
        super()._take(contacts)
        self._turn = np.take(self._turn, contacts, axis=0)
        self.contacts, self.rows = self.rows, 2 * self.rows

    def _set_velocities(self, before: Floats, y: Floats, rate: Floats) -> None:
        n = self.contacts
        super()._set_velocities(before[:n], y[:n], rate)
        set_turning(self._turn, self.body, before[n:], y[n:], self._w)

    def _push(self, g: Floats, m: Floats) -> None:
        n = self.contacts
        m[:], self._pushed[:] = 0.0, 0.0
        for part in self._away:
            self._add_impulses(part, g[:n], g[n:], m)
        self.halo.begin_add(m)
        self._add_impulses(self._own, g[:n], g[n:], m)
        self.halo.end_add(m)

    def _add_impulses(self, part: tuple[Any, ...], force: Floats, moment: Floats, m: Floats) -> None:
        here, frame, arm, body = part
        loops.add_momenta(frame, arm, body, force[here], m, self._pushed)
        add_moments(self._turn[here], body, moment[here], m)

    def contact_blocks(self) -> Floats:
        """The diagonal blocks of G G' (2 nc, 3, 3)."""
        out = super().contact_blocks()
        inverse = np.zeros((self.halo.rows, 9), self.precision)
        inverse[: self.halo.own] = root_blocks(self.mass.square)[:, 1].reshape(-1, 9)
        self.halo.update(inverse)
        turning_blocks(self._turn, self.body, inverse, out[self.contacts :])
        return out

    def scaled(self, size: Floats, precision: type[np.floating] = np.float64) -> TurningMap:
        """The map with its rows multiplied by ``size`` (2 nc, 3)."""
        n, (frame, turn) = self.contacts, np.empty((2, self.contacts, 9), precision)
        loops.scale_frames(self.source.frame, size[:n], frame)
        loops.scale_frames(self._turn_source, size[n:], turn)
        mass = self.mass.rounded(precision)
        other = TurningMap(self.comm, replace(self.source, frame=frame), turn, self.halo, self.body, precision, mass)
        other.log_flops = self.log_flops
        return other

    @cached_property
    def body_rows(self) -> BlockRows:
        """The rows as 3 x 6 blocks without what couples bodies; collective at its first use."""
        turning = np.zeros((self.contacts, 2, 3, 6))
        turning[..., 3:] = self._turn_source.reshape(-1, 1, 3, 3)
        one, two = self.rows_of_blocks(self.frame_blocks()), self.rows_of_blocks(turning)
        indptr = np.concatenate([one.indptr, one.indptr[-1] + two.indptr[1:]])
        both = np.concatenate([one.indices, two.indices]), np.concatenate([one.blocks, two.blocks])
        return BlockRows(indptr, *both, self.source.columns)


@loop
def set_turning(turn, body, before, y, w):
    """y = before + turn (w_b - w_a) (nc, 3); y may be ``before``."""
    for c in range(len(body)):
        a, b = body[c, 0], body[c, 1]
        u0, u1, u2 = w[b, 3] - w[a, 3], w[b, 4] - w[a, 4], w[b, 5] - w[a, 5]
        y[c, 0] = before[c, 0] + (turn[c, 0] * u0 + turn[c, 1] * u1 + turn[c, 2] * u2)
        y[c, 1] = before[c, 1] + (turn[c, 3] * u0 + turn[c, 4] * u1 + turn[c, 5] * u2)
        y[c, 2] = before[c, 2] + (turn[c, 6] * u0 + turn[c, 7] * u1 + turn[c, 8] * u2)


@loop
def add_moments(turn, body, g, m):
    """m (bodies, 6) += the moments g (nc, 3)."""
    for c in range(len(body)):
        a, b = body[c, 0], body[c, 1]
        for i in range(3):
            moment = turn[c, i] * g[c, 0] + turn[c, 3 + i] * g[c, 1] + turn[c, 6 + i] * g[c, 2]
            m[a, 3 + i] -= moment
            m[b, 3 + i] += moment


@loop
def turning_blocks(turn, body, inverse, out):
    """out (nc, 3, 3) = turn (I_a^-1 + I_b^-1) turn' for the ``inverse`` (bodies, 9) of the moments of inertia."""
    for c in range(len(body)):
        a, b = body[c, 0], body[c, 1]
        for i in range(3):
            x = y = z = turn.dtype.type(0)
            for k in range(3):
                x += turn[c, 3 * i + k] * (inverse[a, 3 * k] + inverse[b, 3 * k])
                y += turn[c, 3 * i + k] * (inverse[a, 3 * k + 1] + inverse[b, 3 * k + 1])
                z += turn[c, 3 * i + k] * (inverse[a, 3 * k + 2] + inverse[b, 3 * k + 2])
            for j in range(3):
                out[c, i, j] = x * turn[c, 3 * j] + y * turn[c, 3 * j + 1] + z * turn[c, 3 * j + 2]
