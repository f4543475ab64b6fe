"""What acts on the bodies of a world in a step beside contacts: gravity, loads, springs, drives and guides."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from mpi4py import MPI

from dem import bodies, joints, springs
from dem.arrays import Bools, Floats, Ints
from dem.bodies import Bodies
from dem.free_motion import fallen, free_spin, free_velocity, gyroscopic
from dem.loads import Load
from dem.motion import DROOP, Driven, Dynamic, Guided
from dem.neighbourhood import Neighbourhood
from dem.scene import LargeBody
from dem.springs import Ends
from dem.together import SceneError, together
from dem.world import World


@dataclass(frozen=True)
class Applied:
    """Impulses and angular impulses of loads and springs over a step [N s, N m s]."""

    grains: Floats  #: (grains, 6) of this rank
    large: Floats  #: (large, 6), the same on all ranks; zero on bodies of prescribed motion
    springs: Floats  #: (springs, 3) impulses on the second ends, the same on all ranks
    expected: Floats | None = None  #: (springs, 2, 6) velocities of the ends after the step, see `dem.springs.impulses`


def applied_impulses(world: World, dt: float) -> Applied:
    """What loads and springs give in the next step of dt [s]; collective. SceneError if a law fails, or if dt is too
    large for the springs."""
    asked = (world.time, dt)
    if asked not in world.applied:  # a step asks several times
        grains, large = np.zeros_like(world.grains.velocity), np.zeros_like(world.large.velocity)
        for name, load in world.loads.items():
            of_large = np.array([body.name == load.on for body in world.large_bodies], bool)
            of_one = bool(of_large.any())
            table, out = (world.large, large) if of_one else (world.grains, grains)
            rows = of_large if of_one else _chosen(world, load)
            call = partial(load.impulses, world.time, dt, table.take(rows))
            found = together(world.comm, f"load {name!r}", call)
            out[rows] += world.comm.bcast(found) if of_one else found  # processors may round in other ways
        world.applied = {asked: _with_springs(world, grains, large, dt)}
    return world.applied[asked]


def _chosen(world: World, load: Load) -> Ints | Bools:
    """The rows or the mask of this rank's grains that have a load."""
    if isinstance(load.on, str):
        return world.grains.material == world.materials.index(load.on)
    return np.arange(len(world.grains)) if load.on is None else np.isin(world.grains.id, load.on)


def _with_springs(world: World, grains: Floats, large: Floats, dt: float) -> Applied:
    """The impulses of loads and those of springs; collective."""
    if not world.springs:
        return Applied(grains, large, np.zeros((0, 3)))
    members = list(world.springs.values())
    ends = [end for spring in members for end in spring.ends]
    ids = np.unique([end for end in ends if isinstance(end, int)]).astype(np.int64)
    many, first = len(ids) + len(world.large), len(ids)
    rows = [_row_of(world, ids, end) for end in ends]
    row = np.array(rows).reshape(-1, 2)
    table = _ends(world, ids, grains, large, dt)
    found = springs.impulses(members, row, table, world.expected, dt) if world.comm.rank == 0 else None
    g, change, expected, highest = world.comm.bcast(found)  # processors may round in other ways
    if dt * highest >= 2.0:
        raise SceneError(
            f"the springs {', '.join(world.springs)[:200]} have frequencies up to {highest:.3g} rad/s: -dt {dt:g} s is "
            f"too large for them; take less than {2.0 / highest:.3g} s, and a tenth of that to resolve them"
        )
    here = np.flatnonzero(np.isin(world.grains.id, ids))
    grains[here] += change[np.searchsorted(ids, world.grains.id[here])]
    large[:] += np.where(bodies.is_dynamic(world.large)[:, None], change[first:many], 0.0)
    return Applied(grains, large, g, expected)


def _row_of(world: World, ids: Ints, end: springs.End) -> int:
    """The row of the end of a spring among the grains `ids`, the large bodies and the world."""
    if isinstance(end, int):
        return int(np.searchsorted(ids, end))
    return len(ids) + (len(world.large) if end is None else world.large_row(end))


def _ends(world: World, ids: Ints, grains: Floats, large: Floats, dt: float) -> Ends:
    """The grains of these ids, the large bodies and the world, with the impulses of loads; collective."""
    here = np.flatnonzero(np.isin(world.grains.id, ids))
    own = world.grains.take(here)
    change = velocity_changes(own, grains[here])
    free = free_velocity(own, world.gravity, dt) + change
    root = bodies.inverse_root_inertia(own)
    columns = own.position, own.quaternion, own.velocity, free, 1.0 / own.mass[:, None], (root @ root).reshape(-1, 9)
    gathered = np.zeros((len(ids), 35))
    gathered[np.searchsorted(ids, own.id)] = np.concatenate([*columns, own.inertia, change[:, 3:]], axis=1)
    world.comm.Allreduce(MPI.IN_PLACE, gathered)  # each row is that of one rank
    parts = np.split(gathered, np.cumsum([3, 4, 6, 6, 1, 9, 3]), axis=1)
    position, turn, velocity, free, light, inverse_inertia, moments, given = parts
    tools = world.large
    change = velocity_changes(tools, large)
    pushed = free_velocity(tools, world.gravity, dt) + change
    root = bodies.inverse_root_inertia(tools)
    translation = free_directions(world.large_bodies) / tools.mass[:, None, None]
    inverse = np.zeros((len(ids) + len(tools) + 1, 6, 6))
    inverse[:, :3, :3] = np.concatenate([light[:, :, None] * np.eye(3), translation, np.zeros((1, 3, 3))])
    inverse[:, 3:, 3:] = np.concatenate([inverse_inertia.reshape(-1, 3, 3), root @ root, np.zeros((1, 3, 3))])
    return Ends(
        np.concatenate([position, tools.position, np.zeros((1, 3))]),
        np.concatenate([turn, tools.quaternion, [[1.0, 0.0, 0.0, 0.0]]]),
        np.concatenate([velocity, tools.velocity, np.zeros((1, 6))]),
        np.concatenate([free, _as_motions_allow(world, pushed, dt), np.zeros((1, 6))]),
        inverse,
        np.concatenate([moments, tools.inertia, np.full((1, 3), np.inf)]),
        np.concatenate([given, change[:, 3:], np.zeros((1, 3))]),
    )


def jointed(world: World) -> tuple[Ints, Ints]:
    """The ids of the grains of joints, in order, and the rows (joints, 2) of the ends of joints among these, the large
    bodies and the world."""
    ends = [end for joint in world.joints.values() for end in joint.ends]
    ids = np.unique([end for end in ends if isinstance(end, int)]).astype(np.int64)
    return ids, np.array([_row_of(world, ids, end) for end in ends]).reshape(-1, 2)


def joint_ends(world: World, dt: float) -> tuple[Ints, Ints, Ends]:
    """What `jointed` gives, and those bodies in a step of dt [s] with what loads and springs give; collective."""
    ids, row = jointed(world)
    grains, large = np.zeros_like(world.grains.velocity), np.zeros_like(world.large.velocity)
    if world.loaded:
        given = applied_impulses(world, dt)
        grains, large = given.grains, given.large
    return ids, row, _ends(world, ids, grains, large, dt)


def joint_coupling(world: World, dt: float, push: Floats | None = None) -> joints.Coupling | None:
    """The joints in the next step of dt [s]; None without any. `push` (owned, 6): the mass-scaled momenta that contacts
    are expected to give the bodies whose rows this rank owns. Collective."""
    if not world.joints:
        return None
    ids, row, table = joint_ends(world, dt)
    gathered = np.zeros_like(table.free)
    if push is not None:
        id = np.concatenate([world.grains.id, world.large.id])[: len(push)]
        here, slot = slots(world, id)
        gathered[slot] = push[here]
        world.comm.Allreduce(MPI.IN_PLACE, gathered)
    given = list(world.joints.values()), row, table, dt, world.period, gathered
    found = joints.coupling(*given) if world.comm.rank == 0 else None
    return world.comm.bcast(found)  # processors may round in other ways


def joints_refound(world: World, known: joints.Coupling, push: Floats) -> joints.Coupling | None:
    """`dem.joints.refound`, by the first rank for all; collective."""
    found = joints.refound(known, push) if world.comm.rank == 0 else None
    return world.comm.bcast(found)


def slots(world: World, id: Ints) -> tuple[Ints, Ints]:
    """Which rows of bodies with these ids (n,) are among the bodies that joints know, and their rows there."""
    ids, first = jointed(world)[0], world.first_large
    here = np.flatnonzero(np.isin(id, ids) | (id >= first))
    return here, np.where(id[here] >= first, len(ids) + id[here] - first, np.searchsorted(ids, id[here]))


def velocity_changes(table: Bodies, impulse: Floats) -> Floats:
    """What impulses and angular impulses (n, 6) change of the velocities (n, 6) of bodies on which nothing else acts;
    zero where a mass or moment is infinite."""
    change = np.empty_like(impulse)
    change[:, :3] = impulse[:, :3] / table.mass[:, None]
    change[:, 3:] = impulse[:, 3:] / table.inertia  # of spheres
    rows = np.flatnonzero(impulse[:, 3:].any(axis=1) & (table.shape != bodies.SPHERE))
    root = bodies.inverse_root_inertia(table.take(rows))
    change[rows, 3:] = (root @ (root @ impulse[rows, 3:, None]))[:, :, 0]
    return change


def free_velocities(
    world: World, near: Neighbourhood, dt: float, drives: Drives, change: Floats | None
) -> tuple[Floats, Floats | None]:
    """Velocities (rows, 6) of all bodies of `near` over a step of dt [s] without contacts, of which those of ghosts are
    not yet right; and the angular ones (owned, 3) about which they are linear in the impulses, see
    `dem.free_motion.free_spin`, NaN where they are so anywhere. None without a `change` (owned, 6), what contacts are
    expected to change. Collective."""
    free, _ = fallen(near.bodies, world.gravity, dt)
    first = near.grains + near.ghosts
    pushed = None
    if world.loaded:
        pushed = velocity_changes(world.grains, applied_impulses(world, dt).grains)
        free[: near.grains] += pushed
    free[first:] = drives.free
    if change is None:
        return free, None
    owned = len(change)
    given, middle = np.zeros((owned, 3)), np.full((owned, 3), np.nan)
    if pushed is not None:
        given[: near.grains] = pushed[:, 3:]
    if owned > near.grains:  # of the last rank, which has no ghosts
        given[near.grains :] = velocity_changes(world.large, drives.impulse)[:, 3:]
    own = near.bodies.take(slice(owned))
    rows = gyroscopic(own)
    now = own.quaternion[rows], own.velocity[rows, 3:], own.inertia[rows]
    spin, middle[rows] = free_spin(*now, dt, (given + change[:, 3:])[rows])
    free[rows, 3:] = spin + given[rows]
    return free, middle


def grains_free_velocity(world: World, dt: float) -> Floats:
    """Velocities (grains, 6) of this rank's grains over a step of dt [s] without contacts; collective."""
    free = free_velocity(world.grains, world.gravity, dt)
    return free + velocity_changes(world.grains, applied_impulses(world, dt).grains) if world.loaded else free


def _as_motions_allow(world: World, velocity: Floats, dt: float) -> Floats:
    """These velocities (large, 6), with what motions hold or prescribe over a step of dt [s]; collective."""
    free = world.prescribed_velocity(dt)
    for row, body in enumerate(world.large_bodies):
        if isinstance(motion := body.motion, Dynamic):
            free[row, :3] = motion.free_directions() @ velocity[row, :3]
            free[row, 3:] = motion.free_turns() @ velocity[row, 3:]
            free[row] += motion.held(world.time, dt)
    return free


@dataclass(frozen=True)
class Drives:
    """What drives, loads and springs do to the large bodies in a step."""

    impulse: Floats  #: (large, 6) impulses and angular impulses, of servos if nothing touches their bodies
    line: Floats  #: (large, 6) unit vectors of the lines of drives
    grip: Floats  #: (large,) what servos add to the inertia along them [kg or kg m^2], see `dem.motion.Driven`
    speed: Floats  #: (large,) that servos keep along them [m/s or rad/s]
    most: Floats  #: (large,) greatest impulses of servos [N s or N m s]
    spent: Ints  #: (large,) 1 or -1 of servos that contacts have shown to give all that, forward or back; else 0
    #: (large, 6) velocities over the step without contacts: guided bodies along their guides with the forces of their
    #: drives, hinged ones with their torques, prescribed ones on their paths
    free: Floats

    def refound(self, impulse: Floats, velocity: Floats) -> Ints | None:
        """``spent`` as a step shows it to be right in which the drives gave impulses (large, 6) and which ends with
        velocities (large, 6); None if that is what it is."""
        along, now = (np.einsum("bi,bi->b", self.line, x) for x in (impulse, velocity))
        weak = (self.grip > 0.0) & (np.abs(along) > (1.0 + DROOP) * self.most)
        again = np.where(self.spent * (self.speed - now) < 0.0, 0, self.spent)
        spent = np.where(weak, np.sign(along).astype(int), again)
        return None if np.array_equal(spent, self.spent) else spent


def drives_of(world: World, dt: float, spent: Ints | None = None) -> Drives:
    """Of the next step of dt [s], the same on all ranks, with that ``spent``; collective."""
    if spent is not None:
        return _drives(world, dt, spent)
    asked = (world.time, dt)
    if asked not in world.drives:  # a step asks several times
        world.drives = {asked: _drives(world, dt, np.zeros(len(world.large), int))}
    return world.drives[asked]


def _drives(world: World, dt: float, spent: Ints) -> Drives:
    table, impulse = world.large, np.zeros_like(world.large.velocity)
    line, (grip, speed, most) = np.zeros_like(impulse), np.zeros((3, len(impulse)))
    if not bodies.is_dynamic(table).any():
        return Drives(impulse, line, grip, speed, most, spent, world.prescribed_velocity(dt))
    free = falling = free_velocity(table, world.gravity, dt)
    if world.loaded:
        impulse += applied_impulses(world, dt).large
        free = falling + velocity_changes(table, impulse)
    for row, body in enumerate(world.large_bodies):
        motion = body.motion
        if isinstance(motion, Driven):
            part, inertia = (slice(0, 3), body.mass) if isinstance(motion, Guided) else (slice(3, 6), body.inertia[2])
            line[row, part] = motion.line
            speed[row] = motion.speed or 0.0
            lack = inertia / dt * (speed[row] - float(free[row] @ line[row]))
            lack = spent[row] * np.inf if spent[row] else lack
            most[row] = dt * motion.strength(world.time, dt)
            impulse[row, part] += dt * motion.mean_drive(world.time, dt, lack)
            grip[row] = motion.grip(world.time, dt, inertia, float(world.large.velocity[row] @ line[row]), lack)
    if impulse.any():
        falling = falling + velocity_changes(table, impulse)
    return Drives(impulse, line, grip, speed, most, spent, _as_motions_allow(world, falling, dt))


def free_directions(members: Sequence[LargeBody]) -> Floats:
    """Projectors (large, 3, 3) on the directions that are open to the velocities of large bodies."""
    open_to = [body.motion.free_directions() if isinstance(body.motion, Dynamic) else np.eye(3) for body in members]
    return np.array(open_to).reshape(len(members), 3, 3)


def free_turns(members: Sequence[LargeBody]) -> Floats:
    """Projectors (large, 3, 3) on the axes about which torques can turn large bodies."""
    open_to = [body.motion.free_turns() if isinstance(body.motion, Dynamic) else np.eye(3) for body in members]
    return np.array(open_to).reshape(len(members), 3, 3)
