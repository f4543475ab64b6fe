"""The contact map as frames and arms, and products with it by compiled loops over the contacts, without a matrix.

A product moves 136 bytes per contact (frame, arms, bodies); PETSc's block formats move 300 to 800. While the values of
ghosts travel, the loops work on the contacts that do not touch ghosts.
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from functools import cached_property
from typing import Any

import numpy as np
from mpi4py import MPI

from dem.arrays import Floats, Ints
from dem.compiled import loop, threads
from dem.contact_map import loops
from dem.contact_map.halo import Halo, find_halo
from dem.contact_map.mass import InverseMass
from dem.contact_map.rows import BlockRows, CompactRows, checked, root_blocks


class ContactMap:
    """The contact map G of all ranks.

    Impulses and velocities of contacts are arrays (nc, 3), mass-scaled velocities of bodies are arrays (columns, 6).
    Flat arrays are allowed too; a ValueError for other shapes comes on this rank alone, as products are too frequent to
    ask the other ranks. All products are collective.

    given : the rows; ValueError on all ranks for wrong ones
    mass : what the inverse mass of the bodies is beside the blocks of ``given.root``, see `dem.contact_map.mass`
    halo, body : the halo, and (nc, 2) the rows of the bodies in its tables, uint32, for ``given`` that needs no check.
        They are found from the global indices of the bodies if they are not given.
    precision : of the arrays that products take and return; single precision moves half of the bytes
    """

    couples = False  #: whether more than contacts couples bodies: Newton systems then take its `block_rows`
    has_parts = True  #: whether it has `only`

    def __init__(
        self, comm: MPI.Comm, given: CompactRows, halo: Halo | None = None, body: np.ndarray | None = None,
        precision: type[np.floating] = np.float64, mass: InverseMass | None = None,
    ):  # fmt: skip
        if halo is None or body is None:
            given = checked(comm, given)
            halo, body = find_halo(comm, given.columns, given.body)
        self.comm, self.source, self.halo, self.body, self.precision = comm, given, halo, body, precision
        self.mass = InverseMass(given.root, precision) if mass is None else mass
        self.rows, self.columns, self.couples = given.rows, given.columns + self.mass.more, self.mass.couples
        self.log_flops: Callable[[float], None] = lambda count: None  #: told how many operations a product took
        self._arrays = self._floats(given.frame), self._floats(given.arm), body
        self._pushed = np.zeros(self.mass.axes)  # by the impulses that were collected last, on this rank
        self._first_away = self.rows
        if len(halo.ghosts):
            ghost = np.zeros(halo.rows, bool)
            ghost[halo.ghosts] = True
            self._first_away = first_touching(body, ghost)
        self._spreads = threads() > 1
        self._set_parts()
        self._flops = 45 * self.rows + 6 * self.columns

    @cached_property
    def _w(self) -> Floats:
        """Memory for the velocities of bodies, which a map takes with its first product."""
        return np.zeros((self.halo.rows, 6), self.precision)

    @cached_property
    def _m(self) -> Floats:
        """The same for their momenta."""
        return np.zeros((self.halo.rows, 6), self.precision)

    def with_mass(self, mass: InverseMass) -> ContactMap:
        """The same rows between bodies of another inverse mass."""
        return ContactMap(self.comm, self.source, self.halo, self.body, self.precision, mass)

    def part(self, contacts: Ints) -> ContactMap:
        """The map of these contacts alone, ascending, which shares the bodies with this one. Collective."""
        return ContactMap(
            self.comm, self.source.only(contacts), self.halo, self.body[contacts], self.precision, self.mass
        )

    # -- products -------------------------------------------------------------------------------------------

    def velocities(self, v: Floats) -> Floats:
        """G v (nc, 3)."""
        y, v = np.zeros((self.rows, 3), self.precision), shaped("velocities of bodies", v, self.columns, 6)
        self.mass.scale(v, self._w)
        self._set_velocities(y, y, self.mass.rates_of(v))
        self.log_flops(self._flops)
        return y

    def momenta(self, g: Floats) -> Floats:
        """G' g (columns, 6)."""
        self._collect(g, self._m)
        self.log_flops(self._flops)
        return self.mass.momenta(self._m, self._pushed)

    def add_delassus(self, g: Floats, y: Floats) -> None:
        """y += G G' g; y (nc, 3) is C-contiguous."""
        y = shaped("velocities of contacts", y, self.rows, 3)
        self._collect(g, self._m)
        loops.scale(self.mass.unshared, self._m, self._w)
        self._set_velocities(y, y, self._add_shared(self._share(self._m)) if self.mass.shared else self.mass.none)
        self.log_flops(2 * self._flops)

    def shared(self, g: Floats) -> Floats:
        """The shared coordinates (mass.shared, 6) of impulses g (nc, 3), see `dem.contact_map.mass`."""
        self._collect(g, self._m)
        return self._share(self._m)

    # What an iterate x is to the bodies: its image, the momenta D x and behind them its shared coordinates, from which
    # velocities G G'x and energies x'G G'x follow. A map of those contacts `only` that have impulses finds the same
    # image.

    def only(self, contacts: Ints) -> ContactMap:
        """The map of these contacts, ascending, for images and what follows from them: it shares the memory for
        velocities and momenta with this one."""
        other = copy.copy(self)
        other._take(contacts)
        return other

    def _take(self, contacts: Ints) -> None:
        frame, arm, self.body = (np.take(array, contacts, axis=0) for array in self._arrays)
        self._arrays = frame, arm, self.body
        self.rows, self._first_away = len(contacts), int(np.searchsorted(contacts, self._first_away))
        self._flops = 45 * self.rows + 6 * self.columns
        for name in ("_pieces", "_forces", "_ends", "body_rows", "block_rows"):
            self.__dict__.pop(name, None)
        self._set_parts()

    def _set_parts(self) -> None:
        """Prepare the arrays of the contacts that wait for no other rank, and of the others if there are any."""
        self._own = self._part(0, self._first_away)
        self._away = [self._part(self._first_away, self.rows)] if self._first_away < self.rows else []

    def _part(self, begin: int, end: int) -> tuple[Any, ...]:
        here, (frame, arm, body) = slice(begin, end), self._arrays
        return here, frame[here], arm[here], body[here]

    def image(self) -> Floats:
        """Memory for an image: momenta (halo.rows, 6), and the shared coordinates (mass.shared, 6)."""
        return np.zeros((self.halo.rows + self.mass.shared, 6), self.precision)

    def find_image(self, x: Floats, image: Floats) -> None:
        """image = D x for impulses x (nc, 3)."""
        count, mass = self.halo.rows, self.mass
        self._push(x, image[:count])
        if mass.shared:
            mass.share(image[:count], self._pushed, image[count:])
        self.log_flops(self._flops)

    def find_velocities(self, image: Floats, last: Floats, beta: float, before: Floats, y: Floats) -> None:
        """y = before + G G' z (nc, 3) for the z whose image is image + beta (image - last)."""
        mass = self.mass
        loops.scale_extrapolated(mass.unshared, image, last, beta, self._w)
        rate = self._add_shared(self._shared_at(image, last, beta)) if mass.shared else mass.none
        self._set_velocities(before, y, rate)
        self.log_flops(self._flops + 12 * self.columns)

    def energy_of_step(self, new: Floats, image: Floats, last: Floats, beta: float) -> float:
        """d'GG'd of this rank's bodies, for the step d that leads from this z to the x with the image ``new``."""
        energy: float = loops.energy_of_step(self.mass.unshared, new, image, last, beta)
        if self.mass.shared:
            energy += self.mass.energy(new[self.halo.rows :] - self._shared_at(image, last, beta))
        return energy

    def _shared_at(self, image: Floats, last: Floats, beta: float) -> Floats:
        """The shared coordinates (mass.shared, 6) of z."""
        now, before = image[self.halo.rows :], last[self.halo.rows :]
        return now + self.precision(beta) * (now - before)

    def weights(self, H: Floats, symmetric: bool = True) -> Floats:
        """Blocks H (nc, 3, 3) in the format of `through`: (nc, 6), or (nc, 9) if they are not symmetric."""
        weight = np.empty((self.rows, 6 if symmetric else 9), self.precision)
        loops.weights(*self._arrays, self._floats(H), weight)
        return weight

    def through(self, weight: Floats, v: Floats, out: Floats) -> None:
        """out = v + G' H G v (columns, 6); out is C-contiguous."""
        v = v.reshape(-1, 6)
        self.mass.scale(v, self._w)
        self.halo.begin_update(self._w)
        if self._spreads:
            _, arm, body = self._arrays
            self.halo.end_update(self._w)
            loops.find_forces_through(arm, body, weight, self._w, self._forces)
            self._sum_forces(self._m)
        else:
            self._add_through(weight)
        if self.couples:
            np.add(v, self.mass.momenta(self._m, np.zeros(self.mass.axes)), out=out.reshape(-1, 6))
        else:
            loops.add_scaled(self.mass.root, v, self._m, out.reshape(-1, 6))
        self.log_flops(72 * self.rows + 18 * self.columns)

    def _add_through(self, weight: Floats) -> None:
        """The momenta G' H G v, not yet scaled by masses, of the velocities that are on their way."""
        self._m[:] = 0.0
        if not self.halo.talks:
            self._add(loops.add_through, self._own, weight, self._w, self._m)
            return
        half, rest, away = self._pieces
        self._add(loops.add_through, half, weight, self._w, self._m)
        self.halo.end_update(self._w)
        self._add(loops.add_through, away, weight, self._w, self._m)
        self.halo.begin_add(self._m)
        self._add(loops.add_through, rest, weight, self._w, self._m)
        self.halo.end_add(self._m)

    @cached_property
    def _pieces(self) -> list[tuple[Any, ...]]:
        """Two halves of the contacts that wait for no other rank, then the other contacts."""
        ends = [0, self._first_away // 2, self._first_away, self.rows]
        return [self._part(*pair) for pair in zip(ends, ends[1:])]

    def relative_velocities(self, v: Floats) -> Floats:
        """D' v (nc, 3) for the velocities (rows, 6) of all rows of a table of the halo, without a message."""
        return loops.relative_velocities(*self._arrays, v)

    def greatest_velocities(self, v: Floats, first: int) -> Floats:
        """The greatest component (nc,) of D' v of those contacts whose second body is in the row `first` or behind it,
        0 of the others, without a message."""
        return loops.greatest_velocities(*self._arrays, v, first)

    def works(self, g: Floats, v: Floats, new_v: Floats) -> tuple[float, float, Floats, Floats]:
        """The work of normal and of tangential impulses g (nc, 3) on the mean of two velocities (rows, 6) of all rows
        of a table of the halo, and the normal velocities (nc,) of both, without a message."""
        return loops.works(*self._arrays, g, v, new_v)

    def sums_of_impulses(self, g: Floats, first: int = 0) -> Floats:
        """D g (rows, 6) of those of this rank's contacts whose second body is in the row `first` or behind it, by rows
        of a table of the halo, without a message."""
        sums = np.zeros((self.halo.rows, 6))
        loops.add_momenta_on(first, *self._arrays, self._floats(shaped("impulses", g, self.rows, 3)), sums)
        return sums

    def _share(self, m: Floats) -> Floats:
        """The shared coordinates (mass.shared, 6) of the impulses that were collected, with the momenta m."""
        shared = np.zeros((self.mass.shared, 6), self.precision)
        self.mass.share(m, self._pushed, shared)
        return shared

    def _add_shared(self, shared: Floats) -> Floats:
        """Add the velocities by shared coordinates to those of the own bodies; returns the rates (axes,) of a cell."""
        self.mass.add_bodies(shared, self._w)
        return self.mass.rates(shared)

    def _set_velocities(self, before: Floats, y: Floats, rate: Floats) -> None:
        """y = before + D' w (nc, 3), with the velocities w of the own bodies, and the rates of a cell."""
        (here, frame, arm, body), talks = self._own, self.halo.talks
        if talks:
            self.halo.begin_update(self._w)
        loops.set_velocities(frame, arm, body, before[here], y[here], self._w, rate)
        if talks:
            self.halo.end_update(self._w)
        for here, frame, arm, body in self._away:
            loops.set_velocities(frame, arm, body, before[here], y[here], self._w, rate)

    def _collect(self, g: Floats, m: Floats) -> None:
        """m = the momenta that impulses give to the bodies, not yet scaled by masses; and what they push of a cell."""
        self._push(self._floats(shaped("impulses", g, self.rows, 3)), m)

    def _push(self, g: Floats, m: Floats) -> None:
        """The same of impulses (nc, 3) that have the precision of the map."""
        self._pushed[:] = 0.0
        if self._spreads:
            loops.find_forces(self._arrays[0], g, self._forces)
            if len(self._pushed):
                loops.add_pushes(self._arrays[1], self._forces, self._pushed)
            self._sum_forces(m)
            return
        m[:] = 0.0
        for here, frame, arm, body in self._away:
            loops.add_momenta(frame, arm, body, g[here], m, self._pushed)
        halo, (here, frame, arm, body) = self.halo, self._own
        if halo.talks:
            halo.begin_add(m)
        loops.add_momenta(frame, arm, body, g[here], m, self._pushed)
        if halo.talks:
            halo.end_add(m)

    def _sum_forces(self, m: Floats) -> None:
        """m = the momenta of the bodies by the impulses in ``_forces``, on several threads."""
        (start, ends), (_, arm, _), own = self._ends, self._arrays, self.halo.own
        loops.sum_forces(start[own:], ends, arm, self._forces, m[own:])
        self.halo.begin_add(m)
        loops.sum_forces(start[: own + 1], ends, arm, self._forces, m[:own])
        self.halo.end_add(m)

    @cached_property
    def _forces(self) -> Floats:
        return np.zeros((self.rows, 3), self.precision)

    @cached_property
    def _ends(self) -> tuple[Ints, Ints]:
        moves = np.zeros(self.halo.rows, bool)
        moves[: self.halo.own] = moves[self.halo.ghosts] = True
        return loops.ends_of_bodies(self.body, moves)

    def _add(self, loop: Callable[..., None], part: tuple[Any, ...], each: Floats, *others: Floats) -> None:
        """Run a loop over a part of the contacts, with an array (nc, ...) that has a row for each contact."""
        here, *arrays = part
        if here.stop > here.start:
            loop(*arrays, each[here], *others)

    # -- parts of matrices ----------------------------------------------------------------------------------

    def contact_blocks(self) -> Floats:
        """The diagonal blocks of G G' (nc, 3, 3)."""
        out = np.empty((self.rows, 3, 3), self.precision)
        square = self.mass.square
        mass = np.zeros((self.halo.rows, square.shape[1]), self.precision)
        mass[: self.halo.own] = square
        self.halo.update(mass)
        loops.contact_blocks(*self._arrays, mass, self.mass.mobility, out)
        return out

    def body_blocks(self, weight: Floats) -> Floats:
        """The diagonal blocks of I + G' H G (columns, 6, 6)."""
        blocks = np.zeros((self.halo.rows, 6, 6), self.precision)
        loops.add_body_blocks(*self._arrays, weight, blocks)
        self.halo.add(blocks)
        own, root = blocks[: self.columns], self.mass.root
        if root.shape[1] == 6:
            own *= root[:, :, None] * root[:, None, :]
        else:
            roots = np.zeros((self.columns, 6, 6))
            roots[:, :3, :3], roots[:, 3:, 3:] = root_blocks(root).transpose(1, 0, 2, 3)
            own = roots @ own @ roots
        own[:, range(6), range(6)] += 1.0
        return own

    def scaled(self, size: Floats, precision: type[np.floating] = np.float64) -> ContactMap:
        """The map with its rows multiplied by ``size`` (nc, 3)."""
        frame = np.empty((self.rows, 9), precision)
        loops.scale_frames(self.source.frame, size, frame)
        mass = self.mass.rounded(precision)
        given = self.source
        rows = CompactRows(frame, given.arm, given.body, given.root, given.columns)
        other = ContactMap(self.comm, rows, self.halo, self.body, precision, mass)
        other.log_flops = self.log_flops
        if precision is self.precision:
            other._w, other._m = self._w, self._m
        if self._spreads:
            other._ends = self._ends
        return other

    def structure(self) -> tuple[np.ndarray, ...]:
        """Arrays that are equal where contacts and their bodies are."""
        return self.source.body, np.array([self.columns])

    @cached_property
    def block_rows(self) -> BlockRows:
        """The rows as 3 x 6 blocks; collective at its first use."""
        return self.mass.rows(self.comm, self.source, self.body_rows)

    @cached_property
    def body_rows(self) -> BlockRows:
        """The rows as 3 x 6 blocks without what couples bodies; collective at its first use."""
        return self.rows_of_blocks(self.frame_blocks())

    def frame_blocks(self) -> Floats:
        """The blocks (nc, 2, 3, 6) of both bodies without their masses, and without the sign of the first."""
        frame, arms = self.source.frame.reshape(-1, 1, 3, 3), self.source.arm.reshape(-1, 2, 1, 3)
        return np.concatenate(np.broadcast_arrays(frame, np.cross(arms, frame)), axis=3)

    def rows_of_blocks(self, blocks: Floats) -> BlockRows:
        """The rows that such blocks (nc, 2, 3, 6) make; collective."""
        given = self.source
        root = np.zeros((self.halo.rows, given.root.shape[1]))
        root[: given.columns] = given.root
        self.halo.update(root)
        order = np.argsort(given.body, axis=1)
        blocks = blocks * np.array([-1.0, 1.0])[:, None, None]
        body, local = (np.take_along_axis(rows, order, axis=1) for rows in (given.body, self.body))
        moves = body >= 0
        blocks = np.take_along_axis(blocks, order[:, :, None, None], axis=1)[moves]
        both = root_blocks(root)[local[moves]]
        blocks = np.concatenate([blocks[:, :, :3] @ both[:, 0], blocks[:, :, 3:] @ both[:, 1]], axis=2)
        start = np.concatenate([[0], np.cumsum(moves.sum(axis=1))])
        return BlockRows(start, body[moves].astype(np.int64), blocks, given.columns)

    def _floats(self, array: Floats) -> Floats:
        return np.ascontiguousarray(array, dtype=self.precision)

    def destroy(self) -> None:
        """Nothing to free; the other operators of a cone problem have something."""


def shaped(name: str, x: Floats, rows: int, width: int) -> Floats:
    """x as an array (rows, width), of this shape or flat. ValueError for others, on this rank alone."""
    if x.shape not in ((rows, width), (rows * width,)):
        raise ValueError(f"{name} of the shape {x.shape}; allowed is {(rows, width)}")
    return x.reshape(rows, width)


@loop
def first_touching(body, chosen):
    """The first contact that touches a ``chosen`` (rows,) body, else how many there are."""
    for c in range(len(body)):
        if chosen[body[c, 0]] or chosen[body[c, 1]]:
            return c
    return len(body)
