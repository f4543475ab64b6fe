"""Contacts of bodies that turn so fast that the contacts found at the start of a step do not keep them apart."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from mpi4py import MPI

from dem import bodies
from dem.arrays import Bools, Floats, Ints
from dem.bodies import SPHERE
from dem.contact import Contacts, contact_order, find_contacts
from dem.contact_map.loops import relative_velocities
from dem.quaternion import length
from dem.step import advanced
from dem.system import contact_arms, contact_frames
from dem.world import World


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
    overlap = -(np.maximum(start.gap, -recovery_speed * dt) + approach)
    a, b, known = _rows_in(contacts, end)
    missed = known & (overlap > depth)
    if not world.comm.allreduce(bool(missed.any()), MPI.LOR):
        return None
    found = replace(start, a=a, b=b, near=contacts.near).take(missed)
    return _joined(world, contacts.take(~np.isin(contacts.key, found.key)), found)


def _turn(world: World, velocity: Floats, dt: float, depth: float) -> bool:
    """Whether points of grains that are no spheres move by more than `depth` as these turn, on any rank. False if a
    velocity is not finite."""
    if world.only_spheres:
        return False
    grains = world.grains
    way = dt * bodies.bounding_radius(grains) * length(velocity[:, 3:])
    fast, finite = bool((way[grains.shape != SPHERE] > depth).any()), bool(np.isfinite(velocity).all())
    return world.comm.allreduce(fast, MPI.LOR) and world.comm.allreduce(finite, MPI.LAND)


def _at_start(end: Contacts, dt: float) -> tuple[Contacts, Floats]:
    """The contacts of the end of a step as contacts of its start, and by how much (nc,) their gaps grow in it [m]."""
    velocity, row = end.near.bodies.velocity, np.stack([end.a, end.b], axis=1)
    point = end.point - 0.5 * dt * velocity[row, :3].sum(axis=1)
    arm = contact_arms(point, end.near.bodies.position - dt * velocity[:, :3], row)
    frame = contact_frames(end.normal).reshape(-1, 9)
    growth = dt * relative_velocities(frame, arm, row.astype(np.uint32), velocity)[:, 0]
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
