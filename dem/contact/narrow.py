"""Narrow phase of capsules and half spaces, and what that of polyhedra and of meshes shares with it.

Each function takes m pairs of a first and a second shape, and returns a `Touch` if they touch in one point, else a
`Manifold`. Spheres are in `spheres`, polyhedra in `polyhedra`, surfaces of triangles in `meshes`
and `solid_meshes`.

Capsules touch at the ends of what lies side by side, and at the closest point between them; docs/mechanics.md says why.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from dem.arrays import Bools, Floats, Ints
from dem.contact.spheres import spheres_boxes, spheres_spheres
from dem.quaternion import across, cross, length

#: Corners (8, 3) of the box with half extents one; the row number is the feature of a contact.
CORNERS = np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])

#: Ends of core segments that face each other within this share of the length are one contact: above rounding.
SNAP = 1e-6

#: The closest point is a contact of its own if it is closer than the ends by this share of the lesser radius (of the
#: least half extent). Bodies at rest side by side, which rock by less, keep the contacts of their ends alone.
DISTINCT = 1e-4


class Spheres(NamedTuple):
    """Spheres in the world frame."""

    center: Floats  #: (m, 3) [m]
    radius: Floats  #: (m,) [m]


class Boxes(NamedTuple):
    """Oriented boxes."""

    center: Floats  #: (m, 3) [m]
    turn: Floats  #: (m, 3, 3) from the frame of the box to the world
    half: Floats  #: (m, 3) half extents [m]


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


class ContactBuffer(NamedTuple):
    """Room for contacts, which loops fill in."""

    pair: Ints  #: (room,)
    feature: Ints  #: (room,)
    out: Floats  #: (room, 7) points, normals and gaps

    @classmethod
    def with_room(cls, room: int) -> ContactBuffer:
        """Room for so many."""
        return cls(np.empty(room, np.int64), np.empty(room, np.int64), np.empty((room, 7)))

    def doubled(self) -> ContactBuffer:
        """The same with as much room again."""
        return ContactBuffer(*(np.concatenate([column, np.empty_like(column)]) for column in self))  # type: ignore[arg-type]

    def manifold(self, found: int) -> Manifold:
        """The contacts that are filled in."""
        columns = self.out[:found, :3], self.out[:found, 3:6], self.out[:found, 6]
        touch = Touch(*map(np.ascontiguousarray, columns))
        return Manifold(self.pair[:found], self.feature[:found], touch)


def joined(parts: list[Manifold]) -> Manifold:
    """All contacts of several manifolds of the same pairs."""
    pair, feature, touch = zip(*parts)
    return Manifold(np.concatenate(pair), np.concatenate(feature), Touch(*map(np.concatenate, zip(*touch))))


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


def sphere_sphere(first: Spheres, second: Spheres) -> Touch:
    """Concentric spheres are parted along z."""
    return Touch(*spheres_spheres(*first, *second))


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


def balls_plane(center: Floats, radius: Floats, plane: Planes, delta: Floats) -> Manifold:
    """Bodies with balls of centres (m, k, 3) and radii (m,), and half spaces; the features are the numbers of the
    balls."""
    gap = np.einsum("mki,mi->mk", center - plane.origin[:, None], plane.outward) - radius[:, None]
    pair, feature = np.nonzero(gap <= delta[:, None])
    gap, normal = gap[pair, feature], -plane.outward[pair]
    ahead = radius[pair] + 0.5 * gap
    return Manifold(pair, feature, Touch(center[pair, feature] + ahead[:, None] * normal, normal, gap))


def sphere_box(ball: Spheres, box: Boxes) -> Touch:
    """A centre inside the box is pushed out through the nearest face."""
    return Touch(*spheres_boxes(*ball, box.center, box.turn.reshape(-1, 9), box.half))


def end_ball(capsule: Capsules, side: float) -> Spheres:
    """The balls at the end (side 1) or the start (side -1) of the cores."""
    return Spheres(capsule.center + (side * capsule.half_length)[:, None] * capsule.axis, capsule.radius)


def capsule_plane(capsule: Capsules, plane: Planes, delta: Floats) -> Manifold:
    """The two end balls, features 0 and 1."""
    ends = np.stack([end_ball(capsule, side).center for side in (-1.0, 1.0)], axis=1)
    return balls_plane(ends, capsule.radius, plane, delta)


def capsule_capsule(first: Capsules, second: Capsules, delta: Floats) -> Manifold:
    """Features 0 and 1 are the end balls of the first capsule that lie beside the core of the second, 2 and 3 those of
    the second beside the core of the first. Where none of them is as close as the capsules are, feature 4 is the
    closest point, at the crossing of the cores or between two ends.
    """
    ends, beside = [], []
    for one, two, margin in ((first, second, SNAP), (second, first, -SNAP)):
        for side in (-1.0, 1.0):
            ball = end_ball(one, side)
            touch = sphere_capsule(ball, two)
            ends.append(touch if one is first else reversed_touch(touch))
            slack = margin * (first.half_length + second.half_length)
            beside.append(np.abs(dot(ball.center - two.center, two.axis)) <= two.half_length + slack)

    crossing = _crossing(first, second)
    closest = _least([*ends, crossing])
    lowest = np.min([np.where(mask, end.gap, np.inf) for end, mask in zip(ends, beside)], axis=0)
    distinct = lowest > closest.gap + DISTINCT * np.minimum(first.radius, second.radius)
    return manifold(delta, [*ends, closest], [*beside, distinct])


def capsule_box(capsule: Capsules, box: Boxes, delta: Floats) -> Manifold:
    """A capsule that lies over a face touches it at both ends of the stretch that is over the face, features 0 and 1.
    Where neither is as close as the capsule is, feature 2 is the point where it is closest to the box. A core that
    meets the box is pushed out through the face for which that is the shortest way.
    """
    (center, axis, half_length, radius), turn, half = capsule, box.turn, box.half
    rows = np.arange(len(center))
    middle = ((center - box.center)[:, None, :] @ turn)[:, 0]
    reach = half_length[:, None] * (axis[:, None, :] @ turn)[:, 0]
    start, segment = middle - reach, 2.0 * reach  # of the core, in the frame of the box

    low = np.minimum(start, start + segment)
    apart = np.concatenate([low - half, -(low + np.abs(segment)) - half], axis=1)  # of the six faces
    slack = SNAP * (half_length + half.min(axis=1))
    face = (apart >= apart.max(axis=1, keepdims=True) - SNAP * slack[:, None]).argmax(axis=1)
    k, sign = face % 3, np.where(face < 3, 1.0, -1.0)

    def ball(share: Floats) -> Spheres:
        """At shares (m,) of the way from the start of the core to its end."""
        return Spheres(center + ((2.0 * share - 1.0) * half_length)[:, None] * axis, radius)

    closest = sphere_box(ball(_closest_to_box(start, segment, half)), box)

    # The stretch of the core over the face: clipped with the slabs of the two other axes.
    enter, leave = _slabs(start, segment, half + slack[:, None])
    enter[rows, k], leave[rows, k] = 0.0, 1.0
    begin, end = np.maximum(enter.max(axis=1), 0.0), np.minimum(leave.min(axis=1), 1.0)
    over = begin <= end
    normal = -sign[:, None] * turn[rows, :, k]
    stretch = []
    for place in (np.where(over, begin, 0.0), np.where(over, end, 0.0)):
        gap = sign * (start[rows, k] + place * segment[rows, k]) - half[rows, k] - radius
        stretch.append(Touch(ball(place).center + (radius + 0.5 * gap)[:, None] * normal, normal, gap))
    lowest = np.where(over, np.minimum(stretch[0].gap, stretch[1].gap), np.inf)
    meets = over & (closest.gap <= -radius)
    distinct = (lowest > closest.gap + DISTINCT * np.minimum(radius, half.min(axis=1))) & ~meets
    long = (end - begin) * half_length > slack
    return manifold(delta, [*stretch, closest], [over, over & long, distinct])


def _least(touches: list[Touch]) -> Touch:
    """For each pair the touch of the least gap."""
    best: Ints = np.argmin([touch.gap for touch in touches], axis=0)
    rows = np.arange(len(best))
    return Touch(*(np.stack(values)[best, rows] for values in zip(*touches)))


def _crossing(first: Capsules, second: Capsules) -> Touch:
    """Where both core segments have the closest point of their lines inside; the gap is infinite elsewhere."""
    center, axis, half_length, radius = first
    other, other_axis, other_half, other_radius = second
    s, t = closest_on_lines(center, axis, other, other_axis)
    normal = cross(axis, other_axis)
    sine = length(normal)
    inside = (np.abs(s) <= half_length) & (np.abs(t) <= other_half) & (sine > SNAP)
    normal = np.where(inside[:, None], normal / np.where(inside, sine, 1.0)[:, None], across(axis))
    offset = dot(other - center, normal)
    normal *= np.copysign(1.0, offset)[:, None]
    gap = np.where(inside, np.abs(offset) - radius - other_radius, np.inf)
    ahead = np.where(inside, radius + 0.5 * gap, 0.0)
    return Touch(center + np.where(inside, s, 0.0)[:, None] * axis + ahead[:, None] * normal, normal, gap)


def _slabs(start: Floats, segment: Floats, half: Floats) -> tuple[Floats, Floats]:
    """Parameters t (m, 3) between which the coordinates of start + t way (m, 3) stay within +-half (m, 3), each; the
    first is the greater where one never does."""
    moving = np.abs(segment) > 1e-12 * half
    divisor = np.where(moving, segment, 1.0)
    one, two = (-half - start) / divisor, (half - start) / divisor
    outside = np.where(np.abs(start) <= half, -np.inf, np.inf)
    return np.where(moving, np.minimum(one, two), outside), np.where(moving, np.maximum(one, two), -outside)


def _closest_to_box(start: Floats, segment: Floats, half: Floats) -> Floats:
    """Parameters t in [0, 1] (m,) of the points of segments start + t way (m, 3) that are closest to boxes about the
    origin.

    The squared distance is convex in t, and its derivative is linear between the parameters at which the segment
    crosses the planes of the faces: the root is found exactly.
    """
    ends = np.tile([0.0, 1.0], (len(start), 1))
    t = np.sort(np.clip(np.concatenate([ends, *_slabs(start, segment, half)], axis=1), 0.0, 1.0), axis=1)
    place = start[:, None, :] + t[:, :, None] * segment[:, None, :]
    beyond = place - np.clip(place, -half[:, None], half[:, None])
    slope = dot(beyond, segment[:, None, :])
    rows, last = np.arange(len(t)), t.shape[1] - 1
    after = np.clip((slope <= 0.0).sum(axis=1), 1, last)  # the first crossing at which the distance grows
    before = after - 1
    rise = slope[rows, after] - slope[rows, before]
    share = np.clip(-slope[rows, before] / np.where(rise > 0.0, rise, 1.0), 0.0, 1.0)
    return t[rows, before] + share * (t[rows, after] - t[rows, before])
