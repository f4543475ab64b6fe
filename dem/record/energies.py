"""Kinetic and potential energies of bodies."""

from __future__ import annotations

import numpy as np

from dem.arrays import Floats
from dem.bodies import Bodies
from dem.compiled import loop


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
                kinetic += 0.5 * mass[n] * velocity[n, k] ** 2
                moment[k] += mass[n] * position[n, k]
            w, x, y, z = turn[n, 0], -turn[n, 1], -turn[n, 2], -turn[n, 3]
            a, b, c = velocity[n, 3], velocity[n, 4], velocity[n, 5]
            p, q, r = y * c - z * b, z * a - x * c, x * b - y * a  # to the frame of the body
            spin = (
                a + 2.0 * (w * p + y * r - z * q), b + 2.0 * (w * q + z * p - x * r), c + 2.0 * (w * r + x * q - y * p)
            )  # fmt: skip
            for k in range(3):
                if np.isfinite(inertia[n, k]):
                    kinetic += 0.5 * inertia[n, k] * spin[k] ** 2
    return kinetic, moment
