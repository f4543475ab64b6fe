"""The motion of the bodies without contact forces, over one step."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dem import bodies, quaternion
from dem.arrays import Floats
from dem.bodies import SPHERE, Bodies
from dem.loops import loops
from dem.motion import Dynamic, Guided, Hinged
from dem.neighbourhood import Neighbourhood
from dem.quaternion import cross
from dem.scene import LargeBody
from dem.world import World

#: Newton steps for the spin of a body at most, the relative change of the spin after which the next one would change
#: nothing, and the relative error of the angular momentum at which they have converged.
NEWTON_STEPS, LAST_CHANGE, CONVERGED = 4, 1e-8, 1e-6


def free_velocity(table: Bodies, gravity: Floats, dt: float) -> Floats:
    """Velocities (n, 6) after dt [s] under gravity (3,), explicit, and the gyroscopic torque -w x I w, implicit.

    Rows of bodies with prescribed motion come back as they are.
    """
    velocity = table.velocity.copy()
    dynamic = bodies.is_dynamic(table)
    velocity[:, :3] += np.outer(dynamic, dt * gravity)
    # The torque vanishes where all moments are equal, as for spheres.
    rows = np.flatnonzero(dynamic & (table.shape != SPHERE))
    if not len(rows):
        return velocity
    a, b, c = table.inertia[rows].T
    rows = rows[np.isfinite(a + b + c) & ((a != b) | (b != c))]  # guided bodies do not turn
    velocity[rows, 3:] = free_spin(table.quaternion[rows], velocity[rows, 3:], table.inertia[rows], dt)
    return velocity


def free_spin(turn: Floats, spin: Floats, moments: Floats, dt: float) -> Floats:
    """Angular velocities (n, 3) [rad/s] after dt [s] without torque, from `spin` (n, 3), of bodies with orientations
    `turn` (n, 4) at the start of the step and principal moments (n, 3). All vectors are in the world frame.

    A step turns a body by exp(dt w). In the middle of it the body has the angular momentum exp(dt/2 w) I w in the frame
    of its start, and in the middle of the last step it had exp(-dt/2 w_old) I w_old. Newton's method makes the two
    equal. So the angular momentum is kept (to rounding below half a radian a step), and the energy to O(dt^2): with
    an explicit torque it would grow without bound. Compare Simo and Wong, International Journal for Numerical Methods
    in Engineering 31, 1991. A body that turns by much more than a radian in a step, for which Newton's method does not
    converge, keeps its spin: no such step resolves its motion.
    """
    if compiled := loops():
        arrays = (np.ascontiguousarray(array) for array in (turn, spin, moments))
        return compiled.free_spin(*arrays, dt, NEWTON_STEPS, LAST_CHANGE, CONVERGED)
    half = 0.5 * dt
    moments = moments / moments.max(axis=1, keepdims=True)  # nothing but their ratios counts
    # The search finds lost bodies. A body that turns too far may have a singular slope: its spin is no number then.
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        start = quaternion.rotate(quaternion.conjugate(turn), spin)
        momentum, new = _turned(-half * start, moments * start), start
        for _ in range(NEWTON_STEPS):
            middle = _turned(half * new, moments * new)
            change = _solve(_slope(new, moments, middle, half), momentum - middle)
            new = new + change
            if (quaternion.length(change) <= LAST_CHANGE * quaternion.length(start)).all():
                break
        solved = _turned(-half * new, momentum) / moments
        error = quaternion.length(moments * (solved - new))
        converged = (error <= CONVERGED * quaternion.length(momentum))[:, None]
        return np.where(converged, quaternion.rotate(turn, solved), spin)


def _slope(spin: Floats, moments: Floats, middle: Floats, half: float) -> Floats:
    """Derivatives (n, 3, 3) of the angular momenta `middle` (n, 3) in the middle of the step by the spins (n, 3)."""
    across = half * _cross_matrix(spin)
    turn = np.eye(3) + across / 2 + across @ across / 6  # a turn by v changes with v by 1 + [v]/2 + [v]^2/6 + ...
    matrix = quaternion.matrix(quaternion.exponential(half * spin))
    return matrix * moments[:, None, :] - half * _cross_matrix(middle) @ turn


def _solve(matrices: Floats, right: Floats) -> Floats:
    """Solutions (n, 3) for matrices (n, 3, 3), by Cramer's rule; no numbers where they are singular."""
    a, b, c = np.moveaxis(matrices, 2, 0)
    across = cross(b, c)
    parts = [across, cross(c, a), cross(a, b)]
    return np.einsum("knj,nj->nk", parts, right) / np.einsum("nj,nj->n", a, across)[:, None]


def _turned(rotation: Floats, vectors: Floats) -> Floats:
    """Vectors (n, 3), turned by rotation vectors (n, 3)."""
    return quaternion.rotate(quaternion.exponential(rotation), vectors)


def _cross_matrix(v: Floats) -> Floats:
    """Matrices (n, 3, 3) of the cross products with vectors (n, 3)."""
    return cross(v[:, None, :], np.eye(3)).transpose(0, 2, 1)


def free_velocities(world: World, near: Neighbourhood, dt: float) -> Floats:
    """Velocities (rows, 6) of all bodies of `near` over a step of dt [s] without contacts."""
    grains = near.bodies.take(slice(0, near.grains + near.ghosts))
    return np.concatenate([free_velocity(grains, world.gravity, dt), large_free_velocity(world, dt)])


def large_free_velocity(world: World, dt: float) -> Floats:
    """Velocities (large bodies, 6) over a step of dt [s] without contacts: guided bodies along their guides with the
    forces of their drives, hinged ones with their torques, prescribed ones on their paths."""
    table = world.large
    free, drive = free_velocity(table, world.gravity, dt), drive_impulses(world, dt)
    free[:, :3] += drive[:, :3] / table.mass[:, None]
    free[:, 3:] += drive[:, 3:] / table.inertia[:, 2:]  # the z axis of a hinged body is that of its hinge
    free[:, :3] = project(free_directions(world.large_bodies), free[:, :3])
    prescribed = ~bodies.is_dynamic(table)
    free[prescribed] = world.prescribed_velocity(dt)[prescribed]
    return free


def drive_impulses(world: World, dt: float) -> Floats:
    """Impulses and angular impulses (large bodies, 6) of drives over a step of dt [s], zero where there is none."""
    impulse = np.zeros_like(world.large.velocity)
    free = free_velocity(world.large, world.gravity, dt)
    for row, body in enumerate(world.large_bodies):
        motion = body.motion
        if isinstance(motion, Guided):
            lack = body.mass / dt * ((motion.speed or 0.0) - float(free[row, :3] @ motion.direction))
            impulse[row, :3] = dt * motion.mean_force(world.time, dt, lack)
        elif isinstance(motion, Hinged):
            lack = body.inertia[2] / dt * ((motion.speed or 0.0) - float(free[row, 3:] @ motion.axis))
            impulse[row, 3:] = dt * motion.mean_torque(world.time, dt, lack)
    return impulse


def free_directions(members: Sequence[LargeBody]) -> Floats:
    """Projectors (large, 3, 3) on the directions that are open to the velocities of large bodies."""
    open_to = [body.motion.free_directions() if isinstance(body.motion, Dynamic) else np.eye(3) for body in members]
    return np.array(open_to).reshape(len(members), 3, 3)


def project(projectors: Floats, vectors: Floats) -> Floats:
    """Products (n, 3) of matrices (n, 3, 3) and vectors (n, 3)."""
    return (projectors @ vectors[:, :, None])[:, :, 0]
