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
from dem.compiled import inlined, loop
from dem.contact.narrow import CORNERS, ContactBuffer, Manifold, Planes, Spheres
from dem.contact.simplex import CLOSE, ROUND, SNAP, nearer, no_simplex
from dem.geometry.vectors import dot
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
        center, turn, scale = (np.ascontiguousarray(column) for column in (self.center, self.turn, self.scale))
        return center, turn, scale, self.hull


class Edges(NamedTuple):
    """A polyhedron in the world by its edges, within loops."""

    counts: Ints  #: (3,) of vertices, faces, edges
    points: Floats  #: (v, 3) its vertices
    normals: Floats  #: (f, 3)
    edge: Ints  #: (e, 2)
    wing: Ints  #: (e, 2)


class Cored(NamedTuple):
    """The same with and without its skin."""

    points: Floats  #: (v, 3)
    core: Floats  #: (v, 3)
    edge: Ints  #: (e, 2)


class Polygon(NamedTuple):
    """A face across the axis along which it is seen, within loops."""

    many: int  #: its corners
    flat: Floats  #: (s, 3) these, the height last
    beyond: Floats  #: (s, s) how far they are beyond the lines of the other polygon
    plane: Floats  #: (3,) slopes, and height at the origin


def polyhedra_polyhedra(first: Polyhedra, second: Polyhedra, delta: Floats) -> Manifold:
    """Contacts of gap at most `delta` (m,) [m]: on faces the corners of a polygon, all with the same normal.

    The features are independent of which of the two faces gives the normal.
    """
    most = 4 * first.hulls.corner.shape[2] + 2 * first.hulls.vertex.shape[1]
    done, found, room = 0, 0, 4 * len(delta) + most
    given, contacts = (*first.hulls.tables(), first.columns(), second.columns(), delta), ContactBuffer.of(room)
    while True:
        done, found = _pairs(*given, most, (done, found), contacts[:])
        if done == len(delta):
            return contacts.manifold(found)
        contacts = contacts.doubled()


def spheres_polyhedra(ball: Spheres, body: Polyhedra, delta: Floats) -> Manifold:
    """One contact, at the closest point; a centre inside is pushed out through the nearest face."""
    contacts, hulls = ContactBuffer.of(len(delta)), body.hulls
    given = ball[:], hulls.tables()[0], hulls.corner, body.columns(), delta
    return contacts.manifold(_spheres(*given, contacts[:]))


def polyhedra_planes(body: Polyhedra, plane: Planes, delta: Floats) -> Manifold:
    """The corners."""
    contacts = ContactBuffer.of(len(delta) * body.hulls.vertex.shape[1])
    return contacts.manifold(_planes(body.hulls.tables()[0], body.columns(), plane[:], delta, contacts[:]))


@loop
def _set(out, k, x, y, z, u, v, w, gap):
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


@loop
def _place(hull, place, turn, scale, points, normals, level):
    """Fill in the vertices, the normals and, along these, the levels of the faces of a polyhedron at a place; its half
    thickness: how far its faces are from its centre at least."""
    (count, vertex, normal, corner), (x, y, z) = hull, place
    for k in range(count[0]):
        a, b, c = scale[0] * vertex[k, 0], scale[1] * vertex[k, 1], scale[2] * vertex[k, 2]
        points[k, 0] = x + (turn[0, 0] * a + turn[0, 1] * b + turn[0, 2] * c)
        points[k, 1] = y + (turn[1, 0] * a + turn[1, 1] * b + turn[1, 2] * c)
        points[k, 2] = z + (turn[2, 0] * a + turn[2, 1] * b + turn[2, 2] * c)
    thick = np.inf
    for i in range(count[1]):
        a, b, c = normal[i, 0] / scale[0], normal[i, 1] / scale[1], normal[i, 2] / scale[2]
        per = 1.0 / np.sqrt(a * a + b * b + c * c)
        u = (turn[0, 0] * a + turn[0, 1] * b + turn[0, 2] * c) * per
        v = (turn[1, 0] * a + turn[1, 1] * b + turn[1, 2] * c) * per
        w = (turn[2, 0] * a + turn[2, 1] * b + turn[2, 2] * c) * per
        k = corner[i, 0]
        normals[i, 0], normals[i, 1], normals[i, 2] = u, v, w
        level[i] = u * points[k, 0] + v * points[k, 1] + w * points[k, 2]
        thick = min(thick, level[i] - (u * x + v * y + w * z))
    return thick


@loop
def _within(points, inset, turn, skin, core):
    """Fill in where the vertices of a polyhedron are when its faces move in by the depth of its skin."""
    for k in range(len(core)):
        for n in range(3):
            core[k, n] = points[k, n]
            for i in range(3):
                core[k, n] += skin * turn[n, i] * inset[k, i]


@loop
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


@loop
def _rounded(faces, normals, level, points, many, axis, sign, apart):
    """The greatest of the gaps along the normals of faces, each wider by what the normal is off the axis (`sign` -1:
    off its reverse) of polyhedra that are so far apart without their skins."""
    best = -np.inf
    for f in range(faces):
        u, v, w = normals[f, 0], normals[f, 1], normals[f, 2]
        least = np.inf
        for k in range(many):
            least = min(least, u * points[k, 0] + v * points[k, 1] + w * points[k, 2])
        off = 1.0 - sign * (u * axis[0] + v * axis[1] + w * axis[2])
        best = max(best, least - level[f] + apart * off)
    return best


@loop
def _slopes(edges, edge, points, faces, normals, out):
    """Fill in the scalar products of the edges with normals of the other polyhedron."""
    for e in range(edges):
        a, b = edge[e, 0], edge[e, 1]
        x, y, z = points[b, 0] - points[a, 0], points[b, 1] - points[a, 1], points[b, 2] - points[a, 2]
        for f in range(faces):
            out[e, f] = x * normals[f, 0] + y * normals[f, 1] + z * normals[f, 2]


@loop
def _crossing(first, second, slopes, tie, axis):
    """The two edges along whose common normal the polyhedra are furthest apart, and how far: two edges whose normals
    cross on the sphere make a face of the difference of the two. Fills in the normal, the axis."""
    (many, p, p_normal, edge, wing), (others, q, q_normal, other_edge, other_wing) = first, second
    p_slope, q_slope = slopes[0], slopes[1]
    _slopes(many[2], edge, p, others[1], q_normal, p_slope)
    _slopes(others[2], other_edge, q, many[1], p_normal, q_slope)
    best, one, two = -np.inf, -1, -1
    for e in range(many[2]):
        left, right = wing[e, 0], wing[e, 1]
        a, b = edge[e, 0], edge[e, 1]
        x, y, z = p[b, 0] - p[a, 0], p[b, 1] - p[a, 1], p[b, 2] - p[a, 2]
        square = x * x + y * y + z * z
        for d in range(others[2]):
            s, t = p_slope[e, other_wing[d, 0]], q_slope[d, right]
            if s * p_slope[e, other_wing[d, 1]] < 0.0 and q_slope[d, left] * t < 0.0 and s * t < 0.0:
                c, k = other_edge[d, 0], other_edge[d, 1]
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
                    best, one, two = apart, e, d
                    axis[0], axis[1], axis[2] = u, v, w
    return best, one, two


@loop
def _towards(many, corner, points, normals, axis, sign, slack):
    """The face that looks along the axis, or with `sign` -1 against it, the most among those with most vertices at the
    end of that way, within the slack."""
    far = -np.inf
    for k in range(many[0]):
        far = max(far, sign * dot(axis, points[k]))
    best, most, face = -np.inf, 0, 0
    for f in range(many[1]):
        foremost = 0
        for s in range(corner.shape[1]):
            if corner[f, s] < 0:
                break
            foremost += sign * dot(axis, points[corner[f, s]]) >= far - slack
        ahead = sign * dot(axis, normals[f])
        if foremost > most or (foremost == most and ahead > best + TIE):
            best, most, face = ahead, foremost, f
    return face


@inlined
def _polygon(corner, points, normal, frame, sign, flat, line, plane):
    """Fill in the corners of a face in a frame (rows of unit vectors): two coordinates, and the height along the third
    axis; the lines of its sides, outward normal and level; and its plane, slopes and height at the origin. The number
    of corners, zero where the frame sees the face from its side. `sign` is -1 where the corners turn to the right."""
    many = 0
    while many < len(corner) and corner[many] >= 0:
        k = corner[many]
        for n in range(3):
            flat[many, n] = dot(frame[n], points[k])
        many += 1
    for k in range(many):
        after = k + 1 if k + 1 < many else 0
        x, y = flat[after, 0] - flat[k, 0], flat[after, 1] - flat[k, 1]
        per = sign / max(np.sqrt(x * x + y * y), 1e-300)
        line[k, 0], line[k, 1] = y * per, -x * per
        line[k, 2] = line[k, 0] * flat[k, 0] + line[k, 1] * flat[k, 1]
    u, v, w = dot(frame[0], normal), dot(frame[1], normal), dot(frame[2], normal)
    if abs(w) < PARALLEL:
        return 0
    plane[0], plane[1] = -u / w, -v / w
    plane[2] = flat[0, 2] - plane[0] * flat[0, 0] - plane[1] * flat[0, 1]
    return many


@inlined
def _corners(polygon, opposite, sign, thick, most, spots, code):
    """Fill in the places, the gaps and the numbers of the corners of a polygon that are over another one, if the gap is
    at most `most`; how many, and the least gap of all. A corner on a corner is one contact, in the middle of the two,
    and one of the first polygon, `sign` 1."""
    (many, flat, beyond, plane), (others, other, other_beyond, other_plane) = polygon, opposite
    found, least = 0, np.inf
    for k in range(many):
        if not _inside(beyond[k], others, thick):
            continue
        x, y = flat[k, 0], flat[k, 1]
        low, high = flat[k, 2], other_plane[0] * x + other_plane[1] * y + other_plane[2]
        twin = -1
        for n in range(others):
            u, v = other[n, 0] - x, other[n, 1] - y
            if u * u + v * v <= 4.0 * thick * thick and _inside(other_beyond[n], many, thick):
                twin = n
                break
        if twin >= 0:
            if sign < 0.0:
                continue
            u, v = other[twin, 0], other[twin, 1]
            low, high = 0.5 * (low + plane[0] * u + plane[1] * v + plane[2]), 0.5 * (high + other[twin, 2])
            x, y = 0.5 * (x + u), 0.5 * (y + v)
        gap = sign * (high - low)
        least = min(least, gap)
        if gap <= most:
            spots[found, 0], spots[found, 1], spots[found, 2], spots[found, 3] = x, y, 0.5 * (low + high), gap
            code[found] = k
            found += 1
    return found, least


@loop
def _inside(beyond, many, thick):
    """Whether a point is beyond none of the lines of a polygon, to a tolerance."""
    inside = True
    for n in range(many):
        inside &= beyond[n] <= thick
    return inside


@inlined
def _crossings(polygon, opposite, thick, most, spots, code):
    """The same of the crossings of the sides of two polygons, which have the numbers k S + n of two sides, for S in a
    row: the ends of each are on both sides of the other, none of them just on it."""
    (many, flat, beyond, _), (others, other, other_beyond, _) = polygon, opposite
    found, least = 0, np.inf
    for k in range(many):
        after = k + 1 if k + 1 < many else 0
        for n in range(others):
            then = n + 1 if n + 1 < others else 0
            i, j, s, t = beyond[k, n], beyond[after, n], other_beyond[n, k], other_beyond[then, k]
            if i * j >= 0.0 or s * t >= 0.0 or min(min(abs(i), abs(j)), min(abs(s), abs(t))) <= thick:
                continue
            i, s = i / (i - j), s / (s - t)
            low = flat[k, 2] + i * (flat[after, 2] - flat[k, 2])
            high = other[n, 2] + s * (other[then, 2] - other[n, 2])
            least = min(least, high - low)
            if high - low <= most:
                spots[found, 0] = flat[k, 0] + i * (flat[after, 0] - flat[k, 0])
                spots[found, 1] = flat[k, 1] + i * (flat[after, 1] - flat[k, 1])
                spots[found, 2], spots[found, 3], code[found] = 0.5 * (low + high), high - low, k * len(beyond) + n
                found += 1
    return found, least


@loop
def _well_inside(spots, many, corner, line, margin):
    """Whether the middle of places is further than the margin inside the lines of a polygon."""
    x, y, n, inside = 0.0, 0.0, 0, True
    for k in range(many):
        x, y = x + spots[k, 0] / many, y + spots[k, 1] / many
    while n < len(corner) and corner[n] >= 0:
        inside &= line[n, 0] * x + line[n, 1] * y - line[n, 2] <= -margin
        n += 1
    return inside


@loop
def _overlaid(face, other, frame, thick, most, room, found):
    """The corners of the polygon that is common to two faces, each given by its corners, the points and its normal, and
    seen along the third axis of the frame: how many corners of the first, of the second, and crossings have a gap of at
    most `most`, and the least gap of all; fills in these and leaves their numbers in `code`."""
    (flat, line, plane, beyond), (spots, code) = room, found
    (corners, p, normal), (other_corners, q, other_normal) = face, other
    many = _polygon(corners, p, normal, frame, 1.0, flat[0], line[0], plane[0])
    others = _polygon(other_corners, q, other_normal, frame, -1.0, flat[1], line[1], plane[1])
    if many == 0 or others == 0:
        return 0, 0, 0, np.inf
    for k in range(many):
        for n in range(others):
            beyond[0, k, n] = line[1, n, 0] * flat[0, k, 0] + line[1, n, 1] * flat[0, k, 1] - line[1, n, 2]
            beyond[1, n, k] = line[0, k, 0] * flat[1, n, 0] + line[0, k, 1] * flat[1, n, 1] - line[0, k, 2]
    polygon = Polygon(many, flat[0], beyond[0], plane[0])
    opposite = Polygon(others, flat[1], beyond[1], plane[1])
    of_first, least = _corners(polygon, opposite, 1.0, thick, most, spots, code)
    of_second, lesser = _corners(opposite, polygon, -1.0, thick, most, spots[of_first:], code[of_first:])
    both = of_first + of_second
    crossed, lowest = _crossings(polygon, opposite, thick, most, spots[both:], code[both:])
    return of_first, of_second, crossed, min(least, min(lesser, lowest))


@loop
def _distance(p, q, apart, reach, size, simplex):
    """How many points of the difference of two polyhedra that do not overlap span what is nearest to the origin, and
    the distance, or that it is more than the reach: zero and inf. Fills in the points, the rows of the vertices of
    both, and the shares of the points. `apart`: a vector from about the first to about the second."""
    (x, y, z), (point, ends, _, _), count, square = apart, simplex, 0, np.inf
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


@loop
def _witness(points, ends, share, count, place):
    """Fill in the point of a polyhedron that has these shares of vertices."""
    place[0], place[1], place[2] = 0.0, 0.0, 0.0
    for k in range(count):
        for n in range(3):
            place[n] += share[k] * points[ends[k], n]


@loop
def _surface(points, ends, share, count, core, axis, skin, place):
    """Fill in the place of a polyhedron outside of a place `core` of it without its skin, which has these shares of
    vertices; the vertex of the greatest share, and another one, -1 if there is none. The axis looks outward."""
    one, two, three, most = -1, -1, -1, 0.0
    for k in range(count):
        if share[k] > most:
            one, most = ends[k], share[k]
    for k in range(count):
        if ends[k] != one:
            two = ends[k]
    for k in range(count):
        if ends[k] != one and ends[k] != two:
            three = ends[k]
    if three >= 0:
        for n in range(3):
            place[n] = core[n] + skin * axis[n]
    else:
        _foot(points[one], points[two if two >= 0 else one], core, place)
    return one, two


@loop
def _foot(a, b, point, place):
    """Fill in the point of the line from a to b that is closest to a point, between the two."""
    u, v, w = b[0] - a[0], b[1] - a[1], b[2] - a[2]
    square = u * u + v * v + w * w
    t = (point[0] - a[0]) * u + (point[1] - a[1]) * v + (point[2] - a[2]) * w
    t = min(max(t / square, 0.0), 1.0) if square > 0.0 else 0.0
    place[0], place[1], place[2] = a[0] + t * u, a[1] + t * v, a[2] + t * w


@loop
def _separates(p, q, place, distance):
    """Whether polyhedra are apart along the vector between two places, of that length, which may be within both."""
    x, y, z = place[1, 0] - place[0, 0], place[1, 1] - place[0, 1], place[1, 2] - place[0, 2]
    most, least = -np.inf, np.inf
    for k in range(len(p)):
        most = max(most, x * p[k, 0] + y * p[k, 1] + z * p[k, 2])
    for k in range(len(q)):
        least = min(least, x * q[k, 0] + y * q[k, 1] + z * q[k, 2])
    return least - most > 0.5 * distance * distance


@loop
def _edge_of(edge, one, two):
    """The number of the edge between two vertices, -1 if there is none."""
    for e in range(len(edge)):
        if (edge[e, 0] == one and edge[e, 1] == two) or (edge[e, 0] == two and edge[e, 1] == one):
            return e
    return -1


@loop
def _on_edges(body, other, axis, sign, limits, first, found, contacts):
    """Add the vertices of a polyhedron, of those that are foremost along the axis (`sign` -1: against it) within the
    slack, that are at most `most` from edges of the other one, which has such vertices too, and not beside their ends
    by more than `end`; the new number of contacts, and the least distance. Distances are those of the cores, places
    those of the vertices and edges outside. `limits` are slack, `most` and `end`; `first` is the number of the first
    vertex among the features."""
    (slack, most, end), (_, feature, out), skin, other_skin = limits, contacts, body.points, other.points
    points, others, edge = body.core, other.core, other.edge
    front, back, least = -np.inf, np.inf, np.inf
    for k in range(len(points)):
        front = max(front, sign * dot(axis, points[k]))
    for k in range(len(others)):
        back = min(back, sign * dot(axis, others[k]))
    for k in range(len(points)):
        if sign * dot(axis, points[k]) < front - slack:
            continue
        best, x, y, z, one, two = np.inf, 0.0, 0.0, 0.0, 0, 0
        for e in range(len(edge)):
            a, b = edge[e, 0], edge[e, 1]
            if min(sign * dot(axis, others[a]), sign * dot(axis, others[b])) > back + slack:
                continue
            u, v, w = others[b, 0] - others[a, 0], others[b, 1] - others[a, 1], others[b, 2] - others[a, 2]
            i, j, s = points[k, 0] - others[a, 0], points[k, 1] - others[a, 1], points[k, 2] - others[a, 2]
            t = min(max((i * u + j * v + s * w) / (u * u + v * v + w * w), 0.0), 1.0)
            i, j, s = t * u - i, t * v - j, t * w - s
            square = i * i + j * j + s * s
            if square < best:
                best, x, y, z = square, i, j, s
                one, two = b if t == 1.0 else a, a if t == 0.0 else b
        gap = np.sqrt(best)
        if one == two:  # on a corner, along the axis, or beside it
            ahead = axis[0] * x + axis[1] * y + axis[2] * z
            if best - ahead * ahead > end * end:
                continue
            gap, x, y, z = abs(ahead), ahead * axis[0], ahead * axis[1], ahead * axis[2]
        if gap <= most:
            least = min(least, gap)
            per = sign / gap
            _set(out, found, 0.0, 0.0, 0.0, x * per, y * per, z * per, gap)
            _foot(other_skin[one], other_skin[two], skin[k], out[found])
            for n in range(3):
                out[found, n] = 0.5 * (out[found, n] + skin[k, n])
            feature[found] = first + k
            found += 1
    return found, least


@loop
def _frame(normal, sign, one, other, frame):
    """Fill in a normal as the third axis, and two across it; the way from one point to the other is across it."""
    x, y, z = other[0] - one[0], other[1] - one[1], other[2] - one[2]
    per = 1.0 / np.sqrt(x * x + y * y + z * z)
    x, y, z = x * per, y * per, z * per
    u, v, w = sign * normal[0], sign * normal[1], sign * normal[2]
    frame[0, 0], frame[0, 1], frame[0, 2] = x, y, z
    frame[1, 0], frame[1, 1], frame[1, 2] = v * z - w * y, w * x - u * z, u * y - v * x
    frame[2, 0], frame[2, 1], frame[2, 2] = u, v, w


@loop
def _pairs(faces, sides, inset, first, second, delta, most, progress, contacts):
    """Add to the first contacts those of the pairs that are not done, as long as there is room for the `most` that a
    pair has; new numbers of pairs done and contacts found."""
    (sharp, count, vertex, normal), (corner, side, edge, wing) = faces, sides
    (center, turn, scale, hull), (other_center, other_turn, other_scale, other_hull) = first, second
    (done, found), (pair, feature, out) = progress, contacts
    most_v, most_f, s, most_e = vertex.shape[1], normal.shape[1], corner.shape[2], edge.shape[1]
    points, normals, level = np.empty((2, most_v, 3)), np.empty((2, most_f, 3)), np.empty((2, most_f))
    core, contacts_of_faces = np.empty((2, most_v, 3)), (np.empty((4 * s, 4)), np.empty(4 * s, np.int64))
    slopes, axis, frame, place = np.empty((2, most_e, most_f)), np.empty(3), np.empty((3, 3)), np.empty((2, 3))
    polygons = np.empty((2, s, 3)), np.empty((2, s, 3)), np.empty((2, 3)), np.empty((2, s, s))
    (_, line, _, _), (spots, code), simplex, core_place = polygons, contacts_of_faces, no_simplex(), np.empty((2, 3))
    p, q, p_normal, q_normal, p_level, q_level = points[0], points[1], normals[0], normals[1], level[0], level[1]
    for m in range(done, len(hull)):
        if found + most > len(out):
            return m, found
        g, h, reach, start = hull[m], other_hull[m], delta[m], found
        a, b, c = center[m, 0], center[m, 1], center[m, 2]
        between = other_center[m, 0] - a, other_center[m, 1] - b, other_center[m, 2] - c
        many, others = count[g], count[h]
        own, opposite = (many, vertex[g], normal[g], corner[g]), (others, vertex[h], normal[h], corner[h])
        size = min(
            _place(own, (0.0, 0.0, 0.0), turn[m], scale[m], p, p_normal, p_level),
            _place(opposite, between, other_turn[m], other_scale[m], q, q_normal, q_level),
        )
        tie, tolerance = TIE * size, FLUSH * reach + 2.0 * SNAP * size
        flush, one = _beyond(many[1], p_normal, p_level, q, others[0], reach, tie, -np.inf, -1)
        if flush > reach:
            continue
        flush, other = _beyond(others[1], q_normal, q_level, p, many[0], reach, tie, flush, -1)
        if flush > reach:
            continue

        # Where faces part the two, the edges matter only if no face is clearly the nearest.
        crossed, one_edge, other_edge = -np.inf, -1, -1
        if flush <= CLOSE * size:
            by_edges = Edges(many, p, p_normal, edge[g], wing[g]), Edges(others, q, q_normal, edge[h], wing[h])
            crossed, one_edge, other_edge = _crossing(by_edges[0], by_edges[1], slopes, tie, axis)
        apart, laid = max(flush, crossed), 0
        if apart > reach:
            continue

        # What is well within a face has its normal.
        if flush >= apart - tolerance:
            if other < 0:
                _frame(p_normal[one], 1.0, p[corner[g, one, 0]], p[corner[g, one, 1]], frame)
                last = _towards(others, corner[h], q, q_normal, frame[2], -1.0, tolerance)
            else:
                last = other
                _frame(q_normal[last], -1.0, q[corner[h, last, 0]], q[corner[h, last, 1]], frame)
                one = _towards(many, corner[g], p, p_normal, frame[2], 1.0, tolerance)
            flush_faces = (corner[g, one], p, p_normal[one]), (corner[h, last], q, q_normal[last])
            of_first, of_second, of_both, least = _overlaid(
                flush_faces[0], flush_faces[1], frame, SNAP * size, reach, polygons, contacts_of_faces
            )
            if least <= apart + tolerance:
                laid = of_first + of_second + of_both
                for k in range(laid):
                    if k < of_first:
                        feature[found + k] = corner[g, one, code[k]]
                    elif k < of_first + of_second:
                        feature[found + k] = most_v + corner[h, last, code[k]]
                    else:
                        sides = side[g, one, code[k] // s], side[h, last, code[k] % s]
                        feature[found + k] = 2 * most_v + most_e * sides[0] + sides[1]
                    out[found + k, 6] = spots[k, 3]
                    for n in range(3):
                        out[found + k, n], out[found + k, 3 + n] = center[m, n], frame[2, n]
                        for i in range(3):
                            out[found + k, n] += spots[k, i] * frame[i, n]
                lines = line[0] if other < 0 else line[1]
                corners = corner[g, one] if other < 0 else corner[h, last]
                inside = _well_inside(spots, laid, corners, lines, ROUND * size * (sharp[g] + sharp[h]))
                if laid == 0 or inside:
                    for k in range(found, found + laid):
                        pair[k] = m
                    found += laid
                    continue

        # Else the direction is that of the closest points where edges and corners are round.
        if flush > CLOSE * size:
            by_edges = Edges(many, p, p_normal, edge[g], wing[g]), Edges(others, q, q_normal, edge[h], wing[h])
            crossed, one_edge, other_edge = _crossing(by_edges[0], by_edges[1], slopes, tie, axis)
        skin, cores, ends, share = ROUND * size, (core[0, : many[0]], core[1, : others[0]]), simplex.ends, simplex.share
        _within(p, inset[g], turn[m], skin, cores[0])
        _within(q, inset[h], other_turn[m], skin, cores[1])
        extent, more = np.sqrt(dot(between, between)), skin * (sharp[g] + sharp[h])
        count_in, core_gap = _distance(cores[0], cores[1], between, reach + more, extent, simplex)
        if core_gap == np.inf:
            continue
        for t in range(2):
            _witness(cores[t], ends[:, t], share, count_in, core_place[t])
        if core_gap > CLOSE * size and _separates(cores[0], cores[1], core_place, core_gap):
            crossing = axis[0], axis[1], axis[2]
            for t in range(3):
                axis[t] = (core_place[1, t] - core_place[0, t]) / core_gap
            i, k = _surface(p, ends[:, 0], share, count_in, core_place[0], axis, skin, place[0])
            j, n = _surface(q, ends[:, 1], share, count_in, core_place[1], axis, -skin, place[1])
            if laid > 0 and dot(axis, frame[2]) > 1.0 - PARALLEL:
                for t in range(found, found + laid):
                    pair[t] = m
                found += laid
                continue
            gap = crossed + core_gap * (1.0 - dot(axis, crossing))
            gap = max(gap, _rounded(many[1], p_normal, p_level, q, others[0], axis, 1.0, core_gap))
            gap = max(gap, _rounded(others[1], q_normal, q_level, p, many[0], axis, -1.0, core_gap))
            if gap > reach:
                continue
            one_body, other_body = Cored(p, cores[0], edge[g, : many[2]]), Cored(q, cores[1], edge[h, : others[2]])
            limits = tolerance, core_gap + min(tolerance, reach - gap), skin
            found, least = _on_edges(one_body, other_body, axis, 1.0, limits, 0, found, contacts)
            own = found
            found, lesser = _on_edges(other_body, one_body, axis, -1.0, limits, most_v, found, contacts)
            found = _each_once(out, feature, start, own, found, 2.0 * skin)
            if core_gap < min(least, lesser) - tie:
                one_edge, other_edge = _edge_of(one_body.edge, i, k), _edge_of(other_body.edge, j, n)
                name = i
                if k >= 0 and n < 0:
                    name = most_v + j
                elif one_edge >= 0 and other_edge >= 0:
                    name = 2 * most_v + most_e * one_edge + other_edge
                at = start
                while at < found and feature[at] != name:
                    at += 1
                feature[at], found = name, max(found, at + 1)
                _set(
                    out, at, 0.5 * (place[0, 0] + place[1, 0]), 0.5 * (place[0, 1] + place[1, 1]),
                    0.5 * (place[0, 2] + place[1, 2]), axis[0], axis[1], axis[2], core_gap,
                )  # fmt: skip
            for k in range(start, found):
                out[k, 6] += gap - core_gap
        elif laid > 0:
            for k in range(found, found + laid):
                pair[k] = m
            found += laid
            continue
        elif one_edge >= 0 and crossed >= flush - tolerance:
            _between(
                p[edge[g, one_edge, 0]], p[edge[g, one_edge, 1]], q[edge[h, other_edge, 0]], q[edge[h, other_edge, 1]],
                place,
            )  # fmt: skip
            feature[found] = 2 * most_v + most_e * one_edge + other_edge
            _set(
                out, found, 0.5 * (place[0, 0] + place[1, 0]), 0.5 * (place[0, 1] + place[1, 1]),
                0.5 * (place[0, 2] + place[1, 2]), axis[0], axis[1], axis[2], crossed,
            )  # fmt: skip
            found += 1
        else:  # a corner in a face that the faces of the other, seen from it, are all too steep for
            sign, best, k = 1.0 if other < 0 else -1.0, np.inf, 0
            for n in range(others[0] if other < 0 else many[0]):
                ahead = sign * dot(frame[2], q[n] if other < 0 else p[n])
                if ahead < best:
                    best, k = ahead, n
            feature[found] = most_v + k if other < 0 else k
            for n in range(3):
                tip = q[k, n] if other < 0 else p[k, n]
                out[found, n], out[found, 3 + n] = tip - 0.5 * sign * flush * frame[2, n], frame[2, n]
            out[found, 6] = flush
            found += 1
        for k in range(start, found):
            pair[k] = m
            for n in range(3):
                out[k, n] += center[m, n]
    return len(hull), found


@loop
def _each_once(out, feature, start, own, found, close):
    """Leave out the contacts from `own` on that are in the place of one from `start` on; the new number of contacts."""
    to = own
    for k in range(own, found):
        alone = True
        for n in range(start, own):
            x, y, z = out[k, 0] - out[n, 0], out[k, 1] - out[n, 1], out[k, 2] - out[n, 2]
            alone &= x * x + y * y + z * z > close * close
        if alone:
            out[to], feature[to] = out[k], feature[k]
            to += 1
    return to


@loop
def _between(a, b, c, d, place):
    """Fill in the points of two edges, from a to b and from c to d, where their lines are closest, or their ends."""
    u, v, w = b[0] - a[0], b[1] - a[1], b[2] - a[2]
    i, j, k = d[0] - c[0], d[1] - c[1], d[2] - c[2]
    x, y, z = c[0] - a[0], c[1] - a[1], c[2] - a[2]
    uu, ii, ui = u * u + v * v + w * w, i * i + j * j + k * k, u * i + v * j + w * k
    ux, ix = u * x + v * y + w * z, i * x + j * y + k * z
    square = uu * ii - ui * ui
    s = min(max((ux * ii - ix * ui) / square, 0.0), 1.0)
    t = min(max((ux * ui - ix * uu) / square, 0.0), 1.0)
    for n in range(3):
        place[0, n], place[1, n] = a[n] + s * (b[n] - a[n]), c[n] + t * (d[n] - c[n])


@loop
def _spheres(spheres, faces, corner, body, delta, contacts):
    """Fill in the contacts of spheres with polyhedra; their number."""
    (ball, radius), (center, turn, scale, hull), (pair, feature, out) = spheres, body, contacts
    (_, count, vertex, normal) = faces
    points, normals, level = np.empty(vertex.shape[1:]), np.empty(normal.shape[1:]), np.empty(normal.shape[1])
    simplex, middle, found = no_simplex(), np.zeros((1, 3)), 0
    point, share = simplex.point, simplex.share
    for m in range(len(hull)):
        reach = delta[m] + radius[m]
        apart = center[m, 0] - ball[m, 0], center[m, 1] - ball[m, 1], center[m, 2] - ball[m, 2]
        h = hull[m]
        size = _place((count[h], vertex[h], normal[h], corner[h]), apart, turn[m], scale[m], points, normals, level)
        gap, face = _beyond(count[h, 1], normals, level, middle, 1, reach, TIE * size, -np.inf, -1)
        if gap > reach:
            continue
        u, v, w = -normals[face, 0], -normals[face, 1], -normals[face, 2]
        if gap > CLOSE * size:
            many, gap = _distance(middle, points[: count[h, 0]], apart, reach, np.sqrt(dot(apart, apart)), simplex)
            if gap > reach:
                continue
            u, v, w = 0.0, 0.0, 0.0
            for k in range(many):
                u, v, w = u + share[k] * point[k, 0], v + share[k] * point[k, 1], w + share[k] * point[k, 2]
            gap = np.sqrt(u * u + v * v + w * w)
            u, v, w = u / gap, v / gap, w / gap
        gap -= radius[m]
        ahead = radius[m] + 0.5 * gap
        pair[found], feature[found] = m, 0
        _set(out, found, ball[m, 0] + ahead * u, ball[m, 1] + ahead * v, ball[m, 2] + ahead * w, u, v, w, gap)
        found += 1
    return found
