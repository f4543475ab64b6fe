"""A bucket on an arm digs through a bed of spheres, and the force on it is plotted::

    python docs/examples/dig.py dig                                        # simulates, and draws dig/force.png
    python -m pctt.render dig -bodies bucket=orange -size 800x520 -fps 15  # dig/pictures/film.mp4

It is the first part of `run/demo`.
"""

from __future__ import annotations

import sys
from math import cos, pi, sin

import numpy as np

from pctt import Box, Folder, Mesh, Plane, Rotation, Scene, Simulation, perturbed
from pctt.look.program import EXTRA

RADIUS = 0.01  # of a sphere [m]
LENGTH, WIDTH = 0.8, 0.24  # of the bin, inside [m]
ARM, DEPTH = 0.4, 0.1  # from the axis to the bucket's lip; of the bucket [m]
START, END, SPEED = 0.3, 2.4, 0.9  # when the arm turns [s], and how fast [rad/s]


def bucket(width: float, sides: int = 10) -> Mesh:
    """Half a pipe that opens towards +x, with two cheeks; the lip is at (0, 0, -ARM)."""
    angle = np.linspace(-0.5 * pi, -1.5 * pi, sides + 1)  # from the lip by the back to the upper edge
    profile = 0.5 * DEPTH * np.stack([np.cos(angle), 0 * angle, 1 + np.sin(angle)], axis=1)
    left, right = (profile + [0.0, side * width / 2, -ARM] for side in (-1, 1))
    k, right_side = np.arange(sides), sides + 1
    corners = [(k, k + 1, right_side + k), (k + 1, right_side + k + 1, right_side + k)]
    corners += [(0 * k + first, first + k, first + k + 1) for first in (0, right_side)]
    return Mesh(np.concatenate([left, right]), np.concatenate([np.stack(three, axis=1) for three in corners]))


def digging() -> Scene:
    """A bin with spheres, which settle first, and the bucket, whose arm turns about an axis above it."""
    scene = Scene(friction=0.5)
    x, y, z = (np.arange(count) * 2.15 * RADIUS for count in (36, 10, 6))
    scene.add_spheres(perturbed(x - x.mean(), y - y.mean(), z + 1.1 * RADIUS, 0.05 * RADIUS, 1), RADIUS, 2500.0)
    sides = [Plane((-s, 0, 0), (s * LENGTH / 2, 0, 0)) for s in (-1, 1)]
    sides += [Plane((0, -s, 0), (0, s * WIDTH / 2, 0)) for s in (-1, 1)]
    scene.add_body("bin", [Plane((0, 0, 1)), *sides])
    axis, half = (0.0, 0.0, ARM + 0.03), 0.5  # half the angle at which the arm begins
    arm = Box((0.012, 0.012, 0.12), (0.0, 0.0, DEPTH + 0.12 - ARM))
    turn, tilt = Rotation((0, -SPEED, 0), axis, START, END), (cos(half), 0.0, sin(half), 0.0)
    scene.add_body("bucket", [bucket(0.14), arm], turn, position=axis, quaternion=tilt)
    return scene


def plot(folder: str) -> None:
    """Draw the force on the bucket, its mean over .05 s."""
    import matplotlib.pyplot as plt

    records = Folder(folder).records()
    time, smooth = records["time [s]"], np.full(10, 0.1)
    _, axes = plt.subplots(figsize=(6, 3), layout="constrained")
    for axis, name in (("x", "against its way"), ("z", "downwards")):
        axes.plot(time, -np.convolve(records[f"force_bucket_{axis} [N]"], smooth, mode="same"), label=name)
    axes.set(xlabel="time [s]", ylabel="force on the bucket [N]", xlim=(0, time[-1]))
    axes.legend(frameon=False)
    plt.savefig(f"{folder}/force.png", dpi=150)


if __name__ == "__main__":
    folder = sys.argv[1]
    with Simulation(digging(), dt=0.005, delta=0.002) as sim:
        print(f"a bucket digs in {len(sim.positions)} spheres", flush=True)
        sim.write(folder, overwrite=True, every=8, checkpoint_every=100)
        sim.run(until=2.6, progress=True)
        print(f"{len(sim.contacts)} contacts in the last step, solved to {sim.figures['coulomb_residual']:.1e}")
    try:
        plot(folder)
        print(f"force on the bucket: {folder}/force.png")
    except ImportError as error:
        print(f"no plot of the force: {error}; {EXTRA}")
