"""What presses bodies together beside the weight of a bed: springs, loads, motors, tools with a force of their own."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from dem import bodies, quaternion
from dem.arrays import Floats
from dem.motion import Dynamic, Guided, Hinged
from dem.parts.springs import End
from dem.scene import LargeBody, Scene
from dem.start.falls import box, way_of

CHAINS = 4.0  #: the strongest forces between grains over those that a like share of the load makes

WIDE = 1e6  #: half extents of a half space [m]


class Pressing(NamedTuple):
    """Beside the weight of the grains."""

    force: float  #: the greatest on one body [N]
    spread: list[Floats]  #: forces (3,) on all grains together [N]
    accelerations: list[Floats]  #: (3,) of grains by gravity and loads [m/s^2]
    impacts: list[tuple[float, float]]  #: masses [kg] that come with speeds [m/s]
    highest: float  #: frequency of the springs, at most [1/s]


def pressing(scene: Scene) -> Pressing:
    """Of a scene at time zero. Laws of loads and motors without a limit of strength are not known."""
    with np.errstate(over="ignore", invalid="ignore"):  # what flies apart is told by its first step
        spring, meets, highest = _springs(scene)
        load, spread, accelerations = _loads(scene)
        tool, strikes = _tools(scene)
        motor, turns = _motors(scene)
    force = max(spring, load, tool, motor)
    return Pressing(force, spread, accelerations, [*meets, *strikes, *turns], highest)


def _body(scene: Scene, end: End) -> tuple[float, float, float]:
    """Mass [kg], least moment [kg m^2] and radius [m] of the body at an end of a spring or joint."""
    if end is None:
        return np.inf, np.inf, np.inf
    if isinstance(end, str):
        body = next(body for body in scene.large_bodies if body.name == end)
        return body.mass, float(body.inertia.min()), float(np.linalg.norm(_extent(body)))
    table = scene.row(end)
    return float(table.mass[0]), float(table.inertia.min()), float(bodies.bounding_radius(table)[0])


def _springs(scene: Scene) -> tuple[float, list[tuple[float, float]], float]:
    """The greatest force on a body, what springs let meet, and a bound of their frequencies, see
    `dem.parts.springs.impulses`."""
    ends: dict[End, list[tuple[float, float, float]]] = {}
    impacts = []
    for spring in scene.springs.values():
        poses = [scene.pose("spring", end) for end in spring.ends]
        places = [place + quaternion.rotate(turn, np.array(at)) for (place, turn), at in zip(poses, spring.anchors)]
        stretch = abs(float(np.linalg.norm(places[1] - places[0])) - spring.length)
        force, light = spring.stiffness * stretch, 0.0
        for end, at in zip(spring.ends, spring.anchors):
            ends.setdefault(end, []).append((force, math.sqrt(spring.stiffness), math.hypot(*at)))
            light += 1.0 / _body(scene, end)[0]
        if light > 0.0 and force > 0.0:
            damped = force / spring.damping if spring.damping > 0.0 else np.inf
            impacts.append((1.0 / light, min(stretch * math.sqrt(spring.stiffness * light), damped)))
    greatest, square = 0.0, 0.0
    for end, held in ends.items():
        mass, moment, _ = _body(scene, end)
        force, root, arm = np.array(held).T
        greatest = max(greatest, float(force.sum()))
        square = max(square, float((root * (root.sum() / mass + arm * (root @ arm) / moment)).max()))
    return greatest, impacts, math.sqrt(2.0 * square)


def _loads(scene: Scene) -> tuple[float, list[Floats], list[Floats]]:
    """The greatest force of loads on a grain, their sums (3,) over grains, and the accelerations (3,) of grains."""
    single, accelerations = 0.0, [scene.gravity]
    spread: list[Floats] = []
    names = {body.name for body in scene.large_bodies}
    every = scene.expected()
    half, mass = (float(values.min()) for values in (bodies.least_half_thickness(every), every.mass))
    for load in scene.loads.values():
        if load.on in names:
            continue
        force, torque = (np.zeros(3) if callable(given) else np.array(given) for given in (load.force, load.torque))
        each = np.linalg.norm(np.atleast_2d(force), axis=1)
        single = max(single, float(each.max()), float(np.linalg.norm(np.atleast_2d(torque), axis=1).max()) / half)
        count = scene.count if load.on is None else len(load.on)
        if isinstance(load.on, str):
            number = scene.materials.index(load.on) if load.on in scene.materials else -1
            count = sum(int(np.full(part.count, part.material == number).sum()) for part in scene.parts)
        spread.append(np.array(count * force if force.ndim == 1 else force.sum(axis=0)))
        accelerations.append(scene.gravity + np.atleast_2d(force)[each.argmax()] / mass)
    return single, spread, accelerations


def _tools(scene: Scene) -> tuple[float, list[tuple[float, float]]]:
    """The greatest force that a large body lays on a grain, by its weight, its loads and its drive, and how fast those
    come that meet a few grains alone, or none. Beneath a wide one a bed gives way, the more so if it is a servo."""
    greatest, impacts = 0.0, []
    radius = float(bodies.bounding_radius(scene.expected()).min())
    count, falls = np.inf if scene.sources else float(scene.count), math.hypot(*scene.gravity)
    for body in scene.large_bodies:
        motion = body.motion
        if not isinstance(motion, Dynamic):
            continue
        extent = _extent(body)
        force, torque = _given(scene, body)
        size = float(np.linalg.norm(force)) + torque / float(np.linalg.norm(extent))
        along = force / size if force.any() else np.eye(3)[int(np.argmin(extent))]
        wide = 4.0 * float(np.abs(along) @ (extent[[1, 2, 0]] * extent[[2, 0, 1]]))
        share = min(1.0, CHAINS / max(min(count, wide / (2.0 * radius) ** 2), 1.0))
        if share < 1.0 and getattr(motion, "speed", None) is not None:
            continue
        greatest = max(greatest, share * size)
        if share == 1.0 and force.any():
            way = max(way_of(scene, body, along) - (2.0 * radius if count else 0.0), 0.0)
            speed = math.sqrt(2.0 * size / body.mass * way)
            if isinstance(motion, Guided) and motion.speed is not None and motion.force >= body.mass * falls:
                speed = min(speed, abs(motion.speed))  # which the servo keeps
            impacts.append((body.mass, speed))
    return greatest, impacts


def _given(scene: Scene, body: LargeBody) -> tuple[Floats, float]:
    """The force (3,) [N] and the torque [N m] that move a large body, but for laws of loads."""
    motion, force, torque = body.motion, body.mass * scene.gravity, 0.0
    assert isinstance(motion, Dynamic)
    for load in scene.loads.values():
        if load.on == body.name:
            force = force + (0.0 if callable(load.force) else np.array(load.force))
            torque += 0.0 if callable(load.torque) else float(np.linalg.norm(load.torque))
    force = motion.free_directions() @ force
    if isinstance(motion, Guided):
        force = force + motion.force * motion.line * (1.0 if motion.speed is None else np.sign(motion.speed))
    return force, abs(motion.torque) if isinstance(motion, Hinged) else torque * bool(motion.free_turns().any())


def _motors(scene: Scene) -> tuple[float, list[tuple[float, float]]]:
    """The greatest force of the motors of joints and of servos, and the lighter bodies of joints with their speeds."""
    greatest, impacts = 0.0, []
    for joint in scene.joints.values():
        if not joint.driven:
            continue
        mass, _, radius = min(_body(scene, end) for end in joint.ends)
        lever = radius if joint.kind == "hinge" else 1.0
        if np.isfinite(joint.strength):
            greatest = max(greatest, joint.strength / lever)
        if joint.speed is not None and np.isfinite(mass):
            impacts.append((mass, abs(joint.speed) * lever))
    return greatest, impacts


def _extent(body: LargeBody) -> Floats:
    """Half extents (3,) of the greatest shape of a body along the axes of the world [m]; half spaces are WIDE."""
    return np.minimum(np.max([box(body, shape)[1] for shape in body.shapes], axis=0), WIDE)
