"""Narrow phase of surfaces made of triangles.

The contacts of a ball are the places of the surface where the distance from its centre is least among the places
around them: over a face, on an edge or at a vertex, each once, however many triangles share it (Ericson 2005,
"Real-Time Collision Detection", section 5.1: the centre is in the Voronoi region of the feature).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from dem.arrays import Bools, Floats, Ints
from dem.contact.convex import CLOSEST, Solids, needles, solids_planes, solids_solids
from dem.contact.narrow import (
    Capsules,
    Manifold,
    Planes,
    Spheres,
    Touch,
    balls_plane,
    closest_on_lines,
    dot,
    end_ball,
    reversed_touch,
)
from dem.contact.polyhedra import TIE, Hulls
from dem.contact.simplex import ROUND, SNAP
from dem.mesh import Closest, Surface, spread
from dem.quaternion import cross, length

#: Sine of the angle by which a direction may leave those in which an edge or a vertex is closest, for rounding.
ROUNDING = 1e-6

#: The same for the side of a capsule on an edge: one that rocks a little on two edges keeps the contacts of both.
ROCKING = 0.1

#: Features of a capsule on a surface: those of the surface for each end ball, and for the core between.
PARTS = 3

#: Features of other shapes on a surface: those of the surface for each name of a contact, and once more.
NAMES = CLOSEST + 2


class PlacedMesh(NamedTuple):
    """One surface in the world."""

    surface: Surface
    middle: Floats  #: (3,) where its middle is [m]
    turn: Floats  #: (3, 3) its frame


class _SurfaceContacts(NamedTuple):
    """Contacts of bodies and one surface, in its frame."""

    row: Ints  #: (k,) of the body
    feature: Ints  #: (k,) of the surface, and more than all these for each part of a capsule before
    point: Floats  #: (k, 3) of the surface [m]
    away: Floats  #: (k, 3) unit vector from there to the body
    gap: Floats  #: (k,) [m]

    def take(self, rows: Ints | Bools) -> _SurfaceContacts:
        columns: Any = self
        return _SurfaceContacts(*(column[rows] for column in columns))

    def manifold(self, mesh: PlacedMesh) -> Manifold:
        """The same in the world."""
        between = self.point + 0.5 * self.gap[:, None] * self.away
        touch = Touch(mesh.middle + between @ mesh.turn.T, -self.away @ mesh.turn.T, self.gap)
        return Manifold(self.row, self.feature, touch)


def sphere_mesh(ball: Spheres, mesh: PlacedMesh, delta: Floats) -> Manifold:
    """Spheres and one surface."""
    local = ball._replace(center=(ball.center - mesh.middle) @ mesh.turn)
    return _feet(local, delta, mesh.surface).manifold(mesh)


def capsule_mesh(capsule: Capsules, mesh: PlacedMesh, delta: Floats) -> Manifold:
    """Capsules and one surface: the end balls, and the core between them on edges and vertices.

    A core that goes through a face is pushed back across it the shorter way.
    """
    surface, reach = mesh.surface, capsule.radius + delta
    core = capsule._replace(center=(capsule.center - mesh.middle) @ mesh.turn, axis=capsule.axis @ mesh.turn)
    parts = []
    for end, side in enumerate((-1.0, 1.0)):
        feet = _feet(end_ball(core, side), delta, surface)
        # Where the side of the capsule is clearly closer to an edge than its end is, the end is no contact.
        beyond = side * dot(feet.away, core.axis[feet.row]) <= ROCKING
        feet = feet.take((feet.feature < len(surface.triangle)) | beyond)
        parts.append(feet._replace(feature=feet.feature + end * surface.features))
    row, triangle = surface.near(core.center, core.half_length + reach)
    through = _through_faces(row, triangle, core, surface)
    parts += [_across_edges(row, triangle, core, reach, surface), _over_vertices(row, triangle, core, reach, surface)]
    found = _SurfaceContacts(*(np.concatenate(columns) for columns in zip(*parts, through)))
    # The end on the wrong side of a face that the core goes through would be held there; the first is at the start.
    short = (dot(through.away, core.axis[through.row]) < 0.0).astype(np.int64)
    stuck = PARTS * surface.features * through.row + through.feature + (short - 2) * surface.features
    return found.take(~np.isin(PARTS * surface.features * found.row + found.feature, stuck)).manifold(mesh)


def solid_mesh(body: Solids, mesh: PlacedMesh, delta: Floats, hulls: Hulls) -> Manifold:
    """Convex shapes and one surface: corners and supports of the shapes over faces, and edges and vertices of the
    surface on the shapes."""
    surface = mesh.surface
    center, turn = (body.center - mesh.middle) @ mesh.turn, np.ascontiguousarray(mesh.turn.T @ body.turn)
    body = body._replace(center=center, turn=turn)
    row, triangle = surface.near(center, body.radius + delta)
    over = _over_faces(row, triangle, body, delta, hulls, surface)
    ridges = _on_ridges(row, triangle, body, delta, hulls, surface)
    found = _SurfaceContacts(*(np.concatenate(columns) for columns in zip(over, ridges)))
    return found.take(_distinct(found, body, surface)).manifold(mesh)


def _over_faces(
    row: Ints, triangle: Ints, body: Solids, delta: Floats, hulls: Hulls, surface: Surface
) -> _SurfaceContacts:
    """Where corners and supports of shapes are over faces, or have gone through them from the side of the centre."""
    normal, origin, center = surface.normal[triangle], surface.corner[triangle, 0], body.center[row]
    outward = np.copysign(1.0, dot(center - origin, normal))[:, None] * normal
    pair, name, touch = solids_planes(body.take(row), Planes(outward, origin), delta[row], hulls)
    row, triangle, outward, center, gap = row[pair], triangle[pair], outward[pair], center[pair], touch.gap
    foot = touch.point - 0.5 * gap[:, None] * outward
    deep = np.flatnonzero(gap < 0.0)  # the way from the centre must go through the triangle
    share = (height := dot((center - foot)[deep], outward[deep])) / (height - gap[deep])
    way = foot.copy()
    way[deep] = center[deep] + share[:, None] * (foot + gap[:, None] * outward - center)[deep]
    found = _SurfaceContacts(row, triangle + name * surface.features, foot, outward, gap)
    return found.take(_within_sides(row, triangle, outward, surface.over(way, triangle), body, hulls, surface))


def _within_sides(
    row: Ints, triangle: Ints, outward: Floats, inside: Floats, body: Solids, hulls: Hulls, surface: Surface
) -> Bools:
    """Which of the places on triangles, on the side `outward` (k, 3), that are inside of their sides by `inside` (k, 3)
    [m] are contacts.

    In a groove a body may have gone through both sides. What is behind a ridge, as seen from the body, is hidden.
    Beyond a ridge are corners of bodies that lie on it: without their skin they may be over the face, so that the ridge
    has no contact."""
    beyond, turn, back = (column[triangle] for column in surface.beyond)
    thick, up = body.thick[row, None], turn * np.sign(dot(outward, surface.normal[triangle]))[:, None]
    height = dot(body.center[row, None] - surface.corner[beyond, 0], surface.normal[beyond])
    hidden = (up > 0.0) & (back * height <= 0.0)
    within = inside >= -thick * np.select([hidden, up > 0.0], [-ROUND, ROUND], TIE)
    edged = (up < 0.0) & (body.rounding[row, None] == 0.0) & ~within & (inside >= -2.0 * ROUND * thick)
    n, k = np.nonzero(edged & (within | edged).all(axis=1)[:, None])
    start, end = surface.corner[triangle[n], k], surface.corner[triangle[n], (k + 1) % 3]
    inward = cross(surface.normal[triangle[n]], end - start)
    side = Planes(-inward / length(inward)[:, None], start)
    over = np.unique(solids_planes(body.take(row[n]), side, -SNAP * body.thick[row[n]], hulls).pair)
    within[n[over], k[over]] = True
    return within.all(axis=1)  # type: ignore[no-any-return]


def _on_ridges(
    row: Ints, triangle: Ints, body: Solids, delta: Floats, hulls: Hulls, surface: Surface
) -> _SurfaceContacts:
    """Where edges of the surface, with the vertices at their ends, are closest to shapes, among the surface around
    them."""
    near_row, near_triangle = row, triangle
    row, edge = _each_once(row, surface.side[triangle], surface.ridges)
    one, two = np.moveaxis(surface.vertex[surface.edge[edge]], 1, 0)
    size, away = length(two - one), body.center[row] - one
    along = (two - one) / np.where(size > 0.0, size, 1.0)[:, None]
    foot = dot(away, along)
    half = np.sqrt(np.maximum((body.radius + delta)[row] ** 2 - (dot(away, away) - foot**2), 0.0))
    low, high = np.maximum(foot - half, 0.0), np.minimum(foot + half, size)  # what of it is within reach
    within = low < high
    row, edge, one, along, low, high, size = (c[within] for c in (row, edge, one, along, low, high, size))
    rod = needles(one + low[:, None] * along, one + high[:, None] * along, body.thick[row])
    pair, name, touch = solids_solids(body.take(row), rod, delta[row], hulls)
    # Sharp bodies that lie on the edge have no point there that is closer than those of their faces.
    lies = np.zeros(len(row), bool)
    lies[pair[name != CLOSEST]] = True
    keep = (name != CLOSEST) | ~lies[pair] | (body.rounding[row[pair]] > 0.0)
    pair, name, touch = pair[keep], name[keep], touch.take(keep)

    row, edge, away = row[pair], edge[pair], -touch.normal
    place = touch.point - 0.5 * touch.gap[:, None] * away
    t, close = dot(place - one[pair], along[pair]), SNAP * body.thick[row]
    count = len(surface.triangle)
    feature, vertex = count + edge, np.full(len(row), -1)
    for at, end in ((t < close, 0), (t > size[pair] - close, 1)):
        vertex[at] = surface.edge[edge[at], end]
    feature = np.where(vertex >= 0, count + len(surface.edge) + vertex, feature)
    found = _SurfaceContacts(row, feature, place, away, touch.gap)
    least = _within_cone(surface, feature, place, away, ROCKING)
    least &= _beside(near_row, near_triangle, found, body.thick, surface)
    near = np.flatnonzero(least)
    # An edge has several contacts, a vertex, at which several edges end, one: with a face, if there is one.
    near = near[np.lexsort((touch.gap[near], name[near] == CLOSEST))]
    named = feature[near] + (1 + name[near]) * surface.features
    each = row[near] * (NAMES * surface.features) + np.where(vertex[near] >= 0, feature[near], named)
    _, first = np.unique(each, return_index=True)
    return found.take(near)._replace(feature=named).take(first)


def _beside(row: Ints, triangle: Ints, found: _SurfaceContacts, thick: Floats, surface: Surface) -> Bools:
    """Which contacts of edges and vertices are closest, too, among the near triangles (n,) of their rows that they lie
    in, though these do not have them: as where the corners of one meet the side of another."""
    loose = np.flatnonzero(surface.loose[found.feature - len(surface.triangle)])
    start = np.concatenate([[0], np.cumsum(np.bincount(row, minlength=len(thick)))])
    own, entry = spread(start, found.row[loose])
    own, other = loose[own], triangle[np.argsort(row, kind="stable")[entry]]
    meet = surface.closest(found.point[own], other).distance <= 1e-6 * thick[found.row[own]]
    own, other = own[meet], other[meet]
    way = surface.corner[other] - found.point[own, None]
    ahead = dot(way, found.away[own, None]) > ROCKING * length(way) + 1e-6 * thick[found.row[own], None]
    beside = np.ones(len(found.row), bool)
    beside[own[ahead.any(axis=1)]] = False
    return beside


def _distinct(found: _SurfaceContacts, body: Solids, surface: Surface) -> Ints:
    """Which contacts are not within SNAP half thicknesses of one of lesser gap and almost the same direction, nor those
    of a ridge beside a corner that is over a face: its direction is that of a corner without its skin."""
    order = np.lexsort((found.feature, found.gap, found.row))
    start = np.concatenate([[0], np.cumsum(np.bincount(found.row, minlength=len(body.thick)))])
    one, two = spread(start, found.row[order])
    one, two, before = order[one], order[two], two < one
    thick = body.thick[found.row[one]]
    apart, lower = length(found.point[one] - found.point[two]) / thick, (found.gap[two] - found.gap[one]) / thick
    same = before & (apart <= SNAP) & (dot(found.away[one], found.away[two]) > 0.99)
    name, feature = np.divmod(found.feature, surface.features)
    over = feature < len(surface.triangle)
    bevel = ~over & (name == 1 + CLOSEST) & (body.rounding[found.row] == 0.0)
    same |= bevel[one] & over[two] & (apart <= 2.0 * ROUND) & (lower <= ROUND)
    return np.setdiff1d(order, one[same])


def plane_mesh(plane: Planes, mesh: PlacedMesh, delta: Floats) -> Manifold:
    """Half spaces and the corners of the hull of one surface."""
    hull, none = mesh.surface.hull, np.zeros(len(delta))
    tip = mesh.middle + mesh.surface.vertex[hull] @ mesh.turn.T
    pair, corner, touch = balls_plane(np.broadcast_to(tip, (len(delta), *tip.shape)), none, plane, delta)
    return Manifold(pair, hull[corner], reversed_touch(touch))


def _feet(ball: Spheres, delta: Floats, surface: Surface) -> _SurfaceContacts:
    """The places of the surface at distances from the centres of balls (m,) that are least around them, with gaps of
    at most `delta` (m,)."""
    center, radius = ball
    row, triangle = surface.near(center, radius + delta)
    found = surface.closest(center[row], triangle)
    close = np.flatnonzero(found.distance <= (radius + delta)[row])
    row, triangle = row[close], triangle[close]
    found = Closest(found.point[close], found.feature[close], found.distance[close])
    _, first = np.unique(row * surface.features + found.feature, return_index=True)  # triangles share edges, vertices
    size = found.distance[first, None]
    away = (center[row[first]] - found.point[first]) / np.where(size > 0.0, size, 1.0)  # zero where there is no way
    within = _within_cone(surface, found.feature[first], found.point[first], away, ROUNDING)
    away = np.where(size > 0.0, away, surface.normal[triangle[first]])
    least, away = first[within], away[within]
    chosen = _one_for_each(row, triangle, found, least, radius, surface)
    row, gap = row[least], found.distance[least] - radius[row[least]]
    return _SurfaceContacts(row, found.feature[least], found.point[least], away, gap).take(chosen)


def _within_cone(surface: Surface, feature: Ints, point: Floats, away: Floats, slack: float) -> Bools:
    """Which points (k, 3) of features (k,) are closest, among those of the surface around them, to what is in the
    direction `away` (k, 3) from them; always those over faces."""
    inside = np.ones(len(feature), dtype=bool)
    rim = np.flatnonzero(feature >= len(surface.triangle))
    start, vertex = surface.around
    row, entry = spread(start, feature[rim] - len(surface.triangle))
    offset = surface.vertex[vertex[entry]] - point[rim[row]]
    inside[rim[row[dot(offset, away[rim[row]]) > slack * length(offset)]]] = False
    return inside


def _one_for_each(row: Ints, triangle: Ints, found: Closest, least: Ints, radius: Floats, surface: Surface) -> Ints:
    """Which of the entries `least` are contacts of their own: not those that rounding made twice, closer to each other
    than 1e-4 of the radius, nor places of edges that lie in another triangle, as where the corners of one meet the side
    of another."""
    point, feature, distance = found
    count = np.bincount(row[least], minlength=len(radius))
    several = np.flatnonzero(count[row[least]] > 1)
    if not len(several):
        return np.arange(len(least))
    entry = least[several]
    order = np.lexsort((feature[entry], distance[entry], row[entry]))
    entry, several = entry[order], several[order]
    dropped = np.zeros(len(least), dtype=bool)

    start = np.concatenate([[0], np.cumsum(np.where(count > 1, count, 0))])
    one, two = spread(start, row[entry])
    pair = np.flatnonzero(two < one)  # the closer one stays
    one, two = one[pair], two[pair]
    same = length(point[entry[one]] - point[entry[two]]) <= 1e-4 * radius[row[entry[one]]]
    dropped[several[one[same]]] = True

    edge = np.flatnonzero(feature[entry] >= len(surface.triangle))
    by_row = np.argsort(row, kind="stable")
    start = np.concatenate([[0], np.cumsum(np.bincount(row, minlength=len(radius)))])
    one, two = spread(start, row[entry[edge]])
    one, two = entry[edge[one]], by_row[two]
    closer = np.flatnonzero(distance[two] < distance[one] * (1.0 - 1e-9))
    at = surface.closest(point[one[closer]], triangle[two[closer]]).distance
    inside = one[closer[at <= 1e-6 * radius[row[one[closer]]]]]
    dropped[np.isin(least, inside)] = True
    return np.flatnonzero(~dropped)


def _each_once(row: Ints, items: Ints, wanted: Bools) -> tuple[Ints, Ints]:
    """The distinct pairs of rows (k,) and of those of the three items (k, 3) of their triangles that are wanted."""
    return np.divmod(np.unique((row[:, None] * len(wanted) + items)[wanted[items]]), len(wanted))  # type: ignore


def _across_edges(row: Ints, triangle: Ints, core: Capsules, reach: Floats, surface: Surface) -> _SurfaceContacts:
    """Where cores pass over edges, each between its ends."""
    center, axis, half_length, radius = core
    row, edge = _each_once(row, surface.side[triangle], surface.ridges)
    start, end = surface.vertex[surface.edge[edge, 0]], surface.vertex[surface.edge[edge, 1]]
    size = length(end - start)
    along = (end - start) / size[:, None]
    s, t = closest_on_lines(center[row], axis[row], start, along)
    over = (np.abs(s) < half_length[row]) & (t > 0.0) & (t < size) & (np.abs(dot(along, axis[row])) < 1.0 - 1e-9)
    feature, point = len(surface.triangle) + edge[over], (start + t[:, None] * along)[over]
    return _from_core(row[over], feature, point, s[over], ROCKING, core, reach, surface)


def _over_vertices(row: Ints, triangle: Ints, core: Capsules, reach: Floats, surface: Surface) -> _SurfaceContacts:
    """Vertices that are beside cores, between their ends."""
    sharp = np.zeros(len(surface.vertex), dtype=bool)
    sharp[surface.edge[surface.ridges]] = True
    row, vertex = _each_once(row, surface.triangle[triangle], sharp)
    point = surface.vertex[vertex]
    s = dot(point - core.center[row], core.axis[row])
    beside = np.abs(s) < core.half_length[row]
    feature = len(surface.triangle) + len(surface.edge) + vertex
    return _from_core(row[beside], feature[beside], point[beside], s[beside], ROUNDING, core, reach, surface)


def _from_core(
    row: Ints, feature: Ints, point: Floats, s: Floats, slack: float, core: Capsules, reach: Floats, surface: Surface
) -> _SurfaceContacts:
    """The contacts of points of edges and vertices with the places `s` [m] of the cores, where these are closest."""
    center, axis, _, radius = core
    away = center[row] + s[:, None] * axis[row] - point
    distance = length(away)
    away = away / np.where(distance > 0.0, distance, 1.0)[:, None]
    found = _SurfaceContacts(row, feature + 2 * surface.features, point, away, distance - radius[row])
    near = np.flatnonzero((distance > 0.0) & (distance <= reach[row]))
    return found.take(near[_within_cone(surface, feature[near], point[near], away[near], slack)])


def _through_faces(row: Ints, triangle: Ints, core: Capsules, surface: Surface) -> _SurfaceContacts:
    """Where cores go through faces."""
    center, axis, half_length, radius = core
    normal, corner = surface.normal[triangle], surface.corner[triangle]
    height, slope = dot(center[row] - corner[:, 0], normal), half_length[row] * dot(axis[row], normal)
    through = np.abs(height) < np.abs(slope)
    row, triangle, normal, height, slope = (values[through] for values in (row, triangle, normal, height, slope))
    point = center[row] - (height / slope * half_length[row])[:, None] * axis[row]
    in_face = surface.closest(point, triangle).feature == triangle
    gap = np.abs(height) - np.abs(slope) - radius[row]
    away = np.copysign(1.0, height)[:, None] * normal
    return _SurfaceContacts(row, triangle + 2 * surface.features, point, away, gap).take(in_face)
