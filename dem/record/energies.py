"""Kinetic and potential energies of bodies."""

from __future__ import annotations

import numpy as np

from dem.arrays import Floats
from dem.bodies import Bodies
from dem.compiled import inlined, loop


def energy(table: Bodies, gravity: Floats) -> tuple[float, float]:
    """Kinetic and potential energy [J] of the bodies of a table that forces can move; the potential energy is zero at
    the origin."""
    kinetic, moment = energies(table.position, table.quaternion, table.velocity, table.mass, table.inertia)
    return kinetic, float(-(moment @ gravity))


@loop
def energies(position: Floats, turn: Floats, velocity: Floats, mass: Floats, inertia: Floats) -> tuple[float, Floats]:
    """The kinetic energy [J] of n bodies with principal moments (n, 3), and the sum of mass times position (3,)
    [kg m]. An infinite mass or moment does not move."""
    kinetic, moment = 0.0, np.zeros(3)
    for n in range(len(mass)):
        if np.isfinite(mass[n]):
            for k in range(3):
                moment[k] += mass[n] * position[n, k]
            kinetic = add_kinetic(kinetic, turn[n], velocity[n], mass[n], inertia[n])
    return kinetic, moment


@inlined
def add_kinetic(kinetic, turn, velocity, mass, inertia):
    """An energy [J] and that of a body of finite mass."""
    for k in range(3):
        kinetic += 0.5 * mass * velocity[k] ** 2
    w, x, y, z = turn[0], -turn[1], -turn[2], -turn[3]
    a, b, c = velocity[3], velocity[4], velocity[5]
    p, q, r = y * c - z * b, z * a - x * c, x * b - y * a  # to the frame of the body
    spin = a + 2.0 * (w * p + y * r - z * q), b + 2.0 * (w * q + z * p - x * r), c + 2.0 * (w * r + x * q - y * p)
    for k in range(3):
        if np.isfinite(inertia[k]):
            kinetic += 0.5 * inertia[k] * spin[k] ** 2
    return kinetic
