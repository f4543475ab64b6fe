"""What presses bodies together beside the weight of a bed: parts, and tools with a force of their own."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from itertools import chain

import numpy as np

from dem import bodies
from dem.arrays import Floats
from dem.motion import Dynamic, Guided, Hinged
from dem.parts.ends import End
from dem.parts.named import Named, Pressing
from dem.scene import LargeBody, Scene, kinds_of
from dem.start.falls import box, free_path

CHAINS = 4.0  #: the strongest forces between grains over those that a like share of the load makes

WIDE = 1e6  #: half extents of a half space [m]


def pressing(scene: Scene) -> Pressing:
    """Of a scene at time zero, by its parts, its tools and its gravity. Laws of loads and motors without a limit of
    strength are not known."""
    with np.errstate(over="ignore", invalid="ignore"):  # what flies apart is told by its first step
        body = partial(_body, scene)
        found = [kind.pressing(members, scene, body) for _, kind, members in kinds_of(Named, scene.named)]
        found.append(_tools(scene, [push for each in found for push in each.pushes]))
    found.append(Pressing(accelerations=(scene.gravity,)))
    forces, *others = zip(*found)
    return Pressing(max(forces), *(tuple(chain.from_iterable(each)) for each in others))


def _body(scene: Scene, end: End) -> tuple[float, float, float]:
    """Mass [kg], least moment [kg m^2] and radius [m] of the body at the end of a part."""
    if end is None:
        return np.inf, np.inf, np.inf
    if isinstance(end, str):
        body = next(body for body in scene.large_bodies if body.name == end)
        return body.mass, float(body.inertia.min()), float(np.linalg.norm(_extent(body)))
    table = scene.row(end)
    return float(table.mass[0]), float(table.inertia.min()), float(bodies.bounding_radius(table)[0])


def _tools(scene: Scene, pushes: Sequence[tuple[str, Floats, float]]) -> Pressing:
    """The greatest force that a large body lays on a grain, by its weight, pushes on it and its drive, and how fast
    those come that meet a few grains alone, or none. Beneath a wide one a bed gives way, the more if it is a servo."""
    greatest, impacts = 0.0, []
    radius = float(bodies.bounding_radius(scene.expected()).min())
    count, falls = scene.count + scene.passages.most, math.hypot(*scene.gravity)
    for body in scene.large_bodies:
        motion = body.motion
        if not isinstance(motion, Dynamic):
            continue
        extent = _extent(body)
        force, torque = _given(scene, body, pushes)
        size = float(np.linalg.norm(force)) + torque / float(np.linalg.norm(extent))
        along = force / size if force.any() else np.eye(3)[int(np.argmin(extent))]
        wide = 4.0 * float(np.abs(along) @ (extent[[1, 2, 0]] * extent[[2, 0, 1]]))
        share = min(1.0, CHAINS / max(min(count, wide / (2.0 * radius) ** 2), 1.0))
        if share < 1.0 and getattr(motion, "speed", None) is not None:
            continue
        greatest = max(greatest, share * size)
        if share == 1.0 and force.any():
            way = max(free_path(scene, body, along) - (2.0 * radius if count else 0.0), 0.0)
            speed = math.sqrt(2.0 * size / body.mass * way)
            if isinstance(motion, Guided) and motion.speed is not None and motion.force >= body.mass * falls:
                speed = min(speed, abs(motion.speed))  # which the servo keeps
            impacts.append((body.mass, speed))
    return Pressing(greatest, impacts=tuple(impacts))


def _given(
    scene: Scene, body: LargeBody, pushes: Sequence[tuple[str, Floats, float]]
) -> tuple[Floats, float]:
    """The force (3,) [N] and the torque [N m] that move a large body."""
    motion, force, torque = body.motion, body.mass * scene.gravity, 0.0
    assert isinstance(motion, Dynamic)
    for name, push, twist in pushes:
        if name == body.name:
            force, torque = force + push, torque + twist
    force = motion.free_directions() @ force
    if isinstance(motion, Guided):
        force = force + motion.force * motion.line * (1.0 if motion.speed is None else np.sign(motion.speed))
    return force, abs(motion.torque) if isinstance(motion, Hinged) else torque * bool(motion.free_turns().any())


def _extent(body: LargeBody) -> Floats:
    """Half extents (3,) of the greatest shape of a body along the axes of the world [m]; half spaces are WIDE."""
    return np.minimum(np.max([box(body, shape)[1] for shape in body.shapes], axis=0), WIDE)
