"""Impacts of spheres in their order, each at the place and the time at which the two bodies touch.

A step solves all its contacts at once, with the directions of its end. That is right for bodies that stay in touch. Of
bodies that fly, two meet at some time within the step, where their line of centres is another one, and one impact leads
to the next. So impacts of spheres whose other contacts bear nothing of them are followed from one to the next, as
event-driven dynamics does. Their contacts get the normal and the arms of the place of touch, and the normal velocity
with which the two part in the end. The step then finds the impulses, with those of all others. They act from the time
of touch on, so the bodies end where they would have come, and the angular momentum of a pair is kept.

Impacts on what rests in a bed, or in a row of spheres that touch, are left to the step, which lets all happen at once.
Source: Lubachevsky, How to simulate billiards and similar systems, Journal of Computational Physics 94, 1991.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np

from dem.arrays import Bools, Floats, Ints
from dem.bodies import SPHERE
from dem.compiled import inlined, loop
from dem.contact import Contacts, velocities_about
from dem.exchange import on_any
from dem.geometry.vectors import cross, dot, plus
from dem.model.world import World
from dem.parts.ends import Constraint
from dem.scene import kinds_of
from dem.step.laws import slowest
from dem.unconstrained import UnconstrainedMotion
from dem.unconstrained.constraints import slots

#: Kinds of contacts: of two spheres, of a sphere that bounces from a body that forces do not move, and all others.
PAIR, WALL, OTHER = 0, 1, 2

#: Impacts of one contact in a step, after which those of its bodies are left to the step: they end at rest together.
MANY = 20

#: The share of a change of velocity with which an impact may load another contact of its bodies.
LOADS = 0.05

#: Of a relative velocity: bodies that come together slower than that have met.
ROUNDING = 1e-9

#: The square of a step over the time of an impact, sqrt(m / k), above which no step resolves its spring.
SHORT = 25.0


#: Of contacts (nc,) the rows of the two bodies, the normals (nc, 3) and the gaps.
Touching = tuple[Ints, Ints, Floats, Floats]

#: Of bodies (rows,) which are spheres, the masses, the radii of spheres, and the materials.
Spheres = tuple[Bools, Floats, Floats, Ints]


def in_order(world: World, contacts: Contacts, motion: UnconstrainedMotion) -> Contacts:
    """The contacts of a step, of this motion without contacts, with what impacts that are followed change of them;
    collective.

    Followed are impacts of two spheres, and of spheres that bounce from bodies that forces do not move, if they come
    faster than `slowest`; without restitution those of two that are near no other. Two spheres that pass each
    other have no contact that closes. In cells that deform, and where bodies attract each other, nothing is
    followed."""
    touched = contacts.touched
    contacts = contacts if touched is None else replace(contacts, touched=None)
    if world.cell.moves or world.pairs.attracts or not world.any_spheres:
        return contacts
    near, table, pairs, dt = contacts.near, contacts.near.bodies, world.pairs, motion.dt
    grains, old = near.grains + near.ghosts, table.velocity
    ball = table.shape == SPHERE
    ball[grains:] = False
    if kinds_of(Constraint, world.named):
        ball[slots(world, table.id)[0]] = False
    radius = np.ascontiguousarray(table.size[:, 0])
    surface, slow = np.zeros((0, 3)), np.zeros(len(contacts)) + dt * math.hypot(*world.gravity)
    closing = np.zeros(len(contacts))
    if pairs.bounces:
        old = old.copy()
        old[grains:] = motion.prescribed
        free = velocities_about(contacts, motion.grains, old[grains:])
        forced = free[:, :3] - old[:, :3]
        closing = np.einsum("ci,ci->c", contacts.normal, forced[contacts.a] - forced[contacts.b])
        slow = slowest(world, contacts, dt, closing, forced)
    if touched is not None:
        contacts = _where_they_touch(world, contacts, touched, motion.prescribed, (ball, radius, slow))
    if pairs.bounces:
        surface = _surfaces(contacts, old)
    bodies, laws = (ball, table.mass, radius, table.material), (pairs.restitution, pairs.stiffness)

    def met(of: Contacts, closing: Floats, slow: Floats) -> tuple[Ints, Floats, Floats, Bools, bool]:
        image, linear = -world.cell.whole(table.position[of.b] - table.position[of.a]), of.linear_gap - dt * closing
        touching, motions = (of.a, of.b, of.normal, of.gap), (table.position, old, surface)
        return struck(touching, linear, bodies, motions, laws, grains, image, dt, slow)  # type: ignore[no-any-return]

    if not pairs.bounces:  # in a bed hardly any pair is near no other
        alone = _alone(contacts.a, contacts.b, ball)
        some = len(alone) > 0 and met(contacts.take(alone), closing[alone], slow[alone])[4]
        if not on_any(world.comm, some)[0]:
            return contacts
    kind, bounce, offset, marked, some = met(contacts, closing, slow)
    if not on_any(world.comm, some)[0]:
        return contacts
    rows = np.stack([contacts.a, contacts.b], axis=1)
    chosen = np.flatnonzero(_reached(world, contacts, rows, kind, marked)[rows].any(axis=1))
    if not pairs.bounces:
        free = velocities_about(contacts, motion.grains, old[grains:])
        forced = free[:, :3] - old[:, :3]
    columns = (table.position, free, forced, radius[:, None], table.mass[:, None], table.inertia[:, :1])
    body, of = np.concatenate(columns, axis=1), rows[chosen]
    surface = _surfaces(contacts.take(chosen), free)
    given = (contacts.linear_gap, bounce, contacts.friction, kind, slow)
    contact = np.concatenate(
        [offset[chosen], contacts.normal[chosen], surface, *(x[chosen, None] for x in given)], axis=1
    )
    mine = np.concatenate([near.index[of], contact, body[of[:, 0]], body[of[:, 1]]], axis=1)
    parts = world.comm.allgather(mine) if world.comm.size > 1 else [mine]  # few: all ranks follow all
    first = sum(len(part) for part in parts[: world.comm.rank])
    index, contact, one, two = np.split(np.concatenate(parts), np.cumsum([2, contact.shape[1], body.shape[1]]), axis=1)
    names, pair = np.unique(index.astype(np.int64), return_inverse=True)
    pair, state = pair.reshape(-1, 2), np.empty((len(names), body.shape[1]))
    state[pair[:, 0]], state[pair[:, 1]] = one, two
    more = np.bincount(pair.ravel())[pair].max(axis=1) > 1  # on all ranks together
    contact[more & (contact[:, 10] == 0.0), 12] = OTHER
    *found, lag = followed(pair, np.ascontiguousarray(contact), state, dt)
    here = slice(first, first + len(mine))
    late, row = lag[pair[here, 1]] - lag[pair[here, 0]], names - world.slabs[world.comm.rank]
    own = (row >= 0) & (row < near.grains)
    of_grains = np.zeros((near.grains, 3))
    of_grains[row[own]] = lag[own]
    return _with_impacts(contacts, chosen, [x[here] for x in found], late, of_grains, dt)


@loop
def _alone(a, b, ball):
    """The contacts (k,) of balls of the rows a, b (nc,) that are near no other body."""
    many, found, count = np.zeros(len(ball), np.int64), np.empty(len(a), np.int64), 0
    for c in range(len(a)):
        many[a[c]] += 1
        many[b[c]] += 1
    for c in range(len(a)):
        if many[a[c]] == many[b[c]] == 1 and ball[a[c]] and ball[b[c]]:
            found[count] = c
            count += 1
    return found[:count]


def _surfaces(contacts: Contacts, velocity: Floats) -> Floats:
    """The velocities (nc, 3) of the second bodies in their contacts, where bodies have these (rows, 6)."""
    moved = 0.0 if contacts.moved is None else contacts.moved
    arm = contacts.point - contacts.near.bodies.position[contacts.b] - moved
    return velocity[contacts.b, :3] + np.cross(velocity[contacts.b, 3:], arm)


def _where_they_touch(
    world: World, contacts: Contacts, touched: Floats, prescribed: Floats, balls: tuple[Bools, Floats, Floats]
) -> Contacts:
    """The contacts with normal, arms and gap of the place of touch, as `touched` (nc, 4) says, of `balls` (rows,), with
    radii (rows,), that come to bodies of the `prescribed` velocities (large, 6), along the normal of the end, too,
    faster than the last of the three, `slow` (nc,). A ball that rolls from one face to the next does not."""
    (ball, radius, slow), table, near = balls, contacts.near.bodies, contacts.near
    rows = _touched(touched, contacts.a, ball)
    if not len(rows) or contacts.moved is None:
        return contacts
    velocity = table.velocity.copy()
    velocity[near.grains + near.ghosts :] = prescribed
    these = contacts.take(rows)
    comes = _surfaces(these, velocity) - velocity[these.a, :3]
    rows = rows[np.einsum("ci,ci->c", these.normal, comes) < -slow[rows]]
    a, b, n, time = contacts.a[rows], contacts.b[rows], touched[rows, :3], touched[rows, 3]
    changed = (contacts.point, contacts.normal, contacts.moved, contacts.linear_gap)
    point, normal, moved, linear = (column.copy() for column in changed)
    normal[rows], point[rows] = n, table.position[a] + radius[a, None] * n
    moved[rows] = world.cell.whole(moved[rows]) + time[:, None] * (velocity[b, :3] - velocity[a, :3])
    found = replace(contacts, point=point, normal=normal, moved=moved)
    comes = _surfaces(found.take(rows), velocity) - velocity[a, :3]
    linear[rows] = -time * np.einsum("ci,ci->c", n, comes)
    return replace(found, linear=linear)


@loop
def _touched(touched, a, ball):
    """The contacts of balls in the rows a (nc,) that have a normal of the place of touch."""
    found, count = np.empty(len(a), np.int64), 0
    for c in range(len(a)):
        if ball[a[c]] and (touched[c, 0] != 0.0 or touched[c, 1] != 0.0 or touched[c, 2] != 0.0):
            found[count] = c
            count += 1
    return found[:count]


def _with_impacts(
    contacts: Contacts, chosen: Ints, found: list[Any], late: Floats, lag: Floats, dt: float
) -> Contacts:
    """The contacts with what `followed` says of the `chosen` ones, with the change `late` (nc, 3) of the way from
    body a to body b, and the `lag` (grains, 3)."""
    (meets, after, gap, normal), known = found, np.isfinite(found[2])
    if not (known.any() or lag.any() or late.any()):
        return contacts
    place, radius = contacts.near.bodies.position, contacts.near.bodies.size[:, 0]
    linear, parting = contacts.linear_gap.copy(), np.full(len(contacts), np.nan)
    parting[chosen[known]] = np.where(meets, after, -np.inf)[known]
    by_impacts = np.einsum("ci,ci->c", contacts.normal[chosen], late)
    linear[chosen] = np.where(known, gap - dt * after, linear[chosen] + by_impacts)
    of_pairs = normal.any(axis=1)
    met, n = chosen[of_pairs], normal[of_pairs]
    a, b = contacts.a[met], contacts.b[met]
    turned, point = contacts.normal.copy(), contacts.point.copy()
    moved = np.zeros_like(point) if contacts.moved is None else contacts.moved.copy()
    turned[met] = n
    point[met] = place[a] + radius[a, None] * n
    moved[met] = point[met] + radius[b, None] * n - place[b]
    return replace(contacts, normal=turned, point=point, moved=moved, linear=linear, parting=parting, lag=lag)


def _reached(world: World, contacts: Contacts, rows: Ints, kind: Ints, marked: Bools) -> Bools:
    """The bodies (rows,) that impacts of the marked ones may reach, through contacts of these rows (nc, 2) of spheres
    that are open, or close at once, and touch no other grain; collective."""
    halo, flags = contacts.lists.halo, np.zeros((len(marked), 2))
    pairs = rows[kind == PAIR]
    beside = (contacts.gap <= 0.0) & (kind == OTHER) & (contacts.b < contacts.near.grains + contacts.near.ghosts)
    flags[:, 0] = marked
    flags[contacts.a[beside], 1] = flags[contacts.b[beside], 1] = 1.0
    while True:
        halo.add(flags)
        np.minimum(flags, 1.0, out=flags)
        halo.update(flags)
        seen = flags[:, 0].sum()
        goes_on = (flags[:, 0] > 0.0) & (flags[:, 1] == 0.0)
        flags[pairs[goes_on[pairs].any(axis=1)], 0] = 1.0
        if not on_any(world.comm, bool(flags[:, 0].sum() > seen))[0]:
            return flags[:, 0] > 0.0


@loop
def struck(
    contacts: Touching, linear: Floats, spheres: Spheres, motions: tuple[Floats, Floats, Floats],
    laws: tuple[Floats, Floats], grains: int, image: Floats, dt: float, slow: Floats,
) -> tuple[Ints, Floats, Floats, Bools, bool]:  # fmt: skip
    """Of contacts (nc,) the kinds (nc,), the coefficients of restitution (nc,)
    and the ways from the second bodies to their images (nc, 3), of spheres `image`; and which bodies (rows,) meet by
    the velocities before the step, of second ones in their contacts the third of `motions` (nc, 3), faster than `slow`
    (nc,), or pass each other while the linear gap closes, and whether any do. Those that press others that they touch
    are left out."""
    (one, two, normal, gap), (ball, mass, radius, material) = contacts, spheres
    (place, velocity, surface), (restitution, stiffness) = motions, laws
    count = len(one)
    kind, bounce, offset = np.empty(count, np.int64), np.empty(count), np.zeros((count, 3))
    kind[:] = OTHER
    meets, passes, marked = np.zeros(count, np.bool_), np.zeros(count, np.bool_), np.zeros(len(place), np.bool_)
    many = np.zeros(len(place), np.int64)
    for c in range(count):
        many[one[c]] += 1
        many[two[c]] += 1
    touches, presses, push = marked.copy(), marked.copy(), np.zeros((len(place), 3))
    for c in range(count):
        a, b, n = one[c], two[c], (normal[c, 0], normal[c, 1], normal[c, 2])
        e, k = restitution[material[a], material[b]], stiffness[material[a], material[b]]
        v = velocity[b, 0] - velocity[a, 0], velocity[b, 1] - velocity[a, 1], velocity[b, 2] - velocity[a, 2]
        closed, closes, bounce[c] = gap[c] <= 0.0, linear[c] + dt * dot(v, n) < 0.0, e
        if ball[a] and b >= grains and e > 0.0 and np.isinf(mass[b]):
            v = surface[c, 0] - velocity[a, 0], surface[c, 1] - velocity[a, 1], surface[c, 2] - velocity[a, 2]
            kind[c], meets[c] = WALL, linear[c] + dt * dot(v, n) < 0.0 and dot(v, n) < -slow[c]
        elif ball[a] and ball[b] and (e > 0.0 or (many[a] == many[b] == 1 and _is_short(k, mass, a, b, dt))):
            offset[c] = image[c]
            time, speed = _meeting(_branch(place, a, b, offset, c), v, radius[a] + radius[b])
            kind[c], meets[c] = PAIR, time <= dt and speed < -slow[c]
            passes[c] = closes and not closed
        if meets[c]:
            for i in range(3):
                push[a, i], push[b, i] = -n[i], n[i]
        elif closed and not (kind[c] == PAIR and dot(v, n) > slow[c]):  # not two that an impact has just parted
            kind[c], touches[a], touches[b] = OTHER, True, True
    for c in range(count):
        if kind[c] == OTHER and gap[c] <= 0.0:
            a, b, n = one[c], two[c], (normal[c, 0], normal[c, 1], normal[c, 2])
            presses[a] = presses[a] or dot(n, (push[a, 0], push[a, 1], push[a, 2])) > LOADS
            presses[b] = presses[b] or dot(n, (push[b, 0], push[b, 1], push[b, 2])) < -LOADS
    for c in range(count):
        a, b = one[c], two[c]
        if kind[c] == WALL:
            marked[a] = marked[a] or (meets[c] and not presses[a])
        elif kind[c] == PAIR:
            free = not (presses[a] or presses[b]) if meets[c] else passes[c] and not (touches[a] or touches[b])
            marked[a], marked[b] = marked[a] or free, marked[b] or free
    return kind, bounce, offset, marked, bool(marked.any())


@loop
def followed(
    pair: Ints, contact: Floats, state: Floats, dt: float
) -> tuple[Bools, Floats, Floats, Floats, Floats]:
    """Follow the impacts of contacts of the bodies `pair` (nc, 2) through a step of dt [s].

    contact (nc, 14): way from body b to its image (3), normal (3), velocity of the surface of b (3), linear gap,
    restitution, friction, kind, what `slowest` says. state (n, 15): place (3), velocities of the step without contacts
    (6), the change of the linear ones by forces (3), radius, mass, moment of inertia.

    Returns which contacts (nc,) have impacts, their normal velocities after the last one (nc,), the gaps at the end
    (nc,), NaN where they are left to the step, and the normals of pairs that meet (nc, 3), else zero; and by how much
    (n, 3) bodies end beside the place to which their velocities after the step would bring them."""
    start, link = _links(pair, len(state))
    left, flies = np.zeros(len(state), np.bool_), np.zeros(len(state), np.bool_)
    after, gap, c = np.zeros(len(pair)), np.full(len(pair), np.nan), 0
    normal, now = np.empty((len(pair), 3)), np.empty((len(state), 9))
    coming, times = np.empty(len(pair)), np.empty(len(pair), np.int64)
    again = True
    while again:
        now[:], normal[:], times[:], again = state[:, :9], 0.0, 0, False
        for c in range(len(pair)):
            coming[c] = _next(c, pair, contact, state, now, left, 0.0, dt)
        while len(pair):
            c = int(np.argmin(coming))
            t = coming[c]
            if t > dt:
                break
            times[c] += 1
            if times[c] > MANY:
                again = True
                for side in range(2):
                    left[pair[c, side]] = left[pair[c, side]] or side == 0 or contact[c, 12] == PAIR
                break
            n = _bounce(c, pair, contact, state, now, t, dt)
            if times[c] == 1 and contact[c, 12] == PAIR:
                normal[c, 0], normal[c, 1], normal[c, 2] = n
            for side in range(2 if contact[c, 12] == PAIR else 1):
                for k in range(start[pair[c, side]], start[pair[c, side] + 1]):
                    coming[link[k]] = _next(link[k], pair, contact, state, now, left, t, dt)
        if again:
            continue
        flies[:] = ~left
        for c in range(len(pair)):
            a, b = pair[c, 0], pair[c, 1]
            if contact[c, 12] == OTHER or left[a] or (contact[c, 12] == PAIR and left[b]):
                acts, of_impacts = _acts(c, pair, contact, state, now, dt)
                flies[a], flies[b] = flies[a] and not acts, flies[b] and not acts
                if of_impacts and not (left[a] and left[b]):
                    left[a], left[b], again = True, True, True
    for c in range(len(pair)):
        met, both = times[c] > 0, flies[pair[c, 0]] and flies[pair[c, 1]]
        if met or (contact[c, 12] == PAIR and both):
            n = contact[c, 3], contact[c, 4], contact[c, 5]
            if met and contact[c, 12] == PAIR:
                n = normal[c, 0], normal[c, 1], normal[c, 2]
            branch, v, _ = _relative(c, pair, contact, state, now)
            far = plus(branch, dt, v)
            after[c], gap[c] = dot(v, n), contact[c, 9] + dot(far, n)
            if contact[c, 12] == PAIR:
                gap[c] = np.sqrt(dot(far, far)) - state[pair[c, 0], 12] - state[pair[c, 1], 12]
    return times > 0, after, gap, normal, now[:, :3] - state[:, :3]


@inlined
def _is_short(stiffness, mass, a, b, dt):
    """Whether an impact without restitution of two bodies is over in much less than a step."""
    return stiffness * dt * dt * (1.0 / mass[a] + 1.0 / mass[b]) > SHORT


@inlined
def _branch(place, a, b, offset, c):
    """From body a to the image of body b in a contact c."""
    return (
        place[b, 0] + offset[c, 0] - place[a, 0],
        place[b, 1] + offset[c, 1] - place[a, 1],
        place[b, 2] + offset[c, 2] - place[a, 2],
    )


@inlined
def _meeting(branch, velocity, distance):
    """When two spheres with this way between their centres, and this relative velocity, are a distance apart, and the
    speed at which that grows then; infinite if never. Those that overlap meet at once."""
    a, b, c = dot(velocity, velocity), dot(branch, velocity), dot(branch, branch) - distance * distance
    root = b * b - a * c
    if b >= 0.0 or root <= 0.0:
        return np.inf, 0.0
    if c <= 0.0:
        return 0.0, b / distance
    root = np.sqrt(root)
    return c / (root - b), -root / distance


@inlined
def _links(pair, count):
    """The contacts of each body, as starts (count + 1,) and numbers."""
    start = np.zeros(count + 1, np.int64)
    for c in range(len(pair)):
        start[pair[c, 0] + 1] += 1
        start[pair[c, 1] + 1] += 1
    start = np.cumsum(start)
    link, to = np.empty(start[count], np.int64), start[:count].copy()
    for c in range(len(pair)):
        for side in range(2):
            link[to[pair[c, side]]] = c
            to[pair[c, side]] += 1
    return start, link


@inlined
def _relative(c, pair, contact, state, now):
    """Of a contact, as its bodies move `now`: the way from a to b at the start of the step (of a pair that of the
    centres, else what impacts change of it), the relative velocity in the end, and its change by forces."""
    a, b = pair[c, 0], pair[c, 1]
    if contact[c, 12] == PAIR:
        branch = _branch(now, a, b, contact, c)
        v = now[b, 3] - now[a, 3], now[b, 4] - now[a, 4], now[b, 5] - now[a, 5]
        forced = state[b, 9] - state[a, 9], state[b, 10] - state[a, 10], state[b, 11] - state[a, 11]
    else:
        branch = (
            now[b, 0] - state[b, 0] - now[a, 0] + state[a, 0],
            now[b, 1] - state[b, 1] - now[a, 1] + state[a, 1],
            now[b, 2] - state[b, 2] - now[a, 2] + state[a, 2],
        )
        v = (
            contact[c, 6] + now[b, 3] - state[b, 3] - now[a, 3],
            contact[c, 7] + now[b, 4] - state[b, 4] - now[a, 4],
            contact[c, 8] + now[b, 5] - state[b, 5] - now[a, 5],
        )
        forced = -state[a, 9], -state[a, 10], -state[a, 11]
    return branch, v, forced


@inlined
def _next(c, pair, contact, state, now, left, begin, dt):
    """When the bodies of a contact meet next, from the time `begin` on; infinite if not in the step."""
    a, b = pair[c, 0], pair[c, 1]
    if contact[c, 12] == OTHER or left[a] or (contact[c, 12] == PAIR and left[b]):
        return np.inf
    branch, v, forced = _relative(c, pair, contact, state, now)
    if contact[c, 12] == PAIR:
        later, speed = _meeting(plus(branch, begin, v), v, state[a, 12] + state[b, 12])
    else:  # the gap is gap + speed t + bend t^2 / 2, as forces act all the time
        n = contact[c, 3], contact[c, 4], contact[c, 5]
        bend, later = dot(forced, n) / dt, np.inf
        gap, speed = contact[c, 9] + dot(branch, n), dot(v, n) - 0.5 * dt * bend
        gap, speed = gap + begin * (speed + 0.5 * begin * bend), speed + begin * bend
        root = speed * speed - 2.0 * bend * gap
        if root > 0.0 and (speed < 0.0 or bend < 0.0):
            root = np.sqrt(root)
            later = -(speed + root) / bend if speed >= 0.0 else max(2.0 * gap / (root - speed), 0.0)
            speed += bend * later
    enough = speed < -contact[c, 13] - ROUNDING * np.sqrt(dot(v, v))
    return begin + later if enough and begin + later <= dt else np.inf


@inlined
def _bounce(c, pair, contact, state, now, time, dt):
    """Let the bodies of a contact bounce at a time, with friction; returns the normal."""
    a, b, of_two = pair[c, 0], pair[c, 1], contact[c, 12] == PAIR
    branch, v, forced = _relative(c, pair, contact, state, now)
    n = contact[c, 3], contact[c, 4], contact[c, 5]
    r, s = state[a, 12], 0.0
    give, turn = 1.0 / state[a, 13], r * r / state[a, 14]
    if of_two:
        branch, s = plus(branch, time, v), state[b, 12]
        far = np.sqrt(dot(branch, branch))
        n = branch[0] / far, branch[1] / far, branch[2] / far
        give, turn = give + 1.0 / state[b, 13], turn + s * s / state[b, 14]
    v = plus(v, time / dt - 0.5, forced)
    v = plus(v, -r, cross((now[a, 6], now[a, 7], now[a, 8]), n))
    if of_two:
        v = plus(v, -s, cross((now[b, 6], now[b, 7], now[b, 8]), n))
    speed = dot(v, n)
    slide, push = plus(v, -speed, n), -(1.0 + contact[c, 10]) * speed / give
    slides = max(np.sqrt(dot(slide, slide)), 1e-300)
    rub = min(slides / (give + turn), contact[c, 11] * push) / slides
    impulse = push * n[0] - rub * slide[0], push * n[1] - rub * slide[1], push * n[2] - rub * slide[2]
    spin = cross(n, impulse)
    for side in range(2 if of_two else 1):
        body, sign = pair[c, side], -1.0 if side == 0 else 1.0
        for k in range(3):
            change = sign * impulse[k] / state[body, 13]
            now[body, k] -= time * change
            now[body, 3 + k] += change
            now[body, 6 + k] -= state[body, 12] * spin[k] / state[body, 14]
    return n


@inlined
def _acts(c, pair, contact, state, now, dt):
    """Whether a contact that is not followed closes in the step, faster than bodies at rest do; and whether its bodies
    are in impacts then, or it closes by them."""
    branch, v, _ = _relative(c, pair, contact, state, now)
    n, most, loaded = (contact[c, 3], contact[c, 4], contact[c, 5]), 0.0, 0.0
    for side in range(2):
        body, sign, size = pair[c, side], -1.0 if side == 0 else 1.0, 0.0
        for k in range(3):
            change = now[body, 3 + k] - state[body, 3 + k]
            loaded += sign * change * n[k]
            size += change * change
        most = max(most, np.sqrt(size))
    far = plus(branch, dt, v)
    closes = contact[c, 9] + dot(far, n) < 0.0
    if contact[c, 12] == PAIR:
        closes = np.sqrt(dot(far, far)) < state[pair[c, 0], 12] + state[pair[c, 1], 12]
    fast = loaded < -LOADS * most or dot(v, n) - loaded < -2.0 * contact[c, 13] - LOADS * most
    return closes and fast, closes and fast and most > 0.0
