"""Accelerated projected gradient descent (APGD) with restart.

Mazhar, Heyn, Negrut, Tasora, "Using Nesterov's method to accelerate multibody dynamics with friction and
contact", ACM Trans. Graph. 34 (2015); restart by the gradient test of O'Donoghue and Candes (2015). N is
applied once per iteration: the gradient at the extrapolated point follows from those at the last two
iterates, and for a quadratic objective the line search is a Rayleigh quotient.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pctt.ccp.cone import Array
from pctt.ccp.first_order.progress import FirstOrder, GiveUp, Progress
from pctt.ccp.first_order.scaled import ScaledProblem
from pctt.ccp.problem import ConeProblem
from pctt.ccp.result import Limits, Result


@dataclass(frozen=True)
class APGD(FirstOrder):
    """Options ``-ccp_apgd_*``."""


def solve(
    problem: ConeProblem, guess: Array, limits: Limits, options: APGD, give_up: GiveUp | None = None
) -> Result:
    """Impulses from a first guess (nc, 3)."""
    scaled = ScaledProblem(problem)
    progress = Progress(scaled, limits, options, give_up)
    x = scaled.start(guess)
    y = scaled.gradient(x)
    z, y_z = x, y  # the extrapolated point
    theta, lipschitz = 1.0, _first_lipschitz(scaled)
    while progress.goes_on(x, y):
        while True:
            x_new = y_z * (-1 / lipschitz)
            x_new += z
            x_new = scaled.project(x_new)
            y_new = scaled.gradient(x_new)
            progress.iterations += 1
            d, step = x_new - z, x_new - x
            curvature, length, uphill = scaled.dots((d, y_new - y_z), (d, d), (y_z, step))
            if not curvature > lipschitz * length * (1 + 1e-12):  # also ends on a number that is none
                break
            lipschitz = 1.1 * curvature / length
        if uphill > 0:  # the momentum points uphill: start it anew
            theta, z, y_z = 1.0, x_new, y_new
        else:
            theta_new = theta * (np.sqrt(theta**2 + 4) - theta) / 2
            beta = theta * (1 - theta) / (theta**2 + theta_new)
            theta = theta_new
            z = np.multiply(step, beta, out=step)
            z += x_new
            y_z = np.subtract(y_new, y, out=d)
            y_z *= beta
            y_z += y_new
        x, y = x_new, y_new
        lipschitz *= 0.95  # let the step grow again where the quotient allows it
    return progress.result()


def _first_lipschitz(problem: ScaledProblem) -> float:
    ones = np.ones_like(problem.b)
    Ax = problem.product(ones)
    length, size = problem.dots((Ax, Ax), (ones, ones))
    return max(float(np.sqrt(length / max(size, 1.0))), 1e-3)
