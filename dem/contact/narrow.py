"""Narrow phase: where two shapes touch.

Each function takes m pairs of a first and a second shape and returns for each
    point (m, 3)   middle between the two surfaces [m],
    normal (m, 3)  unit vector from the first shape to the second,
    gap (m,)       signed distance of the surfaces, negative if they overlap [m].
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from dem.arrays import Bools, Floats, Ints
from dem.quaternion import cross


class Touch(NamedTuple):
    """Contact geometry of m pairs."""

    point: Floats
    normal: Floats
    gap: Floats


def sphere_sphere(center: Floats, radius: Floats, other_center: Floats, other_radius: Floats) -> Touch:
    """Spheres of centres (m, 3) and radii (m,). Concentric ones are parted along z."""
    offset = other_center - center
    distance = np.sqrt(np.einsum("ij,ij->i", offset, offset))
    normal = offset / np.where(distance > 0.0, distance, 1.0)[:, None]
    normal[distance == 0.0] = (0.0, 0.0, 1.0)
    gap = distance - radius - other_radius
    return Touch(center + (radius + 0.5 * gap)[:, None] * normal, normal, gap)


def sphere_plane(center: Floats, radius: Floats, outward: Floats, origin: Floats) -> Touch:
    """Spheres of centres (m, 3) and radii (m,), and a half space: point (3,) of its surface, normal (3,)."""
    height = (center - origin) @ outward
    gap = height - radius
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
    gap = (tip - origin) @ outward
    return Touch(tip - 0.5 * gap[:, None] * outward, np.broadcast_to(-outward, tip.shape), gap)


def boxes_within(
    center: Floats,
    turn: Floats,
    half: Floats,
    other_center: Floats,
    other_turn: Floats,
    other_half: Floats,
    reach: float,
) -> Bools:
    """Mask (m,) of the pairs of boxes that none of their 15 separating axes parts by more than `reach` [m].

    All pairs within reach are among them, and some whose corners are nearly so. Gottschalk, Lin, Manocha
    (1996), "OBBTree".
    """
    offset = other_center - center
    faces = [turn[:, :, i] for i in range(3)] + [other_turn[:, :, i] for i in range(3)]
    edges = [cross(faces[i], faces[j]) for i in range(3) for j in range(3, 6)]
    within = np.ones(len(center), dtype=bool)
    for axis in faces + edges:
        extent = np.abs(np.einsum("mij,mi->mj", turn, axis) * half).sum(axis=1)
        other_extent = np.abs(np.einsum("mij,mi->mj", other_turn, axis) * other_half).sum(axis=1)
        length = np.linalg.norm(axis, axis=1)  # zero for parallel edges, which part nothing
        apart = np.abs(np.einsum("mi,mi->m", offset, axis)) - extent - other_extent
        within &= apart <= reach * length
    return within
