"""Preconditioned spectral projected gradient with fallback (P-SPG-FB).

Heyn, Anitescu, Tasora, Negrut, "Using Krylov subspace and spectral methods for solving complementarity
problems in many-body contact dynamics simulation", Int. J. Numer. Meth. Engng 95 (2013), after Birgin,
Martinez, Raydan, "Nonmonotone spectral projected gradient methods on convex sets", SIAM J. Optim. 10 (2000).

The preconditioner is the diagonal of N (``scaled.py``), taken so that the projection stays exact in its metric. Steps
are accepted by the nonmonotone test of Grippo, Lampariello and Lucidi: sufficient descent below the largest of the last
`Steering.memory` objectives. The fallback is that the result is the best point seen (``progress.py``), as the last
point of a nonmonotone method may be worse.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pctt.ccp.cone import Array
from pctt.ccp.first_order.barzilai_borwein import descend
from pctt.ccp.first_order.progress import FirstOrder
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
    rises = np.zeros(1)  # objectives of the last points, less that of the present one

    def line_search(slope: float, curvature: float) -> float:
        nonlocal rises
        part, change = _line_search(slope, curvature, rises.max())
        rises = np.append(rises - change, 0.0)[-STEERING.memory :]
        return part

    return descend(problem, guess, limits, options, line_search)


def _line_search(slope: float, curvature: float, rise: float) -> tuple[float, float]:
    """The part of a step to take, and the change of the objective.

    ``rise``: how far above the present objective the next one may be."""
    part, change = 1.0, slope + 0.5 * curvature
    least, most = STEERING.shorten
    while change > rise + STEERING.sufficient * part * slope and slope < 0:
        part *= min(max(-slope / (curvature * part), least), most)
        change = part * slope + 0.5 * part**2 * curvature
    return part, change
