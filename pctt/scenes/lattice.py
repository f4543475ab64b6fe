"""What the scenes share: options, the perturbed cubic lattice on which spheres start, walls, a body that goes to and
fro, and lengths in scenes of small spheres."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from math import ceil, cos, pi, sqrt
from typing import Any, ClassVar

import numpy as np

from dem.arrays import Bools, Floats, Ints, Rule
from dem.checks import between, not_negative, positive
from dem.experiment import Experiment, option
from dem.motion import Oscillation
from dem.packing import perturbed
from dem.quaternion import length
from dem.record.analysis import calm
from dem.scene import Scene
from dem.shapes import Plane, Shape

LONGEST = 2**28  #: places of a lattice that one rank makes one after another, five million in a second


@dataclass(frozen=True)
class Spheres(Experiment):
    """Options of all scenes: spheres that start on a perturbed lattice. A scene has the method `positions`."""

    n: int = option(4, "size: there are (2n+1)^3 spheres", check=between(1))
    radius: float = option(0.1, "radius of the spheres", unit="m", check=positive)
    density: float = option(2500.0, "density of the spheres (glass)", unit="kg/m^3", check=positive)
    friction: float = option(0.25, "friction coefficient of all contacts", check=not_negative)
    perturbation: float = option(
        0.02, "greatest displacement of a sphere from its lattice point, per axis", unit="m", check=not_negative
    )
    seed: int = option(1, "seed of the perturbation", check=not_negative)
    gravity: float = option(9.81, "gravity, downwards", unit="m/s^2", check=positive)

    pitch: ClassVar[Any]  #: spacing of the lattice [m]

    def __post_init__(self) -> None:
        """ValueError unless the spheres cannot touch at the start, however they are moved."""
        super().__post_init__()
        free = self.pitch / 2 - self.radius
        if self.perturbation >= free:
            way = "half the free space between spheres of the lattice"
            self.refuse("perturbation", f"must be less than pitch / 2 - radius = {free:g} m, {way}")

    def positions(self) -> Rule:
        """Centres (spheres, 3) of the spheres at the start [m]."""
        raise NotImplementedError

    def highest(self) -> float:
        """Height of the highest centre at the start [m]."""
        return max(float(part[:, 2].max()) for _, part in self.walk(self.positions()))

    def walk(self, places: Rule) -> Iterator[tuple[int, Floats]]:
        """The chunks of all places, of which one rank alone makes one after another. ValueError if that takes more than
        a minute."""
        if len(places) > LONGEST:
            self.refuse("n", f"asks for {len(places):.2g} places of spheres; allowed are {LONGEST:.2g} in this scene")
        return places.chunks()

    def spheres_alone(self, radius: float | Rule, material: str = "default") -> Scene:
        """A scene with the spheres, of one radius or of radii (spheres,) [m]."""
        scene = Scene(self.friction, gravity=(0.0, 0.0, -self.gravity))
        scene.add_spheres(self.positions(), radius, self.density, material=material)
        return scene

    def walls(self) -> list[Shape]:
        """The floor, the walls and, if it is not open at the top, the lid of the domain."""
        (low, high), (x, y, z) = np.array(self.domain), np.eye(3)
        sides = [(z, low), (-x, high), (x, low), (-y, high), (y, low), (-z, high)]
        places = [(normal, tuple(np.where(normal, corner, 0.0))) for normal, corner in sides]
        return [Plane(normal, place) for normal, place in places if np.isfinite(place).all()]


@dataclass(frozen=True)
class LargeSpheres(Spheres):
    """A scene whose lattice has a spacing of its own."""

    pitch: float = option(0.25, "spacing of the lattice on which the spheres start", unit="m", check=positive)  # type: ignore[misc]


@dataclass(frozen=True)
class ToAndFro(LargeSpheres):
    """A scene in which a body goes along x and back, from rest, when the spheres have settled.

    Its velocity is v = pi travel / period * sin(2 pi t / period), with t since the end of settling.
    """

    period: float = option(
        4.0, "period of the velocity of the body that moves: half of it is one way", unit="s", check=positive
    )
    cutoff: float = option(2.0, "cutoff frequency of the low-pass filter of the forces", unit="Hz", check=positive)

    travel: ClassVar[Any]  #: way of the body from one end to the other [m]

    @property
    def settling_time(self) -> float:
        """Time [s] after which the body starts: spheres fall from the top of the domain at most."""
        return rest_after_fall(self.domain[1][2], self.gravity)

    def to_and_fro(self) -> Oscillation:
        """The motion: displacement travel / 2 (1 - cos(2 pi t / period))."""
        return Oscillation((1, 0, 0), self.travel / 2, self.period, phase=-pi / 2, start=self.settling_time)

    def steady(self, records: Mapping[str, Floats]) -> Bools:
        """Mask (n,) of the steps of the first way in which the speed is above 1/sqrt(2) of the greatest, without those
        that have a jump of energy."""
        phase = (records["time [s]"] - self.settling_time) / self.period
        return (phase >= 1 / 8) & (phase <= 3 / 8) & calm(records)


@dataclass(frozen=True)
class SmallSpheres(Spheres):
    """Lengths of scenes whose container is round, with a radius of n sphere diameters."""

    n: int = option(6, "size: radius of the container in diameters of a sphere", check=between(3))
    friction: float = option(0.5, "friction coefficient of all contacts", check=not_negative)
    radius: float = option(0.005, "radius of the greatest spheres", unit="m", check=positive)
    perturbation: float = option(
        0.0004, "greatest displacement of a sphere from its lattice point, per axis", unit="m", check=not_negative
    )
    sides: int = option(32, "flat sides of the container", check=between(12))

    packing: ClassVar[float] = 0.58  #: share of the volume that settled spheres take

    @property
    def pitch(self) -> float:
        """Spacing of the lattice on which the spheres start [m]."""
        return 2.2 * self.radius

    @property
    def container_radius(self) -> float:
        """Radius of the container, to the corners between its sides [m]."""
        return 2 * self.n * self.radius

    @property
    def room(self) -> float:
        """Greatest distance of a lattice point from the axis of the container [m]."""
        return self.container_radius * cos(pi / self.sides) - self.radius - 2 * self.perturbation

    def in_container(self, along: Floats, axis: int, most: int | None = None) -> Rule:
        """The places of the perturbed lattice in the container, at the coordinates `along` its axis (of this number),
        the lowest first; the first `most` of them."""
        count = int(self.room / self.pitch)
        grid = [np.arange(-count, count + 1) * self.pitch] * 3
        grid[axis] = along
        x, y, z = grid
        places, layers = perturbed(x, y, z, self.perturbation, self.seed), len(z)

        def inside() -> Iterator[tuple[Ints, Floats]]:
            """The layers (n,) of places (n, 3) in the container, which do not overlap in height."""
            for first, part in self.walk(places):
                row = np.flatnonzero(length(np.delete(part, axis, axis=1)) <= self.room)
                yield (first + row) % layers, part[row]

        ends = np.cumsum(sum(np.bincount(layer, minlength=layers) for layer, _ in inside()))

        def make(first: int, end: int) -> Floats:
            low, high = np.searchsorted(ends, (first, end - 1), side="right")
            found = np.concatenate([part[(low <= layer) & (layer <= high)] for layer, part in inside()])
            before = ends[low - 1] if low else 0
            return found[np.argsort(found[:, 2], kind="stable")][first - before : end - before]

        return Rule(int(ends[-1] if most is None else min(most, ends[-1])), make)


def rest_after_fall(height: float, gravity: float) -> float:
    """Time [s] of a free fall from `height` [m], and two seconds in which the bed, compressed by the last arrivals,
    comes to rest; in whole tenths of a second, so that it is a whole number of the usual time steps."""
    return ceil(10 * (sqrt(2 * height / gravity) + 2.0)) / 10
