"""Preconditioned spectral projected gradient with fallback (P-SPG-FB).

Heyn, Anitescu, Tasora, Negrut, "Using Krylov subspace and spectral methods for solving complementarity
problems in many-body contact dynamics simulation", Int. J. Numer. Meth. Engng 95 (2013), after Birgin,
Martinez, Raydan, "Nonmonotone spectral projected gradient methods on convex sets", SIAM J. Optim. 10 (2000).

The preconditioner is the diagonal of N (``scaled.py``), taken so that the projection stays exact in its metric. Steps
are accepted by the nonmonotone test of Grippo, Lampariello and Lucidi: sufficient descent below the largest of the last
`Steering.memory` objectives; along a segment the objective is a known parabola, so that a shortened step costs no
product. The fallback is that the result is the best point seen (``progress.py``), as the last point of a nonmonotone
method may be worse.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pctt.ccp.cone import Array
from pctt.ccp.first_order.barzilai_borwein import barzilai_borwein_step
from pctt.ccp.first_order.progress import FirstOrder, Progress
from pctt.ccp.first_order.scaled import ScaledProblem
from pctt.ccp.problem import ConeProblem
from pctt.ccp.result import Limits, Result


@dataclass(frozen=True)
class Steering:
    """Numbers that steer the method; the values of Birgin, Martinez and Raydan."""

    memory: int = 10  #: objectives below whose largest the next one must be
    sufficient: float = 1e-4  #: part of the descent promised by the slope that a step must bring
    shorten: tuple[float, float] = (0.1, 0.9)  #: a refused step is shortened by a factor between these


STEERING = Steering()


def solve(problem: ConeProblem, guess: Array, limits: Limits, options: FirstOrder) -> Result:
    """Impulses from a first guess (nc, 3)."""
    scaled = ScaledProblem(problem)
    progress = Progress(scaled, limits, options)
    x = scaled.start(guess)
    y = scaled.gradient(x)
    step = 1.0  # A has a diagonal of about one
    rises = np.zeros(1)  # objectives of the last points, less that of x
    while progress.goes_on(x, y):
        d = scaled.projected_move(x, y, step)
        Ad = scaled.product(d)
        progress.iterations += 1
        slope, length, curvature, stretch = scaled.dots((y, d), (d, d), (d, Ad), (Ad, Ad))
        slope = min(slope, -length / step)  # so it is for a projection; y'd drowns in rounding near the solution
        fraction, change = _line_search(slope, curvature, rises.max())
        rises = np.append(rises - change, 0.0)[-STEERING.memory :]
        if fraction != 1.0:
            d *= fraction
            Ad *= fraction
        x = np.add(x, d, out=d)
        y += Ad
        step = barzilai_borwein_step(length, curvature, stretch, progress.iterations)
    return progress.result()


def _line_search(slope: float, curvature: float, rise: float) -> tuple[float, float]:
    """Fraction of a step and change of the objective along fraction * slope + fraction^2 / 2 * curvature.

    ``rise``: how far above the present objective the next one may be."""
    fraction, change = 1.0, slope + 0.5 * curvature
    least, most = STEERING.shorten
    while change > rise + STEERING.sufficient * fraction * slope and slope < 0:
        fraction *= min(max(-slope / (curvature * fraction), least), most)
        change = fraction * slope + 0.5 * fraction**2 * curvature
    return fraction, change
