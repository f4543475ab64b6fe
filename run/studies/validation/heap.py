"""A bed behind a gate, which is lifted: what does not flow over the edge rests at the angle of repose."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dem.experiment import Experiment, option
from dem.motion import Glide
from dem.packing import perturbed
from dem.scene import Scene
from dem.shapes import Box, Plane

RADIUS = 0.005  # of the greatest spheres [m]
SMALLEST = 0.8  # of them; equal spheres between plane walls make a crystal, whose slopes are steep


@dataclass(frozen=True)
class Heap(Experiment):
    """Spheres on a shelf between two frictionless walls; a lip holds the lowest layer."""

    friction: float = option(0.5, "friction coefficient between spheres, and of shelf and lip")
    rolling: float = option(0.0, "resistance to rolling between spheres, over the radius of the greatest")
    columns: int = option(11, "spheres of the lattice along the shelf")
    rows: int = option(4, "across")
    layers: int = option(22, "above each other")
    seed: int = option(1, "seed of the places and of the radii")
    gate_speed: float = option(0.1, "of the gate, upwards", unit="m/s")
    dt = 0.0025
    delta = 0.001
    settling_time = 0.6

    @property
    def pitch(self) -> float:
        """Spacing of the lattice [m]."""
        return 2.3 * RADIUS

    def build(self) -> Scene:
        """The scene; the shelf is x < 0, its edge x = 0."""
        scene = Scene(self.friction)
        scene.set_pair("spheres", "walls", friction=0.0)
        scene.set_pair("spheres", "spheres", rolling=self.rolling * RADIUS)
        x = -(np.arange(self.columns) + 0.6) * self.pitch
        y = (np.arange(self.rows) - (self.rows - 1) / 2) * self.pitch
        z = 1.5 * RADIUS + (np.arange(self.layers) + 0.6) * self.pitch
        places = perturbed(x, y, z, 0.1 * RADIUS, self.seed)
        radii = RADIUS * np.random.default_rng(self.seed).uniform(SMALLEST, 1.0, len(places))
        scene.add_spheres(places, radii, 2500.0, material="spheres")
        length, half, tall = (self.columns + 0.2) * self.pitch, (self.rows + 0.1) * self.pitch / 2, 0.3
        sides = [Plane((0, -side, 0), (0, side * half, 0)) for side in (-1, 1)]
        scene.add_body("walls", [*sides, Plane((1, 0, 0), (-length, 0, 0))], material="walls")
        shelf = Box((length, half + 0.01, 0.01), (-length, 0, -0.01))
        lip = Box((RADIUS, half + 0.01, 0.75 * RADIUS), (-RADIUS, 0, 0.75 * RADIUS))
        scene.add_body("shelf", [shelf, lip], material="spheres")
        gate = Glide((0, 0, self.gate_speed), self.settling_time)
        plate = Box((0.01, half + 0.01, tall / 2), (0.01, 0, tall / 2))
        scene.add_body("gate", [plate], gate, material="walls")
        scene.add_body("floor", [Plane((0, 0, 1))], position=(0, 0, -20 * RADIUS), material="spheres")
        return scene
