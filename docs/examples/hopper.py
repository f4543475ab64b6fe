"""Grains of rice, which are capsules, flow out of a hopper::

    python -m pctt.run -scene docs/examples/hopper.py -ccp_type apgd -steps 360 -output_every 4 -output hopper
    python -m pctt.render hopper -color speed -elevation 12 -size 640x480
"""

from __future__ import annotations

from dataclasses import dataclass
from math import pi, radians, tan

import numpy as np

from dem.experiment import Experiment, option
from dem.mesh import Mesh
from dem.motion import Glide
from dem.scene import Scene
from dem.scenes.lattice import perturbed
from dem.shapes import Plane


@dataclass(frozen=True)
class Hopper(Experiment):
    """Capsules settle in a cylinder with a conical outlet; then the gate slides away."""

    layers: int = option(10, "", "layers of grains")
    outlet: float = option(0.024, "m", "diameter of the outlet")
    angle: float = option(35.0, "degrees", "of the cone, from the vertical")
    friction: float = option(0.4, "", "friction coefficient of all contacts")
    settling_time: float = option(0.3, "s", "when the gate opens")
    dt = 0.0025
    delta = 0.0005
    radius, half_length, wide = 0.0025, 0.0025, 0.04  # m; of the core of a grain, and the radius of the cylinder

    def build(self) -> Scene:
        """The scene, with the large bodies "hopper", "gate" and "floor"; the outlet is at z = 0."""
        scene = Scene(self.friction)
        hole = self.outlet / 2
        cone, pitch = (self.wide - hole) / tan(radians(self.angle)), 2.2 * (self.radius + self.half_length)
        across = np.arange(-8, 9) * pitch
        up = cone + (np.arange(self.layers) + 0.6) * pitch
        places = perturbed(across, across, up, 0.0003, 1)
        room = 0.98 * self.wide - self.radius - self.half_length
        places = places[np.hypot(places[:, 0], places[:, 1]) < room]
        turns = np.random.default_rng(1).standard_normal((len(places), 4))  # every direction is equally likely
        turns /= np.linalg.norm(turns, axis=1, keepdims=True)
        scene.add_capsules(places, self.radius, self.half_length, 1400.0, quaternions=turns)
        profile = [(hole, 0), (self.wide, cone), (self.wide, up[-1] + pitch)]
        scene.add_body("hopper", [Mesh.revolved(profile, 32)])
        away = Glide((20 * hole, 0, 0), self.settling_time, self.settling_time + 0.1)
        scene.add_body("gate", [Mesh.revolved([(0, 0), (hole, 0)], 32)], away)
        scene.add_body("floor", [Plane((0, 0, 1))], position=(0, 0, -self.wide))
        return scene

    def record(self, step):
        """The mass below the outlet."""
        grains = step.world.grains
        return {"discharged [kg]": step.total(grains.mass[grains.position[:, 2] < 0])}

    def analyse(self, records):
        """The mean flow, and that over the area of the outlet."""
        time, out = records["time [s]"], records["discharged [kg]"]
        open_ = time > self.settling_time + 0.1
        if np.count_nonzero(open_) < 3:
            return {}
        flow = float(np.polyfit(time[open_], out[open_], 1)[0])
        return {"flow [kg/s]": flow, "flux [kg/(m^2 s)]": flow / (pi / 4 * self.outlet**2)}
