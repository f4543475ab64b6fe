"""Narrow phase of solids on surfaces made of triangles: boxes, polyhedra, cylinders, superellipsoids.

Where a solid touches a surface, a corner or support of it is over a face, or an edge or a vertex of the surface is on
it. Corners are those of the solid on the plane of the face. Edges are segments without thickness, which touch a solid
as capsules do; of these contacts those stay whose direction is one in which the edge, or the vertex at its end, is
closest among the surface around it (`dem.contact.meshes`). So what lies flush on many triangles has no more contacts
than on one plane.
"""

from __future__ import annotations

import numpy as np

from dem.arrays import Bools, Floats, Ints
from dem.compiled import loop
from dem.contact.ahead import vector_of
from dem.contact.convex import CLOSEST, Solids, needles, solids_planes, solids_solids
from dem.contact.meshes import ROCKING, PlacedMesh, SurfaceContacts, each_once, within_cone
from dem.contact.narrow import Manifold, Planes
from dem.contact.narrow import dot as products
from dem.contact.polyhedra import TIE, Hulls
from dem.contact.simplex import ROUND, SNAP
from dem.geometry.vectors import cross, dot, plus
from dem.mesh import Surface, spread
from dem.quaternion import length

#: Features of a solid on a surface: those of the surface for each name of a contact, and once more.
NAMES = CLOSEST + 2


def solid_mesh(body: Solids, mesh: PlacedMesh, delta: Floats, hulls: Hulls) -> Manifold:
    """Convex shapes and one surface: corners and supports of the shapes over faces, and edges and vertices of the
    surface on the shapes."""
    surface = mesh.surface
    center, turn = (body.center - mesh.middle) @ mesh.turn, np.ascontiguousarray(mesh.turn.T @ body.turn)
    body = body._replace(center=center, turn=turn)
    row, triangle = surface.near(center, body.radius + delta)
    over = _over_faces(row, triangle, body, delta, hulls, surface)
    ridges = _on_ridges(row, triangle, body, delta, hulls, surface)
    found = SurfaceContacts(*(np.concatenate(columns) for columns in zip(over, ridges)))
    order = np.lexsort((found.feature, found.gap, found.row))
    kinds = len(surface.triangle), surface.features
    distinct = _distinct(order, found[:2], found[2:], (body.thick, body.rounding), kinds)
    return found.take(distinct).manifold(mesh)


def _over_faces(
    row: Ints, triangle: Ints, body: Solids, delta: Floats, hulls: Hulls, surface: Surface
) -> SurfaceContacts:
    """Where corners and supports of shapes are over faces, or have gone through them from the side of the centre."""
    normal, origin = surface.normal[triangle], surface.corner[triangle, 0]
    outward = np.copysign(1.0, products(body.center[row] - origin, normal))[:, None] * normal
    pair, name, touch = solids_planes(body.take(row), Planes(outward, origin), delta[row], hulls)
    if not len(pair):
        return SurfaceContacts(pair, name, *touch)
    faces, given = (surface.normal, surface.corner), (body.center, body.thick, body.rounding)
    within, edged, foot = _within_sides(row, triangle, outward, (pair, *touch[::2]), given, faces, surface.beyond)
    if len(edged):
        n, k = edged.T
        at = pair[n]
        own, start, end = row[at], surface.corner[triangle[at], k], surface.corner[triangle[at], (k + 1) % 3]
        inward = np.cross(surface.normal[triangle[at]], end - start)
        further = np.maximum(SNAP * body.thick[own], -touch.gap[n])
        side = Planes(-inward / length(inward)[:, None], start)
        reaches = np.zeros(len(n), bool)
        reaches[solids_planes(body.take(own), side, -further, hulls).pair] = True
        within[n[~reaches]] = False
    feature = triangle[pair] + name * surface.features
    return SurfaceContacts(row[pair], feature, foot, outward[pair], touch.gap).take(within)


@loop
def _within_sides(row, triangle, outward, touch, body, faces, beyond):
    """Which of the places (k,) over the planes of near triangles (m,) are contacts, inside of the sides of these; of
    those that are only if the body reaches over a side the numbers of the place and of the side (sides, 2); and the
    feet (k, 3) of all on the planes. What has gone through must be inside on the way from the centre.

    In a groove a body may have gone through both sides. What is behind a ridge, as seen from the body, is hidden.
    Beyond a ridge are corners of bodies that lie on it, further than they have gone through: without their skin they
    may be over the face, so that the ridge has no contact. What is deeper than the skin has one."""
    (pair, point, gap), (center, thicks, rounding), (normal, corner), (other, turn, back) = touch, body, faces, beyond
    within, foot = np.empty(len(pair), np.bool_), np.empty(point.shape)
    edged, count = np.empty((3 * len(pair), 2), np.int64), 0
    for n in range(len(pair)):
        own, t, up = row[pair[n]], triangle[pair[n]], vector_of(outward[pair[n]], 0)
        thick, middle, face = thicks[own], vector_of(center[own], 0), vector_of(normal[t], 0)
        at = plus(vector_of(point[n], 0), -0.5 * gap[n], up)
        foot[n, 0], foot[n, 1], foot[n, 2] = at
        if gap[n] < 0.0:
            height = dot(plus(middle, -1.0, at), up)
            at = plus(middle, height / (height - gap[n]), plus(plus(at, gap[n], up), -1.0, middle))
        shallow = rounding[own] == 0.0 and gap[n] >= -ROUND * thick
        within[n], first, sense = True, count, np.sign(dot(up, face))
        for k in range(3):
            start = vector_of(corner[t, k], 0)
            inward = cross(face, plus(vector_of(corner[t, (k + 1) % 3], 0), -1.0, start))
            size = np.sqrt(dot(inward, inward))
            inside = dot(plus(at, -1.0, start), inward) / size if size > 0.0 else -np.inf
            rises, slack, b = turn[t, k] * sense, TIE, other[t, k]
            if rises > 0.0:
                away = dot(plus(middle, -1.0, vector_of(corner[b, 0], 0)), vector_of(normal[b], 0))
                slack = -ROUND if back[t, k] * away <= 0.0 else ROUND
            if inside >= -thick * slack:
                continue
            if rises < 0.0 and shallow and inside >= -2.0 * ROUND * thick:
                edged[count, 0], edged[count, 1] = n, k
                count += 1
            else:
                within[n] = False
        if not within[n]:
            count = first
    return within, edged[:count], foot


def _on_ridges(
    row: Ints, triangle: Ints, body: Solids, delta: Floats, hulls: Hulls, surface: Surface
) -> SurfaceContacts:
    """Where edges of the surface, with the vertices at their ends, are closest to shapes, among the surface around
    them."""
    own, edge = each_once(row, surface.side[triangle], surface.ridges)
    near, start, end = _within_reach(own, edge, body.center, body.radius + delta, (surface.vertex, surface.edge))
    own, edge = own[near], edge[near]
    pair, name, touch = solids_solids(body.take(own), needles(start, end, body.thick[own]), delta[own], hulls)
    if not len(pair):
        return SurfaceContacts(pair, name, *touch)
    given = (surface.vertex, surface.edge), len(surface.triangle)
    keep, feature, place = _at_features((own, edge, pair, name), touch[:], body.thick, body.rounding, *given)
    found = SurfaceContacts(own[pair], feature, place, -touch.normal, touch.gap).take(keep)
    least = within_cone(surface, found.feature, found.away, ROCKING)
    least &= _beside(row, triangle, found, body.thick, surface)
    return _named(found, name[keep], least, body, surface)


@loop
def _within_reach(row, edge, center, reach, edges):
    """Which of edges (k,) come into reach (m,) of the bodies (m, 3) of these rows (k,), and from where to where these
    do (n, 3)."""
    vertex, ends = edges
    near, start, end, count = np.empty(len(row), np.int64), np.empty((len(row), 3)), np.empty((len(row), 3)), 0
    for n in range(len(row)):
        one = vector_of(vertex[ends[edge[n], 0]], 0)
        along = plus(vector_of(vertex[ends[edge[n], 1]], 0), -1.0, one)
        away, size = plus(vector_of(center[row[n]], 0), -1.0, one), np.sqrt(dot(along, along))
        if size == 0.0:
            continue
        foot = dot(away, along) / size
        half = np.sqrt(max(reach[row[n]] ** 2 - (dot(away, away) - foot**2), 0.0))
        low, high = max(foot - half, 0.0), min(foot + half, size)
        if low < high:
            near[count] = n
            start[count, 0], start[count, 1], start[count, 2] = plus(one, low / size, along)
            end[count, 0], end[count, 1], end[count, 2] = plus(one, high / size, along)
            count += 1
    return near[:count], start[:count], end[:count]


@loop
def _at_features(names, touch, thick, rounding, edges, faces):
    """Of contacts (k,) of bodies and edges which stay; their features: the edges, or the vertices that are close; and
    their places on these. Sharp bodies that lie on an edge have no point there that is closer than those of their
    faces."""
    (own, edge, pair, name), (point, normal, gap), (vertex, ends) = names, touch, edges
    lies = np.zeros(len(own), np.bool_)
    for n in range(len(pair)):
        lies[pair[n]] |= name[n] != CLOSEST and rounding[own[pair[n]]] == 0.0
    keep, feature, place = np.empty(len(pair), np.bool_), np.empty(len(pair), np.int64), np.empty(point.shape)
    for n in range(len(pair)):
        m = pair[n]
        keep[n], feature[n] = name[n] != CLOSEST or not lies[m], faces + edge[m]
        at = plus(vector_of(point[n], 0), 0.5 * gap[n], vector_of(normal[n], 0))
        place[n, 0], place[n, 1], place[n, 2] = at
        for k in range(2):
            v = ends[edge[m], k]
            way = plus(at, -1.0, vector_of(vertex[v], 0))
            if np.sqrt(dot(way, way)) < SNAP * thick[own[m]]:
                feature[n] = faces + len(ends) + v
    return keep, feature, place


def _named(found: SurfaceContacts, name: Ints, least: Bools, body: Solids, surface: Surface) -> SurfaceContacts:
    """Those that are the `least` (k,), with features that tell the names: of an edge several, of a vertex, at which
    several edges end, one, of sharp bodies with a face, if there is one."""
    found, name = found.take(least), name[least]
    at_vertex = found.feature >= len(surface.triangle) + len(surface.edge)
    name = np.where(at_vertex & (name != CLOSEST), 0, name)  # which edge is the closest there is a matter of rounding
    named = found.feature + (1 + name) * surface.features
    each = found.row * (NAMES * surface.features) + np.where(at_vertex, found.feature, named)
    order = np.lexsort((found.gap, (name == CLOSEST) & (body.rounding[found.row] == 0.0), each))
    each = each[order]
    first = np.ones(len(each), bool)
    first[1:] = each[1:] != each[:-1]
    return found._replace(feature=named).take(order[first])


def _beside(row: Ints, triangle: Ints, found: SurfaceContacts, thick: Floats, surface: Surface) -> Bools:
    """Which contacts of edges and vertices are closest, too, among the near triangles (n,) of their rows that they lie
    in, though these do not have them: as where the corners of one meet the side of another."""
    beside, loose = np.ones(len(found.row), bool), np.flatnonzero(surface.loose[found.feature - len(surface.triangle)])
    if not len(loose):
        return beside
    start = np.concatenate([[0], np.cumsum(np.bincount(row, minlength=len(thick)))])
    own, entry = spread(start, found.row[loose])
    own, other = loose[own], triangle[entry]
    meet = surface.closest(found.point[own], other).distance <= 1e-6 * thick[found.row[own]]
    own, other = own[meet], other[meet]
    way = surface.corner[other] - found.point[own, None]
    ahead = products(way, found.away[own, None]) > ROCKING * length(way) + 1e-6 * thick[found.row[own], None]
    beside[own[ahead.any(axis=1)]] = False
    return beside


@loop
def _distinct(order, names, touch, body, kinds):
    """Which contacts, in this order of rows and gaps, are not within SNAP half thicknesses of one of lesser gap and
    almost the same direction, nor those of a ridge beside a corner that is over a face: its direction is that of a
    corner without its skin."""
    (row, feature), (point, away, gap), (thicks, rounding), (faces, features) = names, touch, body, kinds
    hidden, twice, first = np.zeros(len(order), np.bool_), np.zeros(len(order), np.bool_), 0
    for a in range(len(order)):
        one = order[a]
        own, thick = row[one], thicks[row[one]]
        first = first if row[order[first]] == own else a
        if feature[one] % features < faces or feature[one] // features != 1 + CLOSEST or rounding[own] != 0.0:
            continue
        b = first
        while b < len(order) and row[order[b]] == own:
            two = order[b]
            way = plus(vector_of(point[one], 0), -1.0, vector_of(point[two], 0))
            beside = np.sqrt(dot(way, way)) <= 2.0 * ROUND * thick and gap[two] - gap[one] <= ROUND * thick
            hidden[one] |= beside and feature[two] % features < faces
            b += 1
    for a in range(len(order)):
        one = order[a]
        first = first if a > 0 and row[order[first]] == row[one] else a
        for b in range(first, a):
            two = order[b]
            way = plus(vector_of(point[one], 0), -1.0, vector_of(point[two], 0))
            close = np.sqrt(dot(way, way)) <= SNAP * thicks[row[one]]
            twice[one] |= close and not hidden[two] and dot(vector_of(away[one], 0), vector_of(away[two], 0)) > 0.99
    return ~(hidden | twice)
