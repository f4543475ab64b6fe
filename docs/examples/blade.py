"""A plough is drawn through a bed of spheres; what it costs is the force on it::

    python -m pctt.run -scene docs/examples/blade.py -ccp_type apgd -steps 240 -output_every 4 -output blade
    python -m pctt.render blade -color speed -size 640x480
"""

from __future__ import annotations

from dataclasses import dataclass
from math import cos, radians, sin

import numpy as np

from pctt import Box, Experiment, Glide, Plane, Scene, option, perturbed


@dataclass(frozen=True)
class Plough(Experiment):
    """Spheres settle in a tray; then an oblique plate goes through them at constant speed."""

    speed: float = option(0.2, "of the plate, along x", unit="m/s")
    depth: float = option(0.025, "of its lower edge above the floor", unit="m")
    rake: float = option(20.0, "of the plate, from the vertical, its upper edge forwards", unit="degrees")
    friction: float = option(0.4, "friction coefficient of all contacts")
    settling_time: float = option(0.4, "when the plate starts", unit="s")
    dt = 0.005
    delta = 0.001
    radius, length, width = 0.005, 0.24, 0.1  # m; of a sphere, and of the tray

    def build(self) -> Scene:
        """The scene, with the large bodies "tray" and "plough"."""
        scene = Scene(self.friction)
        start, tall = -self.length / 2 + 0.04, 0.04  # the plate starts behind the spheres
        pitch, turn = 2.3 * self.radius, radians(self.rake) / 2
        x = np.arange(start + 0.035, self.length / 2 - self.radius, pitch)
        y = (np.arange(8) - 3.5) * pitch
        scene.add_spheres(perturbed(x, y, (np.arange(6) + 0.6) * pitch, 0.0003, 1), self.radius, 2500.0)
        walls = [Plane((0, 0, 1))]
        walls += [Plane((-side, 0, 0), (side * self.length / 2, 0, 0)) for side in (-1, 1)]
        walls += [Plane((0, -side, 0), (0, side * self.width / 2, 0)) for side in (-1, 1)]
        scene.add_body("tray", walls)
        plate = Box((0.003, 0.25 * self.width, tall), quaternion=(cos(turn), 0, sin(turn), 0))
        goes = Glide((self.speed, 0, 0), self.settling_time, self.settling_time + 0.12 / self.speed)
        scene.add_body("plough", [plate], goes, position=(start, 0, self.depth + tall))
        return scene

    def record(self, step):
        """The force against the way of the plate."""
        return {"draft [N]": -step.force_on("plough")[0]}

    def analyse(self, records):
        """The mean force in the second half of the way."""
        middle = self.settling_time + 0.06 / self.speed
        late = (records["time [s]"] > middle) & (records["time [s]"] < middle + 0.06 / self.speed)
        return {"mean_draft [N]": float(records["draft [N]"][late].mean())} if late.any() else {}
