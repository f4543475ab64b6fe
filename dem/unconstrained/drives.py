"""What the motions of large bodies allow, and what their drives do in a step."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from dem import bodies
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
    line: Floats  #: (large, 6) unit vectors of the lines of drives
    grip: Floats  #: (large,) what servos add to the inertia along them [kg or kg m^2], see `dem.motion.Driven`
    speed: Floats  #: (large,) that servos keep along them [m/s or rad/s]
    most: Floats  #: (large,) greatest impulses of servos [N s or N m s]
    spent: Ints  #: (large,) 1 or -1 of servos that contacts have shown to give all that, forward or back; else 0
    #: (large, 6) velocities over the step without contacts: guided bodies along their guides with the forces of their
    #: drives, hinged ones with their torques, prescribed ones on their paths
    free: Floats

    def refound(self, impulse: Floats, velocity: Floats) -> Ints | None:
        """``spent`` as a step shows it to be right in which the drives gave impulses (large, 6) and which ends with
        velocities (large, 6); None if that is what it is."""
        along, now = (np.einsum("bi,bi->b", self.line, x) for x in (impulse, velocity))
        weak = (self.grip > 0.0) & (np.abs(along) > (1.0 + DROOP) * self.most)
        again = np.where(self.spent * (self.speed - now) < 0.0, 0, self.spent)
        spent = np.where(weak, np.sign(along).astype(int), again)
        return None if np.array_equal(spent, self.spent) else spent


def drives_of(world: World, dt: float, given: Floats, pushed: Floats | None, spent: Ints) -> Drives:
    """The drives of the next step of dt [s], the same on all ranks; `given` (large, 6): the velocities that motions
    give, `pushed` (large, 6): impulses of loads and springs, None without any."""
    table, impulse = world.large, np.zeros(world.large.velocity.shape)
    line, (grip, speed, most) = np.zeros(impulse.shape), np.zeros((3, len(impulse)))
    if not bodies.is_dynamic(table).any():
        return Drives(impulse, line, grip, speed, most, spent, given)
    free = falling = free_velocity(table, world.gravity, dt)
    if pushed is not None:
        impulse += pushed
        free = falling + velocity_changes(table, impulse)
    for row, body in enumerate(world.large_bodies):
        motion = body.motion
        if isinstance(motion, Driven):
            part, inertia = (slice(0, 3), body.mass) if isinstance(motion, Guided) else (slice(3, 6), body.inertia[2])
            line[row, part] = motion.line
            speed[row] = motion.speed or 0.0
            lack = inertia / dt * (speed[row] - float(free[row] @ line[row]))
            lack = spent[row] * np.inf if spent[row] else lack
            most[row] = dt * motion.strength(world.time, dt)
            impulse[row, part] += dt * motion.mean_drive(world.time, dt, lack)
            grip[row] = motion.grip(world.time, dt, inertia, float(world.large.velocity[row] @ line[row]), lack)
    if impulse.any():
        falling = falling + velocity_changes(table, impulse)
    return Drives(impulse, line, grip, speed, most, spent, as_motions_allow(world, falling, given))


def given_velocities(world: World, poses: dict[int, Pose], dt: float) -> Floats:
    """The mean velocities (large, 6) over a step of dt [s] that motions give: to bodies that they prescribe those which
    lead to the `poses`, to others what they hold, zero where these are free; collective. SceneError if a motion
    fails."""
    given = np.zeros(world.large.velocity.shape)
    for row, end in poses.items():
        given[row] = velocity_between((world.large.position[row], world.large.quaternion[row]), end, dt)

    def hold() -> None:
        for row, body in enumerate(world.large_bodies):
            if isinstance(motion := body.motion, Dynamic):
                given[row] = motion.held(world.time, dt)

    if len(poses) < len(given):
        together(world.comm, "motion of a large body", hold)
    return given


def as_motions_allow(world: World, velocity: Floats, given: Floats) -> Floats:
    """The velocities (large, 6) in the directions that motions leave free, and in the others those `given`."""
    free = given.copy()
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
