"""Narrow phase of convex polyhedra, boxes among them, compiled.

The planes of the faces, and where those overlap the common normals of edges, give the axis along which two polyhedra
are furthest apart, or overlap least (Gottschalk, Lin, Manocha 1996, "OBBTree"; which edges make a face of the
Minkowski difference, Gregorius 2013, "The separating axis test between convex polyhedra"). Where that is the normal of
a face, the face is laid over the face of the other that looks back at it, and the corners of the polygon that they
share are contacts. Otherwise two edges cross in one point, or corners are nearest to edges or corners.

Edges along edges and corners on corners have many axes along which they overlap as little. So what is not well within a
face has the direction in which the two polyhedra are closest without a thin skin (the distance is that of Gilbert,
Johnson, Keerthi 1988). That is the axis itself where there is one, the mean of those that tie, and continuous between:
convex bodies that are apart have one direction, which is a continuous function of where they are.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import NamedTuple

import numpy as np

from dem.arrays import Floats, Ints
from dem.bodies import POLYHEDRON
from dem.compiled import inlined, inner, loop
from dem.contact.narrow import CORNERS, ContactBuffer, Manifold, Planes, Spheres
from dem.contact.simplex import CLOSE, ROUND, SNAP, nearer, no_simplex
from dem.contact.spheres import frame_of
from dem.geometry.vectors import dot, plus
from dem.shapes.forms import Form
from dem.shapes.polyhedra import Faces, Solid, hull

#: Polyhedra touch on faces if the smallest gap there is within this share of the contact distance of their distance; if
#: not, in the closest points alone.
FLUSH = 0.1

#: Lengths that differ by less than this share of the lesser half thickness are equal: what is chosen among equals does
#: not depend on rounding.
TIE = 1e-9

#: Edges whose angle has a sine below this are parallel and have no normal in common.
PARALLEL = 1e-5

#: The polyhedra of a pair, of the type of a count: loops would be compiled once more for literal numbers.
FIRST, SECOND = np.int64(0), np.int64(1)


class Hulls(NamedTuple):
    """The different polyhedra of a scene, `dem.shapes.polyhedra.Faces` of each in rows of the same lengths."""

    radius: Floats  #: (h,) of the spheres about their origins that enclose them
    inner: Floats  #: (h,) of the spheres about their origins within them, over `radius`
    sharp: Floats  #: (h,) how far a vertex moves at most where the faces move in by one
    counts: Ints  #: (h, 3) vertices, faces, edges
    vertex: Floats  #: (h, v, 3)
    normal: Floats  #: (h, f, 3)
    corner: Ints  #: (h, f, s)
    side: Ints  #: (h, f, s)
    edge: Ints  #: (h, e, 2)
    wing: Ints  #: (h, e, 2)
    inset: Floats  #: (h, v, 3) by which the vertices move there

    @property
    def features(self) -> int:
        """Of a pair: a corner of the first, a corner of the second, two edges."""
        return 2 * self.vertex.shape[1] + self.edge.shape[1] ** 2

    def tables(self) -> tuple[tuple[Floats, Ints, Floats, Floats], tuple[Ints, Ints, Ints, Ints], Floats]:
        """Vertices and faces, what they share, and insets, as loops take them."""
        return self[2:6], self[6:10], self.inset


@cache
def hulls_of(forms: tuple[Form, ...]) -> Hulls:
    """The box of half extents one, which is number 0, and these; of forms that are no polyhedra that box again."""
    box = hull(CORNERS)
    each = [box, *(form.faces if isinstance(form, Solid) else box for form in forms)]
    counts = np.array([(len(own.vertex), len(own.normal), len(own.edge)) for own in each])

    def padded(columns: Sequence[np.ndarray]) -> np.ndarray:
        shape = np.max([column.shape for column in columns], axis=0)
        out = np.full((len(columns), *shape), -1, columns[0].dtype)
        for row, column in zip(out, columns):
            row[tuple(slice(n) for n in column.shape)] = column
        return out

    inset = [_inset(own) for own in each]
    sharp = np.array([np.linalg.norm(own, axis=1).max() for own in inset])
    radius = np.array([np.linalg.norm(own.vertex, axis=1).max() for own in each])
    inner = np.array([np.einsum("fk,fk->f", own.normal, own.vertex[own.corner[:, 0]]).min() for own in each]) / radius
    columns: list[Sequence[np.ndarray]] = [*([own[k] for own in each] for k in range(6)), inset]
    return Hulls(radius, inner, sharp, counts, *map(padded, columns))


def _inset(own: Faces) -> Floats:
    """Vectors (v, 3) that go by one into each of the faces at a vertex; of more than three faces in the mean."""
    faces = [own.normal[(own.corner == k).any(axis=1)] for k in range(len(own.vertex))]
    return np.array([-np.linalg.lstsq(normal, np.ones(len(normal)), rcond=1e-2)[0] for normal in faces])


class Polyhedra(NamedTuple):
    """Convex polyhedra in the world frame."""

    center: Floats  #: (m, 3) [m]
    turn: Floats  #: (m, 3, 3) from their frames to the world
    scale: Floats  #: (m, 3) of the hull along the axes of its frame; of boxes the half extents
    hull: Ints  #: (m,) rows of `hulls`
    hulls: Hulls

    def columns(self) -> tuple[Floats, Floats, Floats, Ints]:
        """Without the table of hulls, as loops take them."""
        return self[:4]


@loop
def frames_of_hulls(
    kind: Ints, center: Floats, quaternion: Floats, size: Floats, radius: Floats, rows: Ints
) -> tuple[Floats, Floats, Floats, Ints]:
    """Centres (m, 3), frames (m, 3, 3), scales (m, 3) and rows (m,) of `Hulls`, of radii (h,), of boxes and polyhedra
    in these `rows` (m,) of tables of kinds, centres, quaternions and sizes (n, ...)."""
    many = len(rows)
    place, turn, scale = np.empty((many, 3)), np.empty((many, 3, 3)), np.empty((many, 3))
    hull = np.empty(many, np.int64)
    for n in range(many):
        row = rows[n]
        hull[n], frame = max(kind[row] - POLYHEDRON + 1, 0), frame_of(quaternion[row])
        for k in range(9):
            turn[n, k // 3, k % 3] = frame[k]
        for k in range(3):
            place[n, k] = center[row, k]
            scale[n, k] = size[row, 0] / radius[hull[n]] if hull[n] > 0 else size[row, k]
    return place, turn, scale, hull


def polyhedra_polyhedra(first: Polyhedra, second: Polyhedra, delta: Floats) -> Manifold:
    """Contacts of gap at most `delta` (m,) [m]: on faces the corners of a polygon, all with the same normal.

    The features are independent of which of the two faces gives the normal.
    """
    most = 4 * first.hulls.corner.shape[2] + 2 * first.hulls.vertex.shape[1]
    done, found, room = 0, 0, 4 * len(delta) + most
    given, contacts = (*first.hulls.tables(), first.columns(), second.columns(), delta), ContactBuffer.with_room(room)
    while True:
        done, found = _pairs(*given, most, (done, found), contacts[:])
        if done == len(delta):
            return contacts.manifold(found)
        contacts = contacts.doubled()


def spheres_polyhedra(ball: Spheres, body: Polyhedra, delta: Floats) -> Manifold:
    """One contact, at the closest point; a centre inside is pushed out through the nearest face."""
    contacts, hulls = ContactBuffer.with_room(len(delta)), body.hulls
    given = ball[:], hulls.tables()[0], hulls.corner, body.columns(), delta
    return contacts.manifold(_spheres(*given, contacts[:]))


def polyhedra_planes(body: Polyhedra, plane: Planes, delta: Floats) -> Manifold:
    """The corners."""
    contacts = ContactBuffer.with_room(len(delta) * body.hulls.vertex.shape[1])
    return contacts.manifold(_planes(body.hulls.tables()[0], body.columns(), plane[:], delta, contacts[:]))


@inner
def _set(out, k, place, normal, gap):
    (x, y, z), (u, v, w) = place, normal
    out[k, 0], out[k, 1], out[k, 2], out[k, 3], out[k, 4], out[k, 5], out[k, 6] = x, y, z, u, v, w, gap


@loop
def _planes(faces, body, plane, delta, contacts):
    """Fill in the contacts of polyhedra with half spaces; their number."""
    (_, count, vertex, _), (center, turn, scale, hull) = faces, body
    (outward, origin), (pair, feature, out) = plane, contacts
    found = 0
    for m in range(len(hull)):
        h = hull[m]
        for k in range(count[h, 0]):
            gap = 0.0
            for n in range(3):
                place = center[m, n]
                for i in range(3):
                    place += turn[m, n, i] * (scale[m, i] * vertex[h, k, i])
                out[found, n] = place
                gap += (place - origin[m, n]) * outward[m, n]
            if gap <= delta[m]:
                for n in range(3):
                    out[found, n] -= 0.5 * gap * outward[m, n]
                    out[found, 3 + n] = -outward[m, n]
                out[found, 6], pair[found], feature[found] = gap, m, k
                found += 1
                if found == len(out):
                    return found
    return found


@inlined
def _place(faces, corner, body, m, place, t, both):
    """Fill in the vertices, the normals and, along these, the levels of the faces of a polyhedron, which is the first
    or the second (`t` 0 or 1) of `both`, at a place; its half thickness: how far its faces are from its centre at
    least."""
    (_, count, vertex, normal), (_, turn, scale, hull), (points, normals, level) = faces, body, both
    (x, y, z), h, thick = place, hull[m], np.inf
    for k in range(count[h, 0]):
        a, b, c = scale[m, 0] * vertex[h, k, 0], scale[m, 1] * vertex[h, k, 1], scale[m, 2] * vertex[h, k, 2]
        points[t, k, 0] = x + (turn[m, 0, 0] * a + turn[m, 0, 1] * b + turn[m, 0, 2] * c)
        points[t, k, 1] = y + (turn[m, 1, 0] * a + turn[m, 1, 1] * b + turn[m, 1, 2] * c)
        points[t, k, 2] = z + (turn[m, 2, 0] * a + turn[m, 2, 1] * b + turn[m, 2, 2] * c)
    for i in range(count[h, 1]):
        a, b, c = normal[h, i, 0] / scale[m, 0], normal[h, i, 1] / scale[m, 1], normal[h, i, 2] / scale[m, 2]
        per = 1.0 / np.sqrt(a * a + b * b + c * c)
        u = (turn[m, 0, 0] * a + turn[m, 0, 1] * b + turn[m, 0, 2] * c) * per
        v = (turn[m, 1, 0] * a + turn[m, 1, 1] * b + turn[m, 1, 2] * c) * per
        w = (turn[m, 2, 0] * a + turn[m, 2, 1] * b + turn[m, 2, 2] * c) * per
        k = corner[h, i, 0]
        normals[t, i, 0], normals[t, i, 1], normals[t, i, 2] = u, v, w
        level[t, i] = u * points[t, k, 0] + v * points[t, k, 1] + w * points[t, k, 2]
        thick = min(thick, level[t, i] - (u * x + v * y + w * z))
    return thick


@inner
def _within(points, count, inset, h, turn, m, skin, t, core):
    """Fill in where the vertices of a polyhedron are when its faces move in by the depth of its skin."""
    for k in range(count[h, 0]):
        for n in range(3):
            core[t, k, n] = points[t, k, n]
            for i in range(3):
                core[t, k, n] += skin * turn[m, n, i] * inset[h, k, i]


@inner
def _beyond(faces, normals, level, points, many, reach, tie, best, face):
    """The face whose plane is furthest from the points on its outer side, and how far that is, if it is more than
    `best`; else `best` and `face`. Ends early where it is more than the reach."""
    for f in range(faces):
        u, v, w = normals[f, 0], normals[f, 1], normals[f, 2]
        least = np.inf
        for k in range(many):
            least = min(least, u * points[k, 0] + v * points[k, 1] + w * points[k, 2])
        if least - level[f] > best + tie:
            best, face = least - level[f], f
            if best > reach:
                break
    return best, face


@inner
def _rounded(both, count, rows, axis, apart):
    """The greatest of the gaps along the normals of faces, each wider by what the normal is off the axis, to the
    second, or off its reverse, of polyhedra that are so far apart without their skins."""
    (points, normals, level), best = both, -np.inf
    for t in range(2):
        for f in range(count[rows[t], 1]):
            u, v, w = normals[t, f, 0], normals[t, f, 1], normals[t, f, 2]
            least = np.inf
            for k in range(count[rows[1 - t], 0]):
                least = min(least, u * points[1 - t, k, 0] + v * points[1 - t, k, 1] + w * points[1 - t, k, 2])
            off = 1.0 - (1.0 - 2.0 * t) * (u * axis[0] + v * axis[1] + w * axis[2])
            best = max(best, least - level[t, f] + apart * off)
    return best


@inner
def _set_heights(t, faces, normals, level, points, many, height):
    """Fill in the heights (faces, points) of points above the faces of the first or the second polyhedron."""
    for f in range(faces):
        u, v, w, at = normals[t, f, 0], normals[t, f, 1], normals[t, f, 2], level[t, f]
        for k in range(many):
            height[t, f, k] = u * points[k, 0] + v * points[k, 1] + w * points[k, 2] - at


@inner
def _may_part(t, edges, wing, height, many, least, some):
    """Fill in the edges of a polyhedron, the first or the second (`t` 0 or 1), along which the two may be apart by
    `least`, which is not positive; how many. No normal between those of the two faces at an edge parts them by more
    than a vertex of the other one is behind both faces."""
    found = 0
    for e in range(edges):
        one, other, k = height[t, wing[e, 0]], height[t, wing[e, 1]], 0
        while k < many and not (one[k] < least and other[k] < least):
            k += 1
        some[t, found] = e
        found += k == many
    return found


@inner
def _set_slopes(t, many, some, edge, faces, height, out):
    """Fill in the scalar products of these edges of the first or the second polyhedron with the normals of the other
    one."""
    for n in range(many):
        a, b = edge[some[t, n], 0], edge[some[t, n], 1]
        for f in range(faces):
            out[t, n, f] = height[1 - t, f, b] - height[1 - t, f, a]


@inner
def _crossing(both, count, sides, rows, tie, least, room):
    """How far the polyhedra are apart along the common normal of two edges, the furthest, the two edges, and the
    normal: two edges whose normals cross on the sphere make a face of the difference of the two. What parts them by
    less than `least`, which is not positive, need not be found."""
    (points, normals, level), (_, _, edge, wing), (g, h), (height, some, slopes) = both, sides, rows, room
    p, q, p_normal, own, others = points[0], points[1], normals[0], edge[g], edge[h]
    _set_heights(FIRST, count[g, 1], normals, level, q, count[h, 0], height)
    _set_heights(SECOND, count[h, 1], normals, level, p, count[g, 0], height)
    many = _may_part(FIRST, count[g, 2], wing[g], height, count[h, 0], least, some)
    more = _may_part(SECOND, count[h, 2], wing[h], height, count[g, 0], least, some)
    _set_slopes(FIRST, many, some, own, count[h, 1], height, slopes)
    _set_slopes(SECOND, more, some, others, count[g, 1], height, slopes)
    best, one, two, axis = -np.inf, -1, -1, (0.0, 0.0, 0.0)
    for m in range(many):
        e = some[0, m]
        left, right = wing[g, e, 0], wing[g, e, 1]
        a, b = own[e, 0], own[e, 1]
        x, y, z = plus(p[b], -1.0, p[a])
        square = x * x + y * y + z * z
        for n in range(more):
            d = some[1, n]
            s, t = slopes[0, m, wing[h, d, 0]], slopes[1, n, right]
            if s * slopes[0, m, wing[h, d, 1]] < 0.0 and slopes[1, n, left] * t < 0.0 and s * t < 0.0:
                c, k = others[d, 0], others[d, 1]
                i, j, k = q[k, 0] - q[c, 0], q[k, 1] - q[c, 1], q[k, 2] - q[c, 2]
                u, v, w = y * k - z * j, z * i - x * k, x * j - y * i
                sine = np.sqrt(u * u + v * v + w * w)
                if sine <= PARALLEL * np.sqrt(square * (i * i + j * j + k * k)):
                    continue
                out = u * (p_normal[left, 0] + p_normal[right, 0]) + v * (p_normal[left, 1] + p_normal[right, 1])
                per = np.copysign(1.0 / sine, out + w * (p_normal[left, 2] + p_normal[right, 2]))
                u, v, w = u * per, v * per, w * per
                apart = u * (q[c, 0] - p[a, 0]) + v * (q[c, 1] - p[a, 1]) + w * (q[c, 2] - p[a, 2])
                if apart > best + tie:
                    best, one, two, axis = apart, e, d, (u, v, w)
    return best, (one, two), axis


@inner
def _towards(t, count, corner, h, both, axis, sign, slack):
    """The face that looks along the axis, or with `sign` -1 against it, the most among those with most vertices at the
    end of that way, within the slack."""
    points, normals, far = both[0], both[1], -np.inf
    for k in range(count[h, 0]):
        far = max(far, sign * dot(axis, points[t, k]))
    best, most, face = -np.inf, 0, 0
    for f in range(count[h, 1]):
        foremost = 0
        for s in range(corner.shape[2]):
            if corner[h, f, s] < 0:
                break
            foremost += sign * dot(axis, points[t, corner[h, f, s]]) >= far - slack
        ahead = sign * dot(axis, normals[t, f])
        if foremost > most or (foremost == most and ahead > best + TIE):
            best, most, face = ahead, foremost, f
    return face


@inlined
def _polygon(t, corner, points, normal, frame, polygons):
    """Fill in the corners of a face in a frame (rows of unit vectors): two coordinates, and the height along the third
    axis; the lines of its sides, outward normal and level; and its plane, slopes and height at the origin. The number
    of corners, zero where the frame sees the face from its side. Of the second, t = 1, they turn to the right."""
    (flat, line, plane, _), sign, many = polygons, 1.0 - 2.0 * t, 0
    while many < len(corner) and corner[many] >= 0:
        k = corner[many]
        for n in range(3):
            flat[t, many, n] = dot(frame[n], points[k])
        many += 1
    for k in range(many):
        after = k + 1 if k + 1 < many else 0
        x, y = flat[t, after, 0] - flat[t, k, 0], flat[t, after, 1] - flat[t, k, 1]
        per = sign / max(np.sqrt(x * x + y * y), 1e-300)
        line[t, k, 0], line[t, k, 1] = y * per, -x * per
        line[t, k, 2] = line[t, k, 0] * flat[t, k, 0] + line[t, k, 1] * flat[t, k, 1]
    u, v, w = dot(frame[0], normal), dot(frame[1], normal), dot(frame[2], normal)
    if abs(w) < PARALLEL:
        return 0
    plane[t, 0], plane[t, 1] = -u / w, -v / w
    plane[t, 2] = flat[t, 0, 2] - plane[t, 0] * flat[t, 0, 0] - plane[t, 1] * flat[t, 0, 1]
    return many


@inlined
def _corners(t, many, others, polygons, thick, most, found, spots, code):
    """Add the places, the gaps and the numbers of the corners of one of two polygons that are over the other one, if
    the gap is at most `most`; how many there are then, and the least gap of all. A corner on a corner is one contact,
    in the middle of the two, and one of the first polygon, t = 0."""
    (flat, _, plane, beyond), sign, least = polygons, 1.0 - 2.0 * t, np.inf
    for k in range(many):
        if not _inside(beyond[t, k], others, thick):
            continue
        x, y = flat[t, k, 0], flat[t, k, 1]
        low, high = flat[t, k, 2], plane[1 - t, 0] * x + plane[1 - t, 1] * y + plane[1 - t, 2]
        twin = -1
        for n in range(others):
            u, v = flat[1 - t, n, 0] - x, flat[1 - t, n, 1] - y
            if u * u + v * v <= 4.0 * thick * thick and _inside(beyond[1 - t, n], many, thick):
                twin = n
                break
        if twin >= 0:
            if t == 1:
                continue
            u, v = flat[1, twin, 0], flat[1, twin, 1]
            low, high = 0.5 * (low + plane[0, 0] * u + plane[0, 1] * v + plane[0, 2]), 0.5 * (high + flat[1, twin, 2])
            x, y = 0.5 * (x + u), 0.5 * (y + v)
        gap = sign * (high - low)
        least = min(least, gap)
        if gap <= most:
            spots[found, 0], spots[found, 1], spots[found, 2], spots[found, 3] = x, y, 0.5 * (low + high), gap
            code[found] = k
            found += 1
    return found, least


@inner
def _inside(beyond, many, thick):
    """Whether a point is beyond none of the lines of a polygon, to a tolerance."""
    n = 0
    while n < many and beyond[n] <= thick:
        n += 1
    return n == many


@inlined
def _crossings(many, others, polygons, thick, most, found, spots, code):
    """The same of the crossings of the sides of two polygons, which have the numbers k S + n of two sides, for S in a
    row: the ends of each are on both sides of the other, none of them just on it."""
    (flat, _, _, beyond), least = polygons, np.inf
    for k in range(many):
        after = k + 1 if k + 1 < many else 0
        for n in range(others):
            then = n + 1 if n + 1 < others else 0
            i, j, s, t = beyond[0, k, n], beyond[0, after, n], beyond[1, n, k], beyond[1, then, k]
            if i * j >= 0.0 or s * t >= 0.0 or min(min(abs(i), abs(j)), min(abs(s), abs(t))) <= thick:
                continue
            i, s = i / (i - j), s / (s - t)
            low = flat[0, k, 2] + i * (flat[0, after, 2] - flat[0, k, 2])
            high = flat[1, n, 2] + s * (flat[1, then, 2] - flat[1, n, 2])
            least = min(least, high - low)
            if high - low <= most:
                spots[found, 0] = flat[0, k, 0] + i * (flat[0, after, 0] - flat[0, k, 0])
                spots[found, 1] = flat[0, k, 1] + i * (flat[0, after, 1] - flat[0, k, 1])
                spots[found, 2], spots[found, 3] = 0.5 * (low + high), high - low
                code[found] = k * beyond.shape[2] + n
                found += 1
    return found, least


@inner
def _well_inside(spots, many, corner, opposite, t, line, margin):
    """Whether the middle of places is further than the margin inside the lines of one of two polygons."""
    (h, f), x, y, n = opposite[t], 0.0, 0.0, 0
    for k in range(many):
        x, y = x + spots[k, 0] / many, y + spots[k, 1] / many
    while n < corner.shape[2] and corner[h, f, n] >= 0:
        if not line[t, n, 0] * x + line[t, n, 1] * y - line[t, n, 2] <= -margin:
            return False
        n += 1
    return True


@inner
def _overlaid(both, corner, opposite, frame, thick, most, polygons, shared):
    """The corners of the polygon that is common to two faces, seen along the third axis of the frame: how many corners
    of the first, of the second, and crossings have a gap of at most `most`, each with those before it, and the least
    gap of all; fills in these and leaves their numbers in `code`."""
    (points, normals, _), (flat, line, _, beyond), (spots, code), many, others = both, polygons, shared, FIRST, FIRST
    for t in range(2):
        h, f = opposite[t]
        many, others = others, _polygon(t, corner[h, f], points[t], normals[t, f], frame, polygons)
        if others == 0:
            return (0, 0, 0), np.inf
    for k in range(many):
        for n in range(others):
            beyond[0, k, n] = line[1, n, 0] * flat[0, k, 0] + line[1, n, 1] * flat[0, k, 1] - line[1, n, 2]
            beyond[1, n, k] = line[0, k, 0] * flat[1, n, 0] + line[0, k, 1] * flat[1, n, 1] - line[0, k, 2]
    of_first, of_both, least = FIRST, FIRST, np.inf
    for t in range(2):
        of_first = of_both
        of_both, lesser = _corners(t, many, others, polygons, thick, most, of_both, spots, code)
        least, many, others = min(least, lesser), others, many
    in_all, lesser = _crossings(many, others, polygons, thick, most, of_both, spots, code)
    return (of_first, of_both, in_all), min(least, lesser)


@inner
def _distance(p, q, apart, reach, size, simplex):
    """How many points of the difference of two polyhedra that do not overlap span what is nearest to the origin, and
    the distance, or that it is more than the reach: zero and inf. Fills in the points, the rows of the vertices of
    both, and the shares of the points. `apart`: a vector from about the first to about the second."""
    (x, y, z), (point, ends, _, _), count, square = apart, simplex, np.int64(0), np.inf
    for _ in range(64):
        least, most, i, j = np.inf, -np.inf, 0, 0
        for k in range(len(p)):
            ahead = x * p[k, 0] + y * p[k, 1] + z * p[k, 2]
            if ahead > most:
                most, i = ahead, k
        for k in range(len(q)):
            ahead = x * q[k, 0] + y * q[k, 1] + z * q[k, 2]
            if ahead < least:
                least, j = ahead, k
        if least - most > reach * np.sqrt(x * x + y * y + z * z):
            return 0, np.inf
        if count > 0 and square - (least - most) <= 1e-12 * square + 4e-16 * size * np.sqrt(square):
            break
        ends[count, 0], ends[count, 1] = i, j
        for n in range(3):
            point[count, n] = q[j, n] - p[i, n]
        many, better, u, v, w = nearer(count, square, simplex)
        if not better < square:
            break
        count, square, x, y, z = many, better, u, v, w
    return count, np.sqrt(square)


@inner
def _witness(t, points, simplex, count):
    """The point of a polyhedron that has these shares of vertices."""
    (_, ends, share, _), place = simplex, (0.0, 0.0, 0.0)
    for k in range(count):
        place = plus(place, share[k], points[t, ends[k, t]])
    return place


@inner
def _surface(t, points, simplex, count, core, axis, skin):
    """The place of a polyhedron outside of a place `core` of it without its skin, which has these shares of vertices;
    the vertex of the greatest share, and another one, -1 if there is none. The axis looks from the first, t = 0."""
    (_, ends, share, _), one, two, three, most = simplex, -1, -1, -1, 0.0
    for k in range(count):
        if share[k] > most:
            one, most = ends[k, t], share[k]
    for k in range(count):
        if ends[k, t] != one and ends[k, t] != two:
            two, three = ends[k, t], two
    if three >= 0:
        return one, two, plus(core, skin - 2.0 * t * skin, axis)
    return one, two, _foot(points[t, one], points[t, two if two >= 0 else one], core)


@inner
def _foot(a, b, point):
    """The point of the line from a to b that is closest to a point, between the two."""
    u, v, w = b[0] - a[0], b[1] - a[1], b[2] - a[2]
    square = u * u + v * v + w * w
    t = (point[0] - a[0]) * u + (point[1] - a[1]) * v + (point[2] - a[2]) * w
    t = min(max(t / square, 0.0), 1.0) if square > 0.0 else 0.0
    return a[0] + t * u, a[1] + t * v, a[2] + t * w


@inner
def _separates(p, q, one, two, distance):
    """Whether polyhedra are apart along the vector between two places, of that length, which may be within both."""
    x, y, z = plus(two, -1.0, one)
    most, least = -np.inf, np.inf
    for k in range(len(p)):
        most = max(most, x * p[k, 0] + y * p[k, 1] + z * p[k, 2])
    for k in range(len(q)):
        least = min(least, x * q[k, 0] + y * q[k, 1] + z * q[k, 2])
    return least - most > 0.5 * distance * distance


@inner
def _edge_of(edge, h, many, one, two):
    """The number of the edge between two vertices, -1 if there is none."""
    for e in range(many):
        a, b = edge[h, e, 0], edge[h, e, 1]
        if (a == one and b == two) or (a == two and b == one):
            return e
    return -1


@inner
def _on_edges(t, skins, cores, edge, axis, limits, found, contacts):
    """Add the vertices of a polyhedron, the first or the second (`t` 0 or 1), of those that are foremost towards the
    other one along the axis within the slack, that are at most `most` from edges of that one, which has such vertices
    too, and not beside their ends by more than `end`; the new number of contacts, and the least distance. Distances are
    those of the cores, places those of the vertices and edges outside. `limits` are slack, `most` and `end`."""
    (slack, most, end), (_, feature, out), sign = limits, contacts, 1.0 - 2.0 * t
    (points, others), front, back, least = cores, -np.inf, np.inf, np.inf
    for k in range(len(points)):
        front = max(front, sign * dot(axis, points[k]))
    for k in range(len(others)):
        back = min(back, sign * dot(axis, others[k]))
    for k in range(len(points)):
        if sign * dot(axis, points[k]) < front - slack:
            continue
        best, one, two, way = _nearest_edge(points[k], others, edge, axis, sign, back + slack)
        gap = np.sqrt(best)
        if one == two:  # on a corner, along the axis, or beside it
            ahead = dot(axis, way)
            if best - ahead * ahead > end * end:
                continue
            gap, way = abs(ahead), (ahead * axis[0], ahead * axis[1], ahead * axis[2])
        if gap <= most:
            least, per, tip = min(least, gap), sign / gap, skins[t, k]
            place = _midway(_foot(skins[1 - t, one], skins[1 - t, two], tip), tip)
            _set(out, found, place, (way[0] * per, way[1] * per, way[2] * per), gap)
            feature[found] = t * skins.shape[1] + k
            found += 1
    return found, least


@inner
def _nearest_edge(point, others, edge, axis, sign, most):
    """Of the edges of a polyhedron, of which no end is further along the axis than `most`, the one nearest to a point:
    its squared distance, the ends, which are the same where the nearest is one of them, and the way to it."""
    best, one, two, way = np.inf, 0, 0, (0.0, 0.0, 0.0)
    for e in range(len(edge)):
        a, b = edge[e, 0], edge[e, 1]
        if min(sign * dot(axis, others[a]), sign * dot(axis, others[b])) > most:
            continue
        u, v, w = plus(others[b], -1.0, others[a])
        i, j, s = plus(point, -1.0, others[a])
        t = min(max((i * u + j * v + s * w) / (u * u + v * v + w * w), 0.0), 1.0)
        i, j, s = t * u - i, t * v - j, t * w - s
        square = i * i + j * j + s * s
        if square < best:
            best, way = square, (i, j, s)
            one, two = b if t == 1.0 else a, a if t == 0.0 else b
    return best, one, two, way


@inner
def _frame(normal, sign, one, other, frame):
    """Fill in a normal as the third axis, and two across it; the way from one point to the other is across it."""
    x, y, z = other[0] - one[0], other[1] - one[1], other[2] - one[2]
    per = 1.0 / np.sqrt(x * x + y * y + z * z)
    x, y, z = x * per, y * per, z * per
    u, v, w = sign * normal[0], sign * normal[1], sign * normal[2]
    frame[0, 0], frame[0, 1], frame[0, 2] = x, y, z
    frame[1, 0], frame[1, 1], frame[1, 2] = v * z - w * y, w * x - u * z, u * y - v * x
    frame[2, 0], frame[2, 1], frame[2, 2] = u, v, w


@inlined
def _room(faces, sides):
    """Room for a pair, the first and the second polyhedron in a row: vertices, normals and levels of their faces;
    vertices without their skins; heights, edges and slopes of these; a frame, the polygons of two faces, what these
    share; a simplex."""
    v, f, s, e = faces[2].shape[1], faces[3].shape[1], sides[0].shape[2], sides[2].shape[1]
    both, core = (np.empty((2, v, 3)), np.empty((2, f, 3)), np.empty((2, f))), np.empty((2, v, 3))
    polygons = np.empty((2, s, 3)), np.empty((2, s, 3)), np.empty((2, 3)), np.empty((2, s, s))
    shared = np.empty((4 * s, 4)), np.empty(4 * s, np.int64)
    crossed_edges = np.empty((2, f, v)), np.empty((2, e), np.int64), np.empty((2, e, f))
    return both, core, crossed_edges, np.empty((3, 3)), polygons, shared, no_simplex()


@loop
def _pairs(faces, sides, inset, first, second, delta, most, progress, contacts):
    """Add to the first contacts those of the pairs that are not done, as long as there is room for the `most` that a
    pair has; new numbers of pairs done and contacts found."""
    (sharp, count, _, _), (corner, _, edge, _), (done, found), turns = faces, sides, progress, (first[1], second[1])
    both, core, crossed_edges, frame, polygons, shared, simplex = _room(faces, sides)
    for m in range(done, len(delta)):
        if found + most > len(contacts[2]):
            return m, found
        rows, between, reach = (first[3][m], second[3][m]), plus(second[0][m], -1.0, first[0][m]), delta[m]
        size = min(
            _place(faces, corner, first, m, (0.0, 0.0, 0.0), FIRST, both),
            _place(faces, corner, second, m, between, SECOND, both),
        )
        tie, tolerance, skin = TIE * size, FLUSH * reach + 2.0 * SNAP * size, ROUND * size
        more, start, laid = skin * (sharp[rows[0]] + sharp[rows[1]]), found, 0
        flush, by = _parting_face(both, count, rows, reach, tie)
        if flush > reach:
            continue
        crossed, edges, axis = -np.inf, (-1, -1), (0.0, 0.0, 0.0)
        if flush <= CLOSE * size:  # where faces part the two, edges matter only if no face is clearly the nearest
            least = min(flush - tolerance, 0.0) - tie
            crossed, edges, axis = _crossing(both, count, sides, rows, tie, least, crossed_edges)
        apart = max(flush, crossed)
        if apart > reach:
            continue
        if flush >= apart - tolerance:  # what is well within a face has its normal
            opposite = _facing(both, count, corner, rows, by, tolerance, frame)
            parts, least = _overlaid(both, corner, opposite, frame, SNAP * size, reach, polygons, shared)
            if least <= apart + tolerance:
                laid = _lay(core.shape[1], sides, opposite, parts, shared, frame, (m, found), first[0], contacts)
                if laid == 0 or _well_inside(shared[0], laid, corner, opposite, by[0], polygons[1], more):
                    found += laid
                    continue
        if flush > CLOSE * size:  # else the direction is that of the closest points where edges and corners are round
            crossed, edges, axis = _crossing(both, count, sides, rows, tie, -np.inf, crossed_edges)
        limits = reach, tie, tolerance, skin, more, CLOSE * size
        closest = _closest_cores(both[0], (count, inset), turns, m, rows, between, limits, core, simplex)
        core_gap, way, _, _ = closest
        if core_gap == np.inf:
            continue
        if laid > 0 and (core_gap == 0.0 or dot(way, frame[2]) > 1.0 - PARALLEL):
            found += laid
            continue
        if core_gap > 0.0:
            gap = max(crossed + core_gap * (1.0 - dot(way, axis)), _rounded(both, count, rows, way, core_gap))
            found = _near_edges((both[0], core), count, edge, rows, closest, gap, limits, simplex, (found, contacts))
        elif edges[0] >= 0 and crossed >= flush - tolerance:
            found = _edges_crossed(both[0], edge, rows, edges, axis, crossed, found, contacts)
        else:
            found = _corner_in_face(both[0], count, rows, by[0], frame, flush, found, contacts)
        _complete(m, start, found, first[0], contacts)
    return len(delta), found


@inlined
def _parting_face(both, count, rows, reach, tie):
    """How far the polyhedra are apart along the normal of a face, the furthest; whose it is, the first's or the
    second's (0 or 1), and the face. Ends early where it is more than the reach."""
    (points, normals, level), flush, own, face = both, -np.inf, 0, -1
    for t in range(2):
        g, h = rows[t], rows[1 - t]
        flush, found = _beyond(count[g, 1], normals[t], level[t], points[1 - t], count[h, 0], reach, tie, flush, -1)
        if found >= 0:
            own, face = t, found
        if flush > reach:
            break
    return flush, (own, face)


@inlined
def _facing(both, count, corner, rows, by, tolerance, frame):
    """Of the first and of the second the row and the face: that which parts them and the one that looks back at it.
    Fills in the frame, of which the normal of the first is the third axis."""
    (points, normals, _), (t, face), sign = both, by, 1.0 - 2.0 * by[0]
    h = rows[t]
    _frame(normals[t, face], sign, points[t, corner[h, face, 0]], points[t, corner[h, face, 1]], frame)
    back = _towards(1 - t, count, corner, rows[1 - t], both, frame[2], -sign, tolerance)
    return ((h, face), (rows[1], back)) if t == 0 else ((rows[0], back), (h, face))


@inlined
def _lay(vertices, sides, opposite, parts, shared, frame, progress, center, contacts):
    """Fill in the contacts, complete, of two faces that share `parts`: corners of the first, with those of the second,
    and with crossings; how many."""
    (corner, side, edge, _), ((g, one), (h, other)), (spots, code) = sides, opposite, shared
    (m, found), (pair, feature, out) = progress, contacts
    for k in range(parts[2]):
        if k < parts[0]:
            name = corner[g, one, code[k]]
        elif k < parts[1]:
            name = vertices + corner[h, other, code[k]]
        else:
            s = corner.shape[2]
            name = 2 * vertices + edge.shape[1] * side[g, one, code[k] // s] + side[h, other, code[k] % s]
        pair[found + k], feature[found + k], out[found + k, 6] = m, name, spots[k, 3]
        for n in range(3):
            place = center[m, n]
            for i in range(3):
                place += spots[k, i] * frame[i, n]
            out[found + k, n], out[found + k, 3 + n] = place, frame[2, n]
    return parts[2]


@inner
def _closest_cores(points, tables, turns, m, rows, between, limits, core, simplex):
    """The distance of the polyhedra without their skins, inf if it is out of reach, zero where they overlap; the
    direction from the first to the second; how many points of the simplex span it, and where it ends on both. Fills in
    their vertices without skins."""
    (count, inset), (reach, _, _, skin, more, close) = tables, limits
    for t in range(2):
        _within(points, count, inset, rows[t], turns[t], m, skin, t, core)
    p, q = core[0, : count[rows[0], 0]], core[1, : count[rows[1], 0]]
    many, gap = _distance(p, q, between, reach + more, np.sqrt(dot(between, between)), simplex)
    one, two = _witness(FIRST, core, simplex, many), _witness(SECOND, core, simplex, many)
    way = (two[0] - one[0]) / gap, (two[1] - one[1]) / gap, (two[2] - one[2]) / gap
    if gap < np.inf and not (gap > close and _separates(p, q, one, two, gap)):
        gap = 0.0
    return gap, way, many, (one, two)


@inner
def _near_edges(points, count, edge, rows, closest, gap, limits, simplex, contacts):
    """Add the contacts of this gap of polyhedra that are apart without their skins, if it is within reach: vertices
    near edges, and the closest points if these are closer; the new number of contacts."""
    (skins, core), (core_gap, axis, _, _), (reach, tie, tolerance, skin, _, _) = points, closest, limits
    (start, contacts), least = contacts, np.inf
    if gap > reach:
        return start
    own, found, near = start, start, (tolerance, core_gap + min(tolerance, reach - gap), skin)
    for t in range(2):
        own, g, h = found, rows[t], rows[1 - t]
        cores = core[t, : count[g, 0]], core[1 - t, : count[h, 0]]
        found, lesser = _on_edges(t, skins, cores, edge[h, : count[h, 2]], axis, near, found, contacts)
        least = min(least, lesser)
    found = _each_once(contacts, start, own, found, 2.0 * skin)
    if core_gap < least - tie:
        found = _add_closest(skins, (count, edge), rows, closest, skin, simplex, (start, found), contacts)
    for k in range(start, found):
        contacts[2][k, 6] += gap - core_gap
    return found


@inner
def _add_closest(points, tables, rows, closest, skin, simplex, progress, contacts):
    """Add the closest points, or put them in the place of the contact that has their name; the new number."""
    (count, edge), (core_gap, axis, many, (one, two)), (at, found) = tables, closest, progress
    _, feature, out = contacts
    i, k, place = _surface(FIRST, points, simplex, many, one, axis, skin)
    j, n, other = _surface(SECOND, points, simplex, many, two, axis, skin)
    one_edge = _edge_of(edge, rows[0], count[rows[0], 2], i, k)
    other_edge = _edge_of(edge, rows[1], count[rows[1], 2], j, n)
    name = i
    if k >= 0 and n < 0:
        name = points.shape[1] + j
    elif one_edge >= 0 and other_edge >= 0:
        name = 2 * points.shape[1] + edge.shape[1] * one_edge + other_edge
    while at < found and feature[at] != name:
        at += 1
    feature[at] = name
    _set(out, at, _midway(place, other), axis, core_gap)
    return max(found, at + 1)


@inlined
def _midway(a, b):
    return 0.5 * (a[0] + b[0]), 0.5 * (a[1] + b[1]), 0.5 * (a[2] + b[2])


@inner
def _edges_crossed(points, edge, rows, edges, axis, gap, found, contacts):
    """Add the contact of two edges whose common normal is the axis; the new number of contacts."""
    (g, h), (one, two), (_, feature, out) = rows, edges, contacts
    a, b, c, d = edge[g, one, 0], edge[g, one, 1], edge[h, two, 0], edge[h, two, 1]
    place = _between(points[0, a], points[0, b], points[1, c], points[1, d])
    feature[found] = 2 * points.shape[1] + edge.shape[1] * one + two
    _set(out, found, place, axis, gap)
    return found + 1


@inner
def _corner_in_face(points, count, rows, own, frame, gap, found, contacts):
    """Add the foremost corner in a face that the faces of the other one, seen from it, are all too steep for; the new
    number of contacts."""
    sign, best, tip, t, (_, feature, out), axis = 1.0 - 2.0 * own, np.inf, 0, 1 - own, contacts, frame[2]
    for n in range(count[rows[t], 0]):
        ahead = sign * dot(axis, points[t, n])
        if ahead < best:
            best, tip = ahead, n
    feature[found] = t * points.shape[1] + tip
    _set(out, found, plus(points[t, tip], -(0.5 * sign * gap), axis), (axis[0], axis[1], axis[2]), gap)
    return found + 1


@inner
def _complete(m, start, found, center, contacts):
    """Fill in the pair of contacts, and move them there from around its first polyhedron."""
    for k in range(start, found):
        contacts[0][k] = m
        for n in range(3):
            contacts[2][k, n] += center[m, n]


@inner
def _each_once(contacts, start, own, found, close):
    """Leave out the contacts from `own` on that are in the place of one from `start` on; the new number of contacts."""
    (_, feature, out), to = contacts, own
    for k in range(own, found):
        is_new = True
        for n in range(start, own):
            x, y, z = out[k, 0] - out[n, 0], out[k, 1] - out[n, 1], out[k, 2] - out[n, 2]
            if not x * x + y * y + z * z > close * close:
                is_new = False
                break
        if is_new:
            feature[to] = feature[k]
            for n in range(7):
                out[to, n] = out[k, n]
            to += 1
    return to


@inner
def _between(a, b, c, d):
    """Midway of the points of two edges, from a to b and from c to d, where their lines are closest, or their ends."""
    u, v, w = b[0] - a[0], b[1] - a[1], b[2] - a[2]
    i, j, k = d[0] - c[0], d[1] - c[1], d[2] - c[2]
    x, y, z = c[0] - a[0], c[1] - a[1], c[2] - a[2]
    uu, ii, ui = u * u + v * v + w * w, i * i + j * j + k * k, u * i + v * j + w * k
    ux, ix = u * x + v * y + w * z, i * x + j * y + k * z
    square = uu * ii - ui * ui
    s = min(max((ux * ii - ix * ui) / square, 0.0), 1.0)
    t = min(max((ux * ui - ix * uu) / square, 0.0), 1.0)
    one, two = (a[0] + s * u, a[1] + s * v, a[2] + s * w), (c[0] + t * i, c[1] + t * j, c[2] + t * k)
    return _midway(one, two)


@loop
def _spheres(spheres, faces, corner, body, delta, contacts):
    """Fill in the contacts of spheres with polyhedra; their number."""
    (ball, radius), (center, _, _, hull), (pair, feature, out) = spheres, body, contacts
    (_, count, vertex, normal), simplex, middle, found = faces, no_simplex(), np.zeros((1, 3)), 0
    both = np.empty((1, vertex.shape[1], 3)), np.empty((1, normal.shape[1], 3)), np.empty((1, normal.shape[1]))
    points, normals, level = both[0][0], both[1][0], both[2][0]
    for m in range(len(hull)):
        h, reach, apart = hull[m], delta[m] + radius[m], plus(center[m], -1.0, ball[m])
        size = _place(faces, corner, body, m, apart, FIRST, both)
        gap, face = _beyond(count[h, 1], normals, level, middle, SECOND, reach, TIE * size, -np.inf, -1)
        if gap > reach:
            continue
        way = -normals[face, 0], -normals[face, 1], -normals[face, 2]
        if gap > CLOSE * size:
            many, gap = _distance(middle, points[: count[h, 0]], apart, reach, np.sqrt(dot(apart, apart)), simplex)
            if gap > reach:
                continue
            u, v, w = 0.0, 0.0, 0.0
            for k in range(many):
                u, v, w = plus((u, v, w), simplex.share[k], simplex.point[k])
            gap = np.sqrt(u * u + v * v + w * w)
            way = u / gap, v / gap, w / gap
        gap -= radius[m]
        pair[found], feature[found] = m, 0
        _set(out, found, plus(ball[m], radius[m] + 0.5 * gap, way), way, gap)
        found += 1
    return found
