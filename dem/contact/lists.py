"""Pairs of grains that are close in this step or may be so in one of the next.

Each grain has some slack beyond its margin, and a pair is in the lists if margins with slack meet. So the lists hold
until a grain has moved, and its margin has grown, by more than its slack together. A search asks of each pair in them
whether the margins meet now: it finds the same with the lists of an earlier step as with new ones.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from operator import attrgetter, is_
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from dem import bodies
from dem.arrays import Floats, Ints
from dem.compiled import loop
from dem.contact.broad import close_pairs
from dem.contact.primitives import Primitives, primitives
from dem.contact_map import Halo
from dem.exchange import on_any
from dem.model.images import Images, images
from dem.model.neighbourhood import MOVING, Neighbourhood, neighbourhood
from dem.parts.cell import Cell

if TYPE_CHECKING:
    from dem.model.world import World

#: The slack of a grain at rest, as a part of its radius. In a mixer lists of 0.2 and 8 have a fifth more pairs than
#: those of 0.1 and 4, and are made half as often: a search takes 5 % less.
AT_REST = 0.2

#: For how many steps of its present speed a grain has slack; a radius is enough, as more makes the lists long.
STEPS = 8.0


@dataclass(frozen=True)
class Rows:
    """For each local grain the other grains of its pairs, which follow it in the table of bodies."""

    start: Ints  #: (grains + 1,)
    other: NDArray[np.int32]  #: (start[-1],) rows, in the order of the contacts


@dataclass(frozen=True)
class Lists:
    """The lists of this rank, and what they were made for."""

    near: Neighbourhood  #: then, without what no list needs, `refreshed` has it; its margins have the slack
    halo: Halo  #: between the grains of `near`
    table: Primitives  #: of the bodies of `near`, not yet where they are
    own: Rows  #: pairs of local grains
    away: Rows  #: pairs of a local grain and a ghost or an image
    images: Images  #: of grains and ghosts
    cell: Cell  #: then
    constant: list[Any]  #: the columns of the world's tables, and the shapes, that no step changes

    def hold(self, world: World, margin: Floats) -> bool:
        """Whether the lists of this rank have all pairs of these margins (grains,)."""
        if not all(map(is_, self.constant, _constant(world))):
            return False
        then, size = self.near.bodies.position, self.table.radius
        strained = world.cell.strained_since(self.cell)
        return stays(then, self.near.margin, size, world.grains.position, margin, *strained)

    def of(self, world: World) -> Lists:
        """The same lists for a world that has taken their columns that no step changes."""
        return replace(self, constant=_constant(world))


def grain_lists(world: World, last: Lists | None, margin: Floats, travel: Floats) -> Lists:
    """The lists of an earlier search if they hold for the margins (grains,) [m], else new ones for grains that go the
    `travel` (grains,) [m] in a step; collective."""
    holds = last is not None and last.hold(world, margin)
    return _new_lists(world, margin, travel) if on_any(world.comm, not holds)[0] or last is None else last


def _new_lists(world: World, margin: Floats, travel: Floats) -> Lists:
    size = bodies.bounding_radius(world.grains)
    near = neighbourhood(world, margin + np.minimum(AT_REST * size + STEPS * travel, size))
    grains, count = near.grains, near.grains + near.ghosts
    pictures = images(world, near)
    wide = pictures.among(near)
    seen = wide.grains + wide.ghosts
    large = [body.shapes for body in world.large_bodies]
    table = primitives(wide, large, world.first_large, world.forms, world.ids)
    pairs = pictures.once(close_pairs(wide.bodies.position[:seen], table.radius[:seen] + wide.margin), wide.index)
    index = near.index[grains:count]
    owner = np.searchsorted(world.slabs, index, side="right") - 1
    halo = Halo(world.comm, grains, len(near.bodies), np.arange(grains, count), owner, index - world.slabs[owner])
    own, away = (Rows(*in_rows(pairs, table.number, grains, *ends)) for ends in ((0, grains), (grains, seen)))
    none = bodies.none()
    places = replace(near, bodies=replace(near.bodies, quaternion=none.quaternion, velocity=none.velocity))
    return Lists(places, halo, table, own, away, pictures, world.cell, _constant(world))


def _constant(world: World) -> list[Any]:
    return [*_COLUMNS(world.grains), *_COLUMNS(world.large), *(body.shapes for body in world.large_bodies)]


#: Columns of bodies that no step changes.
CONSTANT = "id", "mass", "inertia", "material", "shape", "size"
_COLUMNS = attrgetter(*CONSTANT)


def shared(lists: Lists, near: Neighbourhood, before: World, world: World) -> Lists:
    """Return the lists, which both worlds, that before a step and its trial, now have, as they have the first rows of
    the table in the place of columns of their own, which take memory: these are the grains as they are, and any lists
    that hold lead to the same contacts."""
    new = lists is not before.lists
    for name in (*CONSTANT, *MOVING) if new else MOVING:
        column = getattr(near.bodies, name)[: near.grains]
        if getattr(before.grains, name) is getattr(world.grains, name):
            setattr(before.grains, name, column)
        setattr(world.grains, name, column)
    if new:
        lists = lists.of(world)
    before.lists = world.lists = lists
    return lists


@loop
def stays(then: Floats, most: Floats, size: Floats, now: Floats, wanted: Floats, strain: Floats, nearer: float) -> bool:
    """Whether no grain has gone from the place `then` (n or more, 3) to the place `now` (n, 3), and wants a margin
    (n,), by more than leads to the margin `most` (n or more,) that it had then.

    What counts of its way is that beside the deformation `strain` (3, 3) of the cell, which brings pairs, of radii
    `size` (n or more,), `nearer` by this part of their distance at most."""
    for n in range(len(now)):
        x, y, z = now[n, 0], now[n, 1], now[n, 2]
        for k in range(3):
            x -= strain[0, k] * then[n, k]
            y -= strain[1, k] * then[n, k]
            z -= strain[2, k] * then[n, k]
        gone = np.sqrt(x * x + y * y + z * z) + wanted[n] + nearer * (size[n] + most[n])
        if not gone <= (1.0 - 1e-9) * most[n]:  # also for NaN
            return False
    return True


@loop
def in_rows(pairs: Ints, id: Ints, rows: int, low: int, high: int) -> tuple[Ints, NDArray[np.int32]]:
    """The pairs (m, 2) of a row below `rows` and of one from `low` to `high` as `Rows`: in the order of the first row,
    then of the lower id of the two, then of the higher."""
    start = np.zeros(rows + 1, np.int64)
    for k in range(len(pairs)):
        if pairs[k, 0] < rows and low <= pairs[k, 1] < high:
            start[pairs[k, 0] + 1] += 1
    for n in range(rows):
        start[n + 1] += start[n]
    other, end = np.empty(start[rows], np.int32), start[:rows].copy()
    for k in range(len(pairs)):
        i, j = pairs[k, 0], pairs[k, 1]
        if i < rows and low <= j < high:
            to = end[i]  # ids that are lower than that of i come first, and all ascend: so do the ids themselves
            while to > start[i] and id[other[to - 1]] > id[j]:
                other[to] = other[to - 1]
                to -= 1
            other[to] = j
            end[i] += 1
    return start, other
