"""Cone problems with resistance to rolling and spinning.

A contact has six numbers: normal and tangential impulses, a moment about the normal and one about the tangents, in
units of force times a length of the contact (`dem.contact_map.TurningMap`). The cone is

    |g_t| <= mu g_n,    |m_roll| <= rho g_n,    |m_spin| <= sigma g_n,

and its dual has y_n >= mu |y_t| + rho |w_roll| + sigma |w_spin|, with the velocities w that do work on the moments.
Coulomb's law is the complementarity of both, with this sum added to y_n (De Saxce's term): each of the three resists
against its own velocity, and nothing opens that slides, rolls or spins. Without the sum, in the relaxation, it does.
Source: Acary, Bourrier, "Coulomb friction with rolling resistance as a cone complementarity problem", Eur. J. Mech.
A/Solids 85 (2021), for the cone of friction and rolling.

Arrays of contacts are (2 nc, 3): (normal, tangents) of all contacts, then (spin, rolls).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from dem.compiled import inlined, loop
from pctt.arrays import Array, tangential
from pctt.ccp.cones.base import Cones, Units, floats
from pctt.ccp.cones.friction import (
    NO_MOVE,
    ONE,
    STRIP,
    ZERO,
    add_compliance,
    add_products,
    add_squares,
    add_work,
    extrapolate,
)


class RollingCones(Cones):
    """The cones hold impulses and moments of contacts with coefficients (count,): ``mu`` of friction, ``rolling`` and
    ``spinning``, of which the last two are lengths over those of the contacts."""

    parts, tangents, what = 2, ((1, 2), (4, 5), (3,)), "rolling or spinning resistance"

    def __init__(self, mu: Array, rolling: Array, spinning: Array):
        self.mu, self.rolling, self.spinning = (floats(each) for each in (mu, rolling, spinning))
        self.count = len(self.mu)

    def named(self) -> list[tuple[str, Array]]:
        return [("mu", self.mu), ("rolling", self.rolling), ("spinning", self.spinning)]

    @property
    def coefficients(self) -> Array:
        return np.stack([self.mu, self.rolling, self.spinning])

    def scaled(self, size: Array, precision: type[np.floating]) -> RollingCones:
        """Spin and rolls have sizes of their own, so that discs stay discs."""
        forces, moments = np.split(size, 2)
        sizes = (self.mu, forces[:, 1]), (self.rolling, moments[:, 1]), (self.spinning, moments[:, 0])
        return RollingCones(*((each * along / forces[:, 0]).astype(precision, copy=False) for each, along in sizes))

    def only(self, contacts: NDArray[np.intp]) -> RollingCones:
        return RollingCones(self.mu[contacts], self.rolling[contacts], self.spinning[contacts])

    def project(self, x: Array, out: Array) -> Array:
        return project_to(x, self.mu, self.rolling, self.spinning, out)

    @np.errstate(over="ignore", invalid="ignore")  # impulses may be no numbers
    def errors(
        self, g: Array, y: Array, r: Array, step: float, coulomb: bool, units: Units | None = None
    ) -> tuple[Sequence[float], float]:
        if units is not None:
            unit, size = units
            g, y = g * (unit / size), y * (unit * size)
        both = self.move(g, y, step, coulomb), step * y
        move, speed = (np.square(z).sum(axis=1).reshape(2, -1).sum(axis=0) for z in both)
        normal, push = y[: self.count, 0], g[: self.count, 0]
        power = (g * y).sum(axis=1).reshape(2, -1).sum(axis=0)
        closing = np.maximum(-normal, 0.0)
        works = push @ closing, np.maximum(power, 0.0).sum(), 0.5 * np.vdot(g, y - r)
        sums = [float(each) for each in (move[~(move <= NO_MOVE * speed)].sum(), np.vdot(g, g), *works)]
        return sums, float(closing.max(initial=0.0))

    def de_saxce(self, y: Array) -> Array:
        forces, moments = np.split(y, 2)
        return self.mu * tangential(forces) + self.rolling * tangential(moments) + self.spinning * np.abs(moments[:, 0])

    def accelerated_step(
        self, x: Array, last_x: Array, y: Array, compliance: Array, beta: float, step: float, coulomb: bool, out: Array
    ) -> tuple[float, float, float]:
        coefficients = self.mu, self.rolling, self.spinning
        return accelerated_step(x, last_x, y, compliance, beta, step, coefficients, float(coulomb), out)


@inlined
def nearest(n, tangential, roll, spin, mu, rho, sigma):
    """The normal part of the nearest point of a cone, and the factors of the other three parts, whose sizes are given.

    At the height h the parts beyond their discs are pulled back to them, and h is the root of h - n - sum of mu_k max(
    size_k - mu_k h, 0): a least of eight lines that ascend, one for each choice of parts. So h is the greatest root of
    these lines: with rolling alone, inside, friction, rolling and both, and zero is the fifth case. Selections, as a
    processor could not predict branches."""
    a, b, c = mu * tangential, rho * roll, sigma * spin
    of_a, of_b, of_c = mu * mu, rho * rho, sigma * sigma
    height = ZERO if n < ZERO else n
    height = _larger(height, (n + a) / (ONE + of_a))
    height = _larger(height, (n + b) / (ONE + of_b))
    height = _larger(height, (n + c) / (ONE + of_c))
    height = _larger(height, (n + a + b) / (ONE + of_a + of_b))
    height = _larger(height, (n + a + c) / (ONE + of_a + of_c))
    height = _larger(height, (n + b + c) / (ONE + of_b + of_c))
    height = _larger(height, (n + a + b + c) / (ONE + of_a + of_b + of_c))
    return height, _factor(mu * height, tangential), _factor(rho * height, roll), _factor(sigma * height, spin)


@inlined
def _larger(x, y):
    return y if not y <= x else x  # a NaN stays


@inlined
def _factor(radius, size):
    reach = radius if size < radius else size
    return radius / (ONE if reach == ZERO else reach) if size > radius else ONE


@inlined
def size_of(x, y):
    return np.sqrt(x * x + y * y)


@loop
def project_to(x: Array, mu: Array, rho: Array, sigma: Array, out: Array) -> Array:
    """The nearest points (2 nc, 3) of the cones, into ``out``, which may be x."""
    count = len(sigma)
    for c in range(count):
        d = count + c
        tangential, roll, spin = size_of(x[c, 1], x[c, 2]), size_of(x[d, 1], x[d, 2]), abs(x[d, 0])
        n, t, r, s = nearest(x[c, 0], tangential, roll, spin, mu[c], rho[c], sigma[c])
        out[c, 0], out[c, 1], out[c, 2] = n, t * x[c, 1], t * x[c, 2]
        out[d, 0], out[d, 1], out[d, 2] = s * x[d, 0], r * x[d, 1], r * x[d, 2]
    return out


@loop
def accelerated_step(
    x: Array, last_x: Array, y: Array, compliance: Array, beta: float, step: float,
    coefficients: tuple[Array, Array, Array], de_saxce: float, out: Array,
) -> tuple[float, float, float]:  # fmt: skip
    """`pctt.ccp.cones.friction.accelerated_step` for these cones: both halves of the rows go through strips."""
    mu, rho, sigma = coefficients
    count, soft = len(sigma), len(compliance) > 0
    part, step_length, saxce = x.dtype.type(beta), x.dtype.type(step), x.dtype.type(de_saxce)
    x, last_x, y, compliance, to = x.ravel(), last_x.ravel(), y.ravel(), compliance.ravel(), out.reshape(out.size)
    z, y_z, turns = np.empty(3 * STRIP, x.dtype), np.empty(3 * STRIP, x.dtype), np.empty(3 * STRIP, x.dtype)
    squares, products = np.zeros(3 * STRIP, x.dtype), np.zeros(3 * STRIP, x.dtype)
    work = np.zeros(3 * STRIP, x.dtype)
    for first in range(0, count, STRIP):
        here = sigma[first : first + STRIP]
        friction, rolling = mu[first : first + len(here)], rho[first : first + len(here)]
        a, b = 3 * first, 3 * (first + len(here))
        d, e = a + 3 * count, b + 3 * count
        extrapolate(x[a:b], last_x[a:b], part, z)
        extrapolate(x[d:e], last_x[d:e], part, turns)
        if soft:
            add_compliance(y[a:b], compliance[a:b], z, y_z)
        else:
            y_z[: b - a] = y[a:b]
        _add_de_saxce(y_z, y[d:e], saxce, friction, rolling, here)
        _step(z, y_z, turns, y[d:e], step_length, (friction, rolling, here), to[a:b], to[d:e])
        add_squares(to[a:b], z, squares)
        add_squares(to[d:e], turns, squares)
        add_products(to[a:b], x[a:b], y_z, products)
        add_products(to[d:e], x[d:e], y[d:e], products)
        if soft:
            add_work(to[a:b], z, compliance[a:b], work)
    return work.sum(), squares.sum(), products.sum()


@loop
def _add_de_saxce(y, turns, saxce, mu, rho, sigma):
    for c in range(len(mu)):
        i = 3 * c
        resisted = mu[c] * size_of(y[i + 1], y[i + 2]) + rho[c] * size_of(turns[i + 1], turns[i + 2])
        y[i] += saxce * (resisted + sigma[c] * abs(turns[i]))


@loop
def _step(x, y, turned, turning, step, coefficients, out, moments):
    mu, rho, sigma = coefficients
    for c in range(len(mu)):
        i = 3 * c
        p0, p1, p2 = x[i] - step * y[i], x[i + 1] - step * y[i + 1], x[i + 2] - step * y[i + 2]
        p3, p4 = turned[i] - step * turning[i], turned[i + 1] - step * turning[i + 1]
        p5 = turned[i + 2] - step * turning[i + 2]
        n, t, r, s = nearest(p0, size_of(p1, p2), size_of(p4, p5), abs(p3), mu[c], rho[c], sigma[c])
        out[i], out[i + 1], out[i + 2] = n, t * p1, t * p2
        moments[i], moments[i + 1], moments[i + 2] = s * p3, r * p4, r * p5
