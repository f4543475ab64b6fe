"""The semi-implicit step: new velocities come from the contact problem, and positions follow them.

Where bodies turn so fast that the contacts found at the start of a step do not keep them apart, `find_turned` finds
the others.
"""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from mpi4py import MPI

from dem import bodies, quaternion
from dem.arrays import ArrayLike, Bools, Floats, Ints
from dem.bodies import SPHERE, Bodies
from dem.contact import Contacts, contact_order, find_contacts
from dem.contact_map.loops import relative_velocities
from dem.keys import places
from dem.system import ContactSystem, contact_arms, contact_frames, gap_velocities
from dem.together import meet
from dem.world import World


@dataclass(frozen=True)
class Step:
    """A step that was just made, with its forces, places and sums: the argument of a scene's `record`.

    `advance` was called, the grains are not yet balanced anew.
    """

    world: World  #: at the end of the step
    contacts: Contacts
    system: ContactSystem
    impulse: Floats  #: (nc, 3) of the local contacts: normal, t1, t2 [N s]

    def force_on(self, name: str) -> Floats:
        """Contact force and torque (6,) [N, N m] on a large body, about its reference point, averaged over the step."""
        return self.impulse_on_large[self.world.large_row(name)] / self.system.dt

    def position(self, name: str) -> Floats:
        """Position (3,) of a large body [m]."""
        return self.world.large.position[self.world.large_row(name)].copy()

    def velocity(self, name: str) -> Floats:
        """Linear and angular velocity (6,) of a large body [m/s, rad/s]."""
        return self.world.large.velocity[self.world.large_row(name)].copy()

    def total(self, values: ArrayLike) -> float:
        """The sum of values (grains,) over all grains; each rank passes those of its `world.grains`. Collective: the
        `record` of a scene must call it on all ranks."""
        meet(self.world.comm, "Step.total")
        return float(self.world.comm.allreduce(float(np.sum(values))))

    @cached_property
    def impulse_on_large(self) -> Floats:
        """Impulses and angular impulses (large, 6) of the contacts on the large bodies; the same on all ranks."""
        return self.system.impulse_on_large(self.impulse)


def advance(world: World, velocity: Floats, dt: float, moving: Floats | None = None) -> None:
    """Take the velocities (owned, 6) of `ContactSystem` and move all bodies by dt [s]; collective.

    x <- x + dt v, q <- exp(dt w) q, with the velocities `moving` (owned, 6) in place of these if they are given.
    Prescribed motions are followed exactly, whatever dt; SceneError if one fails.
    """
    moving = velocity if moving is None else moving
    large_velocity, large_moving = world.large_velocity(velocity), world.large_velocity(moving)
    _move(world.grains, velocity[: len(world.grains)], moving[: len(world.grains)], dt)
    _move(world.large, large_velocity, large_moving, dt)
    world.time += dt
    world.step += 1
    follow_motions(world)


def advanced(world: World, velocity: Floats, dt: float) -> World:
    """The world that `advance` leads to; this one stays as it is. Collective."""
    after = copy(world)
    after.grains, after.large = replace(world.grains), replace(world.large)
    advance(after, velocity, dt)
    return after


def follow_motions(world: World) -> None:
    """Put the bodies of prescribed motion where they are to be now; collective. SceneError if a motion fails."""

    for row, pose in world.poses(world.time).items():
        world.large.position[row], world.large.quaternion[row] = pose


def _move(table: Bodies, velocity: Floats, moving: Floats, dt: float) -> None:
    table.velocity = velocity.copy()
    table.position = table.position + dt * moving[:, :3]
    table.quaternion = quaternion.integrate(table.quaternion, moving[:, 3:], dt)


def find_turned(
    world: World, contacts: Contacts, velocity: Floats, dt: float, depth: float, recovery_speed: float
) -> Contacts | None:
    """The contacts, with those that overlap by more than `depth` [m] if bodies go on for dt [s] with these velocities
    (owned, 6); None if there are none, or if the grains that are no spheres turn by less than that; collective.

    A step takes the gap of a contact as linear in the velocities. Where bodies turn, its point and its normal move, and
    other points may meet. What overlaps at the end of the step is linearised there: with the normal n of the end, and
    the gap at the start that leads to the gap of the end with these velocities. This is a step of Newton's method (of
    sequential quadratic programming) for the gaps at the end of the step.
    """
    if not _turn(world, velocity[: len(world.grains)], dt, depth):
        return None
    end = find_contacts(advanced(world, velocity, dt), 0.0)
    end = end.take(end.gap < -depth)
    start, approach = _at_start(end, dt)
    overlap = -(dt * gap_velocities(world, start, dt, recovery_speed)[2] + approach)
    a, b, known = _rows_in(contacts, end)
    missed = known & (overlap > depth)
    if not world.comm.allreduce(bool(missed.any()), MPI.LOR):
        return None
    found = replace(start, a=a, b=b, near=contacts.near).take(missed)
    return _joined(world, contacts.take(places(found.key, contacts.key) < 0), found)


def _turn(world: World, velocity: Floats, dt: float, depth: float) -> bool:
    """Whether points of grains that are no spheres move by more than `depth` as these turn, on any rank. False if a
    velocity is not finite."""
    if world.only_spheres:
        return False
    grains = world.grains
    way = dt * bodies.bounding_radius(grains) * quaternion.length(velocity[:, 3:])
    fast, finite = bool((way[grains.shape != SPHERE] > depth).any()), bool(np.isfinite(velocity).all())
    return world.comm.allreduce(fast, MPI.LOR) and world.comm.allreduce(finite, MPI.LAND)


def _at_start(end: Contacts, dt: float) -> tuple[Contacts, Floats]:
    """The contacts of the end of a step as contacts of its start, and by how much (nc,) their gaps grow in it [m]."""
    velocity, row = end.near.bodies.velocity, np.stack([end.a, end.b], axis=1).astype(np.uint32)
    point = end.point - 0.5 * dt * velocity[row, :3].sum(axis=1)
    arm = contact_arms(point, end.near.bodies.position - dt * velocity[:, :3], row)
    growth = dt * relative_velocities(contact_frames(end.normal).reshape(-1, 9), arm, row, velocity)[:, 0]
    return replace(end, point=point, gap=end.gap - growth), growth


def _rows_in(contacts: Contacts, end: Contacts) -> tuple[Ints, Ints, Bools]:
    """Rows (nc,) of the bodies a and b of `end` in the table of `contacts`, and whether both are there."""
    index = contacts.near.index
    order = np.argsort(index)
    place = np.searchsorted(index, end.body, sorter=order)
    row = order[np.minimum(place, len(index) - 1)]
    known: Bools = (index[row] == end.body).all(axis=1)
    return row[:, 0], row[:, 1], known


def _joined(world: World, one: Contacts, other: Contacts) -> Contacts:
    """Both, in the order of contacts."""
    more = other.columns()
    both = {name: np.concatenate([column, more[name]]) for name, column in one.columns().items()}
    order = contact_order(world, one.near, both["a"], both["b"], both["key"])
    return replace(one, **{name: column.take(order, axis=0) for name, column in both.items()})
