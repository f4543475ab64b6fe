"""A cylinder of spheres, whose wall is lifted: how far the heap runs out."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dem.checks import positive
from dem.experiment import Experiment, option
from dem.mesh import Mesh
from dem.motion import Glide
from dem.packing import perturbed
from dem.scene import Scene
from dem.shapes import Plane

RADIUS = 0.005  # of the greatest spheres [m]


@dataclass(frozen=True)
class Collapse(Experiment):
    """Spheres of 8 to 10 mm in a cylinder without friction, on a floor with that of the spheres."""

    friction: float = option(0.5, "friction coefficient between spheres, and of the floor")
    rolling: float = option(0.1, "resistance to rolling on the floor, over the radius of the greatest")
    width: float = option(8.0, "radius of the cylinder", unit="sphere diameters", check=positive)
    aspect: float = option(1.0, "about the height of the bed over the radius of the cylinder", check=positive)
    seed: int = option(1, "seed of the places and of the radii")
    gate_speed: float = option(3.0, "of the wall, upwards", unit="m/s", check=positive)
    dt = 0.004
    delta = 0.001
    settling_time = 0.5

    def build(self) -> Scene:
        """The scene, with the large bodies "wall" and "floor"."""
        scene = Scene(self.friction)
        scene.set_pair("spheres", "wall", friction=0.0)
        scene.set_pair("spheres", "floor", rolling=self.rolling * RADIUS)  # or a part would roll on without end
        wide, pitch = 2 * self.width * RADIUS, 2.2 * RADIUS
        radii = RADIUS * np.random.default_rng(self.seed).uniform(0.8, 1.0, 10**6)
        across = np.arange(-int(wide / pitch), int(wide / pitch) + 1) * pitch
        fraction = np.pi / 6 * (2 * RADIUS / pitch) ** 3 * 0.738  # 0.738: mean cube of the radii over the greatest
        up = (np.arange(round(self.aspect * wide * 0.6 / fraction / pitch)) + 0.6) * pitch
        places = perturbed(across, across, up, 0.08 * RADIUS, self.seed)
        places = places[np.hypot(places[:, 0], places[:, 1]) < 0.995 * wide - 1.2 * RADIUS]
        scene.add_spheres(places, radii[: len(places)], 2500.0, material="spheres")
        top = up[-1] + 4 * RADIUS
        lifted = Glide((0, 0, self.gate_speed), self.settling_time)
        scene.add_body("wall", [Mesh.revolved([(wide, -0.5 * RADIUS), (wide, top)], 48)], lifted, material="wall")
        scene.leaving.add("wall")
        scene.add_body("floor", [Plane((0, 0, 1))], material="floor")
        return scene
