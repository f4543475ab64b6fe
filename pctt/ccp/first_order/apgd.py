"""Accelerated projected gradient descent (APGD) with restart.

Mazhar, Heyn, Negrut, Tasora, "Using Nesterov's method to accelerate multibody dynamics with friction and contact", ACM
Trans. Graph. 34 (2015); restart by the gradient test of O'Donoghue and Candes (2015). For a quadratic objective the
line search is a Rayleigh quotient.

N is applied once per iteration, in two halves. The first gives the velocities of the contacts at the extrapolated point
from the images of the last two iterates, their momenta on the bodies. The second gives the image of the new point, and
with it the curvature along the step, so a step that is repeated costs half. In single precision a contact moves 92
bytes in the first half, 64 in the step, 80 in the second: 236, and none outside the active set.

For Coulomb's law the De Saxce term mu |y_t| of the present gradient is added to it in every iteration. Then the law is
the fixed point of the projected step, and one run finds it. But that step is no gradient step: the term is not the
derivative of any function of the impulses. Linearised, the step is an unsymmetric map with complex eigenvalues a + ib,
and where 1 - beta < |b| / sqrt(a) momentum beta turns them into growing oscillations. So momentum begins anew where
steps have grown, and has a bound. A quadratic function of curvatures from k to L needs 1 - beta of about sqrt(k / L).
Here k is the least curvature of the ways that the impulses have gone from look to look. It is small in deep beds, whose
forces go by few contacts of many bodies, and a hundred times as large in flows. A guess of the last step has the forces
of the bed already: that the way to it from zero is flat says nothing about what is left.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from pctt.arrays import Array
from pctt.ccp.first_order.scaled import FirstOrder, Progress, ScaledProblem
from pctt.ccp.problem import ConeProblem
from pctt.ccp.result import Limits, Result
from pctt.options import AT_LEAST_ONE, NOT_NEGATIVE, PART, POSITIVE, number

IMPATIENT = 300  # iterations without progress in single precision: double precision takes over
CACHED = 500  # contacts whose numbers stay in the cache, where single precision is no faster
FLAT = 1.7  # of k / L, the square of 1 - momentum: with 1 or 2 mixers take 1.04 or .97 times the iterations


@dataclass(frozen=True)
class APGD(FirstOrder):
    """The numbers of the method, set from Python. L is the estimate of the curvature along a step; its inverse is the
    step's length."""

    check: int = number(25, "most iterations between two looks at the natural residual", check=AT_LEAST_ONE)
    lipschitz: float = number(
        2.5, "the first L: A has a diagonal of about one, and on packings L is 2 to 3", check=POSITIVE
    )
    margin: float = number(
        1.3, "L of a repeated step, over the curvature found: the next need not be repeated too", check=POSITIVE
    )
    decay: float = number(
        0.99, "factor on L after each step, so that steps grow again where the curvature allows it", check=PART
    )
    theta: float = number(
        0.2, "where momentum begins: below 1, as steps are short for most directions of descent", check=PART
    )
    damping: float = number(
        0.1, "Coulomb's law: 1 - the greatest momentum, at most; docs/notebook_ccp.md has trials", check=PART
    )
    near: float = number(
        0.03, "the same at least, where the impulses have gone a way of little curvature", check=PART
    )
    growth: float = number(
        6.0, "Coulomb's law: of a squared step over the least one, where momentum begins anew", check=POSITIVE
    )
    single: float = number(
        3e-4,
        "natural residual above which single precision is enough, times the root of the number of contacts: rounding "
        "hides the curvature along a step, but the errors of many contacts cancel",
        check=NOT_NEGATIVE,
    )


def solve(problem: ConeProblem, guess: Array, limits: Limits, options: APGD, coulomb: bool = False) -> Result:
    """Impulses from a first guess (nc, 3): of the cone problem, or of Coulomb's law.

    If the bodies are known, and contacts are many, the first iterations have single precision, and the last ones double
    precision where it makes a difference. The residual of the result has double precision.
    """
    progress = None
    if problem.contact_map is not None and problem.size > CACHED:
        rough = limits.to(max(limits.tol, options.single / np.sqrt(max(problem.size, 1))))
        impatient = replace(options, patience=min(options.patience, IMPATIENT))
        progress = Progress(ScaledProblem(problem, coulomb, np.float32), rough, impatient)
        rough_impulse = _descend(progress, guess, options)
        if progress.best <= limits.aimed:
            return progress.result()
        if progress.iterations:  # else rounding would spoil a guess that is good already
            guess = rough_impulse
    progress = Progress(ScaledProblem(problem, coulomb), limits, options, progress)
    _descend(progress, guess, options)
    return progress.result()


def _descend(progress: Progress, guess: Array, options: APGD) -> Array:
    """The best impulses that accelerated projected steps find from a first guess."""
    scaled, coulomb = progress.problem, progress.problem.coulomb
    now = scaled.iterate(scaled.start(guess))
    last, new = now.copy(), now.copy()
    y = gradient = np.empty(now.x.shape, scaled.precision)
    lipschitz, whole = options.lipschitz, True
    theta, beta, step, least = options.theta, 0.0, 0.0, np.inf  # momentum is beta; |L step|^2, its least since beta = 0
    most, flattest, before = 1.0, np.inf, (now.x.copy(), scaled.b)  # of beta; curvature; at the last look
    while True:
        if progress.is_due(math.sqrt(step)):
            (now, last, new), y = scaled.restore(now, last, new), gradient
            slope = scaled.look(now, y)
            if not progress.goes_on(now.x, slope, exact=True):
                return progress.impulse
            whole = True
            if coulomb:
                flattest = min(flattest, scaled.curvature(now.x, slope, *before))
                before = progress.looked, slope
                most = 1 - min(max(math.sqrt(FLAT * flattest / lipschitz), options.near), options.damping)
        scaled.rigid_gradient(now, last, beta, y)  # at z = x + beta (x - last_x)
        if whole and step > 0:
            now, last, new, y = scaled.restrict(now, last, new, y, math.sqrt(step))
            whole = False
        while True:
            curvature, length, uphill = scaled.step(now, last, beta, y, 1 / lipschitz, new)
            progress.iterations += 1
            allowed = lipschitz * length * (1 + 1e-12)
            if not (length > 0 and curvature > allowed):  # also ends on a number that is none
                break
            lipschitz = options.margin * curvature / length
        if curvature < 0.0:
            progress.watch(curvature, length, lipschitz)
        step = lipschitz**2 * length
        if uphill > 0 or (coulomb and step > options.growth * least):
            theta, beta, least = options.theta, 0.0, np.inf
        else:
            last_theta, theta = theta, theta * (math.sqrt(theta**2 + 4) - theta) / 2
            beta, least = min(last_theta * (1 - last_theta) / (last_theta**2 + theta), most), min(least, step)
        last, now, new = now, new, last
        lipschitz *= options.decay
