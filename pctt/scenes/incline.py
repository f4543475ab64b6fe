"""An endless incline: spheres flow down a rough bottom, in a cell that is periodic along and across it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from math import cos, radians, sin
from typing import ClassVar

import numpy as np

from dem.arrays import Floats
from dem.checks import between, not_negative, positive
from dem.experiment import Experiment, option
from dem.measures import Block, solid_fraction
from dem.packing import perturbed
from dem.record.analysis import calm
from dem.scene import Scene
from dem.shapes import Plane, Sphere
from dem.step import Step


@dataclass(frozen=True)
class Incline(Experiment):
    """A bed of n layers of spheres on a plane with fixed spheres, under tilted gravity: x is down the incline, z is
    normal to it.

    The bottom has a sphere per lattice place, displaced at random along it; see Silbert et al., Physical Review E 64
    (2001) 051302, whose bottom is a layer of a packing instead.
    """

    n: int = option(8, "number of layers of spheres", check=between(1))
    length: int = option(8, "length of the cell in spheres of the bottom", check=between(6))
    width: int = option(6, "width of the cell in spheres of the bottom", check=between(6))
    angle: float = option(24.0, "angle of the incline", unit="deg", check=between(0.0, 90.0))
    radius: float = option(0.005, "radius of the spheres", unit="m", check=positive)
    density: float = option(2500.0, "density of the spheres (glass)", unit="kg/m^3", check=positive)
    friction: float = option(0.5, "friction coefficient of all contacts", check=not_negative)
    gravity: float = option(9.81, "gravity", unit="m/s^2", check=positive)
    seed: int = option(1, "seed of the displacements", check=not_negative)

    pitch: ClassVar[float] = 2.2  #: of the lattice on which the spheres start, in radii

    @property
    def cell(self) -> tuple[float, float]:
        """Periods along x and y [m]."""
        return self.length * self.pitch * self.radius, self.width * self.pitch * self.radius

    def build(self) -> Scene:
        """The scene, with the large body "bottom"."""
        r, tilt, space = self.radius, radians(self.angle), self.pitch * self.radius
        gravity = (self.gravity * sin(tilt), 0.0, -self.gravity * cos(tilt))
        scene = Scene(self.friction, gravity=gravity, period=(*self.cell, None))
        x, y = (np.arange(count) + 0.5 for count in (self.length, self.width))
        fixed = perturbed(x * space, y * space, np.zeros(1), 0.4 * space, self.seed)[:] * [1.0, 1.0, 0.0]
        bottom = [Sphere(radius=r, center=tuple(place)) for place in fixed.tolist()]
        scene.add_body("bottom", [Plane(normal=(0.0, 0.0, 1.0)), *bottom])
        layers = 2.0 * r + space * (np.arange(self.n) + 0.5)
        places = perturbed(x * space, y * space, layers, 0.04 * space, self.seed + 1)
        scene.add_spheres(places, r, self.density)
        return scene

    def record(self, step: Step) -> dict[str, float]:
        """Mean speed along the incline and height of the spheres, and the solid fraction of the middle of the bed."""
        grains, count = step.world.grains, float(step.world.slabs[-1])
        height = step.total(grains.position[:, 2]) / count
        middle = Block((0.0, 0.0, 0.5 * height), (*self.cell, 1.5 * height))
        return {
            "speed [m/s]": step.total(grains.velocity[:, 0]) / count,
            "height [m]": height,
            "solid_fraction": solid_fraction(step.sample, middle),
        }

    def analyse(self, records: Mapping[str, Floats]) -> dict[str, float | Floats]:
        """Mean speed and solid fraction over the last half of the time, and the mean acceleration down the incline over
        that of a bed without friction."""
        time, speed = records["time [s]"], records["speed [m/s]"]
        if len(time) < 2:
            return {}
        late = (time >= 0.5 * time[-1]) & calm(records)
        free = self.gravity * sin(radians(self.angle))
        return {
            "speed [m/s]": float(speed[late].mean()),
            "solid_fraction": float(records["solid_fraction"][late].mean()),
            "acceleration [g sin angle]": float((speed[-1] - speed[0]) / (time[-1] - time[0]) / free) if free else 0.0,
        }
