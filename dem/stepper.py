"""The semi-implicit step: new velocities come from the contact problem, and positions follow them."""

from __future__ import annotations

from copy import copy
from dataclasses import replace

from dem import quaternion
from dem.arrays import Floats
from dem.bodies import Bodies
from dem.motion import Dynamic, checked_pose
from dem.together import together
from dem.world import World


def advance(world: World, velocity: Floats, dt: float) -> None:
    """Take the velocities (owned, 6) of `ContactSystem.velocity` and move all bodies by dt [s]; collective.

    x <- x + dt v, q <- exp(dt w) q. Prescribed motions are followed exactly, whatever dt; SceneError if one fails.
    """
    large_velocity = world.large_velocity(velocity)
    _move(world.grains, velocity[: len(world.grains)], dt)
    _move(world.large, large_velocity, dt)
    world.time += dt
    world.step += 1
    follow_motions(world)


def advanced(world: World, velocity: Floats, dt: float) -> World:
    """The world that `advance` leads to; this one stays as it is. Collective."""
    after = copy(world)
    after.grains, after.large = replace(world.grains), replace(world.large)
    advance(after, velocity, dt)
    return after


def follow_motions(world: World) -> None:
    """Put the bodies of prescribed motion where they are to be now; collective. SceneError if a motion fails."""

    def follow() -> None:
        for row, body in enumerate(world.large_bodies):
            if not isinstance(body.motion, Dynamic):
                pose = checked_pose(body.motion, world.time, body.position, body.quaternion)
                world.large.position[row], world.large.quaternion[row] = pose

    together(world.comm, "motion of a large body", follow)


def _move(table: Bodies, velocity: Floats, dt: float) -> None:
    table.velocity = velocity.copy()
    table.position = table.position + dt * velocity[:, :3]
    table.quaternion = quaternion.integrate(table.quaternion, velocity[:, 3:], dt)
