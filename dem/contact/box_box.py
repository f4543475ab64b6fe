"""Narrow phase of two boxes.

The separating axis test (Gottschalk, Lin, Manocha 1996, "OBBTree") gives the axis along which two boxes are
furthest apart, or overlap least. Where that is the normal of a face, the face is laid over the face of the
other box that looks back at it, and the corners of the polygon that they share are contacts. Otherwise two edges
cross in one point, or corners are nearest to edges or corners.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from dem.arrays import Bools, Floats, Ints
from dem.contact.narrow import (
    Boxes,
    Manifold,
    Spheres,
    Touch,
    closest_on_lines,
    dot,
    joined,
    reversed_touch,
    sphere_box,
)
from dem.quaternion import cross, length

#: Boxes touch on faces if the smallest gap there is within this share of the contact distance of the distance of the
#: boxes; if not, in the closest points alone.
FLUSH = 0.1

#: Corners and edges that are closer to each other across the normal than this share of the least half extent of the
#: two boxes count as one on top of the other.
SNAP = 1e-3

#: Lengths that differ by less than this share of the least half extent are equal: what is chosen among equals does
#: not depend on rounding.
TIE = 1e-9

#: Features of a pair of boxes: a corner of the first (8), a corner of the second (8), two edges (12 x 12).
CORNER_OF_SECOND, EDGES, BOX_FEATURES = 8, 16, 160

#: Edges whose angle has a sine below this are parallel and have no normal in common.
PARALLEL = 1e-5


def _faces() -> tuple[Floats, Ints, Ints]:
    """Of face 2 k + (1 on the positive side) of the box with half extents one, the corners in cyclic order: their
    coordinates (6, 4, 3) and numbers (6, 4), and the numbers (6, 4) of the edges to the next corner."""
    signs, edges = np.empty((6, 4, 3)), np.empty((6, 4), np.int64)
    for face in range(6):
        axis = face // 2
        signs[face, :, axis] = 2.0 * (face % 2) - 1.0
        signs[face, :, (axis + 1) % 3] = (1.0, -1.0, -1.0, 1.0)
        signs[face, :, (axis + 2) % 3] = (1.0, 1.0, -1.0, -1.0)
        for corner in range(4):
            along = (axis + 1 + corner % 2) % 3
            edges[face, corner] = _edge_number(np.array([along]), signs[face, corner][None])[0]
    return signs, ((signs > 0) @ [4, 2, 1]).astype(np.int64), edges


def _edge_number(along: Ints, sign: Floats) -> Ints:
    """Numbers (m,) of the edges along the axes (m,) through the corners of coordinates (m, 3) = +-1."""
    rows = np.arange(len(along))
    return 4 * along + 2 * (sign[rows, (along + 1) % 3] > 0) + (sign[rows, (along + 2) % 3] > 0)


_FACE_SIGNS, _FACE_CORNERS, _FACE_EDGES = _faces()


class _Pairs(NamedTuple):
    """Pairs of boxes with their separations along the 15 axes, negative where they overlap."""

    first: Boxes
    second: Boxes
    offset: Floats  # (m, 3) from the first centres to the second
    size: Floats  # (m,) least half extents
    faces: Floats  # (m, 6) separations along the axes of the first and of the second box
    edges: Floats  # (m, 9) along the cross products, -inf for parallel edges

    def take(self, rows: Ints | Bools) -> _Pairs:
        return _Pairs(self.first.take(rows), self.second.take(rows), *(column[rows] for column in self[2:]))


def box_box(first: Boxes, second: Boxes, delta: Floats) -> Manifold:
    """Contacts of gap at most `delta` (m,) [m]: up to eight points per pair, on faces all with the same normal.

    The features are independent of which of the two faces gives the normal.
    """
    rows, pairs = _separated_within(first, second, delta)
    delta = delta[rows]
    least = np.maximum(pairs.faces.max(axis=1), pairs.edges.max(axis=1))  # the distance at most, or just the overlap
    tolerance = FLUSH * delta + 2.0 * SNAP * pairs.size

    flat = np.flatnonzero(pairs.faces.max(axis=1) >= least - tolerance)
    feature, laid = _faces_laid_over(pairs.take(flat))
    flush = laid.gap.min(axis=1) <= (least + tolerance)[flat]
    pair, point = np.nonzero(flush[:, None] & (laid.gap <= delta[flat, None]))
    touch = Touch(laid.point[pair, point], laid.normal[pair], laid.gap[pair, point])
    on_faces = Manifold(rows[flat[pair]], feature[pair, point], touch)

    pointed = np.setdiff1d(np.arange(len(rows)), flat[flush])
    pair, feature, touch = _closest_points(pairs.take(pointed), least[pointed], tolerance[pointed])
    near = np.flatnonzero(touch.gap <= delta[pointed[pair]])
    return joined([on_faces, Manifold(rows[pointed[pair[near]]], feature[near], touch.take(near))])


def _separated_within(first: Boxes, second: Boxes, reach: Floats) -> tuple[Ints, _Pairs]:
    """The pairs that none of the 15 axes parts by more than `reach`, and their numbers."""
    offset = second.center - first.center
    cosines = first.turn.transpose(0, 2, 1) @ second.turn
    absolute = np.abs(cosines)
    place = (offset[:, None, :] @ first.turn)[:, 0]
    other_place = (offset[:, None, :] @ second.turn)[:, 0]
    extent = first.half + (absolute @ second.half[:, :, None])[:, :, 0]
    other_extent = second.half + (first.half[:, None, :] @ absolute)[:, 0]
    faces = np.concatenate([np.abs(place) - extent, np.abs(other_place) - other_extent], axis=1)

    rows = np.flatnonzero(faces.max(axis=1) <= reach)
    place, cosines, absolute = place[rows], cosines[rows], absolute[rows]
    h, g = first.half[rows], second.half[rows]
    edges = np.empty((len(rows), 9))
    for i in range(3):
        i1, i2 = (i + 1) % 3, (i + 2) % 3
        for j in range(3):
            j1, j2 = (j + 1) % 3, (j + 2) % 3
            # In the frame of the first box, the axis e_i x (column j of the cosines) has two components.
            apart = np.abs(place[:, i2] * cosines[:, i1, j] - place[:, i1] * cosines[:, i2, j])
            apart -= h[:, i1] * absolute[:, i2, j] + h[:, i2] * absolute[:, i1, j]
            apart -= g[:, j1] * absolute[:, i, j2] + g[:, j2] * absolute[:, i, j1]
            sine = np.hypot(cosines[:, i1, j], cosines[:, i2, j])
            edges[:, 3 * i + j] = np.where(sine > PARALLEL, apart / np.maximum(sine, PARALLEL), -np.inf)
    kept = np.flatnonzero(edges.max(axis=1) <= reach[rows])
    rows = rows[kept]
    size = np.minimum(h[kept].min(axis=1), g[kept].min(axis=1))
    return rows, _Pairs(first.take(rows), second.take(rows), offset[rows], size, faces[rows], edges[kept])


def _faces_laid_over(pairs: _Pairs) -> tuple[Ints, Touch]:
    """The corners of the polygon that is common to two faces, seen along the normal (m, 3) of one of them: the corners
    of both and the crossings of their edges, features (m, 24), points (m, 24, 3) and gaps (m, 24), infinite where there
    is no contact."""
    rows, offset, snap = np.arange(len(pairs.faces)), pairs.offset, SNAP * pairs.size
    best = _first_largest(pairs.faces, TIE * pairs.size)
    axes = np.concatenate([pairs.first.turn.transpose(0, 2, 1), pairs.second.turn.transpose(0, 2, 1)], axis=1)
    box, k = 3 * (best // 3), best % 3
    normal = axes[rows, best]
    normal = normal * np.copysign(1.0, dot(normal, offset))[:, None]
    frame = np.stack([axes[rows, box + (k + 1) % 3], axes[rows, box + (k + 2) % 3], normal], axis=1)

    # Corners p and q of the two faces in this frame, about the first centre: two coordinates and a height.
    first, p, p_slope = _face_towards(frame @ pairs.first.turn, pairs.first.half, 1.0)
    second, q, q_slope = _face_towards(frame @ pairs.second.turn, pairs.second.half, -1.0)
    q += (frame @ offset[:, :, None])[:, None, :, 0]
    p_out, q_out = _outside(p, q), _outside(q, p)  # (m, corner, edge of the other face)
    thick = snap[:, None, None]
    p_in, q_in = (p_out <= thick).all(axis=2), (q_out <= thick).all(axis=2)
    # Two coordinates, and the heights of both faces there.
    corners = np.concatenate([p, _height(p, q, q_slope)], axis=2)
    other_corners = np.concatenate([q[..., :2], _height(q, p, p_slope), q[..., 2:]], axis=2)

    # A corner on a corner is one contact, in the middle of the two.
    apart = length(p[:, :, None, :2] - q[:, None, :, :2])
    same = (apart <= 2.0 * thick) & p_in[:, :, None] & q_in[:, None, :]
    partner = other_corners[rows[:, None], same.argmax(axis=2)]
    corners = np.where(same.any(axis=2)[..., None], 0.5 * (corners + partner), corners)
    q_in &= ~same.any(axis=1)

    # Edges cross if the ends of each are on both sides of the other, none of them just on it.
    p_start, p_end = p_out, np.roll(p_out, -1, axis=1)
    q_start, q_end = q_out.transpose(0, 2, 1), np.roll(q_out, -1, axis=1).transpose(0, 2, 1)
    crossed = np.ones_like(p_out, dtype=bool)
    for start, end in ((p_start, p_end), (q_start, q_end)):
        crossed &= (start * end < 0.0) & (np.minimum(np.abs(start), np.abs(end)) > thick)
    s = np.where(crossed, p_start / np.where(crossed, p_start - p_end, 1.0), 0.0)
    t = np.where(crossed, q_start / np.where(crossed, q_start - q_end, 1.0), 0.0)
    on_p = p[:, :, None] + s[..., None] * (np.roll(p, -1, axis=1) - p)[:, :, None]
    height = q[:, None, :, 2] + t * (np.roll(q, -1, axis=1) - q)[:, None, :, 2]
    crossings = np.concatenate([on_p, height[..., None]], axis=3).reshape(len(rows), 16, 4)

    found = np.concatenate([corners, other_corners, crossings], axis=1)
    valid = np.concatenate([p_in, q_in, crossed.reshape(len(rows), 16)], axis=1)
    edges = EDGES + 12 * _FACE_EDGES[first][:, :, None] + _FACE_EDGES[second][:, None, :]
    feature = np.concatenate(
        [_FACE_CORNERS[first], CORNER_OF_SECOND + _FACE_CORNERS[second], edges.reshape(len(rows), 16)], axis=1
    )
    middle = np.concatenate([found[..., :2], found[..., 2:].mean(axis=2, keepdims=True)], axis=2)
    gap = np.where(valid, found[..., 3] - found[..., 2], np.inf)
    return feature, Touch(pairs.first.center[:, None] + middle @ frame, normal, gap)


def _first_largest(values: Floats, tie: Floats) -> Ints:
    """Of each row (m, n) the number of the first entry that equals the largest within `tie` (m,): the choice does not
    depend on rounding."""
    return (values >= values.max(axis=1, keepdims=True) - tie[:, None]).argmax(axis=1)


def _face_towards(turn: Floats, half: Floats, side: float) -> tuple[Ints, Floats, Floats]:
    """Of boxes in frames (m, 3, 3) about their centres, the face most towards the third axis (side 1) or away from it
    (side -1): its number (m,), its corners (m, 4, 3), and the gradient (m, 2) of its height."""
    rows = np.arange(len(turn))
    tilt = np.abs(turn[:, 2])
    k = _first_largest(tilt, np.full(len(tilt), TIE))
    outward = turn[rows, :, k]
    face = 2 * k + (side * outward[:, 2] > 0.0)
    corners = (_FACE_SIGNS[face] * half[:, None]) @ turn.transpose(0, 2, 1)
    return face, corners, -outward[:, :2] / outward[:, 2:]


def _height(points: Floats, face: Floats, slope: Floats) -> Floats:
    """The heights (m, 4, 1) of faces of corners (m, 4, 3) and gradients (m, 2) opposite points (m, 4, 3)."""
    return face[:, :1, 2:] + (points - face[:, :1])[..., :2] @ slope[:, :, None]


def _outside(points: Floats, polygon: Floats) -> Floats:
    """Distances (m, 4, 4) of points (m, 4, 2 or more) beyond the lines of the sides of convex polygons (m, 4, 2 or
    more), negative inside."""
    side = np.roll(polygon, -1, axis=1)[..., :2] - polygon[..., :2]
    outward = np.stack([side[..., 1], -side[..., 0]], axis=2) / length(side)[..., None]
    level = np.einsum("mei,mei->me", outward, polygon[..., :2])
    turned = np.copysign(1.0, level - np.einsum("mei,mi->me", outward, polygon[..., :2].mean(axis=1)))
    return turned[:, None] * (points[..., :2] @ outward.transpose(0, 2, 1) - level[:, None])


def _closest_points(pairs: _Pairs, separation: Floats, tolerance: Floats) -> Manifold:
    """The contact of two edges where boxes overlap or these are closest; else the closest corner, and others that
    are as close but for the tolerance (m,), as where two edges are parallel."""
    edge, touch = _edge_edge(pairs)
    tip = np.flatnonzero(separation > TIE * pairs.size)
    corners, size = _corners(pairs.take(tip)), pairs.size[tip]
    smallest = corners.gap.min(axis=1)
    least = np.minimum(smallest, touch.gap[tip])
    on_edges = np.ones(len(edge), dtype=bool)
    on_edges[tip] = touch.gap[tip] < smallest - TIE * size

    shown = corners.gap <= (least + tolerance[tip])[:, None]
    apart = length(corners.point[:, :8, None] - corners.point[:, None, 8:])
    same = (apart <= 1e-6 * size[:, None, None]) & shown[:, :8, None]  # one corner on the other, to rounding
    shown[:, 8:] &= ~same.any(axis=1)
    pair, corner = np.nonzero(shown)
    edges = np.flatnonzero(on_edges)
    at_corners = Manifold(tip[pair], corner, corners.take((pair, corner)))
    return joined([Manifold(edges, edge[edges], touch.take(edges)), at_corners])


def _corners(pairs: _Pairs) -> Touch:
    """Contacts (m, 16, ...) of the corners of the first box with the second, and of those of the second with the
    first."""
    rows = np.repeat(np.arange(len(pairs.size)), 8)
    first = pairs.first._replace(center=0.0 * pairs.offset).take(rows)  # places about the first centre
    second = pairs.second._replace(center=pairs.offset).take(rows)
    tips = [box.take(slice(None, None, 8)).corners().reshape(-1, 3) for box in (first, second)]
    balls = [Spheres(tip, np.zeros(len(rows))) for tip in tips]
    sides = sphere_box(balls[0], second), reversed_touch(sphere_box(balls[1], first))
    touch = Touch(*(np.concatenate([v.reshape(-1, 8, *v.shape[1:]) for v in both], axis=1) for both in zip(*sides)))
    return touch._replace(point=pairs.first.center[:, None] + touch.point)


def _edge_edge(pairs: _Pairs) -> tuple[Ints, Touch]:
    """The two edges along whose common normal the boxes are furthest apart: feature (m,) and geometry.

    The gap is that along the normal where the boxes overlap, else the distance of the two points. Infinite if all
    edges are parallel.
    """
    rows, (center, turn, half), (_, other_turn, other_half) = np.arange(len(pairs.faces)), pairs.first, pairs.second
    offset, separation = pairs.offset, pairs.edges.max(axis=1)
    i, j = np.divmod(_first_largest(pairs.edges, TIE * pairs.size), 3)
    axis, other_axis = turn[rows, :, i], other_turn[rows, :, j]
    normal = cross(axis, other_axis)
    normal /= np.maximum(length(normal), PARALLEL)[:, None]
    normal *= np.copysign(1.0, dot(normal, offset))[:, None]

    sign = np.copysign(1.0, (normal[:, None, :] @ turn)[:, 0])
    other_sign = -np.copysign(1.0, (normal[:, None, :] @ other_turn)[:, 0])
    feature = EDGES + 12 * _edge_number(i, sign) + _edge_number(j, other_sign)
    arm, other_arm = sign * half, other_sign * other_half
    arm[rows, i], other_arm[rows, j] = 0.0, 0.0
    middle = (turn @ arm[:, :, None])[:, :, 0]
    other_middle = offset + (other_turn @ other_arm[:, :, None])[:, :, 0]
    s, t = closest_on_lines(middle, axis, other_middle, other_axis)
    limit, other_limit = half[rows, i], other_half[rows, j]
    one = middle + np.clip(s, -limit, limit)[:, None] * axis
    two = other_middle + np.clip(t, -other_limit, other_limit)[:, None] * other_axis

    between = two - one
    distance = length(between)
    apart = separation > TIE * pairs.size  # in contact, the two points are too close to give a direction
    normal = np.where(apart[:, None], between / np.where(apart, distance, 1.0)[:, None], normal)
    gap = np.where(apart, distance, np.where(np.isfinite(separation), separation, np.inf))
    return feature, Touch(center + 0.5 * (one + two), normal, gap)
