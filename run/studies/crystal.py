"""Spheres at rest in a crystal, a scene for pctt.run: -scene run/studies/crystal.py."""

from __future__ import annotations

from dataclasses import dataclass
from math import sqrt

import numpy as np

from dem import checks
from dem.arrays import Floats
from dem.experiment import Experiment, option
from dem.scene import Scene
from dem.shapes import Plane

LATTICES = ("fcc", "cubic")


@dataclass(frozen=True)
class Crystal(Experiment):
    """2n+1 layers of touching spheres at rest under gravity in a box that fits.

    `cubic`: (2n+1)^2 spheres in each layer, straight above each other. `fcc`: square layers of (2n+1)^2, those of
    odd number with (2n)^2 spheres in the pockets of the layer below.
    """

    n: int = option(4, "", "size: there are 2n+1 layers of up to (2n+1)^2 spheres")
    lattice: str = option("fcc", "", f"of {', '.join(LATTICES)}")
    radius: float = option(0.1, "m", "radius of the spheres")
    density: float = option(2500.0, "kg/m^3", "density of the spheres (glass)")
    friction: float = option(0.25, "", "friction coefficient of all contacts")
    gravity: float = option(9.81, "m/s^2", "gravity, downwards")

    dt = 0.025

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.n < 1:
            raise ValueError(f"n must be at least 1, got {self.n}")
        if self.lattice not in LATTICES:
            raise ValueError(f"lattice {self.lattice}: allowed is one of {', '.join(LATTICES)}")
        for name in ("radius", "density", "gravity"):
            checks.positive(name, getattr(self, name))
        checks.not_negative("friction", self.friction)

    def positions(self) -> Floats:
        """Centres [m]; the floor is z = 0, the axis of the box x = y = 0."""
        diameter = 2 * self.radius
        fcc = self.lattice == "fcc"
        layers = []
        for k in range(2 * self.n + 1):
            side = np.arange(2 * self.n + 1.0) - self.n
            if fcc and k % 2:
                side = side[:-1] + 0.5
            x, y = np.meshgrid(side, side, indexing="ij")
            height = self.radius + k * diameter * (sqrt(0.5) if fcc else 1.0)
            layers.append(np.stack([diameter * x.ravel(), diameter * y.ravel(), np.full(x.size, height)], axis=1))
        return np.concatenate(layers)

    def build(self) -> Scene:
        """The scene, with the large body "box"."""
        scene = Scene(self.friction, gravity=(0.0, 0.0, -self.gravity))
        scene.add_spheres(self.positions(), self.radius, self.density)
        wall = (2 * self.n + 1) * self.radius
        ways = np.array([(1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0)])
        scene.add_body("box", [Plane((0, 0, 1)), *(Plane(way, -wall * way) for way in ways)])
        return scene
