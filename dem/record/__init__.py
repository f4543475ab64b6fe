"""Records of a time step: forces on the large bodies, energies and their balance, statistics of the contacts.

All functions are collective, and their results are the same on all ranks and, to rounding, for any number of ranks.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np
from mpi4py import MPI

from dem import bodies
from dem.arrays import ArrayLike, Bools, Floats, Ints
from dem.bodies import COMPOUND, Bodies, radius_about
from dem.checks import number
from dem.compiled import loop
from dem.exchange import broadcast, reduced
from dem.experiment import Experiment
from dem.motion import Held
from dem.record.energies import add_kinetic
from dem.start import stiffness
from dem.step.servo import cell_stress
from dem.together import SceneError, digest, together
from dem.unconstrained.constraints import slots

if TYPE_CHECKING:
    from dem.step import Step


def row(step: Step, scene: Experiment) -> dict[str, float]:
    """Return all quantities of a step by name, with units in brackets. SceneError if the scene's `record` fails or
    returns something else than numbers by name."""
    out = {"step": step.world.step, "time [s]": step.world.time}
    out |= energy_balance(step) | contact_statistics(step) | step.world.passages.record()
    out |= cell(step)
    if scene.domain is not None:
        out["grains_outside"] = outside(step, *scene.domain)
    for body, force in zip(step.world.large_bodies, (step.impulse_on_large / step.system.dt).tolist()):
        out.update(zip(_names_of_forces(body.name), force))
    return out | _own(step, scene, out)


@lru_cache(maxsize=1024)
def _names_of_forces(name: str) -> list[str]:
    """Those of a large body in a row."""
    return [f"{what}_{name}_{k} [{unit}]" for what, unit in (("force", "N"), ("torque", "N m")) for k in "xyz"]


def _own(step: Step, scene: Experiment, taken: Mapping[str, float]) -> dict[str, float]:
    """The quantities of the scene's own."""
    if getattr(scene.record, "__func__", None) is Experiment.record:
        return {}
    what = f"record of the scene {type(scene).__name__}"

    def record() -> dict[str, float]:
        own: Any = scene.record(step)
        if not isinstance(own, Mapping):
            raise ValueError(f"record must return a dict of numbers by name, not {type(own).__name__}")
        for name, value in own.items():
            if not isinstance(name, str) or name in taken or not name or set(name) & set(',"\n'):
                raise ValueError(f"record returns the name {name!r}: allowed is text without comma that is not in use")
            if np.ndim(value) != 0:
                raise ValueError(f"record returns {name!r} = {value!r}: allowed is a number")
        return {name: number(f"record returns {name!r}", value) for name, value in own.items()}

    own = together(step.world.comm, what, record)
    names = digest(str(list(own))) >> 8  # 52 bits
    _, (most, least) = reduced(step.world.comm, (), (names, -names))
    if most != -least:
        raise SceneError(f"{what}: it must return the same names on all ranks, in the same order")
    return own


def cell(step: Step) -> dict[str, float]:
    """Return the size of the cell at the end of the step, and the stress of its contacts and grains."""
    return step.world.cell.record(lambda: cell_stress(step.world, step.contacts, step.force))


def outside(step: Step, low: ArrayLike, high: ArrayLike) -> float:
    """Return the number of grains whose centre has left the box from `low` (3,) to `high` (3,) [m]."""
    place = step.world.cell.wrapped(step.world.grains.position)
    return step.total(count_outside(place, np.full(3, low, float), np.full(3, high, float)))


@loop
def count_outside(place: Floats, low: Floats, high: Floats) -> int:
    """How many places (n, 3) are outside the box from `low` to `high` (3,)."""
    lost = 0
    for n in range(len(place)):
        x, y, z = place[n, 0], place[n, 1], place[n, 2]
        lost += x < low[0] or x > high[0] or y < low[1] or y > high[1] or z < low[2] or z > high[2]
    return lost


#: A step has a jump of energy where the kinetic energy rises by more than its sources give, by this part of all that is
#: there, or to so many times what there was.
CREATED, SUDDEN = 0.1, 10.0
SLOW = 0.1  #: a body is at rest below this part of the speed that a step of free fall gives
CREEP = 1e-6  #: or below this part of its radius in a step
SUNK = 1e-3  #: a rise of the energy is none if bodies would get it by sinking for this part of their radii


def energy_balance(step: Step) -> dict[str, float]:
    """Return energies at the end of the step and where their change came from [J].

        change of kinetic + potential + spring = work of motions and of cohesion - friction loss - impact loss
                                                 + time stepping

    With g the impulses and w the mean of the velocities before and after (of prescribed motions in the first step: that
    of the step), the impulses do the work g' D' w: what sits on a plate that shakes gets from it what it has. What its
    tangential part does not give to the springs of contacts is the friction loss. What its normal part does not is lost
    in impacts, or pushes overlaps of rigid contacts apart where it is a gain. The work of motions is that of prescribed
    bodies on the others, of the drives of guided and hinged bodies, of what holds bodies in part, of belts, of parts
    and of the shear of a cell. The rest is the error of the semi-implicit step, of the order of dt:
    -dt/2 m g (v_new - v_old) per body.

    Springs begin a step with what the gaps are, and end it with what gaps linear in the velocities would be, but hold
    no more than impulses have loaded them with (`dem.start.stiffness.elastic_energies`). What they lose or gain
    between two steps is in no term: the spring energy of a step less that before the next.

    The jump is the rise of the kinetic energy in a step in which it rises by more than the work of motions, gravity
    and springs allows, or to more than ten times what there was, although gravity and drives do not give that; else 0.
    Less than what bodies get by sinking a little (SUNK) is none: structures swing on their springs.
    Springs may give that too where no moving tool of prescribed motion can have loaded them. What there was includes
    what bodies at rest have (SLOW), and what those have that go with the tool they touch.
    """
    world, near, comm, system = step.world, step.contacts.near, step.world.comm, step.system
    first, fixed = near.grains + near.ghosts, ~bodies.is_dynamic(world.large)
    of_bodies = _ledger(step, world.grains, slice(near.grains))
    if world.large_moves and comm.rank == 0:  # the large bodies count once
        of_bodies = tuple(map(sum, zip(of_bodies, _ledger(step, world.large, slice(first, None)))))
    velocity = near.bodies.velocity.copy()
    if world.step == 1:  # nobody knows how motions went before
        velocity[first:][fixed] = world.large.velocity[fixed]
    mean = 0.5 * (velocity[first:] + world.large.velocity)
    normal, tangential, came, opening = works(step, step.in_cone, velocity, step.moment)
    of_springs = elastic_energies(step, came, opening)
    attracted = 0.0 if system.attraction is None else works(step, step.impulse, velocity)[0] - normal
    applied = belts = flow = landed = 0.0
    if system.later is not None:
        landed = sum(works(step, system.later, velocity)[:2])
    if system.applied is not None:
        applied = 0.5 * np.vdot(system.applied.grains, near.bodies.velocity[: near.grains] + world.grains.velocity)
    if system.surface is not None:
        belts = -np.vdot(step.impulse[:, 1:], system.surface)
    if system.drift is not None:
        flow = -np.vdot(step.impulse, system.drift)
    whole = dict(zip(WHOLE, reduced(comm, (
        *of_bodies, *of_springs, normal, tangential, _carried(step, fixed), attracted, applied, belts, flow,
        _bounced_work(step), landed,
    ), ())[0]))  # fmt: skip
    holding = _holding_work(step, near.bodies.velocity[first:], mean) if world.large_moves else 0.0
    held_by, held_at_end = _constraint_works(step, near.bodies.velocity[: near.grains], mean)
    driven_by = np.vdot(system.drive_impulse(world.large.velocity), mean) if world.large_moves else 0.0
    driving = driven_by + (whole["applied"] + whole["flow"]) + whole["belts"] + (holding + held_by)
    work = driving - np.vdot(step.impulse_on_large[fixed], mean[fixed])
    rise, fallen = whole["kinetic"] - whole["kinetic_before"], whole["potential_before"] - whole["potential"]
    fallen = max(fallen, whole["falling"])  # the work of gravity, as that of springs, on the mean velocity of the step
    held, bent = whole["elastic_at_end"] - whole["elastic"], whole["strained_at_end"] - whole["strained"]
    pulled, released = 2.0 * max(whole["attracted"], 0.0), max(-held, 0.0) + max(-bent, 0.0)
    pulled += max(held_at_end - held_by, 0.0)  # with the velocity of the end, for bodies that were at rest
    pulled += max(whole["bounced"], 0.0) + 2.0 * max(whole["landed"], 0.0)
    there = whole["kinetic_before"] + whole["still"] + whole["carried"]
    stored = whole["elastic"] + whole["strained"]
    created = rise - fallen - work - released - pulled > CREATED * (there + stored + abs(work))
    driven = max(fallen, 0.0) + max(driving, 0.0) + pulled + released * (whole["carried"] == 0.0)
    jumps = rise > whole["least"] and (created or whole["kinetic"] - driven > SUDDEN * there + CREATED * driven)
    change = whole["kinetic"] + whole["potential"] - whole["kinetic_before"] - whole["potential_before"]
    made = change - work - whole["normal"] - whole["tangential"] - whole["attracted"] + whole["belts"]
    return {
        "kinetic_energy [J]": whole["kinetic"],
        "potential_energy [J]": whole["potential"],
        "spring_energy_before [J]": stored,
        "spring_energy [J]": whole["elastic_at_end"] + whole["strained_at_end"],
        "work_of_motions [J]": work,
        "friction_loss [J]": whole["belts"] - whole["tangential"] - bent,  # nothing is zero, not -0
        "impact_loss [J]": 0.0 - whole["normal"] - held,
        **({} if system.attraction is None else {"work_of_cohesion [J]": whole["attracted"]}),
        "time_stepping [J]": made,
        "energy_jump [J]": broadcast(comm, rise if jumps else 0.0),  # what follows from it is the same on all ranks
    }


def _bounced_work(step: Step) -> float:
    """What gravity, loads and springs do on the way of grains that ends beside that of their mean velocities, as
    impacts are within the step [J]: bodies that come and go as fast may have fallen in between."""
    applied, lag, near = step.system.applied, step.contacts.lag, step.contacts.near
    if lag is None:
        return 0.0
    force = near.bodies.mass[: near.grains, None] * step.world.gravity
    if applied is not None:
        force = force + applied.grains[:, :3] / step.system.dt
    return float(np.vdot(force, lag))


#: What `energy_balance` adds up over the ranks: what `_ledger` returns, `elastic_energies`, and the works.
WHOLE = (
    "kinetic_before", "potential_before", "kinetic", "potential", "falling", "still", "least", "elastic",
    "elastic_at_end", "strained", "strained_at_end", "normal", "tangential", "carried", "attracted", "applied", "belts",
    "flow", "bounced", "landed",
)  # fmt: skip


def _ledger(step: Step, table: Bodies, rows: slice) -> tuple[float, ...]:
    """Of the bodies of a table, which have these rows of `near`, the kinetic and potential energy before the step and
    after it, the work of gravity on their mean velocities, the kinetic energy that they may have at rest by the errors
    of a solver, and the energy of their weights times a part SUNK of their radii [J]."""
    before, gravity, dt = step.contacts.near.bodies, step.world.gravity, step.system.dt
    return ledger(
        (table.mass, table.inertia, table.shape, table.size),
        (before.position[rows], before.quaternion[rows], before.velocity[rows]),
        (table.position, table.quaternion, table.velocity), gravity, dt, SLOW * dt * math.hypot(*gravity), CREEP / dt,
    )  # fmt: skip


@loop
def ledger(kinds, before, after, gravity, dt, fall, creep):
    """The loop of `_ledger`, over n bodies of masses, moments, shapes and sizes, and their places, orientations and
    velocities. A body is at rest below the speed `fall` [m/s], a part SLOW of what gravity gives in a step, or below
    `creep` radii [1/s], of large bodies those of gyration."""
    (mass, inertia, shape, size), (place, turn, velocity), (new_place, new_turn, new_velocity) = kinds, before, after
    kinetic, potential, new_kinetic, new_potential, falling, still, sunk = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    g = np.sqrt(gravity[0] ** 2 + gravity[1] ** 2 + gravity[2] ** 2)
    for n in range(len(mass)):
        if np.isfinite(mass[n]):
            kinetic = add_kinetic(kinetic, turn[n], velocity[n], mass[n], inertia[n])
            new_kinetic = add_kinetic(new_kinetic, new_turn[n], new_velocity[n], mass[n], inertia[n])
            for k in range(3):
                weight = mass[n] * gravity[k]
                potential -= weight * place[n, k]
                new_potential -= weight * new_place[n, k]
                falling += 0.5 * dt * weight * (velocity[n, k] + new_velocity[n, k])
            radius = radius_about(shape[n], size[n])
            if shape[n] == COMPOUND:
                radius = np.sqrt(min(inertia[n, 0], inertia[n, 1], inertia[n, 2]) / mass[n])
            radius = radius if np.isfinite(radius) else 0.0  # what cannot turn has no radius
            still += 0.5 * mass[n] * max(fall, creep * radius) ** 2
            sunk += SUNK * g * mass[n] * radius
    return kinetic, potential, new_kinetic, new_potential, falling, still, sunk


def works(
    step: Step, impulse: Floats, before: Floats, moment: Floats | None = None
) -> tuple[float, float, Floats, Floats]:
    """Return the work of this rank's normal impulses, and of its tangential ones and moments (nc, 3), on the mean of
    the velocities `before` (rows, 6), of all rows of `near`, and of those after the step [J]; and the normal velocities
    (nc,) of both; collective."""
    system, near = step.system, step.contacts.near
    after = np.zeros(before.shape)
    after[: near.grains] = step.world.grains.velocity
    system.contact_map.halo.update(after)
    after[near.grains + near.ghosts :] = step.world.large.velocity
    normal, tangential, came, opening = system.contact_map.works(impulse, before, after)
    if system.drift is not None:
        came, opening = came + system.drift[:, 0], opening + system.drift[:, 0]
        normal += float(impulse[:, 0] @ system.drift[:, 0])
        tangential += float(np.vdot(impulse[:, 1:], system.drift[:, 1:]))
    if moment is not None and system.resistance is not None:
        turning = system.resistance.map.turning
        tangential += 0.5 * float(np.vdot(moment, turning(before) + turning(after)))
    return normal, tangential, came, opening


def elastic_energies(step: Step, came: Floats, opening: Floats) -> tuple[float, float, float, float]:
    """Return `dem.start.stiffness.elastic_energies` of a step, with the normal velocities (nc,) with which contacts
    `came`, and those of its end, `opening`."""
    system, contacts = step.system, step.contacts
    return stiffness.elastic_energies(
        system.stiffness, system.compliance, system.dt, contacts.gap, contacts.linear_gap, came, opening,
        (system.last, system.held), step.in_cone,
    )  # fmt: skip


def _holding_work(step: Step, before: Floats, mean: Floats) -> float:
    """The work [J] of what holds components of the velocities of `Held` bodies; velocities (large, 6) before the step,
    and means of those before and after."""
    work, world, system = 0.0, step.world, step.system
    for row, body in enumerate(world.large_bodies):
        if isinstance(body.motion, Held):
            push = -step.impulse_on_large[row] - system.drive_impulse(world.large.velocity)[row]
            push[:3] += body.mass * (world.large.velocity[row, :3] - before[row, :3] - system.dt * world.gravity)
            held = np.eye(3) - body.motion.free_directions(), np.eye(3) - body.motion.free_turns()
            work += float(mean[row, :3] @ held[0] @ push[:3] + mean[row, 3:] @ held[1] @ push[3:])
    return work


def _constraint_works(step: Step, before: Floats, mean: Floats) -> tuple[float, float]:
    """The work [J] of constraints and motors on the bodies that forces move, on the mean velocities of the step and on
    those of its end: velocities (grains, 6) of this rank's grains before the step, and means (large, 6) of those before
    and after; collective."""
    system, world = step.system, step.world
    if system.coupling is None:
        return 0.0, 0.0
    rows = system.coupling.rows
    push = (step.constraint_impulses @ rows.reshape(len(rows), -1)).reshape(rows.shape[1:])
    here, slot = slots(world, world.grains.id)
    velocity = world.grains.velocity[here]
    works = np.array([0.5 * np.vdot(push[slot], before[here] + velocity), np.vdot(push[slot], velocity)])
    world.comm.Allreduce(MPI.IN_PLACE, works)
    of_large = push[len(push) - 1 - len(world.large) : -1] * bodies.is_dynamic(world.large)[:, None]
    return float(works[0] + np.vdot(of_large, mean)), float(works[1] + np.vdot(of_large, world.large.velocity))


def _carried(step: Step, prescribed: Bools) -> float:
    """The kinetic energy [J] that bodies have which go with the `prescribed` (large,) motions that they touch, on this
    rank."""
    velocity = step.world.large.velocity
    if not velocity.any():
        return 0.0
    velocity = np.where(prescribed[:, None], velocity, 0.0)
    near, arm = step.contacts.near, step.system.contact_map.source.arm
    first, mass = near.grains + near.ghosts, near.bodies.mass
    return carried_energy(velocity, first, mass, step.contacts.a, step.contacts.b, arm)


@loop
def carried_energy(velocity: Floats, first: int, mass: Floats, a: Ints, b: Ints, arm: Floats) -> float:
    """The kinetic energy [J] that the lighter bodies of contacts with arms (nc, 6) between rows a, b (nc,) have at the
    relative velocity of these: `velocity` (large, 6) from the row `first` on, and zero before."""
    energy = 0.0
    for c in range(len(b)):
        if b[c] < first and a[c] < first:
            continue
        u, v, w = 0.0, 0.0, 0.0
        for side, row in ((0, a[c]), (3, b[c])):
            if row >= first:
                x, y, z, sign = arm[c, side], arm[c, side + 1], arm[c, side + 2], 1.0 if side else -1.0
                s = velocity[row - first]
                u += sign * (s[0] + s[4] * z - s[5] * y)
                v += sign * (s[1] + s[5] * x - s[3] * z)
                w += sign * (s[2] + s[3] * y - s[4] * x)
        energy += 0.5 * min(mass[a[c]], mass[b[c]]) * (u * u + v * v + w * w)
    return energy


def contact_statistics(step: Step) -> dict[str, float]:
    """Return statistics of the contacts: how many there are, how many bear forces and slide. Overlaps are those at the
    start of the step.

    A contact is active if its normal impulse exceeds 1 % of the mean, as solvers leave small impulses at others. It
    slides if its tangential impulse is 99 % of what friction can bear, or more. The coordination number is the mean
    number of active contacts per grain. The unbalanced force is the mean resultant of the forces on a grain over the
    mean force of an active contact, as of Yade and PFC; 0 without contacts. Impacts at once are contacts that bounce
    and are not among those whose order `dem.step.impacts` follows: where several of them act on a body in a step,
    energy may be lost.
    """
    comm, contacts, impulse = step.world.comm, step.contacts, step.in_cone
    grains, before = step.world.grains, contacts.near.bodies
    of_all = len(contacts), *exchanged(grains.mass, before.velocity, grains.velocity, impulse)
    (count, weight, push, size), _ = reduced(comm, of_all, ())
    least = 0.01 * weight / max(count, 1.0)
    *sums, worst = counted(impulse, step.system.friction, contacts.gap, contacts.a, contacts.b, before.shape, least)
    sums, (worst,) = reduced(comm, [*sums, step.system.at_once], (max(worst, contacts.held_overlap),))
    bounces = {"impacts_at_once": sums[3]} if step.world.pairs.bounces else {}
    return {
        "contacts": count,
        "active_contacts": sums[0],
        "coordination_number": sums[2] / max(step.world.slabs[-1], 1),
        "sliding_fraction": sums[1] / max(sums[0], 1),
        "unbalanced_force": push / max(step.world.slabs[-1], 1) * sums[0] / size if size > 0.0 else 0.0,
        "worst_overlap [m]": worst,
        **bounces,
    }


@loop
def exchanged(mass: Floats, before: Floats, after: Floats, impulse: Floats) -> tuple[float, float, float]:
    """The sum of normal impulses among those (nc, 3); that of the sizes of the changes of the momenta of n bodies of
    finite mass, with velocities (n, 6) before and after, of which `before` may have more rows; and that of the sizes of
    impulses [N s]."""
    weight, push, size = 0.0, 0.0, 0.0
    for n in range(len(mass)):
        x, y, z = after[n, 0] - before[n, 0], after[n, 1] - before[n, 1], after[n, 2] - before[n, 2]
        push += mass[n] * np.sqrt(x * x + y * y + z * z)
    for c in range(len(impulse)):
        weight += impulse[c, 0]
        size += np.sqrt(impulse[c, 0] ** 2 + impulse[c, 1] ** 2 + impulse[c, 2] ** 2)
    return weight, push, size


@loop
def counted(impulse, friction, gap, a, b, shape, least):
    """Of contacts of bodies in the rows a, b (nc,), those active whose normal impulse exceeds the `least`: their
    number, how many of them slide, how many ends of them are at grains; and the greatest overlap of all, 0 if none."""
    active, sliding, ends, worst = 0, 0, 0, 0.0
    for c in range(len(gap)):
        normal, bears = impulse[c, 0], 0.99 * friction[c] * impulse[c, 0]
        worst = max(worst, -gap[c])
        bearing, slides = normal > least, np.sqrt(impulse[c, 1] ** 2 + impulse[c, 2] ** 2) >= bears
        active += bearing
        sliding += bearing & slides
        ends += bearing * (int(shape[a[c]] != COMPOUND) + int(shape[b[c]] != COMPOUND))
    return active, sliding, ends, worst
