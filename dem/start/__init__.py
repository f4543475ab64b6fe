"""Worlds from a scene at time zero, or from the state of an earlier run; each rank gets its grains."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import fields
from functools import partial

import numpy as np
from mpi4py import MPI

from dem import bodies, checks
from dem.arrays import Ints
from dem.bodies import Bodies
from dem.contact import find_contacts
from dem.contact.primitives import refuse_untouchable
from dem.exchange import exchange, refuse
from dem.model.images import wrap
from dem.model.partition import redistribute
from dem.model.world import World
from dem.parts.ends import Tie
from dem.parts.named import Force
from dem.scene import Scene, kinds_of, least_half
from dem.shapes.forms import Form
from dem.start import stiffness
from dem.together import together


def new_world(scene: Scene, comm: MPI.Comm, overlap: float = 0.01) -> World:
    """Return the scene at time zero, distributed; collective.

    Bodies of prescribed motion are where their motions put them at time zero. ValueError if nothing moves, or if
    bodies overlap by more than `overlap` half thicknesses (`refuse_overlap`); SceneError if a motion fails.
    """
    scene.survey(comm)
    rows = even_slice(scene.count, comm)
    world = _world(scene, comm, scene.cell.inside(scene.grains(rows.start, rows.stop)))
    world.put_large(world.poses(0.0))
    wrap(world)
    redistribute(world)
    refuse_overlap(world, overlap)
    return world


def restored_world(
    scene: Scene, comm: MPI.Comm, local: Mapping[str, np.ndarray], replicated: Mapping[str, np.ndarray]
) -> World:
    """Return the world whose `World.state` was taken, for the same scene; collective.

    `local`: the rows `restart_rows` of every local array. If the number of ranks is that of the state, the restored
    world is the same to the last bit; otherwise the grains are distributed anew. ValueError on all ranks if the scene
    has other bodies than the state, or if this is none that a run can have.
    """
    large = {field.name: np.array(replicated[f"large_{field.name}"]) for field in fields(Bodies)}
    other = [
        name
        for name, like in scene.large().columns().items()
        for column in (large[name], local[name])
        if (column.shape[1:], column.dtype.kind) != (like.shape[1:], like.dtype.kind)
    ]
    refuse(comm, f"arrays of other shapes or types: {', '.join(other)}" if other else "")
    world = _world(scene, comm, Bodies(**{name: np.array(column) for name, column in local.items()}))
    for part in ("passages", "cell"):
        restored = partial(getattr(world, part).restored, replicated)
        setattr(world, part, together(comm, f"restored {part}", restored, own=(ValueError,)))
    count = world.ids - world.passages.removed_count
    if world.slabs[-1] != count or len(large["id"]) != len(world.large):
        raise ValueError(
            f"the state has {world.slabs[-1]} grains and {len(large['id'])} large bodies, "
            f"the scene {count} and {len(world.large)}"
        )
    world.large = Bodies(**large)
    world.time, world.step = float(replicated["time"]), int(replicated["step"])
    for kind, acting, members in kinds_of(Force, world.named):
        memory = np.array(replicated.get(f"memory_{kind}", ()), float)
        if acting.MEMORY and memory.shape == (len(members), acting.MEMORY):
            world.memory[kind] = memory
    world.spare = float(replicated["spare"])
    _refuse_impossible(world)
    if len(replicated["slabs"]) != comm.size + 1:
        redistribute(world)
    return world


def _refuse_impossible(world: World) -> None:
    """ValueError on all ranks for a state that `dem.scene` would refuse to start with; collective."""
    wrong = [] if np.isfinite(world.time) and world.time >= 0.0 <= world.step else ["time or step"]
    wrong += [] if np.isfinite(world.spare) else ["spare"]
    for table, what in ((world.grains, "grain"), (world.large, "large body")):
        grains = what == "grain"
        heavy = np.concatenate([table.mass, table.inertia.ravel()])
        of_forms = (form.BASE + n for n, form in enumerate(world.forms))
        of_grains = (bodies.SPHERE, bodies.BOX, bodies.CAPSULE, *of_forms)
        kinds = np.isin(table.shape, of_grains if grains else (bodies.COMPOUND,))
        right = {
            "position": np.isfinite(table.position),
            "velocity": np.isfinite(table.velocity),
            "quaternion": np.abs(np.linalg.norm(table.quaternion, axis=1) - 1.0) < 1e-6,
            "mass or inertia": (heavy > 0.0) & (np.isfinite(heavy) if grains else True),
            "material": (table.material >= 0) & (table.material < len(world.materials)),
            "shape": kinds,
            "size": np.isfinite(table.size) & (table.size >= 0.0) & (table.size[:, :1] > 0.0 if grains else True),
            "form": np.array([_is_of(table, n, form) for n, form in enumerate(world.forms)]),
        }
        wrong += [f"{name} of a {what}" for name, good in right.items() if not good.all()]
    starts = np.arange(world.comm.size + 1) * world.ids // world.comm.size
    owner = np.clip(np.searchsorted(starts, world.grains.id, side="right") - 1, 0, world.comm.size - 1)
    ids = np.sort(exchange(world.comm, {"id": world.grains.id}, owner)["id"])
    most = starts[world.comm.rank : world.comm.rank + 2]
    missing = not world.passages.removed_count and len(ids) != most[1] - most[0]
    if missing or (np.diff(ids) <= 0).any() or ((ids < most[0]) | (ids >= most[1])).any():
        wrong.append("id of a grain")
    refuse(world.comm, f"a state that no run can have: {', '.join(wrong)}" if wrong else "")


def _is_of(table: Bodies, number: int, form: Form) -> bool:
    """Whether the grains of this form in a table have its sizes, times a scale if they have one."""
    size = table.size[table.shape == form.BASE + number] / form.size
    return bool(np.allclose(size, size[:, :1] if form.SCALES else 1.0, rtol=1e-9, atol=0.0))


def restart_rows(slabs: Ints, comm: MPI.Comm) -> slice:
    """Return rows of a whole state's grain arrays that this rank hands to `restored_world`; slabs as in the state."""
    if len(slabs) == comm.size + 1:
        return slice(int(slabs[comm.rank]), int(slabs[comm.rank + 1]))
    return even_slice(int(slabs[-1]), comm)


def even_slice(count: int, comm: MPI.Comm) -> slice:
    """Return this rank's part of so many rows, in the order of the ranks."""
    return slice(count * comm.rank // comm.size, count * (comm.rank + 1) // comm.size)


def _world(scene: Scene, comm: MPI.Comm, grains: Bodies) -> World:
    refuse_unknown(scene)
    pairs = comm.bcast(stiffness.pairs(scene))  # of one processor
    world = World(comm, tuple(scene.large_bodies), scene.gravity, pairs, scene.materials, grains, scene.large())
    world.named, world.cell = {kind: dict(members) for kind, members in scene.named.items()}, scene.cell
    world.forms = tuple(scene.forms)
    world.passages = scene.passages.counted(world.named["source"])
    world.initial, world.first_large = scene.count, scene.first_large
    number = {body.name: int(id) for body, id in zip(world.large_bodies, world.large.id)} | {None: -1}
    parts = [part for _, _, members in kinds_of(Tie, world.named) for part in members.values() if not part.touching]
    ids = [sorted(end if isinstance(end, int) else number[end] for end in part.ends) for part in parts]
    world.apart = np.unique(np.array([pair for pair in ids if pair[0] >= 0], float).reshape(-1, 2) @ [1.0, 1.0j])
    material, key = world.large.material, world.large.id[:, None] + 1j * world.large.id
    meet = (pairs.touching[material][:, material] > 0.0) & ~np.isin(key, world.apart)
    refuse_untouchable(scene.kinds, scene.large_bodies, meet)
    for members in world.named.values():
        for name, part in members.items():
            part.refuse(name, world)
    return world


def refuse_unknown(scene: Scene) -> None:
    """Raise ValueError for a name in `Scene.leaving` that no large body has."""
    names = [body.name for body in scene.large_bodies]
    for name in sorted(set(scene.leaving) - set(names)):
        allowed = f"allowed are {', '.join(names) or 'none'}{checks.nearest(name, names)}"
        raise ValueError(f"leaving: there is no large body {name!r}; {allowed}")


def refuse_overlap(world: World, overlap: float) -> None:
    """Raise ValueError on all ranks that names the worst pair, its place and the number of such contacts, if bodies
    overlap by more than `overlap` half thicknesses of the thinner one that forces move.

    Bodies at the ends of a part that do not touch each other may share a place, and so may those that no force can part
    (`held_overlap`)."""
    contacts = find_contacts(world, 0.0)
    table = contacts.near.bodies
    worst, many = (0.0, 0.0, -1, -1, [0.0] * 3), 0
    if len(contacts):
        half, large = bodies.least_half_thickness(table), table.shape == bodies.COMPOUND
        moves = bodies.is_dynamic(world.large)
        half[large] = np.where(moves, [least_half(body) for body in world.large_bodies], np.inf)
        relative = -contacts.gap / np.minimum(half[contacts.a], half[contacts.b])
        pair = np.stack([table.id[contacts.a], table.id[contacts.b]], axis=1)
        c = int(np.argmax(relative))
        many, place = int(np.count_nonzero(relative > overlap)), contacts.point[c].tolist()
        worst = (float(relative[c]), float(-contacts.gap[c]), int(pair[c, 0]), int(pair[c, 1]), place)
    relative_depth, depth, a, b, place = world.comm.allreduce(worst, MPI.MAX)
    if relative_depth > overlap:
        more, at = world.comm.allreduce(many) - 1, ", ".join(f"{x:.4g}" for x in place)
        pair = f"{world.name_of(a)} and {world.name_of(b)} overlap by {depth:g} m at ({at}) m"
        most = f"{relative_depth:.2g} half thicknesses, where {overlap:g} are allowed"
        raise ValueError(f"overlapping start: {pair}, {most}{f', as at {more} other contacts' if more else ''}")


def step_remark(world: World, dt: float) -> str:
    """Return what to say of a dt [s] that is too large for the grains as they are now, and a better one; empty if it is
    not; collective.

    A grain should not fall by more than its diameter from rest, dt <= sqrt(d / g), nor go further than two radii.
    """
    grains = world.grains
    radius = bodies.bounding_radius(grains)
    speed = np.sqrt((grains.velocity[:, :3] ** 2).sum(axis=1))
    least = world.comm.allreduce(float(radius.min(initial=np.inf)), MPI.MIN)
    passing = world.comm.allreduce(float((radius / np.maximum(speed, 1e-300)).min(initial=np.inf)), MPI.MIN)
    fall = np.sqrt(2.0 * least / max(math.hypot(*world.gravity), 1e-300))
    if dt <= min(fall, 2.0 * passing):
        return ""
    why = "a grain falls further than its diameter" if dt > fall else "a grain goes further than two of its radii"
    return f"dt {dt:g} s is too large: {why} in a step; take at most {0.95 * min(0.1 * fall, passing):.2g} s"
