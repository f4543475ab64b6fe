"""The contact map of a periodic cell whose size follows from the step: the rates of its periods are unknowns beside the
velocities of the bodies.

With the rates E (3,) of the periods, the relative velocity of a contact has the part F l E, of its frame F and the way
l from centre to centre, component by component. With a mobility of E, the map has three more columns, and the cell is a
body that touches all contacts. Its row, with the root of the mobility times the impulses, is behind those of the bodies
of the last rank.
"""

from __future__ import annotations

import copy
from functools import cached_property
from typing import NamedTuple

import numpy as np
from mpi4py import MPI

from dem.arrays import Floats, Ints
from dem.compiled import loop
from dem.contact_map.map import BlockRows, ContactMap, shaped
from dem.exchange import offsets


class Cell(NamedTuple):
    """What a step knows of its cell."""

    lever: Floats  #: (nc, 9) the frames of the contacts, with columns times the ways from centre to centre [m]
    root: Floats  #: (3,) root of the mobilities of E; 0 along an axis whose rate is given [1 / (m sqrt(kg))]
    free: Floats  #: (3,) E without contacts [1/s]


class CellMap(ContactMap):
    """A `ContactMap` with the columns of a cell.

    free : the map without the cell; it may have rows of turning, which the cell does not touch
    """

    couples = True

    def __init__(self, free: ContactMap, cell: Cell):
        self.comm, self.given, self.halo, self.body = free.comm, free.given, free.halo, free.body
        self.precision = free.precision
        self.free, self.cell, self.rows = free, cell, free.rows
        self._last = self.comm.rank == self.comm.size - 1
        self.columns = free.columns + self._last
        self._lever = cell.lever.astype(self.precision, copy=False)
        self._mobility, self._count = cell.root**2, len(self._lever)
        self.log_flops = free.log_flops

    def only(self, contacts: Ints) -> CellMap:
        other = copy.copy(self)
        other.free, other._lever = self.free.only(contacts), np.take(self._lever, contacts, axis=0)
        other.rows, other._count = other.free.rows, len(contacts)
        other.__dict__.pop("block_rows", None)
        return other

    def push(self, g: Floats) -> Floats:
        """What impulses g (rows, 3) of all ranks do to E: their sum over the contacts with the ways (3,) [N s m]."""
        out = np.zeros(3)
        add_pushes(self._lever, g, out)
        if self.comm.size > 1:
            self.comm.Allreduce(MPI.IN_PLACE, out)
        return out

    def add_rates(self, rate: Floats, y: Floats) -> None:
        """y (rows, 3) += the relative velocities that E = `rate` (3,) gives contacts."""
        add_rates(self._lever, rate, y)

    def rate_of(self, v: Floats) -> Floats:
        """E (3,), the same on all ranks, of mass-scaled velocities (columns, 6); collective."""
        rate = self.cell.root * v.reshape(-1, 6)[-1, :3] if self._last else np.empty(3)
        return np.asarray(self.comm.bcast(rate, self.comm.size - 1))

    def velocities(self, v: Floats) -> Floats:
        """G v (rows, 3)."""
        v = shaped("velocities of bodies", v, self.columns, 6)
        y = self.free.velocities(v[: self.free.columns])
        self.add_rates(self.rate_of(v), y)
        return y

    def momenta(self, g: Floats) -> Floats:
        """G' g (columns, 6)."""
        out = np.zeros((self.columns, 6), self.precision)
        g = shaped("impulses", g, self.rows, 3).astype(self.precision, copy=False)
        out[: self.free.columns] = self.free.momenta(g)
        push = self.push(g)
        if self._last:
            out[-1, :3] = self.cell.root * push
        return out

    def add_delassus(self, g: Floats, y: Floats) -> None:
        """y += G G' g; y (rows, 3) is C-contiguous."""
        y = shaped("velocities of contacts", y, self.rows, 3)
        self.free.add_delassus(g, y)
        g = shaped("impulses", g, self.rows, 3).astype(self.precision, copy=False)
        self.add_rates(self._mobility * self.push(g), y)

    def image(self) -> Floats:
        """Memory for an image: that of the map without the cell, and a row for the push, the same on all ranks."""
        return np.zeros((len(self.free.image()) + 1, 6), self.precision)

    def find_image(self, x: Floats, image: Floats) -> None:
        self.free.find_image(x, image[:-1])
        image[-1, :3] = self.push(x)

    def find_velocities(self, image: Floats, last: Floats, beta: float, before: Floats, y: Floats) -> None:
        self.free.find_velocities(image[:-1], last[:-1], beta, before, y)
        push = image[-1, :3] + beta * (image[-1, :3] - last[-1, :3])
        self.add_rates(self._mobility * push, y)

    def energy_of_step(self, new: Floats, image: Floats, last: Floats, beta: float) -> float:
        energy = self.free.energy_of_step(new[:-1], image[:-1], last[:-1], beta)
        step = (new[-1, :3] - image[-1, :3] - beta * (image[-1, :3] - last[-1, :3])) * self.cell.root
        return energy + (float(step @ step) if self._last else 0.0)

    def relative_velocities(self, v: Floats) -> Floats:
        """Those (nc, 3) of the bodies alone."""
        return self.free.relative_velocities(v)

    def works(self, g: Floats, v: Floats, new_v: Floats) -> tuple[float, float, Floats]:
        """Those of the velocities of the bodies alone."""
        return self.free.works(g, v, new_v)

    def sums_of_impulses(self, g: Floats, contacts: np.ndarray) -> Floats:
        return self.free.sums_of_impulses(g, contacts)

    def contact_blocks(self) -> Floats:
        """The diagonal blocks of G G' (rows, 3, 3)."""
        out = self.free.contact_blocks()
        lever = self._lever.reshape(-1, 3, 3) * self.cell.root.astype(self.precision)
        out[: self._count] += lever @ lever.transpose(0, 2, 1)
        return out

    def scaled(self, size: Floats, precision: type[np.floating] = np.float64) -> CellMap:
        """The map with its rows multiplied by ``size`` (rows, 3)."""
        lever = (self.cell.lever.reshape(-1, 3, 3) * size[: self._count, :, None]).reshape(-1, 9)
        return CellMap(self.free.scaled(size, precision), self.cell._replace(lever=lever))

    @cached_property
    def block_rows(self) -> BlockRows:
        """The rows of the map without the cell, with a block of the cell for each contact; collective at its first
        use."""
        free, count = self.free.block_rows, self._count
        blocks = np.zeros((count, 3, 6))
        blocks[:, :, :3] = self._lever.reshape(-1, 3, 3) * self.cell.root
        ends, last = free.indptr[1 : count + 1], offsets(self.comm, self.columns)[-1] - 1
        indptr = free.indptr + np.minimum(np.arange(len(free.indptr)), count)
        indices, blocks = np.insert(free.indices, ends, last), np.insert(free.blocks, ends, blocks, axis=0)
        return BlockRows(indptr, indices, blocks, self.columns)


@loop
def add_pushes(lever, g, out):
    """out (3,) += lever' g of the contacts (nc, 9), in double precision."""
    x, y, z = 0.0, 0.0, 0.0
    for c in range(len(lever)):
        x += lever[c, 0] * g[c, 0] + lever[c, 3] * g[c, 1] + lever[c, 6] * g[c, 2]
        y += lever[c, 1] * g[c, 0] + lever[c, 4] * g[c, 1] + lever[c, 7] * g[c, 2]
        z += lever[c, 2] * g[c, 0] + lever[c, 5] * g[c, 1] + lever[c, 8] * g[c, 2]
    out[0] += x
    out[1] += y
    out[2] += z


@loop
def add_rates(lever, rate, y):
    """y (nc or more, 3) += lever rate in the contacts (nc, 9)."""
    for c in range(len(lever)):
        for i in range(3):
            y[c, i] += lever[c, 3 * i] * rate[0] + lever[c, 3 * i + 1] * rate[1] + lever[c, 3 * i + 2] * rate[2]
