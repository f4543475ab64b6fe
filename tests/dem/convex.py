"""Signed distances of two convex bodies by means that the contact search does not use.

A body is a centre (3,), a frame (3, 3), and half extents (3,) of a box, some of which may be zero, plus a radius: a
sphere has none, a capsule one half extent.
"""

from __future__ import annotations

import itertools

import numpy as np
from scipy.optimize import lsq_linear
from scipy.spatial import ConvexHull

SIGNS = np.array(list(itertools.product((-1.0, 1.0), repeat=3)))


def distance(one, other):
    """Distance of the cores of two bodies: a linear least squares problem with bounds."""
    sides = np.hstack([one[1] * one[2], -other[1] * other[2]])
    sides = sides[:, np.abs(sides).max(axis=0) > 0.0]
    apart = other[0] - one[0]
    if sides.shape[1] == 0:
        return np.linalg.norm(apart)
    found = lsq_linear(sides, apart, bounds=(-1.0, 1.0), method="bvls", tol=1e-14)
    return np.sqrt(2.0 * found.cost)


def depth(one, other):
    """Shortest translation that parts two cores that overlap: the distance of the origin to the hull of their
    Minkowski difference."""
    tips = [body[0] + (SIGNS * body[2]) @ body[1].T for body in (one, other)]
    hull = ConvexHull((tips[0][:, None] - tips[1]).reshape(-1, 3))
    return -hull.equations[:, 3].max()


def signed_distance(one, other):
    """Gap of two bodies; negative if they overlap. (Spheres and capsules must not overlap with their cores.)"""
    apart = distance(one, other)
    if apart < 1e-9 and np.count_nonzero(one[2]) + np.count_nonzero(other[2]) > 3:
        apart = -depth(one, other)
    return apart - one[3] - other[3]


def outside(body, points):
    """Distances (n,) of points (n, 3) from a body, zero inside."""
    local = np.abs((points - body[0]) @ body[1]) - body[2]
    return np.maximum(np.linalg.norm(np.maximum(local, 0.0), axis=1) - body[3], 0.0)
