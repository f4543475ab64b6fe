"""Sedimentation of spheres into an open box in which a paddle turns."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from math import inf, isinf, pi, sqrt

import numpy as np

from dem.arrays import Corners, Floats, Rule
from dem.checks import not_negative, positive, positive_or_inf
from dem.experiment import option
from dem.motion import Hinged, Rotation
from dem.packing import perturbed
from dem.record import analysis
from dem.scene import Scene
from dem.shapes import Box
from pctt.scenes.lattice import LargeSpheres


@dataclass(frozen=True)
class Mixer(LargeSpheres):
    """(2n+1)^3 spheres on a randomly perturbed cubic lattice fall into a fixed box onto a turning paddle.

    The box is open at the top, and its width grows as 2n+1. The shape of the paddle relative to the box and its speed
    are those of the mixer benchmark of Chrono.
    """

    margin: float = option(0.0, "width of the box beyond (2n+1) pitch", unit="m", check=not_negative)
    paddle_length: float = option(1 / 2, "length of the paddle", unit="box widths", check=positive)
    paddle_height: float = option(1 / 4, "height of the paddle", unit="box widths", check=positive)
    paddle_thickness: float = option(1 / 20, "thickness of the paddle", unit="box widths", check=positive)
    clearance: float = option(0.05, "gap between the floor and the paddle", unit="m", check=not_negative)
    angular_velocity: float = option(pi / 3, "angular velocity of the paddle about the vertical", unit="rad/s")
    torque: float = option(
        inf,
        "greatest torque of a drive that turns the paddle at that speed; inf: it is prescribed",
        unit="N m", check=positive_or_inf
    )  # fmt: skip

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.radius <= self.clearance <= 2 * self.radius:
            self.refuse("clearance", f"would jam spheres of radius {self.radius:g} m below the paddle")
        reach = sqrt(self.paddle_length**2 + self.paddle_thickness**2)
        if reach >= 1.0:
            self.refuse("paddle_length", f"does not fit: the paddle sweeps {reach:g}, and must stay below 1")

    @property
    def width(self) -> float:
        """Width of the square box [m]."""
        return (2 * self.n + 1) * self.pitch + self.margin

    @property
    def domain(self) -> Corners:
        """The inside of the box [m]."""
        wall = self.width / 2
        return (-wall, -wall, 0.0), (wall, wall, inf)

    @property
    def lattice_bottom(self) -> float:
        """Height of the lowest layer of the lattice [m]: all spheres start above the paddle."""
        return self.clearance + self.paddle_height * self.width + self.radius + 2 * self.perturbation

    @property
    def settling_time(self) -> float:
        """Time [s] after which the packing may be taken as settled: free fall of the highest sphere to the
        floor, and two seconds in which the bed, compressed by the last arrivals, comes to rest."""
        height = self.lattice_bottom + 2 * self.n * self.pitch + self.perturbation
        return sqrt(2 * height / self.gravity) + 2.0

    def positions(self) -> Rule:
        """Centres ((2n+1)^3, 3) of the spheres at the start [m]; the floor is z = 0, the axis x = y = 0."""
        side = np.arange(-self.n, self.n + 1) * self.pitch
        height = self.lattice_bottom + np.arange(2 * self.n + 1) * self.pitch
        return perturbed(side, side, height, self.perturbation, self.seed)

    def build(self) -> Scene:
        """The scene, with the large bodies "box" and "mixer"."""
        scene = self.spheres_alone(self.radius)
        scene.add_body("box", self.walls())
        half = self.width / 2 * np.array([self.paddle_length, self.paddle_thickness, self.paddle_height])
        paddle, middle = [Box(tuple(half))], (0, 0, self.clearance + half[2])
        if isinf(self.torque):
            scene.add_body("mixer", paddle, Rotation((0, 0, self.angular_velocity)), position=middle)
        else:
            drive = Hinged((0, 0, 1), self.torque, speed=self.angular_velocity)
            scene.add_body("mixer", paddle, drive, position=middle, density=self.density)
        return scene

    def analyse(self, records: Mapping[str, Floats]) -> Mapping[str, float | Floats]:
        """The mean of the torque that turns the mixer, without steps that have a jump of energy."""
        torque = records["torque_mixer_z [N m]"][analysis.calm(records)]
        return {"mean_torque [N m]": -float(torque.mean())} if len(torque) else {}
