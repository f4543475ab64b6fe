"""What the motions of large bodies allow, and what their drives do in a step."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from dem.arrays import Floats, Ints
from dem.free_motion import free_velocity, velocity_changes
from dem.motion import DROOP, Driven, Dynamic, Guided, Pose, velocity_between
from dem.scene import LargeBody
from dem.together import together

if TYPE_CHECKING:
    from dem.model.world import World


@dataclass(frozen=True)
class Drives:
    """What drives, loads and springs do to the large bodies in a step."""

    impulse: Floats  #: (large, 6) impulses and angular impulses, of servos if nothing touches their bodies
    pushed: Floats  #: (large, 6) what of these loads and springs give
    line: Floats  #: (large, 6) unit vectors of the lines of drives
    servo_inertia: Floats  #: (large,) what servos add to the inertia along them [kg or kg m^2], see `dem.motion.Driven`
    speed: Floats  #: (large,) that servos keep along them [m/s or rad/s]
    bound: Floats  #: (large,) greatest impulses of servos [N s or N m s]
    saturated: Ints  #: (large,) 1 or -1 of servos that contacts have shown to give all that, forward or back; else 0
    #: (large, 6) velocities over the step without contacts: guided bodies along their guides with the forces of their
    #: drives, hinged ones with their torques, prescribed ones on their paths
    free: Floats

    def refound(self, impulse: Floats, velocity: Floats) -> Ints | None:
        """``saturated`` as a step shows it to be right in which drives, loads and springs gave impulses (large, 6) and
        which ends with velocities (large, 6); None if that is what it is."""
        along, now = (np.einsum("bi,bi->b", self.line, x) for x in (impulse - self.pushed, velocity))
        weak = (self.servo_inertia > 0.0) & (np.abs(along) > (1.0 + DROOP) * self.bound)
        again = np.where(self.saturated * (self.speed - now) < 0.0, 0, self.saturated)
        saturated = np.where(weak, np.sign(along).astype(int), again)
        return None if np.array_equal(saturated, self.saturated) else saturated


def drives_of(world: World, dt: float, motion_velocities: Floats, pushed: Floats | None, saturated: Ints) -> Drives:
    """The drives of the next step of dt [s], the same on all ranks; `motion_velocities` (large, 6) are
    what motions give, `pushed` (large, 6): impulses of loads and springs, None without any."""
    table = world.large
    pushed = np.zeros(table.velocity.shape) if pushed is None else pushed
    impulse = pushed.copy()
    line, (servo_inertia, speed, bound) = np.zeros(impulse.shape), np.zeros((3, len(impulse)))
    if not world.large_moves:
        return Drives(impulse, pushed, line, servo_inertia, speed, bound, saturated, motion_velocities)
    free = falling = free_velocity(table, world.gravity, dt)
    if pushed.any():
        free = falling + velocity_changes(table, pushed)
    for row, body in enumerate(world.large_bodies):
        motion = body.motion
        if isinstance(motion, Driven):
            part, inertia = (slice(0, 3), body.mass) if isinstance(motion, Guided) else (slice(3, 6), body.inertia[2])
            line[row, part] = motion.line
            speed[row] = motion.speed or 0.0
            lack = inertia / dt * (speed[row] - float(free[row] @ line[row]))
            lack = saturated[row] * np.inf if saturated[row] else lack
            bound[row] = dt * motion.strength(world.time, dt)
            impulse[row, part] += dt * motion.mean_drive(world.time, dt, lack)
            before = float(world.large.velocity[row] @ line[row])
            servo_inertia[row] = motion.servo_inertia(world.time, dt, inertia, before, lack)
    if impulse.any():
        falling = falling + velocity_changes(table, impulse)
    end = as_motions_allow(world, falling, motion_velocities)
    return Drives(impulse, pushed, line, servo_inertia, speed, bound, saturated, end)


def velocities_of_motions(world: World, poses: dict[int, Pose], dt: float) -> Floats:
    """The mean velocities (large, 6) over a step of dt [s] that motions give: to bodies that they prescribe those which
    lead to the `poses`, to others what they hold, zero where these are free; collective. SceneError if a motion
    fails."""
    motion_velocities = np.zeros(world.large.velocity.shape)
    for row, end in poses.items():
        motion_velocities[row] = velocity_between((world.large.position[row], world.large.quaternion[row]), end, dt)

    def hold() -> None:
        for row, body in enumerate(world.large_bodies):
            if isinstance(motion := body.motion, Dynamic):
                motion_velocities[row] = motion.held(world.time, dt)

    if len(poses) < len(motion_velocities):
        together(world.comm, "motion of a large body", hold)
    return motion_velocities


def as_motions_allow(world: World, velocity: Floats, motion_velocities: Floats) -> Floats:
    """The velocities (large, 6) in the directions that motions leave free, in the others `motion_velocities`."""
    free = motion_velocities.copy()
    for row, body in enumerate(world.large_bodies):
        if isinstance(motion := body.motion, Dynamic):
            free[row, :3] += motion.free_directions() @ velocity[row, :3]
            free[row, 3:] += motion.free_turns() @ velocity[row, 3:]
    return free


def free_directions(members: Sequence[LargeBody]) -> Floats:
    """Projectors (large, 3, 3) on the directions that are open to the velocities of large bodies."""
    open_to = [body.motion.free_directions() if isinstance(body.motion, Dynamic) else np.eye(3) for body in members]
    return np.array(open_to).reshape(len(members), 3, 3)


def free_turns(members: Sequence[LargeBody]) -> Floats:
    """Projectors (large, 3, 3) on the axes about which torques can turn large bodies."""
    open_to = [body.motion.free_turns() if isinstance(body.motion, Dynamic) else np.eye(3) for body in members]
    return np.array(open_to).reshape(len(members), 3, 3)
