"""The accuracy of a solution: figures that judge every method, computed by code of their own, which no solver uses.

The projection below is numpy's, and not the solvers' loop, and y = N g is formed from the momentum of the bodies if
the problem has bodies. So a mistake in a solver's own arithmetic shows.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pctt.ccp.cone import Array, dot
from pctt.ccp.problem import ConeProblem


@dataclass(frozen=True)
class Accuracy:
    """Figures of an impulse g with velocities y = N g + r (see ``docs/ccp.md``).

    Attributes
    ----------
    natural_residual : ||g - P(g - s y)|| / ||g||, s = 1 / mean(diag N)
    coulomb_residual : the same with y_n + mu |y_t| for y_n: zero where impulses obey Coulomb's law (``coulomb.py``)
    objective : 1/2 g'Ng + r'g (J)
    cone_violation : largest distance |g_t| - mu g_n outside the friction cone (N s)
    dual_violation : largest distance mu |y_t| - y_n outside the dual cone (m/s)
    complementarity : largest |g.y| of a contact (J)
    closing_work : work of the normal impulses at contacts that still close, sum of g_n max(-y_n, 0), as a part of
        1/2 g'Ng; 0 without impulses. About as large as the relative error of the objective, or larger: as that is
        convex, f(g) - min f <= g'y + the work of optimal impulses on the velocities that y lacks to the dual cone
    opening_work : the same of the work of impulses on velocities along them, sum of max(g.y, 0): contacts that open
        though impulses push. The natural residual does not see it where bodies are much heavier than most
    impulse_norm, velocity_norm : ||g||, ||y||
    """

    natural_residual: float
    coulomb_residual: float
    objective: float
    cone_violation: float
    dual_violation: float
    complementarity: float
    closing_work: float
    opening_work: float
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
    natural = _residual(problem, g, y)
    closing = problem.dot(g[:, 0], np.maximum(-y[:, 0], 0.0))
    opening = problem.sum(np.maximum((g * y).sum(axis=1), 0.0).sum())
    energy = problem.dot(g, 0.5 * (y - problem.r))
    return Accuracy(
        natural_residual=natural,
        coulomb_residual=_residual(problem, g, with_opening),
        objective=problem.dot(g, 0.5 * (y + problem.r)),
        cone_violation=max(0.0, problem.max((tangential - problem.mu * g[:, 0]).max(initial=0.0))),
        dual_violation=max(0.0, problem.max((problem.mu * sliding - y[:, 0]).max(initial=0.0))),
        complementarity=problem.max(np.abs(dot(g, y)).max(initial=0.0)),
        closing_work=_part(closing, energy),
        opening_work=_part(opening, energy),
        impulse_norm=norm,
        velocity_norm=problem.norm(y),
    )


def _part(work: float, energy: float) -> float:
    """work / energy; 0 without impulses, inf if it is no number."""
    if energy <= 0:
        return 0.0
    part = work / energy
    return part if part == part else np.inf


def _residual(problem: ConeProblem, g: Array, y: Array) -> float:
    """||g - P(g - s y)|| / ||g|| of velocities y (nc, 3)."""
    distance = g - _nearest_in_cone(g - y / problem.mean_diagonal, problem.mu)
    return problem.norm(distance) / max(problem.norm(g), float(np.finfo(float).tiny))


def _nearest_in_cone(x: Array, mu: Array) -> Array:
    """Projection on the cone of slope mu, in the half plane of axis and point: the nearest point of the surface's ray,
    unless the point is inside."""
    tangential = np.hypot(x[:, 1], x[:, 2])
    ray_n, ray_t = 1 / np.hypot(1, mu), mu / np.hypot(1, mu)
    along = np.maximum(ray_n * x[:, 0] + ray_t * tangential, 0.0)
    inside = (x[:, 0] >= 0) & (tangential <= mu * x[:, 0])
    turn = np.divide(ray_t * along, tangential, out=np.zeros_like(along), where=tangential > 0)
    nearest = np.stack([ray_n * along, turn * x[:, 1], turn * x[:, 2]], axis=1)
    return np.where(inside[:, None], x, nearest)
