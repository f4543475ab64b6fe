"""Changes of the motion of large bodies within a run; a changed body goes on from where it is.

All functions are called on all ranks alike, with the same arguments.
"""

from __future__ import annotations

import dataclasses
import json
from typing import Any

import numpy as np

from dem import motion as motions
from dem import quaternion
from dem.arrays import Floats
from dem.motion import Dynamic, Motion, Oscillation, Prescribed, checked_pose, time_gone
from dem.world import World

#: Parameters of motions by forces that a run cannot change, because the frame of the body depends on them.
KEPT = ("direction", "axis")


def changed(motion: Motion, time: float, **values: Any) -> Motion:
    """The motion with other parameters from `time` [s] on. An oscillation of another period stays in its phase, unless
    a phase is given. ValueError for a parameter that the motion does not have, or a bad value."""
    if not dataclasses.is_dataclass(motion):
        raise ValueError(f"{type(motion).__name__} is no dataclass, so its parameters cannot be changed within a run")
    names = [field.name for field in dataclasses.fields(motion)]
    for name in values:
        if name not in names:
            raise ValueError(f"{type(motion).__name__} has no {name}; it has {', '.join(names) or 'no parameters'}")
    after = dataclasses.replace(motion, **values)
    if isinstance(motion, Oscillation) and isinstance(after, Oscillation) and "phase" not in values:
        turns = [time_gone(time, each.start, each.end) / each.period for each in (motion, after)]
        after = dataclasses.replace(after, phase=motion.phase + 2.0 * np.pi * (turns[0] - turns[1]))
    return after


def set_motion(world: World, name: str, motion: Motion | None = None, **values: Any) -> None:
    """Give a large body another motion, or its own one with other `values` as of `changed`; it begins where it is now.
    ValueError for one that it cannot have: if forces move the body, they go on doing so along the same line or about
    the same axis; else they cannot begin to."""
    row = world.large_row(name)
    body = world.large_bodies[row]
    motion = changed(body.motion, world.time, **values) if motion is None else motion
    pose = body.position, body.quaternion
    if isinstance(body.motion, Dynamic) or isinstance(motion, Dynamic):
        if type(motion) is not type(body.motion) or not np.allclose(_kept(motion), _kept(body.motion), atol=1e-12):
            kind = f"{type(body.motion).__name__} with another drive" if isinstance(body.motion, Dynamic) else "a path"
            raise ValueError(f"body {name!r} cannot change its motion to {motion!r}: allowed is {kind}")
    else:
        pose = _leading_to(motion, world.time, world.large.position[row], world.large.quaternion[row])
    world.replace_large(dataclasses.replace(body, motion=motion, position=pose[0], quaternion=pose[1]))


def _kept(motion: Motion) -> list[float]:
    return [number for name in KEPT for number in getattr(motion, name, ())]


def _leading_to(motion: Prescribed, time: float, position: Floats, orientation: Floats) -> tuple[Floats, Floats]:
    """The pose at time zero of a body that the motion brings to this pose at `time`. ValueError if there is none."""
    shift, turn = checked_pose(motion, time, np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]))
    back = quaternion.conjugate(turn)
    start = quaternion.rotate(back, position - shift), quaternion.multiply(back, orientation)
    place, turned = checked_pose(motion, time, *start)
    size = np.abs([place, position]).max() + np.abs(shift).max()
    if np.abs(place - position).max() > 1e-9 * size or abs(turned @ orientation) < 1.0 - 1e-9:
        raise ValueError(f"{type(motion).__name__} does not displace the pose at time zero: the body would jump")
    return start


def changed_motions(world: World) -> str:
    """The motions that were changed as text, for `restore_motions`; empty if there are none."""
    found = {
        body.name: {
            "motion": type(body.motion).__name__,
            "values": {field.name: getattr(body.motion, field.name) for field in dataclasses.fields(body.motion)},
            "position": body.position,
            "quaternion": body.quaternion,
        }
        for body in world.large_bodies
        if body.name in world.changed
    }
    return json.dumps(found, default=lambda array: array.tolist()) if found else ""


def restore_motions(world: World, text: str) -> None:
    """Give the bodies of a world, made from its scene, the motions of `changed_motions`. ValueError if that fails."""
    for name, entry in json.loads(text).items():
        body = world.large_bodies[world.large_row(name)]
        own = type(body.motion)
        kind = own if own.__name__ == entry["motion"] else getattr(motions, entry["motion"], None)
        if kind is None:
            raise ValueError(f"body {name!r}: neither the scene nor dem.motion has the motion {entry['motion']}")
        place, turn = np.array(entry["position"]), np.array(entry["quaternion"])
        moved = dataclasses.replace(body, motion=kind(**entry["values"]), position=place, quaternion=turn)
        world.replace_large(moved)
