"""Regions of space: boxes and cylinders."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Union, get_args

import numpy as np

from dem.arrays import Bools, Floats
from dem.checks import check_fields, positive, short, vector
from dem.compiled import loop


@dataclass(frozen=True)
class Block:
    """A box along the axes from the corner `low` to `high` (3,) [m]."""

    low: Sequence[float]
    high: Sequence[float]

    def __post_init__(self) -> None:
        check_fields(self, low=vector, high=vector)
        positive("size of a Block", np.subtract(self.high, self.low))

    @property
    def volume(self) -> float:
        """[m^3]"""
        return float(np.prod(np.subtract(self.high, self.low)))

    @property
    def bounds(self) -> tuple[Floats, Floats]:
        """The corners (3,) of the least box along the axes around it [m]."""
        return np.array(self.low, float), np.array(self.high, float)

    def contains(self, point: Floats) -> Bools:
        """Mask of points (n, 3) [m]."""
        inside: Bools = ((point >= self.low) & (point < self.high)).all(axis=1)
        return inside

    def part(self, start: Floats, end: Floats) -> Floats:
        """Which part (n,) of the lines from `start` to `end` (n, 3) is inside; exact."""
        return _part_of_block(*self.bounds, start, end)


@loop
def _part_of_block(low: Floats, high: Floats, start: Floats, end: Floats) -> Floats:
    """`Block.part`: a line that does not change a coordinate is beyond both faces, or between them, or on one."""
    out = np.empty(len(start))
    for n in range(len(start)):
        first, last = 0.0, 1.0
        for k in range(3):
            way = end[n, k] - start[n, k]
            one, two = (low[k] - start[n, k]) / way, (high[k] - start[n, k]) / way
            if not (np.isnan(one) or np.isnan(two)):
                first, last = max(first, min(one, two)), min(last, max(one, two))
        out[n] = max(last - first, 0.0)
    return out


@dataclass(frozen=True)
class Cylinder:
    """A cylinder about the line from `start` to `end` (3,) with this radius [m]."""

    start: Sequence[float]
    end: Sequence[float]
    radius: float

    def __post_init__(self) -> None:
        check_fields(self, start=vector, end=vector, radius=positive)
        positive("length of a Cylinder", self.length)

    @property
    def length(self) -> float:
        """[m]"""
        return float(np.linalg.norm(np.subtract(self.end, self.start)))

    @property
    def volume(self) -> float:
        """[m^3]"""
        return float(np.pi * self.radius**2 * self.length)

    @property
    def bounds(self) -> tuple[Floats, Floats]:
        """The corners (3,) of the least box along the axes around it [m]."""
        ends = np.array([self.start, self.end], float)
        across = 1.0 - ((ends[1] - ends[0]) / self.length) ** 2
        reach = self.radius * np.sqrt(np.maximum(across, 0.0))
        return ends.min(axis=0) - reach, ends.max(axis=0) + reach

    def _split(self, vector: Floats) -> tuple[Floats, Floats]:
        """The parts of vectors (n, 3) along (n,) and across (n, 3) the axis."""
        axis = np.subtract(self.end, self.start) / self.length
        along = vector @ axis
        return along, vector - along[:, None] * axis

    def contains(self, point: Floats) -> Bools:
        """Mask of points (n, 3) [m]."""
        along, across = self._split(point - np.asarray(self.start))
        inside: Bools = (along >= 0.0) & (along < self.length) & ((across**2).sum(axis=1) < self.radius**2)
        return inside

    def part(self, start: Floats, end: Floats) -> Floats:
        """Which part (n,) of the lines from `start` to `end` (n, 3) is inside; exact."""
        height, offset = self._split(start - np.asarray(self.start))
        rise, radial = self._split(end - start)
        a, b = (radial**2).sum(axis=1), (radial * offset).sum(axis=1)
        c = (offset**2).sum(axis=1) - self.radius**2
        with np.errstate(divide="ignore", invalid="ignore"):
            cuts = (np.array([0.0, self.length]) - height[:, None]) / rise[:, None]
            first, last = np.fmax(0.0, cuts.min(axis=1)), np.fmin(1.0, cuts.max(axis=1))
            root = np.sqrt(np.maximum(b * b - a * c, 0.0))
            first, last = np.fmax(first, (-b - root) / a), np.fmin(last, (-b + root) / a)
        outside = ((a == 0.0) & (c > 0.0)) | (b * b < a * c)
        return np.where(outside, 0.0, np.maximum(last - first, 0.0))


Region = Union[Block, Cylinder]


def refuse_region(what: str, region: Any, *allowed: type) -> None:
    """Raise ValueError for what is no region, or none of those that are `allowed`."""
    kinds = allowed or get_args(Region)
    if not isinstance(region, kinds):
        names = " or a ".join(kind.__name__ for kind in kinds)
        raise ValueError(f"region of {what}: allowed is a {names} of pctt.measures, got {short(region)}")
