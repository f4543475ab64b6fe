"""What a run changes of the world: parts, motions and surfaces of large bodies, laws of contact, and the cell.

All ranks call these functions alike, with the same arguments. Checkpoints keep the changes.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping
from typing import Any

import numpy as np

from dem import checks, quaternion
from dem import motion as motions
from dem.arrays import Floats
from dem.checks import nearest
from dem.model.world import World
from dem.motion import Dynamic, Motion, Pose, Prescribed, checked_pose
from dem.parts import contact_law
from dem.parts.named import Named
from dem.scene import KINDS, LargeBody, checked_surface

CHANGED = (*KINDS, "body", "pair", "cell")  #: the kinds of what may be changed


def change(world: World, what: str, **values: Any) -> None:
    """Give a part other values from now on. ValueError for what is not there, and for values that it cannot have.

    `what` is a kind of `dem.scene.KINDS` and a name, such as "spring tie", with values of the class's `CHANGED`; "body
    belt" with `motion`, or parameters of its present one, and `surface_velocity`; "pair grains, steel" of two materials
    with coefficients of `dem.parts.contact_law.CHANGED`; or "cell" with `shear_rate`, `stress`, `strain_rate`. A part
    that is not there begins, if the class's `BEGINS` is among the values.
    """
    if not isinstance(what, str):
        raise ValueError(f"change {checks.short(what)}: allowed is a kind and a name, such as 'body belt'")
    kind, _, name = what.partition(" ")
    if kind not in CHANGED:
        allowed = f"allowed are {', '.join(CHANGED[:-1])} with a name, and cell"
        raise ValueError(f"{what!r}: {allowed}{nearest(kind, CHANGED)}")
    if not values:
        raise ValueError(f"{what}: no values; allowed are some by name, as in change('spring tie', length=0.5)")
    refuse_functions(what, values)
    if kind == "cell":
        _refuse_others(what, values, world.cell.CHANGED)
        then, grains = world.cell, world.grains
        world.cell = then.changed(world.time, **values)
        grains.velocity = world.cell.taken_along(then, grains.position, grains.velocity)
    elif kind == "body":
        _change_body(world, name, **values)
    elif kind == "pair":
        _change_pair(world, name, **values)
    else:
        _change_part(world, kind, name, **values)


def refuse_functions(what: str, values: Mapping[str, Any]) -> None:
    """ValueError for values that are functions, which a checkpoint could not keep."""
    for name, value in values.items():
        if callable(value):
            raise ValueError(f"{name} of {what} can be set to numbers within a run; a function comes from the scene")


def _change_part(world: World, kind: str, name: str, **values: Any) -> None:
    there: dict[str, Named] = world.named[kind]
    part, begins = there.get(name), KINDS[kind].BEGINS
    if part is None and begins in values:
        part = KINDS[kind](values[begins])  # type: ignore[call-arg]
    if part is None:
        how = f"; give {begins}=... to begin one" * bool(begins)
        raise ValueError(f"no {kind} {name!r}; there are: {', '.join(there) or 'none'}{nearest(name, there)}{how}")
    _refuse_others(f"{kind} {name!r}", values, part.CHANGED)
    _put(world, kind, name, part.changed(world.time, world.passages.tallies.get(name), **values))


def _put(world: World, kind: str, name: str, part: Named) -> None:
    part.refuse(name, world)
    world.named[kind][name] = part
    world.changed.add((kind, name))


def _change_pair(world: World, name: str, **values: float) -> None:
    i, j = _pair(world, name)
    _refuse_others(f"pair {name!r}", values, contact_law.CHANGED)
    world.pairs = contact_law.changed(world.pairs, i, j, values)
    world.changed.add(("pair", f"{world.materials[i]}, {world.materials[j]}"))


def _pair(world: World, name: str) -> tuple[int, int]:
    """The numbers of two materials that are named with a comma between them, the lower one first."""
    numbers = range(len(world.materials))
    found = [(i, j) for i in numbers for j in numbers if name == f"{world.materials[i]}, {world.materials[j]}"]
    if not found:
        raise ValueError(f"pair {name!r}: allowed are two, with a comma between, of {', '.join(world.materials)}")
    return min(found[0]), max(found[0])


# -- large bodies --------------------------------------------------------------------------------------------


def _change_body(world: World, name: str, motion: Motion | None = None, **values: Any) -> None:
    """Give a large body another motion, or its own one with other values as of `dem.motion.changed`; it begins where
    it is now. If forces move the body, they go on doing so along the same line or about the same axis; else they
    cannot begin to."""
    names = [body.name for body in world.large_bodies]
    if name not in names:
        raise ValueError(f"no large body {name!r}; there are: {', '.join(names) or 'none'}{nearest(name, names)}")
    row = names.index(name)
    body = world.large_bodies[row]
    if "surface_velocity" in values:
        body = dataclasses.replace(body, surface=checked_surface(name, values.pop("surface_velocity")))
    if motion is not None and values:
        raise ValueError(f"body {name!r}: allowed is a motion, or parameters of the present one, not both")
    if motion is not None or values:
        motion = motions.changed(body.motion, world.time, **values) if motion is None else motion
        pose = body.position, body.quaternion
        motions.refuse_ignored(motion)
        _refuse_other_freedoms(body, motion)
        if not isinstance(motion, Dynamic):
            pose = _leading_to(motion, world.time, world.large.position[row], world.large.quaternion[row])
        if _kind(body, type(motion).__name__) is not type(motion):
            kinds = ", ".join(dict.fromkeys([type(body.motion).__name__, *motions.KINDS]))
            raise ValueError(f"body {name!r} cannot change its motion to {motion!r}: allowed are {kinds}")
        body = dataclasses.replace(body, motion=motion, position=pose[0], quaternion=pose[1])
    world.replace_large(body)


def _refuse_other_freedoms(body: LargeBody, motion: Motion) -> None:
    """ValueError for a motion by which forces would move a body in other ways than by its own, or would begin to."""
    if not (isinstance(body.motion, Dynamic) or isinstance(motion, Dynamic)):
        return
    alike = type(motion) is type(body.motion)
    if not (alike and np.allclose(_free_projectors(motion), _free_projectors(body.motion), atol=1e-12)):
        kind = f"{type(body.motion).__name__} with another drive" if isinstance(body.motion, Dynamic) else "a path"
        raise ValueError(f"body {body.name!r} cannot change its motion to {motion!r}: allowed is {kind}")


def _free_projectors(motion: Any) -> Floats:
    """Projectors (2, 3, 3) on what forces and torques can move."""
    return np.array([motion.free_directions(), motion.free_turns()])


def _leading_to(motion: Prescribed, time: float, position: Floats, orientation: Floats) -> Pose:
    """The pose at time zero of a body that the motion brings to this pose at `time`. ValueError if there is none."""
    shift, turn = checked_pose(motion, time, np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]))
    inverse_turn = quaternion.conjugate(turn)
    start = quaternion.rotate(inverse_turn, position - shift), quaternion.multiply(inverse_turn, orientation)
    place, turned = checked_pose(motion, time, *start)
    size = np.abs([place, position]).max() + np.abs(shift).max()
    if np.abs(place - position).max() > 1e-9 * size or abs(turned @ orientation) < 1.0 - 1e-9:
        raise ValueError(f"{type(motion).__name__} does not displace the pose at time zero: the body would jump")
    return start


# -- checkpoints ---------------------------------------------------------------------------------------------


def changes(world: World) -> str:
    """What was changed of parts and large bodies, as JSON for `restore`."""
    found: dict[str, dict[str, Any]] = {}
    for kind, name in sorted(world.changed):
        if kind == "body":
            entry = _entry(world.large_bodies[world.large_row(name)])
        elif kind == "pair":
            i, j = _pair(world, name)
            entry = {key: float(getattr(world.pairs, key)[i, j]) for key in contact_law.CHANGED}
        else:
            part = world.named[kind][name]
            entry = {key: getattr(part, key) for key in part.KEPT}
        found.setdefault(kind, {})[name] = {key: value for key, value in entry.items() if not callable(value)}
    return json.dumps(found, default=lambda array: array.tolist())


def restore(world: World, text: str) -> None:
    """Give a world, made from its scene, what `changes` has. ValueError for what is none."""
    for kind, entries in json.loads(text).items():
        for name, entry in entries.items():
            if kind == "body":
                world.replace_large(_restored(world.large_bodies[world.large_row(name)], entry))
                continue
            if kind == "pair":
                _change_pair(world, name, **entry)
                continue
            part: Any = world.named[kind].get(name)
            if part is None and not KINDS[kind].BEGINS:
                raise ValueError(f"the scene has no {kind} {name!r}")
            part = KINDS[kind](None) if part is None else part  # type: ignore[call-arg]
            _refuse_others(f"{kind} {name!r}", entry, part.KEPT)
            _put(world, kind, name, dataclasses.replace(part, **entry))


def _entry(body: LargeBody) -> dict[str, Any]:
    values = {field.name: getattr(body.motion, field.name) for field in dataclasses.fields(body.motion)}
    kind = type(body.motion).__name__
    pose = {"position": body.position, "quaternion": body.quaternion}
    return {"motion": kind, "values": values, **pose, "surface": body.surface}


def _kind(body: LargeBody, name: str) -> type | None:
    """The class of motions of this name that a checkpoint of the body may have: its own, or one of `dem.motion`."""
    own = type(body.motion)
    return own if own.__name__ == name else motions.KINDS.get(name)


def _restored(body: LargeBody, entry: Mapping[str, Any]) -> LargeBody:
    """The body as an entry has it: its motion is one of `dem.motion` or that of the scene, with parameters that it has,
    by which the body can move, and the pose is one."""
    name, kind = body.name, _kind(body, entry["motion"])
    if kind is None:
        raise ValueError(f"body {name!r}: neither the scene nor dem.motion has the motion {entry['motion']}")
    if strange := sorted({*entry["values"]} - {field.name for field in dataclasses.fields(kind)}):
        raise ValueError(f"body {name!r}: its motion {kind.__name__} has no {strange[0]}")
    motion = kind(**entry["values"])
    _refuse_other_freedoms(body, motion)
    place = checks.vector(f"position of {name!r}", entry["position"])
    turn = checks.rows(f"quaternion of {name!r}", entry["quaternion"], 1, 4)[0]
    if abs(np.linalg.norm(turn) - 1.0) > 1e-6:
        raise ValueError(f"quaternion of {name!r} is {turn.tolist()}; allowed is one of unit norm")
    surface = checked_surface(name, entry["surface"]) if "surface" in entry else body.surface
    return dataclasses.replace(body, motion=motion, position=place, quaternion=turn, surface=surface)


def _refuse_others(what: str, values: Mapping[str, Any], allowed: tuple[str, ...]) -> None:
    for name in values:
        if name not in allowed:
            raise ValueError(f"{what}: {name} cannot be set; allowed are {', '.join(allowed)}{nearest(name, allowed)}")

