"""The motion of the bodies without contact forces, over one step."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dem import bodies, quaternion
from dem.arrays import Floats
from dem.bodies import SPHERE, Bodies
from dem.motion import Dynamic, Guided, Hinged
from dem.neighbourhood import Neighbourhood
from dem.quaternion import cross
from dem.scene import LargeBody
from dem.world import World


def free_velocity(table: Bodies, gravity: Floats, dt: float) -> Floats:
    """Velocities (n, 6) after dt [s] under gravity (3,) and the gyroscopic torque -w x I w, explicit in both.

    Rows of bodies with prescribed motion come back as they are.
    """
    velocity = table.velocity.copy()
    dynamic = bodies.is_dynamic(table)
    velocity[:, :3] += np.outer(dynamic, dt * gravity)
    # The torque vanishes where all moments are equal, as for spheres.
    rows = np.flatnonzero(dynamic & (table.shape != SPHERE))
    if not len(rows):
        return velocity
    rows = rows[np.isfinite(table.inertia[rows]).all(axis=1)]  # guided bodies do not turn
    rows = rows[np.ptp(table.inertia[rows], axis=1) > 0.0]
    turn, moments = table.quaternion[rows], table.inertia[rows]
    spin = quaternion.rotate(quaternion.conjugate(turn), velocity[rows, 3:])
    velocity[rows, 3:] += dt * quaternion.rotate(turn, -cross(spin, moments * spin) / moments)
    return velocity


def free_velocities(world: World, near: Neighbourhood, dt: float) -> Floats:
    """Velocities (rows, 6) of all bodies of `near` over a step of dt [s] without contacts."""
    grains = near.bodies.take(slice(0, near.grains + near.ghosts))
    return np.concatenate([free_velocity(grains, world.gravity, dt), large_free_velocity(world, dt)])


def large_free_velocity(world: World, dt: float) -> Floats:
    """Velocities (large bodies, 6) over a step of dt [s] without contacts: guided bodies along their guides with the
    forces of their drives, hinged ones with their torques, prescribed ones on their paths."""
    free = free_velocity(world.large, world.gravity, dt)
    for row, body in enumerate(world.large_bodies):
        motion = body.motion
        if isinstance(motion, Guided):
            lack = body.mass / dt * ((motion.speed or 0.0) - float(free[row, :3] @ motion.direction))
            free[row, :3] += dt / body.mass * motion.force_at(world.time, lack)
        elif isinstance(motion, Hinged):
            moment = body.inertia[2]
            lack = moment / dt * ((motion.speed or 0.0) - float(free[row, 3:] @ motion.axis))
            free[row, 3:] += dt / moment * motion.torque_at(world.time, lack)
    free[:, :3] = project(free_directions(world.large_bodies), free[:, :3])
    prescribed = ~bodies.is_dynamic(world.large)
    free[prescribed] = world.prescribed_velocity(dt)[prescribed]
    return free


def free_directions(members: Sequence[LargeBody]) -> Floats:
    """Projectors (large, 3, 3) on the directions that are open to the velocities of large bodies."""
    open_to = [body.motion.free_directions() if isinstance(body.motion, Dynamic) else np.eye(3) for body in members]
    return np.array(open_to).reshape(len(members), 3, 3)


def project(projectors: Floats, vectors: Floats) -> Floats:
    """Products (n, 3) of matrices (n, 3, 3) and vectors (n, 3)."""
    return (projectors @ vectors[:, :, None])[:, :, 0]
