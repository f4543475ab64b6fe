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
from dem.contact.convex import CLOSEST, Solids, needles, solids_planes, solids_solids
from dem.contact.meshes import ROCKING, PlacedMesh, SurfaceContacts, each_once, within_cone
from dem.contact.narrow import Manifold, Planes, dot
from dem.contact.polyhedra import TIE, Hulls
from dem.contact.simplex import ROUND, SNAP
from dem.mesh import Surface, spread
from dem.quaternion import cross, length

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
    return found.take(_distinct(found, body, surface)).manifold(mesh)


def _over_faces(
    row: Ints, triangle: Ints, body: Solids, delta: Floats, hulls: Hulls, surface: Surface
) -> SurfaceContacts:
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
    found = SurfaceContacts(row, triangle + name * surface.features, foot, outward, gap)
    return found.take(_within_sides(found, triangle, surface.over(way, triangle), body, hulls, surface))


def _within_sides(
    found: SurfaceContacts, triangle: Ints, inside: Floats, body: Solids, hulls: Hulls, surface: Surface
) -> Bools:
    """Which of the places on triangles (k,), inside of their sides by `inside` (k, 3) [m], are contacts.

    In a groove a body may have gone through both sides. What is behind a ridge, as seen from the body, is hidden.
    Beyond a ridge are corners of bodies that lie on it, further than they have gone through: without their skin they
    may be over the face, so that the ridge has no contact. What is deeper than the skin has one."""
    row, outward = found.row, found.away
    beyond, turn, back = (column[triangle] for column in surface.beyond)
    thick, up = body.thick[row, None], turn * np.sign(dot(outward, surface.normal[triangle]))[:, None]
    height = dot(body.center[row, None] - surface.corner[beyond, 0], surface.normal[beyond])
    hidden = (up > 0.0) & (back * height <= 0.0)
    within = inside >= -thick * np.select([hidden, up > 0.0], [-ROUND, ROUND], TIE)
    shallow = (body.rounding[row, None] == 0.0) & (found.gap[:, None] >= -ROUND * thick)
    edged = (up < 0.0) & shallow & ~within & (inside >= -2.0 * ROUND * thick)
    n, k = np.nonzero(edged & (within | edged).all(axis=1)[:, None])
    start, end = surface.corner[triangle[n], k], surface.corner[triangle[n], (k + 1) % 3]
    inward = cross(surface.normal[triangle[n]], end - start)
    side = Planes(-inward / length(inward)[:, None], start)
    further = np.maximum(SNAP * body.thick[row[n]], -found.gap[n])
    over = np.unique(solids_planes(body.take(row[n]), side, -further, hulls).pair)
    within[n[over], k[over]] = True
    return within.all(axis=1)  # type: ignore[no-any-return]


def _on_ridges(
    row: Ints, triangle: Ints, body: Solids, delta: Floats, hulls: Hulls, surface: Surface
) -> SurfaceContacts:
    """Where edges of the surface, with the vertices at their ends, are closest to shapes, among the surface around
    them."""
    own, edge, start, end = _within_reach(*each_once(row, surface.side[triangle], surface.ridges), body, delta, surface)
    rods = needles(start, end, body.thick[own])
    pair, name, touch = solids_solids(body.take(own), rods, delta[own], hulls)
    # Sharp bodies that lie on the edge have no point there that is closer than those of their faces.
    lies = np.isin(pair, pair[name != CLOSEST]) & (body.rounding[own[pair]] == 0.0)
    keep = (name != CLOSEST) | ~lies
    own, edge, name, touch = own[pair[keep]], edge[pair[keep]], name[keep], touch.take(keep)
    away, place = -touch.normal, touch.point + 0.5 * touch.gap[:, None] * touch.normal
    found = SurfaceContacts(own, _feature_at(place, edge, SNAP * body.thick[own], surface), place, away, touch.gap)
    least = within_cone(surface, found.feature, away, ROCKING)
    least &= _beside(row, triangle, found, body.thick, surface)
    return _named(found, name, least, body, surface)


def _within_reach(
    row: Ints, edge: Ints, body: Solids, delta: Floats, surface: Surface
) -> tuple[Ints, Ints, Floats, Floats]:
    """Of bodies and edges those that come into reach of each other, and from where to where the edges do."""
    one, two = np.moveaxis(surface.vertex[surface.edge[edge]], 1, 0)
    size, away = length(two - one), body.center[row] - one
    along = (two - one) / np.where(size > 0.0, size, 1.0)[:, None]
    foot = dot(away, along)
    half = np.sqrt(np.maximum((body.radius + delta)[row] ** 2 - (dot(away, away) - foot**2), 0.0))
    low, high = np.maximum(foot - half, 0.0)[:, None], np.minimum(foot + half, size)[:, None]
    near = (low < high)[:, 0]
    return row[near], edge[near], (one + low * along)[near], (one + high * along)[near]


def _feature_at(place: Floats, edge: Ints, close: Floats, surface: Surface) -> Ints:
    """The features of places (k, 3) on edges (k,): these, or the vertices that are close (k,) [m]."""
    first, count = len(surface.triangle), len(surface.edge)
    feature = first + edge
    for vertex in surface.edge[edge].T:
        feature = np.where(length(place - surface.vertex[vertex]) < close, first + count + vertex, feature)
    return feature  # type: ignore[no-any-return]


def _named(found: SurfaceContacts, name: Ints, least: Bools, body: Solids, surface: Surface) -> SurfaceContacts:
    """Those that are the `least` (k,), with features that tell the names: of an edge several, of a vertex, at which
    several edges end, one, of sharp bodies with a face, if there is one."""
    order = np.flatnonzero(least)
    last = (name == CLOSEST) & (body.rounding[found.row] == 0.0)
    order = order[np.lexsort((found.gap[order], last[order]))]
    found, name = found.take(order), name[order]
    named = found.feature + (1 + name) * surface.features
    at_vertex = found.feature >= len(surface.triangle) + len(surface.edge)
    each = found.row * (NAMES * surface.features) + np.where(at_vertex, found.feature, named)
    _, first = np.unique(each, return_index=True)
    return found._replace(feature=named).take(first)


def _beside(row: Ints, triangle: Ints, found: SurfaceContacts, thick: Floats, surface: Surface) -> Bools:
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


def _distinct(found: SurfaceContacts, body: Solids, surface: Surface) -> Ints:
    """Which contacts are not within SNAP half thicknesses of one of lesser gap and almost the same direction, nor those
    of a ridge beside a corner that is over a face: its direction is that of a corner without its skin."""
    order = np.lexsort((found.feature, found.gap, found.row))
    start = np.concatenate([[0], np.cumsum(np.bincount(found.row, minlength=len(body.thick)))])
    one, two = spread(start, found.row[order])
    one, two, before = order[one], order[two], two < one
    thick = body.thick[found.row[one]]
    apart, lower = length(found.point[one] - found.point[two]) / thick, (found.gap[two] - found.gap[one]) / thick
    name, feature = np.divmod(found.feature, surface.features)
    over = feature < len(surface.triangle)
    bevel = ~over & (name == 1 + CLOSEST) & (body.rounding[found.row] == 0.0)
    left_out = np.unique(one[bevel[one] & over[two] & (apart <= 2.0 * ROUND) & (lower <= ROUND)])
    same = before & (apart <= SNAP) & (dot(found.away[one], found.away[two]) > 0.99) & ~np.isin(two, left_out)
    return np.setdiff1d(order, np.concatenate([left_out, one[same]]))
