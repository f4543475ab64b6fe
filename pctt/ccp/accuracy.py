"""The accuracy of a solution: figures that judge every method, computed by code of their own, which no solver uses.

The projection below goes through the angle in the (normal, tangential) half plane, and y = N g is formed from the
momentum of the bodies if the problem has bodies. So a mistake in a solver's own arithmetic shows.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pctt.ccp.cone import Array
from pctt.ccp.problem import ConeProblem


@dataclass(frozen=True)
class Accuracy:
    """Figures of an impulse g with velocities y = N g + r (see ``docs/ccp.md``).

    Attributes
    ----------
    natural_residual : ||g - P(g - s y)|| / ||g||, s = 1 / mean(diag N)
    rigid_residual : the same of the problem without its compliance
    coulomb_residual : the same with y_n + mu |y_t| for y_n: zero where impulses obey Coulomb's law (``coulomb.py``)
    objective : 1/2 g'Ng + r'g (J)
    cone_violation : largest distance |g_t| - mu g_n outside the friction cone (N s)
    dual_violation : largest distance mu |y_t| - y_n outside the dual cone (m/s)
    complementarity : largest |g.y| of a contact (J)
    impulse_norm, velocity_norm : ||g||, ||y||
    """

    natural_residual: float
    rigid_residual: float
    coulomb_residual: float
    objective: float
    cone_violation: float
    dual_violation: float
    complementarity: float
    impulse_norm: float
    velocity_norm: float


def measure(problem: ConeProblem, g: Array) -> Accuracy:
    """The figures of an impulse g (nc, 3), the same on every rank."""
    y = problem.product(g) + problem.r
    norm = problem.norm(g)
    tangential = np.hypot(g[:, 1], g[:, 2])
    sliding = np.hypot(y[:, 1], y[:, 2])
    with_opening = y.copy()
    with_opening[:, 0] += problem.mu * sliding
    return Accuracy(
        natural_residual=_residual(problem, g, y),
        rigid_residual=_residual(problem, g, y - problem.compliance * g),
        coulomb_residual=_residual(problem, g, with_opening),
        objective=problem.dot(g, 0.5 * (y + problem.r)),
        cone_violation=max(0.0, problem.max((tangential - problem.mu * g[:, 0]).max(initial=0.0))),
        dual_violation=max(0.0, problem.max((problem.mu * sliding - y[:, 0]).max(initial=0.0))),
        complementarity=problem.max(np.abs((g * y).sum(1)).max(initial=0.0)),
        impulse_norm=norm,
        velocity_norm=problem.norm(y),
    )


def _residual(problem: ConeProblem, g: Array, y: Array) -> float:
    """||g - P(g - s y)|| / ||g|| of velocities y (nc, 3)."""
    distance = g - _nearest_in_cone(g - y / problem.mean_diagonal, problem.mu)
    return problem.norm(distance) / max(problem.norm(g), float(np.finfo(float).tiny))


def _nearest_in_cone(x: Array, mu: Array) -> Array:
    """Projection on the cone of half angle atan(mu): turn a point to the cone's surface and shorten it."""
    radius = np.sqrt((x * x).sum(1))
    angle = np.arctan2(np.hypot(x[:, 1], x[:, 2]), x[:, 0])  # from the axis, 0 to pi
    half = np.arctan(mu)
    excess = np.maximum(angle - half, 0.0)
    # exactly zero in the polar cone, where the cosine of a rounded pi / 2 is not
    length = np.where(excess < np.pi / 2, radius * np.cos(excess), 0.0)
    turned = np.minimum(angle, half)
    azimuth = np.arctan2(x[:, 2], x[:, 1])
    flat = length * np.sin(turned)
    return np.stack([length * np.cos(turned), flat * np.cos(azimuth), flat * np.sin(azimuth)], axis=1)
