"""Direct shear test: the lower half of a box of spheres under load is displaced, and the stresses are recorded."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from math import pi

import numpy as np

from dem.arrays import Corners, Floats, Rule
from dem.checks import between, not_negative, positive
from dem.experiment import option
from dem.motion import Guided
from dem.packing import perturbed
from dem.record import analysis
from dem.scene import Scene
from dem.shapes import Box, Plane, Shape
from dem.step import Step
from pctt.scenes.lattice import ToAndFro


@dataclass(frozen=True)
class Shear(ToAndFro):
    """(3n+1)(2n+1)^2 spheres settle in a box under a press; then the lower half of the box moves along x and back.

    The box is 3n+1 lattice cells long, along x, and 2n+1 wide. Its halves have thick walls, so that no gap opens where
    one is displaced against the other; the floor moves with the lower half. The press fills the cross-section, can only
    move vertically, and lies on the spheres by its weight.
    """

    n: int = option(4, "size: there are (3n+1)(2n+1)^2 spheres", check=between(1))
    friction: float = option(0.25, "friction coefficient between spheres", check=not_negative)
    wall_friction: float = option(0.25, "friction coefficient of spheres on walls, floor and press", check=not_negative)
    press_density: float = option(10.0, "density of the press", unit="densities of the spheres", check=positive)
    press_thickness: float = option(0.05, "thickness of the press", unit="box widths", check=positive)
    split: float = option(
        0.5, "height of the plane between the halves; packing fraction 0.6", unit="bed depths", check=positive
    )
    stroke: float = option(0.1, "greatest displacement of the lower half", unit="box lengths", check=positive)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.split >= 1.0:
            self.refuse("split", "puts all spheres into the lower half, must be below 1")

    @property
    def length(self) -> float:
        """Length of the box, along x [m]."""
        return (3 * self.n + 1) * self.pitch

    @property
    def width(self) -> float:
        """Width of the box, along y, and height of the lattice [m]."""
        return (2 * self.n + 1) * self.pitch

    @property
    def split_height(self) -> float:
        """Height of the plane between the halves above the floor [m], for a bed with a packing fraction of 0.6."""
        depth = self.width * 4 / 3 * pi * (self.radius / self.pitch) ** 3 / 0.6
        return self.split * depth

    @property
    def area(self) -> float:
        """Area of the plane between the halves, to which the stresses refer at all displacements [m^2]."""
        return self.length * self.width

    @property
    def travel(self) -> float:
        """Greatest displacement of the lower half [m]."""
        return self.stroke * self.length

    @property
    def domain(self) -> Corners:
        """The inside of the box at the greatest displacement [m]."""
        return (-self.length / 2, -self.width / 2, 0.0), (self.length / 2 + self.travel, self.width / 2, self.width)

    def positions(self) -> Rule:
        """Centres ((3n+1)(2n+1)^2, 3) of the spheres at the start [m]; the floor is z = 0."""
        x = (np.arange(3 * self.n + 1) - 1.5 * self.n) * self.pitch
        y = np.arange(-self.n, self.n + 1) * self.pitch
        z = (np.arange(2 * self.n + 1) + 0.5) * self.pitch
        return perturbed(x, y, z, self.perturbation, self.seed)

    def build(self) -> Scene:
        """The scene, with the large bodies "lower", "upper" and "press"."""
        scene = self.spheres_alone(self.radius, "spheres")
        scene.set_pair("spheres", "walls", friction=self.wall_friction)
        thickness = self.press_thickness * self.width
        lower = [Plane((0, 0, 1)), *self._side_walls(-2 * self.radius, self.split_height)]
        scene.add_body("lower", lower, self.to_and_fro(), material="walls")
        scene.add_body("upper", self._side_walls(self.split_height, self.width + thickness), material="walls")
        press, middle = Box((self.length / 2, self.width / 2, thickness / 2)), (0, 0, self.width + thickness / 2)
        density = self.press_density * self.density
        scene.add_body("press", [press], Guided((0, 0, 1)), position=middle, density=density, material="walls")
        return scene

    def _side_walls(self, bottom: float, top: float) -> list[Shape]:
        """The four walls of a half, thick enough that they cover each other at the greatest displacement."""
        thick, tall, middle = self.travel + 4 * self.radius, (top - bottom) / 2, (top + bottom) / 2
        x, y = self.length / 2, self.width / 2
        ends = [Box((thick / 2, y + thick, tall), (side * (x + thick / 2), 0, middle)) for side in (-1, 1)]
        sides = [Box((x, thick / 2, tall), (0, side * (y + thick / 2), middle)) for side in (-1, 1)]
        return [*ends, *sides]

    def record(self, step: Step) -> dict[str, float]:
        """Displacement, mean stresses on the plane between the halves, from all contact forces on the lower half and
        the weight of the spheres in it, and the height of the sample. The force of inertia is neglected."""
        grains, force = step.world.grains, step.force_on("lower")
        below = self.gravity * step.total(grains.mass[grains.position[:, 2] < self.split_height])
        half_press = self.press_thickness * self.width / 2
        return {
            "shear_displacement [m]": step.position("lower")[0],
            "shear_speed [m/s]": step.velocity("lower")[0],
            "shear_stress [Pa]": -force[0] / self.area,
            "normal_stress [Pa]": (-force[2] - below) / self.area,
            "press_stress [Pa]": step.force_on("press")[2] / self.area,
            "sample_height [m]": step.position("press")[2] - half_press,
        }

    def analyse(self, records: Mapping[str, Floats]) -> dict[str, float | Floats]:
        """Filtered stresses, the volume strain since the first record, and friction angles: that of the peak in the
        first stroke, and the steady one while the lower half is fast."""
        time, height = records["time [s]"], records["sample_height [m]"]
        stresses = ["shear_stress [Pa]", "normal_stress [Pa]"]
        out: dict[str, float | Floats] = {"shear_displacement [m]": records["shear_displacement [m]"]}
        out |= analysis.filtered(records, stresses, self.cutoff)
        shear, normal = (np.asarray(out[f"{name}_stress_filtered [Pa]"]) for name in ("shear", "normal"))
        out["volume_strain"] = height / height[0] - 1.0
        stroke = (time > self.settling_time) & (time <= self.settling_time + self.period / 2)
        steady = self.steady(records)
        if stroke.any():
            peak = np.flatnonzero(stroke)[np.argmax(shear[stroke])]
            out["peak_shear_stress [Pa]"] = float(shear[peak])
            out["peak_friction_angle [degrees]"] = analysis.friction_angle(shear[peak], normal[peak])
        if steady.any():
            raw = [records[name][steady] for name in stresses]
            out["steady_shear_stress [Pa]"], out["steady_normal_stress [Pa]"] = (float(values.mean()) for values in raw)
            out["normal_stress_swing"] = float(np.std(raw[1] - normal[steady]) / np.mean(raw[1]))
            out["steady_friction_angle [degrees]"] = analysis.friction_angle(*raw)
        return out
