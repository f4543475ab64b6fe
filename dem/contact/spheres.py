"""Narrow phase of spheres with spheres, half spaces and boxes, compiled: nearly all contacts of most scenes."""

from __future__ import annotations

import numpy as np

from dem.arrays import Floats, Ints
from dem.bodies import BOX, PLANE, SPHERE
from dem.compiled import inlined, loop


@inlined
def from_sphere(x, y, z, radius, other):
    """The normal from a sphere to another one, of the radius `other`, at the offset x, y, z from it, and the gap.
    Concentric ones are parted along z."""
    distance = np.sqrt(x * x + y * y + z * z)
    gap = distance - radius - other
    if distance > 0.0:
        x, y, z = x / distance, y / distance, z / distance
    else:
        z = 1.0
    return x, y, z, gap


@inlined
def to_box(x, y, z, radius, t, half):
    """The normal from a sphere to a box with the frame t (nine numbers) and half extents (three), and the gap; x, y, z
    is the offset of the sphere.

    The nearest point of the box lies on a face, an edge or a corner. A centre inside the box is pushed out through the
    nearest face."""
    u, v, w = x * t[0] + y * t[3] + z * t[6], x * t[1] + y * t[4] + z * t[7], x * t[2] + y * t[5] + z * t[8]
    a, b, c = half[0], half[1], half[2]
    p, q, r = u - min(max(u, -a), a), v - min(max(v, -b), b), w - min(max(w, -c), c)
    distance = np.sqrt(p * p + q * q + r * r)
    # At the surface p, q, r are zero or rounding noise: the direction of the nearest face is right there too.
    if distance <= 1e-12 * max(a, b, c):
        deep, p, q, r = a - abs(u), 0.0, 0.0, 0.0
        if deep <= b - abs(v) and deep <= c - abs(w):
            p = np.copysign(1.0, u)
        elif b - abs(v) <= c - abs(w):
            deep, q = b - abs(v), np.copysign(1.0, v)
        else:
            deep, r = c - abs(w), np.copysign(1.0, w)
        distance = -deep
    else:
        p, q, r = p / distance, q / distance, r / distance
    gap = distance - radius
    x, y, z = -(t[0] * p + t[1] * q + t[2] * r), -(t[3] * p + t[4] * q + t[5] * r), -(t[6] * p + t[7] * q + t[8] * r)
    return x, y, z, gap


@inlined
def frame_of(q):
    """The nine numbers of the rotation matrix of a quaternion."""
    w, x, y, z = q[0], q[1], q[2], q[3]
    return (
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    )  # fmt: skip


@loop
def touch_spheres(
    kind: Ints, center: Floats, quaternion: Floats, size: Floats, i: Ints, j: Ints, reach: Floats
) -> tuple[Ints, Floats, Floats, Floats, Ints]:
    """Of the pairs of rows i, j (m,) of `dem.contact.primitives.Primitives` that are spheres with spheres, half spaces
    or boxes, those of which the gap is at most `reach` (m,): their numbers, points, normals (from i to j) and gaps; and
    the numbers of the pairs of other kinds."""
    pair, other = np.empty(len(i), np.int64), np.empty(len(i), np.int64)
    point, normal, gaps = np.empty((len(i), 3)), np.empty((len(i), 3)), np.empty(len(i))
    found = others = 0
    for k in range(len(i)):
        swap = kind[i[k]] != SPHERE
        a, b = (j[k], i[k]) if swap else (i[k], j[k])
        if kind[a] != SPHERE or kind[b] not in (SPHERE, PLANE, BOX):
            other[others] = k
            others += 1
            continue
        radius = size[a, 0]
        x, y, z = center[b, 0] - center[a, 0], center[b, 1] - center[a, 1], center[b, 2] - center[a, 2]
        if kind[b] == SPHERE:
            x, y, z, gap = from_sphere(x, y, z, radius, size[b, 0])
        elif kind[b] == PLANE:
            p, q, r = size[b, 0], size[b, 1], size[b, 2]
            gap = -(x * p + y * q + z * r) - radius
            x, y, z = -p, -q, -r
        else:
            x, y, z, gap = to_box(-x, -y, -z, radius, frame_of(quaternion[b]), size[b])
        if gap <= reach[k]:
            ahead, sign = radius + 0.5 * gap, -1.0 if swap else 1.0
            pair[found], gaps[found] = k, gap
            normal[found, 0], normal[found, 1], normal[found, 2] = sign * x, sign * y, sign * z
            point[found, 0] = center[a, 0] + ahead * x
            point[found, 1] = center[a, 1] + ahead * y
            point[found, 2] = center[a, 2] + ahead * z
            found += 1
    return pair[:found], point[:found], normal[:found], gaps[:found], other[:others]


@loop
def spheres_spheres(
    center: Floats, radius: Floats, other: Floats, other_radius: Floats
) -> tuple[Floats, Floats, Floats]:
    """Points, normals and gaps of the pairs of spheres of centres (m, 3) and radii (m,)."""
    point, normal, gaps = np.empty((len(radius), 3)), np.empty((len(radius), 3)), np.empty(len(radius))
    for k in range(len(radius)):
        x, y, z = other[k, 0] - center[k, 0], other[k, 1] - center[k, 1], other[k, 2] - center[k, 2]
        x, y, z, gap = from_sphere(x, y, z, radius[k], other_radius[k])
        gaps[k], normal[k, 0], normal[k, 1], normal[k, 2] = gap, x, y, z
        for n in range(3):
            point[k, n] = center[k, n] + (radius[k] + 0.5 * gap) * normal[k, n]
    return point, normal, gaps


@loop
def spheres_boxes(
    center: Floats, radius: Floats, place: Floats, turn: Floats, half: Floats
) -> tuple[Floats, Floats, Floats]:
    """Points, normals and gaps of the pairs of spheres, of centres (m, 3) and radii (m,), and boxes with the places
    (m, 3), frames (m, 9) and half extents (m, 3)."""
    point, normal, gaps = np.empty((len(radius), 3)), np.empty((len(radius), 3)), np.empty(len(radius))
    for k in range(len(radius)):
        x, y, z = center[k, 0] - place[k, 0], center[k, 1] - place[k, 1], center[k, 2] - place[k, 2]
        x, y, z, gap = to_box(x, y, z, radius[k], turn[k], half[k])
        gaps[k], normal[k, 0], normal[k, 1], normal[k, 2] = gap, x, y, z
        for n in range(3):
            point[k, n] = center[k, n] + (radius[k] + 0.5 * gap) * normal[k, n]
    return point, normal, gaps
