"""Functions of ``lorentz`` as loops over the contacts."""

from __future__ import annotations

import numpy as np

from pctt.ccp.cone import TINY
from pctt.ccp.interior.lorentz import LEAST
from pctt.compiled import inlined, loop


@inlined
def _determinant(x_0, x_1, x_2):
    small, large = abs(x_1), abs(x_2)
    if small > large:
        small, large = large, small
    found = (x_0 - large) * (x_0 + large) - small * small
    least = max(LEAST * x_0 * x_0, TINY)
    return least if found < least else found


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


@inlined
def _block(u, v, along, against, across, out):
    mean, half = 0.5 * (along + against), 0.5 * (along - against)
    out[0, 0] = mean
    out[0, 1] = out[1, 0] = half * u
    out[0, 2] = out[2, 0] = half * v
    out[1, 1] = mean * u * u + across * v * v
    out[2, 2] = mean * v * v + across * u * u
    out[1, 2] = out[2, 1] = (mean - across) * u * v
