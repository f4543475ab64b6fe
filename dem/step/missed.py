"""Contacts that the search at the start of a step has missed.

Where impulses send bodies so far, or bodies turn so fast, that the contacts found there do not keep them apart,
`find_overrun` and `find_turned` find the others.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np

from dem import quaternion
from dem.arrays import Bools, Floats, Ints, Keys, places
from dem.bodies import BOX, CLUMP, COMPOUND, CONVEX, POLYHEDRON, SPHERE, radius_about
from dem.compiled import loop
from dem.contact import Contacts, contact_order, exceeds_margin, find_contacts, greatest_travel, velocities_about
from dem.contact_map.loops import relative_velocities
from dem.exchange import on_any
from dem.model.neighbourhood import Neighbourhood
from dem.model.world import World
from dem.shapes.forms import Form, arms
from dem.step import advanced
from dem.step.system import contact_arms, gap_velocities
from dem.unconstrained import UnconstrainedMotion, large_velocity

#: Of two linearisations of a contact the later one replaces the other: cosine between their normals, at least, and way
#: between their points over the overlap that is let pass, at most.
ALIKE, NEAR = 0.99, 10.0
BESIDE = (0.0, 0.5j, 0.25j)  #: what keys of later linearisations have more, by how often it was tried before


def find_overrun(
    world: World, free: UnconstrainedMotion, contacts: Contacts, velocity: Floats, delta: float, depth: float,
    recovery_speed: float,
) -> Callable[[], Contacts] | None:  # fmt: skip
    """Return the search for the contacts of wider margins, if with these velocities (owned, 6) bodies go further in the
    step than their margins in the search for `contacts`, and overlap by more than `depth` [m] with others that it has
    not seen. None if none do; collective, as the search is, before which these contacts may go.

    The search may be repeated for the contacts that it finds: margins only grow.
    """
    dt, seen = free.dt, contacts.near.margin[: contacts.near.grains]
    travel = greatest_travel(world, velocity[: len(seen)], dt)
    large = large_velocity(world, free, velocity)
    # the ranks tell each other also of large bodies, which all know: processors of other kinds may round otherwise
    gone = bool((travel > seen).any()), exceeds_margin(world, contacts, dt * large, delta)
    further, beyond = on_any(world.comm, *gone)
    if not (further or beyond):
        return None
    shifts = np.concatenate([contacts.shifts, dt * large[None]]) if beyond else contacts.shifts
    margin = np.maximum(seen, travel)
    unseen = find_contacts(world, delta, free, margin, shifts, contacts.lists, besides=contacts)
    table = velocities_about(unseen, velocity, large)
    opening = _opening(world, unseen, unseen.near.bodies.position, table)
    overlap = -dt * (gap_velocities(world, unseen, dt, recovery_speed)[2] + opening)
    if not on_any(world.comm, bool((overlap > depth).any()))[0]:
        return None
    return partial(find_contacts, world, delta, free, margin, shifts, unseen.lists)


def _opening(world: World, contacts: Contacts, position: Floats, velocity: Floats) -> Floats:
    """Normal velocities (nc,) of contacts of bodies with these positions and velocities (rows, 3 and 6)."""
    row = np.stack([contacts.a, contacts.b], axis=1).astype(np.uint32)
    arm = contact_arms(contacts, position, row)
    opening: Floats = relative_velocities(contacts.frame.reshape(-1, 9), arm, row, velocity)[:, 0]
    flow = contacts.flow(world.cell, position)
    return opening if flow is None else opening + np.einsum("ci,ci->c", contacts.normal, flow)


def find_turned(
    world: World, free: UnconstrainedMotion, contacts: Contacts, velocity: Floats, depth: float,
    recovery_speed: float, tried: int,
) -> Contacts | None:  # fmt: skip
    """The contacts, with those that overlap by more than `depth` [m] if bodies go on for a step with these velocities
    (owned, 6), and that deeper than foreseen; None if there are none, or if the grains that are no spheres turn by less
    than that; collective.

    A step takes the gap of a contact as linear in the velocities. Where bodies turn, its point and its normal move, and
    other points may meet. What overlaps at the end of the step is linearised there: with the normal n of the end, and
    the gap at the start that leads to the gap of the end with these velocities. A contact that is there with nearly
    this normal stays, with a gap that is corrected (`_corrected`). This is a step of Newton's method (of sequential
    quadratic programming) for the gaps at the end of the step. What springs bear, and what a solution leaves, is
    foreseen. Where it was `tried` in this time step, what turns between two features, or rocks on a flat side, would go
    to and fro for ever: a linearisation with another normal or point then stays, and the new one is a contact beside
    it.
    """
    dt = free.dt
    if not _turn(world, velocity[: len(world.grains)], dt, depth):
        return None
    turn = None if world.large_moves else partial(_turning, forms=world.forms, dt=dt, depth=depth)
    end = find_contacts(advanced(world, free, contacts, velocity), 0.0, among=turn)
    end = end.take(end.gap < -depth)
    if not on_any(world.comm, bool(len(end)))[0]:
        return None
    large = large_velocity(world, free, velocity)
    foreseen = _foreseen(world, contacts, velocities_about(contacts, velocity, large), dt, end.key)
    start, approach = _at_start(world, end, velocities_about(end, velocity, large), dt)
    overlap = -(dt * gap_velocities(world, start, dt, recovery_speed)[2] + approach)
    a, b, known = _rows_in(contacts, end)
    missed = known & (overlap > depth) & (end.gap < foreseen - 1e-3 * depth)  # rounding is no reason
    if not on_any(world.comm, bool(missed.any()))[0]:
        return None
    if contacts.linear is not None:
        moved = np.zeros_like(start.point) if start.moved is None else start.moved
        real = np.maximum(start.gap, -_overlaps_of(contacts, start.body))
        start = replace(start, moved=moved, linear=start.gap, gap=real)
    found = replace(start, a=a, b=b, near=contacts.near).take(missed)
    if contacts.linear is not None:
        contacts, found = _corrected(contacts, found, (end.gap - foreseen)[missed], tried, NEAR * depth)
    if tried and len(contacts):
        place = places(contacts.key, found.key)
        others = np.einsum("ci,ci->c", contacts.normal[place], found.normal) < ALIKE
        others |= quaternion.length(contacts.point[place] - found.point) > NEAR * depth
        found = replace(found, key=np.where((place >= 0) & others, found.key + BESIDE[tried], found.key))
    return _joined(world, contacts.take(places(found.key, contacts.key) < 0), found)


def _corrected(
    contacts: Contacts, found: Contacts, deeper: Floats, tried: int, near: float
) -> tuple[Contacts, Contacts]:
    """The contacts, whose gaps with large bodies are corrected where `found` has them again by how much they are
    `deeper` (n,) at the end of the step than foreseen, and what is found beside them: with another normal, deeper by
    more than `near` [m], or of bodies with corners, where it was `tried` before, at a point further off than that.

    What stays has the arms of the start of the step: with those of the end each step would brake a body that rolls,
    rocks or wobbles (see `dem.contact.ahead`). Between two grains, which both turn, corrections alone do not converge
    in a few tries: beds of mixed shapes would overlap four times as deep."""
    place, shape = places(contacts.key, found.key), found.near.bodies.shape
    same = (place >= 0) & (shape[found.b] == COMPOUND)
    at, own, shape = place[same], found.take(same), shape[found.a[same]]
    alike = (np.einsum("ci,ci->c", contacts.normal[at], own.normal) >= ALIKE) & (deeper[same] > -near)
    if tried:
        corners = (shape == BOX) | (shape == COMPOUND) | ((shape >= POLYHEDRON) & (shape < CONVEX))
        alike &= ~corners | (quaternion.length(contacts.point[at] - own.point) <= near)
    same[same] = alike
    linear = contacts.linear_gap.copy()
    linear[place[same]] += deeper[same]
    return replace(contacts, linear=linear), found.take(~same)


def _overlaps_of(contacts: Contacts, body: Ints) -> Floats:
    """How deep the pairs of bodies (n, 2) overlap in these contacts; 0 where they do not [m]."""
    over = contacts.take(contacts.gap < 0.0)
    pairs, row = np.unique(body @ [1.0, 1.0j], return_inverse=True)
    deepest, pair = np.zeros(len(pairs)), over.body @ [1.0, 1.0j]  # several contacts have one pair
    here = np.isin(pair, pairs)
    np.maximum.at(deepest, np.searchsorted(pairs, pair[here]), -over.gap[here])
    return deepest[row]


def _foreseen(world: World, contacts: Contacts, velocity: Floats, dt: float, key: Keys) -> Floats:
    """The gaps (n,) at the end of a step with these velocities (rows, 6) that contacts of these keys foresee, the least
    of those of a pair of features; inf where there are none [m]."""
    gap = np.full(len(key), np.inf)
    for tried in BESIDE:
        place = places(contacts.key, key + tried)
        of = contacts.take(place[place >= 0])
        end = of.linear_gap + dt * _opening(world, of, of.near.bodies.position, velocity)
        gap[place >= 0] = np.minimum(gap[place >= 0], end)
    return gap


def _turn(world: World, velocity: Floats, dt: float, depth: float) -> bool:
    """Whether grains that are no spheres turn so that contacts may be deeper by more than `depth` than foreseen, on any
    rank. False if a velocity is not finite.

    Points of their surfaces move by more than that, which brings others near. Of a clump these are on spheres, whose
    centres go on arcs: at most c w^2 / 2 off their tangents, for a distance c from the centre, of each of a pair."""
    if world.only_spheres:
        return False
    grains = world.grains
    fast = turned(velocity, grains.shape, grains.size, arms(world.forms), dt, depth)
    any_fast, not_finite = on_any(world.comm, bool(fast.any()), not np.isfinite(velocity).all())
    return any_fast and not not_finite


def _turning(near: Neighbourhood, forms: tuple[Form, ...], dt: float, depth: float) -> Bools:
    """Which grains and ghosts turn so."""
    table, seen = near.bodies, near.grains + near.ghosts
    return turned(table.velocity[:seen], table.shape[:seen], table.size[:seen], arms(forms), dt, depth)


@loop
def turned(velocity: Floats, shape: Ints, size: Floats, arms: Floats, dt: float, depth: float) -> Bools:
    """Which grains of shapes (n,) and sizes (n, 3), with the `arms` (forms,) of clumps, turn as `_turn` says."""
    fast = np.zeros(len(shape), np.bool_)
    for n in range(len(shape)):
        x, y, z = velocity[n, 3], velocity[n, 4], velocity[n, 5]
        angle = dt * np.sqrt(x * x + z * z + y * y)
        way = radius_about(shape[n], size[n]) * angle
        if CLUMP <= shape[n] < POLYHEDRON:
            way = arms[shape[n] - CLUMP] * angle**2
        fast[n] = shape[n] != SPHERE and way > depth
    return fast


def _at_start(world: World, end: Contacts, velocity: Floats, dt: float) -> tuple[Contacts, Floats]:
    """The contacts of the end of a step with these velocities (rows, 6) as contacts of its start, and by how much (nc,)
    their gaps grow in it [m]."""
    start = replace(end, point=end.point - 0.5 * dt * (velocity[end.a, :3] + velocity[end.b, :3]))
    position = end.near.bodies.position - dt * velocity[:, :3]
    flow = end.flow(world.cell, end.near.bodies.position)
    if flow is not None and end.moved is not None:
        start = replace(start, point=start.point - 0.5 * dt * flow, moved=end.moved - dt * flow)
    growth = dt * _opening(world, start, position, velocity)
    if world.cell.deforms and start.moved is not None:
        shift = dt * world.cell.rate * position  # of the centres, which the cell takes with it
        start = replace(start, point=start.point - shift[end.a], moved=start.moved + shift[end.b] - shift[end.a])
    return replace(start, gap=end.gap - growth), growth


def _rows_in(contacts: Contacts, end: Contacts) -> tuple[Ints, Ints, Bools]:
    """Rows (nc,) of the bodies a and b of `end` in the table of `contacts`, and whether both are there."""
    index = contacts.near.index
    order = np.argsort(index)
    place = np.searchsorted(index, end.body, sorter=order)
    row = order[np.minimum(place, len(index) - 1)]
    known: Bools = (index[row] == end.body).all(axis=1)
    return row[:, 0], row[:, 1], known


def carried(world: World, contacts: Contacts, wider: Contacts) -> Contacts:
    """Return the contacts of a wider search, where they are among these as these: `find_turned` has linearised some
    anew."""
    a, b, known = _rows_in(wider, contacts)
    kept = replace(contacts, a=a, b=b, near=wider.near, shifts=wider.shifts).take(known)
    return _joined(world, wider.take(places(kept.key, wider.key) < 0), kept)


def _joined(world: World, one: Contacts, other: Contacts) -> Contacts:
    """Both, in the order of contacts."""
    if (one.parting is None) != (other.parting is None):
        one, other = (x if x.parting is not None else replace(x, parting=np.full(len(x), np.nan)) for x in (one, other))
    if (one.swing is None) != (other.swing is None):
        one, other = (x if x.swing is not None else replace(x, swing=np.zeros_like(x.point)) for x in (one, other))
    one, other = replace(one, touched=None), replace(other, touched=None)  # impacts were followed before
    more = other.columns()
    both = {name: np.concatenate([column, more[name]]) for name, column in one.columns().items()}
    order = contact_order(world, one.near, both["a"], both["b"], both["key"])
    return replace(one, **{name: column.take(order, axis=0) for name, column in both.items()})
