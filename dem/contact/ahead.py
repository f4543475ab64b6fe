"""Contacts as they will be at the end of the step.

A step takes the directions of a contact as constant. With those of its start a contact of a tool bears load for half a
step too long: it acts from the start of the step in which it closes, and on to the end of that in which the grain
escapes along the curved surfaces. So forces on tools are too large by a part of first order in dt. With those of the
end, gaps and directions belong to the same instant, as in the implicit method of Euler: a contact begins and ends half
a step early, and bears load for as long as it should.

The end is foreseen with the velocities before the step. Gaps are linear in the velocities about the places foreseen, so
where velocities do not change no overlap is left at the end. The price: the energy of a body that slides freely along a
curve is kept to first order in the step only. What balances forces does not depend on that. docs/mechanics.md has what
directions of the start of lasting contacts alone would do.

Arms are another matter. The impulse J of a step acts at its start, between two velocities. Its work is that of J on
their mean at the end of the arm, whatever arm it has. With the arm r of the start, a point that rests has the velocity
-dt/2 w x (w x r) by the later spin w, and +dt/2 w x (w x r) by the one before: no work, to second order. With that of
the end (or of the middle) both have the same sign, and each step brakes a body that spins on a corner. So bodies have
the arms of the start, both to one place: angular momentum is kept. Curved surfaces lead to two places there, as they
slide along each other until the end: the place is half way between these. What the arms then miss of the way that
surfaces go along each other in the step, the term with dt/2, is foreseen and added (`Contacts.swing`): a body that
turns together with another one does not creep on it. Bodies of prescribed motion have the arms of the end, as normals:
a tool does the work that its force does at the speed of its face.

Large round bodies on a flat face that impulses move have its normal of the start, too. The normal turns with the face,
and the place goes along the face as it rolls on them: with the normal of the end, and arms along it, each step would
take energy from a plank that rocks on a log, to first order. What rests on round grains keeps that of the end, which
damps it.

What touches bodies of prescribed motion has the normal of the start as well, with the gap of the end. So the force is
along the normal at the place between two velocities, as in the method SHAKE (Ryckaert, Ciccotti, Berendsen, J. Comput.
Phys. 23, 1977), and does no work on their mean, to second order: a ball swings in a bowl, and goes over an edge,
without loss, also where bowl and edge move.

Of a sphere that comes to a body of prescribed motion the normal at the time of touch is told beside that of the end: it
bounces along that (`Contacts.touched`).

Of two spheres that impulses move the normal of the end is turned back by what both turn together, at most to that of
the start. So a pile that turns gains no angular momentum; with the normal of the end it would gain w dt times the
moment of all contact forces in a step. What they roll on each other is not taken back: the torque on a mixer would be
9 % too large.

Contacts of spheres with spheres, half spaces and boxes are found where the bodies are, and then turned. Of other pairs
the first, the guest, is put where it will be at the end as seen from the second, the host, which stays; what is found
there then goes with the host (`seen_from`, `turn_ahead`).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from dem.arrays import Bools, Floats, Ints
from dem.bodies import BOX, CAPSULE, CLUMP, CONVEX, MESH, PLANE, POLYHEDRON, SPHERE
from dem.compiled import inlined, loop
from dem.contact.spheres import frame_of, to_box
from dem.geometry.vectors import cross, dot, plus, shares, turned

#: Radii (half thicknesses) by which a body is moved ahead along another one, at most: its impulses may stop it sooner.
#: How far a surface rolls, and how far what touches a flat body bends away from it, go on to the end of the step.
FURTHEST = 0.25

#: Half thicknesses of a guest by which a linear gap may overlap before the overlap at the start is looked up.
DEEP = 0.005

#: Half thicknesses of a guest within which a contact of the end is one of the start: it goes FURTHEST, on a hollow
#: surface the contact further.
NEAREST = 0.5

#: Half thicknesses of a guest up to which a contact touches: one that comes to an edge would be held by that.
CLOSE = 5e-5

TRIES, TOUCHES = 20, 1e-9  #: of a time of touch, and the gap there in radii
SAME = 1.0 - 1e-12  #: the cosine between normals from which on they are the same

LEAST_COSINE = 0.9  #: of the angle by which the normal of a contact may turn until the end

#: Of spheres, boxes, -, capsules, half spaces, meshes, polyhedra, other convex bodies: of a pair the one of lower rank
#: is the guest.
RANK = np.array([0, 3, 9, 1, 5, 6, 4, 2])

Vector = tuple[float, float, float]
Forms = tuple[Ints, Ints, Floats, Floats]  #: kind, row, size, radius of `dem.contact.primitives.Primitives`
Poses = tuple[Floats, Floats]  #: their centres and quaternions


class Course(NamedTuple):
    """The bodies in the rows of `Primitives.row`, and how they go on in a step."""

    place: Floats  #: (rows, 3) [m]
    velocity: Floats  #: (rows, 6) [m/s, rad/s]
    moves: Bools  #: (rows,) which of them impulses move
    dt: float  #: [s]


Moving = tuple[Floats, Floats, Bools, float]  #: a `Course`
Paired = tuple[Ints, Ints, Ints, Floats]  #: of pairs rows of shapes (m,), of contacts the pair (nc,), the reach (m,)
Touched = tuple[Floats, Floats, Floats]  #: a `Touch`
Touching = tuple[Floats, Floats, Floats, Floats]  #: a `Touch`, and what `dem.contact.primitives.at_start` gives


@inlined
def guest_is_second(one, two):
    """Whether of a pair of kinds the second is the guest."""
    first = RANK[CLUMP + 1 if one >= CONVEX else min(one, CLUMP)]
    return first > RANK[CLUMP + 1 if two >= CONVEX else min(two, CLUMP)]


@loop
def seen_from(
    forms: Forms, poses: Poses, inner: Floats, course: Moving, i: Ints, j: Ints
) -> tuple[Floats, Floats, Floats]:
    """Centres (m, 3) and quaternions (m, 4) of guests, the rows i (m,) of the shapes, at the end of a step, as seen
    from the bodies of their hosts, the rows j (m,), put back to where these are now; and how far the surfaces of the
    two go along each other until then (m,), at most. `inner` is that of `dem.contact.polyhedra.Hulls`."""
    (place, velocity, _, _), (center, quaternion), row = course, poses, forms[1]
    middle, turn, travel = np.empty((len(i), 3)), np.empty((len(i), 4)), np.empty(len(i))
    for p in range(len(i)):
        a, b = i[p], j[p]
        A, B = row[a], row[b]
        h, speed = ahead_by(a, b, forms, poses, inner, course)
        u, w, travel[p] = vector_of(velocity[A], 3), vector_of(velocity[B], 3), h * speed
        far = plus(vector_of(place[A], 0), h, vector_of(velocity[A], 0))
        far = plus(far, 1.0, after_turn(plus(center[a], -1.0, place[A]), u, h))
        far = after_turn(plus(plus(far, -h, vector_of(velocity[B], 0)), -1.0, place[B]), w, -h)
        q = spun(spun(quaternion[a], u, h), w, -h)
        for k in range(3):
            middle[p, k] = place[B, k] + far[k]
        for k in range(4):
            turn[p, k] = q[k]
    return middle, turn, travel


@loop
def turn_ahead(
    forms: Forms, poses: Poses, inner: Floats, course: Moving, pairs: Paired, touch: Touching, arcs: Floats
) -> tuple[Floats, Floats, Floats, Floats, Ints, int]:
    """Give contacts (nc,) of the pairs of rows i, j (m,) of the shapes the normals of the end of a step and the places
    of its start, of bodies of prescribed motion those of its end: `point` is as seen from the present place of body i.
    Returns (nc, 3) from body j to where it is relative to i for that [m]; by how much (nc, 3) the mean velocities of
    surfaces along each other, of j relative to i, differ from those with these arms [m/s]; the gaps (nc,) from which
    gaps that are linear in the velocities lead to those of the end [m]; and `touched` (nc, 4). Contacts of guests in
    the places of `seen_from` get these gaps as their `gap`; returns also which of them overlap by more than DEEP so,
    and how many contacts have a gap that is wider than the reach of their pair.

    Where an open sphere closes with a body of prescribed motion, `touched` are its normal at the time of touch, and
    that time after the start [s]; zeros where that normal is the one of the end, or none is known. It has no row if
    all are zeros.

    `arcs` (nc, 4, 3) are as of `dem.contact.convex.arcs_of`; empty without such shapes."""
    (kind, row, size, _), (center, quaternion), (place, _, _, dt) = forms, poses, course
    (i, j, pair, reach), (point, normal, gap, before) = pairs, touch
    moved, swing, linear = np.zeros((len(pair), 3)), np.zeros((len(pair), 3)), gap.copy()
    touched, comes = np.zeros((len(pair), 4)), False
    deep, found, wide = np.empty(len(pair), np.int64), 0, 0
    for c in range(len(pair)):
        one, two = i[pair[c]], j[pair[c]]
        swap = guest_is_second(kind[one], kind[two])
        a, b, sign = (two, one, -1.0) if swap else (one, two, 1.0)
        A, B = row[a], row[b]
        guest, host = _side(a, forms, poses, course), _side(b, forms, poses, course)
        apart = plus(place[A], -1.0, place[B])
        h, _ = ahead_by(a, b, forms, poses, inner, course)

        # The end: its normal and gap, and the arms there.
        here = guest.kind == SPHERE and host.kind in (SPHERE, PLANE, BOX)  # found where the bodies are
        as_found = sign * normal[c, 0], sign * normal[c, 1], sign * normal[c, 2]
        if here:
            between = plus(center[a], -1.0, center[b])
            n, end, arm, other = _turned_to_end(guest, host, between, h, quaternion[b], size[b])
        else:
            n, end, arm, other = _found_at_end(guest, host, apart, h, as_found, plus(point[c], -1.0, place[B]), gap[c])
        if h == 0.0 or dot(n, n) == 0.0:
            continue

        # What rolls, and which contacts keep the normal of the start.
        given, start = not (guest.moves and host.moves), of_start(before, c, sign)
        if here and given and gap[c] <= CLOSE * guest.radius:
            start = as_found
        if here and host.kind == SPHERE and not given:
            start = _less_common(as_found, n, guest, host, h)
        lasts = dot(start, start) > 0.0
        start = start if lasts else n
        arc, first_arc = _arcs(guest, 1.0, n, start, arcs, c, 0)
        bow, first_bow = _arcs(host, -1.0, n, start, arcs, c, 2)
        flat = dot(bow, bow) == 0.0
        lasts &= given or (flat and dot(arc, arc) > 0.0) or (guest.kind == SPHERE and host.kind == SPHERE)
        n = start if lasts else n

        # The arms of the start, of two bodies that impulses move to one place; of two spheres they go along the normal.
        core = guest.center if here else after_turn(plus(arm, -1.0, arc), guest.spin, -h)
        seat = host.center if host.kind == SPHERE else after_turn(plus(other, -1.0, bow), host.spin, -h)
        early, there = guest.moves or lasts, arm
        if early:
            arm = plus(core, 1.0, first_arc)
            seat = plus(arm, 1.0, apart) if flat else seat
        if host.moves:
            other = plus(seat, 1.0, first_bow)
        one_place = not given and (host.kind != SPHERE or dot(core, core) + dot(host.center, host.center) > 0.0)
        if one_place and not flat:  # else impulses on two bodies had a torque on both together
            across = plus(plus(other, -1.0, arm), -1.0, apart)
            arm, other = plus(arm, 0.5, across), plus(other, -0.5, across)
        linear[c] = end - h * dot(n, plus(_velocity_at(host, other), -1.0, _velocity_at(guest, arm)))
        if h < dt and guest.moves and given and flat and not here:
            bent = dot(n, plus(plus(there, -1.0, arm), -h, cross(guest.spin, arm)))
            if linear[c] + bent < DEEP * _thickness(guest.kind, size[a], inner):  # it touches at the start
                linear[c] -= ((dt / h) ** 2 - 1.0) * bent
        if early and flat:
            seat = plus(seat, linear[c], n)
            other = seat if host.moves else other

        if guest.kind == SPHERE and given and not lasts:
            if here:
                time, at_touch = _touch(guest, host, between, as_found, gap[c], dt, quaternion[b], size[b])
            else:
                time, at_touch = _touch_between(guest, host, before, c, sign, (as_found, end), h)
            if time < dt and dot(at_touch, n) < SAME:
                for k in range(3):
                    touched[c, k] = sign * at_touch[k]
                touched[c, 3], comes = time, True

        own, their = Arms(core, arm, arc, first_arc), Arms(seat, other, bow, first_bow)
        more = _swing((guest, own), (host, their), n, early, h, dt)

        half = 0.0 if one_place and not flat else 0.5 * min(gap[c] if here else linear[c], 0.0)
        arm, other = plus(arm, half, n), plus(other, -half, n)
        if one_place:
            other = plus(arm, 1.0, apart)
        if not here:
            gap[c], deep[found] = linear[c], c
            found += linear[c] < -DEEP * _thickness(guest.kind, size[a], inner)
        at, to, of_i, of_j = (B, A, other, arm) if swap else (A, B, arm, other)
        for k in range(3):
            normal[c, k] = sign * n[k]
            point[c, k] = place[at, k] + of_i[k]
            moved[c, k] = point[c, k] - of_j[k] - place[to, k]
            swing[c, k] = sign * more[k]
    for c in range(len(pair)):
        wide += gap[c] > reach[pair[c]]
    return moved, swing, linear, touched[: len(pair) if comes else 0], deep[:found], wide


class Side(NamedTuple):
    """A shape of a pair, guest or host, in a compiled loop, and how its body goes on."""

    kind: int
    radius: float  #: of a sphere or capsule, whose surface turns with the normal and not with the body; else 0 [m]
    center: Vector  #: from the place of the body to that of the shape, at the start [m]
    velocity: Vector  #: of the body [m/s]
    spin: Vector  #: [rad/s]
    moves: bool  #: by impulses


class Arms(NamedTuple):
    """Ways from the place of a body of a contact [m]."""

    core: Vector  #: at the start, to what turns with the body: the axis of a capsule, a point of a flat face
    arm: Vector  #: to where impulses act
    arc: Vector  #: from the core on to the surface, at the end
    first: Vector  #: the same at the start


@inlined
def _side(s, forms, poses, course):
    (kind, row, size, _), (center, _), (place, velocity, moves, _) = forms, poses, course
    S = row[s]
    radius = size[s, 0] if kind[s] in (SPHERE, CAPSULE) else 0.0
    lever = plus(center[s], -1.0, place[S])
    return Side(kind[s], radius, lever, vector_of(velocity[S], 0), vector_of(velocity[S], 3), moves[S])


@inlined
def _turned_to_end(guest, host, between, h, quaternion, size):
    """Of a sphere that was found where the bodies are, `between` from its host: normal, gap and arms of the end."""
    ahead, beside = after_turn(guest.center, guest.spin, h), after_turn(host.center, host.spin, h)
    way = plus(plus(plus(between, h, guest.velocity), -h, host.velocity), -1.0, beside)
    way = plus(plus(way, 1.0, plus(ahead, -1.0, guest.center)), 1.0, host.center)
    n, gap = _from_host(way, host.kind, quaternion, size, guest.radius, host.spin, h)
    other = plus(plus(host.center if host.kind == SPHERE else beside, 1.0, way), guest.radius + gap, n)
    return n, gap, plus(guest.center, guest.radius, n), other


@inlined
def _touch(guest, host, between, normal, gap, dt, quaternion, size):
    """When a sphere touches its host that has this normal and gap at the start, and with which normal; dt if it does
    not within the step, or goes further than its radius. Gaps are convex in time or nearly so: by false position."""
    begin, end, before = 0.0, dt, gap
    drift = plus(_velocity_at(guest, guest.center), -1.0, host.velocity)
    _, after, _, _ = _turned_to_end(guest, host, between, dt, quaternion, size)
    if before <= 0.0 or after >= 0.0 or dt * dt * dot(drift, drift) > guest.radius * guest.radius:
        return dt, normal
    time, n = dt, normal
    for _ in range(TRIES):
        time = begin + (end - begin) * before / (before - after)
        n, now, _, _ = _turned_to_end(guest, host, between, time, quaternion, size)
        if abs(now) <= TOUCHES * guest.radius:
            break
        if now < 0.0:
            end, after = time, now
        else:
            begin, before = time, now
    return time, n


@inlined
def _touch_between(guest, host, before, c, sign, last, h):
    """The same of a sphere whose normal and gap at the start are those of `nearest_at_start`, and the `last` ones, with
    the host put back, those of the end after h; infinite where it does not touch. The centre of the curve of the host
    goes straight as seen from the sphere."""
    if not len(before) or dot(before[c], before[c]) == 0.0:
        return np.inf, last[0]
    far, gap = guest.radius + before[c, 4], before[c, 3]
    start = plus(_ZERO, sign * (far + gap), before[c])
    way = plus(plus(_ZERO, far + last[1], last[0]), -1.0, start)
    closing, square, left = dot(start, way), dot(way, way), gap * (2.0 * far + gap)
    root = closing * closing - square * left
    if closing >= 0.0 or root <= 0.0:
        return np.inf, last[0]
    share = left / (np.sqrt(root) - closing)
    n = plus(start, share, way)
    return share * h, after_turn(plus(_ZERO, 1.0 / np.sqrt(dot(n, n)), n), host.spin, share * h)


@inlined
def _found_at_end(guest, host, apart, h, normal, spot, gap):
    """The same of a guest that was found where `seen_from` puts it, at a `spot` of its host: they turn with this."""
    n, middle = after_turn(normal, host.spin, h), after_turn(spot, host.spin, h)
    arm = plus(plus(middle, -0.5 * gap, n), -1.0, apart)
    return n, gap, plus(arm, h, plus(host.velocity, -1.0, guest.velocity)), plus(middle, 0.5 * gap, n)


@inlined
def _arcs(side, out, end, start, arcs, c, column):
    """From what turns with a body to its surface, where the normal that goes `out` of it is that of the end, or of the
    start."""
    if side.kind >= CONVEX:
        return vector_of(arcs[c, column], 0), vector_of(arcs[c, column + 1], 0)
    r = out * side.radius
    return (r * end[0], r * end[1], r * end[2]), (r * start[0], r * start[1], r * start[2])


@inlined
def _velocity_at(side, arm):
    return plus(side.velocity, 1.0, cross(side.spin, arm))


@inlined
def _swing(one, two, normal, early, h, dt):
    """By how much the mean velocities of surfaces along each other, of host relative to guest, differ from those with
    their arms; `early`: those of the guest are of the start. Each of them is a `Side` with its `Arms`."""
    (guest, own), (host, their) = one, two
    u, w = guest.spin, host.spin
    more = plus(_bend(their.core, w, dt), -1.0, _bend(own.core, u, dt))
    if dot(their.arc, their.arc) == 0.0 and dot(w, normal) != 0.0:  # the contact goes along a face that spins
        about = plus(_ZERO, dot(w, normal), normal)
        more = plus(more, 0.5 * dt if early else 0.5 * dt - h, cross(about, _slide(one, two, h, dt)))
    if host.kind != SPHERE or host.moves:
        more = plus(more, 1.0, cross(w, plus(plus(their.core, 1.0, their.first), -1.0, their.arm)))
    more = plus(more, -1.0, cross(u, plus(plus(own.core, 1.0, own.first), -1.0, own.arm)))
    if guest.kind >= CONVEX:
        more = plus(more, -0.5, cross(u, _rolled(own, dt / h)))
    if host.kind >= CONVEX:
        more = plus(more, 0.5, cross(w, _rolled(their, dt / h)))
    return plus(more, -dot(more, normal), normal)


@inlined
def _rolled(arms, times):
    """How far the end of an arc goes in a step, which is so many times as long as what is foreseen of it: at most as
    far as the arc is long, unless it is foreseen to go further."""
    way = plus(arms.arc, -1.0, arms.first)
    far = times * np.sqrt(dot(way, way))
    most = np.sqrt(dot(arms.arc, arms.arc))
    return plus(_ZERO, times if far <= most else max(times * most / far, 1.0), way)


@inlined
def _slide(one, two, h, dt):
    """The velocity of the contact on the host, as in the middle of the last step, whose velocities bodies have."""
    (guest, own), (host, their) = one, two
    speed = plus(_before(guest, dt), 1.0, cross(guest.spin, after_turn(own.core, guest.spin, -0.5 * dt)))
    speed = plus(speed, 1.0 / h, plus(own.arc, -1.0, own.first))
    speed = plus(speed, -1.0, _before(host, dt))
    return plus(speed, -1.0, cross(host.spin, after_turn(their.core, host.spin, -0.5 * dt)))


@inlined
def _less_common(start, end, guest, host, h):
    """The normal of the end of two spheres, turned back towards that of the start by what both turn together."""
    turn = cross(start, end)
    sine = np.sqrt(dot(turn, turn))
    together = h * min(dot(guest.spin, turn), dot(host.spin, turn))
    if not together > 0.0:
        return end
    n = plus(end, min(together / sine**2, 1.0), plus(start, -1.0, end))
    return plus(_ZERO, 1.0 / np.sqrt(dot(n, n)), n)


@inlined
def _before(side, dt):
    """The velocity of a body in the last step: of one of prescribed motion as it turns with its spin."""
    return side.velocity if side.moves else after_turn(side.velocity, side.spin, -dt)


@inlined
def of_start(before, c, sign):
    """The normal of the start that the contact c keeps, sign times it, as of `nearest_at_start`; zero where it does
    not, or none does."""
    if not len(before) or before[c, 3] > 0.0:
        return 0.0, 0.0, 0.0
    return sign * before[c, 0], sign * before[c, 1], sign * before[c, 2]


@loop
def nearest_at_start(
    forms: Forms, inner: Floats, guest: Ints, sign: Floats, pair: Ints, touch: Touched, now_pair: Ints, now: Touched
) -> Floats:
    """Return for contacts (k,) of guests in these rows what (k, 5) they are now: normal, gap, zero if they touch, and
    the radius by which the host is curved there. Taken is of the contacts now (l,) of the same pair, at most NEAREST
    half thicknesses of the guest away, that of nearly the same direction, before others one that touches; zeros where
    there is none. `sign` (k,) is 1 where normals point from guest to host, else -1."""
    (kind, _, size, _), (point, normal, gap), (now_point, now_normal, now_gap) = forms, touch, now
    out, last, before = np.zeros((len(pair), 5)), np.full(pair.max() + 1, -1), np.empty(len(now_pair), np.int64)
    for n in range(len(now_pair)):
        before[n], last[now_pair[n]] = last[now_pair[n]], n
    for c in range(len(pair)):
        thick, best, touches, n = _thickness(kind[guest[c]], size[guest[c]], inner), LEAST_COSINE, False, last[pair[c]]
        while n >= 0:
            square, cosine, close = 0.0, 0.0, now_gap[n] <= CLOSE * thick
            for k in range(3):
                square += (now_point[n, k] - point[c, k]) ** 2
                cosine += now_normal[n, k] * normal[c, k]
            better = cosine > best if close == touches else close and cosine > LEAST_COSINE
            if better and square < (NEAREST * thick) ** 2:
                best, touches = cosine, close
                bend, along = 0.0, 0.0
                for k in range(3):
                    out[c, k], turn = now_normal[n, k], now_normal[n, k] - normal[c, k]
                    way = 0.5 * sign[c] * (gap[c] * normal[c, k] - now_gap[n] * now_normal[n, k])
                    along += sign[c] * turn * (point[c, k] - now_point[n, k] + way)
                    bend += turn * turn
                out[c, 3] = 0.0 if close else now_gap[n]
                out[c, 4] = max(along / bend, 0.0) if bend > 2.0 * (1.0 - SAME) else 0.0
            n = before[n]
    return out


@inlined
def _from_host(end, kind, quaternion, size, radius, spin, time):
    """The normal from a sphere to its host, and the gap, where its centre is at `end` from that of the host, which has
    turned for a time. Concentric spheres have no normal."""
    if kind == SPHERE:
        distance = np.sqrt(dot(end, end))
        per, gap = (-1.0 / distance if distance > 0.0 else 0.0), distance - radius - size[0]
        x, y, z = per * end[0], per * end[1], per * end[2]
    elif kind == PLANE:
        x, y, z = after_turn((-size[0], -size[1], -size[2]), spin, time)
        gap = -(x * end[0] + y * end[1] + z * end[2]) - radius
    else:
        local = after_turn(end, spin, -time)
        x, y, z, gap = to_box(local[0], local[1], local[2], radius, frame_of(quaternion), size)
        x, y, z = after_turn((x, y, z), spin, time)
    return (x, y, z), gap


@inlined
def ahead_by(a, b, forms, poses, inner, course):
    """The time by which a pair of a guest a and a host b is foreseen: dt, or less where the surface of the one goes
    further along the other than FURTHEST allows; and the speed at which it goes."""
    (kind, row, size, radius), (center, quaternion) = forms, poses
    place, velocity, _, dt = course
    least, other = _thickness(kind[a], size[a], inner), _thickness(kind[b], size[b], inner)
    if other < np.inf and kind[a] in (SPHERE, CAPSULE) and kind[b] not in (SPHERE, CAPSULE):
        other = radius[b]  # a plate may be thinner than the way: centre or core do not get into it
    least = min(least, other)
    if least == np.inf:
        return 0.0, 0.0
    A, B = row[a], row[b]
    u, w = vector_of(velocity[A], 3), vector_of(velocity[B], 3)
    drift = plus(vector_of(velocity[A], 0), 1.0, cross(u, plus(center[a], -1.0, place[A])))
    drift = plus(drift, -1.0, vector_of(velocity[B], 0))
    seat = center[b] if kind[b] in (SPHERE, CAPSULE) else center[a]  # the spin of a sphere moves no surface
    drift = plus(drift, -1.0, cross(w, plus(seat, -1.0, place[B])))
    if kind[b] == CAPSULE:
        drift = plus(drift, -1.0, cross(_across(w, quaternion[b]), plus(center[a], -1.0, center[b])))
    speed = np.sqrt(dot(drift, drift))
    if kind[a] != SPHERE:
        spin = plus(u, -1.0, w)
        if kind[a] == CAPSULE:
            spin = _across(spin, quaternion[a])
        speed += radius[a] * np.sqrt(dot(spin, spin))
    return (dt if speed * dt <= FURTHEST * least else FURTHEST * least / speed), speed


@inlined
def _across(spin, q):
    """The part of an angular velocity that moves the surface of a capsule: not that about its axis."""
    w, x, y, z = q[0], q[1], q[2], q[3]
    axis = 2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)
    return plus(spin, -dot(axis, spin), axis)


@inlined
def _thickness(kind, size, inner):
    """Half of it, at the thinnest place; of half spaces and meshes it is infinite."""
    if kind in (PLANE, MESH):
        thick = np.inf
    elif kind == BOX:
        thick = min(size[0], size[1], size[2])
    elif kind in (SPHERE, CAPSULE):
        thick = size[0]
    elif kind >= CONVEX:
        thick = size[2]
    else:
        thick = size[0] * inner[kind - POLYHEDRON + 1]
    return thick


@inlined
def vector_of(row, start):
    return row[start], row[start + 1], row[start + 2]


@inlined
def after_turn(v, spin, time):
    """The vector v after `time` of turning with the angular velocity `spin`."""
    if dot(v, v) == 0.0:
        return v[0], v[1], v[2]
    rotation = time * spin[0], time * spin[1], time * spin[2]
    sine, versed = shares(rotation)
    return turned(v, rotation, sine, versed)


_ZERO = (0.0, 0.0, 0.0)


@inlined
def _bend(arm, spin, dt):
    """By how much the mean velocity of the end of an arm that turns for dt differs from that at the start."""
    if dot(spin, spin) == 0.0 or dot(arm, arm) == 0.0:
        return 0.0, 0.0, 0.0
    return plus(plus(_ZERO, 1.0 / dt, plus(after_turn(arm, spin, dt), -1.0, arm)), -1.0, cross(spin, arm))


@inlined
def spun(q, spin, time):
    """The quaternion q after `time` of turning with the angular velocity `spin`."""
    half = 0.5 * time * spin[0], 0.5 * time * spin[1], 0.5 * time * spin[2]
    sine, _ = shares(half)
    x, y, z, c = sine * half[0], sine * half[1], sine * half[2], np.cos(np.sqrt(dot(half, half)))
    return (
        c * q[0] - x * q[1] - y * q[2] - z * q[3],
        c * q[1] + x * q[0] + y * q[3] - z * q[2],
        c * q[2] + y * q[0] + z * q[1] - x * q[3],
        c * q[3] + z * q[0] + x * q[2] - y * q[1],
    )  # fmt: skip
