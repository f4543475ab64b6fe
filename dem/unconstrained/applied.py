"""Impulses of the parts of a scene on the bodies of a world in a step."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np
from mpi4py import MPI

from dem import bodies
from dem.arrays import Floats, Ints
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
        first = len(ends.ids)
        here = np.flatnonzero(np.isin(world.grains.id, ends.ids))
        self.grains[here] += impulse[np.searchsorted(ends.ids, world.grains.id[here])]
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


COLUMNS = (0, 3, 7, 13, 19, 20, 29, 32, 35)  #: where what ranks tell of the grains at ends begins


def ends_of(
    world: World, parts: Iterable[Tie], grains: Floats, large: Floats, motion_velocities: Floats, dt: float
) -> Ends:
    """The bodies at the ends of parts, with impulses (grains, 6) and (large, 6); collective."""
    ids, row = rows_of(world, parts)
    here = np.flatnonzero(np.isin(world.grains.id, ids))
    own = world.grains.take(here)
    change = velocity_changes(own, grains[here])
    free = free_velocity(own, world.gravity, dt) + change
    root = bodies.inverse_root_inertia(own)
    state = own.position, own.quaternion, own.velocity, free, 1.0 / own.mass[:, None], (root @ root).reshape(-1, 9)
    gathered = np.zeros((len(ids), 35))
    gathered[np.searchsorted(ids, own.id)] = np.concatenate([*state, own.inertia, change[:, 3:]], axis=1)
    world.comm.Allreduce(MPI.IN_PLACE, gathered)  # each row is that of one rank
    columns = [gathered[:, first:end] for first, end in zip(COLUMNS, COLUMNS[1:])]
    position, turn, velocity, free, light, inverse_inertia, moments, pushes = columns
    tools = world.large
    change = velocity_changes(tools, large)
    pushed = free_velocity(tools, world.gravity, dt) + change
    root = bodies.inverse_root_inertia(tools)
    translation = free_directions(world.large_bodies) / tools.mass[:, None, None]
    inverse = np.zeros((len(ids) + len(tools) + 1, 6, 6))
    inverse[:, :3, :3] = np.concatenate([light[:, :, None] * np.eye(3), translation, np.zeros((1, 3, 3))])
    inverse[:, 3:, 3:] = np.concatenate([inverse_inertia.reshape(-1, 3, 3), root @ root, np.zeros((1, 3, 3))])
    return Ends(
        ids,
        row,
        np.concatenate([position, tools.position, np.zeros((1, 3))]),
        np.concatenate([turn, tools.quaternion, [[1.0, 0.0, 0.0, 0.0]]]),
        np.concatenate([velocity, tools.velocity, np.zeros((1, 6))]),
        np.concatenate([free, as_motions_allow(world, pushed, motion_velocities), np.zeros((1, 6))]),
        inverse,
        np.concatenate([moments, tools.inertia, np.full((1, 3), np.inf)]),
        np.concatenate([pushes, change[:, 3:], np.zeros((1, 3))]),
    )
