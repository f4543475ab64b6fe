"""Worlds from a scene at time zero, or from the state of an earlier run; each rank gets its grains."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import fields, replace

import numpy as np
from mpi4py import MPI

from dem import bodies
from dem.arrays import Ints
from dem.bodies import Bodies
from dem.contact import find_contacts
from dem.contact.primitives import refuse_untouchable
from dem.exchange import exchange, refuse
from dem.model.changes import refuse_load
from dem.model.partition import redistribute
from dem.model.period import put_back, velocity_in_cell, wrapped
from dem.model.world import Servo, Shear, World
from dem.parts.sources import Tally, from_array
from dem.scene import Scene, least_half
from dem.shapes.forms import Form
from dem.start import stiffness


def new_world(scene: Scene, comm: MPI.Comm, overlap: float = 0.01) -> World:
    """The scene at time zero, distributed; collective.

    Bodies of prescribed motion are where their motions put them at time zero. ValueError if nothing moves, or if
    bodies overlap by more than `overlap` half thicknesses (`refuse_overlap`); SceneError if a motion fails.
    """
    scene.survey(comm)
    rows = even_slice(scene.count, comm)
    grains = scene.grains(rows.start, rows.stop)
    grains.velocity = velocity_in_cell(grains.position, grains.velocity, _shear(scene))
    grains.position = wrapped(grains.position, scene.period, _shear(scene))
    world = _world(scene, comm, grains)
    world.put_large(world.poses(0.0))
    put_back(world)
    redistribute(world)
    refuse_overlap(world, overlap)
    return world


def restored_world(
    scene: Scene, comm: MPI.Comm, local: Mapping[str, np.ndarray], replicated: Mapping[str, np.ndarray]
) -> World:
    """The world whose `World.state` was taken, for the same scene; collective.

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
    if world.tallies:
        world.tallies = from_array([*world.tallies], np.array(replicated.get("tallies", ())))
    count = world.ids - sum(world.tallies[name].count for name in world.outlets)
    if world.slabs[-1] != count or len(large["id"]) != len(world.large):
        raise ValueError(
            f"the state has {world.slabs[-1]} grains and {len(large['id'])} large bodies, "
            f"the scene {count} and {len(world.large)}"
        )
    world.large = Bodies(**large)
    world.time, world.step = float(replicated["time"]), int(replicated["step"])
    expected = np.array(replicated["expected"]) if "expected" in replicated else None
    world.expected = expected if expected is not None and expected.shape == (len(world.springs), 2, 6) else None
    world.spare = float(replicated["spare"])
    _restore_cell(world, replicated)
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
    missing = not world.outlets and len(ids) != most[1] - most[0]
    if missing or (np.diff(ids) <= 0).any() or ((ids < most[0]) | (ids >= most[1])).any():
        wrong.append("id of a grain")
    refuse(world.comm, f"a state that no run can have: {', '.join(wrong)}" if wrong else "")


def _is_of(table: Bodies, number: int, form: Form) -> bool:
    """Whether the grains of this form in a table have its sizes, times a scale if they have one."""
    size = table.size[table.shape == form.BASE + number] / form.size
    return bool(np.allclose(size, size[:, :1] if form.SCALES else 1.0, rtol=1e-9, atol=0.0))


def restart_rows(slabs: Ints, comm: MPI.Comm) -> slice:
    """Rows of a whole state's grain arrays that this rank hands to `restored_world`; slabs as in the state."""
    if len(slabs) == comm.size + 1:
        return slice(int(slabs[comm.rank]), int(slabs[comm.rank + 1]))
    return even_slice(int(slabs[-1]), comm)


def even_slice(count: int, comm: MPI.Comm) -> slice:
    """This rank's part of so many rows, in the order of the ranks."""
    return slice(count * comm.rank // comm.size, count * (comm.rank + 1) // comm.size)


def _shear(scene: Scene) -> Shear | None:
    """The shear of the cell at time zero."""
    if scene.shear_rate is None or scene.period is None:
        return None
    return Shear(scene.shear_rate, scene.gradient, float(scene.period[scene.gradient]))


def _restore_cell(world: World, replicated: Mapping[str, np.ndarray]) -> None:
    """Take the shear, the servo and the periods of the cell from a state; ValueError on all ranks if it has none."""
    comm = world.comm
    if world.servo is not None:
        servo = np.array(replicated.get("servo", np.full((5, 3), np.nan)), float)
        right = servo.shape == (5, 3) and np.isfinite(servo[2:]).all() and (servo[4] > 0.0).all()
        refuse(comm, "" if right else "the state has no stress or strain rate of the cell, as the scene has")
        world.servo, world.period = Servo(servo[0], servo[1], float(servo[2, 0]), servo[3]), servo[4]
    if world.shear is not None and world.period is not None:
        rate, shift = np.array(replicated.get("shear", (0.0, np.nan)), float)
        refuse(comm, "" if np.isfinite([rate, shift]).all() else "the state has no shear of the cell, as the scene has")
        length = float(world.period[world.shear.axis])
        world.shear = replace(world.shear, rate=float(rate), shift=float(shift), length=length)


def _world(scene: Scene, comm: MPI.Comm, grains: Bodies) -> World:
    pairs = comm.bcast(stiffness.pairs(scene))  # of one processor
    world = World(comm, tuple(scene.large_bodies), scene.gravity, pairs, scene.materials, grains, scene.large())
    world.loads, world.springs, world.period = dict(scene.loads), dict(scene.springs), scene.period
    world.forms = tuple(scene.forms)
    refuse_untouchable(scene.kinds, scene.large_bodies)
    world.sources, world.outlets = dict(scene.sources), dict(scene.outlets)
    world.tallies = {name: Tally() for name in (*world.sources, *world.outlets)}
    world.initial, world.first_large = scene.count, scene.first_large
    for what, members in (("spring", world.springs), ("joint", scene.joints)):
        tied = [name for name, member in members.items() if any(isinstance(end, int) for end in member.ends)]
        if tied and world.outlets:
            raise ValueError(f"{what} {tied[0]!r} holds a grain: with outlets {what}s may hold large bodies alone")
    world.shear = _shear(scene)
    world.joints = dict(scene.joints)
    number = {body.name: int(id) for body, id in zip(world.large_bodies, world.large.id)}
    ends = [joint.ends for joint in world.joints.values() if None not in joint.ends and not joint.touching]
    ids = [sorted(end if isinstance(end, int) else number[str(end)] for end in pair) for pair in ends]  # type: ignore[index]
    world.apart = np.unique(np.array(ids, float).reshape(-1, 2) @ [1.0, 1.0j])
    if scene.deforms:
        none = np.full(3, np.nan)
        asked, strain = (none if given is None else given for given in (scene.stress, scene.strain_rate))
        world.servo = Servo(asked, strain, scene.strain_start)
    for name, load in world.loads.items():
        refuse_load(world, name, load)
    return world


def refuse_overlap(world: World, overlap: float) -> None:
    """ValueError, on all ranks, that names the worst pair if bodies overlap by more than `overlap` half thicknesses of
    the thinner one that forces move.

    Bodies that a joint joins may share a place, unless they are to touch, and so may those that no force can part
    (`held_overlap`)."""
    contacts = find_contacts(world, 0.0)
    table = contacts.near.bodies
    worst = (0.0, 0.0, -1, -1)
    if len(contacts):
        half, large = bodies.least_half_thickness(table), table.shape == bodies.COMPOUND
        moves = bodies.is_dynamic(world.large)
        half[large] = np.where(moves, [least_half(body) for body in world.large_bodies], np.inf)
        relative = -contacts.gap / np.minimum(half[contacts.a], half[contacts.b])
        pair = np.stack([table.id[contacts.a], table.id[contacts.b]], axis=1)
        c = int(np.argmax(relative))
        worst = (float(relative[c]), float(-contacts.gap[c]), int(pair[c, 0]), int(pair[c, 1]))
    relative_depth, depth, a, b = world.comm.allreduce(worst, MPI.MAX)
    if relative_depth > overlap:
        pair = f"{world.name_of(a)} and {world.name_of(b)} overlap by {depth:g} m"
        most = f"{relative_depth:.2g} half thicknesses, where {overlap:g} are allowed"
        raise ValueError(f"overlapping start: {pair}, {most}")


def step_remark(world: World, dt: float) -> str:
    """What to say of a dt [s] that is too large for the grains as they are now, and a better one; empty if it is not;
    collective.

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
