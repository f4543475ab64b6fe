"""Accelerated projected gradient descent (APGD) with restart.

Mazhar, Heyn, Negrut, Tasora, "Using Nesterov's method to accelerate multibody dynamics with friction and
contact", ACM Trans. Graph. 34 (2015); restart by the gradient test of O'Donoghue and Candes (2015). Every
contact is scaled by the mean of its diagonal block, under which its cone stays what it is. N is applied
once per iteration: the product of the extrapolated point follows from those of the last two iterates, and
for a quadratic objective the line search is a Rayleigh quotient.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pctt.ccp.cone import Array, project
from pctt.ccp.problem import ConeProblem
from pctt.ccp.result import Limits, Result
from pctt.options import AT_LEAST_ONE, option


@dataclass(frozen=True)
class APGD:
    """Options ``-ccp_apgd_*``."""

    check: int = option(10, "iterations between two looks at the natural residual", check=AT_LEAST_ONE)


def solve(problem: ConeProblem, guess: Array, limits: Limits, options: APGD) -> Result:
    """Impulses from a first guess (nc, 3); default iteration limit 20,000."""
    max_it = limits.max_it if limits.max_it >= 0 else 20_000
    scale = _contact_scale(problem)
    mu, r = problem.mu, problem.r / scale

    def product(x: Array) -> Array:
        return problem.product(x / scale) / scale

    x = project(guess * scale, mu)
    Nx = product(x)
    z, Nz = x, Nx  # the extrapolated point
    theta, lipschitz = 1.0, _first_lipschitz(problem, product)
    history = [problem.natural_residual(x / scale, (Nx + r) * scale)]
    iterations = 0
    while history[-1] > limits.tol and iterations < max_it and np.isfinite(lipschitz):
        gradient = Nz + r
        while True:
            x_new = project(z - gradient / lipschitz, mu)
            Nx_new = product(x_new)
            iterations += 1
            d = x_new - z
            curvature, length, uphill = problem.sum(
                np.array([np.vdot(d, Nx_new - Nz), np.vdot(d, d), np.vdot(gradient, x_new - x)])
            )
            if not curvature > lipschitz * length * (1 + 1e-12):  # also ends on a number that is none
                break
            lipschitz = 1.1 * curvature / length
        if uphill > 0:  # the momentum points uphill: start it anew
            theta, z, Nz = 1.0, x_new, Nx_new
        else:
            theta_new = theta * (np.sqrt(theta**2 + 4) - theta) / 2
            beta = theta * (1 - theta) / (theta**2 + theta_new)
            theta, z, Nz = theta_new, x_new + beta * (x_new - x), Nx_new + beta * (Nx_new - Nx)
        x, Nx = x_new, Nx_new
        lipschitz *= 0.95  # let the step grow again where the quotient allows it
        if len(history) * options.check <= iterations or iterations >= max_it:
            history.append(problem.natural_residual(x / scale, (Nx + r) * scale))
    converged = history[-1] <= limits.tol
    reason = "natural residual below the tolerance" if converged else f"{iterations} iterations"
    return Result(x / scale, converged, reason, history[-1], iterations, history=history)


def _contact_scale(problem: ConeProblem) -> Array:
    """Square root of the mean diagonal of each contact's block (nc, 1)."""
    mean = np.trace(problem.diagonal_blocks, axis1=1, axis2=2)[:, None] / 3
    return np.sqrt(np.where(mean > 0, mean, problem.mean_diagonal))


def _first_lipschitz(problem: ConeProblem, product) -> float:
    ones = np.ones_like(problem.r)
    return max(problem.norm(product(ones)) / max(problem.norm(ones), 1.0), 1e-3)
