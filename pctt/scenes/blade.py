"""Drafting test: a blade is drawn through a bed of spheres, and the force that this takes is recorded."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from dem.arrays import Corners, Floats, Rule
from dem.checks import not_negative, positive
from dem.experiment import option
from dem.packing import perturbed
from dem.record import analysis
from dem.scene import Scene
from dem.shapes import Box
from dem.step import Step
from pctt.scenes.lattice import ToAndFro


@dataclass(frozen=True)
class Blade(ToAndFro):
    """(2n+1)^3 spheres settle in a closed box, then a blade goes from one end to the other and back.

    The blade spans the width of the box, as in the bin of Melanz et al. (2017), and stands upright, its lower edge at
    about two thirds of the height of the bed and its upper edge above the surface. It starts near one end, beside the
    spheres, and stops short of both ends, so that the spheres in front can flow under it and are not crushed. Lengths
    given in box widths keep the experiment similar for all n.
    """

    margin: float = option(0.0, "width of the box beyond (2n+1) pitch", unit="m", check=not_negative)
    thickness: float = option(0.1, "thickness of the blade", unit="m", check=positive)
    blade_height: float = option(0.3, "height of the blade", unit="box widths", check=positive)
    clearance: float = option(0.3, "gap between the floor and the blade", unit="box widths")
    end_gap: float = option(0.3, "gap between the blade and the end walls where it turns", unit="box widths")

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("clearance", "end_gap"):
            gap = getattr(self, name) * self.width
            if gap < 2 * self.radius:
                self.refuse(name, f"is {gap:g} m: spheres would jam; make it or the margin of the box wider")
        if self.end_gap >= 1.0:
            self.refuse("end_gap", "leaves the blade no way to go, must be below 1")
        if (self.clearance + self.blade_height) * self.width > self.height:
            self.refuse("blade_height", f"takes the blade above the lid at {self.height:g} m")

    @property
    def width(self) -> float:
        """Width of the box, across the way of the blade [m]."""
        return (2 * self.n + 1) * self.pitch + self.margin

    @property
    def length(self) -> float:
        """Length of the box, along the way of the blade [m]: the cube of spheres, and the place of the blade."""
        return self.width + self.end_gap * self.width + self.thickness

    @property
    def height(self) -> float:
        """Height of the lid [m]."""
        return self.width + self.pitch

    @property
    def travel(self) -> float:
        """Way of the blade from one end to the other [m]."""
        return self.width - self.end_gap * self.width

    @property
    def start(self) -> float:
        """x coordinate of the middle of the blade at the start [m]; the middle of the box is x = 0."""
        return -self.length / 2 + self.end_gap * self.width + self.thickness / 2

    @property
    def domain(self) -> Corners:
        """The inside of the box [m]."""
        return (-self.length / 2, -self.width / 2, 0.0), (self.length / 2, self.width / 2, self.height)

    def positions(self) -> Rule:
        """Centres ((2n+1)^3, 3) of the spheres at the start [m], between the blade and the far end."""
        steps = (np.arange(2 * self.n + 1) + 0.5) * self.pitch
        x = self.start + self.thickness / 2 + self.margin / 2 + steps
        y = steps - self.width / 2 + self.margin / 2
        return perturbed(x, y, steps, self.perturbation, self.seed)

    def build(self) -> Scene:
        """The scene, with the large bodies "box" and "blade"."""
        scene = self.spheres_alone(self.radius)
        scene.add_body("box", self.walls())
        half = (self.thickness / 2, self.width / 2, self.blade_height * self.width / 2)
        middle = (self.start, 0, self.clearance * self.width + half[2])
        scene.add_body("blade", [Box(half)], self.to_and_fro(), position=middle)
        return scene

    def record(self, step: Step) -> dict[str, float]:
        """Where the blade is, and the force against its way out."""
        return {
            "blade_position [m]": step.position("blade")[0] - self.start,
            "blade_speed [m/s]": step.velocity("blade")[0],
            "draft_force [N]": -step.force_on("blade")[0],
        }

    def analyse(self, records: Mapping[str, Floats]) -> dict[str, float | Floats]:
        """Filtered forces and torques, and mean, median and standard deviation of the draft force while the blade is
        fast on its first way."""
        names = ["draft_force [N]"]
        names += [f"force_blade_{axis} [N]" for axis in "xyz"] + [f"torque_blade_{axis} [N m]" for axis in "xyz"]
        out: dict[str, float | Floats] = {"blade_position [m]": records["blade_position [m]"]}
        out |= analysis.filtered(records, names, self.cutoff)
        force = records["draft_force [N]"][self.steady(records)]
        if len(force):
            out["steady_draft_force [N]"] = float(force.mean())
            out["median_draft_force [N]"] = float(np.median(force))
            out["draft_force_deviation [N]"] = float(force.std())
        return out
