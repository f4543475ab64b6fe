"""The triaxial test: a cell of spheres under a lateral stress is compressed along its axis."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from math import asin, degrees, pi, sqrt
from typing import ClassVar

import numpy as np

from dem.arrays import Floats, Ints
from dem.checks import between, not_negative, positive
from dem.experiment import Experiment, option
from dem.packing import random_packing
from dem.parts.cell import PASSING, STRAINED
from dem.parts.sizes import Uniform
from dem.record import cell
from dem.record.analysis import calm
from dem.scene import Scene
from dem.step import Step


@dataclass(frozen=True)
class Triaxial(Experiment):
    """Spheres in a cell with three periods and no gravity. The cell first has the same stress on all sides. Then it is
    compressed along z at a constant rate of strain, and keeps the stress along x and y (or, in plane strain, its width
    along y). There are no walls, so the sample deforms as a whole.

    At large strain its volume and stress no longer change: the critical state, whatever the density at the start.
    """

    n: int = option(8, "width of the cell in diameters along x and y at the start", check=between(6))
    height: float = option(1.5, "its height at the start, over its width", check=between(1.0))
    pressure: float = option(
        1000.0, "stress of the isotropic compression, and along x and y", unit="Pa", check=positive
    )
    strain_rate: float = option(0.1, "rate of the logarithmic strain along z", unit="1/s", check=positive)
    start: float = option(0.5, "time of the isotropic compression", unit="s", check=not_negative)
    plane: bool = option(False, "plane strain, a biaxial test: the width along y stays")
    radius: float = option(0.005, "mean radius of the spheres", unit="m", check=positive)
    spread: float = option(0.2, "radii are uniform within this part of the mean", check=between(0.0, 0.5))
    density: float = option(2500.0, "density of the spheres (glass)", unit="kg/m^3", check=positive)
    friction: float = option(0.5, "friction coefficient of all contacts", check=not_negative)
    fraction: float = option(
        0.6, "solid fraction at the start; with less the sample is loose", check=between(0.1, 0.62)
    )
    seed: int = option(1, "seed of the places and radii", check=not_negative)

    PEAK: ClassVar[float] = 0.01  #: the strain over which the stresses of a peak are averaged

    @property
    def dt(self) -> float:  # type: ignore[override]
        """Recommended time step [s]."""
        time = 2.0 * self.radius * sqrt(self.density / self.pressure)
        return float(f"{min(PASSING * time, STRAINED / self.strain_rate):.2g}")

    def build(self) -> Scene:
        """The scene."""
        side, r = 2.0 * self.n * self.radius, self.radius
        sizes = Uniform(r * (1.0 - self.spread), r * (1.0 + self.spread)) if self.spread else r
        lengths = (side, side, self.height * side)
        place, radius = random_packing(lengths, sizes, self.fraction, periodic=(True,) * 3, seed=self.seed)
        scene = Scene(
            self.friction, (0.0, 0.0, 0.0), period=lengths, stress=(self.pressure,) * 3,
            strain_rate=(None, 0.0 if self.plane else None, self.strain_rate), strain_start=self.start,
        )  # fmt: skip
        scene.add_spheres(place, radius, self.density)
        return scene

    def record(self, step: Step) -> dict[str, float]:
        """Axial and lateral stress, that of the plane of deformation in plane strain; q/p, strain and solid
        fraction."""
        of_cell = cell(step)
        x, y, z = (of_cell[f"stress_{axis}{axis} [Pa]"] for axis in "xyz")
        volume = step.total(4.0 / 3.0 * pi * step.world.grains.size[:, 0] ** 3)
        lateral = x if self.plane else 0.5 * (x + y)
        return {
            "axial_strain": max(step.world.time - self.start, 0.0) * self.strain_rate,
            "axial_stress [Pa]": z,
            "lateral_stress [Pa]": lateral,
            "q_over_p": 3.0 * (z - lateral) / max(x + y + z, 1e-300),
            "solid_fraction": volume / (of_cell["period_x [m]"] * of_cell["period_y [m]"] * of_cell["period_z [m]"]),
        }

    def analyse(self, records: Mapping[str, Floats]) -> dict[str, float | Floats]:
        """The volumetric strain since the compression began, positive where the volume grows. The friction angle at the
        peak, of means over a strain of PEAK; that of the last third of the strain, its standard error from ten parts,
        and there the solid fraction, the coordination number and the dilation, the volumetric over the axial strain."""
        strain, fraction = records["axial_strain"], records["solid_fraction"]
        shears = np.flatnonzero(strain > 0.0)
        if not len(shears):
            return {}
        volumetric = np.where(strain > 0.0, np.log(fraction[shears[0]] / fraction), 0.0)
        axial, lateral = records["axial_stress [Pa]"], records["lateral_stress [Pa]"]

        def angle(rows: Ints) -> float:
            a, b = axial[rows].mean(), lateral[rows].mean()
            return degrees(asin((a - b) / (a + b)))

        count = max(int(strain[-1] / self.PEAK), 1)
        late = np.flatnonzero((strain > 2.0 / 3.0 * strain[-1]) & calm(records))
        out: dict[str, float | Floats] = {
            "volumetric_strain": volumetric,
            "peak_angle [degrees]": max(map(angle, np.array_split(shears, count))),
        }
        if len(late) > 10:
            parts = [angle(part) for part in np.array_split(late, 10)]
            out |= {
                "late_angle [degrees]": angle(late),
                "late_angle_error [degrees]": float(np.std(parts) / 3.0),
                "late_fraction": float(fraction[late].mean()),
                "late_coordination": float(records["coordination_number"][late].mean()),
                "late_dilation": float(np.polyfit(strain[late], volumetric[late], 1)[0]),
            }
        return out
