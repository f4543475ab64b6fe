"""A plate is pushed into a bed of spheres: force against depth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dem.checks import positive
from dem.experiment import Experiment, option
from dem.mesh import Mesh
from dem.motion import Path
from dem.packing import perturbed
from dem.scene import Scene
from dem.shapes import Plane
from dem.step import Step

RADIUS = 0.005  # of the greatest spheres [m]


@dataclass(frozen=True)
class Intrusion(Experiment):
    """Spheres of 8 to 10 mm in a box without friction. The plate is a disc; a shaft without friction keeps the hole
    behind it open."""

    friction: float = option(0.5, "friction coefficient between spheres, and of floor and plate")
    width: int = option(18, "width of the box", unit="sphere diameters", check=positive)
    layers: int = option(18, "layers of the lattice of the start")
    plate: float = option(3.0, "radius of the plate", unit="sphere diameters", check=positive)
    speed: float = option(0.05, "of the plate, downwards", unit="m/s", check=positive)
    seed: int = option(1, "seed of the places and of the radii")
    dt = 0.005
    delta = 0.001
    settling_time = 0.7

    def build(self) -> Scene:
        """The scene, with the large bodies "box", "floor", "plate" and "shaft"."""
        scene = Scene(self.friction)
        for name in ("walls", "shaft"):
            scene.set_pair("spheres", name, friction=0.0)
        side, pitch = 2 * self.width * RADIUS, 2.2 * RADIUS
        across = (np.arange(int(side / pitch)) + 0.5) * (side / int(side / pitch)) - side / 2
        up = (np.arange(self.layers) + 0.6) * pitch
        places = perturbed(across, across, up, 0.08 * RADIUS, self.seed)
        radii = RADIUS * np.random.default_rng(self.seed).uniform(0.8, 1.0, len(places))
        scene.add_spheres(places, radii, 2500.0, material="spheres")
        normals = ((1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0))
        scene.add_body("box", [Plane(n, tuple(-side / 2 * np.array(n))) for n in normals], material="walls")
        scene.add_body("floor", [Plane((0, 0, 1))], material="spheres")
        wide, height = 2 * self.plate * RADIUS, up[-1] + 3 * RADIUS
        level = (4 / 3 * np.pi * radii**3).sum() / 0.58 / side**2  # of the bed; the plate is there soon
        times = self.settling_time + np.array([0.0, 0.1, 0.1 + level / self.speed])
        down = Path(tuple(times), ((0, 0, height), (0, 0, level + 2 * RADIUS), (0, 0, 2 * RADIUS)))
        disc, tube = [(0.0, 0.0), (wide, 0.0)], [(wide, 0.0), (wide, height)]
        for name, profile, material in (("plate", disc, "spheres"), ("shaft", tube, "shaft")):
            mesh = Mesh.revolved(profile, 32)
            scene.add_body(name, [mesh], down, position=(0, 0, height), material=material)
        return scene

    def record(self, step: Step) -> dict[str, float]:
        """Height of the plate, and of the surface: twice the mean height of the mass beside the plate."""
        grains = step.world.grains
        beside = np.hypot(grains.position[:, 0], grains.position[:, 1]) > 2 * self.plate * RADIUS
        level = 2.0 * step.total(grains.mass[beside] * grains.position[beside, 2]) / step.total(grains.mass[beside])
        return {"plate [m]": step.position("plate")[2], "surface [m]": level}
