"""Plane shear: spheres in a cell that is sheared at a constant rate under a constant pressure along the gradient."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from math import pi, sqrt
from typing import ClassVar

import numpy as np

from dem.arrays import Floats
from dem.checks import between, not_negative, positive
from dem.experiment import Experiment, option
from dem.packing import perturbed, random_packing
from dem.parts.cell import PASSING, SHEARED
from dem.parts.sizes import Uniform
from dem.record import cell
from dem.record.analysis import calm
from dem.scene import Scene
from dem.step import Step


@dataclass(frozen=True)
class PlaneShear(Experiment):
    """Spheres in a cell with three periods: flow along x, gradient and pressure along z. There are no walls, and no
    gravity, so the flow is the same everywhere, and friction and solid fraction depend on the inertial number alone:
    GDR MiDi, Eur. Phys. J. E 14 (2004) 341; da Cruz et al., Physical Review E 72 (2005) 021309.

    A `layer` is the plane flow of disks of da Cruz et al.: one layer of spheres across y, in a cell that is LAYERS
    diameters thick, so that no images touch across it. With P the force on a length over the mean diameter, the
    inertial number is that of disks, rate times sqrt(m / (P d)) with the mass m of the mean sphere.
    """

    n: int = option(
        8,
        "width of the cell in diameters along x, y and, at the start, z; spheres of a layer along x",
        check=between(6)
    )  # fmt: skip
    layer: bool = option(False, "one layer of spheres, which move in the plane of flow and gradient")
    inertial: float = option(0.1, "inertial number: rate times d sqrt(rho / P)", check=positive)
    pressure: float = option(
        1000.0, "normal stress along the gradient; of a layer the force on a length over d", unit="Pa", check=positive
    )
    radius: float = option(0.005, "mean radius of the spheres", unit="m", check=positive)
    spread: float = option(0.2, "radii are uniform within this part of the mean", check=between(0.0, 0.5))
    density: float = option(2500.0, "density of the spheres (glass)", unit="kg/m^3", check=positive)
    friction: float = option(0.5, "friction coefficient of all contacts", check=not_negative)
    fraction: float = option(0.55, "solid fraction at the start; a layer starts as a lattice", check=between(0.1, 0.58))
    seed: int = option(1, "seed of the places and radii", check=not_negative)

    LAYERS: ClassVar[float] = 6.0  #: thickness of the cell of a layer, in diameters

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.layer:
            self.refuse_idle("a layer, which starts as a lattice; allowed without the option layer", "fraction")

    @property
    def time(self) -> float:
        """d sqrt(rho / P), of a layer sqrt(m / (P d)) [s]."""
        shape = pi / 6.0 if self.layer else 1.0
        return 2.0 * self.radius * sqrt(shape * self.density / self.pressure)

    @property
    def rate(self) -> float:
        """The shear rate [1/s]."""
        return self.inertial / self.time

    @property
    def dt(self) -> float:  # type: ignore[override]
        """Recommended time step [s]."""
        return float(f"{min(SHEARED / self.rate, PASSING * self.time):.2g}")

    def build(self) -> Scene:
        """The scene, with the velocities of the shear."""
        lengths, place, radius = self._lattice() if self.layer else self._packing()
        scene = Scene(
            self.friction, (0.0, 0.0, 0.0), period=lengths, shear_rate=self.rate, shear_gradient="z",
            stress=(None, None, self._asked),
        )  # fmt: skip
        scene.add_spheres(place, radius, self.density, velocity=place[:, [2, 2, 2]] * [self.rate, 0.0, 0.0])
        return scene

    def _packing(self) -> tuple[tuple[float, float, float], Floats, Floats]:
        """Periods, places and radii of a random packing in a cube."""
        side, r = 2.0 * self.n * self.radius, self.radius
        sizes = Uniform(r * (1.0 - self.spread), r * (1.0 + self.spread)) if self.spread else r
        place, radius = random_packing((side,) * 3, sizes, self.fraction, periodic=(True,) * 3, seed=self.seed)
        return (side,) * 3, place, radius

    def _lattice(self) -> tuple[tuple[float, float, float], Floats, Floats]:
        """Periods, places and radii of a layer: a square lattice with room for all sizes, higher than wide, as it
        closes."""
        high, pitch = round(1.6 * self.n), 2.02 * (1.0 + self.spread) * self.radius
        x, z = (pitch * (np.arange(count) + 0.5) for count in (self.n, high))
        thick = 2.0 * self.LAYERS * self.radius
        place = perturbed(x, np.array([0.5 * thick]), z, 0.009 * pitch, self.seed)[:]
        place[:, 1] = 0.5 * thick
        share = np.random.default_rng(self.seed).uniform(-1.0, 1.0, len(place))
        return (self.n * pitch, thick, high * pitch), place, self.radius * (1.0 + self.spread * share)

    def record(self, step: Step) -> dict[str, float]:
        """Shear strain, friction coefficient of the flow, inertial number by the stress that there is, and solid
        fraction, of a layer the part of the area."""
        of_cell, rate = cell(step), step.world.cell.shear_rate
        pressure, radius = max(of_cell["stress_zz [Pa]"], 1e-300), step.world.grains.size[:, 0]
        room, filled = of_cell["period_x [m]"] * of_cell["period_z [m]"], pi * radius**2
        if not self.layer:
            room, filled = room * of_cell["period_y [m]"], 4.0 / 3.0 * pi * radius**3
        return {
            "strain": rate * step.world.time,
            "mu": -of_cell["stress_xz [Pa]"] / pressure,
            "inertial_number": rate * self.time * sqrt(self._asked / pressure),
            "solid_fraction": step.total(filled) / room,
        }

    @property
    def _asked(self) -> float:
        """The stress of the cell along z [Pa]."""
        return self.pressure / (self.LAYERS if self.layer else 1.0)

    def analyse(self, records: Mapping[str, Floats]) -> dict[str, float | Floats]:
        """Over the last half of the strain: the friction coefficient and inertial number of the mean stresses, the
        solid fraction, the pressure over that asked and its deviation over its mean, and the standard error of mu from
        ten parts of that half."""
        strain = records["strain"]
        late = (strain >= 0.5 * strain[-1]) & calm(records)
        if not late.any():
            return {}
        shear, pressure = -records["stress_xz [Pa]"][late], records["stress_zz [Pa]"][late]
        mean = float(pressure.mean())
        parts = min(10, len(pressure))
        found = [a.mean() / b.mean() for a, b in zip(np.array_split(shear, parts), np.array_split(pressure, parts))]
        return {
            "mu": float(shear.mean()) / mean,
            "mu_error": float(np.std(found) / sqrt(max(parts - 1, 1))),
            "inertial_number": self.inertial * sqrt(self._asked / mean),
            "solid_fraction": float(records["solid_fraction"][late].mean()),
            "pressure_ratio": mean / self._asked,
            "pressure_swing": float(pressure.std()) / mean,
        }
