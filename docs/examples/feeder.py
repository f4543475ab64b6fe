"""A source feeds a belt, which carries the grains to its end; there they fall and leave by an outlet::

    python -m pctt.run -scene docs/examples/feeder.py -steps 2000 -output_every 20 -output feeder
    python -m pctt.render feeder -color size -elevation 15 -size 640x480
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from dem.arrays import Floats
from pctt import Block, Box, Experiment, Scene, Uniform, option


@dataclass(frozen=True)
class Feeder(Experiment):
    """A belt of 1 m with guides at its sides, at z = 0. What falls off it leaves half a metre below."""

    rate: float = option(2.0, "that falls on the belt", unit="kg/s")
    speed: float = option(0.8, "of the belt", unit="m/s")
    radius: float = option(0.015, "mean radius of the spheres; they are uniform within a third of it", unit="m")

    def build(self) -> Scene:
        """The scene, with the large bodies "belt" and "guides", the source "feed" and the outlet "end"."""
        scene, r = Scene(0.4), self.radius
        along = (self.speed, 0.0, 0.0)
        scene.add_body("belt", [Box((0.5, 0.15, 0.02))], position=(0.5, 0.0, -0.02), surface_velocity=along)
        sides = [Box((0.5, 0.01, 0.1), (0.5, y, 0.1)) for y in (-0.16, 0.16)]
        scene.add_body("guides", [*sides, Box((0.01, 0.17, 0.1), (-0.01, 0.0, 0.1))])
        region = Block((0.05, -0.1, 0.1), (0.2, 0.1, 0.25))
        scene.add_source("feed", region, radius=Uniform(r / 1.5, r * 4 / 3), density=2500.0, mass_rate=self.rate)
        scene.add_outlet("end", Block((-10, -10, -10), (10, 10, -0.5)))
        return scene

    def analyse(self, records: Mapping[str, Floats]) -> dict[str, float | Floats]:
        """The mass on its way, and the mean flow at the end in the last half of the time."""
        time, out = records["time [s]"], records["mass_end [kg]"]
        found: dict[str, float | Floats] = {"held [kg]": float(records["mass_feed [kg]"][-1] - out[-1])}
        late = time >= 0.5 * time[-1]
        if np.count_nonzero(late) > 1:
            found["flow [kg/s]"] = float(np.polyfit(time[late], out[late], 1)[0])
        return found
