"""The friction cone |(g_1, g_2)| <= mu g_n and the arithmetic that the solvers need on it; its loops are in
`cone_loops`.

Impulses are arrays (nc, 3), one row per contact in the order (normal, tangent 1, tangent 2); ``mu`` is (nc,).

`FrictionCones` is what solvers ask of the cones of a problem; `pctt.ccp.rolling` has others with the same members.

The cone of friction 1 is its own dual, with the Jordan product x o y = (x'y, x_0 y_1: + y_0 x_1:). Its unit is
e = (1, 0, 0), the spectral values of x are x_0 +- |x_1:|. Source: Domahidi, Chu and Boyd (2013).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pctt.ccp.cone_loops import (
    TINY,
    Array,
    accelerated_step,
    determinant,
    nesterov_todd,
    project_to,
    step_inside,
    step_to_boundary,
    step_to_zero,
    times,
)

__all__ = [
    "TINY",
    "Array",
    "determinant",
    "step_inside",
    "step_to_boundary",
    "step_to_zero",
    "times",
]


def project(x: Array, mu: Array, out: Array | None = None) -> Array:
    """Euclidean projection of each row on its friction cone; ``out`` may be x itself.

    >>> project(np.array([[1.0, 0.0, 1.0], [-1.0, 0.0, 0.1]]), np.array([1.0, 1.0]))
    array([[1., 0., 1.],
           [0., 0., 0.]])
    """
    return project_to(x, mu, np.empty(x.shape, x.dtype) if out is None else out)


def margin(x: Array, mu: Array) -> Array:
    """mu g_n - |(g_1, g_2)|, positive inside the cone (nc,)."""
    return mu * x[:, 0] - tangential(x)


def tangential(x: Array) -> Array:
    """|(g_1, g_2)| (nc,). (Five times as fast as np.hypot; no impulse is near the ends of the range of numbers.)"""
    t = x[:, 1] * x[:, 1]
    t += x[:, 2] * x[:, 2]
    return np.sqrt(t, out=t)


def dot(x: Array, y: Array) -> Array:
    """Inner products of rows (nc,). (Six times as fast as a sum along rows of three.)"""
    out: Array = x[:, 0] * y[:, 0]
    out += x[:, 1] * y[:, 1]
    out += x[:, 2] * y[:, 2]
    return out


class FrictionCones:
    """The cones of all contacts of this rank. Arrays of unknowns are (rows, 3), the first rows with the normals."""

    def __init__(self, mu: Array):
        self.mu, self.count = mu, len(mu)

    def scaled(self, size: Array, precision: type[np.floating]) -> FrictionCones:
        """The cones of unknowns multiplied by ``size`` (rows, 3), whose tangential numbers are equal."""
        return FrictionCones((self.mu * size[:, 1] / size[:, 0]).astype(precision, copy=False))

    def project(self, x: Array, out: Array) -> Array:
        """The nearest points (rows, 3), into ``out``, which may be x."""
        return project_to(x, self.mu, out)

    def resisted(self, y: Array) -> Array:
        """De Saxce's term mu |y_t| (count,): the power that velocities y lose for a unit of normal impulse."""
        return self.mu * tangential(y)

    def accelerated_step(
        self, x: Array, last_x: Array, y: Array, compliance: Array, beta: float, step: float, coulomb: bool, out: Array
    ) -> tuple[float, float, float]:
        """`pctt.ccp.cone_loops.accelerated_step` to these cones."""
        return accelerated_step(x, last_x, y, compliance, beta, step, self.mu, float(coulomb), out)

    def move(self, x: Array, y: Array, step: Array | float, coulomb: bool = False) -> Array:
        """P(x - step y) - x (rows, 3) for a step of one length or many, where y_n gets De Saxce's term for Coulomb's law."""
        out = y.copy()
        if coulomb:
            out[: self.count, 0] += self.resisted(y)
        out *= -step
        out += x
        self.project(out, out)
        out -= x
        return out

    def power(self, x: Array, y: Array) -> Array:
        """x.y of each contact (count,)."""
        return dot(x, y).reshape(len(x) // max(self.count, 1), self.count).sum(axis=0)

    def not_idle(self, x: Array, last_x: Array, y: Array, least: float) -> NDArray[np.bool_]:
        """Mask (count,) of the contacts but those without an impulse at x and last_x whose distance inside the dual
        cone, y_n less `resisted`, exceeds the ``least``."""
        x, last_x, opening = x[: self.count, 0], last_x[: self.count, 0], y[: self.count, 0] - self.resisted(y)
        return (x > 0) | (last_x > 0) | ~(opening > least)


# -- the cone of friction 1 -----------------------------------------------------------------------------------

J = np.array([1.0, -1.0, -1.0])


def jordan_product(x: Array, y: Array) -> Array:
    """x o y (nc, 3)."""
    out = x[:, :1] * y + y[:, :1] * x
    out[:, 0] = dot(x, y)
    return out


def jordan_divide(x: Array, y: Array) -> Array:
    """The w (nc, 3) with x o w = y; x inside the cones."""
    first = (x[:, 0] * y[:, 0] - x[:, 1] * y[:, 1] - x[:, 2] * y[:, 2]) / determinant(x)
    out = (y - first[:, None] * x) / x[:, :1]
    out[:, 0] = first
    return out


class NesterovTodd(NamedTuple):
    """The scaling W = eta (2 root root' - J), J = diag(1, -1, -1), of pairs: ``root`` (nc, 3), ``eta`` (nc,).

    Products by this form. Those by blocks lose a digit of the residual that the conic method reaches."""

    root: Array
    eta: Array

    def times(self, x: Array) -> Array:
        """W x (nc, 3)."""
        return nesterov_todd(self.root, self.eta, x, False)

    def divide(self, x: Array) -> Array:
        """W^-1 x (nc, 3)."""
        return nesterov_todd(self.root, self.eta, x, True)


def towards_interval(x: Array, low: float, high: float) -> Array:
    """What moves the spectral values of x into [low, high], but none by more than ``high`` downwards."""
    size = tangential(x)
    values = x[:, 0] + np.stack([size, -size])
    return _of_spectrum(x, *np.maximum(np.clip(values, low, high) - values, -high))


def central_pair(x: Array, tau: Array, complementarity: float) -> tuple[Array, Array]:
    """The pair (s, z) inside the cones with s - tau z = x and s o z = complementarity e; tau (nc,).

    In the spectral values l of x: s = (l + root(l^2 + 4 complementarity tau)) / 2, and z likewise of -l."""
    size, room = tangential(x), 4.0 * complementarity * tau
    values = x[:, 0] + np.stack([size, -size])
    root = np.sqrt(values**2 + room)
    larger = 0.5 * (np.abs(values) + root)
    smaller = 0.25 * room / larger  # the product of both is room / 4; their difference would cancel
    s, z = np.where(values > 0, larger, smaller), np.where(values > 0, smaller, larger)
    return _of_spectrum(x, *s), _of_spectrum(-x, *z[::-1]) / tau[:, None]


def _of_spectrum(x: Array, high: Array, low: Array) -> Array:
    """The points (nc, 3) in the directions of x with other spectral values."""
    out = (0.5 * (high - low) / np.maximum(tangential(x), TINY))[:, None] * x
    out[:, 0] = 0.5 * (high + low)
    return out
