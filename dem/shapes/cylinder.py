"""Cylinders with flat ends, along the z axis."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from dem.arrays import Floats, Ints
from dem.checks import check_fields, positive
from dem.compiled import inlined, loop
from dem.shapes.convex import Convex, revolved

#: Points of a rim that may be contacts. Evenly spread ones bear tilts in all directions alike.
RIM = 6

#: Sine of a tilt below which these stay with the body; above, one of them is the lowest point of the rim.
EVEN = 1e-6

#: Sine of a tilt below which the lowest point does not roll: its direction may be another one a step later.
LEVEL = 0.01


@inlined
def _support(numbers, skin, x, y, z):
    across = np.sqrt(x * x + y * y)
    per = (numbers[0] - skin) / across if across > 0.0 else 0.0
    return per * x, per * y, np.copysign(numbers[1] - skin, z)


@loop
def _face(numbers, x, y, z, point, name):
    radius, half, across = numbers[0], numbers[1], np.sqrt(x * x + y * y)
    if across >= abs(z):
        for k in range(2):
            point[k, 0], point[k, 1], point[k, 2] = radius * x / across, radius * y / across, half * (2 * k - 1)
            name[k] = RIM + k
        return 2, radius
    per = 2.0 * np.pi / RIM
    lowest = np.arctan2(y, x) / per if across > EVEN * abs(z) else 0.0
    for k in range(RIM):
        angle = (k + lowest - np.round(lowest)) * per
        point[k, 0], point[k, 1], name[k] = radius * np.cos(angle), radius * np.sin(angle), k
        point[k, 2] = np.copysign(half, z)
    return RIM, 0.0


@inlined
def _rolls(numbers, x, y, z, u, v, w):
    """On its side, and on the lowest point of a rim."""
    across = np.sqrt(x * x + y * y)
    return u * x + v * y > (1.0 - 1e-6) * across * numbers[0]


@inlined
def _arc(numbers, x, y, z):
    across = np.sqrt(x * x + y * y)
    per = numbers[0] / across if across > LEVEL * np.sqrt(x * x + y * y + z * z) else 0.0
    return per * x, per * y, 0.0


@dataclass(frozen=True)
class Cylinder(Convex):
    """Cylinder with flat ends along the z axis of its frame."""

    radius: float  #: [m]
    length: float  #: from end to end [m]
    support, face = staticmethod(_support), staticmethod(_face)
    rolls, arc = staticmethod(_rolls), staticmethod(_arc)

    def __post_init__(self) -> None:
        check_fields(self, radius=positive, length=positive)
        super().__post_init__()

    @property
    def numbers(self) -> Sequence[float]:
        """Radius and half length [m]."""
        return self.radius, 0.5 * self.length

    @property
    def solid(self) -> tuple[float, Sequence[float]]:
        """As of `Convex`."""
        volume, square = np.pi * self.radius**2 * self.length, self.radius**2
        lateral = volume * (square / 4.0 + self.length**2 / 12.0)
        return volume, (lateral, lateral, 0.5 * volume * square)

    @property
    def radii(self) -> tuple[float, float]:
        """As of `Convex`."""
        return float(np.hypot(self.radius, 0.5 * self.length)), min(self.radius, 0.5 * self.length)

    def surface(self) -> tuple[Floats, Ints]:
        """As of `Convex`."""
        angle = np.arange(32) * np.pi / 16.0
        circle = self.radius * np.stack([np.cos(angle), np.sin(angle), np.zeros(32)], axis=1)
        return revolved([circle - [0.0, 0.0, 0.5 * self.length], circle + [0.0, 0.0, 0.5 * self.length]])
