"""The contacts of a rank."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from dem import bodies, quaternion
from dem.arrays import Bools, Floats, Ints
from dem.bodies import BOX, SPHERE, Bodies
from dem.checks import not_negative
from dem.contact.broad import close_pairs
from dem.contact.narrow import (
    CORNERS,
    Touch,
    boxes_within,
    corner_plane,
    sphere_box,
    sphere_plane,
    sphere_sphere,
)
from dem.neighbourhood import Neighbourhood, neighbourhood
from dem.shapes import Box, Plane, Shape

if TYPE_CHECKING:
    from dem.world import World

#: Contacts that one pair of shapes can have at a time (a box lies on a plane with its eight corners).
FEATURES = 8


@dataclass(frozen=True)
class Contacts:
    """The contacts of this rank, ordered by the row of the body that owns them and then by key."""

    key: Ints  #: (nc,) the same for the same two shapes and feature at all times and on any number of ranks
    a: Ints  #: (nc,) row of the first body in `near.bodies`, the one of lower id
    b: Ints  #: (nc,) row of the second body in `near.bodies`
    body: Ints  #: (nc, 2) global indices of the two bodies
    point: Floats  #: (nc, 3) middle between the surfaces [m]
    normal: Floats  #: (nc, 3) unit vector from a to b
    gap: Floats  #: (nc,) signed distance, negative if the bodies overlap [m]
    friction: Floats  #: (nc,) coefficient
    near: Neighbourhood  #: the bodies of the rows `a` and `b`

    def __len__(self) -> int:
        return len(self.key)


class _Hits(NamedTuple):
    """Contacts of one kind of pair."""

    a: Ints  # rows of the bodies
    b: Ints
    shape_a: Ints  # numbers of the shapes
    shape_b: Ints
    feature: Ints  # number of the contact among those of the two shapes
    touch: Touch


def find_contacts(world: World, delta: float) -> Contacts:
    """All contacts of gap at most `delta` [m] that this rank owns; collective.

    A contact belongs to the rank that owns the body of lower global index. The numbers of contacts that the
    grains own are left in `world.grains.weight`. NotImplementedError, on all ranks, if boxes come within
    reach of boxes.
    """
    not_negative("contact distance delta", delta)
    near = neighbourhood(world, delta)
    found, clashes = _grain_pairs(near, delta)
    # Shapes are numbered: a grain is one shape, whose number is its id; those of the large bodies follow.
    shape = int(world.slabs[-1])
    for row, body in enumerate(world.large_bodies, start=near.grains + near.ghosts):
        for part in body.shapes:
            hits, boxes = _grains_on_shape(near, row, part, shape, delta)
            found += hits
            clashes += [f"box {grain} and body {body.name!r}" for grain in boxes]
            shape += 1
    _refuse(world, clashes)

    a, b, shape_a, shape_b, feature = (np.concatenate(parts) for parts in list(zip(*found))[:5])
    touch = Touch(*(np.concatenate(parts) for parts in zip(*(hits.touch for hits in found))))
    key = (shape_a * shape + shape_b) * FEATURES + feature
    owner = np.minimum(a, b)  # the local grains are the first rows, and ghosts come from higher ranks only
    order = np.lexsort((key, owner))
    a, b = a[order], b[order]
    world.grains.weight = np.bincount(owner, minlength=near.grains).astype(np.float64)
    material = near.bodies.material
    return Contacts(
        key=key[order],
        a=a,
        b=b,
        body=np.stack([near.index[a], near.index[b]], axis=1),
        point=touch.point[order],
        normal=touch.normal[order],
        gap=touch.gap[order],
        friction=world.friction[material[a], material[b]],
        near=near,
    )


def _grain_pairs(near: Neighbourhood, delta: float) -> tuple[list[_Hits], list[str]]:
    """Contacts among local grains and ghosts, and the names of pairs of boxes in reach."""
    table = near.bodies
    count = near.grains + near.ghosts
    pairs = close_pairs(table.position[:count], bodies.bounding_radius(table)[:count], delta)
    if near.ghosts:
        pairs = pairs[pairs[:, 0] < near.grains]
    swap = table.id[pairs[:, 0]] > table.id[pairs[:, 1]]
    a, b = np.where(swap, pairs[:, 1], pairs[:, 0]), np.where(swap, pairs[:, 0], pairs[:, 1])
    box_a, box_b = table.shape[a] == BOX, table.shape[b] == BOX

    def kind(mask: Bools) -> tuple[Ints, Ints]:
        return a[mask], b[mask]

    found = []
    i, j = kind(~box_a & ~box_b)
    x, radius = table.position, table.size[:, 0]
    found.append(_hits(table, i, j, sphere_sphere(x[i], radius[i], x[j], radius[j]), delta))
    i, j = kind(~box_a & box_b)
    found.append(_hits(table, i, j, sphere_box(x[i], radius[i], x[j], *_frames(table, j)), delta))
    i, j = kind(box_a & ~box_b)
    found.append(_hits(table, i, j, _reversed(sphere_box(x[j], radius[j], x[i], *_frames(table, i))), delta))
    i, j = kind(box_a & box_b)
    meet = boxes_within(x[i], *_frames(table, i), x[j], *_frames(table, j), delta)
    clashes = [f"boxes {table.id[p]} and {table.id[q]}" for p, q in zip(i[meet], j[meet])]
    return found, clashes


def _grains_on_shape(
    near: Neighbourhood, row: int, part: Shape, shape: int, delta: float
) -> tuple[list[_Hits], Ints]:
    """Contacts of the local grains with one shape, of number `shape`, of the large body in `row`, and the ids
    of box grains in reach of a box."""
    table = near.bodies
    body_turn = table.quaternion[row]
    center = table.position[row] + quaternion.rotate(body_turn, np.array(part.center))
    kinds = table.shape[: near.grains]
    spheres, boxes = np.flatnonzero(kinds == SPHERE), np.flatnonzero(kinds == BOX)
    none = np.zeros(0, np.int64)

    def hits(rows: Ints, touch: Touch, feature: Ints | None = None) -> _Hits:
        return _hits(table, rows, np.full(len(rows), row), touch, delta, np.full(len(rows), shape), feature)

    x, radius = table.position[spheres], table.size[spheres, 0]
    if isinstance(part, Plane):
        outward = quaternion.rotate(body_turn, np.array(part.normal))
        tips = np.repeat(boxes, len(CORNERS))
        corner = np.tile(np.arange(len(CORNERS)), len(boxes))
        on_corner = corner_plane(table.position[tips], *_frames(table, tips), corner, outward, center)
        return [hits(spheres, sphere_plane(x, radius, outward, center)), hits(tips, on_corner, corner)], none
    if isinstance(part, Box):
        frame = quaternion.matrix(quaternion.multiply(body_turn, np.array(part.quaternion)))
        half = np.array(part.half_extents)
        close = np.linalg.norm(x - center, axis=1) <= radius + np.linalg.norm(half) + delta
        spheres, x, radius = spheres[close], x[close], radius[close]
        meet = boxes_within(table.position[boxes], *_frames(table, boxes), center, frame[None], half, delta)
        return [hits(spheres, sphere_box(x, radius, center, frame, half))], table.id[boxes[meet]]
    other = np.full(len(spheres), part.radius)
    on_box = sphere_box(center[None], np.array(part.radius), table.position[boxes], *_frames(table, boxes))
    return [hits(spheres, sphere_sphere(x, radius, center, other)), hits(boxes, _reversed(on_box))], none


def _hits(
    table: Bodies,
    a: Ints,
    b: Ints,
    touch: Touch,
    delta: float,
    shape_b: Ints | None = None,
    feature: Ints | None = None,
) -> _Hits:
    """The touches of gap at most delta; the shape of b is the grain itself unless given."""
    near = np.flatnonzero(touch.gap <= delta)
    a, b = a[near], b[near]
    return _Hits(
        a,
        b,
        table.id[a],
        table.id[b] if shape_b is None else shape_b[near],
        np.zeros(len(near), np.int64) if feature is None else feature[near],
        Touch(*(values[near] for values in touch)),
    )


def _frames(table: Bodies, rows: Ints) -> tuple[Floats, Floats]:
    """Rotation matrices (m, 3, 3) and half extents (m, 3) of boxes."""
    return quaternion.matrix(table.quaternion[rows]), table.size[rows]


def _reversed(touch: Touch) -> Touch:
    return touch._replace(normal=-touch.normal)


def _refuse(world: World, clashes: list[str]) -> None:
    everywhere = world.comm.allreduce(clashes)
    if everywhere:
        raise NotImplementedError(
            f"contact of boxes with boxes is not supported: {everywhere[0]} are within reach"
        )
