"""The primitives that a rank knows, in one table, and where pairs of them touch."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from dem import quaternion
from dem.arrays import Floats, Ints
from dem.bodies import BOX, CAPSULE, SPHERE, enclosing_radius
from dem.contact.box_box import BOX_FEATURES, box_box
from dem.contact.capsules import capsule_box, capsule_capsule, capsule_plane
from dem.contact.meshes import PARTS, PlacedMesh, capsule_mesh, mesh_plane, sphere_mesh
from dem.contact.narrow import (
    CORNERS,
    Boxes,
    Capsules,
    Manifold,
    Planes,
    Spheres,
    Touch,
    corner_plane,
    joined,
    reversed_touch,
    sphere_box,
    sphere_capsule,
    sphere_plane,
    spheres_within,
)
from dem.mesh import Mesh, Surface
from dem.neighbourhood import Neighbourhood
from dem.shapes import Box, Plane, Shape, Sphere

#: Kinds of the half spaces and of the meshes; those of the others are the kinds of grains.
PLANE, MESH = 4, 5

#: Features that the contacts of one pair of primitives without meshes can have. A mesh has as many numbers as its
#: features need.
FEATURES = BOX_FEATURES


class Primitives(NamedTuple):
    """Spheres, boxes, capsules, half spaces and meshes in the world frame; first all grains, then parts of large
    bodies."""

    number: Ints  #: (n,) of the grain its id, of parts the numbers that follow: the same at all times
    row: Ints  #: (n,) row of the body
    kind: Ints  #: (n,) SPHERE, BOX, CAPSULE, PLANE or MESH
    center: Floats  #: (n, 3); a point of the surface of a half space, the middle of a mesh [m]
    quaternion: Floats  #: (n, 4)
    size: Floats  #: (n, 3) as of `Bodies` [m]; the outward normal of a half space; of a mesh half its extents
    radius: Floats  #: (n,) of the sphere about the centre that encloses it, without meaning for half spaces [m]
    surfaces: dict[int, Surface]  #: of the meshes, by row
    numbers: int  #: more than any of `number`, and those that meshes take after theirs

    def sphere(self, rows: Ints) -> Spheres:
        return Spheres(self.center[rows], self.size[rows, 0])

    def box(self, rows: Ints) -> Boxes:
        return Boxes(self.center[rows], quaternion.matrix(self.quaternion[rows]), self.size[rows])

    def capsule(self, rows: Ints) -> Capsules:
        axis = quaternion.rotate(self.quaternion[rows], np.array([0.0, 0.0, 1.0]))
        return Capsules(self.center[rows], axis, self.size[rows, 1], self.size[rows, 0])

    def plane(self, rows: Ints | int) -> Planes:
        return Planes(self.size[rows], self.center[rows])

    def mesh(self, row: int) -> PlacedMesh:
        return PlacedMesh(self.surfaces[row], self.center[row], quaternion.matrix(self.quaternion[row]))

    def keys(self, i: Ints, j: Ints, feature: Ints) -> Ints:
        """Numbers (m,) of the features of pairs of rows i, j (m,), distinct and the same at all times."""
        first, second = self.number[i], self.number[j]
        if self.surfaces:
            further, feature = np.divmod(feature, FEATURES)
            first, second = first + further * (self.kind[i] == MESH), second + further * (self.kind[i] != MESH)
        return (first * self.numbers + second) * FEATURES + feature


def primitives(near: Neighbourhood, shapes: list[tuple[Shape, ...]], grains: int) -> Primitives:
    """The table of the grains and ghosts of `near` and of the `shapes` of its large bodies; `grains` is the number of
    grains on all ranks."""
    table, count = near.bodies, near.grains + near.ghosts
    row = count + np.repeat(np.arange(len(shapes)), [len(parts) for parts in shapes])
    members = [shape for body in shapes for shape in body]
    parts = [_placed(shape) for shape in members]
    surfaces = {count + n: shape.surface for n, shape in enumerate(members) if isinstance(shape, Mesh)}
    spans = [_numbers_of(shape) for shape in members]
    kind, center, turn, size = (np.array(column) for column in zip(*parts)) if parts else _NOTHING
    body_turn = table.quaternion[row]
    size = np.where((kind == PLANE)[:, None], quaternion.rotate(body_turn, size), size)
    sizes, kinds = np.concatenate([table.size[:count], size]), np.concatenate([table.shape[:count], kind])
    center = table.position[row] + quaternion.rotate(body_turn, center)
    return Primitives(
        number=np.concatenate([table.id[:count], grains + np.cumsum([0, *spans[:-1]])[: len(row)]]).astype(np.int64),
        row=np.concatenate([np.arange(count), row]),
        kind=kinds,
        center=np.concatenate([table.position[:count], center]),
        quaternion=np.concatenate([table.quaternion[:count], quaternion.multiply(body_turn, turn)]),
        size=sizes,
        radius=enclosing_radius(kinds, sizes),
        surfaces=surfaces,
        numbers=grains + sum(spans),
    )


def extents(shapes: list[tuple[Shape, ...]]) -> Floats:
    """Distances (large,) of the furthest points of large bodies from their reference points [m]; half spaces, which
    have none, count with a metre."""

    def extent(shape: Shape) -> float:
        kind, center, _, size = _placed(shape)
        return float(np.linalg.norm(center) + enclosing_radius(np.array([kind]), size[None])[0])

    return np.array([max(extent(shape) for shape in parts) for parts in shapes])


def _numbers_of(shape: Shape) -> int:
    """How many numbers a part takes, that its features may be distinct."""
    return 1 + (PARTS * shape.surface.features - 1) // FEATURES if isinstance(shape, Mesh) else 1


_UPRIGHT = np.array([1.0, 0.0, 0.0, 0.0])
_NOTHING = np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 4)), np.zeros((0, 3))


def _placed(shape: Shape) -> tuple[int, Floats, Floats, Floats]:
    """Kind, centre, quaternion and size of a shape in the frame of its body."""
    center = np.array(shape.center)
    if isinstance(shape, Sphere):
        return SPHERE, center, _UPRIGHT, np.array([shape.radius, 0.0, 0.0])
    if isinstance(shape, Plane):
        return PLANE, center, _UPRIGHT, np.array(shape.normal)
    turn = np.array(shape.quaternion)
    if isinstance(shape, Box):
        return BOX, center, turn, np.array(shape.half_extents)
    if isinstance(shape, Mesh):
        return MESH, center + quaternion.rotate(turn, shape.surface.middle), turn, shape.surface.half
    return CAPSULE, center, turn, np.array([shape.radius, shape.half_length, 0.0])


def touches(table: Primitives, i: Ints, j: Ints, delta: Floats) -> Manifold:
    """All contacts of gap at most `delta` (m,) [m] of the pairs of rows i, j (m,); normals point from i to j.

    Two half spaces have none, nor have meshes with boxes or meshes: `dem.scene` refuses those.
    """
    found = [_NO_CONTACT]
    code = 8 * table.kind[i] + table.kind[j]
    for one, two in (divmod(int(kinds), 8) for kinds in np.flatnonzero(np.bincount(code))):
        rows = np.flatnonzero(code == 8 * one + two)
        if (one, two) in _TOUCH:
            pair, feature, touch = _TOUCH[one, two](table, i[rows], j[rows], delta[rows])
        elif (two, one) in _TOUCH:
            pair, feature, touch = _TOUCH[two, one](table, j[rows], i[rows], delta[rows])
            touch = reversed_touch(touch)
        else:
            continue
        found.append(Manifold(rows[pair], feature, touch))
    return joined(found)


_NO_CONTACT = Manifold(
    np.zeros(0, np.int64), np.zeros(0, np.int64), Touch(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0))
)


def _single(touch: Touch, delta: Floats) -> Manifold:
    """The manifold of pairs that touch in one point."""
    pair = np.flatnonzero(touch.gap <= delta)
    return Manifold(pair, np.zeros_like(pair), touch.take(pair))


def _spheres(table: Primitives, i: Ints, j: Ints, delta: Floats) -> Manifold:
    pair, *touch = spheres_within(table.center, table.size, i, j, delta)
    return Manifold(pair, np.zeros_like(pair), Touch(*touch))


def _box_plane(table: Primitives, i: Ints, j: Ints, delta: Floats) -> Manifold:
    corner = np.tile(np.arange(len(CORNERS)), len(i))
    pair = np.repeat(np.arange(len(i)), len(CORNERS))
    manifold = _single(corner_plane(table.box(i[pair]), corner, table.plane(j[pair])), delta[pair])
    return Manifold(pair[manifold.pair], corner[manifold.pair], manifold.touch)


def _on_meshes(
    contacts: Callable[..., Manifold], shapes: Callable[[Ints], Any], table: Primitives, i: Ints, j: Ints, delta: Floats
) -> Manifold:
    """The manifolds of ``shapes(rows)``, of the rows i (m,), with the meshes of rows j (m,), mesh by mesh."""
    found = []
    for mesh in np.unique(j):
        rows = np.flatnonzero(j == mesh)
        manifold = contacts(shapes(i[rows]), table.mesh(int(mesh)), delta[rows])
        found.append(manifold._replace(pair=rows[manifold.pair]))
    return joined(found)


def _meshes_plane(table: Primitives, i: Ints, j: Ints, delta: Floats) -> Manifold:
    found = []
    for pair, (mesh, plane) in enumerate(zip(i.tolist(), j.tolist())):
        manifold = mesh_plane(table.mesh(mesh), table.plane(plane), delta[pair])
        found.append(manifold._replace(pair=manifold.pair + pair))
    return joined(found)


_TOUCH: dict[tuple[int, int], Callable[[Primitives, Ints, Ints, Floats], Manifold]] = {
    (SPHERE, SPHERE): _spheres,
    (SPHERE, BOX): lambda t, i, j, delta: _single(sphere_box(t.sphere(i), t.box(j)), delta),
    (SPHERE, CAPSULE): lambda t, i, j, delta: _single(sphere_capsule(t.sphere(i), t.capsule(j)), delta),
    (SPHERE, PLANE): lambda t, i, j, delta: _single(sphere_plane(t.sphere(i), t.plane(j)), delta),
    (CAPSULE, CAPSULE): lambda t, i, j, delta: capsule_capsule(t.capsule(i), t.capsule(j), delta),
    (CAPSULE, BOX): lambda t, i, j, delta: capsule_box(t.capsule(i), t.box(j), delta),
    (CAPSULE, PLANE): lambda t, i, j, delta: capsule_plane(t.capsule(i), t.plane(j), delta),
    (BOX, BOX): lambda t, i, j, delta: box_box(t.box(i), t.box(j), delta),
    (BOX, PLANE): _box_plane,
    (SPHERE, MESH): lambda t, i, j, delta: _on_meshes(sphere_mesh, t.sphere, t, i, j, delta),
    (CAPSULE, MESH): lambda t, i, j, delta: _on_meshes(capsule_mesh, t.capsule, t, i, j, delta),
    (MESH, PLANE): _meshes_plane,
}
