"""Spheres of two sizes flow out of a hopper with a conical outlet::

    python -m pctt.run -scene docs/examples/hopper.py -ccp_type apgd -steps 240 -output_every 4 -output hopper
    python -m pctt.render hopper -color size -elevation 12 -size 640x480
"""

from __future__ import annotations

from dataclasses import dataclass
from math import pi, radians, tan

import numpy as np

from pctt import Experiment, Glide, Mesh, Plane, Scene, option, perturbed


@dataclass(frozen=True)
class Hopper(Experiment):
    """Spheres settle in a cylinder with a cone below; then the gate drops away."""

    layers: int = option(12, "layers of spheres")
    outlet: float = option(0.03, "diameter of the outlet", unit="m")
    angle: float = option(35.0, "of the cone, from the vertical", unit="degrees")
    friction: float = option(0.4, "friction coefficient of all contacts")
    settling_time: float = option(0.35, "when the gate opens", unit="s")
    dt = 0.004
    delta = 0.0006
    radii, wide = (0.0025, 0.0035), 0.04  # m; of the spheres, and of the cylinder

    def build(self) -> Scene:
        """The scene, with the large bodies "hopper", "gate" and "floor"; the outlet is at z = 0."""
        scene = Scene(self.friction)
        hole, pitch = self.outlet / 2, 2.2 * self.radii[1]
        cone = (self.wide - hole) / tan(radians(self.angle))
        across = np.arange(-6, 7) * pitch
        up = cone + (np.arange(self.layers) + 0.6) * pitch
        places = perturbed(across, across, up, 0.0003, 1)
        places = places[np.hypot(places[:, 0], places[:, 1]) < 0.98 * self.wide - self.radii[1]]
        radius = np.random.default_rng(1).choice(self.radii, len(places))
        scene.add_spheres(places, radius, 2500.0)
        profile = [(hole, 0), (self.wide, cone), (self.wide, up[-1] + pitch)]
        scene.add_body("hopper", [Mesh.revolved(profile, 32)])
        away = Glide((0, 0, -20 * (self.wide + hole)), self.settling_time, self.settling_time + 0.05)
        scene.add_body("gate", [Mesh.revolved([(0, 0), (hole, 0)], 32)], away)
        scene.leaving.add("gate")  # meets no grain: its speed asks for no stiffness
        scene.add_body("floor", [Plane((0, 0, 1))], position=(0, 0, -self.wide))
        return scene

    def record(self, step):
        """The mass below the outlet."""
        grains = step.world.grains
        return {"discharged [kg]": step.total(grains.mass[grains.position[:, 2] < 0])}

    def analyse(self, records):
        """The mean flow from the opening of the gate on, and that over the area of the outlet."""
        time, out = records["time [s]"], records["discharged [kg]"]
        flows = (time > self.settling_time + 0.1) & (out < 0.9 * out[-1])
        if np.count_nonzero(flows) < 3:
            return {}
        flow = float(np.polyfit(time[flows], out[flows], 1)[0])
        return {"flow [kg/s]": flow, "flux [kg/(m^2 s)]": flow / (pi / 4 * self.outlet**2)}
