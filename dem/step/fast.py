"""Grains that go further in a step than the search for contacts looks: whether they meet anything on their way.

The margin of a grain ends at two of its radii, as contacts that far away are taken for planes. A grain that goes
further may do so through empty space alone. If it meets a body there, the step is refused: its normal and its arms are
not those of the start of the step, and the grain may meet several bodies one after another.
"""

from __future__ import annotations

import numpy as np

from dem.arrays import Bools, Floats, places
from dem.bodies import SPHERE
from dem.compiled import loop
from dem.contact import Contacts, find_contacts, velocities_about
from dem.exchange import greatest, on_any, reduced
from dem.model.world import World
from dem.quaternion import cross, length
from dem.step.system import contact_arms
from dem.together import SceneError
from dem.unconstrained import UnconstrainedMotion, large_velocity

FAR = 2.0  #: radii that a margin reaches at most
MANY = 1e7  #: pairs that are tested at most when margins are wider than a packing


def refuse_passages(
    world: World, free: UnconstrainedMotion, contacts: Contacts, velocity: Floats, delta: float
) -> None:
    """SceneError, on all ranks, if with these velocities (owned, 6) a grain goes further in a step than two radii, and
    may meet a body that is in no contact with it; collective.

    For two spheres the test is exact. For other pairs it asks whether the grain crosses the plane through the closest
    points of the two: convex bodies that do not turn cannot meet without. So it never misses one of these, but refuses
    some that pass beside a body. The margins are doubled from one search to the next, so that in a dense packing the
    first search tells.
    """
    grains, dt = world.grains, free.dt
    most = FAR * contacts.lists.table.radius[: len(grains)]
    here, own = beyond(velocity, most, dt)
    if not on_any(world.comm, here > 0)[0]:
        return
    (count,), (furthest,) = reduced(world.comm, (here,), (own,))
    speed = length(velocity[: len(grains), :3])
    travel = dt * speed
    fast = (travel > most) & np.isfinite(travel)
    lists, reach, seen = contacts.lists, 1.0, contacts.near.margin[: len(grains)]
    large = large_velocity(world, free, velocity)
    # where bodies are, not where they will be
    known = find_contacts(world, delta, None, seen, contacts.shifts, lists).key
    while reach < furthest:
        reach *= 2.0
        worst = (0.0, -1, -1)  # speed [m/s], and the ids of the grain and of what it meets
        if reach > 32.0 and count * float(world.slabs[-1]) > MANY:  # every grain would see every other
            row = int(np.argmax(np.where(fast, speed, 0.0))) if fast.any() else -1
            worst = (float(speed[row]), int(grains.id[row]), -1) if row >= 0 else worst
        else:
            margin = np.where(fast, np.minimum(travel, reach * most), 0.0)
            wide = find_contacts(world, delta, None, np.maximum(seen, margin), contacts.shifts, lists)
            lists, wide = wide.lists, wide.take(places(known, wide.key) < 0)
            table = velocities_about(wide, velocity, large)
            met = wide.take(_meet(world, wide, table, delta, dt))
            if len(met):
                pair = np.stack([met.a, met.b], axis=1)
                grain = pair < met.near.grains + met.near.ghosts
                of = np.where(grain, length(table[pair, :3]), -1.0)
                row = int(np.argmax(of.max(axis=1)))
                first = int(np.argmax(of[row]))
                id = met.near.bodies.id[pair[row]]
                worst = (float(of[row, first]), int(id[first]), int(id[1 - first]))
        worst = greatest(world.comm, worst)
        if worst[1] >= 0:
            raise SceneError(_refusal(world, worst, dt, furthest))


@loop
def beyond(velocity: Floats, most: Floats, dt: float) -> tuple[int, float]:
    """How many bodies of velocities (n or more, 6) go further in dt [s] than `most` (n,), and the furthest over that;
    zero if none does."""
    count, furthest = 0, 0.0
    for n in range(len(most)):
        travel = dt * np.sqrt(velocity[n, 0] ** 2 + velocity[n, 1] ** 2 + velocity[n, 2] ** 2)
        if travel > most[n] and np.isfinite(travel):
            count, furthest = count + 1, max(furthest, travel / most[n])
    return count, furthest


def _meet(world: World, contacts: Contacts, table: Floats, delta: float, dt: float) -> Bools:
    """Which of the contacts (nc,) close within dt, to a hundredth of delta, with the velocities (rows, 6) of the bodies
    of `near`."""
    near, row = contacts.near, np.stack([contacts.a, contacts.b], axis=1)
    arm = contact_arms(contacts, near.bodies.position, row.astype(np.uint32)).reshape(-1, 2, 3)
    spin = cross(table[row, 3:], arm)
    shape = near.bodies.shape[row]
    spin[shape == SPHERE] = 0.0  # their surfaces do not move
    travel = dt * (table[row, :3] + spin)
    travel = travel[:, 1] - travel[:, 0]
    if (flow := contacts.flow(world.cell, near.bodies.position)) is not None:
        travel += dt * flow
    closes: Bools = contacts.linear_gap + np.einsum("ci,ci->c", travel, contacts.normal) < -0.01 * delta
    balls = (shape == SPHERE).all(axis=1)
    radii = near.bodies.size[row[balls], 0].sum(axis=1)
    apart = contacts.branch(near.bodies.position)[balls]
    square = np.maximum(length(travel[balls]) ** 2, 1e-300)
    share = -np.einsum("ci,ci->c", apart, travel[balls]) / square
    nearest = apart + np.clip(share, 0.0, 1.0)[:, None] * travel[balls]
    closes[balls] = length(nearest) < radii - 0.01 * delta
    return closes


def _refusal(world: World, worst: tuple[float, int, int], dt: float, furthest: float) -> str:
    """What to say of a speed, a grain and the body that it may meet (-1: not known), by their ids."""
    speed, one, other = worst
    met = world.name_of(other) if other >= 0 else "other bodies"
    return (
        f"step {world.step + 1}: {world.name_of(one)} moves at {speed:.4g} m/s, too far in a time step of {dt:g} s "
        f"to see whether it passes through {met}; a dt of {0.95 * dt / furthest:.2g} s is safe at this speed"
    )
