"""The drum of Dosta et al. (2024), Comput. Phys. Commun. 296, 109066: two kinds of spheres in layers are mixed."""

from __future__ import annotations

from dataclasses import dataclass
from math import sqrt

import numpy as np

from dem.experiment import Experiment, option
from dem.mesh import Mesh
from dem.motion import Rotation
from dem.packing import perturbed
from dem.scene import Scene
from dem.step import Step

RADIUS, LENGTH, SPEED = 0.1, 0.06, 2.0  # of the drum [m], [rad/s]
SMALL, LARGE = 30000 / LENGTH, 8000 / LENGTH  # spheres of M1, with a radius of 1 mm, and of M2, with 2 mm, in a metre
SIDES = 64


@dataclass(frozen=True)
class DostaDrum(Experiment):
    """A slice of the drum, which is 60 mm long; M1 lies on M2 at the start. The friction of the ends is less by as much
    as the slice is shorter, so that they carry as large a part of the bed.

    The drum turns about -y: its side goes up at x > 0.
    """

    length: float = option(0.012, "length of the drum", unit="m")
    seed: int = option(1, "seed of the places at the start")
    dt = 0.002
    delta = 0.0002
    settling_time = 0.4

    def build(self) -> Scene:
        """The scene, with the large bodies "drum" and "ends"."""
        scene = Scene(0.2, restitution=0.45)  # of M1 and M2
        scene.set_pair("M1", "M1", friction=0.3, restitution=0.5)
        scene.set_pair("M2", "M2", friction=0.4, restitution=0.4)
        for kind in ("M1", "M2"):
            scene.set_pair(kind, "steel", friction=0.2, restitution=0.4)
            scene.set_pair(kind, "ends", friction=0.2 * self.length / LENGTH, restitution=0.4)
        large = self.places(0.002, round(LARGE * self.length), -RADIUS)
        small = self.places(0.001, round(SMALL * self.length), large[:, 2].max() + 0.0035)
        scene.add_spheres(large, 0.002, 2000.0, material="M2")
        scene.add_spheres(small, 0.001, 2500.0, material="M1")
        turning = Rotation((0.0, -SPEED, 0.0), start=self.settling_time)
        half, along_y = self.length / 2, (sqrt(0.5), -sqrt(0.5), 0.0, 0.0)
        side = Mesh.revolved([(RADIUS, -half), (RADIUS, half)], SIDES, quaternion=along_y)
        ends = [Mesh.revolved([(0.0, y), (RADIUS, y)], SIDES, quaternion=along_y) for y in (-half, half)]
        scene.add_body("drum", [side], turning, material="steel")
        scene.add_body("ends", ends, turning, material="ends")
        return scene

    def places(self, radius: float, count: int, bottom: float) -> np.ndarray:
        """The lowest places (count, 3) above `bottom` of a lattice of spheres in the drum [m]."""
        pitch, loose = 2.2 * radius, 0.08 * radius
        slots = int((self.length - 2 * radius - 2 * loose) / pitch) + 1
        y = (np.arange(slots) - (slots - 1) / 2) * pitch
        wide = int(RADIUS / pitch)
        x, z = np.arange(-wide, wide + 1) * pitch, bottom + np.arange(2 * wide) * pitch
        place = perturbed(x, y, z, loose, self.seed)
        place = place[np.hypot(place[:, 0], place[:, 2]) < 0.998 * RADIUS - radius - 2 * loose]
        return place[np.argsort(place[:, 2], kind="stable")][:count]

    def record(self, step: Step) -> dict[str, float]:
        """Which part of the spheres of M1 and of M2 is in the quadrant x < 0, z < 0."""
        grains = step.world.grains
        inside, small = (grains.position[:, [0, 2]] < 0.0).all(axis=1), grains.size[:, 0] < 0.0015
        return {
            name: step.total(inside & kind) / step.total(kind) for name, kind in (("M1", small), ("M2", ~small))
        }
