"""Narrow phase of surfaces made of triangles.

The contacts of a ball are the places of the surface where the distance from its centre is least among the places
around them: over a face, on an edge or at a vertex, each once, however many triangles share it. A ball that rolls over
a flat surface of many triangles has one contact, and one in a groove has two. In the words of Ericson (2005),
"Real-Time Collision Detection", section 5.1: the centre is in the Voronoi region of the feature with respect to each
of its faces.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from dem.arrays import Bools, Floats, Ints
from dem.contact.capsules import end_ball
from dem.contact.narrow import Capsules, Manifold, Planes, Spheres, Touch, closest_on_lines, dot
from dem.mesh import Closest, Surface, spread
from dem.quaternion import length

#: Sine of the angle by which a direction may leave those in which an edge or a vertex is closest, for rounding.
ROUNDING = 1e-6

#: The same for the side of a capsule on an edge: one that rocks a little on two edges keeps the contacts of both.
ROCKING = 0.1

#: Features of a capsule on a surface: those of the surface for each end ball, and for the core between.
PARTS = 3


class PlacedMesh(NamedTuple):
    """One surface in the world."""

    surface: Surface
    middle: Floats  #: (3,) where its middle is [m]
    turn: Floats  #: (3, 3) its frame


def sphere_mesh(ball: Spheres, mesh: PlacedMesh, delta: Floats) -> Manifold:
    """Spheres and one surface."""
    local = (ball.center - mesh.middle) @ mesh.turn
    row, feature, point, away, distance = _feet(local, ball.radius, ball.radius + delta, mesh.surface)
    return _placed(row, feature, point, away, distance - ball.radius[row], mesh)


def capsule_mesh(capsule: Capsules, mesh: PlacedMesh, delta: Floats) -> Manifold:
    """Capsules and one surface: the end balls, and the core between them on edges and vertices.

    A core that goes through a face is pushed back across it the shorter way.
    """
    surface, radius, reach = mesh.surface, capsule.radius, capsule.radius + delta
    core = capsule._replace(center=(capsule.center - mesh.middle) @ mesh.turn, axis=capsule.axis @ mesh.turn)
    found = []
    for end, side in enumerate((-1.0, 1.0)):
        row, feature, point, away, distance = _feet(end_ball(core, side).center, radius, reach, surface)
        # Where the side of the capsule is clearly closer to an edge than its end is, the end is no contact.
        beyond = side * dot(away, core.axis[row]) <= ROCKING
        kept = (feature < len(surface.triangle)) | beyond
        found.append((row, feature + end * surface.features, point, away, distance - radius[row], kept))
    row, triangle = surface.near(core.center, core.half_length + reach)
    found += [_across_edges(row, triangle, core, reach, surface), _over_vertices(row, triangle, core, reach, surface)]
    through = _through_faces(row, triangle, core, surface)
    found.append(through)
    row, feature, point, away, gap, kept = (np.concatenate([part[k] for part in found]) for k in range(6))
    # The end on the wrong side of a face that the core goes through would be held there.
    stuck = np.isin(row * PARTS * surface.features + feature, _short_ends(through, core, surface))
    kept &= ~stuck
    return _placed(row[kept], feature[kept], point[kept], away[kept], gap[kept], mesh)


def plane_mesh(plane: Planes, mesh: PlacedMesh, delta: Floats) -> Manifold:
    """Half spaces and the corners of the hull of one surface."""
    hull = mesh.surface.hull
    tip = mesh.middle + mesh.surface.vertex[hull] @ mesh.turn.T
    gap = plane.outward @ tip.T - dot(plane.outward, plane.origin)[:, None]
    pair, corner = np.nonzero(gap <= delta[:, None])
    gap, normal = gap[pair, corner], plane.outward[pair]
    return Manifold(pair, hull[corner], Touch(tip[corner] - 0.5 * gap[:, None] * normal, normal, gap))


def _feet(center: Floats, radius: Floats, reach: Floats, surface: Surface) -> tuple[Ints, Ints, Floats, Floats, Floats]:
    """The places of the surface at distances from centres (m, 3) that are least around them and within reach (m,): rows
    of the centres, features, points, unit vectors from there to the centre, distances."""
    row, triangle = surface.near(center, reach)
    found = surface.closest(center[row], triangle)
    close = np.flatnonzero(found.distance <= reach[row])
    row, triangle = row[close], triangle[close]
    point, feature, distance = found.point[close], found.feature[close], found.distance[close]
    _, first = np.unique(row * surface.features + feature, return_index=True)  # triangles share edges and vertices
    away = center[row[first]] - point[first]
    size = distance[first, None]
    away = np.where(size > 0.0, away / np.where(size > 0.0, size, 1.0), surface.normal[triangle[first]])
    least = first[_within_cone(surface, feature[first], point[first], np.where(size > 0.0, away, 0.0), ROUNDING)]
    away = away[np.isin(first, least)]
    chosen = _one_for_each(row, triangle, Closest(point, feature, distance), least, radius, surface)
    return row[least][chosen], feature[least][chosen], point[least][chosen], away[chosen], distance[least][chosen]


def _within_cone(surface: Surface, feature: Ints, point: Floats, away: Floats, slack: float) -> Bools:
    """Which points (k, 3) of features (k,) are closest, among those of the surface around them, to what is in the
    direction `away` (k, 3) from them; always those over faces."""
    inside = np.ones(len(feature), dtype=bool)
    rim = np.flatnonzero(feature >= len(surface.triangle))
    start, vertex = surface.around
    row, entry = spread(start, feature[rim] - len(surface.triangle))
    way = surface.vertex[vertex[entry]] - point[rim[row]]
    inside[rim[row[dot(way, away[rim[row]]) > slack * length(way)]]] = False
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


_Found = tuple[Ints, Ints, Floats, Floats, Floats, Bools]  # rows, features, points, directions, gaps, which are kept


def _each_once(row: Ints, items: Ints, wanted: Bools) -> tuple[Ints, Ints]:
    """The distinct pairs of rows (k,) and of those of the three items (k, 3) of their triangles that are wanted."""
    return np.divmod(np.unique((row[:, None] * len(wanted) + items)[wanted[items]]), len(wanted))  # type: ignore


def _across_edges(row: Ints, triangle: Ints, core: Capsules, reach: Floats, surface: Surface) -> _Found:
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


def _over_vertices(row: Ints, triangle: Ints, core: Capsules, reach: Floats, surface: Surface) -> _Found:
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
) -> _Found:
    """The contacts of points of edges and vertices with the places `s` [m] of the cores, where these are closest."""
    center, axis, _, radius = core
    away = center[row] + s[:, None] * axis[row] - point
    distance = length(away)
    away = away / np.where(distance > 0.0, distance, 1.0)[:, None]
    kept = (distance > 0.0) & (distance <= reach[row])
    kept[kept] = _within_cone(surface, feature[kept], point[kept], away[kept], slack)
    return row, feature + 2 * surface.features, point, away, distance - radius[row], kept


def _through_faces(row: Ints, triangle: Ints, core: Capsules, surface: Surface) -> _Found:
    """Where cores go through faces."""
    center, axis, half_length, radius = core
    normal, corner = surface.normal[triangle], surface.corner[triangle]
    height, slope = dot(center[row] - corner[:, 0], normal), half_length[row] * dot(axis[row], normal)
    through = np.abs(height) < np.abs(slope)
    row, triangle, normal, height, slope = (values[through] for values in (row, triangle, normal, height, slope))
    point = center[row] - (height / slope * half_length[row])[:, None] * axis[row]
    in_face = surface.closest(point, triangle).feature == triangle
    depth = np.abs(slope) - np.abs(height)
    away = np.copysign(1.0, height)[:, None] * normal
    return row, triangle + 2 * surface.features, point, away, -depth - radius[row], in_face


def _short_ends(through: _Found, core: Capsules, surface: Surface) -> Ints:
    """Numbers, of the row and the feature, of the contacts of ends beyond faces that their cores go through."""
    row, feature, _, away, _, kept = through
    row, triangle, away = row[kept], feature[kept] - 2 * surface.features, away[kept]
    end = (dot(away, core.axis[row]) < 0.0).astype(np.int64)  # the first end is at the start of the axis
    return row * PARTS * surface.features + end * surface.features + triangle


def _placed(row: Ints, feature: Ints, point: Floats, away: Floats, gap: Floats, mesh: PlacedMesh) -> Manifold:
    """The manifold of contacts in the frame of the surface: its points, and unit vectors from there."""
    between = point + 0.5 * gap[:, None] * away
    return Manifold(row, feature, Touch(mesh.middle + between @ mesh.turn.T, -away @ mesh.turn.T, gap))
