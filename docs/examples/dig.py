"""A bucket on an arm digs through a bed of spheres, and the force on it is plotted::

    python docs/examples/dig.py dig                # simulates; dig/force.png
    python -m pctt.render dig -size 800x600        # dig/pictures/film.mp4

It is the first part of `run/demo`.
"""

from __future__ import annotations

import sys
from math import pi

import numpy as np

from pctt import Box, Mesh, Plane, Rotation, Scene, Simulation, perturbed

RADIUS = 0.01  # of a sphere [m]
LENGTH, WIDTH = 0.6, 0.24  # of the bin, inside [m]
ARM = 0.4  # from the axis to the bucket's lip [m]


def bucket(width: float, depth: float, sides: int = 10) -> Mesh:
    """A bent plate, half a circle wide open towards +x, with two cheeks; its lip is the origin, its back up."""
    angle = np.linspace(-0.5 * pi, 0.5 * pi, sides + 1) + pi  # from the upper edge by the back to the lip
    profile = depth * np.stack([0.5 * np.cos(angle), 0.0 * angle, 0.5 - 0.5 * np.sin(angle)], axis=1)[::-1]
    left, right = (profile + [0.0, side * width / 2, 0.0] for side in (-1, 1))
    k, m = np.arange(sides), sides + 1
    plate = [(k, k + 1, m + k), (k + 1, m + k + 1, m + k)]
    cheeks = [(0 * k + first, first + k, first + k + 1) for first in (0, m)]
    triangles = np.concatenate([np.stack(three, axis=1) for three in plate + cheeks])
    return Mesh(np.concatenate([left, right]), triangles, center=(0.0, 0.0, -ARM))


def scene(layers: int = 6) -> Scene:
    """A bin with a bed of spheres, and beside it the bucket, which turns through the bed after 0.4 s."""
    made = Scene(friction=0.5)
    x, y, z = (np.arange(count) * 2.15 * RADIUS for count in (27, 10, layers))
    places = perturbed(x - x.mean(), y - y.mean(), z + 1.1 * RADIUS, 0.05 * RADIUS, 1)
    made.add_spheres(places, RADIUS, density=2500.0)
    walls = [Plane((-s, 0, 0), (s * LENGTH / 2, 0, 0)) for s in (-1, 1)]
    walls += [Plane((0, -s, 0), (0, s * WIDTH / 2, 0)) for s in (-1, 1)]
    made.add_body("bin", [Plane((0, 0, 1)), *walls])
    turn = Rotation((0.0, -0.9, 0.0), (0.0, 0.0, ARM + 0.03), 0.4, 2.4)
    beam = Box((0.012, 0.012, 0.14), (0.0, 0.0, -0.16))
    tilt = 0.5 * 1.0
    made.add_body("bucket", [bucket(0.14, 0.1), beam], turn, position=(0, 0, ARM + 0.03),
                  quaternion=(np.cos(tilt), 0.0, np.sin(tilt), 0.0))  # fmt: skip
    return made


if __name__ == "__main__":
    sim = Simulation(scene(), dt=0.005, delta=0.002, solver="apgd")
    sim.write(sys.argv[1], overwrite=True, every=8)
    sim.run(until=2.6)
    sim.close()
    print(sim)
