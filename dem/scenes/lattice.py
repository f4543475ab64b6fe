"""What the scenes share: options, the perturbed cubic lattice on which spheres start, lengths in scenes of small
spheres."""

from __future__ import annotations

from dataclasses import dataclass
from math import ceil, sqrt
from typing import Any, ClassVar

import numpy as np

from dem.arrays import Floats
from dem.checks import not_negative, positive
from dem.experiment import Experiment, option


@dataclass(frozen=True)
class Spheres(Experiment):
    """Options of all scenes: spheres that start on a perturbed lattice."""

    n: int = option(4, "", "size: there are (2n+1)^3 spheres")
    radius: float = option(0.1, "m", "radius of the spheres", positive)
    density: float = option(2500.0, "kg/m^3", "density of the spheres (glass)", positive)
    friction: float = option(0.25, "", "friction coefficient of all contacts", not_negative)
    perturbation: float = option(0.02, "m", "greatest displacement of a sphere from its lattice point, per axis")
    seed: int = option(1, "", "seed of the perturbation", not_negative)
    gravity: float = option(9.81, "m/s^2", "gravity, downwards", positive)

    least_n: ClassVar[int] = 1
    pitch: ClassVar[Any]  #: spacing of the lattice [m]

    def __post_init__(self) -> None:
        """ValueError unless the spheres cannot touch at the start, however they are moved."""
        super().__post_init__()
        if self.n < self.least_n:
            raise ValueError(f"n must be at least {self.least_n}, got {self.n}")
        not_negative("perturbation", self.perturbation)
        free = self.pitch / 2 - self.radius
        if self.perturbation >= free:
            raise ValueError(
                f"perturbation {self.perturbation:g} m must be less than pitch / 2 - radius = {free:g} m, "
                "half the free space between spheres of the lattice"
            )


@dataclass(frozen=True)
class LargeSpheres(Spheres):
    """A scene whose lattice has a spacing of its own."""

    pitch: float = option(0.25, "m", "spacing of the lattice on which the spheres start", positive)  # type: ignore[misc]


@dataclass(frozen=True)
class SmallSpheres(Spheres):
    """Lengths of scenes whose container is round, with a radius of n sphere diameters."""

    friction: float = option(0.5, "", "friction coefficient of all contacts", not_negative)
    radius: float = option(0.005, "m", "radius of the greatest spheres", positive)
    sides: int = option(32, "", "flat sides of the container")

    least_n: ClassVar[int] = 3

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.sides < 12:
            raise ValueError(f"sides must be at least 12, got {self.sides}")

    @property
    def delta(self) -> float:
        """Contact distance [m]."""
        return 0.2 * self.radius

    @property
    def settle_delta(self) -> float:
        """Contact distance while settling [m]."""
        return self.radius

    @property
    def container_radius(self) -> float:
        """Radius of the container, to the corners between its sides [m]."""
        return 2 * self.n * self.radius


def perturbed(x: Floats, y: Floats, z: Floats, perturbation: float, seed: int) -> Floats:
    """Points (nx ny nz, 3) of the lattice with these coordinates per axis, each moved by up to `perturbation` [m] per
    axis."""
    lattice = np.stack(np.meshgrid(x, y, z, indexing="ij"), axis=-1).reshape(-1, 3)
    return lattice + perturbation * np.random.default_rng(seed).uniform(-1.0, 1.0, lattice.shape)


def rest_after_fall(height: float, gravity: float) -> float:
    """Time [s] of a free fall from `height` [m], and two seconds in which the bed, compressed by the last arrivals,
    comes to rest; in whole tenths of a second, so that it is a whole number of the usual time steps."""
    return ceil(10 * (sqrt(2 * height / gravity) + 2.0)) / 10
