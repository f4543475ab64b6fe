"""Compiled loops over contacts that are stored as frames and arms (`CompactRows`).

``body`` (nc, 2) has local numbers of bodies. w and m (bodies, 6) are physical velocities and momenta. The loops run
over all contacts of their arrays, not between two given bounds, and the numbers of bodies are unsigned. Otherwise every
index could be negative, and the test for this costs a third of a product.

A cell whose periods grow at the rates E (3,) adds E l to the velocity of a contact, with the way l from centre to
centre, which is the difference of the arms. `rate` and `pushed` are empty where there is none.
"""

from __future__ import annotations

import numpy as np

from dem.arrays import Floats
from dem.compiled import PART, inlined, inner, loop, prange

NUMBERS = 1536  # that stay in the nearest cache, of loops that become vectors


@inner
def sum_of(x):
    """The sum (double precision) of a whole number of eights, eight sums side by side: one after the other each would
    wait for the last."""
    zero = x.dtype.type(0)
    a, b, c, d, e, f, g, h = zero, zero, zero, zero, zero, zero, zero, zero
    for k in range(0, len(x), 8):
        a, b, c, d = a + x[k], b + x[k + 1], c + x[k + 2], d + x[k + 3]
        e, f, g, h = e + x[k + 4], f + x[k + 5], g + x[k + 6], h + x[k + 7]
    return np.float64((a + e) + (b + f)) + np.float64((c + g) + (d + h))


@inlined
def velocity_at(c, arm, body, w):
    """The velocity of the second body at the contact point c, relative to the first body."""
    a, b = body[c, 0], body[c, 1]
    r0, r1, r2, s0, s1, s2 = arm[c, 0], arm[c, 1], arm[c, 2], arm[c, 3], arm[c, 4], arm[c, 5]
    u0 = w[b, 0] - w[a, 0] + w[b, 4] * s2 - w[b, 5] * s1 - (w[a, 4] * r2 - w[a, 5] * r1)
    u1 = w[b, 1] - w[a, 1] + w[b, 5] * s0 - w[b, 3] * s2 - (w[a, 5] * r0 - w[a, 3] * r2)
    u2 = w[b, 2] - w[a, 2] + w[b, 3] * s1 - w[b, 4] * s0 - (w[a, 3] * r1 - w[a, 4] * r0)
    return u0, u1, u2


@inlined
def push(c, arm, body, f0, f1, f2, m):
    """Add an impulse at the contact point c to the second body's momenta, and subtract it from the first body's."""
    a, b = body[c, 0], body[c, 1]
    r0, r1, r2, s0, s1, s2 = arm[c, 0], arm[c, 1], arm[c, 2], arm[c, 3], arm[c, 4], arm[c, 5]
    m[a, 0] -= f0
    m[a, 1] -= f1
    m[a, 2] -= f2
    m[a, 3] -= r1 * f2 - r2 * f1
    m[a, 4] -= r2 * f0 - r0 * f2
    m[a, 5] -= r0 * f1 - r1 * f0
    m[b, 0] += f0
    m[b, 1] += f1
    m[b, 2] += f2
    m[b, 3] += s1 * f2 - s2 * f1
    m[b, 4] += s2 * f0 - s0 * f2
    m[b, 5] += s0 * f1 - s1 * f0


@loop
def set_velocities(frame, arm, body, before, y, w, rate):
    """y = before + D' w (nc, 3), and what the rates (3,) of a cell add; y may be ``before``."""
    for c in prange(len(body)):
        u0, u1, u2 = velocity_at(c, arm, body, w)
        if len(rate):
            u0 += rate[0] * (arm[c, 0] - arm[c, 3])
            u1 += rate[1] * (arm[c, 1] - arm[c, 4])
            u2 += rate[2] * (arm[c, 2] - arm[c, 5])
        y[c, 0] = before[c, 0] + (frame[c, 0] * u0 + frame[c, 1] * u1 + frame[c, 2] * u2)
        y[c, 1] = before[c, 1] + (frame[c, 3] * u0 + frame[c, 4] * u1 + frame[c, 5] * u2)
        y[c, 2] = before[c, 2] + (frame[c, 6] * u0 + frame[c, 7] * u1 + frame[c, 8] * u2)


def relative_velocities(frame, arm, body, w) -> Floats:
    """D' w (nc, 3)."""
    y = np.zeros((len(body), 3))
    set_velocities(frame, arm, body, y, y, w, np.zeros(0))
    return y


@loop
def greatest_velocities(frame, arm, body, w, first) -> Floats:
    """The loop of `ContactMap.greatest_velocities`."""
    most = np.zeros(len(body))
    for c in range(len(body)):
        if body[c, 1] >= first:
            u0, u1, u2 = velocity_at(c, arm, body, w)
            for k in range(3):
                y = frame[c, 3 * k] * u0 + frame[c, 3 * k + 1] * u1 + frame[c, 3 * k + 2] * u2
                most[c] = max(most[c], abs(y))
    return most


@loop
def closing(frame, arm, body, w) -> tuple[Floats, Floats]:
    """D' w (nc, 3) for velocities w (rows, 6) of bodies, and what of it (nc,) is rounding: 1e-12 of the velocities of
    both bodies at their contact [m/s].

    What closes more slowly makes an overlap of 1e-12 v dt, until it counts by its gap. Bodies that fly side by side
    would else get impulses of 1e-25 N s, and solvers take hundreds of iterations for what is noise."""
    y, rounding = np.empty((len(body), 3)), np.empty(len(body))
    for c in range(len(body)):
        a, b = body[c, 0], body[c, 1]
        r0, r1, r2, s0, s1, s2 = arm[c, 0], arm[c, 1], arm[c, 2], arm[c, 3], arm[c, 4], arm[c, 5]
        u0, u1, u2 = velocity_at(c, arm, body, w)
        for k in range(3):
            y[c, k] = frame[c, 3 * k] * u0 + frame[c, 3 * k + 1] * u1 + frame[c, 3 * k + 2] * u2
        one = abs(w[a, 0]) + abs(w[a, 1]) + abs(w[a, 2])
        one += (abs(w[a, 3]) + abs(w[a, 4]) + abs(w[a, 5])) * (abs(r0) + abs(r1) + abs(r2))
        two = abs(w[b, 0]) + abs(w[b, 1]) + abs(w[b, 2])
        two += (abs(w[b, 3]) + abs(w[b, 4]) + abs(w[b, 5])) * (abs(s0) + abs(s1) + abs(s2))
        rounding[c] = 1e-12 * one + 1e-12 * two
    return y, rounding


@loop
def works(frame, arm, body, g, w, new_w):
    """g' D' (w + new_w) / 2 of normal and of tangential impulses g (nc, 3), and the normal parts (nc,) of D' w and
    D' new_w."""
    normal, tangential, last, velocity = 0.0, 0.0, np.empty(len(body)), np.empty(len(body))
    for c in range(len(body)):
        u0, u1, u2 = velocity_at(c, arm, body, w)
        v0, v1, v2 = velocity_at(c, arm, body, new_w)
        last[c] = frame[c, 0] * u0 + frame[c, 1] * u1 + frame[c, 2] * u2
        velocity[c] = frame[c, 0] * v0 + frame[c, 1] * v1 + frame[c, 2] * v2
        u0, u1, u2 = 0.5 * (u0 + v0), 0.5 * (u1 + v1), 0.5 * (u2 + v2)
        normal += g[c, 0] * (frame[c, 0] * u0 + frame[c, 1] * u1 + frame[c, 2] * u2)
        tangential += g[c, 1] * (frame[c, 3] * u0 + frame[c, 4] * u1 + frame[c, 5] * u2)
        tangential += g[c, 2] * (frame[c, 6] * u0 + frame[c, 7] * u1 + frame[c, 8] * u2)
    return normal, tangential, last, velocity


@loop
def add_momenta_on(first, frame, arm, body, g, m):
    """m += D g for impulses g (nc, 3) of the contacts whose second body is in the row `first` or behind it."""
    for c in range(len(body)):
        if body[c, 1] >= first:
            g0, g1, g2 = g[c, 0], g[c, 1], g[c, 2]
            f0 = frame[c, 0] * g0 + frame[c, 3] * g1 + frame[c, 6] * g2
            f1 = frame[c, 1] * g0 + frame[c, 4] * g1 + frame[c, 7] * g2
            f2 = frame[c, 2] * g0 + frame[c, 5] * g1 + frame[c, 8] * g2
            push(c, arm, body, f0, f1, f2, m)


@loop
def add_momenta(frame, arm, body, g, m, pushed):
    """m += D g for impulses g (nc, 3), and ``pushed`` (3,) += what they do to the rates of a cell."""
    x, y, z = 0.0, 0.0, 0.0
    for c in range(len(body)):
        g0, g1, g2 = g[c, 0], g[c, 1], g[c, 2]
        f0 = frame[c, 0] * g0 + frame[c, 3] * g1 + frame[c, 6] * g2
        f1 = frame[c, 1] * g0 + frame[c, 4] * g1 + frame[c, 7] * g2
        f2 = frame[c, 2] * g0 + frame[c, 5] * g1 + frame[c, 8] * g2
        push(c, arm, body, f0, f1, f2, m)
        if len(pushed):
            x += f0 * (arm[c, 0] - arm[c, 3])
            y += f1 * (arm[c, 1] - arm[c, 4])
            z += f2 * (arm[c, 2] - arm[c, 5])
    if len(pushed):
        pushed[0] += x
        pushed[1] += y
        pushed[2] += z


@loop
def add_pushes(arm, f, pushed):
    """``pushed`` (3,) += what forces f (nc, 3) of contacts do to the rates of a cell."""
    for c in range(len(f)):
        for k in range(3):
            pushed[k] += f[c, k] * (arm[c, k] - arm[c, 3 + k])


@loop
def scale_frames(frame, size, out):
    """out (nc, 9) = the frames with their rows multiplied by ``size`` (nc, 3), in the precision of out."""
    for c in range(len(out)):
        for k in range(9):
            out[c, k] = frame[c, k] * size[c, k // 3]


@loop
def find_forces(frame, g, f):
    """f = F' g (nc, 3), the impulses g (nc, 3) in the axes of the world."""
    for c in prange(len(f)):
        g0, g1, g2 = g[c, 0], g[c, 1], g[c, 2]
        f[c, 0] = frame[c, 0] * g0 + frame[c, 3] * g1 + frame[c, 6] * g2
        f[c, 1] = frame[c, 1] * g0 + frame[c, 4] * g1 + frame[c, 7] * g2
        f[c, 2] = frame[c, 2] * g0 + frame[c, 5] * g1 + frame[c, 8] * g2


@loop
def find_forces_through(arm, body, weight, w, f):
    """f = F' H D' w (nc, 3) for the ``weight`` of `weights`."""
    for c in prange(len(f)):
        u0, u1, u2 = velocity_at(c, arm, body, w)
        f[c, 0], f[c, 1], f[c, 2] = weighted(weight, c, u0, u1, u2)


@loop
def ends_of_bodies(body, moves):
    """The contacts of each body that ``moves`` (bodies,): those of body i are side e % 2 of contact e // 2, for the e
    in ends[start[i]:start[i + 1]], in the order of contacts. The others have none."""
    start, ends = np.zeros(len(moves) + 1, np.uint32), np.empty(2 * len(body), np.uint32)
    for c in range(len(body)):
        for side in range(2):
            start[body[c, side] + 1] += moves[body[c, side]]
    for i in range(len(moves)):
        start[i + 1] += start[i]
    next_of = start[:-1].copy()
    for c in range(len(body)):
        for side in range(2):
            i = body[c, side]
            if moves[i]:
                ends[next_of[i]] = 2 * c + side
                next_of[i] += 1
    return start, ends


@loop
def sum_forces(start, ends, arm, f, m):
    """m = D g (bodies, 6) from forces f (nc, 3) of contacts, body by body, so that threads do not meet; ``start``
    (bodies + 1,) and ``ends`` are those of `ends_of_bodies`."""
    for i in prange(len(m)):
        m0 = m1 = m2 = m3 = m4 = m5 = f.dtype.type(0)
        for k in range(start[i], start[i + 1]):
            c, side = ends[k] >> 1, ends[k] & 1
            sign = f.dtype.type(2 * side) - f.dtype.type(1)
            f0, f1, f2 = sign * f[c, 0], sign * f[c, 1], sign * f[c, 2]
            r0, r1, r2 = arm[c, 3 * side], arm[c, 3 * side + 1], arm[c, 3 * side + 2]
            m0 += f0
            m1 += f1
            m2 += f2
            m3 += r1 * f2 - r2 * f1
            m4 += r2 * f0 - r0 * f2
            m5 += r0 * f1 - r1 * f0
        m[i, 0], m[i, 1], m[i, 2], m[i, 3], m[i, 4], m[i, 5] = m0, m1, m2, m3, m4, m5


@inlined
def weighted(weight, c, u0, u1, u2):
    """W u at the contact c. ``weight`` has the upper triangles of symmetric blocks W, (nc, 6), or all of W, (nc, 9)."""
    if weight.shape[1] == 6:
        return (
            weight[c, 0] * u0 + weight[c, 1] * u1 + weight[c, 2] * u2,
            weight[c, 1] * u0 + weight[c, 3] * u1 + weight[c, 4] * u2,
            weight[c, 2] * u0 + weight[c, 4] * u1 + weight[c, 5] * u2,
        )
    return (
        weight[c, 0] * u0 + weight[c, 1] * u1 + weight[c, 2] * u2,
        weight[c, 3] * u0 + weight[c, 4] * u1 + weight[c, 5] * u2,
        weight[c, 6] * u0 + weight[c, 7] * u1 + weight[c, 8] * u2,
    )


@loop
def add_through(frame, arm, body, weight, w, m):
    """m += D H D' w; the ``weight`` of `weights` is F'HF, so the loop does not need the frame itself."""
    for c in range(len(body)):
        u0, u1, u2 = velocity_at(c, arm, body, w)
        f0, f1, f2 = weighted(weight, c, u0, u1, u2)
        push(c, arm, body, f0, f1, f2, m)


@loop
def weights(frame, arm, body, H, weight):
    """F'HF of blocks H (nc, 3, 3) as the ``weight`` of `weighted`."""
    whole = weight.shape[1] == 9
    for c in range(len(frame)):
        for i in range(3):
            h0 = H[c, 0, 0] * frame[c, i] + H[c, 0, 1] * frame[c, 3 + i] + H[c, 0, 2] * frame[c, 6 + i]
            h1 = H[c, 1, 0] * frame[c, i] + H[c, 1, 1] * frame[c, 3 + i] + H[c, 1, 2] * frame[c, 6 + i]
            h2 = H[c, 2, 0] * frame[c, i] + H[c, 2, 1] * frame[c, 3 + i] + H[c, 2, 2] * frame[c, 6 + i]
            for j in range(3):  # all of them: a compiler unrolls loops of known lengths
                entry = h0 * frame[c, j] + h1 * frame[c, 3 + j] + h2 * frame[c, 6 + j]
                if whole:
                    weight[c, i + 3 * j] = entry
                elif i <= j:
                    weight[c, j if i == 0 else i + j + 1] = entry


@loop
def add_body_blocks(frame, arm, body, weight, blocks):
    """blocks (bodies, 6, 6) += the diagonal blocks of D H D', for the ``weight`` of `weights`."""
    T, of = np.empty((3, 6)), np.arange(9)  # W J, with J = [1, X] from the velocities of a body to that of the point
    if weight.shape[1] == 6:
        of[3:] = 1, 3, 4, 2, 4, 5
    for c in range(len(frame)):
        for side in range(2):
            to = blocks[body[c, side]]
            x, y, z = arm[c, 3 * side], arm[c, 3 * side + 1], arm[c, 3 * side + 2]
            for k in range(3):  # a row of W X is the way r to the point times a row of W
                u, v, w = weight[c, of[3 * k]], weight[c, of[3 * k + 1]], weight[c, of[3 * k + 2]]
                T[k, 0], T[k, 1], T[k, 2] = u, v, w
                T[k, 3], T[k, 4], T[k, 5] = y * w - z * v, z * u - x * w, x * v - y * u
            for n in range(6):  # and X' is r times a column
                u, v, w = T[0, n], T[1, n], T[2, n]
                to[0, n] += u
                to[1, n] += v
                to[2, n] += w
                to[3, n] += y * w - z * v
                to[4, n] += z * u - x * w
                to[5, n] += x * v - y * u


@loop
def contact_blocks(frame, arm, body, mass, mobility, out):
    """out (nc, 3, 3) = diagonal blocks of D' M^-1 D; ``mass`` (bodies, 6 or 12) is M^-1 in the format of
    `CompactRows.root`, ``mobility`` (3,) that of the rates of a cell."""
    W = np.empty(6)  # from an impulse at the contact point to its velocity, the upper triangle
    for c in range(len(frame)):
        W[:] = 0.0
        if len(mobility):
            W[0] = mobility[0] * (arm[c, 0] - arm[c, 3]) ** 2
            W[3] = mobility[1] * (arm[c, 1] - arm[c, 4]) ** 2
            W[5] = mobility[2] * (arm[c, 2] - arm[c, 5]) ** 2
        for side in range(2):
            n = body[c, side]
            x, y, z = arm[c, 3 * side], arm[c, 3 * side + 1], arm[c, 3 * side + 2]
            if mass.shape[1] == 6:
                p, q, r = mass[n, 3], mass[n, 4], mass[n, 5]
                W[0] += mass[n, 0] + q * z * z + r * y * y
                W[1] -= r * x * y
                W[2] -= q * x * z
                W[3] += mass[n, 1] + p * z * z + r * x * x
                W[4] -= p * y * z
                W[5] += mass[n, 2] + p * y * y + q * x * x
            else:  # the rows of [r]x I^-1 and then times [r]x'
                p, q, r, s, t, u = mass[n, 6], mass[n, 7], mass[n, 8], mass[n, 9], mass[n, 10], mass[n, 11]
                a0, a1, a2 = y * r - z * q, y * t - z * s, y * u - z * t
                b0, b1, b2 = z * p - x * r, z * q - x * t, z * r - x * u
                c0, c1 = x * q - y * p, x * s - y * q
                W[0] += mass[n, 0] + y * a2 - z * a1
                W[1] += mass[n, 1] + z * a0 - x * a2
                W[2] += mass[n, 2] + x * a1 - y * a0
                W[3] += mass[n, 3] + z * b0 - x * b2
                W[4] += mass[n, 4] + x * b1 - y * b0
                W[5] += mass[n, 5] + x * c1 - y * c0
        for i in range(3):
            x, y, z = frame[c, 3 * i], frame[c, 3 * i + 1], frame[c, 3 * i + 2]
            u, v, w = W[0] * x + W[1] * y + W[2] * z, W[1] * x + W[3] * y + W[4] * z, W[2] * x + W[4] * y + W[5] * z
            for j in range(3):
                out[c, i, j] = u * frame[c, 3 * j] + v * frame[c, 3 * j + 1] + w * frame[c, 3 * j + 2]


@inlined
def scaled_row(root, i, x0, x1, x2, x3, x4, x5):
    """R_i x of the body i. R is block diagonal in the format of `CompactRows.root`."""
    if root.shape[1] == 6:
        return root[i, 0] * x0, root[i, 1] * x1, root[i, 2] * x2, root[i, 3] * x3, root[i, 4] * x4, root[i, 5] * x5
    return (
        root[i, 0] * x0 + root[i, 1] * x1 + root[i, 2] * x2,
        root[i, 1] * x0 + root[i, 3] * x1 + root[i, 4] * x2,
        root[i, 2] * x0 + root[i, 4] * x1 + root[i, 5] * x2,
        root[i, 6] * x3 + root[i, 7] * x4 + root[i, 8] * x5,
        root[i, 7] * x3 + root[i, 9] * x4 + root[i, 10] * x5,
        root[i, 8] * x3 + root[i, 10] * x4 + root[i, 11] * x5,
    )


@loop
def squared(root):
    """R^2, in the format of R."""
    out = np.empty(root.shape)
    for i in range(len(root)):
        for first in range(0, root.shape[1], 6):
            if root.shape[1] == 6:
                for k in range(6):
                    out[i, k] = root[i, k] * root[i, k]
            else:
                a, b, c = root[i, first], root[i, first + 1], root[i, first + 2]
                d, e, f = root[i, first + 3], root[i, first + 4], root[i, first + 5]
                out[i, first], out[i, first + 1] = a * a + b * b + c * c, a * b + b * d + c * e
                out[i, first + 2], out[i, first + 3] = a * c + b * e + c * f, b * b + d * d + e * e
                out[i, first + 4], out[i, first + 5] = b * c + d * e + e * f, c * c + e * e + f * f
    return out


@loop
def scale(root, v, out):
    """out = R v for v and out (bodies, 6); out may have more rows."""
    for i in prange(len(root)):
        out[i, 0], out[i, 1], out[i, 2], out[i, 3], out[i, 4], out[i, 5] = scaled_row(
            root, i, v[i, 0], v[i, 1], v[i, 2], v[i, 3], v[i, 4], v[i, 5]
        )


@loop
def add_scaled(root, v, m, out):
    """out = v + R m for v, m and out (bodies, 6); m may have more rows."""
    for i in prange(len(root)):
        m0, m1, m2, m3, m4, m5 = scaled_row(root, i, m[i, 0], m[i, 1], m[i, 2], m[i, 3], m[i, 4], m[i, 5])
        out[i, 0], out[i, 1], out[i, 2] = v[i, 0] + m0, v[i, 1] + m1, v[i, 2] + m2
        out[i, 3], out[i, 4], out[i, 5] = v[i, 3] + m3, v[i, 4] + m4, v[i, 5] + m5


@inlined
def extrapolated(m, last_m, beta, i):
    """The row i of m + beta (m - last_m)."""
    return (
        m[i, 0] + beta * (m[i, 0] - last_m[i, 0]), m[i, 1] + beta * (m[i, 1] - last_m[i, 1]),
        m[i, 2] + beta * (m[i, 2] - last_m[i, 2]), m[i, 3] + beta * (m[i, 3] - last_m[i, 3]),
        m[i, 4] + beta * (m[i, 4] - last_m[i, 4]), m[i, 5] + beta * (m[i, 5] - last_m[i, 5]),
    )  # fmt: skip


@loop
def scale_extrapolated(mass, m, last_m, beta, out):
    """out = M^-1 (m + beta (m - last_m)) for the bodies of ``mass``, which is M^-1 in the format of
    `CompactRows.root`."""
    way = m.dtype.type(beta)
    if mass.shape[1] == 6:
        each, now, last, to = mass.ravel(), m.ravel(), last_m.ravel(), out.reshape(out.size)
        for part in prange((len(each) + NUMBERS - 1) // NUMBERS):
            a, b = part * NUMBERS, min(part * NUMBERS + NUMBERS, len(each))
            _scale_numbers(each[a:b], now[a:b], last[a:b], way, to[a:b])
    else:
        for i in prange(len(mass)):
            u, v, w, x, y, z = extrapolated(m, last_m, way, i)
            out[i, 0], out[i, 1], out[i, 2], out[i, 3], out[i, 4], out[i, 5] = scaled_row(mass, i, u, v, w, x, y, z)


@inner
def _scale_numbers(mass, m, last_m, beta, out):
    for k in range(len(mass)):
        out[k] = mass[k] * (m[k] + beta * (m[k] - last_m[k]))


@loop
def energy_of_step(mass, new_m, m, last_m, beta):
    """d' M^-1 d of d = new_m - (m + beta (m - last_m)), summed in double precision over parts of the bodies of
    ``mass``."""
    factor = m.dtype.type(beta)
    sums = np.zeros((len(mass) + PART - 1) // PART)
    for part in prange(len(sums)):
        a, b = part * PART, min(part * PART + PART, len(mass))
        sums[part] = _energy_of_part(mass[a:b], new_m[a:b], m[a:b], last_m[a:b], factor)
    return sums.sum()


@inner
def _energy_of_part(mass, new_m, m, last_m, beta):
    if mass.shape[1] == 6:
        each, new, now, last = mass.ravel(), new_m.ravel(), m.ravel(), last_m.ravel()
        sums = np.zeros(min(NUMBERS, (len(each) + 7) // 8 * 8), mass.dtype)
        for a in range(0, len(each), NUMBERS):
            b = min(a + NUMBERS, len(each))
            _add_energies(each[a:b], new[a:b], now[a:b], last[a:b], beta, sums)
        return sum_of(sums)
    energy = 0.0
    for i in range(len(mass)):
        u, v, w, x, y, z = extrapolated(m, last_m, beta, i)
        d0, d1, d2 = new_m[i, 0] - u, new_m[i, 1] - v, new_m[i, 2] - w
        d3, d4, d5 = new_m[i, 3] - x, new_m[i, 4] - y, new_m[i, 5] - z
        v0, v1, v2, v3, v4, v5 = scaled_row(mass, i, d0, d1, d2, d3, d4, d5)
        energy += d0 * v0 + d1 * v1 + d2 * v2 + d3 * v3 + d4 * v4 + d5 * v5
    return energy


@inner
def _add_energies(mass, new_m, m, last_m, beta, sums):
    for k in range(len(mass)):
        d = new_m[k] - (m[k] + beta * (m[k] - last_m[k]))
        sums[k] += mass[k] * (d * d)


@loop
def pack(H, weight):
    """The upper triangles of symmetric blocks H (nc, 3, 3) as the ``weight`` of `weighted`, (nc, 6)."""
    for c in range(len(H)):
        for i in range(3):
            for j in range(i, 3):
                weight[c, j if i == 0 else i + j + 1] = H[c, i, j]


@loop
def local_product(weight, g, y):
    """y = H g (nc, 3) for the ``weight`` of `weighted`."""
    for c in range(len(weight)):
        y[c, 0], y[c, 1], y[c, 2] = weighted(weight, c, g[c, 0], g[c, 1], g[c, 2])


@inlined
def block_velocity_at(c, blocks, start, body, w):
    """G w at the contact c, in registers: sums in memory take 1.5 times as long."""
    y0 = y1 = y2 = blocks.dtype.type(0)
    for k in range(start[c], start[c + 1]):
        i = body[k]
        for n in range(6):
            y0 += blocks[k, 0, n] * w[i, n]
            y1 += blocks[k, 1, n] * w[i, n]
            y2 += blocks[k, 2, n] * w[i, n]
    return y0, y1, y2


@inlined
def block_push(c, blocks, start, body, g0, g1, g2, m):
    """m += G' g for the impulse of the contact c. All six sums are read before one is written, so that the compiler
    makes vectors of them."""
    for k in range(start[c], start[c + 1]):
        i = body[k]
        m0 = blocks[k, 0, 0] * g0 + blocks[k, 1, 0] * g1 + blocks[k, 2, 0] * g2
        m1 = blocks[k, 0, 1] * g0 + blocks[k, 1, 1] * g1 + blocks[k, 2, 1] * g2
        m2 = blocks[k, 0, 2] * g0 + blocks[k, 1, 2] * g1 + blocks[k, 2, 2] * g2
        m3 = blocks[k, 0, 3] * g0 + blocks[k, 1, 3] * g1 + blocks[k, 2, 3] * g2
        m4 = blocks[k, 0, 4] * g0 + blocks[k, 1, 4] * g1 + blocks[k, 2, 4] * g2
        m5 = blocks[k, 0, 5] * g0 + blocks[k, 1, 5] * g1 + blocks[k, 2, 5] * g2
        m[i, 0] += m0
        m[i, 1] += m1
        m[i, 2] += m2
        m[i, 3] += m3
        m[i, 4] += m4
        m[i, 5] += m5


@loop
def block_velocities(blocks, start, body, w, y):
    """y += G w (nc, 3) for blocks (nb, 3, 6): contact c has those from start[c] to start[c + 1], of bodies (nb,)."""
    for c in range(len(y)):
        y0, y1, y2 = block_velocity_at(c, blocks, start, body, w)
        y[c, 0] += y0
        y[c, 1] += y1
        y[c, 2] += y2


@loop
def block_momenta(blocks, start, body, g, m):
    """m += G' g for the blocks of `block_velocities` and impulses g (nc, 3)."""
    for c in range(len(g)):
        block_push(c, blocks, start, body, g[c, 0], g[c, 1], g[c, 2], m)


@loop
def block_through(blocks, start, body, weight, w, m):
    """m += G' H G w for blocks H (nc, 3, 3), here ``weight``; one pass over the blocks of `block_velocities`."""
    for c in range(len(weight)):
        y0, y1, y2 = block_velocity_at(c, blocks, start, body, w)
        g0 = weight[c, 0, 0] * y0 + weight[c, 0, 1] * y1 + weight[c, 0, 2] * y2
        g1 = weight[c, 1, 0] * y0 + weight[c, 1, 1] * y1 + weight[c, 1, 2] * y2
        g2 = weight[c, 2, 0] * y0 + weight[c, 2, 1] * y1 + weight[c, 2, 2] * y2
        block_push(c, blocks, start, body, g0, g1, g2, m)
