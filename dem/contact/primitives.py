"""The primitives that a rank knows, in one table, and where pairs of them touch."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import combinations, combinations_with_replacement, product
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from dem import quaternion
from dem.arrays import Bools, Floats, Ints
from dem.bodies import BOX, CAPSULE, CLUMP, CONVEX, MESH, PLANE, POLYHEDRON, SPHERE, enclosing_radius
from dem.compiled import inlined, loop
from dem.contact.ahead import Course, Forms, Poses, guest_is_second, nearest_at_start, seen_from, turn_ahead, vector_of
from dem.contact.clumps import Members, members, more_numbers, spread
from dem.contact.convex import (
    Solids,
    Supports,
    arcs_of,
    flat_towards,
    solids,
    solids_planes,
    solids_solids,
    supports_of,
)
from dem.contact.meshes import PlacedMesh, capsule_mesh, flat_across, plane_mesh, sphere_mesh
from dem.contact.narrow import (
    Boxes,
    Capsules,
    Manifold,
    Planes,
    Spheres,
    Touch,
    capsule_box,
    capsule_capsule,
    capsule_plane,
    joined,
    manifold,
    sphere_capsule,
)
from dem.contact.polyhedra import (
    Hulls,
    Polyhedra,
    frames_of_hulls,
    hulls_of,
    polyhedra_planes,
    polyhedra_polyhedra,
    spheres_polyhedra,
)
from dem.contact.solid_meshes import NAMES, solid_mesh
from dem.contact.spheres import touch_spheres
from dem.geometry.vectors import turned
from dem.mesh import Mesh, Surface
from dem.motion import Dynamic
from dem.shapes import CONVEX_SHAPES, Shape, placed
from dem.shapes.convex import Convex, centred
from dem.shapes.forms import Form

if TYPE_CHECKING:
    from dem.model.neighbourhood import Neighbourhood
    from dem.scene import LargeBody


class Primitives(NamedTuple):
    """Spheres, polyhedra, capsules, half spaces and meshes in the world frame; first all grains, then parts of large
    bodies."""

    number: Ints  #: (n,) of the grain its id, of parts the numbers that follow: the same at all times
    row: Ints  #: (n,) row of the body
    kind: Ints  #: (n,) SPHERE, BOX, CAPSULE, PLANE, MESH, or POLYHEDRON or CONVEX and the number of the form
    center: Floats  #: (n, 3); a point of the surface of a half space, the middle of a mesh [m]
    quaternion: Floats  #: (n, 4)
    size: Floats  #: (n, 3) as of `dem.shapes.placed` [m]; the normals of half spaces are those in the world
    radius: Floats  #: (n,) of the sphere about the centre that encloses it, without meaning for half spaces [m]
    surfaces: dict[int, Surface]  #: of the meshes, by row
    hulls: Hulls  #: of boxes and of the polyhedra of the scene
    supports: Supports  #: of its other convex shapes
    curved: bool  #: whether any shape is one of `dem.shapes.CONVEX_SHAPES`
    bounded: bool  #: whether a part of a large body is no half space
    members: Members | None = None  #: the spheres of clumps; None in scenes without

    def moved(self, rows: Ints, center: Floats, turn: Floats) -> Primitives:
        """The shapes of these rows (m,) at other centres (m, 3) and quaternions (m, 4), without what else there is of
        primitives."""
        return self._replace(kind=self.kind[rows], size=self.size[rows], center=center, quaternion=turn)

    def tables(self) -> tuple[Forms, Poses, Floats]:
        """What the loops of `dem.contact.ahead` take of it."""
        return (self.kind, self.row, self.size, self.radius), (self.center, self.quaternion), self.hulls.inner

    def now(self, near: Neighbourhood) -> Primitives:
        """The same where the bodies are; parts come from the frames of their bodies."""
        table, first = near.bodies, near.grains + near.ghosts
        of_bodies, of_parts = (table.position, table.quaternion, table.size), (self.center, self.quaternion, self.size)
        center, turn, size = with_parts(first, self.row, self.kind, of_bodies, of_parts)
        return self._replace(center=center, quaternion=turn, size=size)

    def of_members(self, i: Ints, j: Ints, reach: Floats) -> tuple[Primitives, Ints, Ints, Floats]:
        """The table with the spheres of clumps in further rows, and the pairs i, j (m,) of it with their `reach` (m,),
        in which they stand for the clumps."""
        if self.members is None:
            return self, i, j, reach
        own, first, many = self.members, len(self.kind), len(self.members.row)
        radii = np.zeros((many, 3))
        radii[:, 0] = own.radius
        further = {
            "number": own.number, "row": own.row, "kind": np.full(many, SPHERE), "size": radii, "radius": own.radius,
            "center": own.now(self.center, self.quaternion), "quaternion": self.quaternion[own.row],
        }  # fmt: skip
        table = self._replace(**{k: np.concatenate([getattr(self, k), more]) for k, more in further.items()})
        return table, *spread(i, j, reach, own.start, first, table.kind, table.center, table.radius)

    def sphere(self, rows: Any) -> Spheres:
        return Spheres(self.center[rows], self.size[rows, 0])

    def box(self, rows: Any) -> Boxes:
        return Boxes(self.center[rows], quaternion.matrix(self.quaternion[rows]), self.size[rows])

    def polyhedron(self, rows: Any) -> Polyhedra:
        """Boxes are some."""
        rows = np.arange(rows.start, rows.stop) if isinstance(rows, slice) else rows
        given = self.kind, self.center, self.quaternion, self.size, self.hulls.radius
        return Polyhedra(*frames_of_hulls(*given, rows), self.hulls)

    def solid(self, rows: Any) -> Solids:
        """Any convex shape."""
        turn = quaternion.matrix(self.quaternion[rows])
        return solids(self.kind[rows], self.center[rows], turn, self.size[rows], self.hulls, self.supports)

    def capsule(self, rows: Any) -> Capsules:
        axis = quaternion.rotate(self.quaternion[rows], np.array([0.0, 0.0, 1.0]))
        return Capsules(self.center[rows], axis, self.size[rows, 1], self.size[rows, 0])

    def plane(self, rows: Any) -> Planes:
        return Planes(self.size[rows], self.center[rows])

    def mesh(self, row: int) -> PlacedMesh:
        return PlacedMesh(self.surfaces[row], self.center[row], quaternion.matrix(self.quaternion[row]))


def primitives(
    near: Neighbourhood, shapes: list[tuple[Shape, ...]], grains: int, forms: tuple[Form, ...] = (), ids: int = 0
) -> Primitives:
    """The table of the grains and ghosts of `near` and of the `shapes` of its large bodies, for `Primitives.now`; it
    has the places and sizes of the parts alone, in the frames of their bodies. Grains have ids
    below `grains`; so far those below `ids` were given away, and may have `forms`. ValueError if there are more than
    have names."""
    table, count, hulls = near.bodies, near.grains + near.ghosts, hulls_of(forms)
    row = count + np.repeat(np.arange(len(shapes)), [len(parts) for parts in shapes])
    parts_of = [shape for body in shapes for shape in body]
    kinds, centers, turns, sizes = zip(*(placed(shape) for shape in parts_of)) if parts_of else [()] * 4
    numbers = [forms.index(centred(shape)) if isinstance(shape, Convex) else 0 for shape in parts_of]
    center, turn, size = (np.reshape(c, (len(row), k)) for c, k in ((centers, 3), (turns, 4), (sizes, 3)))
    # that features may be distinct, of which polyhedra have the most but for meshes
    meshes = [NAMES * shape.surface.features if isinstance(shape, Mesh) else 1 for shape in parts_of]
    spans = [1 + (most - 1) // hulls.features for most in meshes]
    columns = {
        "number": (table.id, grains + np.cumsum([0, *spans])[:-1]),
        "row": (np.arange(count), row),
        "kind": (table.shape, np.array(kinds, np.int64) + np.array(numbers, np.int64)),
    }
    after = grains + sum(spans)
    last = after + more_numbers(forms, ids)
    if last > (most := most_numbers(hulls.features)):
        raise ValueError(
            f"{grains} grains and {last - grains} numbers of parts of bodies: their contacts have no keys; "
            f"allowed are {most} together"
        )
    both = {name: np.concatenate([of_grains[:count], of_parts]) for name, (of_grains, of_parts) in columns.items()}
    return Primitives(
        **both,
        center=center,
        quaternion=turn,
        size=size,
        radius=enclosing_radius(both["kind"], np.concatenate([table.size[:count], size])),
        surfaces={count + n: shape.surface for n, shape in enumerate(parts_of) if isinstance(shape, Mesh)},
        hulls=hulls,
        supports=supports_of(forms),
        curved=bool((both["kind"] >= CONVEX).any()),
        bounded=bool((columns["kind"][1] != PLANE).any()),
        members=members(table.take(slice(0, count)), forms, after),
    )


def most_numbers(features: int) -> int:
    """The most numbers of shapes: of the two numbers of a key one is this times a feature of so many."""
    return 2**53 // features


def extents(shapes: list[tuple[Shape, ...]]) -> Floats:
    """Distances (large,) of the furthest points of large bodies from their reference points [m]; half spaces, which
    have none, count with a metre."""

    def extent(shape: Shape) -> float:
        kind, center, _, size = placed(shape)
        return float(np.linalg.norm(center) + enclosing_radius(np.array([kind]), size[None])[0])

    return np.array([max(extent(shape) for shape in parts) for parts in shapes])


def touches(table: Primitives, i: Ints, j: Ints, delta: Floats, course: Course | None = None) -> Manifold:
    """All contacts of gap at most `delta` (m,) [m] of the pairs of rows i, j (m,), in their order, and in that of the
    features; normals point from i to j. With a course those that are not of spheres with spheres, half spaces or boxes
    are of guests that are where `dem.contact.ahead.seen_from` puts them, with gaps that are wider by their ways.

    Two half spaces have none; other pairs that have none are refused by `refuse_untouchable`.
    """
    pair, point, normal, gap, others = touch_spheres(
        table.kind, table.center, table.quaternion, table.size, i, j, delta
    )
    found = [Manifold(pair, np.zeros(len(pair), np.int64), Touch(point, normal, gap))]
    if not len(others):
        return found[0]
    number, guest, host, reach, sign, spans = by_kinds(table.kind, i, j, delta, others)
    center, turn = table.center[guest], table.quaternion[guest]
    if course is not None:
        center, turn, travel = seen_from(*table.tables(), course[:], guest, host)
        reach += travel
    guests = table.moved(guest, center, turn)
    for one, two, first, end in spans.tolist():
        if (one, two) in _TOUCH:
            here = slice(first, end)
            pair, feature, touch = _touching(table, (one, two), guests, host, reach, here)
            found.append(Manifold(of_all(pair, number[here], sign[here], touch.normal), feature, touch))
    found = [part for part in found if len(part.pair)] or found[:1]
    whole = joined(found) if len(found) > 1 else found[0]
    order = in_order(whole.pair, whole.feature, len(i))
    return Manifold(whole.pair[order], whole.feature[order], whole.touch.take(order)) if len(order) else whole


def touches_ahead(
    table: Primitives, i: Ints, j: Ints, delta: Floats, course: Course, grains: int
) -> tuple[Manifold, Floats, Floats, Floats, Floats]:
    """The contacts as `turn_ahead` gives them directions of the end of a step, and what this returns of them; the first
    rows of bodies, so many, are `grains`. A deep gap is no deeper than the pair overlaps at the start, and none is
    wider than `delta` there."""
    found = touches(table, i, j, delta, course)
    touch = (*found.touch, at_start(table, i, j, delta, found, course, grains))
    given = *table.tables(), course[:], (i, j, found.pair, delta), touch
    arcs = arcs_of(*given, table.supports[:]) if table.curved else np.zeros((0, 4, 3))
    moved, swing, linear, touched, deep, wider = turn_ahead(*given, arcs)
    if len(deep):
        pairs, row = np.unique(found.pair[deep], return_inverse=True)
        now, least = touches(table, i[pairs], j[pairs], delta[pairs]), delta[pairs]
        np.minimum.at(least, now.pair, now.touch.gap)
        found.touch.gap[deep] = np.maximum(linear[deep], least[row])
    if wider:
        wide = found.touch.gap > delta[found.pair]
        found = Manifold(found.pair[~wide], found.feature[~wide], found.touch.take(~wide))
        moved, swing, linear = moved[~wide], swing[~wide], linear[~wide]
        touched = touched[~wide] if len(touched) else touched
    return found, moved, swing, linear, touched


def at_start(
    table: Primitives, i: Ints, j: Ints, delta: Floats, found: Manifold, course: Course, grains: int
) -> Floats:
    """What contacts (nc,) of pairs of rows i, j (m,) are at the start of the step, as of `nearest_at_start`: of those
    with bodies of prescribed motion; and the normals of round guests on flat faces of hosts that impulses move. The
    normals of what touches are kept. Of others zeros; no row if there are none. The first rows of bodies, so many, are
    `grains`: these are no guests on faces, as what rests on a bed of them would tremble. Those of contacts that are
    found where bodies are `turn_ahead` knows."""
    none = np.zeros((0, 5))
    if not table.bounded:
        return none
    kind, part = table.kind, table.row >= grains
    given = part & (kind != PLANE) & ~course.moves[table.row]
    rolls = part & ((kind == SPHERE) | (kind == CAPSULE) | (kind >= CONVEX))
    if not (given.any() or rolls.any()):
        return none
    guest, host, swap = guests_and_hosts(kind, i, j, found.pair)
    before, ahead = np.zeros((len(found.pair), 5)), (kind != SPHERE) & (kind != BOX)
    if len(kept := np.flatnonzero((given[guest] | given[host]) & ((kind[guest] != SPHERE) | ahead[host]))):
        pairs, row = np.unique(found.pair[kept], return_inverse=True)
        now, sign = touches(table, i[pairs], j[pairs], delta[pairs]), np.where(swap[kept], -1.0, 1.0)
        of_pairs = table.tables()[0], table.hulls.inner, guest[kept], sign
        before[kept] = nearest_at_start(*of_pairs, row, found.touch.take(kept)[:], now.pair, now.touch[:])
    faces = course.moves[table.row] & (kind != SPHERE) & (kind != CAPSULE)
    rows = np.flatnonzero(faces[host] & rolls[guest])
    if len(rows):
        flat = rows[_on_faces(table, found, rows, host[rows], np.where(swap[rows], 1.0, -1.0)[:, None])]
        before[flat, :3] = found.touch.normal[flat]
    return before


def _on_faces(table: Primitives, found: Manifold, rows: Ints, host: Ints, sign: Floats) -> Bools:
    """Which of these contacts touch flat faces of their hosts, all (rows,)."""
    kind, away = table.kind[host], found.touch.normal[rows] * sign
    flat = kind == PLANE
    for row in table.surfaces:
        mesh, own = table.mesh(row), host == row
        flat[own] = flat_across(mesh.surface, found.feature[rows[own]], away[own] @ mesh.turn)
    own = (kind != PLANE) & (kind != MESH)
    flat[own] = flat_towards(table.solid(host[own]), away[own], table.hulls)
    return flat


def _touching(
    table: Primitives, kinds: tuple[int, int], guests: Primitives, host: Ints, delta: Floats, here: slice
) -> Manifold:
    """The contacts of those pairs, of all guests with the rows `host` (m,), that are of two kinds; with meshes mesh by
    mesh."""
    contacts, first, second = _TOUCH[kinds]
    further = (table.hulls,) if first is Primitives.solid or second is Primitives.solid else ()
    host, delta = host[here], delta[here]
    if second is not None:
        return contacts(first(guests, here), second(table, host), delta, *further)
    found = []
    for mesh in np.unique(host):
        rows = np.flatnonzero(host == mesh)
        contact = contacts(first(guests, here.start + rows), table.mesh(int(mesh)), delta[rows], *further)
        found.append(contact._replace(pair=rows[contact.pair]))
    return joined(found)


@loop
def with_parts(first, row, kind, bodies, parts):
    """Centres (n, 3), quaternions (n, 4) and sizes (n, 3) of shapes, of which those before the `first` part are the
    `bodies` in the same rows; each of the `parts`, which are in the frames of the bodies in their `row` (n,), goes with
    its body, and the normals of half spaces turn."""
    (position, turns, sizes), (offset, own, extent) = bodies, parts
    center, turn, size = np.empty((len(row), 3)), np.empty((len(row), 4)), np.empty((len(row), 3))
    for n in range(first):
        turn[n, 3] = turns[n, 3]
        for k in range(3):
            center[n, k], turn[n, k], size[n, k] = position[n, k], turns[n, k], sizes[n, k]
    for n in range(first, len(row)):
        p, q, part = turns[row[n]], own[n - first], n - first
        axis, twice = vector_of(p, 1), 2.0 * p[0]
        moved = turned(vector_of(offset[part], 0), axis, twice, 2.0)
        sized = turned(vector_of(extent[part], 0), axis, twice, 2.0)
        for k in range(3):
            center[n, k] = position[row[n], k] + moved[k]
            size[n, k] = sized[k] if kind[n] == PLANE else extent[part, k]
        turn[n, 0] = p[0] * q[0] - (p[1] * q[1] + p[2] * q[2] + p[3] * q[3])
        turn[n, 1] = p[0] * q[1] + q[0] * p[1] + (p[2] * q[3] - p[3] * q[2])
        turn[n, 2] = p[0] * q[2] + q[0] * p[2] + (p[3] * q[1] - p[1] * q[3])
        turn[n, 3] = p[0] * q[3] + q[0] * p[3] + (p[1] * q[2] - p[2] * q[1])
    return center, turn, size


@loop
def guests_and_hosts(kind, i, j, pairs):
    """Of some of the pairs of rows i, j of the shapes, by their numbers `pairs` (m,), the guests and the hosts (m,),
    and whether the second one is the guest."""
    guest, host = np.empty(len(pairs), np.int64), np.empty(len(pairs), np.int64)
    swap = np.empty(len(pairs), np.bool_)
    for n in range(len(pairs)):
        a, b = i[pairs[n]], j[pairs[n]]
        swap[n] = guest_is_second(kind[a], kind[b])
        guest[n], host[n] = (b, a) if swap[n] else (a, b)
    return guest, host, swap


@loop
def by_kinds(
    kind: Ints, i: Ints, j: Ints, reach: Floats, pairs: Ints
) -> tuple[Ints, Ints, Ints, Floats, Floats, Ints]:
    """Some of the pairs of rows i, j of the shapes, by their numbers `pairs` (m,), in the order of their kinds: these
    numbers, the guests, the hosts, the `reach`, and -1 where the second one is the guest, else 1 (m,); and for each two
    kinds that there are, as in `_TOUCH`, these, and the first and the end of their rows (k, 4)."""
    code, start = np.empty(len(pairs), np.int64), np.zeros(65, np.int64)
    number, guest, host = code.copy(), code.copy(), code.copy()
    far, sign = np.empty(len(pairs)), np.empty(len(pairs))
    for n in range(len(pairs)):
        one, two = kind[i[pairs[n]]], kind[j[pairs[n]]]
        one, two = (two, one) if guest_is_second(one, two) else (one, two)
        code[n] = 8 * kind_in_pairs(one) + kind_in_pairs(two)
        start[code[n] + 1] += 1
    many = 0
    for k in range(64):
        many += start[k + 1] > 0
        start[k + 1] += start[k]
    spans, found = np.empty((many, 4), np.int64), 0
    for k in range(64):
        if start[k + 1] > start[k]:
            spans[found, 0], spans[found, 1], spans[found, 2], spans[found, 3] = k // 8, k % 8, start[k], start[k + 1]
            found += 1
    for n in range(len(pairs)):
        a, b, to = i[pairs[n]], j[pairs[n]], start[code[n]]
        swap = guest_is_second(kind[a], kind[b])
        guest[to], host[to] = (b, a) if swap else (a, b)
        number[to], far[to], sign[to] = pairs[n], reach[pairs[n]], -1.0 if swap else 1.0
        start[code[n]] += 1
    return number, guest, host, far, sign, spans


@loop
def in_order(pair: Ints, feature: Ints, pairs: int) -> Ints:
    """The contacts (nc,) of so many pairs by their pairs, and by their features; none if they are in this order. They
    are counted into places by the pairs; of those of a pair, which are few, each goes before the greater ones."""
    sorted_already, start = True, np.zeros(pairs + 1, np.int64)
    for c in range(len(pair)):
        start[pair[c] + 1] += 1
        before = max(c - 1, 0)
        sorted_already &= pair[before] < pair[c] or (pair[before] == pair[c] and feature[before] <= feature[c])
    order = np.empty(0 if sorted_already else len(pair), np.int64)
    if sorted_already:
        return order
    for n in range(pairs):
        start[n + 1] += start[n]
    end = start[:-1].copy()
    for c in range(len(pair)):
        first, to = start[pair[c]], end[pair[c]]
        end[pair[c]] += 1
        while to > first and feature[order[to - 1]] > feature[c]:
            order[to] = order[to - 1]
            to -= 1
        order[to] = c
    return order


@loop
def of_all(pair: Ints, number: Ints, sign: Floats, normal: Floats) -> Ints:
    """The `number` (m,) of the pair of each contact (nc,), whose normals (nc, 3) get its `sign` (m,)."""
    out = np.empty(len(pair), np.int64)
    for c in range(len(pair)):
        out[c] = number[pair[c]]
        for k in range(3):
            normal[c, k] *= sign[pair[c]]
    return out


#: The kinds of polyhedra that are no boxes, and of other convex shapes, in pairs: clumps are their spheres there.
_POLYHEDRON, _CONVEX = CLUMP, CLUMP + 1


@inlined
def kind_in_pairs(kind):
    return _CONVEX if kind >= CONVEX else _POLYHEDRON if kind >= POLYHEDRON else kind


#: For pairs of kinds, of guest and host (`dem.contact.ahead.RANK`), the contacts, and what these take of each of the
#: two; None: mesh by mesh.
_TOUCH: dict[tuple[int, int], tuple[Callable[..., Manifold], Callable[..., Any], Callable[..., Any] | None]] = {
    (SPHERE, CAPSULE): (
        lambda ball, capsule, delta: manifold(delta, [sphere_capsule(ball, capsule)]),
        Primitives.sphere, Primitives.capsule,
    ),
    (CAPSULE, CAPSULE): (capsule_capsule, Primitives.capsule, Primitives.capsule),
    (CAPSULE, BOX): (capsule_box, Primitives.capsule, Primitives.box),
    (CAPSULE, PLANE): (capsule_plane, Primitives.capsule, Primitives.plane),
    (BOX, BOX): (polyhedra_polyhedra, Primitives.polyhedron, Primitives.polyhedron),
    (BOX, _POLYHEDRON): (polyhedra_polyhedra, Primitives.polyhedron, Primitives.polyhedron),
    (_POLYHEDRON, _POLYHEDRON): (polyhedra_polyhedra, Primitives.polyhedron, Primitives.polyhedron),
    (SPHERE, _POLYHEDRON): (spheres_polyhedra, Primitives.sphere, Primitives.polyhedron),
    (BOX, PLANE): (polyhedra_planes, Primitives.polyhedron, Primitives.plane),
    (_POLYHEDRON, PLANE): (polyhedra_planes, Primitives.polyhedron, Primitives.plane),
    **{(kind, _CONVEX): (solids_solids, Primitives.solid, Primitives.solid) for kind in (SPHERE, CAPSULE, _CONVEX)},
    **{(_CONVEX, kind): (solids_solids, Primitives.solid, Primitives.solid) for kind in (BOX, _POLYHEDRON)},
    (CAPSULE, _POLYHEDRON): (solids_solids, Primitives.solid, Primitives.solid),
    (_CONVEX, PLANE): (solids_planes, Primitives.solid, Primitives.plane),
    (SPHERE, MESH): (sphere_mesh, Primitives.sphere, None),
    (CAPSULE, MESH): (capsule_mesh, Primitives.capsule, None),
    **{(kind, MESH): (solid_mesh, Primitives.solid, None) for kind in (BOX, _POLYHEDRON, _CONVEX)},
    (PLANE, MESH): (plane_mesh, Primitives.plane, None),
}  # fmt: skip

#: What messages call the kinds of pairs.
_NAMES = {
    SPHERE: "spheres", BOX: "boxes", CAPSULE: "capsules", _POLYHEDRON: "polyhedra", PLANE: "planes", MESH: "meshes",
    _CONVEX: " or ".join(f"{shape.__name__.lower()}s" for shape in CONVEX_SHAPES),
}  # fmt: skip


def _can_touch(one: int, other: int) -> bool:
    """Whether there are contacts of these kinds of pairs; of two half spaces there need be none."""
    first = SPHERE in (one, other) and {one, other} <= {SPHERE, PLANE, BOX}  # `touch_spheres`
    return first or one == other == PLANE or (one, other) in _TOUCH or (other, one) in _TOUCH


def _in_pairs(kind: int) -> int:
    """The kind that stands for one in `_TOUCH`; that of clumps is the one of their spheres."""
    if kind >= CLUMP:
        return _CONVEX if kind >= CONVEX else _POLYHEDRON if kind >= POLYHEDRON else SPHERE
    return kind


def refuse_untouchable(grains: Sequence[int], large_bodies: Sequence[LargeBody], meet: Bools) -> None:
    """ValueError for kinds of grains, and shapes of large bodies, that might meet and have no contacts; `meet` (large,
    large) tells of which pairs of large bodies, the first before the second, contacts are wanted."""
    of_grains = [(f"grains that are {_NAMES[kind]}", kind) for kind in sorted({_in_pairs(kind) for kind in grains})]
    pairs = list(combinations_with_replacement(of_grains, 2))
    shapes = [[(f"the {type(s).__name__.lower()} of {b.name!r}", _in_pairs(placed(s)[0])) for s in b.shapes]
              for b in large_bodies]
    pairs += [(grain, part) for parts in shapes for part in parts for grain in of_grains]
    moves = [isinstance(body.motion, Dynamic) for body in large_bodies]
    for one, other in combinations(range(len(shapes)), 2):
        if meet[one, other] and (moves[one] or moves[other]):
            pairs += product(shapes[other], shapes[one])
    for (first, kind), (second, host) in pairs:
        if not _can_touch(kind, host):
            allowed = [name for known, name in _NAMES.items() if _can_touch(known, host)]
            raise ValueError(f"{first} cannot touch {second}: allowed are {', '.join(allowed)}")
