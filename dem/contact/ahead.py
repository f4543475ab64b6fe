"""Contacts of spheres as they will be at the end of the step.

A step takes the directions of a contact as constant. With those of its start a contact of a tool bears load for half a
step too long: it acts from the start of the step in which it closes, and on to the end of that in which the grain
escapes along the curved surfaces. So forces on tools are too large by a part of first order in dt. With those of the
end, gaps and directions belong to the same instant, as in the implicit method of Euler: a contact begins and ends half
a step early, and bears load for as long as it should.

The end is foreseen with the velocities before the step. Gaps are linear in the velocities about the places foreseen, so
where velocities do not change no overlap is left at the end. The price: the energy of a body that slides freely along a
curve, and angular momentum about a contact, are kept to first order in the step only. What balances forces does not
depend on that.

Contacts of spheres with spheres, half spaces and boxes are turned; others keep the directions of the start, and those
that turn far are found anew by `dem.step.find_turned`.
"""

from __future__ import annotations

import numpy as np

from dem.arrays import Floats, Ints
from dem.bodies import BOX, PLANE, SPHERE
from dem.compiled import inlined, loop
from dem.contact.spheres import frame_of, to_box
from dem.vectors import cross, dot, plus, shares, turned

FURTHEST = 0.25  #: radii by which a sphere is moved ahead along another body, at most: its impulses may stop it sooner


@loop
def turn_ahead(
    kind: Ints, row: Ints, center: Floats, quaternion: Floats, size: Floats, place: Floats, velocity: Floats, i: Ints,
    j: Ints, pair: Ints, point: Floats, normal: Floats, gap: Floats, dt: float,
) -> tuple[Floats, Floats]:  # fmt: skip
    """Give contacts (nc,) of the pairs of rows i, j (m,) of `Primitives` the normals of the end of a step of dt [s]:
    `point` is then as seen from the present place of body i. Returns (nc, 3) from body j to where it is relative to i
    then, and the gaps (nc,) from which gaps that are linear in the velocities lead to those of the end [m].

    The bodies in the rows of `Primitives.row` are at `place` (rows, 3) and move with `velocity` (rows, 6).
    """
    moved, linear = np.zeros((len(pair), 3)), gap.copy()
    for c in range(len(pair)):
        one, two = i[pair[c]], j[pair[c]]
        swap = kind[one] != SPHERE
        a, b = (two, one) if swap else (one, two)
        if kind[a] != SPHERE or kind[b] not in (SPHERE, PLANE, BOX):
            continue
        A, B, radius = row[a], row[b], size[a, 0]
        V, W, u, w = _vector(velocity[A], 0), _vector(velocity[B], 0), _vector(velocity[A], 3), _vector(velocity[B], 3)
        lever, other = plus(center[a], -1.0, place[A]), plus(center[b], -1.0, place[B])
        way = plus(center[a], -1.0, center[b])
        drift = plus(plus(V, 1.0, cross(u, lever)), -1.0, plus(W, 1.0, cross(w, other)))  # of the centres
        along = drift if kind[b] == SPHERE else plus(drift, -1.0, cross(w, way))
        speed, h = np.sqrt(dot(along, along)), dt
        if speed * dt > FURTHEST * radius:
            h = FURTHEST * radius / speed
        ahead, beside = _after(lever, u, h), _after(other, w, h)
        end = plus(plus(plus(plus(way, h, V), -h, W), -1.0, beside), 1.0, plus(ahead, -1.0, lever))
        end = plus(end, 1.0, other)
        if kind[b] == SPHERE:
            distance = np.sqrt(dot(end, end))
            if distance == 0.0:
                continue
            n, after = (-end[0] / distance, -end[1] / distance, -end[2] / distance), distance - radius - size[b, 0]
        elif kind[b] == PLANE:
            m = _after(_vector(size[b], 0), w, h)
            n, after = (-m[0], -m[1], -m[2]), dot(m, end) - radius
        else:
            back = _after(end, w, -h)
            x, y, z, after = to_box(back[0], back[1], back[2], radius, frame_of(quaternion[b]), size[b])
            n = _after((x, y, z), w, h)
        half = 0.5 * gap[c]
        own = plus(ahead, radius + half, n)
        their = plus(plus(beside, 1.0, end), radius + after - half, n)
        opening = dot(n, plus(plus(W, 1.0, cross(w, their)), -1.0, plus(V, 1.0, cross(u, own))))
        linear[c] = after - h * opening
        first, second, sign = (their, own, -1.0) if swap else (own, their, 1.0)
        at, to = (place[B], place[A]) if swap else (place[A], place[B])
        for k in range(3):
            normal[c, k] = sign * n[k]
            point[c, k] = at[k] + first[k]
            moved[c, k] = point[c, k] - second[k] - to[k]
    return moved, linear


@inlined
def _vector(row, start):
    return row[start], row[start + 1], row[start + 2]


@inlined
def _after(v, spin, time):
    """The vector v after `time` of turning with the angular velocity `spin`."""
    if dot(v, v) == 0.0:
        return v[0], v[1], v[2]
    rotation = time * spin[0], time * spin[1], time * spin[2]
    sine, versed = shares(rotation)
    return turned(v, rotation, sine, versed)
