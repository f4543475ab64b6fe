"""The accuracy of a solution: figures that judge every method, computed by code of their own, which no solver uses.

The loop below, with its projection, is not the solvers', and y = N g is a product of its own. So a mistake in a
solver's own arithmetic shows.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dem.compiled import inlined, loop
from dem.exchange import reduced
from pctt.arrays import TINY, Array
from pctt.ccp.cones import FrictionCones
from pctt.ccp.problem import ConeProblem
from pctt.options import short

ROUNDINGS = 8.0 * float(np.finfo(float).eps)


@dataclass(frozen=True)
class Accuracy:
    """The figures say how accurate an impulse g with velocities y = N g + r is (see ``docs/accuracy.md``).

    Attributes
    ----------
    natural_residual : ||g - P(g - s y)|| / ||g||, s = 1 / mean(diag N); a contact whose part is below 8 roundings of
        its s y does not count
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
    closing_speed: float
    impulse_norm: float
    velocity_norm: float


def measure(problem: ConeProblem, impulse: Array) -> Accuracy:
    """Return the figures of an impulse (nc, 3), or (nc, 2) in the plane; the same on every rank. ValueError for another
    shape."""
    if not isinstance(problem, ConeProblem):
        raise ValueError(f"the problem {short(problem)}: allowed is a ConeProblem")
    g = problem.taken("impulses", impulse)
    return figures(problem, g, problem.velocity_of(problem.momentum(g)))


def figures(problem: ConeProblem, g: Array, rigid: Array) -> Accuracy:
    """Those of an impulse g (nc, 3) in the cones, whose velocities are ``rigid`` without compliance and r."""
    step = 1.0 / problem.mean_diagonal
    soft = problem.compliance[: None if problem.yields else 0]
    sums: Sequence[float]
    greatest: Sequence[float]
    if type(problem.cones) is FrictionCones:
        sums, greatest = _judged(g, rigid, soft, problem.r, problem.mu, step)
    else:
        cones, disc = problem.cones, np.zeros(3 * problem.cones.parts, int)
        for k, part in enumerate(cones.tangents):
            disc[list(part)] = k
        y = rigid + problem.compliance * g + problem.r
        joined = cones.joined(g), cones.joined(y), cones.joined(problem.r)
        sums, greatest = _judged_discs(joined, cones.coefficients, disc, step)
    of_all, (cone, dual, complementarity, closes) = reduced(problem.comm, sums, greatest)
    square, speed, power, pushed, closing, opening, natural, coulomb = of_all
    norm, energy = math.sqrt(square), 0.5 * pushed
    per = 1.0 / max(norm, TINY)
    return Accuracy(
        natural_residual=math.sqrt(natural) * per,
        coulomb_residual=math.sqrt(coulomb) * per,
        objective=0.5 * power,
        cone_violation=cone,
        dual_violation=dual,
        complementarity=complementarity,
        closing_work=_part(closing, energy),
        opening_work=_part(opening, energy),
        closing_speed=closes if closes == closes else np.inf,
        impulse_norm=norm,
        velocity_norm=math.sqrt(speed),
    )


def _part(work: float, energy: float) -> float:
    """work / energy; 0 without impulses, inf if it is no number."""
    if energy <= 0:
        return 0.0
    part = work / energy
    return part if part == part else np.inf


@loop
def _judged(
    g: Array, rigid: Array, C: Array, r: Array, mu: Array, step: float
) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Of impulses g and velocities y = N g + r (nc, 3) eight sums over the contacts: of |g|^2, |y|^2, g.(y + r),
    g.(y - r), the closing and the opening work, |g - P(g - step y)|^2 and the same of Coulomb's law; and the four
    greatest: distances outside the cone and outside the dual one, |g.y|, and -y_n. Comparisons let a NaN through.

    N g is `rigid`, and C g more, of the diagonal C (nc, 3), or no row of it for zero."""
    sums, greatest = np.zeros(8), np.zeros(4)
    for c in range(len(mu)):
        n, u, v, m = g[c, 0], g[c, 1], g[c, 2], mu[c]
        y_n, y_u, y_v = rigid[c, 0], rigid[c, 1], rigid[c, 2]
        if len(C):
            y_n, y_u, y_v = y_n + C[c, 0] * n, y_u + C[c, 1] * u, y_v + C[c, 2] * v
        y_n, y_u, y_v = y_n + r[c, 0], y_u + r[c, 1], y_v + r[c, 2]
        along = n * y_n + u * y_u + v * y_v
        free = n * r[c, 0] + u * r[c, 1] + v * r[c, 2]
        slip = np.sqrt(y_u * y_u + y_v * y_v)
        sums[0] += n * n + u * u + v * v
        sums[1] += y_n * y_n + y_u * y_u + y_v * y_v
        sums[2] += along + free
        sums[3] += along - free
        closing = 0.0 if y_n > 0.0 else -y_n
        sums[4] += n * closing
        sums[5] += 0.0 if along < 0.0 else along
        noise = ROUNDINGS * step * np.sqrt(y_n * y_n + slip * slip)
        for law in range(2):
            w = y_n + m * slip if law else y_n
            a_n, a_u, a_v = _nearest_in_cone(n - step * w, u - step * y_u, v - step * y_v, m)
            distance = np.sqrt((n - a_n) ** 2 + (u - a_u) ** 2 + (v - a_v) ** 2)
            sums[6 + law] += 0.0 if distance <= noise else distance * distance
        greatest[0] = max(greatest[0], np.sqrt(u * u + v * v) - m * n)
        greatest[1] = max(greatest[1], m * slip - y_n)
        greatest[2] = max(greatest[2], abs(along))
        greatest[3] = closing if closing > greatest[3] or closing != closing else greatest[3]
    return (
        (sums[0], sums[1], sums[2], sums[3], sums[4], sums[5], sums[6], sums[7]),
        (greatest[0], greatest[1], greatest[2], greatest[3]),
    )


@inlined
def _nearest_in_cone(n, u, v, mu):
    """Projection on the cone of slope mu, in the half plane of axis and point: the nearest point of the surface's ray,
    unless the point is inside."""
    tangential = np.sqrt(u * u + v * v)
    ray = 1.0 / np.sqrt(1.0 + mu * mu)
    along = ray * (n + mu * tangential)
    along = 0.0 if along < 0.0 else along
    if not (n >= 0.0 and tangential <= mu * n):
        turn = ray * mu * along / tangential if tangential > 0.0 else 0.0
        n, u, v = ray * along, turn * u, turn * v
    return n, u, v


@loop
def _judged_discs(
    rows: tuple[Array, Array, Array], most: Array, disc: NDArray[np.intp], step: float
) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """The figures of `_judged` of g, y and r (nc, width) for any cones that discs meet, with coefficients `most`
    (discs, nc): `disc` (width,) says on which a number lies; the first one lies on none."""
    g, y, r = rows
    sums, greatest = np.zeros(8), np.zeros(4)
    sizes, move = np.zeros((3, len(most))), np.zeros(len(disc))  # of impulses, velocities and targets
    for c in range(len(g)):
        square, speed, along, free, resisted, outside = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        for j in range(len(disc)):
            square, speed = square + g[c, j] ** 2, speed + y[c, j] ** 2
            along, free = along + g[c, j] * y[c, j], free + g[c, j] * r[c, j]
        for of, (one, other) in enumerate(((1.0, 0.0), (0.0, 1.0), (1.0, -step))):
            _set_sizes(one, g[c], other, y[c], disc, sizes[of])
        for k in range(len(most)):
            resisted += most[k, c] * sizes[1, k]
            outside = _larger(outside, sizes[0, k] - most[k, c] * g[c, 0])
        closing = _larger(0.0, -y[c, 0])
        sums[0] += square
        sums[1] += speed
        sums[2] += along + free
        sums[3] += along - free
        sums[4] += g[c, 0] * closing
        sums[5] += _larger(0.0, along)
        for law in range(2):
            normal = g[c, 0] - step * (y[c, 0] + law * resisted)
            height = _height(normal, sizes[2], most[:, c])
            move[0] = height - g[c, 0]
            for j in range(1, len(disc)):
                size, radius = sizes[2, disc[j]], most[disc[j], c] * height
                target = g[c, j] - step * y[c, j]
                move[j] = (target * (radius / size) if size > radius else target) - g[c, j]
            square = (move * move).sum()
            sums[6 + law] += 0.0 if np.sqrt(square) <= ROUNDINGS * step * np.sqrt(speed) else square
        greatest[0] = _larger(greatest[0], outside)
        greatest[1] = _larger(greatest[1], resisted - y[c, 0])
        greatest[2] = _larger(greatest[2], abs(along))
        greatest[3] = _larger(greatest[3], closing)
    return (
        (sums[0], sums[1], sums[2], sums[3], sums[4], sums[5], sums[6], sums[7]),
        (greatest[0], greatest[1], greatest[2], greatest[3]),
    )


@inlined
def _larger(x, y):
    return x if x >= y or x != x else y  # a NaN stays


@inlined
def _set_sizes(one, g, other, y, disc, sizes):
    """The sizes (discs,) of the parts of one g + other y (width,)."""
    sizes[:] = 0.0
    for j in range(1, len(disc)):
        sizes[disc[j]] += (one * g[j] + other * y[j]) ** 2
    for k in range(len(sizes)):
        sizes[k] = np.sqrt(sizes[k])


@inlined
def _height(normal, sizes, most):
    """The height of the projection of a point, whose parts have these sizes (discs,), on a cone with the coefficients
    `most` (discs,): by Newton's method, whose steps ascend from below and end after one for each disc, as the function
    is concave with as many kinks."""
    height = normal
    for _ in range(len(most) + 2):
        above, below = normal, 1.0
        for k in range(len(most)):
            if sizes[k] > most[k] * height:
                above += most[k] * sizes[k]
                below += most[k] * most[k]
        last, height = height, above / below
        if height == last:
            break
    return _larger(0.0, height)
