"""Worlds from a scene at time zero, or from the state of an earlier run; each rank gets its grains."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields

import numpy as np
from mpi4py import MPI

from dem import bodies, stiffness
from dem.arrays import Ints
from dem.bodies import Bodies
from dem.contact import find_contacts
from dem.partition import redistribute
from dem.scene import Scene
from dem.step import follow_motions
from dem.world import World


def new_world(scene: Scene, comm: MPI.Comm, overlap: float = 0.01) -> World:
    """The scene at time zero, distributed; collective.

    Bodies of prescribed motion are where their motions put them at time zero. ValueError if there is no grain, or if
    grains overlap each other or a large body by more than `overlap` radii; SceneError if a motion fails.
    """
    grains = scene.grains()
    world = _world(scene, comm, grains.take(even_slice(len(grains), comm)))
    follow_motions(world)
    redistribute(world)
    _refuse_overlap(world, overlap)
    return world


def restored_world(
    scene: Scene, comm: MPI.Comm, local: Mapping[str, np.ndarray], replicated: Mapping[str, np.ndarray]
) -> World:
    """The world whose `World.state` was taken, for the same scene; collective.

    `local`: the rows `restart_rows` of every local array. If the number of ranks is that of the state, the restored
    world is the same to the last bit; otherwise the grains are distributed anew. ValueError if the scene has other
    bodies than the state.
    """
    world = _world(scene, comm, Bodies(**{name: np.array(column) for name, column in local.items()}))
    count = len(scene.grains())
    large = {field.name: np.array(replicated[f"large_{field.name}"]) for field in fields(Bodies)}
    if world.slabs[-1] != count or len(large["id"]) != len(world.large):
        raise ValueError(
            f"the state has {world.slabs[-1]} grains and {len(large['id'])} large bodies, "
            f"the scene {count} and {len(world.large)}"
        )
    world.large = Bodies(**large)
    world.time, world.step = float(replicated["time"]), int(replicated["step"])
    if len(replicated["slabs"]) != comm.size + 1:
        redistribute(world)
    return world


def restart_rows(slabs: Ints, comm: MPI.Comm) -> slice:
    """Rows of a whole state's grain arrays that this rank hands to `restored_world`; slabs as in the state."""
    if len(slabs) == comm.size + 1:
        return slice(int(slabs[comm.rank]), int(slabs[comm.rank + 1]))
    return even_slice(int(slabs[-1]), comm)


def even_slice(count: int, comm: MPI.Comm) -> slice:
    """This rank's part of so many rows, in the order of the ranks."""
    return slice(count * comm.rank // comm.size, count * (comm.rank + 1) // comm.size)


def _world(scene: Scene, comm: MPI.Comm, grains: Bodies) -> World:
    stiff = comm.bcast(stiffness.table(scene))  # of one processor
    tables = scene.friction_table(), stiff, scene.restitution_table()
    return World(comm, tuple(scene.large_bodies), scene.gravity, *tables, scene.materials, grains, scene.large())


def _refuse_overlap(world: World, overlap: float) -> None:
    """ValueError, on all ranks, that names the worst pair if bodies overlap by more than `overlap` radii."""
    contacts = find_contacts(world, 0.0)
    world.grains.weight[:] = 0.0
    table = contacts.near.bodies
    worst = (0.0, 0.0, -1, -1)
    if len(contacts):
        radius = bodies.bounding_radius(table)
        radius[table.shape == bodies.COMPOUND] = np.inf
        relative = -contacts.gap / np.minimum(radius[contacts.a], radius[contacts.b])
        c = int(np.argmax(relative))
        a, b = int(table.id[contacts.a[c]]), int(table.id[contacts.b[c]])
        worst = (float(relative[c]), float(-contacts.gap[c]), a, b)
    relative_depth, depth, a, b = world.comm.allreduce(worst, MPI.MAX)
    if relative_depth > overlap:
        names = [
            f"grain {i}" if i < world.slabs[-1] else f"body {world.large_bodies[i - world.slabs[-1]].name!r}"
            for i in (a, b)
        ]
        raise ValueError(f"overlapping start: {names[0]} and {names[1]} overlap by {depth:g} m")
