"""Blocks and spheres on a belt: friction speeds them up until they go with it, or roll on it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from dem.arrays import Floats
from dem.checks import between, finite, positive
from dem.experiment import Experiment, option
from dem.scene import Scene
from dem.shapes import Box
from dem.step import Step


@dataclass(frozen=True)
class Belt(Experiment):
    """n blocks and n spheres are put at rest on a belt that runs along x.

    A block has the acceleration mu g until it has the speed v of the belt, after v / (mu g). A sphere has it too, but
    begins to turn, and rolls from the speed 2 v / 7 on. The sum of the forces on the belt is what drives it.
    """

    n: int = option(3, "number of blocks, and of spheres", check=between(1))
    speed: float = option(0.5, "speed of the belt", unit="m/s", check=finite)
    friction: float = option(0.25, "friction coefficient of all contacts", check=positive)
    radius: float = option(0.05, "radius of the spheres, half the side of the blocks", unit="m", check=positive)
    density: float = option(2500.0, "density of both", unit="kg/m^3", check=positive)
    gravity: float = option(9.81, "gravity, downwards", unit="m/s^2", check=positive)

    @property
    def length(self) -> float:
        """Length of the belt [m]: the way in five times the time in which blocks speed up, and a place to begin."""
        return 5.0 * self.speed**2 / (self.friction * self.gravity) + 4.0 * self.radius

    def build(self) -> Scene:
        """The scene, with the large body "belt"."""
        scene, r = Scene(self.friction, gravity=(0.0, 0.0, -self.gravity)), self.radius
        rows = np.zeros((2 * self.n, 3)) + [0.0, 0.0, r]
        rows[:, 1] = 3.0 * r * np.arange(2 * self.n)
        scene.add_boxes(rows[::2], (r, r, r), self.density, material="blocks")
        scene.add_spheres(rows[1::2], r, self.density, material="spheres")
        ahead = np.copysign(0.5 * self.length - 2.0 * r, self.speed)
        half = (0.5 * self.length, 3.0 * self.n * r, r)
        middle = (ahead, 3.0 * r * (self.n - 0.5), -r)
        scene.add_body("belt", [Box(half)], position=middle, surface_velocity=(self.speed, 0.0, 0.0))
        return scene

    def record(self, step: Step) -> dict[str, float]:
        """Mean velocities of both along the belt."""
        grains, names = step.world.grains, step.world.materials
        means = {
            name: step.total(grains.velocity[grains.material == names.index(name), 0]) / self.n
            for name in ("blocks", "spheres")
        }
        return {f"speed_{name} [m/s]": mean for name, mean in means.items()}

    def analyse(self, records: Mapping[str, Floats]) -> dict[str, float | Floats]:
        """The acceleration of the blocks while they slide over mu g, and the last speeds over that of the belt."""
        time, blocks, spheres = (records[name] for name in ("time [s]", "speed_blocks [m/s]", "speed_spheres [m/s]"))
        sliding = np.abs(blocks) < 0.9 * abs(self.speed)
        out: dict[str, float | Floats] = {}
        if self.speed and sliding.sum() > 1:
            rate = (blocks[sliding][-1] - blocks[0]) / (time[sliding][-1] - time[0])
            out["block_acceleration [mu g]"] = abs(rate) / (self.friction * self.gravity)
        if self.speed and len(time):
            out["block_speed [belt speeds]"] = blocks[-1] / self.speed
            out["sphere_speed [belt speeds]"] = spheres[-1] / self.speed
        return out
