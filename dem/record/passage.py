"""Grains that come and go: before a step those in outlets leave, then sources add those that are due.

The first rank decides what comes, from the grains of all ranks about the sources, and the grains are distributed anew.
"""

from __future__ import annotations

import numpy as np
from mpi4py import MPI

from dem import bodies
from dem.arrays import Bools, Floats
from dem.bodies import PLANE, SPHERE, Bodies
from dem.contact.primitives import primitives, touches
from dem.geometry.insertion import inserted
from dem.model.neighbourhood import Neighbourhood, seen_by
from dem.model.partition import redistribute
from dem.model.world import World
from dem.parts.sources import MOST_IDS, Source, bounds, reach
from dem.record.energies import energy
from dem.together import SceneError

PART = 256  #: grains that are placed at once


def insert_and_remove(world: World) -> None:
    """Let grains leave and come, as they are due at the time of the world; collective. SceneError for a source that has
    used up all ids."""
    world.passages = world.passages.counted()
    if world.passages.outlets:
        _leave(world)
    if world.passages.sources:
        _insert(world)


def _leave(world: World) -> None:
    grains = world.grains
    position, left = world.cell.wrapped(grains.position), np.zeros(len(grains), bool)
    sums = np.zeros((len(world.passages.outlets), 3))
    for row, outlet in enumerate(world.passages.outlets.values()):
        mine = outlet.takes(position) & ~left
        left |= mine
        table = grains.take(mine)
        sums[row] = len(table), table.mass.sum(), sum(energy(table, world.gravity))
    world.comm.Allreduce(MPI.IN_PLACE, sums)
    for name, (count, mass, joule) in zip(world.passages.outlets, sums):
        tally = world.passages.tallies[name]
        tally.count, tally.mass, tally.energy = tally.count + int(count), tally.mass + float(mass), float(joule)
    if sums[:, 0].any():
        world.set_grains(grains.take(~left))


def _insert(world: World) -> None:
    comm, ids = world.comm, world.ids
    wanted = comm.bcast([name for name in world.passages.sources if _due(world, name, PART)[1]])
    for name in world.passages.sources:
        world.passages.tallies[name].energy = 0.0
    if not wanted:
        return
    center, radius = _about(world, [world.passages.sources[name] for name in wanted])
    born: list[Bodies] = []
    if comm.rank == 0:
        for name in wanted:
            found, center, radius = _inserted(world, name, center, radius)
            born += found
    tallies, count = comm.bcast(({name: world.passages.tallies[name] for name in wanted}, sum(map(len, born))))
    world.passages.tallies.update(tallies)
    if ids + count > MOST_IDS:
        raise SceneError(f"step {world.step + 1}: sources have made more than {MOST_IDS} grains, which have no ids")
    if count:
        table = world.grains
        if born:
            new = bodies.concatenate(born)
            new.id = ids + np.arange(count)
            table = bodies.concatenate([table, new])
        world.set_grains(table)
        redistribute(world)


def _due(world: World, name: str, most: int) -> tuple[Bodies, int]:
    """The next grains of a source, so many at most, and how many of them are due."""
    source, tally = world.passages.sources[name], world.passages.tallies[name]
    table = source.grains(name, tally.count + np.arange(most))
    return table, source.due(world.time, tally, table.mass)


def _about(world: World, sources: list[Source]) -> tuple[Floats, Floats]:
    """Centres (m, 3) and radii (m,) of the spheres about the grains of all ranks that may be in the way of sources, in
    the order of their ids, on the first rank; collective."""
    boxes = np.array([bounds(source.region) for source in sources])
    largest = np.array([reach(source.extremes()).max() for source in sources])
    boxes += np.array([-1.0, 1.0])[None, :, None] * largest[:, None, None]
    position, radius = world.cell.wrapped(world.grains.position), reach(world.grains)
    rows = seen_by(position, radius, world.cell.image_vectors, boxes[None])[0].any(axis=0).nonzero()[0]
    parts = world.comm.gather((world.grains.id[rows], position[rows], radius[rows]))
    if parts is None:
        return np.zeros((0, 3)), np.zeros(0)
    id, center, radii = (np.concatenate(columns) for columns in zip(*parts))
    order = np.argsort(id)
    return center[order], radii[order]


def _inserted(world: World, name: str, center: Floats, radius: Floats) -> tuple[list[Bodies], Floats, Floats]:
    """The grains that a source adds now among spheres of centres (m, 3) and radii (m,), and all of these spheres then;
    counted in the tally. Where the next grain finds no place, it and all after it wait, so that sizes keep their
    shares."""
    source, tally, born = world.passages.sources[name], world.passages.tallies[name], []
    while True:
        table, count = _due(world, name, PART)
        place = source.places(name, tally.count + np.arange(count))
        table = table.take(slice(0, count))
        size = reach(table)
        taken = inserted(place, _free(world, place, size), size, center, radius, world.cell.period)
        came = int((taken >= 0).sum())
        table = table.take(slice(0, came))
        table.position = place[np.arange(came), taken[:came]]
        center, radius = np.concatenate([center, table.position]), np.concatenate([radius, size[:came]])
        tally.count += came
        tally.mass = float(np.cumsum(np.concatenate([[tally.mass], table.mass]))[-1])
        tally.energy += sum(energy(table, world.gravity))
        tally.refused += came < count
        born.append(table)
        if came < PART:
            return born, center, radius


def _free(world: World, place: Floats, radius: Floats) -> Bools:
    """Which places (n, tries, 3) spheres of radii (n,) can take beside the large bodies, which have images."""
    free = np.ones(place.shape[:2], bool)
    if not len(world.large) or not free.size:
        return free
    for way in world.cell.image_vectors:
        free &= _apart(world, place.reshape(-1, 3) + way, np.repeat(radius, place.shape[1])).reshape(free.shape)
    return free


def _apart(world: World, center: Floats, radius: Floats) -> Bools:
    """Which spheres of centres (n, 3) and radii (n,) touch no large body."""
    count = len(center)
    table = Bodies(
        id=np.arange(count), position=center, quaternion=np.tile([1.0, 0.0, 0.0, 0.0], (count, 1)),
        velocity=np.zeros((count, 6)), mass=np.ones(count), inertia=np.ones((count, 3)),
        material=np.zeros(count, np.int64), shape=np.full(count, SPHERE), weight=np.zeros(count),
        size=np.stack([radius, np.zeros(count), np.zeros(count)], axis=1),
    )  # fmt: skip
    every = bodies.concatenate([table, world.large])
    near = Neighbourhood(every, np.zeros(count), np.arange(len(every)), count, 0)
    parts = primitives(near, [body.shapes for body in world.large_bodies], count, world.forms).now(near)
    i, j = [np.zeros(0, np.int64)], [np.zeros(0, np.int64)]
    for part in range(count, len(parts.kind)):
        way = center - parts.center[part]
        if parts.kind[part] == PLANE:
            rows = np.flatnonzero(way @ parts.size[part] <= radius)
        else:
            rows = np.flatnonzero((way**2).sum(axis=1) <= (radius + parts.radius[part]) ** 2)
        i.append(rows)
        j.append(np.full(len(rows), part))
    one, other = np.concatenate(i), np.concatenate(j)
    apart = np.ones(count, bool)
    apart[one[touches(parts, one, other, np.zeros(len(one))).pair]] = False
    return apart


