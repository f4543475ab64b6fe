"""Rotating drum: the angle at which a bed of spheres flows."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from math import atan2, ceil, degrees, pi, sin, sqrt

import numpy as np

from dem.arrays import Corners, Floats, Rule
from dem.checks import between, not_negative, positive
from dem.experiment import option
from dem.mesh import Mesh
from dem.motion import Rotation
from dem.packing import uniform
from dem.record.analysis import calm
from dem.scene import Scene
from dem.step import Step
from pctt.scenes.lattice import SmallSpheres, rest_after_fall


@dataclass(frozen=True)
class Drum(SmallSpheres):
    """Spheres fall into a drum of radius n sphere diameters; when they are at rest it begins to turn about its axis.

    The drum is a mesh of flat sides with a horizontal axis, along y; its ends are discs, without friction by default,
    so that a short drum stands for a piece of a long one.
    """

    n: int = option(8, "size: radius of the drum in diameters of a sphere", check=between(3))
    length: float = option(6.0, "length of the drum", unit="sphere diameters", check=between(2))
    fill: float = option(0.3, "part of the drum that the settled bed fills, at most about a third", check=positive)
    spread: float = option(
        0.2, "part by which the smallest spheres are smaller; equal ones order themselves", check=between(0, 0.9)
    )
    friction: float = option(0.5, "friction coefficient between spheres", check=not_negative)
    wall_friction: float = option(0.9, "friction coefficient on the side of the drum", check=not_negative)
    end_friction: float = option(0.0, "friction coefficient on the ends of the drum", check=not_negative)
    froude: float = option(0.01, "speed: Froude number omega^2 R / g", check=positive)
    sides: int = option(48, "flat sides of the drum", check=between(12))

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.spheres > (most := len(self._lattice())):
            room = f"{self.spheres} spheres, but only {most} have room at the start"
            self.refuse("fill", f"needs {room}; take a smaller fill or a larger n")

    @property
    def width(self) -> float:
        """Length of the drum [m]."""
        return 2 * self.length * self.radius

    @property
    def speed(self) -> float:
        """Angular velocity of the drum [rad/s]."""
        return sqrt(self.froude * self.gravity / self.container_radius)

    @property
    def spheres(self) -> int:
        """Number of the spheres: they fill their part of the drum."""
        area = 0.5 * self.sides * self.container_radius**2 * sin(2 * pi / self.sides)
        s = self.spread
        mean_cube = 1 - 3 / 2 * s + s**2 - s**3 / 4  # of radii from 1 - s to 1
        return ceil(self.packing * self.fill * area * self.width / (4 / 3 * pi * self.radius**3 * mean_cube))

    @property
    def settling_time(self) -> float:
        """Time [s] after which the drum starts."""
        return rest_after_fall(2 * self.container_radius, self.gravity) - 1.5

    @property
    def domain(self) -> Corners:
        """The box around the drum [m]."""
        high = (self.container_radius, self.width / 2, self.container_radius)
        return (-high[0], -high[1], -high[2]), high

    def positions(self) -> Rule:
        """Centres (spheres, 3) of the spheres at the start [m], the lowest of a lattice in the drum."""
        return self._lattice(self.spheres)

    def _lattice(self, most: int | None = None) -> Rule:
        """Places of the lattice in the drum, the lowest first: so many, or all."""
        slots = max(int((self.width - 2 * self.radius - 2 * self.perturbation) / self.pitch) + 1, 1)
        return self.in_container((np.arange(slots) - (slots - 1) / 2) * self.pitch, 1, most)

    def build(self) -> Scene:
        """The scene, with the large bodies "drum" and "ends"."""
        part = uniform(1.0 - self.spread, 1.0, (self.spheres,), self.seed)
        radii = Rule(self.spheres, lambda first, end: self.radius * part[first:end])
        scene = self.spheres_alone(radii, "spheres")
        scene.set_pair("spheres", "side", friction=self.wall_friction)
        scene.set_pair("spheres", "ends", friction=self.end_friction)
        half, wide = self.width / 2, self.container_radius
        turning = Rotation((0.0, self.speed, 0.0), start=self.settling_time)
        along_y = (sqrt(0.5), -sqrt(0.5), 0.0, 0.0)  # where the z axis is turned to
        side = Mesh.revolved([(wide, -half), (wide, half)], self.sides, quaternion=along_y)
        ends = [Mesh.revolved([(0.0, z), (wide, z)], self.sides, quaternion=along_y) for z in (-half, half)]
        scene.add_body("drum", [side], turning, material="side")
        scene.add_body("ends", ends, turning, material="ends")
        return scene

    def record(self, step: Step) -> dict[str, float]:
        """Angle of the bed's centre of mass about the axis, from the vertical, and the torque on the drum."""
        grains = step.world.grains
        x, z = (step.total(grains.mass * grains.position[:, k]) for k in (0, 2))
        return {"bed_angle [degrees]": degrees(atan2(-x, -z)), "drum_torque [N m]": step.force_on("drum")[4]}

    def analyse(self, records: Mapping[str, Floats]) -> dict[str, float | Floats]:
        """Mean and standard deviation of the angle after the drum has turned by 90 degrees."""
        time, angle = records["time [s]"], records["bed_angle [degrees]"]
        steady = (time > self.settling_time + 0.5 * pi / self.speed) & calm(records)
        if not steady.any():
            return {}
        return {
            "dynamic_angle [degrees]": float(angle[steady].mean()),
            "angle_deviation [degrees]": float(angle[steady].std()),
        }
