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

from dem.compiled import inlined, inner, loop
from dem.contact_map.loops import sum_of
from pctt.arrays import Array, tangential
from pctt.ccp.cones.base import Cones, Units, floats
from pctt.ccp.cones.friction import (
    NO_MOVE,
    NO_UNITS,
    ONE,
    STRIP,
    ZERO,
    add_compliance,
    add_products,
    add_squares,
    add_work,
    extrapolate,
    in_units,
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
    def _each(self) -> tuple[Array, Array, Array]:
        return self.mu, self.rolling, self.spinning

    @property
    def coefficients(self) -> Array:
        return np.stack(self._each)

    def scaled(self, size: Array, precision: type[np.floating]) -> RollingCones:
        """Spin and rolls have sizes of their own, so that discs stay discs."""
        forces, moments = np.split(size, 2)
        sizes = (self.mu, forces[:, 1]), (self.rolling, moments[:, 1]), (self.spinning, moments[:, 0])
        return RollingCones(*((each * along / forces[:, 0]).astype(precision, copy=False) for each, along in sizes))

    def only(self, contacts: NDArray[np.intp]) -> RollingCones:
        return RollingCones(self.mu[contacts], self.rolling[contacts], self.spinning[contacts])

    def project(self, x: Array, out: Array) -> Array:
        return project_to(x, *self._each, out)

    def errors(
        self, g: Array, y: Array, r: Array, step: float, coulomb: bool, units: Units | None = None
    ) -> tuple[Sequence[float], float]:
        found: tuple[Sequence[float], float]
        found = errors(g, y, r, step, self._each, float(coulomb), *(units or NO_UNITS))
        return found

    def de_saxce(self, y: Array) -> Array:
        forces, moments = np.split(y, 2)
        return self.mu * tangential(forces) + self.rolling * tangential(moments) + self.spinning * np.abs(moments[:, 0])

    def accelerated_step(
        self, x: Array, last_x: Array, y: Array, compliance: Array, beta: float, step: float, coulomb: bool, out: Array
    ) -> tuple[float, float, float]:
        return accelerated_step(x, last_x, y, compliance, beta, step, self._each, float(coulomb), out)


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


@inner
def _project(forces, moments, mu, rho, sigma):
    """Move the rows of both halves, flat, of contacts with these coefficients (n,) to the nearest points of their
    cones.

    At the height h the parts beyond their discs are pulled back to them, and h is the root of h - n - sum of mu_k max(
    size_k - mu_k h, 0): a least of eight lines that ascend, one for each choice of parts. So h is the greatest root of
    these lines: with rolling alone, inside, friction, rolling and both, and zero is the fifth case. Selections, as a
    processor could not predict branches."""
    for c in range(len(mu)):
        i = 3 * c
        n, u, v, spin, p, q = forces[i], forces[i + 1], forces[i + 2], moments[i], moments[i + 1], moments[i + 2]
        slid, rolled, spun = size_of(u, v), size_of(p, q), abs(spin)
        a, b, d = mu[c] * slid, rho[c] * rolled, sigma[c] * spun
        of_a, of_b, of_d = mu[c] * mu[c], rho[c] * rho[c], sigma[c] * sigma[c]
        height = ZERO if n < ZERO else n
        height = _larger(height, (n + a) / (ONE + of_a))
        height = _larger(height, (n + b) / (ONE + of_b))
        height = _larger(height, (n + d) / (ONE + of_d))
        height = _larger(height, (n + a + b) / (ONE + of_a + of_b))
        height = _larger(height, (n + a + d) / (ONE + of_a + of_d))
        height = _larger(height, (n + b + d) / (ONE + of_b + of_d))
        height = _larger(height, (n + a + b + d) / (ONE + of_a + of_b + of_d))
        along, about = _factor(mu[c] * height, slid), _factor(rho[c] * height, rolled)
        forces[i], forces[i + 1], forces[i + 2] = height, along * u, along * v
        moments[i] = _factor(sigma[c] * height, spun) * spin
        moments[i + 1], moments[i + 2] = about * p, about * q


@inner
def _add_de_saxce(y, turning, mu, rho, sigma):
    """Add the power that velocities of sliding, rolling and spinning lose for a unit of normal impulse."""
    for c in range(len(mu)):
        i = 3 * c
        slides, rolls, spins = size_of(y[i + 1], y[i + 2]), size_of(turning[i + 1], turning[i + 2]), abs(turning[i])
        y[i] += mu[c] * slides + rho[c] * rolls + sigma[c] * spins


@inner
def _move(x, y, step, out):
    for k in range(len(x)):
        out[k] = x[k] - step * y[k]


@loop
def project_to(x: Array, mu: Array, rho: Array, sigma: Array, out: Array) -> Array:
    """The nearest points (2 nc, 3) of the cones, into ``out``, which may be x."""
    out[:] = x
    to, half = out.reshape(out.size), 3 * len(mu)
    _project(to[:half], to[half:], mu, rho, sigma)
    return out


@loop
def accelerated_step(
    x: Array, last_x: Array, y: Array, compliance: Array, beta: float, step: float,
    coefficients: tuple[Array, Array, Array], de_saxce: float, out: Array,
) -> tuple[float, float, float]:  # fmt: skip
    """`pctt.ccp.cones.friction.accelerated_step` for these cones: both halves of the rows go through strips."""
    mu, rho, sigma = coefficients
    count, soft, part, step_length = len(mu), len(compliance) > 0, x.dtype.type(beta), x.dtype.type(step)
    x, last_x, y, compliance, to = x.ravel(), last_x.ravel(), y.ravel(), compliance.ravel(), out.reshape(out.size)
    room = 3 * STRIP
    z, y_z, turned = np.empty(room, x.dtype), np.empty(room, x.dtype), np.empty(room, x.dtype)
    squares, products, work = np.zeros(room, x.dtype), np.zeros(room, x.dtype), np.zeros(room, x.dtype)
    for first in range(0, count, STRIP):
        end = min(first + STRIP, count)
        forces, moments = slice(3 * first, 3 * end), slice(3 * (count + first), 3 * (count + end))
        each, turning = (mu[first:end], rho[first:end], sigma[first:end]), y[moments]
        extrapolate(x[forces], last_x[forces], part, z)
        extrapolate(x[moments], last_x[moments], part, turned)
        if soft:
            add_compliance(y[forces], compliance[forces], z, y_z)
        else:
            y_z[: 3 * (end - first)] = y[forces]
        if de_saxce:
            _add_de_saxce(y_z, turning, *each)
        new, new_turned = to[forces], to[moments]
        _move(z[: len(new)], y_z, step_length, new)
        _move(turned[: len(new)], turning, step_length, new_turned)
        _project(new, new_turned, *each)
        add_squares(new, z, squares)
        add_squares(new_turned, turned, squares)
        add_products(new, x[forces], y_z, products)
        add_products(new_turned, x[moments], turning, products)
        if soft:
            add_work(new, z, compliance[forces], work)
    return sum_of(work), sum_of(squares), sum_of(products)


@loop
def errors(
    x: Array, y: Array, r: Array, step: float, coefficients: tuple[Array, Array, Array], de_saxce: float, unit: float,
    size: Array,
) -> tuple[tuple[float, float, float, float, float], float]:  # fmt: skip
    """`pctt.ccp.cones.friction.errors` for these cones."""
    mu, rho, sigma = coefficients
    count, scaled, room = len(mu), len(size) > 0, 3 * min(STRIP, len(mu))
    x, y, r, size = x.ravel(), y.ravel(), r.ravel(), size.ravel()
    sums, most = np.zeros((5, STRIP)), np.zeros(STRIP)
    g, v, turned, turning = np.empty(room), np.empty(room), np.empty(room), np.empty(room)
    to, to_turned, y_z = np.empty(room), np.empty(room), np.empty(room)
    for first in range(0, count, STRIP):
        end = min(first + STRIP, count)
        forces, moments, length = slice(3 * first, 3 * end), slice(3 * (count + first), 3 * (count + end)), end - first
        each = mu[first:end], rho[first:end], sigma[first:end]
        if scaled:
            in_units(x[forces], y[forces], unit, size[forces], g, v)
            in_units(x[moments], y[moments], unit, size[moments], turned, turning)
        else:
            g[: 3 * length], v[: 3 * length] = x[forces], y[forces]
            turned[: 3 * length], turning[: 3 * length] = x[moments], y[moments]
        y_z[:] = v
        if de_saxce:
            _add_de_saxce(y_z, turning, *each)
        _move(g, y_z, step, to)
        _move(turned, turning, step, to_turned)
        _project(to, to_turned, *each)
        _add_moves((to, to_turned), (g, turned), (v, turning), step, length, sums[0])
        _add_works((g, turned), (v, turning), (r[forces], r[moments]), length, sums, most)
    greatest = 0.0
    for k in range(STRIP):
        greatest = most[k] if most[k] > greatest or most[k] != most[k] else greatest
    return (sum_of(sums[0]), sum_of(sums[1]), sum_of(sums[2]), sum_of(sums[3]), sum_of(sums[4])), greatest


@inner
def _add_moves(to, x, y, step, count, squares):
    (f, m), (g, t), (v, w) = to, x, y
    for c in range(count):
        i, square, speed = 3 * c, 0.0, 0.0
        for k in range(i, i + 3):
            square += (f[k] - g[k]) ** 2 + (m[k] - t[k]) ** 2
            speed += v[k] ** 2 + w[k] ** 2
        squares[c] += 0.0 if square <= NO_MOVE * (step * step) * speed else square


@inner
def _add_works(x, y, r, count, sums, most):
    (g, t), (v, w), (free, turning) = x, y, r
    for c in range(count):
        i, square, along, given = 3 * c, 0.0, 0.0, 0.0
        for k in range(i, i + 3):
            square += g[k] ** 2 + t[k] ** 2
            along += g[k] * v[k] + t[k] * w[k]
            given += g[k] * free[k] + t[k] * turning[k]
        closing = 0.0 if v[i] > 0.0 else -v[i]
        sums[1, c] += square
        sums[2, c] += g[i] * closing
        sums[3, c] += 0.0 if along < 0.0 else along
        sums[4, c] += 0.5 * (along - given)
        most[c] = closing if closing > most[c] or closing != closing else most[c]
