"""Superellipsoids: ellipsoids whose sides may be flatter, up to rounded boxes and cylinders.

Their support function is a norm of the same kind, of the exponents n / (n - 1). Volume and moments are those of
Jaklic, Leonardis, Solina, "Segmentation and Recovery of Superquadrics" (2000), chapter 2, by beta functions.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.special import beta

from dem.arrays import Floats, Ints
from dem.checks import between, check_fields, positive, rows, vector
from dem.compiled import inlined, loop
from dem.shapes.convex import Convex, revolved

#: Exponents that are allowed: convex, with the ball of the shortest axis in it, and edges that a search can follow.
EXPONENTS = between(2.0, 20.0)

#: Cosine of the angle to an axis within which a flat side faces a direction; tangents of those of the normals, along
#: flat sections, at the points of it that bear beside the closest one: a body on a flat side would rock on one alone.
#: Where exponents are above FLAT no step follows how that goes to and fro: with the first tangent bodies gain up to ten
#: times their energy, and never rest. With the second one lesser exponents take the energy of bodies that rock.
FACING, FLAT = 0.9, 4.0
TILT, LESS = 0.1, 1e-4

GRID = 24  #: intervals of a quarter of the directions in which the curvature is looked up
SAFE = 0.9  #: what counts of the least radius found, as there may be lesser ones between


@inlined
def _normed(u, v, exponent):
    """(u^p + v^p)^(1/p) of two numbers that are not negative, and its derivatives, for the dual p of an exponent."""
    most = max(u, v)
    if most == 0.0:
        return 0.0, 0.0, 0.0
    p = exponent / (exponent - 1.0)
    a, b = u / most, v / most
    norm = (a**p + b**p) ** (1.0 / p)
    return most * norm, (a / norm) ** (p - 1.0), (b / norm) ** (p - 1.0)


@inlined
def _support(numbers, skin, x, y, z):
    a, b, c = numbers[0], numbers[1], numbers[2]
    flat, by_x, by_y = _normed(abs(a * x), abs(b * y), numbers[4])
    _, by_flat, by_z = _normed(flat, abs(c * z), numbers[3])
    per = skin / np.sqrt(x * x + y * y + z * z)
    return (
        np.copysign(a * by_flat * by_x, x) - per * x, np.copysign(b * by_flat * by_y, y) - per * y,
        np.copysign(c * by_z, z) - per * z,
    )  # fmt: skip


@loop
def _face(numbers, x, y, z, point, name):
    """Four points of a side that is flat both ways, two of one that is flat one way."""
    direction, axis = (x, y, z), 0
    for k in range(3):
        axis = k if abs(direction[k]) > abs(direction[axis]) else axis
    one, two = (axis + 1) % 3, (axis + 2) % 3
    n_one, n_two = numbers[3 if axis == 2 or one == 2 else 4], numbers[3 if axis == 2 or two == 2 else 4]
    flat_one, flat_two = n_one > 2.0, n_two > 2.0
    tilt_one, tilt_two = (TILT if n_one <= FLAT else LESS) * flat_one, (TILT if n_two <= FLAT else LESS) * flat_two
    if abs(direction[axis]) < FACING * np.sqrt(x * x + y * y + z * z) or not (flat_one or flat_two):
        return 1, 0.0
    count = 4 if flat_one and flat_two else 2
    for k in range(count):
        ahead, beside = 2 * (k in (1, 2)) - 1, 2 * (k > 1) - 1
        for n in range(3):
            name[k], point[k, n] = k, 0.0
        point[k, axis] = np.copysign(1.0, direction[axis])
        point[k, one], point[k, two] = tilt_one * ahead, tilt_two * (beside if flat_one else ahead)
        point[k, 0], point[k, 1], point[k, 2] = _support(numbers, 0.0, point[k, 0], point[k, 1], point[k, 2])
    return count, numbers[two if flat_one else one] ** 2 / numbers[axis] if count == 2 else 0.0


@inlined
def _rolls(numbers, x, y, z, u, v, w):
    """On the closest point."""
    p, q, r = _support(numbers, 0.0, x, y, z)
    return u * x + v * y + w * z > (1.0 - 1e-6) * (p * x + q * y + r * z)


@inlined
def _arc(numbers, x, y, z):
    return _support(numbers, 0.0, x, y, z)


@loop
def supports(numbers: Floats, direction: Floats) -> Floats:
    """The points (n, 3) that are furthest along vectors (n, 3)."""
    out = np.empty_like(direction)
    for k in range(len(direction)):
        out[k, 0], out[k, 1], out[k, 2] = _support(numbers, 0.0, direction[k, 0], direction[k, 1], direction[k, 2])
    return out


@dataclass(frozen=True)
class Superellipsoid(Convex):
    """All points with ((|x/a|^m + |y/b|^m)^(n/m) + |z/c|^n <= 1 for the `axes` a, b, c and the `exponents` n, m; 2 and
    2 are those of an ellipsoid."""

    axes: Sequence[float]  #: (3,) half lengths [m]
    exponents: Sequence[float] = (2.0, 2.0)  #: (2,) n of sections along z, m of those across; from 2 to 20
    support, face = staticmethod(_support), staticmethod(_face)
    rolls, arc = staticmethod(_rolls), staticmethod(_arc)

    def __post_init__(self) -> None:
        check_fields(self, axes=positive)
        check_fields(self, axes=vector, exponents=lambda name, value: rows(name, value, 1, 2)[0])
        for value in self.exponents:
            EXPONENTS("Superellipsoid.exponents", value)
        super().__post_init__()

    @property
    def numbers(self) -> Sequence[float]:
        """Axes [m] and exponents."""
        return *self.axes, *self.exponents

    @property
    def solid(self) -> tuple[float, Sequence[float]]:
        """As of `Convex`."""
        (a, b, c), (e, f) = self.axes, (2.0 / n for n in self.exponents)
        volume = 2.0 * a * b * c * e * f * beta(0.5 * e + 1.0, e) * beta(0.5 * f, 0.5 * f)
        across = 0.5 * a * b * c * e * f * beta(1.5 * f, 0.5 * f) * beta(0.5 * e, 2.0 * e + 1.0)
        along = 2.0 * a * b * c * e * f * beta(0.5 * f, 0.5 * f + 1.0) * beta(1.5 * e, e + 1.0) * c**2
        return volume, (across * b**2 + along, across * a**2 + along, across * (a**2 + b**2))

    @property
    def radii(self) -> tuple[float, float]:
        """As of `Convex`: the furthest point by Hoelder's inequality, across and then along."""

        def furthest(one: float, other: float, n: float) -> float:
            both = np.array([one, other])
            most = both.max()
            return float(most * np.linalg.norm(both / most, 2.0 * n / (n - 2.0)) if n > 2.0 else most)

        (a, b, c), (n, m) = self.axes, self.exponents
        return furthest(furthest(a, b, m), c, n), min(self.axes)

    @cached_property
    def rounding(self) -> float:  # type: ignore[override]
        """As of `Convex`: by differences of supports in directions of an octant; the others are alike."""
        angle = np.linspace(0.0, 0.5 * np.pi, GRID + 1)
        up, round_z = (grid.ravel() for grid in np.meshgrid(angle, angle))
        direction = np.stack([np.cos(up) * np.cos(round_z), np.cos(up) * np.sin(round_z), np.sin(up)], axis=1)
        one = np.stack([-np.sin(round_z), np.cos(round_z), np.zeros(len(up))], axis=1)
        two = np.cross(direction, one)
        numbers, small = np.array([*self.numbers, 0.0]), 1e-4
        change = [(supports(numbers, direction + small * t) - supports(numbers, direction - small * t)) / (2.0 * small)
                  for t in (one, two)]  # fmt: skip
        aa, ab, bb = (np.einsum("ni,ni->n", s, t) for s, t in ((change[0], one), (change[0], two), (change[1], two)))
        least = 0.5 * (aa + bb) - np.hypot(0.5 * (aa - bb), ab)
        return SAFE * float(least.min())

    def surface(self) -> tuple[Floats, Ints]:
        """As of `Convex`."""
        (a, b, c), (n, m) = self.axes, self.exponents
        up, turn = (np.arange(1, 16) / 16.0 - 0.5) * np.pi, np.arange(32) * np.pi / 16.0
        low, circle = np.cos(up), np.stack([np.cos(turn), np.sin(turn)], axis=1)

        def power(values: Floats, exponent: float) -> Floats:
            return np.sign(values) * np.abs(np.where(np.abs(values) < 1e-12, 0.0, values)) ** (2.0 / exponent)

        flat = np.stack([a * power(circle[:, 0], m), b * power(circle[:, 1], m), np.zeros(32)], axis=1)
        height = c * power(np.sin(up), n)
        rings = [s * flat + [0.0, 0.0, z] for s, z in zip(power(low, n), height)]
        vertex, triangle = revolved([0.0 * flat - [0.0, 0.0, c], *rings, 0.0 * flat + [0.0, 0.0, c]])
        return vertex * (self.radii[0] / np.linalg.norm(vertex, axis=1).max()), triangle
