"""How far grains may go before they meet a body, and how fast they are then: by gravity, and by loads on them.

The ways are those of the box about the grains at time zero and of the regions of sources, straight along the
acceleration. They end at half spaces, boxes, meshes and other parts of large bodies that do not go with the grains.
Steep surfaces end no way; where none is left, a way has no end, and counts as none.
"""

from __future__ import annotations

import math
from itertools import product
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from dem import bodies, quaternion, shapes
from dem.arrays import Floats
from dem.bodies import BOX, CAPSULE, MESH, PLANE, Bodies
from dem.motion import Dynamic
from dem.shapes import Plane, Shape, placed

if TYPE_CHECKING:
    from dem.scene import LargeBody, Scene

STEEP = 0.1  #: cosine between the way and the normal of a surface below which it is a wall
DENSE = 0.64  #: solid fraction of a settled bed
CUBIC = np.pi / 6.0  #: solid fraction of a cubic lattice of spheres that touch


class Fall(NamedTuple):
    """Of the grains of a scene along an acceleration."""

    last: float  #: the greatest speed with which a grain meets a body or the bed of the others [m/s]
    block: float  #: the speed of all grains of time zero together where the first of them meets a body [m/s]
    gap: float  #: between the layers of these grains [m]
    column: float  #: their mass over the area of the box about them [kg/m^2]


NONE = Fall(0.0, 0.0, np.inf, 0.0)


def fall(scene: Scene, acceleration: Floats, start: float = 0.0) -> Fall:
    """The fall of the grains from time zero, with the speed `start` [m/s], at this acceleration (3,) [m/s^2]."""
    size = math.hypot(*acceleration)
    if size == 0.0:
        return NONE
    along, grains, every = acceleration / size, scene.survey(), scene.expected()
    planes, levels = ends(scene, along)
    if not len(planes) and not len(levels):
        return NONE
    halves = bodies.least_half_thickness(every)
    half = float(halves.min())
    first, gap, column = 0.0, np.inf, 0.0
    lasts = [_longest_path(_corners(*box), along, planes, levels) for box in scene.passages.boxes()]
    if grains.count:
        corners = _corners(grains.low, grains.high)
        bed, gap, column = _bed(scene, along, every)
        first = _shortest_path(corners, along, planes, levels) - half
        lasts += [_longest_path(corners, along, planes, levels) - bed, first + half]
    elif not lasts:  # large bodies alone: the highest falls on all others
        lasts = [_longest_path(every.position, along, planes, levels) - 2.0 * float(halves.sum() - half)]
    squares = (start * start + 2.0 * size * max(distance, 0.0) for distance in (max(lasts) - half, first))
    last, block = (math.sqrt(min(square, 1e300)) for square in squares)
    return Fall(last, block, gap, column)


def free_path(scene: Scene, body: LargeBody, along: Floats) -> float:
    """How far a large body may go along a direction (3,) before it meets another one, at most; 0 without an end [m]."""
    planes, levels = ends(scene, along, besides=body)
    corners = [_corners(-extent, extent) + place for place, extent in (box(body, shape) for shape in body.shapes)
               if np.isfinite(extent).all()]  # fmt: skip
    if not corners or not (len(planes) or len(levels)):
        return 0.0
    place = np.concatenate(corners)
    distances = _to_planes(place, along, planes) if len(planes) else levels.max() - place @ along
    return max(float(distances.min()), 0.0)


def area(scene: Scene, along: Floats) -> float:
    """The area [m^2] of the grains at time zero, as seen along a direction (3,): that of a rectangle of their spread,
    with grains at its edges."""
    grains = scene.survey()
    across = np.eye(3) - np.outer(along, along)
    spread = across @ grains.spread @ across / grains.count
    spread = np.sqrt(np.maximum(np.linalg.eigvalsh(spread), 0.0))[1:]  # in the plane across
    radius = grains.radius / grains.count
    width = np.sqrt(12.0) * spread + 2.0 * radius
    return float(width.prod())


def _bed(scene: Scene, along: Floats, every: Bodies) -> tuple[float, float, float]:
    """The thickness of the bed that the grains of time zero make along a direction (3,), and the gap between their
    layers, as in a cubic lattice of their solid fraction [m]; their mass over the area of the box about them
    [kg/m^2]."""
    grains = scene.survey()
    density = float((every.mass / shapes.volumes(every.shape, every.size)).max())
    volume, radius = grains.mass / density, grains.radius / grains.count
    wide = grains.high - grains.low + 2.0 * radius
    pitch = max((CUBIC * wide.prod() / volume) ** (1.0 / 3.0), 1.0)
    column = grains.mass / float(np.abs(along) @ (wide[[1, 2, 0]] * wide[[2, 0, 1]]))
    return volume / (area(scene, along) * DENSE), 2.0 * radius * (pitch - 1.0), column


def _corners(low: Floats, high: Floats) -> Floats:
    """Those (8, 3) of a box."""
    return np.array(list(product(*np.stack([low, high], axis=1))))


def _to_planes(place: Floats, along: Floats, planes: Floats) -> Floats:
    """From places (n, 3) along a direction to the nearest of half spaces (p, 2, 3) [m]; inf without."""
    drop = np.full(len(place), np.inf)
    for center, normal in planes:
        drop = np.minimum(drop, (place - center) @ normal / -(normal @ along))
    return drop


def _longest_path(place: Floats, along: Floats, planes: Floats, levels: Floats) -> float:
    """The longest way from places (n, 3): through a half space nothing goes, past other parts of bodies it may."""
    if len(planes):
        return float(_to_planes(place, along, planes).max())
    return float(levels.max() - (place @ along).min())


def _shortest_path(place: Floats, along: Floats, planes: Floats, levels: Floats) -> float:
    """The shortest way from places (n, 3) to a half space or to a part of a body beyond all of them."""
    distances = np.append(levels - (place @ along).max(), _to_planes(place, along, planes).min())
    ahead = distances[distances >= 0.0]
    return float(ahead.min(initial=np.inf)) if np.isfinite(ahead).any() else 0.0


def ends(scene: Scene, along: Floats, besides: LargeBody | None = None) -> tuple[Floats, Floats]:
    """What ends a way along a direction (3,): half spaces (p, 2, 3), a point and the normal of each; and of other
    parts of bodies the last place (l,) of a surface that faces the way, along it [m]."""
    planes, levels = [], []
    for body in scene.large_bodies:
        goes = isinstance(body.motion, Dynamic) and along @ body.motion.free_directions() @ along > 0.5
        for shape in () if goes or body is besides else body.shapes:
            if isinstance(shape, Plane):
                normal = quaternion.rotate(body.quaternion, np.array(shape.normal))
                if normal @ along < -STEEP:
                    planes.append((body.position + quaternion.rotate(body.quaternion, np.array(shape.center)), normal))
            elif np.isfinite(level := _level(body, shape, along)):
                levels.append(level)
    return np.array(planes).reshape(-1, 2, 3), np.array(levels)


def _level(body: LargeBody, shape: Shape, along: Floats) -> float:
    """The last place [m] along a direction (3,) of those surfaces of a shape that face it; -inf if none does."""
    kind, center, turn, size = placed(shape)
    middle = float((body.position + quaternion.rotate(body.quaternion, center)) @ along)
    share = along @ quaternion.matrix(quaternion.multiply(body.quaternion, turn))  # of the axes of the shape
    if kind == MESH:
        corner = shape.surface.vertex[shape.surface.triangle] @ share  # type: ignore[union-attr]
        faces = np.abs(shape.surface.normal @ share) > STEEP  # type: ignore[union-attr]
        return middle + float(corner[faces].max(initial=-np.inf))
    if kind == BOX:
        faces = np.abs(share) > STEEP
        reach = np.abs(share) * size
        return middle + float((reach.sum() - 2.0 * reach)[faces].max())
    return middle + (size[1] * abs(share[2]) if kind == CAPSULE else 0.0)


def box(body: LargeBody, shape: Shape) -> tuple[Floats, Floats]:
    """Centre (3,) and half extents (3,) along the axes of the world of a shape of a body [m]; inf of half spaces."""
    kind, center, turn, size = placed(shape)
    frame = quaternion.matrix(quaternion.multiply(body.quaternion, turn))
    place = body.position + quaternion.rotate(body.quaternion, center)
    if kind == PLANE:
        return place, np.full(3, np.inf)
    if kind in (BOX, MESH):
        return place, np.abs(frame) @ size
    return place, size[0] + np.abs(frame[:, 2]) * (size[1] if kind == CAPSULE else 0.0)
