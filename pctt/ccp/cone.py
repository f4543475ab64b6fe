"""The friction cone |(g_1, g_2)| <= mu g_n and the arithmetic that the solvers need on it.

Impulses are arrays (nc, 3), one row per contact in the order (normal, tangent 1, tangent 2); ``mu`` is (nc,).

Loops take arrays of rows flat: so the compiler knows the distance from one contact to the next, and works on several at
once. Comparisons are written so that a NaN stays a NaN. Constants have single precision, so that loops on arrays of
single precision stay in it. They are exact in double precision too.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dem.compiled import inlined, loop, unfused

Array = NDArray[np.float64]
TINY = float(np.finfo(float).tiny)
ZERO, ONE = np.float32(0.0), np.float32(1.0)
STRIP = 256  # contacts whose numbers stay in the nearest cache from one loop to the next


def project(x: Array, mu: Array, out: Array | None = None) -> Array:
    """Euclidean projection of each row on its friction cone; ``out`` may be x itself.

    >>> project(np.array([[1.0, 0.0, 1.0], [-1.0, 0.0, 0.1]]), np.array([1.0, 1.0]))
    array([[1., 0., 1.],
           [0., 0., 0.]])
    """
    return project_to(x, mu, np.empty(x.shape, x.dtype) if out is None else out)


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
def projected_move(x: Array, y: Array, step: float, mu: Array) -> Array:
    """P(x - step y) - x."""
    out = np.empty(x.shape, x.dtype)
    way = x.dtype.type(step)
    x, y, to = x.ravel(), y.ravel(), out.reshape(out.size)
    for c in range(len(mu)):
        i = 3 * c
        n, t_1, t_2 = _nearest(x[i] - way * y[i], x[i + 1] - way * y[i + 1], x[i + 2] - way * y[i + 2], mu[c])
        to[i], to[i + 1], to[i + 2] = n - x[i], t_1 - x[i + 1], t_2 - x[i + 2]
    return out


@unfused
def accelerated_step(
    x: Array, last_x: Array, y: Array, last_y: Array, beta: float, step: float, mu: Array, opening: float, out: Array
) -> tuple[float, float]:
    """P(z - step y_z) for z = x + beta (x - last_x) and its gradient y_z = y + beta (y - last_y), to which the opening
    (mu |y_t|, 0, 0) is added once (``opening`` 1: Coulomb's law) or not (0).

    Returned are, for this rank, |out - z|^2 and y_z'(out - x); z and y_z themselves are nowhere stored."""
    part, way = x.dtype.type(beta), x.dtype.type(step)
    x, last_x, y, last_y, to = x.ravel(), last_x.ravel(), y.ravel(), last_y.ravel(), out.reshape(out.size)
    z, y_z = np.empty(3 * STRIP, x.dtype), np.empty(3 * STRIP, x.dtype)
    squares, products = np.zeros(3 * STRIP, x.dtype), np.zeros(3 * STRIP, x.dtype)
    for first in range(0, len(mu), STRIP):
        friction = mu[first : first + STRIP]
        a, b = 3 * first, 3 * (first + len(friction))
        _extrapolate(x[a:b], last_x[a:b], part, z)
        _extrapolate(y[a:b], last_y[a:b], part, y_z)
        if opening:
            _add_opening(y_z, friction)
        _step(z, y_z, way, friction, to[a:b])
        _add_squares(to[a:b], z, squares)
        _add_products(to[a:b], x[a:b], y_z, products)
    return squares.sum(), products.sum()


@unfused
def _extrapolate(x, last_x, beta, out):
    for k in range(len(x)):
        out[k] = x[k] + beta * (x[k] - last_x[k])


@unfused
def _add_opening(y, mu):
    for c in range(len(mu)):
        i = 3 * c
        y[i] += mu[c] * np.sqrt(y[i + 1] * y[i + 1] + y[i + 2] * y[i + 2])


@unfused
def _step(x, y, step, mu, out):
    for c in range(len(mu)):
        i = 3 * c
        n, t_1, t_2 = x[i] - step * y[i], x[i + 1] - step * y[i + 1], x[i + 2] - step * y[i + 2]
        out[i], out[i + 1], out[i + 2] = _nearest(n, t_1, t_2, mu[c])


@unfused
def _add_squares(x, y, sums):
    for k in range(len(x)):
        sums[k] += (x[k] - y[k]) ** 2


@unfused
def _add_products(x, y, z, sums):
    for k in range(len(x)):
        sums[k] += (x[k] - y[k]) * z[k]


@unfused
def accelerated_curvature(
    new_x: Array, x: Array, last_x: Array, new_y: Array, y: Array, last_y: Array, beta: float
) -> float:
    """d'Ad of the step d = new_x - z, from the same z and y_z and the gradient new_y at new_x; on this rank."""
    part = x.dtype.type(beta)
    new_x, x, last_x, new_y, y, last_y = (
        new_x.ravel(), x.ravel(), last_x.ravel(), new_y.ravel(), y.ravel(), last_y.ravel(),
    )  # fmt: skip
    d, products = np.empty(3 * STRIP, x.dtype), np.zeros(3 * STRIP, x.dtype)
    for i in range(0, len(x), 3 * STRIP):
        j = min(i + 3 * STRIP, len(x))
        _extrapolated_move(new_x[i:j], x[i:j], last_x[i:j], part, d)
        _add_extrapolated_work(new_y[i:j], y[i:j], last_y[i:j], part, d, products)
    return products.sum()


@unfused
def _extrapolated_move(new, x, last_x, beta, out):
    for k in range(len(x)):
        out[k] = new[k] - (x[k] + beta * (x[k] - last_x[k]))


@unfused
def _add_extrapolated_work(new, x, last_x, beta, d, sums):
    for k in range(len(x)):
        sums[k] += d[k] * (new[k] - (x[k] + beta * (x[k] - last_x[k])))


def add_opening(y: Array, mu: Array) -> Array:
    """y, in place, with mu |y_t| more in the normal direction: the velocity of De Saxce, for which a cone problem is
    Coulomb's law."""
    y[:, 0] += mu * tangential(y)
    return y


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
