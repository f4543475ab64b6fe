"""The silo of Dosta et al. (2024), Comput. Phys. Commun. 296, 109066: spheres of 4 mm flow out of a cone."""

from __future__ import annotations

from dataclasses import dataclass

from dem.arrays import Floats
from dem.checks import not_negative
from dem.experiment import option
from dem.scene import Scene
from pctt.scenes.silo import Silo


@dataclass(frozen=True)
class DostaSilo(Silo):
    """Orifice and cone have the published size. The silo is narrower, and the bed is less deep: 100,000 spheres in a
    silo of 200 mm there."""

    n: int = option(13, "radius of the silo in diameters of a sphere; 25 there")
    radius: float = option(0.002, "radius of the spheres", unit="m")
    friction: float = option(0.3, "friction coefficient between spheres: of M1", check=not_negative)
    wall_friction: float = option(0.2, "friction coefficient of steel", check=not_negative)
    bounce: float = option(0.5, "restitution between spheres: of M1", check=not_negative)
    wall_bounce: float = option(0.4, "restitution of steel", check=not_negative)
    outlet: float = option(10.0, "diameter of the orifice: the small one", unit="sphere diameters")
    half_angle: float = option(45.0, "of the cone, from the vertical", unit="degrees")
    filling: float = option(0.8, "height of the settled bed if it were all in the cylinder", unit="silo diameters")
    perturbation: float = option(
        0.00016, "greatest displacement of a sphere from its lattice point, per axis", unit="m"
    )
    dt = 0.001
    delta = 0.0004

    @property
    def settling_time(self) -> float:
        """Time [s] after which the gate opens."""
        return 0.5

    def spheres_alone(self, radius: float | Floats, material: str = "spheres") -> Scene:
        """A scene with the spheres; all else is of steel."""
        scene = super().spheres_alone(radius, material="spheres")
        scene.set_pair("spheres", "spheres", restitution=self.bounce)
        scene.set_pair("spheres", "default", friction=self.wall_friction, restitution=self.wall_bounce)
        return scene
