"""The motion of the bodies without contact forces, over one step, and their angular momentum.

The velocities of a step are those of its middle. Impulses act at its start. A body that is no sphere has then the
angular momentum L(w) = exp(dt/2 w) I w in the middle of the step, with the inertia I of its start, and impulses J of
contacts, joints, springs and loads are to give L(w) = L_old + J. The cone problem needs velocities that are linear in
the impulses: they are so about the spin that the impulses of the last step would lead to (`free_spin`). What they miss
of the angular momentum is of third order in dt where forces change smoothly, and `kept_velocities` gives it back at the
end of the step: no impulse is lost.
"""

from __future__ import annotations

import numpy as np

from dem import bodies
from dem.arrays import Bools, Floats, Ints
from dem.bodies import SPHERE, Bodies
from dem.compiled import inlined, inner, loop
from dem.geometry.vectors import cross, dot, plus, shares, turned


def free_velocity(table: Bodies, gravity: Floats, dt: float) -> Floats:
    """Velocities (n, 6) after dt [s] under gravity (3,), explicit, and the gyroscopic torque -w x I w, implicit.

    Rows of bodies with prescribed motion come back as they are.
    """
    velocity, others = falling(table.velocity, table.mass, table.shape, gravity, dt)
    if others:  # the torque vanishes where all moments are equal, as for spheres
        spin_freely(table, velocity, np.zeros((len(velocity), 3)), np.zeros(velocity.shape), dt)
    return velocity


def velocity_changes(table: Bodies, impulse: Floats) -> Floats:
    """What impulses and angular impulses (n, 6) change of the velocities (n, 6) of bodies on which nothing else acts;
    zero where a mass or moment is infinite."""
    change = np.empty(impulse.shape)
    change[:, :3] = impulse[:, :3] / table.mass[:, None]
    change[:, 3:] = impulse[:, 3:] / table.inertia  # of spheres
    rows = (impulse[:, 3:].any(axis=1) & (table.shape != bodies.SPHERE)).nonzero()[0]
    if len(rows):
        root = bodies.inverse_root_inertia(table.take(rows))
        change[rows, 3:] = (root @ (root @ impulse[rows, 3:, None]))[:, :, 0]
    return change


def spin_freely(table: Bodies, velocity: Floats, given: Floats, expected: Floats, dt: float) -> Floats:
    """Let the first bodies of a table, whose angular velocities get the changes `given` (m, 3) by forces and `expected`
    (m, 6), of all velocities, by impulses, spin in the `velocity` (n, 6) of a step as `free_spin` says. Returns what
    that returns with impulses (m, 3): NaN of bodies that do not turn freely, or whose moments are equal."""
    numbers = table.quaternion, table.velocity, table.inertia
    return spin_others(*numbers, (table.mass, table.shape), given, expected, dt, velocity)


def unequal(moments: Floats) -> Bools:
    """Which bodies (n,) of these principal moments (n, 3) turn freely and have not three equal ones: guided and hinged
    bodies have infinite ones."""
    a, b, c = moments.T
    mask: Bools = np.isfinite(a + b + c) & ((a != b) | (b != c))
    return mask


@loop
def falling(velocity: Floats, mass: Floats, shape: Ints, gravity: Floats, dt: float) -> tuple[Floats, int]:
    """The velocities (n, 6) after dt [s] under gravity (3,) alone of bodies whose mass (n,) is finite, those of the
    others, and how many of the former are no spheres."""
    out, others = velocity.copy(), 0
    for n in range(len(mass)):
        if np.isfinite(mass[n]):
            others += shape[n] != SPHERE
            for k in range(3):
                out[n, k] += dt * gravity[k]
    return out, others


@loop
def free_spin(turn: Floats, spin: Floats, moments: Floats, dt: float, change: Floats) -> tuple[Floats, Floats]:
    """Angular velocities (n, 3) [rad/s] in a step of dt [s] without impulses, from `spin` (n, 3) in the last one, of
    bodies with orientations `turn` (n, 4) at the start of the step and principal moments (n, 3); and those (n, 3) with
    impulses that are expected to change them by `change` (n, 3), which the first ones and I^-1 J add up to. All vectors
    are in the world frame.

    A step turns a body by exp(dt w). In the middle of it the body has the angular momentum exp(dt/2 w) I w in the frame
    of its start, and in the middle of the last step it had exp(-dt/2 w_old) I w_old. Newton's method makes the two
    equal, less the expected impulses: the angular momentum is kept, and the energy to O(dt^2) (compare Simo and Wong,
    International Journal for Numerical Methods in Engineering 31, 1991). Where it does not converge with the expected
    impulses, they are left out. A body that turns by much more than a radian, for which it does not converge at all,
    keeps its spin, and the second one is NaN.
    """
    out, middle = spin.copy(), np.full_like(spin, np.nan)
    for n in range(len(spin)):
        _spin_one(turn[n], spin[n], moments[n], dt, (change[n, 0], change[n, 1], change[n, 2]), out[n], middle[n])
    return out, middle


@loop
def spin_others(turn, old, inertia, kinds, given, expected, dt, out):
    """The loop of `spin_freely`, with the velocities `old` (n, 6), and the masses and shapes (n,) as `kinds`."""
    (mass, shape), middle = kinds, np.full(given.shape, np.nan)
    for n in range(len(given)):
        a, b, c = inertia[n, 0], inertia[n, 1], inertia[n, 2]
        if np.isfinite(mass[n]) and shape[n] != SPHERE and np.isfinite(a + b + c) and (a != b or b != c):
            out[n, 3:] = old[n, 3:]
            change = given[n, 0] + expected[n, 3], given[n, 1] + expected[n, 4], given[n, 2] + expected[n, 5]
            _spin_one(turn[n], old[n, 3:], inertia[n], dt, change, out[n, 3:], middle[n])
            for k in range(3):
                out[n, 3 + k] += given[n, k]
    return middle


@inner
def _spin_one(turn, spin, moments, dt, change, out, middle):
    """The two spins of `free_spin` of one body, where they are found."""
    half = 0.5 * dt
    frame, twice = (turn[1], turn[2], turn[3]), 2.0 * turn[0]
    w = turned((spin[0], spin[1], spin[2]), frame, -twice, 2.0)
    c = turned(change, frame, -twice, 2.0)
    inertia = _shape_of(moments)
    rotation = plus(_ZERO, half, w)
    sine, versed = shares(rotation)
    momentum = turned(_each(inertia, w), rotation, -sine, versed)
    for share in (1.0, 0.0):
        new, found = _spin_of(inertia, plus(momentum, share, _each(inertia, c)), plus(w, share, c), half)
        if found:
            without = turned(plus(new, -share, c), frame, twice, 2.0)
            new = turned(new, frame, twice, 2.0)
            for k in range(3):
                out[k], middle[k] = without[k], new[k]
            break


@loop
def kept_velocities(turn: Floats, velocity: Floats, middle: Floats, moments: Floats, dt: float) -> Floats:
    """The velocities (n, 6) with which bodies go into the next step, where they have moved with `velocity` (n, 6) in
    one of dt [s], and their angular velocities were linear about `middle` (n, 3), see `free_spin`; NaN: the same.
    Orientations and moments may be those of more bodies.

    With the spin of the step the momentum in its middle is L(middle) + I (spin - middle), and that of the angular
    velocity w in the orientation of the end is exp(-dt/2 w) I w, the same where spin is middle. Newton's method finds
    w.
    """
    out = velocity.copy()
    half = 0.5 * dt
    for n in range(len(velocity)):
        if np.isnan(middle[n, 0]):
            continue
        frame, twice = (turn[n, 1], turn[n, 2], turn[n, 3]), 2.0 * turn[n, 0]
        w = turned((velocity[n, 3], velocity[n, 4], velocity[n, 5]), frame, -twice, 2.0)
        x = turned((middle[n, 0], middle[n, 1], middle[n, 2]), frame, -twice, 2.0)
        inertia = _shape_of(moments[n])
        rotation = plus(_ZERO, half, x)
        sine, versed = shares(rotation)
        momentum = turned(_each(inertia, x), rotation, sine, versed)
        momentum = plus(momentum, 1.0, _each(inertia, plus(w, -1.0, x)))
        rotation = plus(_ZERO, dt, w)
        sine, versed = shares(rotation)
        new, found = _spin_of(inertia, turned(momentum, rotation, -sine, versed), w, -half)
        if found:
            new = turned(turned(new, rotation, sine, versed), frame, twice, 2.0)
            for k in range(3):
                out[n, 3 + k] = new[k]
    return out


_ZERO = (0.0, 0.0, 0.0)


@inlined
def _shape_of(moments):
    """The moments over the largest of them."""
    largest = max(moments[0], moments[1], moments[2])
    return moments[0] / largest, moments[1] / largest, moments[2] / largest


@inner
def _spin_of(inertia, momentum, start, half):
    """The spin w with exp(half w) I w = momentum, by Newton's method from `start`, and whether it was found. All are in
    the frame of the body."""
    new = start
    rotation = plus(_ZERO, half, new)
    sine, versed = shares(rotation)
    for _ in range(5):  # enough below half a radian a step
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
        if dot(change, change) <= 1e-16 * dot(start, start):
            break  # the next change would be its square
    in_frame = turned(momentum, rotation, -sine, versed)
    error = plus(in_frame, -1.0, _each(inertia, new))
    found = dot(error, error) <= 1e-12 * dot(momentum, momentum)  # else a step does not resolve the motion
    return (in_frame[0] / inertia[0], in_frame[1] / inertia[1], in_frame[2] / inertia[2]), found


@inner
def _slope(along, axis, rotation, sine, versed, middle, half):
    """How the angular momentum in the middle of the step changes with the spin about an axis."""
    about = turned(axis, rotation, 0.5, 1.0 / 6.0)
    return plus(turned(along, rotation, sine, versed), -half, cross(middle, about))


@inner
def _solve(a, b, c, right):
    """The solution of a matrix with columns a, b, c, by Cramer's rule."""
    across = cross(b, c)
    over = 1.0 / dot(a, across)
    return over * dot(right, across), over * dot(a, cross(right, c)), over * dot(a, cross(b, right))


@inner
def _each(a, b):
    return a[0] * b[0], a[1] * b[1], a[2] * b[2]
