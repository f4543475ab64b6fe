"""The motion of the bodies without contact forces, over one step."""

from __future__ import annotations

import numpy as np

from dem import bodies
from dem.arrays import Floats, Ints
from dem.bodies import SPHERE, Bodies
from dem.compiled import loop
from dem.vectors import cross, dot, plus, shares, turned


def free_velocity(table: Bodies, gravity: Floats, dt: float) -> Floats:
    """Velocities (n, 6) after dt [s] under gravity (3,), explicit, and the gyroscopic torque -w x I w, implicit.

    Rows of bodies with prescribed motion come back as they are.
    """
    with np.errstate(over="ignore"):  # `dem.neighbourhood` refuses bodies that are lost
        change = dt * gravity
    velocity, others = falling(table.velocity, table.mass, table.shape, change)
    if not others:  # the torque vanishes where all moments are equal, as for spheres
        return velocity
    rows = np.flatnonzero(bodies.is_dynamic(table) & (table.shape != SPHERE))
    a, b, c = table.inertia[rows].T
    rows = rows[np.isfinite(a + b + c) & ((a != b) | (b != c))]  # guided bodies do not turn
    velocity[rows, 3:] = free_spin(table.quaternion[rows], velocity[rows, 3:], table.inertia[rows], dt)
    return velocity


@loop
def falling(velocity: Floats, mass: Floats, shape: Ints, change: Floats) -> tuple[Floats, int]:
    """The velocities (n, 6), with a change (3,) of the linear ones of bodies whose mass (n,) is finite, and how many of
    these are no spheres."""
    out, others = velocity.copy(), 0
    for n in range(len(mass)):
        if np.isfinite(mass[n]):
            others += shape[n] != SPHERE
            for k in range(3):
                out[n, k] += change[k]
    return out, others


@loop
def free_spin(turn: Floats, spin: Floats, moments: Floats, dt: float) -> Floats:
    """Angular velocities (n, 3) [rad/s] after dt [s] without torque, from `spin` (n, 3), of bodies with orientations
    `turn` (n, 4) at the start of the step and principal moments (n, 3). All vectors are in the world frame.

    A step turns a body by exp(dt w). In the middle of it the body has the angular momentum exp(dt/2 w) I w in the frame
    of its start, and in the middle of the last step it had exp(-dt/2 w_old) I w_old. Newton's method makes the two
    equal: the angular momentum is kept, and the energy to O(dt^2) (compare Simo and Wong, International Journal for
    Numerical Methods in Engineering 31, 1991). A body that turns by much more than a radian, for which it does not
    converge, keeps its spin.
    """
    out = spin.copy()
    half = 0.5 * dt
    for n in range(len(spin)):
        frame, twice = (turn[n, 1], turn[n, 2], turn[n, 3]), 2.0 * turn[n, 0]
        w = turned((spin[n, 0], spin[n, 1], spin[n, 2]), frame, -twice, 2.0)
        largest = max(moments[n, 0], moments[n, 1], moments[n, 2])
        inertia = (moments[n, 0] / largest, moments[n, 1] / largest, moments[n, 2] / largest)
        rotation = plus(_ZERO, half, w)
        sine, versed = shares(rotation)
        momentum, new = turned(_each(inertia, w), rotation, -sine, versed), w
        for _ in range(4):  # enough below half a radian a step
            middle = turned(_each(inertia, new), rotation, sine, versed)
            change = _solve(
                _slope((inertia[0], 0.0, 0.0), (1.0, 0.0, 0.0), rotation, sine, versed, middle, half),
                _slope((0.0, inertia[1], 0.0), (0.0, 1.0, 0.0), rotation, sine, versed, middle, half),
                _slope((0.0, 0.0, inertia[2]), (0.0, 0.0, 1.0), rotation, sine, versed, middle, half),
                plus(momentum, -1.0, middle),
            )
            new = plus(new, 1.0, change)
            rotation = plus(_ZERO, half, new)
            sine, versed = shares(rotation)
            if dot(change, change) <= 1e-16 * dot(w, w):
                break  # the next change would be its square
        back = turned(momentum, rotation, -sine, versed)
        error = plus(back, -1.0, _each(inertia, new))
        if dot(error, error) <= 1e-12 * dot(momentum, momentum):  # else a step does not resolve the motion
            solved = back[0] / inertia[0], back[1] / inertia[1], back[2] / inertia[2]
            out[n, 0], out[n, 1], out[n, 2] = turned(solved, frame, twice, 2.0)
    return out


_ZERO = (0.0, 0.0, 0.0)


@loop
def _slope(along, axis, rotation, sine, versed, middle, half):
    """How the angular momentum in the middle of the step changes with the spin about an axis."""
    about = turned(axis, rotation, 0.5, 1.0 / 6.0)
    return plus(turned(along, rotation, sine, versed), -half, cross(middle, about))


@loop
def _solve(a, b, c, right):
    """The solution of a matrix with columns a, b, c, by Cramer's rule."""
    across = cross(b, c)
    over = 1.0 / dot(a, across)
    return over * dot(right, across), over * dot(a, cross(right, c)), over * dot(a, cross(b, right))


@loop
def _each(a, b):
    return a[0] * b[0], a[1] * b[1], a[2] * b[2]
