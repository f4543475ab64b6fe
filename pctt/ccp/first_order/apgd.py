"""Accelerated projected gradient descent (APGD) with restart.

Mazhar, Heyn, Negrut, Tasora, "Using Nesterov's method to accelerate multibody dynamics with friction and contact", ACM
Trans. Graph. 34 (2015); restart by the gradient test of O'Donoghue and Candes (2015). N is applied once per iteration:
the gradient at the extrapolated point follows from those at the last two iterates, and for a quadratic objective the
line search is a Rayleigh quotient. The extrapolated point is computed twice, where it is used: reading the last two
iterates takes less time than storing and reading the point.

For Coulomb's law the opening mu |y_t| of the present gradient is added to it in every iteration, and momentum gets a
bound (`Momentum`). Then Coulomb's law is the fixed point of the projected step, and one run finds it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pctt.ccp.cone import Array, accelerated_curvature, accelerated_step
from pctt.ccp.first_order.momentum import Momentum
from pctt.ccp.first_order.progress import FirstOrder, GiveUp, Progress
from pctt.ccp.first_order.scaled import ScaledProblem
from pctt.ccp.problem import ConeProblem
from pctt.ccp.result import Limits, Result


@dataclass(frozen=True)
class Steering:
    """How the estimate L of the curvature follows the curvature along the steps; its inverse is the length of a
    step."""

    margin: float = 1.3  #: L of a repeated step, over the curvature found: the next step need not be repeated too
    decay: float = 0.99  #: factor on L after each step, so that steps grow again where the curvature allows it
    rounding: float = 1e-12  #: part of L by which the curvature may exceed it
    least: float = 1e-3  #: the first L at least; A has a diagonal of about one
    #: natural residual above which single precision is enough, times the root of the number of contacts: rounding hides
    #: the curvature along a step, but the errors of many contacts cancel
    single: float = 3e-4


STEERING = Steering()


@dataclass(frozen=True)
class APGD(FirstOrder):
    """Options ``-ccp_apgd_*``."""


def solve(
    problem: ConeProblem,
    guess: Array,
    limits: Limits,
    options: APGD,
    give_up: GiveUp | None = None,
    coulomb: bool = False,
) -> Result:
    """Impulses from a first guess (nc, 3): of the cone problem, or of Coulomb's law.

    If the bodies are known, the first iterations have single precision. The last ones, and the residual of the result,
    always have double precision.
    """
    momentum = Momentum(problem.max(problem.mu.max(initial=0.0)) if coulomb else None)
    progress = None
    if problem.contact_map is not None:
        enough = STEERING.single / np.sqrt(max(problem.size, 1))
        rough = limits.to(max(limits.tol, enough))
        progress = Progress(ScaledProblem(problem, coulomb, np.float32), rough, options, give_up)
        rough_impulse = _descend(progress, momentum, guess)
        if progress.iterations:  # else rounding would spoil a guess that is good already
            guess = rough_impulse
    progress = Progress(ScaledProblem(problem, coulomb), limits, options, give_up, progress)
    _descend(progress, momentum, guess)
    return progress.result()


def _descend(progress: Progress, momentum: Momentum, guess: Array) -> Array:
    """The best impulses that accelerated projected steps find from a first guess."""
    scaled = progress.problem
    momentum.restart()
    x = scaled.start(guess)
    y = scaled.gradient(x)
    last_x, last_y, new_x, new_y = x.copy(), y.copy(), np.empty_like(x), np.empty_like(y)
    lipschitz = _first_lipschitz(scaled)
    while progress.goes_on(x, y):
        momentum.look(progress.iterations, progress.history)
        beta, mu = momentum.beta, scaled.mu
        while True:  # a step from z = x + beta (x - last_x), where the gradient is y_z = y + beta (y - last_y)
            length, uphill = accelerated_step(x, last_x, y, last_y, beta, 1 / lipschitz, mu, scaled.opening, new_x)
            scaled.gradient(new_x, out=new_y)
            progress.iterations += 1
            curvature = accelerated_curvature(new_x, x, last_x, new_y, y, last_y, beta)
            curvature, length, uphill = scaled.sums(curvature, length, uphill)
            allowed = lipschitz * length * (1 + STEERING.rounding)
            if not (length > 0 and curvature > allowed):  # also ends on a number that is none
                break
            lipschitz = STEERING.margin * curvature / length
        momentum.advance(uphill > 0)
        last_x, x, new_x = x, new_x, last_x
        last_y, y, new_y = y, new_y, last_y
        lipschitz *= STEERING.decay
    return progress.impulse


def _first_lipschitz(problem: ScaledProblem) -> float:
    ones = np.ones_like(problem.b)
    Ax = problem.product(ones)
    length, size = problem.dots((Ax, Ax), (ones, ones))
    return max(float(np.sqrt(length / max(size, 1.0))), STEERING.least)
