"""Convex shapes that contacts know by their support functions: what they have in common.

Such a shape is one class in one file, and a row of `dem.shapes.CONVEX_SHAPES`. Its compiled functions take its numbers
and vectors (x, y, z) in its frame, of which none need be of length one:

- `support(numbers, skin, x, y, z)`: the point (3) that is furthest along a vector, of the shape without a skin of that
  depth. It is called with the depth `rounding` or, where that is zero, with small depths: there the shape without its
  skin has sharp edges too.
- `face(numbers, x, y, z, point, name)`: what of the shape lies flush along a vector. Fills in points (k, 3), in order
  around it, and their names (k,), distinct whole numbers below 16; returns k, 1 without filling in where it is the
  support alone, and the radius of curvature across it where k = 2.
- `rolls(numbers, x, y, z, u, v, w)`: whether the contact in the point u, v, w, with that outward normal, goes along the
  surface when the shape turns; else it stays with the body.
- `arc(numbers, x, y, z)`: from what stays with the body to the point that a normal touches; zeros where it has none.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from typing import Any, ClassVar

import numpy as np

from dem.arrays import Floats, Ints
from dem.bodies import CONVEX
from dem.checks import check_fields, unit_quaternion, vector
from dem.shapes.forms import Form

ORIGIN, UPRIGHT = (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Convex:
    """A convex shape with its centre of mass at the origin of its frame, along the principal axes."""

    center: Sequence[float] = field(default=ORIGIN, kw_only=True)  #: (3,) [m]
    quaternion: Sequence[float] = field(default=UPRIGHT, kw_only=True)  #: (4,)
    support: ClassVar[Callable[..., Any]]
    face: ClassVar[Callable[..., Any]]
    rolls: ClassVar[Callable[..., Any]]
    arc: ClassVar[Callable[..., Any]]

    def __post_init__(self) -> None:
        check_fields(self, center=vector, quaternion=unit_quaternion)

    @property
    def numbers(self) -> Sequence[float]:
        """What its compiled functions take, at most six."""
        raise NotImplementedError

    @property
    def solid(self) -> tuple[float, Sequence[float]]:
        """Volume [m^3], and principal moments (3,) over the density [m^5]."""
        raise NotImplementedError

    @property
    def radii(self) -> tuple[float, float]:
        """Of the sphere that encloses it, and of the largest in it, both about the origin [m]."""
        raise NotImplementedError

    @property
    def rounding(self) -> float:
        """The least radius of curvature of its surface; 0 if it has edges [m]."""
        return 0.0

    def surface(self) -> tuple[Floats, Ints]:
        """Vertices (v, 3) [m], and triangles (t, 3) of these, for pictures; one vertex is on the sphere about it."""
        raise NotImplementedError


@dataclass(frozen=True, eq=False, repr=False)
class ConvexForm(Form):
    """The form of a convex shape."""

    shape: Convex
    BASE: ClassVar[int] = CONVEX
    SCALES: ClassVar[bool] = True

    @property
    def size(self) -> Floats:
        """As of `Form`."""
        around, within = self.shape.radii
        return np.array([around, np.cbrt(0.75 * self.volume / np.pi), within])

    def described(self) -> dict[str, Any]:
        """As of `Form`: triangles."""
        vertex, triangle = self.shape.surface()
        return {"vertices": vertex.tolist(), "triangles": triangle.tolist()}


def form(shape: Convex) -> ConvexForm:
    """The form of a shape of grains; the same object for equal ones. ValueError for what is none."""
    if not isinstance(shape, Convex):
        raise ValueError(f"shape of grains: allowed are convex shapes such as a pctt.Cylinder, got {shape!r}")
    if tuple(shape.center) != ORIGIN or tuple(shape.quaternion) != UPRIGHT:
        raise ValueError("shape of grains: its center and quaternion must be those of its frame; give positions")
    return centred(shape)


def centred(shape: Convex) -> ConvexForm:
    """The form of a shape that is anywhere in the frame of its body."""
    return _form(replace(shape, center=ORIGIN, quaternion=UPRIGHT))


@cache
def _form(shape: Convex) -> ConvexForm:
    volume, moments = shape.solid
    return ConvexForm(volume, np.array(moments), np.array(ORIGIN), np.array(UPRIGHT), shape)


def revolved(rings: Sequence[Floats]) -> tuple[Floats, Ints]:
    """Vertices (v, 3) and triangles (t, 3) of a surface of rings (k, 3) of as many points each, from the lowest to the
    highest; the first and the last are closed."""
    many = len(rings[0])
    vertex = np.concatenate([*rings, [rings[0].mean(axis=0)], [rings[-1].mean(axis=0)]])
    k = np.arange(many)
    following, last = (k + 1) % many, many * (len(rings) - 1)
    parts = [np.stack([np.full(many, len(vertex) - 2), following, k], axis=1)]
    for low in range(0, last, many):
        parts.append(np.stack([low + k, low + following, low + many + following], axis=1))
        parts.append(np.stack([low + k, low + many + following, low + many + k], axis=1))
    parts.append(np.stack([np.full(many, len(vertex) - 1), last + k, last + following], axis=1))
    return vertex, np.concatenate(parts)
