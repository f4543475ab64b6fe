"""A tyre with lugs drives itself over sand and pulls a load::

    python -m pctt.run -scene docs/examples/wheel.py -steps 1500 -output_every 10 -output wheel
    python -m pctt.render wheel -elevation 15 -size 640x480
"""

from __future__ import annotations

from dataclasses import dataclass
from math import cos, pi, sin

import numpy as np

from pctt import Box, Experiment, Held, Mesh, Plane, Scene, option, perturbed


@dataclass(frozen=True)
class Wheel(Experiment):
    """The axle turns at constant speed; the wheel moves freely up, down and forwards."""

    spin: float = option(3.0, "speed of the axle", unit="rad/s")
    mass: float = option(8.0, "of the wheel", unit="kg")
    pull: float = option(5.0, "load behind the wheel", unit="N")
    length: int = option(30, "spheres along the bin")
    settling_time: float = option(0.5, "when the axle begins to turn", unit="s")

    def build(self) -> Scene:
        """The scene, with the large bodies "bin" and "wheel"."""
        scene, pitch, R, half = Scene(0.5), 0.034, 0.12, 0.05
        x, y, z = ((np.arange(count) + 0.5) * pitch for count in (self.length, 10, 5))
        scene.add_spheres(perturbed(x, y - 5 * pitch, z, 0.001, 0), 0.015, 2500.0)
        ends = [Plane((s, 0, 0), (0.5 * (1 - s) * self.length * pitch, 0, 0)) for s in (1, -1)]
        scene.add_body("bin", [Plane((0, 0, 1)), *ends, *(Plane((0, s, 0), (0, -5 * s * pitch, 0)) for s in (1, -1))])
        profile, along_y = [(0, -half), (R, -half), (R, half), (0, half)], (0.5**0.5, -(0.5**0.5), 0, 0)
        tyre = Mesh.revolved(profile, 32, quaternion=along_y)
        turns = np.arange(12) * pi / 6
        lugs = [Box((0.012, half, 0.006), (R * cos(a), 0, -R * sin(a)), (cos(a / 2), 0, sin(a / 2), 0)) for a in turns]
        rig = Held((None, 0, None), (0, self.spin, 0), start=self.settling_time)
        scene.add_body("wheel", [tyre, *lugs], rig, position=(0.2, 0, 5 * pitch + R + 0.03), mass=self.mass)
        scene.add_load("pull", on="wheel", force=(-self.pull, 0, 0), start=self.settling_time)
        return scene

    def record(self, step):
        """Slip of the wheel, power of the axle and of the pull, and the height of the axle."""
        force, velocity = step.force_on("wheel"), step.velocity("wheel")
        figures = {"slip": 1 - velocity[0] / (self.spin * 0.12), "axle [W]": -force[4] * velocity[4]}
        return {**figures, "pull [W]": self.pull * velocity[0], "height [m]": step.position("wheel")[2]}
