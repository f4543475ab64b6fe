"""The accuracy of a solution: figures that judge every method, computed by code of their own, which no solver uses.

The projection below is not the solvers', and y = N g is a product of its own. So a mistake in a solver's own arithmetic
shows.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pctt.ccp.cone import Array
from pctt.ccp.problem import ConeProblem
from pctt.ccp.rolling import RollingProblem


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


@np.errstate(over="ignore", invalid="ignore")  # impulses may be no numbers
def measure(problem: ConeProblem, g: Array) -> Accuracy:
    """The figures of an impulse g (nc, 3), the same on every rank."""
    y = problem.product(g) + problem.r
    most = problem.mu[None]
    if isinstance(problem, RollingProblem):
        most = np.concatenate([problem.mu.reshape(2, -1), problem.spinning[None]])
    count = most.shape[1]
    (g_n, sizes), (y_n, speeds) = _parts(g, most), _parts(y, most)
    resisted, along = (most * speeds).sum(axis=0), (g * y).sum(axis=1)
    along = along[:count] + (along[count:] if len(along) > count else 0.0)
    target = g - y / problem.mean_diagonal
    natural = ((_nearest(target, most) - g) ** 2).sum()
    target[:count, 0] -= resisted / problem.mean_diagonal
    coulomb = ((_nearest(target, most) - g) ** 2).sum()
    sums = [
        np.vdot(g, g), np.vdot(y, y), np.vdot(g, y + problem.r), np.vdot(g, y - problem.r),
        g_n @ np.maximum(-y_n, 0.0), np.maximum(along, 0.0).sum(), natural, coulomb,
    ]  # fmt: skip
    greatest = [np.max(x, initial=0.0) for x in (sizes - most * g_n, resisted - y_n, np.abs(along))]
    square, speed, power, pushed, closing, opening, natural, coulomb = problem.sum(np.array(sums)).tolist()
    cone, dual, complementarity = problem.max(np.array(greatest)).tolist()
    norm, energy = float(np.sqrt(square)), 0.5 * pushed
    per = 1.0 / max(norm, float(np.finfo(float).tiny))
    return Accuracy(
        natural_residual=float(np.sqrt(natural)) * per,
        coulomb_residual=float(np.sqrt(coulomb)) * per,
        objective=0.5 * power,
        cone_violation=cone,
        dual_violation=dual,
        complementarity=complementarity,
        closing_work=_part(closing, energy),
        opening_work=_part(opening, energy),
        impulse_norm=norm,
        velocity_norm=float(np.sqrt(speed)),
    )


def _part(work: float, energy: float) -> float:
    """work / energy; 0 without impulses, inf if it is no number."""
    if energy <= 0:
        return 0.0
    part = work / energy
    return part if part == part else np.inf


def _parts(x: Array, most: Array) -> tuple[Array, Array]:
    """The normal numbers (count,) of unknowns, and the sizes (1 or 3, count) of what the coefficients ``most`` bound:
    along the tangents, and of moments about them and about the normal."""
    count = most.shape[1]
    sizes = np.sqrt(x[:, 1] ** 2 + x[:, 2] ** 2).reshape(len(most) // 2 + 1, count)
    if len(most) > 1:
        sizes = np.concatenate([sizes, np.abs(x[None, count:, 0])])
    return x[:count, 0], sizes


def _nearest(x: Array, most: Array) -> Array:
    """The nearest points of the cones, sizes <= most height. The height, by Newton's method: its steps ascend from
    below and end after one more than there are kinks, as the function is concave."""
    count = most.shape[1]
    normal, sizes = _parts(x, most)
    height = normal
    for _ in range(len(most) + 1):
        beyond = sizes > most * height
        height = (normal + (most * sizes * beyond).sum(axis=0)) / (1.0 + (most**2 * beyond).sum(axis=0))
    height = np.maximum(height, 0.0)
    shrink = np.minimum(1.0, most * height / np.maximum(sizes, 1e-300))
    out = np.repeat(shrink[:1].T, 3, axis=1) * x[:count]
    out[:, 0] = height
    if len(most) > 1:
        out = np.concatenate([out, shrink[[2, 1, 1]].T * x[count:]])
    return out
