"""The friction cones |(g_1, g_2)| <= mu g_n, their compiled loops, and arithmetic on rows of three numbers.

Impulses are arrays (nc, 3), one row per contact in the order (normal, tangent 1, tangent 2); ``mu`` is (nc,).

Compiled loops take arrays of rows flat: so the compiler knows the distance from one contact to the next, and works on
several at once. Comparisons are written so that a NaN stays a NaN. Constants have single precision, so that loops on
arrays of single precision stay in it. They are exact in double precision too.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from dem.compiled import PART, inlined, inner, loop, prange
from dem.contact_map.loops import sum_of
from pctt.arrays import Array, tangential
from pctt.ccp.cones.base import Cones, Units, floats

NO_UNITS = 1.0, np.empty((0, 3))
ZERO, ONE = np.float32(0.0), np.float32(1.0)
STRIP, PIECE = 256, 128  # contacts whose numbers stay in the nearest cache from one loop to the next; of their sums
NO_MOVE = 64.0 * float(np.finfo(float).eps) ** 2  # (8 eps)^2: |move|^2 / |step y|^2 that rounding makes


@inlined
def _nearest(n, t_1, t_2, mu):
    """The nearest point of a cone, by selections: a processor could not predict branches."""
    length = np.sqrt(t_1 * t_1 + t_2 * t_2)
    height = (mu * length + n) * (ONE / (ONE + mu * mu))
    height = n if height < n else height
    height = ZERO if height < ZERO else height
    radius = mu * height
    reach = radius if length < radius else length
    shrink = radius / (ONE if reach == ZERO else reach)
    return height, t_1 * shrink, t_2 * shrink


@loop
def project_to(x: Array, mu: Array, out: Array) -> Array:
    """`project` into ``out``, which is C-contiguous."""
    flat, to = x.ravel(), out.reshape(out.size)
    for c in range(len(mu)):
        i = 3 * c
        to[i], to[i + 1], to[i + 2] = _nearest(flat[i], flat[i + 1], flat[i + 2], mu[c])
    return out


@loop
def _scaled(mu: Array, size: Array, out: Array) -> Array:
    """The coefficients of unknowns multiplied by ``size`` (nc, 3), in the precision of ``out``."""
    for c in range(len(mu)):
        out[c] = mu[c] * size[c, 1] / size[c, 0]
    return out


@loop
def active(x: Array, last_x: Array, y: Array, mu: Array, least: float) -> NDArray[np.bool_]:
    """The loop of `FrictionCones.active`."""
    out, enough = np.empty(len(mu), np.bool_), x.dtype.type(least)
    x, last_x, y = x.ravel(), last_x.ravel(), y.ravel()
    for c in range(len(mu)):
        i = 3 * c
        opening = y[i] - mu[c] * np.sqrt(y[i + 1] * y[i + 1] + y[i + 2] * y[i + 2])
        out[c] = (x[i] > 0) | (last_x[i] > 0) | (not opening > enough)
    return out


@loop
def errors(
    x: Array, y: Array, r: Array, step: float, mu: Array, de_saxce: float, unit: float, size: Array
) -> tuple[tuple[float, float, float, float, float], float]:
    """Five sums over the contacts, and the greatest -y_n, or 0.

    The sums are of |P(x - step y) - x|^2, where y gets the term (mu |y_t|, 0, 0) of De Saxce if ``de_saxce`` is 1, and
    below the rounding of step y it is zero: a contact that slides has 0 = P(-step y) only up to that; of |x|^2; and
    closing work, opening work and 1/2 x.(y - r).

    With the sizes (nc, 3) of the unknowns, if there are any, x and y have the units unit / size and unit size."""
    room = _room(len(mu), STRIP)
    sums, most = np.zeros((5, room)), np.zeros(room)
    g, v, scaled = np.empty(3 * room), np.empty(3 * room), len(size) > 0
    x, y, r, size = x.ravel(), y.ravel(), r.ravel(), size.ravel()
    for first in range(0, len(mu), STRIP):
        friction = mu[first : first + STRIP]
        a, b = 3 * first, 3 * (first + len(friction))
        if scaled:
            in_units(x[a:b], y[a:b], unit, size[a:b], g, v)
        else:
            g[: b - a], v[: b - a] = x[a:b], y[a:b]
        _add_moves(g, v, step, friction, de_saxce, sums[0])
        _add_works(g, v, r[a:b], len(friction), sums[1], sums[2], sums[3], sums[4], most)
    greatest = 0.0
    for k in range(room):
        greatest = most[k] if most[k] > greatest or most[k] != most[k] else greatest
    return (sum_of(sums[0]), sum_of(sums[1]), sum_of(sums[2]), sum_of(sums[3]), sum_of(sums[4])), greatest


@inlined
def _room(count, most):
    """The whole pieces that hold so many numbers, or the `most`: of few contacts no zeros are added up."""
    return min(most, (count + PIECE - 1) // PIECE * PIECE)


@inner
def in_units(x, y, unit, size, g, v):
    for k in range(len(x)):
        g[k], v[k] = x[k] * (unit / size[k]), y[k] * (unit * size[k])


@inner
def _add_moves(x, y, step, mu, de_saxce, squares):
    """Comparisons, here and below, let a NaN through."""
    for c in range(len(mu)):
        i, m = 3 * c, mu[c]
        n, u, v, y_n, y_u, y_v = x[i], x[i + 1], x[i + 2], y[i], y[i + 1], y[i + 2]
        w = y_n + de_saxce * m * np.sqrt(y_u * y_u + y_v * y_v)
        to_n, to_u, to_v = _nearest(n - step * w, u - step * y_u, v - step * y_v, m)
        square = (to_n - n) ** 2 + (to_u - u) ** 2 + (to_v - v) ** 2
        squares[c] += 0.0 if square <= NO_MOVE * (step * step) * (y_n * y_n + y_u * y_u + y_v * y_v) else square


@inner
def _add_works(x, y, r, count, squares, closings, openings, energies, most):
    """In a loop of its own: a compiler makes vectors of two short loops, and not of a long one."""
    for c in range(count):
        i = 3 * c
        n, u, v, y_n, y_u, y_v = x[i], x[i + 1], x[i + 2], y[i], y[i + 1], y[i + 2]
        along = n * y_n + u * y_u + v * y_v
        closing = 0.0 if y_n > 0.0 else -y_n
        squares[c] += n * n + u * u + v * v
        closings[c] += n * closing
        openings[c] += 0.0 if along < 0.0 else along
        energies[c] += 0.5 * (along - (n * r[i] + u * r[i + 1] + v * r[i + 2]))
        most[c] = closing if closing > most[c] or closing != closing else most[c]


@loop
def accelerated_step(
    x: Array, last_x: Array, y: Array, compliance: Array, beta: float, step: float, mu: Array, de_saxce: float,
    out: Array,
) -> tuple[float, float, float]:  # fmt: skip
    """P(z - step y_z) for z = x + beta (x - last_x) and its gradient y_z = y + C z, to which the term (mu |y_t|, 0, 0)
    of De Saxce is added once (``de_saxce`` 1: Coulomb's law) or not (0). ``compliance`` has the diagonal of C (nc, 3),
    or no row for C = 0.

    Returned are, for the contacts of this rank, d'Cd and |d|^2 of d = out - z, and y_z'(out - x), sums of parts; z and
    y_z are nowhere stored. A contact moves 64 bytes in single precision, 52 without compliance."""
    part, step_length, soft, count = x.dtype.type(beta), x.dtype.type(step), len(compliance) > 0, len(mu)
    x, last_x, y, compliance, to = x.ravel(), last_x.ravel(), y.ravel(), compliance.ravel(), out.reshape(out.size)
    sums, room = np.zeros(((count + PART - 1) // PART, 3)), _room(3 * count, 3 * STRIP)
    for k in prange(len(sums)):
        z, y_z, squares = np.empty(room, x.dtype), np.empty(room, x.dtype), np.zeros(room, x.dtype)
        products, work = np.zeros(room, x.dtype), np.zeros(room, x.dtype)
        for first in range(k * PART, min(k * PART + PART, count), STRIP):
            friction = mu[first : first + STRIP]
            a, b = 3 * first, 3 * (first + len(friction))
            extrapolate(x[a:b], last_x[a:b], part, z)
            if soft:
                add_compliance(y[a:b], compliance[a:b], z, y_z)
            else:
                y_z[: b - a] = y[a:b]
            if de_saxce:
                _add_de_saxce(y_z, friction)
            _step(z, y_z, step_length, friction, to[a:b])
            add_squares(to[a:b], z, squares)
            add_products(to[a:b], x[a:b], y_z, products)
            if soft:
                add_work(to[a:b], z, compliance[a:b], work)
        sums[k] = sum_of(work), sum_of(squares), sum_of(products)
    total_work, square, product = 0.0, 0.0, 0.0
    for k in range(len(sums)):
        total_work, square, product = total_work + sums[k, 0], square + sums[k, 1], product + sums[k, 2]
    return total_work, square, product


@inner
def extrapolate(x, last_x, beta, out):
    for k in range(len(x)):
        out[k] = x[k] + beta * (x[k] - last_x[k])


@inner
def add_compliance(y, compliance, z, out):
    for k in range(len(y)):
        out[k] = y[k] + compliance[k] * z[k]


@inner
def add_work(x, y, compliance, sums):
    for k in range(len(x)):
        sums[k] += compliance[k] * (x[k] - y[k]) ** 2


@inner
def _add_de_saxce(y, mu):
    for c in range(len(mu)):
        i = 3 * c
        y[i] += mu[c] * np.sqrt(y[i + 1] * y[i + 1] + y[i + 2] * y[i + 2])


@inner
def _step(x, y, step, mu, out):
    for c in range(len(mu)):
        i = 3 * c
        n, t_1, t_2 = x[i] - step * y[i], x[i + 1] - step * y[i + 1], x[i + 2] - step * y[i + 2]
        out[i], out[i + 1], out[i + 2] = _nearest(n, t_1, t_2, mu[c])


@inner
def add_squares(x, y, sums):
    for k in range(len(x)):
        sums[k] += (x[k] - y[k]) ** 2


@inner
def add_products(x, y, z, sums):
    for k in range(len(x)):
        sums[k] += (x[k] - y[k]) * z[k]


@loop
def times(blocks: Array, x: Array) -> Array:
    """Products of blocks (nc, 3, 3) with rows. (Twice as fast as a batched matrix product.)"""
    out = np.empty_like(x)
    for c in range(len(x)):
        n, t_1, t_2 = x[c, 0], x[c, 1], x[c, 2]
        for i in range(3):
            out[c, i] = blocks[c, i, 0] * n + blocks[c, i, 1] * t_1 + blocks[c, i, 2] * t_2
    return out


@loop
def step_to_boundary(x: Array, dx: Array, mu: Array) -> float:
    """Largest a such that x + a dx is in the cones of this rank (inf where nothing limits it); x is inside.

    The smaller positive root of |x_t + a dx_t|^2 = mu^2 (x_n + a dx_n)^2, in the form that does not cancel,
    and the apex x_n + a dx_n = 0 (which alone limits a contact without friction).
    """
    x, dx = x.ravel(), dx.ravel()
    least = np.inf
    for c in range(len(mu)):
        i, m = 3 * c, mu[c]
        n, t_1, t_2 = x[i], x[i + 1], x[i + 2]
        dn, dt_1, dt_2 = dx[i], dx[i + 1], dx[i + 2]
        size = np.sqrt(t_1 * t_1 + t_2 * t_2)
        quadratic = dt_1 * dt_1 + dt_2 * dt_2 - (m * dn) ** 2
        linear = t_1 * dt_1 + t_2 * dt_2 - m * m * n * dn
        inside = (m * n - size) * (m * n + size)
        discriminant = linear * linear + quadratic * inside
        step = np.inf
        if linear > 0 and discriminant >= 0:
            step = inside / (linear + np.sqrt(discriminant))
        elif linear <= 0 and quadratic > 0 and m > 0:
            step = (np.sqrt(max(discriminant, 0.0)) - linear) / quadratic
        if dn < 0 and not -n / dn >= step:
            step = -n / dn
        if not step >= least:
            least = step
            if step != step:  # no other is smaller
                break
    return least


@loop
def step_to_zero(x: Array, dx: Array) -> float:
    """Largest a such that x + a dx >= 0 on this rank, x > 0."""
    least = np.inf
    for c in range(len(x)):
        if dx[c] < 0 and not -x[c] / dx[c] >= least:
            least = -x[c] / dx[c]
            if least != least:
                break
    return least


def project(x: Array, mu: Array, out: Array | None = None) -> Array:
    """Euclidean projection of each row on its friction cone; ``out`` may be x itself.

    >>> project(np.array([[1.0, 0.0, 1.0], [-1.0, 0.0, 0.1]]), np.array([1.0, 1.0]))
    array([[1., 0., 1.],
           [0., 0., 0.]])
    """
    return project_to(x, mu, np.empty(x.shape, x.dtype) if out is None else out)


class FrictionCones(Cones):
    """The cones |g_t| <= mu g_n hold the impulses of contacts with friction ``mu`` (count,)."""

    parts, tangents, what = 1, ((1, 2),), "friction"

    def __init__(self, mu: Array):
        self.mu = floats(mu)
        self.count = len(self.mu)

    @property
    def coefficients(self) -> Array:
        return self.mu[None]

    def times(self, blocks: Array, x: Array) -> Array:
        return times(blocks, x)

    def scaled(self, size: Array, precision: type[np.floating]) -> FrictionCones:
        return FrictionCones(_scaled(self.mu, size, np.empty(self.count, precision)))

    def only(self, contacts: NDArray[np.intp]) -> FrictionCones:
        return FrictionCones(self.mu[contacts])

    def project(self, x: Array, out: Array) -> Array:
        return project_to(x, self.mu, out)

    def de_saxce(self, y: Array) -> Array:
        return self.mu * tangential(y)

    def accelerated_step(
        self, x: Array, last_x: Array, y: Array, compliance: Array, beta: float, step: float, coulomb: bool, out: Array
    ) -> tuple[float, float, float]:
        return accelerated_step(x, last_x, y, compliance, beta, step, self.mu, float(coulomb), out)

    def errors(
        self, g: Array, y: Array, r: Array, step: float, coulomb: bool, units: Units | None = None
    ) -> tuple[Sequence[float], float]:
        found: tuple[Sequence[float], float]
        found = errors(g, y, r, step, self.mu, float(coulomb), *(units or NO_UNITS))
        return found

    def active(self, x: Array, last_x: Array, y: Array, least: float) -> NDArray[np.bool_]:
        return active(x, last_x, y, self.mu, least)

    def step_length(self, x: Array, dx: Array) -> float:
        return step_to_boundary(x, dx, self.mu)
