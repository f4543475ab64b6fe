"""Silo with a conical outlet: how fast it empties."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from math import ceil, pi, radians, sqrt, tan

import numpy as np

from dem.arrays import Floats, Rule
from dem.checks import between, positive
from dem.experiment import option
from dem.mesh import Mesh
from dem.motion import Glide
from dem.scene import Scene
from dem.shapes import Plane
from dem.step import Step
from pctt.scenes.lattice import SmallSpheres, rest_after_fall


@dataclass(frozen=True)
class Silo(SmallSpheres):
    """Spheres settle in a cylinder with a cone below, whose outlet is shut; then the gate drops away, and they flow out
    onto a floor.

    Cylinder and cone are one mesh, of flat sides. The mass below the outlet is recorded; its slope is the flow.
    """

    filling: float = option(
        1.5, "height of the settled bed if it were all in the cylinder", unit="silo diameters", check=positive
    )
    outlet: float = option(5.0, "diameter of the outlet", unit="sphere diameters", check=positive)
    half_angle: float = option(
        30.0, "of the cone, from the vertical; 90: flat bottom", unit="degrees", check=between(5, 90)
    )
    drop: float = option(1.0, "height of the outlet above the floor", unit="silo diameters", check=positive)

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 1.0 < self.outlet < 2 * self.n:
            self.refuse("outlet", f"must be between 1 sphere diameter and the {2 * self.n} of the silo")

    @property
    def outlet_radius(self) -> float:
        """Radius of the outlet, which is at z = 0 [m]."""
        return self.outlet * self.radius

    @property
    def cone_height(self) -> float:
        """Height of the cone [m]."""
        wider = self.container_radius - self.outlet_radius
        return 0.0 if self.half_angle == 90.0 else wider / tan(radians(self.half_angle))

    @property
    def floor(self) -> float:
        """Height of the floor, below zero [m]."""
        return -2 * self.drop * self.container_radius

    @property
    def spheres(self) -> int:
        """Number of the spheres."""
        bed = pi * self.container_radius**2 * 2 * self.filling * self.container_radius
        return ceil(self.packing * bed / (4 / 3 * pi * self.radius**3))

    @property
    def settling_time(self) -> float:
        """Time [s] after which the gate opens."""
        return rest_after_fall(2 * self.filling * self.container_radius, self.gravity) - 1.4

    def positions(self) -> Rule:
        """Centres (spheres, 3) of the spheres at the start [m], a lattice in the cylinder above the cone."""
        layers = ceil(self.spheres * self.pitch**2 / (2 * self.room**2))  # more than enough: pi > 2
        return self.in_container(self.cone_height + (np.arange(layers) + 0.6) * self.pitch, 2, self.spheres)

    def build(self) -> Scene:
        """The scene, with the large bodies "silo", "gate" and "floor"."""
        scene = self.spheres_alone(self.radius)
        wide, hole = self.container_radius, self.outlet_radius
        top = self.highest() + 2 * self.radius
        profile = [(hole, 0.0), (wide, self.cone_height), (wide, top)]
        scene.add_body("silo", [Mesh.revolved(profile, self.sides)])
        # Down and through the floor, in a twentieth of a second. Drawn aside it would wedge spheres against the rim.
        away = Glide((0.0, 0.0, 20 * (self.floor - hole)), self.settling_time, self.settling_time + 0.05)
        disc = Mesh.revolved([(0.0, 0.0), (hole, 0.0)], self.sides)
        scene.add_body("gate", [disc], away)
        scene.add_body("floor", [Plane((0, 0, 1))], position=(0.0, 0.0, self.floor))
        scene.leaving.add("gate")
        return scene

    def record(self, step: Step) -> dict[str, float]:
        """The mass below the outlet."""
        grains = step.world.grains
        return {"discharged [kg]": step.total(grains.mass[grains.position[:, 2] < 0.0])}

    def analyse(self, records: Mapping[str, Floats]) -> dict[str, float | Floats]:
        """The flow while a tenth to a half of the mass runs out, and that by the law of Beverloo, Leniger and van de
        Velde (1961), C rho_bulk sqrt(g) (D - k d)^(5/2), with C = 0.58 and k = 1.5."""
        time, out = records["time [s]"], records["discharged [kg]"]
        total = self.spheres * self.density * 4 / 3 * pi * self.radius**3
        steady = (out > 0.1 * total) & (out < 0.5 * total)
        if np.count_nonzero(steady) < 3:
            return {}
        flow = float(np.polyfit(time[steady], out[steady], 1)[0])
        opening = max(2 * self.outlet_radius - 1.5 * 2 * self.radius, 0.0)
        beverloo = 0.58 * self.packing * self.density * sqrt(self.gravity) * opening**2.5
        return {"mass_flow [kg/s]": flow, "beverloo_flow [kg/s]": beverloo}
