"""Projected Barzilai-Borwein method with adaptive nonmonotone line search.

Dai and Fletcher, "Projected Barzilai-Borwein methods for large-scale box-constrained quadratic programming", Numer.
Math. 100 (2005); here on cones, as the method needs nothing but the projection. Steps alternate between the two
Barzilai-Borwein lengths. A step is shortened, to the exact minimiser on its segment, only where the objective would
rise above a reference value: the worst of the values since the best one, taken over when `Steering.memory` steps have
brought no new best. One product with N per iteration.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from pctt.ccp.cone import Array
from pctt.ccp.first_order.progress import FirstOrder, Progress
from pctt.ccp.first_order.scaled import ScaledProblem
from pctt.ccp.problem import ConeProblem
from pctt.ccp.result import Limits, Result

# from slope and curvature, of the change slope t + curvature t^2 / 2 of the objective: the part t of the step to take
LineSearch = Callable[[float, float], float]


@dataclass(frozen=True)
class Steering:
    """Numbers that steer the method."""

    memory: int = 10  #: steps without a new best objective after which the reference value falls; Dai and Fletcher's L
    flat: float = 1e-14  #: curvature over squared length of a step below which rounding decides its sign


STEERING = Steering()


def solve(problem: ConeProblem, guess: Array, limits: Limits, options: FirstOrder) -> Result:
    """Impulses from a first guess (nc, 3)."""
    return descend(problem, guess, limits, options, adaptive_search())


def descend(
    problem: ConeProblem, guess: Array, limits: Limits, options: FirstOrder, line_search: LineSearch
) -> Result:
    """Impulses by projected steps of these lengths with any line search."""
    scaled = ScaledProblem(problem)
    progress = Progress(scaled, limits, options)
    x = scaled.start(guess)
    y = scaled.gradient(x)
    step = 1.0  # A has a diagonal of about one
    while progress.goes_on(x, y):
        d = scaled.projected_move(x, y, step)
        Ad = scaled.product(d)
        progress.iterations += 1
        slope, length, curvature, stretch = scaled.dots((y, d), (d, d), (d, Ad), (Ad, Ad))
        slope = min(slope, -length / step)  # so it is for a projection; y'd drowns in rounding near the solution
        part = line_search(slope, curvature)
        if part != 1.0:
            d *= part
            Ad *= part
        x = np.add(x, d, out=d)
        y += Ad
        step = 1.0
        if curvature > STEERING.flat * length:
            step = float(length / curvature if progress.iterations % 2 else curvature / stretch)
    return progress.result()


def adaptive_search() -> LineSearch:
    reference, best, worst, since = np.inf, 0.0, 0.0, 0  # objectives, less that of the present point

    def search(slope: float, curvature: float) -> float:
        nonlocal reference, best, worst, since
        part = 1.0
        if curvature > 0 and slope + 0.5 * curvature > reference:
            part = min(1.0, -slope / curvature)
        change = part * slope + 0.5 * part**2 * curvature
        reference, best, worst = reference - change, best - change, worst - change
        if best > 0:
            best, worst, since = 0.0, 0.0, 0
        else:
            worst, since = max(worst, 0.0), since + 1
            if since == STEERING.memory:
                reference, worst, since = worst, 0.0, 0
        return part

    return search
