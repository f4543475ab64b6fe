"""The friction cone |(g_1, g_2)| <= mu g_n and the arithmetic that the solvers need on it.

Impulses are arrays (nc, 3), one row per contact in the order (normal, tangent 1, tangent 2); ``mu`` is (nc,).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def project(x: Array, mu: Array) -> Array:
    """Euclidean projection of each row on its friction cone.

    >>> project(np.array([[1.0, 0.0, 1.0], [-1.0, 0.0, 0.1]]), np.array([1.0, 1.0]))
    array([[1., 0., 1.],
           [0., 0., 0.]])
    """
    normal = x[:, 0]
    tangential = np.hypot(x[:, 1], x[:, 2])
    on_surface = np.maximum(normal + mu * tangential, 0.0) / (1.0 + mu * mu)  # 0 in the polar cone
    inside = (tangential <= mu * normal) & (normal >= 0)  # mu normal is -0.0 without friction
    shorten = ~inside & (tangential > 0)
    shrink = np.divide(mu * on_surface, tangential, out=np.zeros_like(tangential), where=shorten)
    out = np.empty_like(x)
    out[:, 0] = np.where(inside, normal, on_surface)
    out[:, 1:] = x[:, 1:] * np.where(inside, 1.0, shrink)[:, None]
    return out


def margin(x: Array, mu: Array) -> Array:
    """mu g_n - |(g_1, g_2)|, positive inside the cone (nc,)."""
    return mu * x[:, 0] - np.hypot(x[:, 1], x[:, 2])


def step_to_boundary(x: Array, dx: Array, mu: Array) -> float:
    """Largest a such that x + a dx is in the cones of this rank (inf where nothing limits it); x is inside.

    The smaller positive root of |x_t + a dx_t|^2 = mu^2 (x_n + a dx_n)^2, in the form that does not cancel,
    and the apex x_n + a dx_n = 0 (which alone limits a contact without friction).
    """
    quadratic = dx[:, 1] ** 2 + dx[:, 2] ** 2 - (mu * dx[:, 0]) ** 2
    linear = x[:, 1] * dx[:, 1] + x[:, 2] * dx[:, 2] - mu**2 * x[:, 0] * dx[:, 0]
    inside = margin(x, mu) * (mu * x[:, 0] + np.hypot(x[:, 1], x[:, 2]))
    discriminant = linear**2 + quadratic * inside
    root = np.sqrt(np.maximum(discriminant, 0.0))
    to_surface = np.full_like(mu, np.inf)
    np.divide(inside, linear + root, out=to_surface, where=(linear > 0) & (discriminant >= 0))
    np.divide(root - linear, quadratic, out=to_surface, where=(linear <= 0) & (quadratic > 0) & (mu > 0))
    return min(to_surface.min(initial=np.inf), step_to_zero(x[:, 0], dx[:, 0]))


def step_to_zero(x: Array, dx: Array) -> float:
    """Largest a such that x + a dx >= 0 on this rank, x > 0."""
    return np.divide(-x, dx, out=np.full_like(x, np.inf), where=dx < 0).min(initial=np.inf)
