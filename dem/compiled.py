"""Loops over contacts, pairs and bodies, compiled by numba at their first call.

Each gives the same as the numpy code beside its caller, in one pass over memory. Import it by `dem.loops.loops`. Arrays
are C-contiguous, of float64 and int64.
"""

from __future__ import annotations

import numpy as np
from numba import njit

#: Fused multiply-adds are allowed; what else numba calls fast assumes that there are no NaNs. A division by zero gives
#: inf or nan, as in numpy.
compiled = njit(cache=True, fastmath={"contract"}, error_model="numpy")

#: For a loop that another one calls: fused differently in the first process, it would have other bits there
#: (`pctt.compiled.unfused`).
unfused = njit(cache=True, error_model="numpy")


# -- the contact map ---------------------------------------------------------------------------------------------


@compiled
def contact_frames(normal):
    """`dem.system.contact_frames`."""
    frame = np.empty((len(normal), 3, 3))
    for c in range(len(normal)):
        x, y, z = normal[c, 0], normal[c, 1], normal[c, 2]
        sign = np.copysign(1.0, z)
        p = -1.0 / (sign + z)
        q = x * y * p
        frame[c, 0, 0], frame[c, 0, 1], frame[c, 0, 2] = x, y, z
        frame[c, 1, 0], frame[c, 1, 1], frame[c, 1, 2] = 1.0 + sign * x * x * p, sign * q, -sign * x
        frame[c, 2, 0], frame[c, 2, 1], frame[c, 2, 2] = q, sign + y * y * p, -y
    return frame


@compiled
def contact_arms(point, position, row):
    """`dem.system.contact_arms`."""
    arm = np.empty((len(point), 6))
    for c in range(len(point)):
        a, b = row[c, 0], row[c, 1]
        for k in range(3):
            arm[c, k], arm[c, 3 + k] = point[c, k] - position[a, k], point[c, k] - position[b, k]
    return arm


@compiled
def relative_velocity(frame, arm, row, velocity):
    """`dem.system.relative_velocity`."""
    out = np.empty((len(frame), 3))
    for c in range(len(frame)):
        v, w, r = velocity[row[c, 0]], velocity[row[c, 1]], arm[c]
        x = w[0] + w[4] * r[5] - w[5] * r[4] - (v[0] + v[4] * r[2] - v[5] * r[1])
        y = w[1] + w[5] * r[3] - w[3] * r[5] - (v[1] + v[5] * r[0] - v[3] * r[2])
        z = w[2] + w[3] * r[4] - w[4] * r[3] - (v[2] + v[3] * r[1] - v[4] * r[0])
        for k in range(3):
            out[c, k] = frame[c, k, 0] * x + frame[c, k, 1] * y + frame[c, k, 2] * z
    return out


@compiled
def sum_of_impulses(frame, arm, row, impulse, count):
    """`dem.system.sum_of_impulses`."""
    out = np.zeros((count, 6))
    for c in range(len(frame)):
        n, s, t = impulse[c, 0], impulse[c, 1], impulse[c, 2]
        x = n * frame[c, 0, 0] + s * frame[c, 1, 0] + t * frame[c, 2, 0]
        y = n * frame[c, 0, 1] + s * frame[c, 1, 1] + t * frame[c, 2, 1]
        z = n * frame[c, 0, 2] + s * frame[c, 1, 2] + t * frame[c, 2, 2]
        a, b, r = out[row[c, 0]], out[row[c, 1]], arm[c]
        a[0] -= x
        a[1] -= y
        a[2] -= z
        a[3] -= r[1] * z - r[2] * y
        a[4] -= r[2] * x - r[0] * z
        a[5] -= r[0] * y - r[1] * x
        b[0] += x
        b[1] += y
        b[2] += z
        b[3] += r[4] * z - r[5] * y
        b[4] += r[5] * x - r[3] * z
        b[5] += r[3] * y - r[4] * x
    return out


@compiled
def in_the_world(impulse, frame):
    """`dem.impulses.in_the_world`."""
    out = np.empty((len(frame), 4))
    for c in range(len(frame)):
        out[c, 0] = impulse[c, 0]
        for k in range(3):
            out[c, 1 + k] = impulse[c, 1] * frame[c, 1, k] + impulse[c, 2] * frame[c, 2, k]
    return out


@compiled
def in_frames(stored, frame):
    """`dem.impulses.in_frames`."""
    out = np.empty((len(frame), 3))
    for c in range(len(frame)):
        out[c, 0] = stored[c, 0]
        for i in range(1, 3):
            out[c, i] = stored[c, 1] * frame[c, i, 0] + stored[c, 2] * frame[c, i, 1] + stored[c, 3] * frame[c, i, 2]
    return out


# -- the search --------------------------------------------------------------------------------------------------


@unfused
def pairs_in_cells(center, radius, first, second, alike):
    """Pairs (m, 2), the lower row first, of a sphere of the rows `first` and one of the rows `second` that touch, to
    rounding.

    first, second: the same rows if `alike`, else without common ones. Those of `second` are sorted into cubic cells, so
    wide that a pair is at most one cell apart. Cells share a cube of buckets, so that a sphere far away costs nothing;
    four buckets a side are enough to tell neighbours apart.
    """
    largest = 0.0
    for row in second:
        largest = max(largest, radius[row])
    width = largest
    for row in first:
        width = max(width, (radius[row] + largest) * (1.0 + 1e-6))
    per = 1.0 / width
    side = 4
    while side * side * side < len(second):
        side *= 2
    last = side - 1
    bucket, start = np.empty(len(second), np.int64), np.zeros(side * side * side + 1, np.int64)
    for k in range(len(second)):
        x, y, z = center[second[k], 0] * per, center[second[k], 1] * per, center[second[k], 2] * per
        bucket[k] = ((int(np.floor(x)) & last) * side + (int(np.floor(y)) & last)) * side + (int(np.floor(z)) & last)
        start[bucket[k] + 1] += 1
    for k in range(len(start) - 1):
        start[k + 1] += start[k]
    member, place, free = np.empty(len(second), np.int64), np.empty((len(second), 4)), start[:-1].copy()
    for k in range(len(second)):
        to = free[bucket[k]]
        free[bucket[k]] += 1
        member[to], place[to, 3] = second[k], radius[second[k]]
        place[to, 0], place[to, 1], place[to, 2] = center[second[k], 0], center[second[k], 1], center[second[k], 2]

    # Alike, the rows are taken in the order of their cells, each with those behind it: every pair comes once.
    rows = member if alike else first
    pairs, found, done = np.empty((8 * len(first) + 8, 2), np.int64), 0, 0
    while True:
        done, found = _pairs_of_rows(
            center, radius, rows, done, alike, largest, per, side, start, place, member, pairs, found
        )
        if done == len(rows):
            return pairs[:found].copy()
        pairs = np.concatenate((pairs, np.empty((max(len(pairs), len(second)), 2), np.int64)))


@unfused
def _pairs_of_rows(center, radius, rows, done, alike, largest, per, side, start, place, member, pairs, found):
    """Add to the first pairs those of the rows that are not done, as long as there is room; new numbers of rows done
    and pairs found. A loop that makes the room itself takes twice the time."""
    last = side - 1
    for n in range(done, len(rows)):
        i, behind, before = rows[n], n + 1 if alike else 0, found
        a, b, c, r = center[i, 0], center[i, 1], center[i, 2], radius[i]
        out = (r + largest) * (1.0 + 1e-9)
        bottom, top = int(np.floor((c - out) * per)), int(np.floor((c + out) * per))
        for x in range(int(np.floor((a - out) * per)), int(np.floor((a + out) * per)) + 1):
            for y in range(int(np.floor((b - out) * per)), int(np.floor((b + out) * per)) + 1):
                column, z = ((x & last) * side + (y & last)) * side, bottom
                while z <= top:  # cells whose buckets follow each other at once
                    until = min(z | last, top)
                    begin, end = max(start[column + (z & last)], behind), start[column + (until & last) + 1]
                    z = until + 1
                    if found + end - begin > len(pairs):
                        return n, before
                    for k in range(begin, end):
                        u, v, w = place[k, 0] - a, place[k, 1] - b, place[k, 2] - c
                        most = (r + place[k, 3]) * (1.0 + 1e-12)
                        if u * u + v * v + w * w <= most * most:
                            pairs[found, 0], pairs[found, 1] = min(i, member[k]), max(i, member[k])
                            found += 1
    return len(rows), found


@compiled
def sphere_sphere(center, size, i, j, delta):
    """`dem.contact.narrow.sphere_sphere` of the pairs of rows i, j (m,) of which the gap is at most `delta` (m,): their
    numbers, points, normals and gaps."""
    pair = np.empty(len(i), np.int64)
    point, normal, gap = np.empty((len(i), 3)), np.empty((len(i), 3)), np.empty(len(i))
    found = 0
    for k in range(len(i)):
        p, q = center[i[k]], center[j[k]]
        radius = size[i[k], 0]
        x, y, z = q[0] - p[0], q[1] - p[1], q[2] - p[2]
        distance = np.sqrt(x * x + y * y + z * z)
        apart = distance - radius - size[j[k], 0]
        if apart <= delta[k]:
            if distance > 0.0:
                x, y, z = x / distance, y / distance, z / distance
            else:
                z = 1.0
            middle = radius + 0.5 * apart
            pair[found], gap[found] = k, apart
            normal[found, 0], normal[found, 1], normal[found, 2] = x, y, z
            point[found, 0], point[found, 1], point[found, 2] = p[0] + middle * x, p[1] + middle * y, p[2] + middle * z
            found += 1
    return pair[:found], point[:found], normal[:found], gap[:found]


@compiled
def lexsort(key, major, count):
    """`numpy.lexsort((key, major))` of distinct keys (n,), with `major` (n,) in 0 ... count - 1."""
    start = np.zeros(count + 1, np.int64)
    for k in range(len(major)):
        start[major[k] + 1] += 1
    for k in range(count):
        start[k + 1] += start[k]
    order, free = np.empty(len(major), np.int64), start[:-1].copy()
    for k in range(len(major)):
        order[free[major[k]]] = k
        free[major[k]] += 1
    for m in range(count):
        _shell_sort(order[start[m] : start[m + 1]], key)
    return order


@compiled
def _shell_sort(rows, key):
    """Sort a few rows by their keys, in place."""
    gap = 1
    while 3 * gap < len(rows):
        gap = 3 * gap + 1
    while gap > 0:
        for k in range(gap, len(rows)):
            row, place = rows[k], k
            while place >= gap and key[rows[place - gap]] > key[row]:
                rows[place] = rows[place - gap]
                place -= gap
            rows[place] = row
        gap //= 3


# -- the motion --------------------------------------------------------------------------------------------------


@compiled
def integrate(quaternion, angular_velocity, dt):
    """`dem.quaternion.integrate` of rows."""
    out = np.empty((len(quaternion), 4))
    for n in range(len(quaternion)):
        x, y, z = dt * angular_velocity[n, 0], dt * angular_velocity[n, 1], dt * angular_velocity[n, 2]
        angle = np.sqrt(x * x + y * y + z * z)
        w = np.cos(0.5 * angle)
        share = np.sin(0.5 * angle) / angle if angle > 0.0 else 0.5
        x, y, z = share * x, share * y, share * z
        a, b, c, d = quaternion[n, 0], quaternion[n, 1], quaternion[n, 2], quaternion[n, 3]
        e, f = w * a - x * b - y * c - z * d, w * b + a * x + y * d - z * c
        g, h = w * c + a * y + z * b - x * d, w * d + a * z + x * c - y * b
        size = 1.0 / np.sqrt(e * e + f * f + g * g + h * h)
        out[n, 0], out[n, 1], out[n, 2], out[n, 3] = size * e, size * f, size * g, size * h
    return out


@unfused
def free_spin(turn, spin, moments, dt, newton_steps, last_change, converged):
    """`dem.free_motion.free_spin`, body by body: each ends Newton's method by itself."""
    out = spin.copy()
    half = 0.5 * dt
    for n in range(len(spin)):
        frame, twice = (turn[n, 1], turn[n, 2], turn[n, 3]), 2.0 * turn[n, 0]
        w = _turned((spin[n, 0], spin[n, 1], spin[n, 2]), frame, -twice, 2.0)
        largest = max(moments[n, 0], moments[n, 1], moments[n, 2])
        inertia = (moments[n, 0] / largest, moments[n, 1] / largest, moments[n, 2] / largest)
        rotation = _times(half, w)
        sine, versed = _shares(rotation)
        momentum, new = _turned(_each(inertia, w), rotation, -sine, versed), w
        for _ in range(newton_steps):
            middle = _turned(_each(inertia, new), rotation, sine, versed)
            change = _solve(
                _slope((inertia[0], 0.0, 0.0), (1.0, 0.0, 0.0), rotation, sine, versed, middle, half),
                _slope((0.0, inertia[1], 0.0), (0.0, 1.0, 0.0), rotation, sine, versed, middle, half),
                _slope((0.0, 0.0, inertia[2]), (0.0, 0.0, 1.0), rotation, sine, versed, middle, half),
                _plus(momentum, _times(-1.0, middle)),
            )
            new = _plus(new, change)
            rotation = _times(half, new)
            sine, versed = _shares(rotation)
            if _dot(change, change) <= last_change**2 * _dot(w, w):
                break
        back = _turned(momentum, rotation, -sine, versed)
        error = _plus(back, _times(-1.0, _each(inertia, new)))
        if _dot(error, error) <= converged**2 * _dot(momentum, momentum):
            solved = back[0] / inertia[0], back[1] / inertia[1], back[2] / inertia[2]
            out[n, 0], out[n, 1], out[n, 2] = _turned(solved, frame, twice, 2.0)
    return out


@unfused
def _slope(along, axis, rotation, sine, versed, middle, half):
    """How the angular momentum in the middle of the step changes with the spin about an axis."""
    turned = _turned(axis, rotation, 0.5, 1.0 / 6.0)
    return _plus(_turned(along, rotation, sine, versed), _times(-half, _cross(middle, turned)))


@unfused
def _turned(v, r, sine, versed):
    """v + sine r x v + versed r x (r x v): the vector v, turned by the rotation vector r with its `_shares`, or by the
    quaternion (w, r) with 2 w and 2; with -sine the other way."""
    once = _cross(r, v)
    return _plus(v, _plus(_times(sine, once), _times(versed, _cross(r, once))))


@unfused
def _shares(rotation):
    """sin(a) / a and (1 - cos(a)) / a^2 of the angle a of a rotation vector."""
    square = _dot(rotation, rotation)
    angle = np.sqrt(square)
    return (np.sin(angle) / angle, (1.0 - np.cos(angle)) / square) if angle > 1e-8 else (1.0, 0.5)


@unfused
def _solve(a, b, c, right):
    """The solution of a matrix with columns a, b, c, by Cramer's rule."""
    across = _cross(b, c)
    scale = 1.0 / _dot(a, across)
    return _times(scale, (_dot(right, across), _dot(a, _cross(right, c)), _dot(a, _cross(b, right))))


@unfused
def _cross(a, b):
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@unfused
def _dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@unfused
def _plus(a, b):
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


@unfused
def _each(a, b):
    return a[0] * b[0], a[1] * b[1], a[2] * b[2]


@unfused
def _times(a, b):
    return a * b[0], a * b[1], a * b[2]
