"""Single-wheel rig: a wheel that turns at a given speed drives over a bed of spheres."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from math import ceil, pi, sqrt

import numpy as np

from dem.arrays import Corners, Floats, Rule
from dem.checks import between, finite, not_negative, positive
from dem.experiment import option
from dem.mesh import Mesh
from dem.motion import Held
from dem.packing import perturbed
from dem.quaternion import exponential
from dem.record.analysis import calm
from dem.scene import Scene
from dem.shapes import Box, Shape
from dem.step import Step
from pctt.scenes.lattice import Spheres, rest_after_fall


@dataclass(frozen=True)
class Wheel(Spheres):
    """A wheel settles with its weight on a bed of spheres. Then its axle, along y, is turned at constant speed.

    The wheel is free to rise and sink. Its carriage moves forwards, along x, at the speed of a given slip, or freely
    against a drawbar load; it holds the wheel across and upright. The wheel is a star of bars through the axle, or the
    surface of an STL file, and as wide as the bin, whose walls have no friction: a slice of a wide wheel. Lengths are
    in radii of the wheel and its speed is a Froude number, so that wheels of all n are similar (Slonaker et al.,
    "General scaling relations for locomotion in granular media", Phys. Rev. E 95, 052901 (2017)).
    """

    n: int = option(6, "size: radius of the wheel in diameters of a sphere", check=between(3))
    radius: float = option(0.005, "radius of the spheres", unit="m", check=positive)
    friction: float = option(0.5, "friction coefficient between spheres, and of the wheel", check=not_negative)
    perturbation: float = option(
        0.0004, "greatest displacement of a sphere from its lattice point, per axis", unit="m", check=not_negative
    )
    width: float = option(5.0, "width of the bin", unit="sphere diameters", check=between(2))
    depth: float = option(1.2, "depth of the bed", unit="wheel radii", check=positive)
    way: float = option(2.0, "way of the wheel for which the bin has room", unit="wheel radii", check=positive)
    froude: float = option(0.05, "spin of the wheel: Froude number omega^2 R / g", check=positive)
    slip: float = option(0.3, "slip 1 - v / (omega R) of a carriage that is driven")
    free: bool = option(False, "the carriage moves freely, against the drawbar load")
    drawbar: float = option(0.0, "load that pulls a free carriage backwards", unit="wheel weights", check=finite)
    weight: float = option(0.25, "weight of the wheel, over that of spheres in its circle", check=positive)
    bars: int = option(6, "number of bars through the axle", check=between(2))
    thickness: float = option(0.2, "thickness of the bars", unit="wheel radii", check=between(0.01, 1.0))
    file: str = option("", "STL file of a wheel with its axle along y through the origin, in its radii")

    packing = 0.6  #: share of the volume that settled spheres take

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.free:
            self.refuse_idle("a carriage that moves freely; allowed without the option free", "slip")
        else:
            self.refuse_idle("a carriage that is driven; allowed with the option free", "drawbar")
        if self.file:
            self.refuse_idle("a wheel of a file; allowed without the option file", "bars", "thickness")

    @property
    def pitch(self) -> float:
        """Spacing of the lattice on which the spheres start [m]."""
        return 2.2 * self.radius

    @property
    def wheel_radius(self) -> float:
        """Radius of the wheel [m]."""
        return 2 * self.n * self.radius

    @property
    def spin(self) -> float:
        """Speed at which the wheel turns [rad/s]."""
        return sqrt(self.froude * self.gravity / self.wheel_radius)

    @property
    def mass(self) -> float:
        """Mass of the wheel [kg]."""
        return self.weight * self.packing * self.density * pi * self.wheel_radius**2 * self.bin_width

    @property
    def bin_width(self) -> float:
        """[m]"""
        return 2 * self.width * self.radius

    @property
    def length(self) -> float:
        """Length of the bin [m]: the way, and a place of three radii at both ends together."""
        return (self.way + 3.0) * self.wheel_radius

    @property
    def settling_time(self) -> float:
        """Time [s] after which the wheel turns."""
        return rest_after_fall(self.highest() + self.wheel_radius, self.gravity)

    @property
    def domain(self) -> Corners:
        """The inside of the bin, which is open at the top [m]."""
        return (0.0, -self.bin_width / 2, 0.0), (self.length, self.bin_width / 2, np.inf)

    def positions(self) -> Rule:
        """Centres of the spheres at the start [m]; settled they fill the depth."""
        x, y = (self._places(extent) for extent in (self.length, self.bin_width))
        volume = self.packing * self.depth * self.wheel_radius * self.length * self.bin_width
        layers = ceil(volume / (4 / 3 * pi * self.radius**3 * len(x) * len(y)))
        z = (np.arange(layers) + 0.5) * self.pitch
        return perturbed(x, y - self.bin_width / 2, z, self.perturbation, self.seed)

    def _places(self, extent: float) -> Floats:
        """Coordinates of the lattice between two walls."""
        count = int(extent / self.pitch)
        return (np.arange(count) + 0.5) * (extent / count)

    def build(self) -> Scene:
        """The scene, with the large bodies "floor", "walls" and "wheel"."""
        scene = self.spheres_alone(self.radius, "spheres")
        scene.set_pair("spheres", "walls", friction=0.0)
        floor, *walls = self.walls()
        scene.add_body("floor", [floor], material="spheres")
        scene.add_body("walls", walls, material="walls")
        forwards = None if self.free else self.spin * self.wheel_radius * (1.0 - self.slip)
        rig = Held((forwards, 0.0, None), (0.0, self.spin, 0.0), start=self.settling_time)
        height = self.highest() + 1.1 * self.radius + self.wheel_radius + self.perturbation
        place = (1.5 * self.wheel_radius, 0.0, height)
        scene.add_body("wheel", self._shapes(), rig, position=place, mass=self.mass, material="spheres")
        if self.free:
            load = (-self.drawbar * self.mass * self.gravity, 0.0, 0.0)
            scene.add_load("drawbar", on="wheel", force=load, start=self.settling_time)
        return scene

    def _shapes(self) -> list[Shape]:
        R = self.wheel_radius
        if self.file:
            return [Mesh.read(self.file, scale=R)]
        thick, half = 0.5 * self.thickness * R, 0.5 * self.bin_width - 0.1 * self.radius
        size = (sqrt(R**2 - thick**2), half, thick)
        angles = np.arange(self.bars) * pi / self.bars
        return [Box(size, quaternion=tuple(exponential(np.array([0.0, angle, 0.0])))) for angle in angles]

    def record(self, step: Step) -> dict[str, float]:
        """Slip, pull on the drawbar, torque and power of the axle, and sinkage below the level of the bed away from
        the wheel."""
        place, velocity, force = (get("wheel") for get in (step.position, step.velocity, step.force_on))
        grains, R = step.world.grains.position, self.wheel_radius
        away = np.abs(grains[:, 0] - place[0]) > 1.5 * R
        level = 2.0 * step.total(grains[away, 2]) / max(step.total(away), 1.0)  # the centre is at half the height
        rim = velocity[4] * R
        return {
            "way [m]": place[0] - 1.5 * R,
            "slip": 1.0 - velocity[0] / rim if rim else 0.0,
            "drawbar_pull [N]": force[0],
            "torque [N m]": -force[4],
            "power [W]": -force[4] * velocity[4],
            "sinkage [m]": level - (place[2] - R),
        }

    def analyse(self, records: Mapping[str, Floats]) -> dict[str, float | Floats]:
        """Means after the wheel has turned by half a radian and before it comes to the end of its way: slip, pull over
        weight, power over M g sqrt(R g), sinkage over radius."""
        R, weight = self.wheel_radius, self.mass * self.gravity
        since = (records["time [s]"] - self.settling_time) * self.spin
        steady = (since > 0.5) & (records["way [m]"] < self.way * R) & calm(records)
        if not steady.any():
            return {}
        scales = {"slip": 1.0, "drawbar_pull [N]": weight, "sinkage [m]": R, "torque [N m]": weight * R}
        scales["power [W]"] = weight * sqrt(R * self.gravity)
        return {f"mean_{name.split()[0]}": float(records[name][steady].mean()) / by for name, by in scales.items()}
