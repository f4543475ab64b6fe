"""Impulses of the parts of a scene on the bodies of a world in a step."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np
from mpi4py import MPI

from dem import bodies
from dem.arrays import Floats, Ints
from dem.compiled import loop
from dem.free_motion import free_velocity, velocity_changes
from dem.model.world import World
from dem.parts.ends import End, Ends, Tie
from dem.parts.named import Force
from dem.scene import kinds_of
from dem.unconstrained.drives import as_motions_allow, free_directions


@dataclass(frozen=True)
class Applied:
    """Impulses and angular impulses of parts over a step of dt [s], in which motions give large bodies the
    `motion_velocities` [N s, N m s]."""

    dt: float
    motion_velocities: Floats  #: (large, 6) [m/s, rad/s]
    grains: Floats  #: (grains, 6) of this rank
    large: Floats  #: (large, 6), the same on all ranks; zero on bodies of prescribed motion
    memory: dict[str, Floats] = field(default_factory=dict)  #: by kind, see `dem.parts.named.Force.act`

    def ends(self, world: World, members: Mapping[str, Tie]) -> Ends:
        """The bodies at the ends of parts, with the impulses so far; collective."""
        return ends_of(world, members.values(), self.grains, self.large, self.motion_velocities, self.dt)

    def add(self, world: World, ends: Ends, impulse: Floats) -> None:
        """Add impulses (n, 6) on these bodies; no force moves large bodies of prescribed motion."""
        first, (here, slot) = len(ends.ids), slots_of(ends.ids, world.first_large, world.grains.id)
        self.grains[here] += impulse[slot]
        self.large[:] += np.where(bodies.is_dynamic(world.large)[:, None], impulse[first:-1], 0.0)


def applied_impulses(world: World, dt: float, motion_velocities: Floats) -> Applied | None:
    """What parts give in the next step of dt [s], in which large bodies have the `motion_velocities` (large, 6) that
    motions give; None without any; collective. SceneError if a part fails."""
    kinds = kinds_of(Force, world.named)
    if not kinds:
        return None
    grains, large = np.zeros(world.grains.velocity.shape), np.zeros(world.large.velocity.shape)
    applied = Applied(dt, motion_velocities, grains, large)
    for kind, acting, members in kinds:
        memory = acting.act(members, world, applied)
        if memory is not None:
            applied.memory[kind] = memory
    return applied


def rows_of(world: World, parts: Iterable[Tie]) -> tuple[Ints, Ints]:
    """The ids of the grains at the ends of n parts, in order, and the rows (n, 2) of their ends among these, the large
    bodies and the world."""
    return _rows_of(tuple(part.ends for part in parts), tuple(body.name for body in world.large_bodies))


@lru_cache(maxsize=64)  # parts come and go with no step
def _rows_of(ends: tuple[tuple[End, End], ...], large: tuple[str, ...]) -> tuple[Ints, Ints]:
    grains = sorted({end for pair in ends for end in pair if isinstance(end, int)})
    names = [*grains, *large, None]
    row = {name: number for number, name in enumerate(names)}
    return np.array(grains, np.int64), np.array([[row[end] for end in pair] for pair in ends]).reshape(-1, 2)


@loop
def slots_of(ids: Ints, first: int, id: Ints) -> tuple[Ints, Ints]:
    """Which rows of bodies with the ids `id` (n,) are among the grains of `ids`, in order, and the large bodies, whose
    ids begin with the `first`; and their rows there."""
    here, slot, found = np.empty(len(id), np.int64), np.empty(len(id), np.int64), 0
    for n in range(len(id)):
        at = len(ids) + id[n] - first if id[n] >= first else np.searchsorted(ids, id[n])
        if id[n] >= first or (at < len(ids) and ids[at] == id[n]):
            here[found], slot[found] = n, at
            found += 1
    return here[:found].copy(), slot[:found].copy()


COLUMNS = (0, 3, 7, 13, 19, 20, 29, 32, 35)  #: where what ranks tell of the grains at ends begins


def ends_of(
    world: World, parts: Iterable[Tie], grains: Floats, large: Floats, motion_velocities: Floats, dt: float
) -> Ends:
    """The bodies at the ends of parts, with impulses (grains, 6) and (large, 6); collective."""
    ids, row = rows_of(world, parts)
    here, slot = slots_of(ids, world.first_large, world.grains.id)
    own = world.grains.take(here)
    change = velocity_changes(own, grains[here])
    free = free_velocity(own, world.gravity, dt) + change
    light, turning = 1.0 / np.sqrt(own.mass)[:, None], bodies.inverse_root_inertia(own).reshape(-1, 9)
    state = own.position, own.quaternion, own.velocity, free, light, turning, own.inertia, change[:, 3:]
    gathered = np.zeros((len(ids), 35))
    gathered[slot] = np.concatenate(state, axis=1)
    world.comm.Allreduce(MPI.IN_PLACE, gathered)  # each row is that of one rank
    columns = [gathered[:, first:end] for first, end in zip(COLUMNS, COLUMNS[1:])]
    position, turn, velocity, free, light, turning, moments, pushes = columns
    tools = world.large
    change = velocity_changes(tools, large)
    pushed = free_velocity(tools, world.gravity, dt) + change
    root, first = np.zeros((len(ids) + len(tools) + 1, 6, 6)), len(ids)
    root[:first, [0, 1, 2], [0, 1, 2]], root[:first, 3:, 3:] = light, turning.reshape(-1, 3, 3)
    root[first:-1, :3, :3] = free_directions(world.large_bodies) / np.sqrt(tools.mass)[:, None, None]
    root[first:-1, 3:, 3:] = bodies.inverse_root_inertia(tools)
    return Ends(
        ids,
        row,
        np.concatenate([position, tools.position, np.zeros((1, 3))]),
        np.concatenate([turn, tools.quaternion, [[1.0, 0.0, 0.0, 0.0]]]),
        np.concatenate([velocity, tools.velocity, np.zeros((1, 6))]),
        np.concatenate([free, as_motions_allow(world, pushed, motion_velocities), np.zeros((1, 6))]),
        root,
        np.concatenate([moments, tools.inertia, np.full((1, 3), np.inf)]),
        np.concatenate([pushes, change[:, 3:], np.zeros((1, 3))]),
    )
