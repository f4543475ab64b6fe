"""Algebra of the cone x_0 >= |(x_1, x_2)| (second-order, or Lorentz, cone), one cone per row of arrays (nc, 3).

The product x o y = (x'y, x_0 y_1: + y_0 x_1:) has the unit e = (1, 0, 0); x has the spectral values x_0 +- |x_1:|. The
Nesterov-Todd scaling of a pair (s, z) inside the cones is the symmetric W with W z = W^-1 s, of which W^2 and W^-2
have the eigenvectors (1, u), (1, -u) and (0, u'), u the direction of the scaling point.

Source: Nesterov and Todd (1997); Andersen, Roos and Terlaky (2003); Domahidi, Chu and Boyd (2013).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dem.compiled import inlined, loop
from pctt.ccp.cone import TINY, Array, dot, tangential

LEAST = 1e-17  # determinant of a unit point that rounding has put on or outside the boundary
ROUND = 1e-14  # tangential part of a unit scaling point below which it has no direction


@loop
def determinant(x: Array) -> Array:
    """x_0^2 - |x_1:|^2 (nc,) of points inside, kept positive in spite of rounding.

    Near the boundary rounding is at most 1.5 eps x_0^2: the first difference is exact, and neither the product nor the
    square is larger than x_0^2 / 2."""
    out = np.empty(len(x))
    for c in range(len(x)):
        out[c] = _determinant(x[c, 0], x[c, 1], x[c, 2])
    return out


@inlined
def _determinant(x_0, x_1, x_2):
    small, large = abs(x_1), abs(x_2)
    if small > large:
        small, large = large, small
    found = (x_0 - large) * (x_0 + large) - small * small
    least = max(LEAST * x_0 * x_0, TINY)
    return least if found < least else found


def product(x: Array, y: Array) -> Array:
    """x o y."""
    out = np.empty_like(x)
    out[:, 0] = dot(x, y)
    for k in (1, 2):
        out[:, k] = x[:, 0] * y[:, k] + y[:, 0] * x[:, k]
    return out


def divide(x: Array, y: Array) -> Array:
    """The w with x o w = y; x inside the cones."""
    out = np.empty_like(y)
    out[:, 0] = (x[:, 0] * y[:, 0] - x[:, 1] * y[:, 1] - x[:, 2] * y[:, 2]) / determinant(x)
    for k in (1, 2):
        out[:, k] = (y[:, k] - out[:, 0] * x[:, k]) / x[:, 0]
    return out


@loop
def step_to_boundary(x: Array, dx: Array) -> float:
    """Largest a such that x + a dx is in the cones of this rank (inf where nothing limits it); x is inside.

    By the smallest spectral value of dx seen from x (Vandenberghe, "The CVXOPT linear and quadratic cone program
    solvers", 2010).
    """
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


def central_pair(x: Array, tau: Array, complementarity: Array | float) -> tuple[Array, Array]:
    """The pair (s, z) inside the cones with s - tau z = x and s o z = complementarity e; tau (nc,).

    In the spectral values of x: s = (l + root(l^2 + 4 c tau)) / 2, and z likewise of -l.
    """
    t = tangential(x)
    direction = np.divide(x[:, 1:], t[:, None], out=np.zeros_like(x[:, 1:]), where=t[:, None] > 0)
    room = 4.0 * complementarity * tau

    def positive_part(value: Array) -> Array:
        root = np.sqrt(value * value + room)
        return np.where(value > 0, 0.5 * (value + root), 0.5 * room / (root - np.minimum(value, 0.0)))

    def assembled(high: Array, low: Array) -> Array:
        out = np.empty_like(x)
        out[:, 0] = 0.5 * (high + low)
        out[:, 1:] = (0.5 * (high - low))[:, None] * direction
        return out

    high, low = x[:, 0] + t, x[:, 0] - t
    s = assembled(positive_part(high), positive_part(low))
    z = assembled(positive_part(-high), positive_part(-low)) / tau[:, None]
    return s, z


@loop
def scale(root: Array, eta: Array, x: Array) -> Array:
    """W x."""
    out = np.empty_like(x)
    for c in range(len(x)):
        twice = 2.0 * (root[c, 0] * x[c, 0] + root[c, 1] * x[c, 1] + root[c, 2] * x[c, 2])
        out[c, 0] = eta[c] * (twice * root[c, 0] - x[c, 0])
        out[c, 1] = eta[c] * (twice * root[c, 1] + x[c, 1])
        out[c, 2] = eta[c] * (twice * root[c, 2] + x[c, 2])
    return out


@loop
def unscale(root: Array, eta: Array, x: Array) -> Array:
    """W^-1 x."""
    out = np.empty_like(x)
    for c in range(len(x)):
        twice = 2.0 * (root[c, 0] * x[c, 0] - root[c, 1] * x[c, 1] - root[c, 2] * x[c, 2])
        out[c, 0] = (twice * root[c, 0] - x[c, 0]) / eta[c]
        out[c, 1] = (x[c, 1] - twice * root[c, 1]) / eta[c]
        out[c, 2] = (x[c, 2] - twice * root[c, 2]) / eta[c]
    return out


@loop
def barrier_blocks(
    direction: Array, eta: Array, spread: Array, scale: Array, compliance: Array, proximal: float
) -> tuple[Array, Array, Array]:
    """What the method of ``NesterovTodd`` returns."""
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
    """A symmetric block (3, 3) with given eigenvalues for (1, u), (1, -u), (0, u')."""
    mean, half = 0.5 * (along + against), 0.5 * (along - against)
    out[0, 0] = mean
    out[0, 1] = out[1, 0] = half * u
    out[0, 2] = out[2, 0] = half * v
    out[1, 1] = mean * u * u + across * v * v
    out[2, 2] = mean * v * v + across * u * u
    out[1, 2] = out[2, 1] = (mean - across) * u * v


def towards_interval(x: Array, low: float, high: float) -> Array:
    """What moves the spectral values of x into [low, high], but none by more than ``high`` downwards."""
    size = tangential(x)
    values = x[:, 0] + np.stack([size, -size])
    larger, smaller = np.maximum(np.clip(values, low, high) - values, -high)
    out = np.empty_like(x)
    out[:, 0] = 0.5 * (larger + smaller)
    out[:, 1:] = (0.5 * (larger - smaller) / np.maximum(size, 1e-300))[:, None] * x[:, 1:]
    return out


@dataclass(frozen=True)
class NesterovTodd:
    """The scaling W of a pair.

    root, inverse_root : unit hyperbolic vectors of W and W^-1
    eta : (nc,) size of W
    spread : (nc,) eta^-1 times the larger eigenvalue of W, the smaller is its inverse
    direction : (nc, 2) u
    """

    root: Array
    eta: Array
    spread: Array
    direction: Array

    @classmethod
    def of(cls, s: Array, z: Array) -> NesterovTodd:
        size_s, size_z = (np.sqrt(determinant(x)) for x in (s, z))
        angle = np.sqrt(np.maximum(0.5 * (1.0 + dot(s, z) / (size_s * size_z)), 0.5))
        of_s, of_z = 0.5 / (angle * size_s), 0.5 / (angle * size_z)
        point = np.empty_like(s)
        point[:, 0] = of_s * s[:, 0] + of_z * z[:, 0]
        for k in (1, 2):
            point[:, k] = of_s * s[:, k] - of_z * z[:, k]
        t = tangential(point)
        direction = np.empty_like(point[:, 1:])
        for k in (0, 1):
            direction[:, k] = np.divide(point[:, 1 + k], t, out=np.full_like(t, 1.0 - k), where=t > ROUND)
        spread = point[:, 0] + t
        point[:, 0] += 1.0
        root = point / np.sqrt(2.0 * point[:, :1])
        return cls(root, np.sqrt(size_s / size_z), spread, direction)

    def times(self, x: Array) -> Array:
        """W x."""
        return scale(self.root, self.eta, x)

    def divide(self, x: Array) -> Array:
        """W^-1 x."""
        return unscale(self.root, self.eta, x)

    def barrier_blocks(self, scale: Array, compliance: Array, proximal: float) -> tuple[Array, Array, Array]:
        """Of B = W^-2 + ``proximal`` and C + ``proximal``, which is ``compliance``, a number per contact: S B S,
        S^-1 (B + C)^-1 S^-1 and (B + C)^-1 B, (nc, 3, 3) each, with S = diag ``scale``.

        From the spectral form, no tiny block is inverted: W^2 has the eigenvalues (eta spread)^2, (eta / spread)^2 and
        eta^2 for (1, u), (1, -u) and (0, u')."""
        return barrier_blocks(self.direction, self.eta, self.spread, scale, compliance, proximal)
