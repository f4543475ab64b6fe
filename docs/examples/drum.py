"""The two halves of a bed, of equal spheres, mix in a turning drum::

    python -m pctt.run -scene docs/examples/drum.py -ccp_type apgd -steps 500 -output_every 4 -output drum
    python -m pctt.render drum -color material -azimuth -75 -elevation 12 -size 640x480
"""

from __future__ import annotations

from dataclasses import dataclass
from math import pi, sqrt

import numpy as np

from pctt import Experiment, Mesh, Rotation, Scene, option, perturbed


@dataclass(frozen=True)
class MixingDrum(Experiment):
    """Spheres fall into a drum, left ones and right ones of different materials; then it turns about the y axis."""

    radius: float = option(0.06, "radius of the drum", unit="m")
    length: float = option(0.05, "length of the drum", unit="m")
    grain: float = option(0.004, "radius of a sphere", unit="m")
    period: float = option(2.0, "time of a turn", unit="s")
    friction: float = option(0.5, "friction coefficient between spheres, and on the side of the drum")
    settling_time: float = option(0.3, "when the drum begins to turn", unit="s")
    dt = 0.005
    delta = 0.0008

    def build(self) -> Scene:
        """The scene, with the large bodies "side" and "ends"; the ends have no friction, as of a long drum."""
        scene = Scene(self.friction)
        scene.set_pair("left", "ends", friction=0.0)
        scene.set_pair("right", "ends", friction=0.0)
        pitch, room = 2.2 * self.grain, self.radius - 1.5 * self.grain
        across = np.arange(-int(room / pitch), int(room / pitch) + 1) * pitch
        count = int((self.length - 2.2 * self.grain) / pitch) + 1
        along = (np.arange(count) - (count - 1) / 2) * pitch
        places = perturbed(across, along, across, 0.05 * self.grain, 1)
        places = places[(np.hypot(places[:, 0], places[:, 2]) < room) & (places[:, 2] < 0.2 * self.radius)]
        for name, side in (("left", places[:, 0] < 0), ("right", places[:, 0] >= 0)):
            scene.add_spheres(places[side], self.grain, 2500.0, material=name)
        turn, flat = Rotation((0, 2 * pi / self.period, 0), start=self.settling_time), self.length / 2
        upright = (sqrt(0.5), -sqrt(0.5), 0, 0)  # the z axis of the meshes becomes the y axis
        side = Mesh.revolved([(self.radius, -flat), (self.radius, flat)], 48, quaternion=upright)
        ends = [Mesh.revolved([(0, y), (self.radius, y)], 48, quaternion=upright) for y in (-flat, flat)]
        scene.add_body("side", [side], turn, material="side")
        scene.add_body("ends", ends, turn, material="ends")
        return scene

    def record(self, step):
        """How far apart the centres of mass of the two halves are, over the radius: 0 if they are mixed."""
        grains = step.world.grains
        left = grains.material == step.world.materials.index("left")
        middles = [step.total(grains.position[half]) / step.total(half) for half in (left, ~left)]
        return {"separation": float(np.linalg.norm(middles[1] - middles[0])) / self.radius}
