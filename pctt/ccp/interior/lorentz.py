"""Algebra of the cone x_0 >= |(x_1, x_2)| (second-order, or Lorentz, cone), one cone per row of arrays (nc, 3).

The product x o y = (x'y, x_0 y_1: + y_0 x_1:) has the unit e = (1, 0, 0); x has the spectral values x_0 +- |x_1:|. The
Nesterov-Todd scaling of a pair (s, z) inside the cones is the symmetric W with W z = W^-1 s, of which W^2 and W^-2
have the eigenvectors (1, u), (1, -u) and (0, u'), u the direction of the scaling point.

Source: Nesterov and Todd (1997); Andersen, Roos and Terlaky (2003); Domahidi, Chu and Boyd (2013).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pctt.ccp.cone import Array

_LEAST = 1e-17  # determinant of a unit point that rounding has put on or outside the boundary


def determinant(x: Array) -> Array:
    """x_0^2 - |x_1:|^2 (nc,) of points inside, kept positive where rounding would not."""
    t = np.hypot(x[:, 1], x[:, 2])
    return np.maximum((x[:, 0] - t) * (x[:, 0] + t), np.maximum(_LEAST * x[:, 0] ** 2, np.finfo(float).tiny))


def product(x: Array, y: Array) -> Array:
    """x o y."""
    out = x[:, :1] * y + y[:, :1] * x
    out[:, 0] = (x * y).sum(1)
    return out


def divide(x: Array, y: Array) -> Array:
    """The w with x o w = y; x inside the cones."""
    out = np.empty_like(y)
    out[:, 0] = (x[:, 0] * y[:, 0] - x[:, 1] * y[:, 1] - x[:, 2] * y[:, 2]) / determinant(x)
    out[:, 1:] = (y[:, 1:] - out[:, :1] * x[:, 1:]) / x[:, :1]
    return out


def step_to_boundary(x: Array, dx: Array) -> float:
    """Largest a such that x + a dx is in the cones of this rank (inf where nothing limits it); x is inside.

    By the smallest spectral value of dx seen from x (Vandenberghe, "The CVXOPT linear and quadratic cone program
    solvers", 2010).
    """
    size = np.sqrt(determinant(x))
    unit = x / size[:, None]
    inner = unit[:, 0] * dx[:, 0] - unit[:, 1] * dx[:, 1] - unit[:, 2] * dx[:, 2]
    turned = dx[:, 1:] - ((inner + dx[:, 0]) / (unit[:, 0] + 1.0))[:, None] * unit[:, 1:]
    fastest = ((np.hypot(turned[:, 0], turned[:, 1]) - inner) / size).max(initial=0.0)
    return 1.0 / fastest if fastest > 0 else np.inf


def central_pair(x: Array, tau: Array, complementarity: Array | float) -> tuple[Array, Array]:
    """The pair (s, z) inside the cones with s - tau z = x and s o z = complementarity e; tau (nc,).

    In the spectral values of x: s = (l + root(l^2 + 4 c tau)) / 2, and z likewise of -l.
    """
    t = np.hypot(x[:, 1], x[:, 2])
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
        unit_s, unit_z = s / size_s[:, None], z / size_z[:, None]
        angle = np.sqrt(np.maximum(0.5 * (1.0 + (unit_s * unit_z).sum(1)), 0.5))
        point = unit_s
        point[:, 0] += unit_z[:, 0]
        point[:, 1:] -= unit_z[:, 1:]
        point /= (2.0 * angle)[:, None]
        t = np.hypot(point[:, 1], point[:, 2])
        direction = np.zeros_like(point[:, 1:])
        direction[:, 0] = 1.0
        np.divide(point[:, 1:], t[:, None], out=direction, where=t[:, None] > 1e-14)
        root = point.copy()
        root[:, 0] += 1.0
        root /= np.sqrt(2.0 * root[:, :1])
        return cls(root, np.sqrt(size_s / size_z), point[:, 0] + t, direction)

    def times(self, x: Array) -> Array:
        """W x."""
        out = (2.0 * self.eta * (self.root * x).sum(1))[:, None] * self.root
        flipped = self.eta[:, None] * x
        out[:, 0] -= flipped[:, 0]
        out[:, 1:] += flipped[:, 1:]
        return out

    def divide(self, x: Array) -> Array:
        """W^-1 x."""
        mirrored = self.root.copy()
        mirrored[:, 1:] *= -1.0
        out = (2.0 * (mirrored * x).sum(1))[:, None] * mirrored
        out[:, 0] -= x[:, 0]
        out[:, 1:] += x[:, 1:]
        return out / self.eta[:, None]

    def square_values(self) -> tuple[Array, Array, Array]:
        """Eigenvalues of W^2 for (1, u), (1, -u), (0, u')."""
        square = self.eta * self.eta
        return square * self.spread**2, square / self.spread**2, square

    def blocks(self, along: Array, against: Array, across: Array) -> Array:
        """Symmetric blocks (nc, 3, 3) with given eigenvalues for (1, u), (1, -u), (0, u')."""
        u, v = self.direction.T
        mean, half = 0.5 * (along + against), 0.5 * (along - against)
        out = np.empty((len(mean), 3, 3))
        out[:, 0, 0] = mean
        out[:, 0, 1] = out[:, 1, 0] = half * u
        out[:, 0, 2] = out[:, 2, 0] = half * v
        out[:, 1, 1] = mean * u * u + across * v * v
        out[:, 2, 2] = mean * v * v + across * u * u
        out[:, 1, 2] = out[:, 2, 1] = (mean - across) * u * v
        return out
