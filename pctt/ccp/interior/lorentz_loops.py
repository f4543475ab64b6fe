"""The functions of ``lorentz`` as loops over the contacts."""

from __future__ import annotations

import numpy as np

from pctt.ccp.cone import TINY
from pctt.ccp.interior.lorentz import LEAST, ROUND
from pctt.compiled import loop


@loop
def _determinant(x_0, x_1, x_2):
    small, large = abs(x_1), abs(x_2)
    if small > large:
        small, large = large, small
    found = (x_0 - large) * (x_0 + large) - small * small
    least = max(LEAST * x_0 * x_0, TINY)
    return least if found < least else found


@loop
def product(x, y):
    out = np.empty_like(x)
    for c in range(len(x)):
        x_0, y_0 = x[c, 0], y[c, 0]
        out[c, 0] = x_0 * y_0 + x[c, 1] * y[c, 1] + x[c, 2] * y[c, 2]
        out[c, 1] = x_0 * y[c, 1] + y_0 * x[c, 1]
        out[c, 2] = x_0 * y[c, 2] + y_0 * x[c, 2]
    return out


@loop
def divide(x, y):
    out = np.empty_like(y)
    for c in range(len(x)):
        x_0, x_1, x_2 = x[c, 0], x[c, 1], x[c, 2]
        w = (x_0 * y[c, 0] - x_1 * y[c, 1] - x_2 * y[c, 2]) / _determinant(x_0, x_1, x_2)
        out[c, 0] = w
        out[c, 1] = (y[c, 1] - w * x_1) / x_0
        out[c, 2] = (y[c, 2] - w * x_2) / x_0
    return out


@loop
def step_to_boundary(x, dx):
    fastest = 0.0
    for c in range(len(x)):
        x_0, x_1, x_2 = x[c, 0], x[c, 1], x[c, 2]
        dx_0, dx_1, dx_2 = dx[c, 0], dx[c, 1], dx[c, 2]
        size = np.sqrt(_determinant(x_0, x_1, x_2))
        inner = (x_0 * dx_0 - x_1 * dx_1 - x_2 * dx_2) / size
        along = (inner + dx_0) / (x_0 + size)
        turned_1, turned_2 = dx_1 - along * x_1, dx_2 - along * x_2
        speed = (np.sqrt(turned_1 * turned_1 + turned_2 * turned_2) - inner) / size
        if not speed <= fastest:
            fastest = speed
            if speed != speed:  # no other is larger
                break
    return 1.0 / fastest if fastest > 0 else np.inf


@loop
def scaling(s, z):
    count = len(s)
    root, eta, spread, direction = np.empty_like(s), np.empty(count), np.empty(count), np.empty((count, 2))
    for c in range(count):
        size_s = np.sqrt(_determinant(s[c, 0], s[c, 1], s[c, 2]))
        size_z = np.sqrt(_determinant(z[c, 0], z[c, 1], z[c, 2]))
        cosine = (s[c, 0] * z[c, 0] + s[c, 1] * z[c, 1] + s[c, 2] * z[c, 2]) / (size_s * size_z)
        squared = 0.5 * (1.0 + cosine)
        angle = np.sqrt(0.5 if squared < 0.5 else squared)
        of_s, of_z = 0.5 / (angle * size_s), 0.5 / (angle * size_z)
        point_0 = of_s * s[c, 0] + of_z * z[c, 0]
        point_1 = of_s * s[c, 1] - of_z * z[c, 1]
        point_2 = of_s * s[c, 2] - of_z * z[c, 2]
        t = np.sqrt(point_1 * point_1 + point_2 * point_2)
        direction[c, 0], direction[c, 1] = (point_1 / t, point_2 / t) if t > ROUND else (1.0, 0.0)
        spread[c] = point_0 + t
        point_0 += 1.0
        length = np.sqrt(2.0 * point_0)
        root[c, 0], root[c, 1], root[c, 2] = point_0 / length, point_1 / length, point_2 / length
        eta[c] = np.sqrt(size_s / size_z)
    return root, eta, spread, direction


@loop
def scale(root, eta, x):
    out = np.empty_like(x)
    for c in range(len(x)):
        twice = 2.0 * (root[c, 0] * x[c, 0] + root[c, 1] * x[c, 1] + root[c, 2] * x[c, 2])
        out[c, 0] = eta[c] * (twice * root[c, 0] - x[c, 0])
        out[c, 1] = eta[c] * (twice * root[c, 1] + x[c, 1])
        out[c, 2] = eta[c] * (twice * root[c, 2] + x[c, 2])
    return out


@loop
def unscale(root, eta, x):
    out = np.empty_like(x)
    for c in range(len(x)):
        twice = 2.0 * (root[c, 0] * x[c, 0] - root[c, 1] * x[c, 1] - root[c, 2] * x[c, 2])
        out[c, 0] = (twice * root[c, 0] - x[c, 0]) / eta[c]
        out[c, 1] = (x[c, 1] - twice * root[c, 1]) / eta[c]
        out[c, 2] = (x[c, 2] - twice * root[c, 2]) / eta[c]
    return out


@loop
def barrier_blocks(direction, eta, spread, scale, compliance, proximal):
    count = len(eta)
    B, inverse, share = np.empty((count, 3, 3)), np.empty((count, 3, 3)), np.empty((count, 3, 3))
    for c in range(count):
        square = eta[c] * eta[c]
        along, against = square * (spread[c] * spread[c]), square / (spread[c] * spread[c])
        u, v = direction[c, 0], direction[c, 1]
        _block(u, v, 1.0 / along + proximal, 1.0 / against + proximal, 1.0 / square + proximal, B[c])
        e = compliance[c]
        shares = 1.0 / (1.0 + e * along), 1.0 / (1.0 + e * against), 1.0 / (1.0 + e * square)
        _block(u, v, along * shares[0], against * shares[1], square * shares[2], inverse[c])
        _block(u, v, shares[0], shares[1], shares[2], share[c])
        for i in range(3):
            for j in range(3):
                both = scale[c, i] * scale[c, j]
                B[c, i, j] *= both
                inverse[c, i, j] /= both
    return B, inverse, share


@loop
def _block(u, v, along, against, across, out):
    mean, half = 0.5 * (along + against), 0.5 * (along - against)
    out[0, 0] = mean
    out[0, 1] = out[1, 0] = half * u
    out[0, 2] = out[2, 0] = half * v
    out[1, 1] = mean * u * u + across * v * v
    out[2, 2] = mean * v * v + across * u * u
    out[1, 2] = out[2, 1] = (mean - across) * u * v


@loop
def towards_interval(x, low, high):
    out = np.empty_like(x)
    for c in range(len(x)):
        size = np.sqrt(x[c, 1] * x[c, 1] + x[c, 2] * x[c, 2])
        larger = _shift(x[c, 0] + size, low, high)
        smaller = _shift(x[c, 0] - size, low, high)
        turn = 0.5 * (larger - smaller) / (1e-300 if size < 1e-300 else size)
        out[c, 0], out[c, 1], out[c, 2] = 0.5 * (larger + smaller), turn * x[c, 1], turn * x[c, 2]
    return out


@loop
def _shift(value, low, high):
    aim = low if value < low else high if value > high else value
    shift = aim - value
    return -high if shift < -high else shift
