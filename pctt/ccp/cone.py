"""The friction cone |(g_1, g_2)| <= mu g_n and the arithmetic that the solvers need on it.

Impulses are arrays (nc, 3), one row per contact in the order (normal, tangent 1, tangent 2); ``mu`` is (nc,). Functions
marked ``compiled`` have a twin in ``cone_loops``.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pctt.compiled import compiled

Array = NDArray[np.float64]
TINY = float(np.finfo(float).tiny)


def project(x: Array, mu: Array, out: Array | None = None) -> Array:
    """Euclidean projection of each row on its friction cone; ``out`` may be x itself.

    >>> project(np.array([[1.0, 0.0, 1.0], [-1.0, 0.0, 0.1]]), np.array([1.0, 1.0]))
    array([[1., 0., 1.],
           [0., 0., 0.]])
    """
    return project_to(x, mu, np.empty_like(x) if out is None else out)


@compiled
def project_to(x: Array, mu: Array, out: Array) -> Array:
    normal, tangent_1, tangent_2 = x[:, 0], x[:, 1], x[:, 2]
    length = tangent_1 * tangent_1
    length += tangent_2 * tangent_2
    np.sqrt(length, out=length)
    # on the surface (n + mu t) / (1 + mu^2), which is below n inside the cone and below 0 in the polar cone
    height = mu * length
    height += normal
    height /= 1.0 + mu * mu
    np.maximum(height, normal, out=height)
    np.maximum(height, 0.0, out=height)
    out[:, 0] = height
    radius = np.multiply(mu, height, out=height)
    shrink = np.divide(radius, np.maximum(np.maximum(length, radius), TINY), out=radius)  # 1 inside
    np.multiply(tangent_1, shrink, out=out[:, 1])
    np.multiply(tangent_2, shrink, out=out[:, 2])
    return out


@compiled
def projected_move(x: Array, y: Array, step: float, mu: Array) -> Array:
    """P(x - step y) - x."""
    moved = y * -step
    moved += x
    project(moved, mu, out=moved)
    moved -= x
    return moved


@compiled
def accelerated_step(
    x: Array, last_x: Array, y: Array, last_y: Array, beta: float, step: float, mu: Array, opening: float, out: Array
) -> tuple[float, float]:
    """P(z - step y_z) for z = x + beta (x - last_x) and its gradient y_z = y + beta (y - last_y), to which the opening
    (mu |y_t|, 0, 0) is added once (``opening`` 1: Coulomb's law) or not (0).

    Returned are, for this rank, |out - z|^2 and y_z'(out - x); z and y_z themselves are nowhere stored."""
    z, y_z = _extrapolated(x, last_x, beta), _extrapolated(y, last_y, beta)
    if opening:
        add_opening(y_z, mu)
    np.multiply(y_z, -step, out=out)
    out += z
    project(out, mu, out=out)
    z -= out
    return float(np.vdot(z, z)), float(np.vdot(y_z, out - x))


@compiled
def accelerated_curvature(
    new_x: Array, x: Array, last_x: Array, new_y: Array, y: Array, last_y: Array, beta: float
) -> float:
    """d'Ad of the step d = new_x - z, from the same z and y_z and the gradient new_y at new_x; on this rank."""
    d, Ad = new_x - _extrapolated(x, last_x, beta), new_y - _extrapolated(y, last_y, beta)
    return float(np.vdot(d, Ad))


def _extrapolated(x: Array, last_x: Array, beta: float) -> Array:
    """x + beta (x - last_x)."""
    out = x - last_x
    out *= beta
    out += x
    return out


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


@compiled
def times(blocks: Array, x: Array) -> Array:
    """Products of blocks (nc, 3, 3) with rows. (Twice as fast as a batched matrix product.)"""
    return np.einsum("nij,nj->ni", blocks, x)


@compiled
def step_to_boundary(x: Array, dx: Array, mu: Array) -> float:
    """Largest a such that x + a dx is in the cones of this rank (inf where nothing limits it); x is inside.

    The smaller positive root of |x_t + a dx_t|^2 = mu^2 (x_n + a dx_n)^2, in the form that does not cancel,
    and the apex x_n + a dx_n = 0 (which alone limits a contact without friction).
    """
    quadratic = dx[:, 1] ** 2 + dx[:, 2] ** 2 - (mu * dx[:, 0]) ** 2
    linear = x[:, 1] * dx[:, 1] + x[:, 2] * dx[:, 2] - mu**2 * x[:, 0] * dx[:, 0]
    inside = margin(x, mu) * (mu * x[:, 0] + tangential(x))
    discriminant = linear**2 + quadratic * inside
    root = np.sqrt(np.maximum(discriminant, 0.0))
    to_surface = np.full_like(mu, np.inf)
    np.divide(inside, linear + root, out=to_surface, where=(linear > 0) & (discriminant >= 0))
    np.divide(root - linear, quadratic, out=to_surface, where=(linear <= 0) & (quadratic > 0) & (mu > 0))
    return float(np.minimum(to_surface.min(initial=np.inf), step_to_zero(x[:, 0], dx[:, 0])))


@compiled
def step_to_zero(x: Array, dx: Array) -> float:
    """Largest a such that x + a dx >= 0 on this rank, x > 0."""
    return np.divide(-x, dx, out=np.full_like(x, np.inf), where=dx < 0).min(initial=np.inf)
