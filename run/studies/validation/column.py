"""A tall column of spheres in a cylinder, whose bottom is lowered a little so that the wall bears what it can."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dem.experiment import Experiment, option
from dem.mesh import Mesh
from dem.motion import Glide
from dem.packing import perturbed
from dem.scene import Scene
from dem.shapes import Plane

RADIUS = 0.005  # of a sphere [m]


@dataclass(frozen=True)
class Column(Experiment):
    """Spheres in a cylinder, a mesh; the bottom is a plane."""

    friction: float = option(0.5, "friction coefficient between spheres")
    wall_friction: float = option(0.5, "friction coefficient of the wall")
    width: float = option(4.0, "radius of the cylinder", unit="sphere diameters")
    layers: int = option(28, "layers of the lattice")
    speed: float = option(0.005, "of the bottom, downwards", unit="m/s")
    dt = 0.0025
    delta = 0.001
    settling_time = 0.6

    def build(self) -> Scene:
        """The scene, with the large bodies "wall" and "bottom"."""
        scene = Scene(self.friction)
        scene.set_pair("spheres", "wall", friction=self.wall_friction)
        radius, pitch = 2 * self.width * RADIUS, 2.3 * RADIUS
        count = int(radius / pitch)
        across = np.arange(-count, count + 1) * pitch
        up = (np.arange(self.layers) + 0.6) * pitch
        places = perturbed(across, across, up, 0.0, 1)
        places = places[np.hypot(places[:, 0], places[:, 1]) <= 0.98 * radius - 1.1 * RADIUS]
        places += 0.1 * RADIUS * np.random.default_rng(1).uniform(-1, 1, places.shape)
        scene.add_spheres(places, RADIUS, 2500.0, material="spheres")
        scene.add_body("wall", [Mesh.revolved([(radius, -0.05), (radius, up[-1] + 0.05)], 48)], material="wall")
        scene.add_body("bottom", [Plane((0, 0, 1))], Glide((0, 0, -self.speed), self.settling_time))
        return scene
