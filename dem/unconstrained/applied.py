"""Impulses of loads and springs on the bodies of a world in a step."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np
from mpi4py import MPI

from dem import bodies
from dem.arrays import Bools, Floats, Ints
from dem.free_motion import free_velocity, velocity_changes
from dem.model.world import World
from dem.parts import springs
from dem.parts.loads import Load
from dem.parts.springs import Ends
from dem.together import SceneError, together
from dem.unconstrained.drives import as_motions_allow, free_directions


@dataclass(frozen=True)
class Applied:
    """Impulses and angular impulses of loads and springs over a step [N s, N m s]."""

    grains: Floats  #: (grains, 6) of this rank
    large: Floats  #: (large, 6), the same on all ranks; zero on bodies of prescribed motion
    springs: Floats  #: (springs, 3) impulses on the second ends, the same on all ranks
    #: (springs, 2, 6) velocities of the ends after the step, see `dem.parts.springs.impulses`
    expected: Floats | None = None


def applied_impulses(world: World, dt: float, given: Floats) -> Applied | None:
    """What loads and springs give in the next step of dt [s] in which motions give the velocities `given` (large, 6);
    None without any; collective. SceneError if a law fails, or if dt is too large for the springs."""
    if not (world.loads or world.springs):
        return None
    grains, large = np.zeros_like(world.grains.velocity), np.zeros_like(world.large.velocity)
    for name, load in world.loads.items():
        of_large = np.array([body.name == load.on for body in world.large_bodies], bool)
        of_one = bool(of_large.any())
        table, out = (world.large, large) if of_one else (world.grains, grains)
        rows = of_large if of_one else _chosen(world, load)
        call = partial(load.impulses, world.time, dt, table.take(rows))
        found = together(world.comm, f"load {name!r}", call)
        out[rows] += world.comm.bcast(found) if of_one else found  # processors may round in other ways
    return _with_springs(world, grains, large, given, dt)


def _chosen(world: World, load: Load) -> Ints | Bools:
    """The rows or the mask of this rank's grains that have a load."""
    if isinstance(load.on, str):
        return world.grains.material == world.materials.index(load.on)
    return np.arange(len(world.grains)) if load.on is None else np.isin(world.grains.id, load.on)


def _with_springs(world: World, grains: Floats, large: Floats, given: Floats, dt: float) -> Applied:
    """The impulses of loads and those of springs; collective."""
    if not world.springs:
        return Applied(grains, large, np.zeros((0, 3)))
    members = list(world.springs.values())
    ends = [end for spring in members for end in spring.ends]
    ids = np.unique([end for end in ends if isinstance(end, int)]).astype(np.int64)
    many, first = len(ids) + len(world.large), len(ids)
    row = np.array([row_of(world, ids, end) for end in ends]).reshape(-1, 2)
    table = ends_of(world, ids, grains, large, given, dt)
    found = springs.impulses(members, row, table, world.expected, dt) if world.comm.rank == 0 else None
    g, change, expected, highest = world.comm.bcast(found)  # processors may round in other ways
    if dt * highest >= 2.0:
        raise SceneError(
            f"the springs {', '.join(world.springs)[:200]} have frequencies up to {highest:.3g} rad/s: -dt {dt:g} s is "
            f"too large for them; take less than {2.0 / highest:.3g} s, and a tenth of that to resolve them"
        )
    here = np.flatnonzero(np.isin(world.grains.id, ids))
    grains[here] += change[np.searchsorted(ids, world.grains.id[here])]
    large[:] += np.where(bodies.is_dynamic(world.large)[:, None], change[first:many], 0.0)
    return Applied(grains, large, g, expected)


def row_of(world: World, ids: Ints, end: springs.End) -> int:
    """The row of the end of a spring among the grains `ids`, the large bodies and the world."""
    if isinstance(end, int):
        return int(np.searchsorted(ids, end))
    return len(ids) + (len(world.large) if end is None else world.large_row(end))


def ends_of(world: World, ids: Ints, grains: Floats, large: Floats, given: Floats, dt: float) -> Ends:
    """The grains of these ids, the large bodies and the world, with impulses (grains, 6) and (large, 6); collective."""
    here = np.flatnonzero(np.isin(world.grains.id, ids))
    own = world.grains.take(here)
    change = velocity_changes(own, grains[here])
    free = free_velocity(own, world.gravity, dt) + change
    root = bodies.inverse_root_inertia(own)
    columns = own.position, own.quaternion, own.velocity, free, 1.0 / own.mass[:, None], (root @ root).reshape(-1, 9)
    gathered = np.zeros((len(ids), 35))
    gathered[np.searchsorted(ids, own.id)] = np.concatenate([*columns, own.inertia, change[:, 3:]], axis=1)
    world.comm.Allreduce(MPI.IN_PLACE, gathered)  # each row is that of one rank
    parts = np.split(gathered, np.cumsum([3, 4, 6, 6, 1, 9, 3]), axis=1)
    position, turn, velocity, free, light, inverse_inertia, moments, pushes = parts
    tools = world.large
    change = velocity_changes(tools, large)
    pushed = free_velocity(tools, world.gravity, dt) + change
    root = bodies.inverse_root_inertia(tools)
    translation = free_directions(world.large_bodies) / tools.mass[:, None, None]
    inverse = np.zeros((len(ids) + len(tools) + 1, 6, 6))
    inverse[:, :3, :3] = np.concatenate([light[:, :, None] * np.eye(3), translation, np.zeros((1, 3, 3))])
    inverse[:, 3:, 3:] = np.concatenate([inverse_inertia.reshape(-1, 3, 3), root @ root, np.zeros((1, 3, 3))])
    return Ends(
        np.concatenate([position, tools.position, np.zeros((1, 3))]),
        np.concatenate([turn, tools.quaternion, [[1.0, 0.0, 0.0, 0.0]]]),
        np.concatenate([velocity, tools.velocity, np.zeros((1, 6))]),
        np.concatenate([free, as_motions_allow(world, pushed, given), np.zeros((1, 6))]),
        inverse,
        np.concatenate([moments, tools.inertia, np.full((1, 3), np.inf)]),
        np.concatenate([pushes, change[:, 3:], np.zeros((1, 3))]),
    )
