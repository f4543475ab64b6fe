"""Narrow phase: where two shapes touch in one point, and what the other narrow phases share.

Each function takes m pairs of a first and a second shape. Pairs that touch in several points are in `capsules`,
`box_box` and `meshes`; they return a `Manifold`.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from dem.arrays import Bools, Floats, Ints
from dem.compiled import loop
from dem.quaternion import across, cross, length


class Spheres(NamedTuple):
    """Spheres in the world frame."""

    center: Floats  #: (m, 3) [m]
    radius: Floats  #: (m,) [m]


class Boxes(NamedTuple):
    """Oriented boxes."""

    center: Floats  #: (m, 3) [m]
    turn: Floats  #: (m, 3, 3) from the frame of the box to the world
    half: Floats  #: (m, 3) half extents [m]

    def take(self, rows: Ints | Bools) -> Boxes:
        return Boxes(*(column[rows] for column in self))


class Capsules(NamedTuple):
    """All that lies within the radius of a core segment."""

    center: Floats  #: (m, 3) [m]
    axis: Floats  #: (m, 3) unit vector
    half_length: Floats  #: (m,) of the core segment [m]
    radius: Floats  #: (m,) [m]


class Planes(NamedTuple):
    """Half spaces."""

    outward: Floats  #: (m, 3) unit normal
    origin: Floats  #: (m, 3) a point of the surface [m]


class Touch(NamedTuple):
    """Contact geometry of m pairs."""

    point: Floats  #: (m, 3) middle between the two surfaces [m]
    normal: Floats  #: (m, 3) unit vector from the first shape to the second
    gap: Floats  #: (m,) signed distance of the surfaces, negative if they overlap [m]

    def take(self, rows: Any) -> Touch:
        """The contacts of the given rows: an index array, a mask, or a pair of index arrays."""
        return Touch(*(column[rows] for column in self))


class Manifold(NamedTuple):
    """Contact geometry of k points of m pairs."""

    pair: Ints  #: (k,) number of the pair
    feature: Ints  #: (k,) what touches in this point; distinct within a pair, the same while it goes on touching
    touch: Touch  #: (k, ...)


def joined(parts: list[Manifold]) -> Manifold:
    """All contacts of several manifolds of the same pairs."""
    pair, feature, touch = zip(*parts)
    columns = (np.concatenate(column) for column in zip(*touch))
    return Manifold(np.concatenate(pair), np.concatenate(feature), Touch(*columns))


def manifold(delta: Floats, touches: list[Touch], where: list[Bools] | None = None) -> Manifold:
    """Feature f of the pairs has the geometry touches[f], where its gap is at most `delta` (m,) [m] and the mask
    where[f] (m,) is set."""
    parts = []
    for feature, touch in enumerate(touches):
        near = touch.gap <= delta
        pair = np.flatnonzero(near & where[feature] if where else near)
        parts.append(Manifold(pair, np.full(len(pair), feature), touch.take(pair)))
    return joined(parts)


def dot(a: Floats, b: Floats) -> Floats:
    """Scalar products (...,) of vectors (..., 3)."""
    return np.einsum("...i,...i->...", a, b)


def reversed_touch(touch: Touch) -> Touch:
    """The same contacts with first and second shape exchanged."""
    return touch._replace(normal=-touch.normal)


@loop
def spheres_within(
    center: Floats, size: Floats, i: Ints, j: Ints, delta: Floats
) -> tuple[Ints, Floats, Floats, Floats]:
    """Of the pairs of rows i, j (m,) of spheres of centres (n, 3) and sizes (n, k), whose first column has the radii,
    those of which the gap is at most `delta` (m,): their numbers, points, normals and gaps. Concentric ones are parted
    along z."""
    pair = np.empty(len(i), np.int64)
    point, normal, gap = np.empty((len(i), 3)), np.empty((len(i), 3)), np.empty(len(i))
    found = 0
    for k in range(len(i)):
        p, q = center[i[k]], center[j[k]]
        radius = size[i[k], 0]
        x, y, z = q[0] - p[0], q[1] - p[1], q[2] - p[2]
        distance = np.sqrt(x * x + y * y + z * z)
        apart = distance - radius - size[j[k], 0]
        if apart <= delta[k]:
            if distance > 0.0:
                x, y, z = x / distance, y / distance, z / distance
            else:
                z = 1.0
            middle = radius + 0.5 * apart
            pair[found], gap[found] = k, apart
            normal[found, 0], normal[found, 1], normal[found, 2] = x, y, z
            point[found, 0], point[found, 1], point[found, 2] = p[0] + middle * x, p[1] + middle * y, p[2] + middle * z
            found += 1
    return pair[:found], point[:found], normal[:found], gap[:found]


def sphere_sphere(first: Spheres, second: Spheres) -> Touch:
    """As `spheres_within`, of all pairs."""
    rows = np.arange(len(first.center))
    center, radius = (np.concatenate(both) for both in zip(first, second))
    return Touch(*spheres_within(center, radius[:, None], rows, len(rows) + rows, np.full(len(rows), np.inf))[1:])


def sphere_capsule(ball: Spheres, capsule: Capsules) -> Touch:
    """A centre on the core is pushed out across it."""
    other, axis, half_length, other_radius = capsule
    along = np.clip(dot(ball.center - other, axis), -half_length, half_length)
    foot = other + along[:, None] * axis
    touch = sphere_sphere(ball, Spheres(foot, other_radius))
    on_core = np.flatnonzero((ball.center == foot).all(axis=1))
    touch.normal[on_core] = across(axis[on_core])
    touch.point[on_core] = foot[on_core] + (ball.radius + 0.5 * touch.gap)[on_core, None] * touch.normal[on_core]
    return touch


def closest_on_lines(point: Floats, axis: Floats, other: Floats, other_axis: Floats) -> tuple[Floats, Floats]:
    """Positions (m,) [m] along two lines, from their points (m, 3) along unit axes (m, 3), where they are closest.
    Parallel ones give numbers without meaning."""
    offset = other - point
    a, b, c = dot(axis, other_axis), dot(offset, axis), dot(offset, other_axis)
    normal = cross(axis, other_axis)
    square = np.maximum(dot(normal, normal), 1e-30)
    return (b - a * c) / square, (a * b - c) / square


def sphere_plane(ball: Spheres, plane: Planes) -> Touch:
    gap = dot(ball.center - plane.origin, plane.outward) - ball.radius
    point = ball.center - (ball.radius + 0.5 * gap)[:, None] * plane.outward
    return Touch(point, np.broadcast_to(-plane.outward, point.shape), gap)


def sphere_box(ball: Spheres, box: Boxes) -> Touch:
    """The nearest point of the box lies on a face, an edge or a corner. A centre inside the box is pushed out through
    the nearest face."""
    (center, radius), turn, half = ball, box.turn, box.half
    local = ((center - box.center)[:, None, :] @ turn)[:, 0]
    beyond = local - np.clip(local, -half, half)
    distance = length(beyond)
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


def box_plane(box: Boxes, plane: Planes, delta: Floats) -> Manifold:
    """The corners of the boxes."""
    none = np.zeros(len(box.center))
    tips = [box.center + (box.turn @ (box.half * corner)[:, :, None])[:, :, 0] for corner in CORNERS]
    return manifold(delta, [sphere_plane(Spheres(tip, none), plane) for tip in tips])
