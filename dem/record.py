"""Records of a time step: forces on the large bodies, energies and their balance, statistics of the contacts.

All functions are collective, and their results are the same on all ranks and, to rounding, for any number of ranks.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from mpi4py import MPI

from dem import bodies
from dem.arrays import ArrayLike, Floats
from dem.bodies import COMPOUND, Bodies
from dem.compiled import loop
from dem.experiment import Experiment
from dem.step import Step
from dem.together import SceneError, together


def row(step: Step, scene: Experiment) -> dict[str, float]:
    """All quantities of a step by name, with units in brackets. SceneError if the scene's `record` fails or returns
    something else than numbers by name."""
    out = {"step": step.world.step, "time [s]": step.world.time}
    out |= energy_balance(step) | contact_statistics(step)
    if scene.domain is not None:
        out["grains_outside"] = outside(step, *scene.domain)
    for body in step.world.large_bodies:
        force = step.force_on(body.name)
        out |= {f"force_{body.name}_{axis} [N]": force[k] for k, axis in enumerate("xyz")}
        out |= {f"torque_{body.name}_{axis} [N m]": force[3 + k] for k, axis in enumerate("xyz")}
    return out | _own(step, scene, out)


def _own(step: Step, scene: Experiment, taken: Mapping[str, float]) -> dict[str, float]:
    """The quantities of the scene's own."""
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
        return {name: float(value) for name, value in own.items()}

    own = together(step.world.comm, what, record)
    names = step.world.comm.allgather(list(own))
    if any(other != names[0] for other in names):
        raise SceneError(f"{what}: it must return the same names on all ranks, in the same order")
    return own


def outside(step: Step, low: ArrayLike, high: ArrayLike) -> float:
    """Number of grains whose centre has left the box from `low` (3,) to `high` (3,) [m]."""
    place, lost = step.world.grains.position, np.zeros(len(step.world.grains), bool)
    for axis, (least, most) in enumerate(zip(np.asarray(low), np.asarray(high))):
        lost |= (place[:, axis] < least) | (place[:, axis] > most)
    return step.total(lost)


def energy(table: Bodies, gravity: Floats) -> tuple[float, float]:
    """Kinetic and potential energy [J] of the bodies of a table that forces can move; the potential energy is zero at
    the origin."""
    kinetic, moment = energies(table.position, table.quaternion, table.velocity, table.mass, table.inertia)
    return kinetic, float(-(moment @ gravity))


@loop
def energies(position: Floats, turn: Floats, velocity: Floats, mass: Floats, inertia: Floats) -> tuple[float, Floats]:
    """The kinetic energy [J] of n bodies with principal moments (n, 3), and the sum of mass times position (3,)
    [kg m]. An infinite mass or moment does not move."""
    kinetic, moment = 0.0, np.zeros(3)
    for n in range(len(mass)):
        if np.isfinite(mass[n]):
            for k in range(3):
                kinetic += 0.5 * mass[n] * velocity[n, k] ** 2
                moment[k] += mass[n] * position[n, k]
            w, x, y, z = turn[n, 0], -turn[n, 1], -turn[n, 2], -turn[n, 3]
            a, b, c = velocity[n, 3], velocity[n, 4], velocity[n, 5]
            p, q, r = y * c - z * b, z * a - x * c, x * b - y * a  # to the frame of the body
            spin = (
                a + 2.0 * (w * p + y * r - z * q), b + 2.0 * (w * q + z * p - x * r), c + 2.0 * (w * r + x * q - y * p)
            )  # fmt: skip
            for k in range(3):
                if np.isfinite(inertia[n, k]):
                    kinetic += 0.5 * inertia[n, k] * spin[k] ** 2
    return kinetic, moment


def energy_balance(step: Step) -> dict[str, float]:
    """Energies at the end of the step and where their change came from [J].

        change of kinetic + potential + spring = work of motions - friction loss - impact loss + time stepping

    With g the impulses and w the mean of the velocities before and after (of prescribed motions: that of the step), the
    impulses do the work g' D' w. Its tangential part is the friction loss. Its normal part goes to the springs of
    contacts, and the rest is lost in impacts, or pushes overlaps of rigid contacts apart where it is a gain. The work
    of motions is that of prescribed bodies on the others, and that of the drives of guided and hinged bodies. The rest
    is the error of the semi-implicit step, of the order of dt: -dt/2 m g (v_new - v_old) per body.
    """
    world, near, comm = step.world, step.contacts.near, step.world.comm
    before = near.bodies.take(slice(0, near.grains)), near.bodies.take(slice(near.grains + near.ghosts, None))
    after = world.grains, world.large
    moves = bodies.is_dynamic(world.large)
    mean = [0.5 * (old.velocity + new.velocity) for old, new in zip(before, after)]
    mean[1][~moves] = world.large.velocity[~moves]

    def sums(grains: Any, large: Any) -> Floats:
        """Local sums; what all ranks know of the large bodies counts once."""
        return np.array(grains) + (np.array(large) if comm.rank == 0 else 0.0)

    was = sums(*(energy(table, world.gravity) for table in before))
    now = sums(*(energy(table, world.gravity) for table in after))
    slip = step.system.contact_velocities(*mean)
    normal, tangential = (np.vdot(step.impulse[:, part], slip[:, part]) for part in (slice(0, 1), slice(1, 3)))
    received = np.vdot(step.impulse_on_large[~moves], mean[1][~moves])
    springs = comm.allreduce(spring_energies(step))
    work = np.vdot(step.system.drive_impulse, mean[1]) - received
    whole = comm.allreduce(np.array([*was, *now, normal, tangential]))
    change, held = whole[2] + whole[3] - whole[0] - whole[1], springs[1] - springs[0]
    return {
        "kinetic_energy [J]": whole[2],
        "potential_energy [J]": whole[3],
        "spring_energy [J]": springs[1],
        "work_of_motions [J]": work,
        "friction_loss [J]": 0.0 - whole[5],  # nothing is zero, not -0
        "impact_loss [J]": 0.0 - whole[4] - held,
        "time_stepping [J]": change - work - whole[4] - whole[5],
    }


def spring_energies(step: Step) -> Floats:
    """What the contacts of this rank hold as springs at the start and at the end of a step (2,) [J].

    k/2 d^2 of an overlap d, which changes in the step by dt times the normal velocity at its end. Collective."""
    system, gap = step.system, step.contacts.gap
    k = np.where(np.isinf(system.stiffness), 0.0, system.stiffness)
    after = system.contact_velocities(step.world.grains.velocity, step.world.large.velocity)
    overlaps = np.maximum(-gap, 0.0), np.maximum(-gap - system.dt * after[:, 0], 0.0)
    return np.array([0.5 * k @ overlap**2 for overlap in overlaps])


def contact_statistics(step: Step) -> dict[str, float]:
    """Statistics of the contacts: how many there are, how many bear forces and slide. Overlaps are those at the start
    of the step.

    A contact is active if its normal impulse exceeds 1 % of the mean, as solvers leave small impulses at others. It
    slides if its tangential impulse is 99 % of what friction can bear, or more. The coordination number is the mean
    number of active contacts per grain.
    """
    comm, contacts = step.world.comm, step.contacts
    count, weight = comm.allreduce(np.array([len(contacts), step.impulse[:, 0].sum()]))
    grain = contacts.near.bodies.shape != COMPOUND
    least = 0.01 * weight / max(count, 1.0)
    *sums, worst = counted(step.impulse, contacts.friction, contacts.gap, contacts.a, contacts.b, grain, least)
    sums = comm.allreduce(np.array(sums))
    return {
        "contacts": count,
        "active_contacts": sums[0],
        "coordination_number": sums[2] / step.world.slabs[-1],
        "sliding_fraction": sums[1] / max(sums[0], 1),
        "worst_overlap [m]": comm.allreduce(worst, MPI.MAX),
    }


@loop
def counted(impulse, friction, gap, a, b, grain, least):
    """Of contacts of bodies in the rows a, b (nc,), those active whose normal impulse exceeds the `least`: their
    number, how many of them slide, how many ends of them are at grains; and the greatest overlap of all, 0 if none."""
    active, sliding, ends, worst = 0, 0, 0, 0.0
    for c in range(len(gap)):
        normal, bears = impulse[c, 0], 0.99 * friction[c] * impulse[c, 0]
        worst = max(worst, -gap[c])
        if normal > least:
            active += 1
            ends += int(grain[a[c]]) + int(grain[b[c]])
            if np.sqrt(impulse[c, 1] ** 2 + impulse[c, 2] ** 2) >= bears:
                sliding += 1
    return active, sliding, ends, worst
