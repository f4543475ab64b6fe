"""Narrow phase of convex shapes that are known by their support functions, compiled.

Two shapes touch along the direction in which their cores are closest (Gilbert, Johnson, Keerthi 1988). A core is the
shape without a skin: of a sphere the centre, of a capsule its segment, of a round shape what is left within the least
radius of curvature. So the direction is exact, also where the two overlap by less than their skins. If both have sharp
edges, all edges count as rounded by ROUND half thicknesses for it. Deeper ones are shrunk towards their centres until
they are apart. The gap is that of the supports of the true shapes along the direction.

What lies flush on both sides, ends, sides, faces and edges, is laid over each other, and the corners of what they share
are contacts with the same normal; the closest point is one of its own if none of them is as close.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import Any, NamedTuple

import numpy as np

from dem.arrays import Bools, Floats, Ints
from dem.bodies import BOX, CAPSULE, CONVEX, POLYHEDRON, SPHERE, enclosing_radius, half_thickness
from dem.compiled import inlined, loop
from dem.contact.ahead import (
    Forms,
    Moving,
    Paired,
    Poses,
    Touching,
    after_turn,
    ahead_by,
    guest_is_second,
    of_start,
    spun,
    vector_of,
)
from dem.contact.narrow import DISTINCT, ContactBuffer, Manifold, Planes, joined
from dem.contact.polyhedra import Hulls, Polyhedra, polyhedra_planes
from dem.contact.simplex import CLOSE, ROUND, SNAP, nearer, no_simplex
from dem.contact.spheres import frame_of
from dem.geometry.vectors import dot, plus
from dem.quaternion import across, cross, length
from dem.shapes import CONVEX_SHAPES
from dem.shapes.convex import ConvexForm
from dem.shapes.forms import Form

#: Cosine of the angle to the normal of a face, or sine to an edge, within which these may lie flush.
FLUSH = 0.9
EDGE = 0.2

#: A face is flat where a tilt of its direction moves the furthest point by more half thicknesses than FAR.
TILT, FAR = 1e-4, 0.01

#: Sine of the angle between lines below which they lie side by side.
PARALLEL = 0.05

#: Shares of their size to which shapes are shrunk whose cores overlap.
SHRUNK = np.array([0.9, 0.7, 0.4, 0.1])

#: What a shape is: a ball or capsule, a box, a hull, or a row of `CONVEX_SHAPES` after these.
ROD, BLOCK, HULL, OTHER = range(4)

#: Names of the contacts of a pair: points of faces, from here on crossings of their sides, points of the second, and
#: the closest point.
CROSSING, SECOND, CLOSEST = 32, 96, 128

POINTS = 64  #: of a face, and contacts of a pair, at most


class Supports(NamedTuple):
    """The forms of a scene by their numbers; rows without meaning of those that are no convex shapes of this kind."""

    what: Ints  #: (f,) OTHER and the row of `CONVEX_SHAPES`
    numbers: Floats  #: (f, 6) of the shape
    radius: Floats  #: (f,) of the sphere about it [m]
    rounding: Floats  #: (f,) least radius of curvature [m]


@cache
def supports_of(forms: tuple[Form, ...]) -> Supports:
    """Those of the forms of a scene."""
    found = Supports(np.zeros(len(forms), np.int64), np.zeros((len(forms), 6)), *np.ones((2, len(forms))))
    for n, form in enumerate(forms):
        if isinstance(form, ConvexForm):
            shape = form.shape
            found.what[n] = OTHER + CONVEX_SHAPES.index(type(shape))
            found.numbers[n, : len(shape.numbers)] = shape.numbers
            found.radius[n], found.rounding[n] = form.size[0], shape.rounding
    return found


class Solids(NamedTuple):
    """Convex shapes in the world frame."""

    center: Floats  #: (m, 3) [m]
    turn: Floats  #: (m, 3, 3) from their frames to the world
    scale: Floats  #: (m,) of the numbers
    thick: Floats  #: (m,) half thickness [m]
    what: Ints  #: (m,)
    numbers: Floats  #: (m, 6) of a ball radius and 0, of a capsule radius and half length, of a box half extents
    hull: Ints  #: (m,) rows of `hulls`
    rounding: Floats  #: (m,) [m]
    radius: Floats  #: (m,) of the spheres about the centres that enclose them [m]

    def tables(self) -> tuple[tuple[Floats, Floats, Floats, Floats], tuple[Ints, Floats, Ints, Floats]]:
        """Where they are and what they are, as loops take them."""
        return self[:4], self[4:8]

    def take(self, rows: Any) -> Solids:
        return Solids(*(column[rows] for column in self))


class Shape(NamedTuple):
    """One of the solids, within loops."""

    what: int
    numbers: Floats  #: (6,)
    turn: Floats  #: (3, 3)
    scale: float
    vertex: Floats  #: (v, 3) of its hull, as `dem.contact.polyhedra.Hulls` has it
    inset: Floats  #: (v, 3)
    normal: Floats  #: (f, 3)
    corner: Ints  #: (f, s)


class Flush(NamedTuple):
    """What of both shapes of a pair lies flush along the normal, within loops."""

    point: Floats  #: (2, POINTS, 3) in the frame of the normal
    name: Ints  #: (2, POINTS)
    flat: Floats  #: (2, POINTS, 2) the points across the normal
    slope: Floats  #: (2, 3) height and gradients of the plane or line through them
    many: Ints  #: (2,) numbers of the points
    sense: Floats  #: (2,) in which they turn
    bend: Floats  #: (2,) the radius across it where it is a line


def solids(kind: Ints, center: Floats, turn: Floats, size: Floats, hulls: Hulls, supports: Supports) -> Solids:
    """Those of rows (m,) of `dem.contact.primitives.Primitives`, with frames (m, 3, 3)."""
    what, numbers, hull, scale, rounding = _numbers_of(kind, size, hulls.radius, supports[:])
    place = np.ascontiguousarray(center), np.ascontiguousarray(turn), scale, half_thickness(kind, size)
    return Solids(*place, what, numbers, hull, rounding, enclosing_radius(kind, size))


@loop
def _numbers_of(kind, size, hull_radius, supports):
    """`what`, `numbers`, `hull`, `scale` and `rounding` of `Solids` of these kinds and sizes."""
    whats, all_numbers, radius, least = supports
    what, hull = np.zeros(len(kind), np.int64), np.zeros(len(kind), np.int64)
    numbers, scale, rounding = np.zeros((len(kind), 6)), np.ones(len(kind)), np.zeros(len(kind))
    for n in range(len(kind)):
        k, form = kind[n], kind[n] - CONVEX
        if form >= 0:
            what[n], numbers[n], scale[n] = whats[form], all_numbers[form], size[n, 0] / radius[form]
            rounding[n] = least[form] * scale[n]
            continue
        for i in range(3):
            numbers[n, i] = size[n, i]
        if k >= POLYHEDRON:
            what[n], hull[n] = HULL, k - POLYHEDRON + 1
            scale[n] = size[n, 0] / hull_radius[hull[n]]
        elif k == BOX:
            what[n] = BLOCK
        elif k in (SPHERE, CAPSULE):
            rounding[n] = size[n, 0]
    return what, numbers, hull, scale, rounding


def needles(start: Floats, end: Floats, thick: Floats) -> Solids:
    """Segments from places (m, 3) to other ones [m], to be beside bodies of these half thicknesses (m,)."""
    many, axis, numbers = len(start), 0.5 * (end - start), np.zeros((len(start), 6))
    half = length(axis)
    along = axis / half[:, None]
    one = across(along)
    turn, numbers[:, 1] = np.stack([one, cross(along, one), along], axis=2), half
    none, skin = np.zeros(many, np.int64), np.full(many, 1e-300)  # with none it would be given that of sharp edges
    return Solids(0.5 * (start + end), turn, np.ones(many), thick, none + ROD, numbers, none, skin, half)


def solids_solids(first: Solids, second: Solids, delta: Floats, hulls: Hulls) -> Manifold:
    """Contacts of gap at most `delta` (m,) [m], all with the same normal."""
    done, found, room = 0, 0, 4 * len(delta) + POINTS
    given, contacts = (*first.tables(), *second.tables(), *_tables(hulls), delta), ContactBuffer.with_room(room)
    while True:
        done, found = _pairs(*given, (done, found), contacts[:])
        if done == len(delta):
            return contacts.manifold(found)
        contacts = contacts.doubled()


def solids_planes(body: Solids, plane: Planes, delta: Floats, hulls: Hulls) -> Manifold:
    """What of the body lies flush along the plane: the points of a face or a side, and the support. Of boxes and
    polyhedra all corners."""
    cornered = (body.what == BLOCK) | (body.what == HULL)
    if not cornered.any():
        return _on_planes(body, plane, delta, hulls)
    rows, others = np.flatnonzero(cornered), np.flatnonzero(~cornered)
    scale = np.where((body.what == BLOCK)[:, None], body.numbers[:, :3], body.scale[:, None])[rows]
    own = Polyhedra(body.center[rows], body.turn[rows], scale, body.hull[rows], hulls)
    parts = [(rows, polyhedra_planes(own, Planes(*(column[rows] for column in plane)), delta[rows]))]
    if len(others):
        given = body.take(others), Planes(*(column[others] for column in plane)), delta[others]
        parts.append((others, _on_planes(*given, hulls)))
    return joined([found._replace(pair=numbers[found.pair]) for numbers, found in parts])


def flat_towards(body: Solids, outward: Floats, hulls: Hulls) -> Bools:
    """Which of the solids (m,) have a flat face towards a direction (m, 3) of the world."""
    return _flat(*body.tables(), *_tables(hulls), outward)


def _on_planes(body: Solids, plane: Planes, delta: Floats, hulls: Hulls) -> Manifold:
    contacts, (outward, origin) = ContactBuffer.with_room(len(delta) * POINTS), map(np.ascontiguousarray, plane)
    given = *body.tables(), *_tables(hulls), (outward, origin), delta
    return contacts.manifold(_planes(*given, contacts[:]))


def _tables(hulls: Hulls) -> tuple[tuple[Ints, Floats, Floats], tuple[Floats, Ints]]:
    """Those of hulls that loops take."""
    return (hulls.counts, hulls.vertex, hulls.inset), (hulls.normal, hulls.corner)


def _chain(functions: Sequence[Any]) -> Any:
    """One compiled function that calls that of a number."""
    first = functions[0]
    if len(functions) == 1:

        @inlined
        def last(which, *given):
            return first(*given)

        return last
    others = _chain(functions[1:])

    @inlined
    def one_of(which, *given):
        return first(*given) if which == 0 else others(which - 1, *given)

    return one_of


_other_support = _chain([shape.support for shape in CONVEX_SHAPES])
_other_face = _chain([shape.face for shape in CONVEX_SHAPES])
_other_rolls = _chain([shape.rolls for shape in CONVEX_SHAPES])
_other_arc = _chain([shape.arc for shape in CONVEX_SHAPES])


@inlined
def _shape(place, form, vertices, faces, m):
    """The solid of a row."""
    (_, turn, scale, _), (what, numbers, hull, _), (counts, vertex, inset) = place, form, vertices
    h, (normal, corner) = hull[m], faces
    v, f = counts[h, 0], counts[h, 1]
    own = vertex[h, :v], inset[h, :v], normal[h, :f], corner[h, :f]
    return Shape(what[m], numbers[m], turn[m], scale[m], own[0], own[1], own[2], own[3])


@loop
def _support(shape, skin, x, y, z):
    """The point of a shape without its skin that is furthest along a vector, both in its frame; in its scale."""
    what, numbers = shape.what, shape.numbers
    if what == ROD:
        per = (numbers[0] - skin) / np.sqrt(x * x + y * y + z * z)
        found = per * x, per * y, per * z + np.copysign(numbers[1], z)
    elif what == BLOCK:
        found = (
            np.copysign(numbers[0] - skin, x), np.copysign(numbers[1] - skin, y), np.copysign(numbers[2] - skin, z)
        )  # fmt: skip
    elif what == HULL:
        best, found = -np.inf, (0.0, 0.0, 0.0)
        for k in range(len(shape.vertex)):
            corner = plus(vector_of(shape.vertex[k], 0), skin, shape.inset[k])
            ahead = dot(corner, (x, y, z))
            if ahead > best:
                best, found = ahead, corner
    else:
        found = _other_support(what - OTHER, numbers, skin, x, y, z)
    return found


@inlined
def _inward(turn, v):
    """A vector of the world in the frame of a shape."""
    return (
        turn[0, 0] * v[0] + turn[1, 0] * v[1] + turn[2, 0] * v[2],
        turn[0, 1] * v[0] + turn[1, 1] * v[1] + turn[2, 1] * v[2],
        turn[0, 2] * v[0] + turn[1, 2] * v[1] + turn[2, 2] * v[2],
    )  # fmt: skip


@inlined
def _outward(turn, v):
    return (
        turn[0, 0] * v[0] + turn[0, 1] * v[1] + turn[0, 2] * v[2],
        turn[1, 0] * v[0] + turn[1, 1] * v[1] + turn[1, 2] * v[2],
        turn[2, 0] * v[0] + turn[2, 1] * v[1] + turn[2, 2] * v[2],
    )  # fmt: skip


@loop
def _furthest(shape, skin, shrunk, x, y, z):
    """The same in the world, from the centre of the shape; `skin` in metres."""
    x, y, z = _inward(shape.turn, (x, y, z))
    x, y, z = _support(shape, skin / shape.scale, x, y, z)
    x, y, z = _outward(shape.turn, (x, y, z))
    per = shrunk * shape.scale
    return per * x, per * y, per * z


@loop
def _closest(first, second, skins, shrunk, apart, reach, points, simplex):
    """How many points of the difference of two cores span what is nearest to the origin, and the vector from the first
    to the second there; zero points if they are further apart than the reach, -1 if they overlap. `apart` is the second
    centre from the first. Fills in the points of both (64, 2, 3), their rows and their shares."""
    x, y, z = apart
    (skin, other_skin), (point, ends, _, _) = skins, simplex
    if x == 0.0 and y == 0.0 and z == 0.0:
        return -1, (0.0, 0.0, 1.0)
    size, count, square, ahead = np.sqrt(dot(apart, apart)), 0, np.inf, 0.0
    for k in range(len(points)):
        a = _furthest(first, skin, shrunk, x, y, z)
        b = plus(apart, 1.0, _furthest(second, other_skin, shrunk, -x, -y, -z))
        between = plus(b, -1.0, a)
        ahead = dot(between, (x, y, z))
        if ahead > reach * np.sqrt(x * x + y * y + z * z):
            return 0, (x, y, z)
        if count > 0 and square - ahead <= 1e-15 * square + 4e-16 * size * np.sqrt(square):
            break
        for n in range(3):
            points[k, 0, n], points[k, 1, n], point[count, n] = a[n], b[n], between[n]
        ends[count, 0] = k
        many, better, u, v, w = nearer(count, square, simplex)
        if not better < square:
            break
        count, square, x, y, z = many, better, u, v, w
        if square <= (CLOSE * size) ** 2:
            return -1, (x, y, z)
    # The least that is ahead along the last direction parts the two, if it is not zero but for rounding.
    return (count if ahead > 0.5 * square else -1), (x, y, z)


@loop
def _face(shape, x, y, z, point, name):
    """As `dem.shapes.convex` says, of any shape, in its scale."""
    what, numbers = shape.what, shape.numbers
    size = np.sqrt(x * x + y * y + z * z)
    count, bend = 1, 0.0
    if what == ROD:
        if numbers[1] > 0.0 and abs(z) < EDGE * size:
            count, bend = 2, numbers[0]
            for k in range(2):
                point[k, 0], point[k, 1], name[k] = bend * x / size, bend * y / size, k
                point[k, 2] = bend * z / size + numbers[1] * (2 * k - 1)
    elif what == BLOCK:
        given, axis = (abs(x), abs(y), abs(z)), 0
        for k in range(3):
            axis = k if given[k] > given[axis] else axis
        if given[axis] > FLUSH * size:
            count = 4
        else:
            for k in range(3):
                axis = k if given[k] < given[axis] else axis
            count = 2 if given[axis] < EDGE * size else 1
        one, two, ahead = (axis + 1) % 3, (axis + 2) % 3, (x, y, z)
        for k in range(count if count > 1 else 0):
            for n in range(3):
                point[k, n] = np.copysign(numbers[n], ahead[n])
            if count == 2:
                point[k, axis] = numbers[axis] * (2 * k - 1)
            else:
                point[k, one], point[k, two] = numbers[one] * (2 * (k in (1, 2)) - 1), numbers[two] * (2 * (k > 1) - 1)
            name[k] = (point[k, 0] > 0.0) + 2 * (point[k, 1] > 0.0) + 4 * (point[k, 2] > 0.0)
    elif what == HULL:
        best, face, corner = FLUSH * size, -1, shape.corner
        for f in range(len(shape.normal)):
            ahead = dot(shape.normal[f], (x, y, z))
            if ahead > best:
                best, face = ahead, f
        if face >= 0:
            count = 0
            while count < corner.shape[1] and corner[face, count] >= 0:
                name[count] = corner[face, count]
                for n in range(3):
                    point[count, n] = shape.vertex[name[count], n]
                count += 1
    else:
        count, bend = _other_face(what - OTHER, numbers, x, y, z, point, name)
    return count, bend


@loop
def _laid(shape, side, apart, frame, flush):
    """Fill in what of a shape lies flush along a normal, the third axis of the frame, of the second (`side` 1) against
    it; how many points."""
    sign, n = 1.0 - 2.0 * side, frame[2]
    point, name, flat, slope = flush.point[side], flush.name[side], flush.flat[side], flush.slope[side]
    x, y, z = _inward(shape.turn, (sign * n[0], sign * n[1], sign * n[2]))
    count, bend = _face(shape, x, y, z, point, name)
    flush.many[side] = count
    if count < 2:
        return count
    middle = np.zeros(3)
    for k in range(count):
        place = plus(apart, shape.scale, _outward(shape.turn, point[k]))
        for i in range(3):
            point[k, i] = dot(frame[i], place)
            middle[i] += point[k, i] / count
        flat[k, 0], flat[k, 1] = point[k, 0], point[k, 1]
    a, b, c = 0.0, 0.0, 0.0
    for k in range(count):
        i = (k + 1) % count
        u, v, w = plus(point[k], -1.0, middle)
        p, q, r = plus(point[i], -1.0, middle)
        a, b, c = a + v * r - w * q, b + w * p - u * r, c + u * q - v * p
    if count == 2:
        u, v, w = point[1, 0] - point[0, 0], point[1, 1] - point[0, 1], point[1, 2] - point[0, 2]
        square = u * u + v * v
        slope[1], slope[2] = (u * w / square, v * w / square) if square > 0.0 else (0.0, 0.0)
    else:
        slope[1], slope[2] = -a / c, -b / c
    slope[0] = middle[2] - slope[1] * middle[0] - slope[2] * middle[1]
    flush.bend[side], flush.sense[side] = bend * shape.scale, np.copysign(1.0, c)
    return count


@inlined
def _height(slope, x, y):
    return slope[0] + slope[1] * x + slope[2] * y


@loop
def _within(flat, count, sense, a, b, c, d, slack):
    """The shares of the way from a, b to c, d between which it lies within a polygon, widened by the slack."""
    low, high = 0.0, 1.0
    for k in range(count):
        i = (k + 1) % count
        u, v = sense * (flat[i, 0] - flat[k, 0]), sense * (flat[i, 1] - flat[k, 1])
        side = slack * np.sqrt(u * u + v * v)
        one = u * (b - flat[k, 1]) - v * (a - flat[k, 0]) + side
        two = u * (d - flat[k, 1]) - v * (c - flat[k, 0]) + side
        if one < 0.0 and two < 0.0:
            return 1.0, 0.0
        if one < 0.0:
            low = max(low, one / (one - two))
        elif two < 0.0:
            high = min(high, one / (one - two))
    return low, high


@inlined
def _put(x, y, slope, more, reach, what, frame, found, contacts):
    """Add a contact at x, y if its gap is within reach; the number of contacts, and the gap."""
    low, high, (_, feature, out) = _height(slope[0], x, y), _height(slope[1], x, y), contacts
    gap = high - low + more
    if gap <= reach:
        for n in range(3):
            out[found, n] = x * frame[0, n] + y * frame[1, n] + 0.5 * (low + high) * frame[2, n]
            out[found, 3 + n] = frame[2, n]
        feature[found], out[found, 6] = what, gap
        found += 1
    return found, gap


@loop
def _overlaid(flush, frame, slack, reach, found, contacts):
    """Add the corners of what two faces share; the number of contacts, and the least gap."""
    _, name, flat, slope, count, sense, bend = flush
    least = np.inf
    if count[0] == 2 and count[1] == 2:
        a, b = flat[0, 0, 0], flat[0, 0, 1]
        u, v = flat[0, 1, 0] - a, flat[0, 1, 1] - b
        p, q = flat[1, 1, 0] - flat[1, 0, 0], flat[1, 1, 1] - flat[1, 0, 1]
        square, lengths = u * u + v * v, np.sqrt((u * u + v * v) * (p * p + q * q))
        if abs(u * q - v * p) > PARALLEL * lengths:
            return found, least
        one = ((flat[1, 0, 0] - a) * u + (flat[1, 0, 1] - b) * v) / square
        two = ((flat[1, 1, 0] - a) * u + (flat[1, 1, 1] - b) * v) / square
        low, high = max(min(one, two), 0.0), min(max(one, two), 1.0)
        if low > high:
            return found, least
        for k in range(1 if (high - low) * np.sqrt(square) <= slack else 2):
            t = high if k else low
            s = (t - one) / (two - one)
            x, y = a + t * u, b + t * v
            x, y = flat[1, 0, 0] + s * p - x, flat[1, 0, 1] + s * q - y  # across, to the other line
            more, per = 0.5 * (x * x + y * y) / (bend[0] + bend[1]), bend[0] / (bend[0] + bend[1])
            x, y = a + t * u + per * x, b + t * v + per * y
            found, gap = _put(x, y, slope, more, reach, k, frame, found, contacts)
            least = min(least, gap)
        return found, least
    for one in range(2):
        two = 1 - one
        if count[two] < 3 or (one == 1 and count[1] > 2):
            continue
        first = SECOND if one else 0
        sides = count[one] if count[one] > 2 else 1
        for k in range(sides):
            i = (k + 1) % count[one]
            a, b, c, d = flat[one, k, 0], flat[one, k, 1], flat[one, i, 0], flat[one, i, 1]
            low, high = _within(flat[two], count[two], sense[two], a, b, c, d, slack)
            if low > high:
                continue
            for last in range(2):
                t = high if last else low
                if last and ((sides > 1 and high == 1.0) or (high - low) * np.hypot(c - a, d - b) <= slack):
                    continue  # the next side begins there, or it is the same point
                what = CROSSING + 2 * (name[one, k] % 32) + last
                what = first + name[one, k] if low == t == 0.0 else what
                what = first + name[one, i] if last and high == 1.0 else what
                x, y = a + t * (c - a), b + t * (d - b)
                found, gap = _put(x, y, slope, 0.0, reach, what, frame, found, contacts)
                least = min(least, gap)
    if count[0] > 2 and count[1] > 2:
        for k in range(count[1]):
            x, y = flat[1, k, 0], flat[1, k, 1]
            low, high = _within(flat[0], count[0], sense[0], x, y, x, y, -slack)
            if low <= high:
                found, gap = _put(x, y, slope, 0.0, reach, SECOND + name[1, k], frame, found, contacts)
                least = min(least, gap)
    return found, least


@loop
def _across(frame):
    """Fill in two axes across the third."""
    x, y, z = frame[2]
    k = 0
    for n in range(3):
        k = n if abs(frame[2, n]) < abs(frame[2, k]) else k
    u, v, w = (0.0, z, -y) if k == 0 else (-z, 0.0, x) if k == 1 else (y, -x, 0.0)
    per = 1.0 / np.sqrt(u * u + v * v + w * w)
    u, v, w = per * u, per * v, per * w
    frame[0, 0], frame[0, 1], frame[0, 2] = u, v, w
    frame[1, 0], frame[1, 1], frame[1, 2] = y * w - z * v, z * u - x * w, x * v - y * u


@loop
def _pairs(first, form, second, other_form, vertices, faces, delta, progress, contacts):
    """Add to the first contacts those of the pairs that are not done, as long as there is room; new numbers of pairs
    done and contacts found."""
    (center, _, _, thick), (other_center, _, _, other_thick), (done, found) = first, second, progress
    rounding, other_rounding, (pair, feature, out) = form[3], other_form[3], contacts
    points, frame, simplex = np.empty((64, 2, 3)), np.empty((3, 3)), no_simplex()
    flush = Flush(
        np.empty((2, POINTS, 3)), np.empty((2, POINTS), np.int64), np.empty((2, POINTS, 2)), np.zeros((2, 3)),
        np.empty(2, np.int64), np.empty(2), np.empty(2),
    )  # fmt: skip
    share, ends, origin = simplex.share, simplex.ends, (0.0, 0.0, 0.0)
    for m in range(done, len(delta)):
        if found + POINTS > len(out):
            return m, found
        one, two = _shape(first, form, vertices, faces, m), _shape(second, other_form, vertices, faces, m)
        thin = min(thick[m], other_thick[m])
        apart = plus(vector_of(other_center[m], 0), -1.0, center[m])
        skin, other_skin = rounding[m], other_rounding[m]
        if skin + other_skin <= ROUND * thin:
            skin = max(skin, ROUND * thin) if skin == 0.0 else skin
            other_skin = max(other_skin, ROUND * thin) if other_skin == 0.0 else other_skin
        reach = delta[m] + skin + other_skin
        many, v = _closest(one, two, (skin, other_skin), 1.0, apart, reach, points, simplex)
        if many == 0:
            continue
        shrinks = 0
        while many < 0 and shrinks < len(SHRUNK):
            many, v = _closest(one, two, (0.0, 0.0), SHRUNK[shrinks], apart, np.inf, points, simplex)
            shrinks += 1
        if many < 0:
            v = apart if dot(apart, apart) > 0.0 else (0.0, 0.0, 1.0)
        per = 1.0 / np.sqrt(dot(v, v))
        x, y, z = per * v[0], per * v[1], per * v[2]
        own = _furthest(one, 0.0, 1.0, x, y, z)
        their = plus(apart, 1.0, _furthest(two, 0.0, 1.0, -x, -y, -z))
        gap = dot(plus(their, -1.0, own), (x, y, z))
        if gap > delta[m]:
            continue
        frame[2, 0], frame[2, 1], frame[2, 2] = x, y, z
        _across(frame)
        start, least = found, np.inf
        if _laid(one, 0, origin, frame, flush) > 1 and _laid(two, 1, apart, frame, flush) > 1:
            found, least = _overlaid(flush, frame, SNAP * thin, delta[m], found, contacts)
        if gap < least - DISTINCT * thin:
            middle, height = plus(own, 0.5 * gap, frame[2]), dot(own, frame[2]) + 0.5 * gap
            for k in range(many):  # of the cores; the supports of flat ones may be anywhere on them
                middle = origin if k == 0 else middle
                middle = plus(middle, 0.5 * share[k], points[ends[k, 0], 0])
                middle = plus(middle, 0.5 * share[k], points[ends[k, 0], 1])
            middle = plus(middle, height - dot(middle, frame[2]), frame[2])
            for n in range(3):
                out[found, n], out[found, 3 + n] = middle[n], frame[2, n]
            feature[found], out[found, 6] = CLOSEST, gap
            found += 1
        for k in range(start, found):
            pair[k] = m
            for n in range(3):
                out[k, n] += center[m, n]
    return len(delta), found


@loop
def _flat(body, form, vertices, faces, outward):
    """Where the furthest point goes far as the direction tilts a little, to all sides."""
    thick, frame, flat = body[3], np.empty((3, 3)), np.ones(len(outward), np.bool_)
    for m in range(len(outward)):
        shape = _shape(body, form, vertices, faces, m)
        frame[2, 0], frame[2, 1], frame[2, 2] = _inward(shape.turn, vector_of(outward[m], 0))
        _across(frame)
        for k in range(2):
            one, other = plus(frame[2], TILT, frame[k]), plus(frame[2], -TILT, frame[k])
            there = _support(shape, 0.0, one[0], one[1], one[2])
            way = plus(there, -1.0, _support(shape, 0.0, other[0], other[1], other[2]))
            flat[m] = flat[m] and dot(way, frame[k]) * shape.scale > FAR * thick[m]
    return flat


@loop
def _planes(body, form, vertices, faces, plane, delta, contacts):
    """Fill in the contacts of shapes with half spaces; their number."""
    (center, _, _, thick), (outward, origin), (pair, feature, out) = body, plane, contacts
    point, name, found = np.empty((POINTS, 3)), np.empty(POINTS, np.int64), 0
    for m in range(len(delta)):
        normal, shape = vector_of(outward[m], 0), _shape(body, form, vertices, faces, m)
        x, y, z = _inward(shape.turn, (-normal[0], -normal[1], -normal[2]))
        count, _ = _face(shape, x, y, z, point, name)
        # The support, unless it is among them, as of a face with edges.
        point[count, 0], point[count, 1], point[count, 2] = _support(shape, 0.0, x, y, z)
        name[count], least = CLOSEST, -np.inf
        for k in range(count if count > 1 else 0):
            least = max(least, dot(point[k], (x, y, z)))
        if count == 1:
            for n in range(3):
                point[0, n], name[0] = point[1, n], CLOSEST
        elif dot(point[count], (x, y, z)) > least + DISTINCT * thick[m] / shape.scale:
            count += 1
        for k in range(count):
            place = plus(vector_of(center[m], 0), shape.scale, _outward(shape.turn, point[k]))
            gap = dot(plus(place, -1.0, origin[m]), normal)
            if gap <= delta[m]:
                place = plus(place, -0.5 * gap, normal)
                for n in range(3):
                    out[found, n], out[found, 3 + n] = place[n], -normal[n]
                out[found, 6], pair[found], feature[found] = gap, m, name[k]
                found += 1
    return found


@loop
def arcs_of(
    forms: Forms, poses: Poses, inner: Floats, course: Moving, pairs: Paired, touch: Touching,
    supports: tuple[Ints, Floats, Floats, Floats],
) -> Floats:  # fmt: skip
    """Of contacts (nc,) as of `dem.contact.ahead.turn_ahead`, vectors (nc, 4, 3) from what turns with the bodies to
    their surfaces where these have the foreseen normal, guests on faces that of the start [m]: of guests at the end of
    the step and at its start, of hosts at these two. As a surface rolls on, the contact stays where its normal is.
    Zeros of points that go with the body, and of shapes of other kinds."""
    (kind, row, size, _), (center, quaternion) = forms, poses
    (place, velocity, _, _), (i, j, pair, _), (point, normal, gap, before) = course, pairs, touch
    what, numbers, radii, _ = supports
    arcs = np.zeros((len(pair), 4, 3))
    for c in range(len(pair)):
        one, two = i[pair[c]], j[pair[c]]
        swap = guest_is_second(kind[one], kind[two])
        a, b = (two, one) if swap else (one, two)
        if kind[a] < CONVEX and kind[b] < CONVEX:
            continue
        A, B, sign = row[a], row[b], -1.0 if swap else 1.0
        u, w = vector_of(velocity[A], 3), vector_of(velocity[B], 3)
        h, _ = ahead_by(a, b, forms, poses, inner, course)
        n = after_turn((sign * normal[c, 0], sign * normal[c, 1], sign * normal[c, 2]), w, h)
        middle = after_turn(plus(point[c], -1.0, place[B]), w, h)
        apart = plus(place[A], -1.0, place[B])
        apart = plus(plus(apart, h, vector_of(velocity[A], 0)), -h, vector_of(velocity[B], 0))
        for side in range(2):
            s, spin, out = (a, u, 1.0) if side == 0 else (b, w, -1.0)
            if kind[s] < CONVEX:
                continue
            f = kind[s] - CONVEX
            scale = size[s, 0] / radii[f]
            spot = plus(middle, -0.5 * out * gap[c], n)
            if side == 0:
                spot = plus(spot, -1.0, apart)
            spot = plus(spot, -1.0, after_turn(plus(center[s], -1.0, place[row[s]]), spin, h))
            ahead = (out * n[0], out * n[1], out * n[2])
            end, start = frame_of(spun(quaternion[s], spin, h)), frame_of(quaternion[s])
            x, y, z = _into(end, ahead)
            p, q, r = _into(end, spot)
            which = what[f] - OTHER
            if not _other_rolls(which, numbers[f], x, y, z, p / scale, q / scale, r / scale):
                continue
            at_end = _other_arc(which, numbers[f], x, y, z)
            first = of_start(before, c, out * sign)
            x, y, z = _into(start, first if dot(first, first) > 0.0 else ahead)
            at_start = _other_arc(which, numbers[f], x, y, z)
            if dot(at_end, at_end) == 0.0 or dot(at_start, at_start) == 0.0:
                continue
            at_end, at_start = _out_of(end, at_end), _out_of(start, at_start)
            for k in range(3):
                arcs[c, 2 * side, k], arcs[c, 2 * side + 1, k] = scale * at_end[k], scale * at_start[k]
    return arcs


@inlined
def _into(t, v):
    """A vector of the world in a frame of nine numbers."""
    return (
        t[0] * v[0] + t[3] * v[1] + t[6] * v[2], t[1] * v[0] + t[4] * v[1] + t[7] * v[2],
        t[2] * v[0] + t[5] * v[1] + t[8] * v[2],
    )  # fmt: skip


@inlined
def _out_of(t, v):
    return (
        t[0] * v[0] + t[1] * v[1] + t[2] * v[2], t[3] * v[0] + t[4] * v[1] + t[5] * v[2],
        t[6] * v[0] + t[7] * v[1] + t[8] * v[2],
    )  # fmt: skip
