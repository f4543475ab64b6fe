"""The motion of the bodies over a step without contacts: gravity, spin, forces of parts, drives, prescribed motions.

It is found once, at the start of a step, and handed on: the search for contacts, the contact problem, the advance and
the record take what they need from it. Nothing else of a step asks motions and forces.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from dem import bodies
from dem.arrays import Floats, Ints
from dem.free_motion import falling, free_velocity, spin_freely, velocity_changes
from dem.model.neighbourhood import Neighbourhood
from dem.model.world import World
from dem.motion import Pose
from dem.together import together
from dem.unconstrained.applied import Applied, applied_impulses
from dem.unconstrained.drives import Drives, drives_of, velocities_of_motions

if TYPE_CHECKING:
    from dem.unconstrained.constraints import Coupling


@dataclass(frozen=True)
class UnconstrainedMotion:
    """The motion over a step without contacts."""

    dt: float  #: [s]
    poses: dict[int, Pose]  #: of large bodies of prescribed motion at the end of the step, by row
    #: (large, 6) mean velocities that motions give, see `dem.unconstrained.drives.velocities_of_motions` [m/s, rad/s]
    motion_velocities: Floats
    prescribed: Floats  #: (large, 6) of prescribed motions the same; other bodies keep theirs
    applied: Applied | None  #: what parts give; None without any
    drives: Drives  #: of the large bodies, the same on all ranks
    grains: Floats  #: (grains, 6) velocities of this rank's grains [m/s, rad/s]
    #: (owned, 6) mass-scaled momenta that contacts are expected to give, about which bodies that are no spheres and
    #: constraints are linearised; None until contacts are known, and if all bodies turn as spheres do
    push: Floats | None = None
    coupling: Coupling | None = None  #: by constraints, with that push, and what contacts have shown; likewise None

    def with_saturated(self, world: World, saturated: Ints) -> UnconstrainedMotion:
        """The same with drives that give all their strength, see `Drives.saturated`; collective."""
        return replace(self, drives=_drives(world, self.dt, self.motion_velocities, self.applied, saturated))


def unconstrained(world: World, dt: float) -> UnconstrainedMotion:
    """Return the motion over the next step of dt [s] without contacts; collective. SceneError if a motion or a part
    fails."""
    if not 0.0 < dt < math.inf:
        raise ValueError(f"time step must be positive, got {dt:g}")
    poses = world.poses(world.time + dt)
    prescribed = motion_velocities = velocities_of_motions(world, poses, dt)
    if world.large_moves:
        moves = bodies.is_dynamic(world.large)[:, None]
        prescribed = np.where(moves, world.large.velocity, motion_velocities)
    applied, grains = applied_impulses(world, dt, motion_velocities), free_velocity(world.grains, world.gravity, dt)
    if applied is not None:
        grains += velocity_changes(world.grains, applied.grains)
    drives = _drives(world, dt, motion_velocities, applied, np.zeros(len(world.large), int))
    return UnconstrainedMotion(dt, poses, motion_velocities, prescribed, applied, drives, grains)


def _drives(world: World, dt: float, motion_velocities: Floats, applied: Applied | None, saturated: Ints) -> Drives:
    pushed = None if applied is None else applied.large
    call = partial(drives_of, world, dt, motion_velocities, pushed, saturated)
    return together(world.comm, "motion of a large body", call) if world.large_moves else call()


def large_velocity(world: World, free: UnconstrainedMotion, velocity: Floats) -> Floats:
    """Those (large, 6) of the large bodies, on all ranks, of the velocities (owned, 6) over the step of the bodies
    whose rows each rank owns; collective."""
    if not world.large_moves:
        return free.prescribed
    large = np.zeros(world.large.velocity.shape)
    count = len(world.grains)
    large[: len(velocity) - count] = velocity[count:]  # all of them on the last rank, none elsewhere
    world.comm.Bcast(large, root=world.comm.size - 1)
    return large


def free_velocities(
    world: World, near: Neighbourhood, free: UnconstrainedMotion, change: Floats | None
) -> tuple[Floats, Floats | None]:
    """Velocities (rows, 6) of all bodies of `near` over a step without contacts, of which those of ghosts are not yet
    right; and the angular ones (owned, 3) about which they are linear in the impulses, see
    `dem.free_motion.free_spin`, NaN where they are so anywhere. None without a `change` (owned, 6), what contacts are
    expected to change."""
    table, first = near.bodies, near.grains + near.ghosts
    velocity, _ = falling(table.velocity, table.mass, table.shape, world.gravity, free.dt)
    pushed = None
    if free.applied is not None:
        pushed = velocity_changes(world.grains, free.applied.grains)
        velocity[: near.grains] += pushed
    velocity[first:] = free.drives.free
    if change is None:
        return velocity, None
    owned = len(change)
    given = np.zeros((owned, 3))
    if pushed is not None:
        given[: near.grains] = pushed[:, 3:]
    if world.large_moves and owned > near.grains and free.drives.impulse.any():  # of the last rank, which has no ghosts
        given[near.grains :] = velocity_changes(world.large, free.drives.impulse)[:, 3:]
    return velocity, spin_freely(table, velocity, given, change, free.dt)
