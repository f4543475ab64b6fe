"""Narrow phase of balls, capsules and half spaces with surfaces made of triangles; solids are in `solid_meshes`.

The contacts of a ball are the places of the surface where the distance from its centre is least among the places
around them: over a face, on an edge or at a vertex, each once, however many triangles share it (Ericson 2005,
"Real-Time Collision Detection", section 5.1: the centre is in the Voronoi region of the feature).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from dem.arrays import Bools, Floats, Ints
from dem.compiled import inlined, loop
from dem.contact.ahead import vector_of
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
from dem.geometry.vectors import dot as product
from dem.geometry.vectors import plus
from dem.mesh import Closest, Surface, spread
from dem.quaternion import length

#: Sine of the angle by which a direction may leave those in which an edge or a vertex is closest, for rounding.
ROUNDING = 1e-6

#: The same for the side of a capsule on an edge: one that rocks a little on two edges keeps the contacts of both.
ROCKING = 0.1

#: The same for edges of a face that a round body rolls on.
TILT = 1e-4

#: Features of a capsule on a surface: those of the surface for each end ball, and for the core between.
PARTS = 3


class PlacedMesh(NamedTuple):
    """One surface in the world."""

    surface: Surface
    middle: Floats  #: (3,) where its middle is [m]
    turn: Floats  #: (3, 3) its frame


class SurfaceContacts(NamedTuple):
    """Contacts of bodies and one surface, in its frame."""

    row: Ints  #: (k,) of the body
    feature: Ints  #: (k,) of the surface, and more than all these for each part of a capsule, or name, before
    point: Floats  #: (k, 3) of the surface [m]
    away: Floats  #: (k, 3) unit vector from there to the body
    gap: Floats  #: (k,) [m]

    def take(self, rows: Ints | Bools) -> SurfaceContacts:
        columns: Any = self
        return SurfaceContacts(*(column[rows] for column in columns))

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
    found = SurfaceContacts(*(np.concatenate(columns) for columns in zip(*parts, through)))
    # The end on the wrong side of a face that the core goes through would be held there; the first is at the start.
    short = (dot(through.away, core.axis[through.row]) < 0.0).astype(np.int64)
    stuck = PARTS * surface.features * through.row + through.feature + (short - 2) * surface.features
    return found.take(~np.isin(PARTS * surface.features * found.row + found.feature, stuck)).manifold(mesh)


def plane_mesh(plane: Planes, mesh: PlacedMesh, delta: Floats) -> Manifold:
    """Half spaces and the corners of the hull of one surface."""
    hull, none = mesh.surface.hull, np.zeros(len(delta))
    tip = mesh.middle + mesh.surface.vertex[hull] @ mesh.turn.T
    pair, corner, touch = balls_plane(np.broadcast_to(tip, (len(delta), *tip.shape)), none, plane, delta)
    return Manifold(pair, hull[corner], reversed_touch(touch))


def _feet(ball: Spheres, delta: Floats, surface: Surface) -> SurfaceContacts:
    """The places of the surface at distances from the centres of balls (m,) that are least around them, with gaps of
    at most `delta` (m,)."""
    center, radius = ball
    row, triangle = surface.near(center, radius + delta)
    found = surface.closest(center[row], triangle)
    least, away = _least_around(center, radius + delta, row, triangle, found[:], surface.normal, surface.around)
    chosen = _one_for_each(row, triangle, found, least, radius, surface)
    row, gap = row[least], found.distance[least] - radius[row[least]]
    return SurfaceContacts(row, found.feature[least], found.point[least], away, gap).take(chosen)


@loop
def _least_around(center, reach, row, triangle, found, normal, around):
    """Of the closest points of triangles (m,) to the centres of these rows (m,) of balls those (k,) that are within
    reach, and least around them: one for each ball and feature, in their order; and the directions (k, 3) from there to
    the centres."""
    (point, feature, distance), faces = found, len(normal)
    least, away, count, first = np.empty(len(row), np.int64), np.empty((len(row), 3)), 0, 0
    for n in range(len(row)):
        if n and row[n] != row[n - 1]:
            first = count
        size = distance[n]
        if not size <= reach[row[n]]:
            continue
        at = count
        while at > first and feature[least[at - 1]] > feature[n]:
            at -= 1
        if at > first and feature[least[at - 1]] == feature[n]:
            continue  # triangles share edges and vertices
        x, y, z = vector_of(normal[triangle[n]], 0)
        if size > 0.0:
            x, y, z = plus(vector_of(center[row[n]], 0), -1.0, vector_of(point[n], 0))
            x, y, z = x / size, y / size, z / size
        rim = feature[n] - faces
        if size > 0.0 and rim >= 0 and not _is_least(around, rim, (x, y, z), ROUNDING):
            continue
        for k in range(count, at, -1):
            least[k], away[k] = least[k - 1], away[k - 1]
        least[at], away[at, 0], away[at, 1], away[at, 2] = n, x, y, z
        count += 1
    return least[:count], away[:count]


@inlined
def _is_least(around, rim, away, slack):
    """Whether a place on an edge or at a vertex, number `rim` of both, is closer to what is in the direction `away`
    than others of the surface `Surface.around` it."""
    start, way = around
    for e in range(start[rim], start[rim + 1]):  # noqa: SIM110 - all() of a generator is not compiled
        if product(vector_of(way[e], 0), away) > slack:
            return False
    return True


def within_cone(surface: Surface, feature: Ints, away: Floats, slack: float) -> Bools:
    """Which places on features (k,) are closest, among those of the surface around them, to what is in the direction
    `away` (k, 3) from them; always those over faces."""
    inside: Bools = _are_least(surface.around, feature - len(surface.triangle), away, slack)
    return inside


@loop
def _are_least(around, rim, away, slack):
    """The loop of `within_cone`; over faces `rim` is negative."""
    inside = np.empty(len(rim), np.bool_)
    for n in range(len(rim)):
        inside[n] = rim[n] < 0 or _is_least(around, rim[n], vector_of(away[n], 0), slack)
    return inside


def flat_across(surface: Surface, feature: Ints, away: Floats) -> Bools:
    """Which features (k,) of contacts are flat across the directions `away` (k, 3): faces, and edges of one there."""
    feature, faces = feature % surface.features, len(surface.triangle)
    flat: Bools = feature < faces
    rim = np.flatnonzero(~flat & (feature < faces + len(surface.edge)))
    start, way = surface.around
    row, entry = spread(start, feature[rim] - faces)
    flat[rim[row[np.abs(dot(way[entry], away[rim[row]])) <= TILT]]] = True
    return flat


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


def each_once(row: Ints, items: Ints, wanted: Bools) -> tuple[Ints, Ints]:
    """The distinct pairs of rows (k,) and of those of the three items (k, 3) of their triangles that are wanted."""
    return np.divmod(np.unique((row[:, None] * len(wanted) + items)[wanted[items]]), len(wanted))  # type: ignore


def _across_edges(row: Ints, triangle: Ints, core: Capsules, reach: Floats, surface: Surface) -> SurfaceContacts:
    """Where cores pass over edges, each between its ends."""
    center, axis, half_length, radius = core
    row, edge = each_once(row, surface.side[triangle], surface.ridges)
    start, end = surface.vertex[surface.edge[edge, 0]], surface.vertex[surface.edge[edge, 1]]
    size = length(end - start)
    along = (end - start) / size[:, None]
    s, t = closest_on_lines(center[row], axis[row], start, along)
    over = (np.abs(s) < half_length[row]) & (t > 0.0) & (t < size) & (np.abs(dot(along, axis[row])) < 1.0 - 1e-9)
    feature, point = len(surface.triangle) + edge[over], (start + t[:, None] * along)[over]
    return _from_core(row[over], feature, point, s[over], ROCKING, core, reach, surface)


def _over_vertices(row: Ints, triangle: Ints, core: Capsules, reach: Floats, surface: Surface) -> SurfaceContacts:
    """Vertices that are beside cores, between their ends."""
    sharp = np.zeros(len(surface.vertex), dtype=bool)
    sharp[surface.edge[surface.ridges]] = True
    row, vertex = each_once(row, surface.triangle[triangle], sharp)
    point = surface.vertex[vertex]
    s = dot(point - core.center[row], core.axis[row])
    beside = np.abs(s) < core.half_length[row]
    feature = len(surface.triangle) + len(surface.edge) + vertex
    return _from_core(row[beside], feature[beside], point[beside], s[beside], ROUNDING, core, reach, surface)


def _from_core(
    row: Ints, feature: Ints, point: Floats, s: Floats, slack: float, core: Capsules, reach: Floats, surface: Surface
) -> SurfaceContacts:
    """The contacts of points of edges and vertices with the places `s` [m] of the cores, where these are closest."""
    center, axis, _, radius = core
    away = center[row] + s[:, None] * axis[row] - point
    distance = length(away)
    away = away / np.where(distance > 0.0, distance, 1.0)[:, None]
    found = SurfaceContacts(row, feature + 2 * surface.features, point, away, distance - radius[row])
    near = np.flatnonzero((distance > 0.0) & (distance <= reach[row]))
    return found.take(near[within_cone(surface, feature[near], away[near], slack)])


def _through_faces(row: Ints, triangle: Ints, core: Capsules, surface: Surface) -> SurfaceContacts:
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
    return SurfaceContacts(row, triangle + 2 * surface.features, point, away, gap).take(in_face)
