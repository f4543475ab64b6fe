"""The point of a simplex nearest to the origin, compiled: what the distance of convex shapes asks for (Gilbert,
Johnson, Keerthi 1988), and the lengths that count as none in it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from dem.arrays import Floats, Ints
from dem.compiled import inlined, inner
from dem.geometry.vectors import cross, dot, plus

#: Corners and edges that are closer to each other across the normal than this share of the lesser half thickness of the
#: two count as one on top of the other.
SNAP = 1e-3

#: Radius to which edges and corners that meet count as rounded, as a share of the lesser half thickness.
ROUND = 0.01

#: Two points that are closer than this share of the lesser half thickness give no direction.
CLOSE = 1e-7


class Simplex(NamedTuple):
    """Points of the difference of two shapes, within loops, and the point of their hull nearest to the origin."""

    point: Floats  #: (4, 3)
    ends: Ints  #: (4, 2) the rows of the vertices of both shapes
    share: Floats  #: (4,) of the points in the nearest one
    parts: Floats  #: (6,) room for shares that are compared


@inner
def no_simplex():
    """Room for one."""
    return Simplex(np.empty((4, 3)), np.empty((4, 2), np.int64), np.empty(4), np.empty(6))


@inlined
def nearer(count, square, simplex):
    """Make of a simplex of so many points, and of the point that follows them, the part that is nearest to the origin,
    if it is nearer than `square`: how many points it has, the square of its distance, and its place. The ends go with
    the points; their shares are filled in."""
    point, ends, share, parts = simplex
    first, second, better = 0, 0, np.inf  # the new simplex: `first`, `second` and the last of the points
    if count == 0:
        better = dot(point[0], point[0])
        parts[0], parts[1], parts[2] = 0.0, 0.0, 1.0
    elif count == 1:
        way = plus(point[1], -1.0, point[0])
        t = min(max(-dot(way, point[0]) / dot(way, way), 0.0), 1.0)
        parts[0], parts[1], parts[2], better = 1.0 - t, 0.0, t, 0.0
        for n in range(3):
            better += ((1.0 - t) * point[0, n] + t * point[1, n]) ** 2
    else:
        for one in range(count - 1):
            for two in range(one + 1, count):
                found = _on_triangle(point[one], point[two], point[count], parts[3:])
                if found < better:
                    better, first, second = found, one, two
                    parts[0], parts[1], parts[2] = parts[3], parts[4], parts[5]
    x, y, z, last = 0.0, 0.0, 0.0, count
    if better < square:
        count = 0
        for n in range(3):
            k = first if n == 0 else second if n == 1 else last
            if parts[n] > 0.0:
                share[count], ends[count, 0], ends[count, 1] = parts[n], ends[k, 0], ends[k, 1]
                point[count, 0], point[count, 1], point[count, 2] = point[k, 0], point[k, 1], point[k, 2]
                x, y, z = x + parts[n] * point[k, 0], y + parts[n] * point[k, 1], z + parts[n] * point[k, 2]
                count += 1
    return count, better, x, y, z


@inner
def _on_triangle(a, b, c, share):
    """Fill in the shares of the corners of a triangle in its point nearest to the origin (Ericson 2005, "Real-time
    collision detection", 5.1.5); its squared distance."""
    ab, ac = plus(b, -1.0, a), plus(c, -1.0, a)
    d1, d2, d3, d4, d5, d6 = -dot(ab, a), -dot(ac, a), -dot(ab, b), -dot(ac, b), -dot(ab, c), -dot(ac, c)
    n = cross(ab, ac)  # products of d1 to d6 would lose what is narrow
    va, vb, vc = dot(n, cross(b, plus(c, -1.0, b))), -dot(n, cross(a, ac)), dot(n, cross(a, ab))
    if d1 <= 0.0 and d2 <= 0.0:
        v, w = 0.0, 0.0
    elif d3 >= 0.0 and d4 <= d3:
        v, w = 1.0, 0.0
    elif d6 >= 0.0 and d5 <= d6:
        v, w = 0.0, 1.0
    elif vc <= 0.0 and d1 >= 0.0 and d3 <= 0.0:
        v, w = d1 / (d1 - d3), 0.0
    elif vb <= 0.0 and d2 >= 0.0 and d6 <= 0.0:
        v, w = 0.0, d2 / (d2 - d6)
    elif va <= 0.0 and d4 - d3 >= 0.0 and d5 - d6 >= 0.0:
        w = (d4 - d3) / ((d4 - d3) + (d5 - d6))
        v = 1.0 - w
    else:
        v, w = vb / (va + vb + vc), vc / (va + vb + vc)
    u = 1.0 - v - w
    share[0], share[1], share[2] = u, v, w
    x, y, z = u * a[0] + v * b[0] + w * c[0], u * a[1] + v * b[1] + w * c[1], u * a[2] + v * b[2] + w * c[2]
    return x * x + y * y + z * z
