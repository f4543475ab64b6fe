"""Sources, where grains come into a scene; see docs/sources.md.

A grain of a source follows from its seed, its name and the number of the grain alone: random numbers are a hash of
these. So no generator has a state, and a run that goes on from a checkpoint has the same grains on any number of ranks.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

import numpy as np

from dem import checks, quaternion, shapes
from dem.arrays import Floats, Ints
from dem.bodies import SPHERE, Bodies, enclosing_radius
from dem.geometry.region import Block, Cylinder, refuse_region
from dem.motion import Timed
from dem.parts.named import Named
from dem.parts.sizes import Listed, Sizes, Uniform, sizes
from dem.shapes import Box, Capsule, Sphere
from dem.shapes.forms import Form
from dem.together import digest

TRIES = 64  #: places that are tried for a grain in a step


@dataclass(frozen=True)
class Source(Named, Timed):
    """Grains come in a region, at a mass rate or a number rate, where there is room for them.

    They are of one `shape`, whose lengths are times a size of each, and turned at random if it is no sphere.
    """

    region: Block | Cylinder  #: of the centres at birth
    radius: float | Sequence[float] | Sizes | None = None  #: sizes; of spheres the radius [m]; None: 1
    density: float = field(kw_only=True)  #: [kg/m^3]
    mass_rate: float | None = None  #: [kg/s]; either this
    number_rate: float | None = None  #: [1/s]; or this
    most: float = np.inf  #: grains in all
    material: int = 0
    velocity: Sequence[float] = (0.0, 0.0, 0.0)  #: at birth [m/s]
    shape: Sphere | Box | Capsule | Form | None = None  #: None: spheres of radius 1 m, times the sizes
    number: int = 0  #: of a form among those of the scene
    start: float = 0.0  #: [s]
    end: float = np.inf  #: [s]
    seed: int = 0
    before: float = 0.0  #: what was due before `start`, with other rates [kg] or grains
    CHANGED: ClassVar = ("mass_rate", "number_rate", "velocity")
    KEPT: ClassVar = (*CHANGED, "start", "before")

    def __post_init__(self) -> None:
        self._check_times()
        refuse_region("a source", self.region)
        if (self.mass_rate is None) == (self.number_rate is None):
            raise ValueError("a source has either a mass_rate [kg/s] or a number_rate [1/s]")
        given = [rate for rate in (self.mass_rate, self.number_rate) if rate is not None]
        checks.not_negative("rate of a source", given)
        checks.positive("density of a source", self.density)
        if self.radius is None and self.shape is None:
            raise ValueError("a source needs a shape, or the radius of its spheres [m]")
        object.__setattr__(self, "radius", sizes(1.0 if self.radius is None else self.radius))
        object.__setattr__(self, "shape", Sphere(1.0) if self.shape is None else self.shape)
        if isinstance(self.shape, Form) and not self.shape.SCALES and (ends := self.sizes.ends) != (1.0, 1.0):
            wrong = " to ".join(f"{size:g}" for size in dict.fromkeys(ends))
            raise ValueError(f"radius of a source: {wrong}; its shape has one size, so allowed is 1, or none")
        checks.between(1)("most grains of a source", self.most)
        checks.seed("seed of a source", self.seed)
        checks.check_fields(self, velocity=checks.vector)

    @property
    def sizes(self) -> Sizes:
        """The distribution of the sizes."""
        assert isinstance(self.radius, (Uniform, Listed))
        return self.radius

    def grains(self, name: str, serial: Ints) -> Bodies:
        """The grains (n,) of these numbers, at the origin, without ids."""
        random = numbers(name, self.seed, serial, range(4))
        return self.of_sizes(self.sizes.at(random[:, 0]), random[:, 1:])

    def of_sizes(self, size: Floats, random: Floats) -> Bodies:
        """Grains of sizes (n,), turned by three numbers each (n, 3) from 0 to 1 if they are no spheres."""
        count, density = len(size), np.full(len(size), float(self.density))
        if isinstance(self.shape, Form):
            kind, (lengths, mass, inertia) = self.shape.BASE + self.number, self.shape.grown(size, density)
        else:
            assert self.shape is not None
            kind, _, _, one = shapes.placed(self.shape)
            lengths = size[:, None] * one
            mass, inertia = shapes.solid(kind, lengths, density)
        return Bodies(
            id=np.zeros(count, np.int64),
            position=np.zeros((count, 3)),
            quaternion=np.tile([1.0, 0.0, 0.0, 0.0], (count, 1)) if kind == SPHERE else _turns(random),
            velocity=np.tile([*self.velocity, 0.0, 0.0, 0.0], (count, 1)),
            mass=mass,
            inertia=inertia,
            material=np.full(count, self.material),
            shape=np.full(count, kind),
            size=lengths,
            weight=np.zeros(count),
        )

    def extremes(self) -> Bodies:
        """The smallest and the largest grain, at the corners of the box about the region."""
        table = self.of_sizes(np.array(self.sizes.ends), np.zeros((2, 3)))
        table.position = bounds(self.region)
        return table

    def due(self, time: float, tally: Tally, mass: Floats) -> int:
        """How many of the next grains, of masses (n,), have come by the time [s], as rate times time says."""
        due, count = self.amount(time) * (1.0 + 1e-12), len(mass)
        if self.number_rate is not None:
            count = min(count, int(np.floor(due + 1e-9)) - tally.count)
        else:
            held = np.cumsum(np.concatenate([[tally.mass], mass]))[1:]  # one after another, in parts of any lengths
            count = int(np.searchsorted(held, due, side="right"))
        return max(int(min(count, self.most - tally.count)), 0)

    def amount(self, time: float) -> float:
        """What is due by the time [s]: mass [kg], or number of grains."""
        rate = self.number_rate if self.mass_rate is None else self.mass_rate
        assert rate is not None
        return self.before + rate * self.elapsed(time)

    def changed(self, time: float, tally: Tally, **values: Any) -> Source:
        """The same with another `mass_rate`, `number_rate` or `velocity` from the time [s] on. What was due before and
        found no place stays due, but where masses take the place of numbers or the other way round."""
        rates = {name: values[name] for name in ("mass_rate", "number_rate") if values.get(name) is not None}
        out: dict[str, Any] = {"velocity": values["velocity"]} if "velocity" in values else {}
        if rates:
            kind = next(iter(rates))
            same = getattr(self, kind) is not None
            came = tally.mass if kind == "mass_rate" else float(tally.count)
            out |= {"mass_rate": None, "number_rate": None, **rates}
            out |= {"before": self.amount(time) if same else came, "start": min(max(time, self.start), self.end)}
        return replace(self, **out)

    def places(self, name: str, serial: Ints) -> Floats:
        """Places (n, TRIES, 3) in the region where grains of these numbers may come, in the order of trying [m]."""
        random = numbers(name, self.seed, serial, range(4, 4 + 3 * TRIES)).reshape(-1, 3)
        return points(self.region, random).reshape(len(serial), TRIES, 3)


@dataclass
class Tally:
    """What has passed a source or an outlet up to now."""

    count: int = 0  #: grains
    mass: float = 0.0  #: [kg]
    energy: float = 0.0  #: kinetic and potential, of the last step alone [J]
    refused: int = 0  #: steps in which the next grain of a source was due, but found no place


def bounds(region: Block | Cylinder) -> Floats:
    """Return the lower and upper corner (2, 3) of the box about a region [m]."""
    if isinstance(region, Block):
        return np.array([region.low, region.high], float)
    ends = np.array([region.start, region.end], float)
    axis = (ends[1] - ends[0]) / region.length
    wide = region.radius * np.sqrt(np.maximum(1.0 - axis**2, 0.0))
    return np.array([ends.min(axis=0) - wide, ends.max(axis=0) + wide])


def points(region: Block | Cylinder, random: Floats) -> Floats:
    """Return points (n, 3) that are uniform in a region, from numbers (n, 3) from 0 to 1."""
    if isinstance(region, Block):
        low, high = bounds(region)
        return low + random * (high - low)
    start, end = np.array(region.start, float), np.array(region.end, float)
    x = quaternion.across((end - start)[None] / region.length)[0]
    y = np.cross((end - start) / region.length, x)
    angle, radius = 2.0 * np.pi * random[:, 1:2], region.radius * np.sqrt(random[:, :1])
    return start + random[:, 2:] * (end - start) + radius * (np.cos(angle) * x + np.sin(angle) * y)


def numbers(name: str, seed: int, serial: Ints, draws: range) -> Floats:
    """Return random numbers (n, draws) from 0 to 1 of the grains (n,) of a source, which depend on nothing else.

    A hash of the counters: the mixer of SplitMix64 (Steele, Lea, Flood, "Fast splittable pseudorandom number
    generators", OOPSLA 2014), once for the source, once for the grain and once for the draw."""
    key = _mixed(np.array([digest(name)], np.uint64) ^ _mixed(np.array([seed], np.int64).astype(np.uint64)))
    of_grain = _mixed(key + np.asarray(serial).astype(np.uint64) * np.uint64(0x9E3779B97F4A7C15))
    draw = np.arange(draws.start, draws.stop, dtype=np.uint64) + np.uint64(1)
    both = _mixed(of_grain[:, None] + draw * np.uint64(0xD1B54A32D192ED03))
    return (both >> np.uint64(11)).astype(float) / 2.0**53


def _mixed(x: Any) -> Any:
    x = (x ^ (x >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    x = (x ^ (x >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return x ^ (x >> np.uint64(31))


def _turns(random: Floats) -> Floats:
    """Uniform unit quaternions (n, 4) from numbers (n, 3) (Shoemake, Graphics Gems III, 1992)."""
    one, two = np.sqrt(1.0 - random[:, 0]), np.sqrt(random[:, 0])
    a, b = 2.0 * np.pi * random[:, 1], 2.0 * np.pi * random[:, 2]
    return np.stack([one * np.sin(a), one * np.cos(a), two * np.sin(b), two * np.cos(b)], axis=1)


def reach(table: Bodies) -> Floats:
    """Return radii (n,) of the spheres about grains [m]."""
    return enclosing_radius(table.shape, table.size)

