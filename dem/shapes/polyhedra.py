"""Convex polyhedra: shapes of grains, with volume, centre and moments by closed forms, in the frame of the principal
axes."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any, ClassVar, NamedTuple

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from dem import quaternion
from dem.arrays import ArrayLike, Floats, Ints
from dem.bodies import POLYHEDRON
from dem.checks import finite
from dem.shapes.forms import Form

#: Vertices of a polyhedron: contacts are known by pairs of edges, and the search tries all of them.
MOST_VERTICES = 32


class Faces(NamedTuple):
    """What bounds a convex polyhedron of v vertices: f faces, of which the one of most corners has s of them, and e
    edges. Corners come one after the other, to the left as seen from outside, and -1 stands for those that a face does
    not have."""

    vertex: Floats  #: (v, 3) [m]
    normal: Floats  #: (f, 3) outward unit vectors
    corner: Ints  #: (f, s) rows of vertices
    side: Ints  #: (f, s) the edge from each corner to the next
    edge: Ints  #: (e, 2) rows of vertices
    wing: Ints  #: (e, 2) the face on the left of an edge, and that on its right


@dataclass(frozen=True, eq=False, repr=False)
class Solid(Form):
    """The form of a convex polyhedron."""

    faces: Faces
    BASE: ClassVar[int] = POLYHEDRON
    SCALES: ClassVar[bool] = True

    @property
    def size(self) -> Floats:
        """As of `Form`; the largest sphere is about the origin."""
        vertex, normal, corner, *_ = self.faces
        depth = np.einsum("fi,fi->f", normal, vertex[corner[:, 0]]).min()
        return np.array([np.linalg.norm(vertex, axis=1).max(), np.cbrt(0.75 * self.volume / np.pi), depth])

    def described(self) -> dict[str, Any]:
        """As of `Form`: triangles."""
        return {"vertices": self.faces.vertex.tolist(), "triangles": triangles(self.faces).tolist()}


def solid(vertices: ArrayLike) -> Solid:
    """The polyhedron of these vertices (v, 3) [m]; the same object for equal ones. ValueError if it has no volume, or
    vertices that are no corners of it."""
    given = finite("vertices", vertices)
    if given.ndim != 2 or given.shape[1] != 3 or not 4 <= len(given) <= MOST_VERTICES:
        raise ValueError(f"vertices must have shape (v, 3) with v from 4 to {MOST_VERTICES}, got {given.shape}")
    return _solid(tuple(map(tuple, given.tolist())))


@cache
def _solid(vertices: tuple[tuple[float, ...], ...]) -> Solid:
    given = np.array(vertices)
    middle = given.mean(axis=0)
    faces = hull(given - middle)
    volume, place, tensor = integrals(faces)
    moments, turn = quaternion.principal(tensor)
    inverse_turn = quaternion.conjugate(turn)
    own = quaternion.rotate(inverse_turn, faces.vertex - place), quaternion.rotate(inverse_turn, faces.normal)
    return Solid(volume, moments, place + middle, turn, Faces(*own, *faces[2:]))


def hull(vertex: Floats) -> Faces:
    """The faces of the convex hull of points (v, 3), all of which must be corners of it (ValueError)."""
    size = np.linalg.norm(vertex - vertex.mean(axis=0), axis=1).max()
    try:
        found = ConvexHull(vertex)
    except QhullError:
        raise ValueError(
            f"vertices: {len(vertex)} points in a plane or on a line; allowed are the corners of a solid"
        ) from None
    # Triangles in one plane are one face: each goes to the first that has its plane.
    plane = found.equations / [1.0, 1.0, 1.0, size]
    same = np.abs(plane[:, None] - plane).max(axis=2) < 1e-6
    first = same.argmax(axis=1)
    normal = plane[np.unique(first), :3]
    loops = []
    for number, outward in zip(np.unique(first), normal):
        rows = np.unique(found.simplices[first == number])
        arm = vertex[rows] - vertex[rows].mean(axis=0)
        x = arm[0] / np.linalg.norm(arm[0])
        loops.append(rows[np.argsort(np.arctan2(arm @ np.cross(outward, x), arm @ x))])
    meeting = np.bincount(np.concatenate(loops), minlength=len(vertex))
    if (meeting < 3).any():
        k = int(np.argmin(meeting))
        raise ValueError(
            f"vertices: number {k} is no corner of their hull; allowed are the corners of a convex solid, each once"
        )
    corner = np.full((len(loops), max(map(len, loops))), -1)
    for row, loop in zip(corner, loops):
        row[: len(loop)] = loop
    ends = np.array([(a, b, f) for f, loop in enumerate(loops) for a, b in zip(loop, np.roll(loop, -1))])
    left, right = {(a, b): f for a, b, f in ends.tolist()}, [(a, b) for a, b, _ in ends.tolist() if a < b]
    edge = np.array(sorted(right))
    number_of = {pair: n for n, (a, b) in enumerate(edge.tolist()) for pair in ((a, b), (b, a))}
    side = np.full_like(corner, -1)
    for row, loop in zip(side, loops):
        row[: len(loop)] = [number_of[a, b] for a, b in zip(loop.tolist(), np.roll(loop, -1).tolist())]
    wing = np.array([(left[a, b], left[b, a]) for a, b in edge.tolist()])
    return Faces(vertex, normal, corner, side, edge, wing)


def triangles(faces: Faces) -> Ints:
    """Rows (t, 3) of the vertices of triangles that make up the faces; seen from outside they turn left."""
    fans = [row[row >= 0] for row in faces.corner]
    return np.array([(loop[0], a, b) for loop in fans for a, b in zip(loop[1:], loop[2:])])


def integrals(faces: Faces) -> tuple[float, Floats, Floats]:
    """Volume [m^3], centre (3,) [m] and inertia tensor (3, 3) about it over the density [m^5]: sums over the tetrahedra
    of the origin and the triangles of the faces, which may have either sign."""
    a, b, c = np.moveaxis(faces.vertex[triangles(faces)], 1, 0)
    six = np.einsum("ti,ti->t", a, np.cross(b, c))  # volumes
    volume, total = six.sum() / 6.0, a + b + c
    place = six @ total / (24.0 * volume)
    second = sum(np.einsum("t,ti,tj->ij", six, x, x) for x in (a, b, c, total)) / 120.0
    second = second - volume * np.outer(place, place)
    return float(volume), place, np.trace(second) * np.eye(3) - second
