"""Narrow phase: where two shapes touch in one point.

Each function takes m pairs of a first and a second shape and returns for each
    point (m, 3)   middle between the two surfaces [m],
    normal (m, 3)  unit vector from the first shape to the second,
    gap (m,)       signed distance of the surfaces, negative if they overlap [m].
Pairs that touch in several points are in `capsules` and `box_box`; they return a `Manifold`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from dem.arrays import Floats, Ints
from dem.quaternion import cross


class Touch(NamedTuple):
    """Contact geometry of m pairs."""

    point: Floats
    normal: Floats
    gap: Floats


class Manifold(NamedTuple):
    """Contact geometry of k points of m pairs."""

    pair: Ints  #: (k,) number of the pair
    feature: Ints  #: (k,) what touches in this point; distinct within a pair, the same while it goes on touching
    touch: Touch  #: (k, ...)


#: Shapes touch in several points if the smallest gap among these is within this share of the contact distance
#: of the distance of the shapes; if not, in the closest point alone.
FLUSH = 0.1


def dot(a: Floats, b: Floats) -> Floats:
    """Scalar products (...,) of vectors (..., 3)."""
    return np.einsum("...i,...i->...", a, b)


def reversed_touch(touch: Touch) -> Touch:
    """The same contacts with first and second shape exchanged."""
    return touch._replace(normal=-touch.normal)


def sphere_sphere(center: Floats, radius: Floats, other_center: Floats, other_radius: Floats) -> Touch:
    """Spheres of centres (m, 3) and radii (m,). Concentric ones are parted along z."""
    offset = other_center - center
    distance = np.sqrt(np.einsum("ij,ij->i", offset, offset))
    normal = offset / np.where(distance > 0.0, distance, 1.0)[:, None]
    normal[distance == 0.0] = (0.0, 0.0, 1.0)
    gap = distance - radius - other_radius
    return Touch(center + (radius + 0.5 * gap)[:, None] * normal, normal, gap)


def sphere_capsule(
    center: Floats, radius: Floats, other: Floats, axis: Floats, half_length: Floats, other_radius: Floats
) -> Touch:
    """Spheres of centres (m, 3) and radii (m,), and capsules: centres and unit axes (m, 3), half lengths of the
    core segments and radii (m,). A centre on the core is pushed out across it."""
    along = np.clip(dot(center - other, axis), -half_length, half_length)
    foot = other + along[:, None] * axis
    touch = sphere_sphere(center, radius, foot, other_radius)
    on_core = np.flatnonzero((center == foot).all(axis=1))
    touch.normal[on_core] = across(axis[on_core])
    touch.point[on_core] = center[on_core] + (radius + 0.5 * touch.gap)[on_core, None] * touch.normal[on_core]
    return touch


def across(axis: Floats) -> Floats:
    """Unit vectors (m, 3) normal to the given ones."""
    rows = np.arange(len(axis))
    other = np.zeros_like(axis)
    other[rows, np.abs(axis).argmin(axis=1)] = 1.0
    normal = cross(axis, other)
    return normal / np.linalg.norm(normal, axis=1, keepdims=True)


def closest_on_lines(point: Floats, axis: Floats, other: Floats, other_axis: Floats) -> tuple[Floats, Floats]:
    """Positions (m,) [m] along two lines, from their points (m, 3) along unit axes (m, 3), where they are closest.
    Parallel ones give numbers without meaning."""
    offset = other - point
    a, b, c = dot(axis, other_axis), dot(offset, axis), dot(offset, other_axis)
    normal = cross(axis, other_axis)
    square = np.maximum(dot(normal, normal), 1e-30)
    return (b - a * c) / square, (a * b - c) / square


def sphere_plane(center: Floats, radius: Floats, outward: Floats, origin: Floats) -> Touch:
    """Spheres of centres (m, 3) and radii (m,), and half spaces: normals and points of the surfaces, (m, 3) or
    (3,) for all."""
    gap = dot(center - origin, outward) - radius
    point = center - (radius + 0.5 * gap)[:, None] * outward
    return Touch(point, np.broadcast_to(-outward, center.shape), gap)


def sphere_box(center: Floats, radius: Floats, box_center: Floats, turn: Floats, half: Floats) -> Touch:
    """Spheres of centres (m, 3) and radii (m,), and boxes: centres, frames (m, 3, 3), half extents (m, 3).

    Either side may be a single shape, with arguments (3,) and (3, 3). The nearest point of the box lies on a
    face, an edge or a corner. A centre inside the box is pushed out through the nearest face.
    """
    offset = center - box_center
    local = (offset[:, None, :] @ turn)[:, 0]
    half = np.broadcast_to(half, local.shape)
    beyond = local - np.clip(local, -half, half)
    distance = np.sqrt(np.einsum("ij,ij->i", beyond, beyond))
    outward = beyond / np.where(distance > 0.0, distance, 1.0)[:, None]
    # At the surface `beyond` is zero or rounding noise: the direction of the nearest face is right there too.
    inside = np.flatnonzero(distance <= 1e-12 * half.max(axis=1))
    depth = half[inside] - np.abs(local[inside])
    axis = depth.argmin(axis=1)
    distance[inside] = -depth[np.arange(len(inside)), axis]
    outward[inside] = 0.0
    outward[inside, axis] = np.copysign(1.0, local[inside, axis])
    gap = distance - radius
    normal = -(turn @ outward[:, :, None])[:, :, 0]
    return Touch(center + (radius + 0.5 * gap)[:, None] * normal, normal, gap)


#: Corners (8, 3) of the box with half extents one; the row number is the feature of a contact.
CORNERS = np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])


def corner_plane(
    center: Floats, turn: Floats, half: Floats, corner: Ints, outward: Floats, origin: Floats
) -> Touch:
    """One corner (m,) each of boxes, as in `sphere_box`, and a half space, as in `sphere_plane`."""
    tip = center + (turn @ (half * CORNERS[corner])[:, :, None])[:, :, 0]
    gap = dot(tip - origin, outward)
    return Touch(tip - 0.5 * gap[:, None] * outward, np.broadcast_to(-outward, tip.shape), gap)
