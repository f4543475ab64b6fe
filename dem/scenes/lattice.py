"""Parts that the scenes share: the perturbed cubic lattice on which spheres start, and the lengths in scenes of small
spheres."""

from __future__ import annotations

from math import ceil, sqrt

import numpy as np

from dem import checks
from dem.arrays import Floats
from dem.experiment import Experiment


class SmallSpheres(Experiment):
    """Lengths of scenes whose container is round, with a radius of n sphere diameters."""

    n: int
    sides: int  #: of the container
    radius: float  #: of the greatest spheres [m]

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.n < 3:
            raise ValueError(f"n must be at least 3, got {self.n}")
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


def check_room(radius: float, pitch: float, perturbation: float) -> None:
    """ValueError unless spheres of a lattice of this pitch cannot touch, however they are moved [m]."""
    checks.not_negative("perturbation", perturbation)
    free = pitch / 2 - radius
    if perturbation >= free:
        raise ValueError(
            f"perturbation {perturbation:g} m must be less than pitch / 2 - radius = {free:g} m, "
            "half the free space between spheres of the lattice"
        )


def rest_after_fall(height: float, gravity: float) -> float:
    """Time [s] of a free fall from `height` [m], and two seconds in which the bed, compressed by the last arrivals,
    comes to rest; in whole tenths of a second, so that it is a whole number of the usual time steps."""
    return ceil(10 * (sqrt(2 * height / gravity) + 2.0)) / 10
