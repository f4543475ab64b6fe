"""Capsules fall on a belt, which throws them into a box; how many arrive is recorded::

    python -m pctt.run -scene docs/examples/conveyor.py -steps 1000 -output_every 10 -output conveyor
    python -m pctt.render conveyor -elevation 40 -size 640x480
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pctt import Box, Experiment, Scene, option


@dataclass(frozen=True)
class Conveyor(Experiment):
    """A belt of 2.1 m with guides on three sides, 1 m above the floor of the box at its end."""

    speed: float = option(1.0, "of the belt", unit="m/s")
    layers: int = option(5, "layers of 100 capsules")

    def build(self) -> Scene:
        """The scene, with the large bodies "belt", "guides" and "box"."""
        scene, pitch, top = Scene(0.4), 0.105, 1.0
        lines = np.arange(20) + 0.5, np.arange(5) - 2.0, np.arange(self.layers)
        places = pitch * np.stack(np.meshgrid(*lines, indexing="ij"), -1).reshape(-1, 3) + [0, 0, top + 0.06]
        turns = np.random.default_rng(3).normal(size=(len(places), 4))
        scene.add_capsules(places, 0.02, 0.03, 1200.0, quaternions=turns)
        along, across, h = 10 * pitch, 2.5 * pitch, 0.45
        belt = [Box((along, across + 0.05, 0.02), (along, 0, top - 0.02))]
        scene.add_body("belt", belt, surface_velocity=(self.speed, 0, 0))
        sides = [Box((along + 0.05, 0.02, 0.3), (along, s * (across + 0.03), top + 0.3)) for s in (-1, 1)]
        scene.add_body("guides", [*sides, Box((0.02, across + 0.05, 0.3), (-0.03, 0, top + 0.3))])
        x, y = 2 * along + 0.5, across + 0.1
        walls = [Box((0.02, y, 0.3), (x + s * h, 0, 0.3)) for s in (-1, 1)]
        walls += [Box((h, 0.02, 0.3), (x, s * y, 0.3)) for s in (-1, 1)]
        scene.add_body("box", [Box((h, y, 0.02), (x, 0, -0.02)), *walls])
        return scene

    def record(self, step):
        """How many are in the box and below it, and the power of the belt."""
        z, power = step.world.grains.position[:, 2], -step.force_on("belt")[0] * self.speed
        return {"arrived": step.total((z > 0) & (z < 0.6)), "lost": step.total(z < 0), "power [W]": power}
