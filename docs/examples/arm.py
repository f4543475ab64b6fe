"""A bucket on an arm of two hinged links digs in spheres: motors with bounded torques::

    python docs/examples/arm.py arm.png
"""

from __future__ import annotations

import sys

import numpy as np

import pctt
from pctt import Box, Dynamic, Plane, Scene


def arm(n: int = 4) -> Scene:
    """A bed of n x n x 2 spheres, and an arm above it whose hinges turn about y."""
    scene = Scene(friction=0.4)
    scene.add_body("floor", [Plane((0, 0, 1))])
    places = np.stack(np.meshgrid(np.arange(n), np.arange(n), np.arange(2), indexing="ij"), axis=-1).reshape(-1, 3)
    scene.add_spheres(0.06 + 0.121 * places * [1, 1, 0.99] + [0.4, -0.06 * n, 0.0], 0.06, 1500.0)
    scene.add_body("boom", [Box((0.28, 0.03, 0.03))], Dynamic(), position=(0.3, 0, 0.8), density=2000.0)
    scene.add_body("bucket", [Box((0.02, 0.15, 0.2))], Dynamic(), position=(0.65, 0, 0.56), density=2000.0)
    scene.add_joint("shoulder", None, "boom", anchor=(0, 0, 0.8), axis=(0, 1, 0), speed=0.3, strength=400.0)
    scene.add_joint("wrist", "boom", "bucket", anchor=(0.65, 0, 0.8), axis=(0, 1, 0), speed=0.2, strength=100.0)
    return scene


def main(picture: str = "", until: float = 3.0) -> tuple[float, float]:
    """The greatest torques of both motors [N m]: the bucket digs, then lifts; a picture from between, if it has a
    name."""
    sim = pctt.Simulation(arm(), dt=0.01, tol=1e-5, say=lambda text: None)
    shoulder, wrist, most = sim.joint("shoulder"), sim.joint("wrist"), np.zeros(2)
    while sim.time < until - 1e-9:
        sim.step()
        most = np.maximum(most, np.abs([shoulder.drive, wrist.drive]))
        if sim.time > 0.5 * until and shoulder.motor.speed > 0:
            sim.change("joint shoulder", speed=-0.3)  # it lifts
            if picture:
                sim.render(elevation=10, width=640, height=480).save(picture)
    print(f"angles {shoulder.angle:.3f} and {wrist.angle:.3f} rad")
    print(f"greatest torques {most[0]:.0f} and {most[1]:.0f} N m")
    return float(most[0]), float(most[1])


if __name__ == "__main__":
    main(*sys.argv[1:])
