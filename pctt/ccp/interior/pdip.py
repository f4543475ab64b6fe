"""The paper's primal-dual interior point method (PDIP) for the cone problem.

Newton's method on the perturbed optimality conditions of min 1/2 g'Ng + r'g, f(g) <= 0 (paper, section 2.4):

    N g + r + sum lambda_i grad f_i = 0,    -lambda_i f_i = 1/t,

with the multipliers eliminated:

    S dg = -(N g + r + grad f / (-t f)),    S = N + lambda hess f + lambda/(-f) grad f grad f'.

Where the paper's form creeps (134 Newton steps at 17,911 contacts, natural residual 6e-5), this one differs
in three points, each measured in ``docs/ccp.md``: the constraint is the cone's perspective form
(``barrier.py``); steps end at 0.9 of the way to the boundary and inside a neighbourhood of the central
path, rather than at 0.99 and where the multiplier residual falls; and the natural residual alone decides
when to stop.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pctt.ccp.cone import Array, step_to_boundary, step_to_zero
from pctt.ccp.interior.barrier import CONSTRAINTS, Perspective, Quadratic
from pctt.ccp.newton import Newton
from pctt.ccp.problem import ConeProblem
from pctt.ccp.result import Limits, Result
from pctt.log import phase
from pctt.options import FRACTION, POSITIVE, option

PATIENCE = 5  # Newton steps that may go by without much progress before the linear solves are made more accurate


@dataclass(frozen=True)
class PDIP:
    """Options ``-ccp_pdip_*``."""

    constraint: str = option(
        "perspective", "form of the cone constraint; quadratic is the paper's", choices=CONSTRAINTS
    )
    centering: float = option(
        0.3, "complementarity aimed at, as a part of the present one (the paper: 0.1)", check=FRACTION
    )
    boundary: float = option(
        0.9, "part of the way to the cone's boundary that a step may go (the paper: 0.99)", check=FRACTION
    )
    neighbourhood: float = option(
        1e-4, "smallest complementarity of a contact, as a part of the mean", check=FRACTION
    )
    start: float = option(
        10.0, "normal impulse of new contacts, in units of rms(r) / mean diag N", check=POSITIVE
    )


def solve(problem: ConeProblem, guess: Array, limits: Limits, options: PDIP, newton: Newton) -> Result:
    """Impulses; ``guess`` (nc, 3) gives the normal impulses of persistent contacts, 0 elsewhere.

    Default iteration limit 100 Newton steps.
    """
    max_it = limits.max_it if limits.max_it >= 0 else 100
    cone = CONSTRAINTS[options.constraint](problem.mu)
    newton.begin(problem)
    rtol = min(1e-3, 10 * limits.tol)  # of the linear solves, where ``-ksp_rtol`` does not say otherwise
    g, lam = _start(problem, guess, cone, options)
    history: list[float] = []
    tightened = 0
    for iteration in range(max_it + 1):
        y = _velocity(problem, g)
        history.append(problem.natural_residual(g, y))
        if history[-1] <= limits.tol:
            reason = "natural residual below the tolerance"
            break
        if iteration == max_it:
            reason = f"{max_it} Newton steps"
            break
        if _stalls(history, iteration - tightened):  # the Newton directions are too inexact
            rtol, tightened = max(0.1 * rtol, 1e-12), iteration
        f, df = cone.value(g), cone.gradient(g)
        gap = problem.sum(-(lam @ f)) / problem.size
        barrier = options.centering * gap  # 1/t
        newton.update(_barrier_blocks(cone, g, lam, f, df))
        q = -(y - (barrier / f)[:, None] * df)
        dg, _ = newton.solve(q, rtol * problem.norm(q) / np.sqrt(problem.mean_diagonal))
        dg[problem.mu == 0, 1:] = 0.0
        dlam = -(lam + (barrier + lam * (df * dg).sum(1)) / f)
        step = _step_length(problem, cone, g, lam, dg, dlam, options)
        if not step > 1e-10:
            reason = "steps became too short" if step == step else "not a number in the Newton step"
            break
        g = g + step * dg
        lam = lam + step * dlam
    converged = history[-1] <= limits.tol
    return Result(g, converged, reason, history[-1], iteration, newton.ksp_its, newton.fallbacks, history)


def _stalls(history: list[float], since: int) -> bool:
    """Whether PATIENCE steps together took less than a third off the natural residual (settled packings with
    accurate solves: half or more); ``since``: steps to judge by."""
    return since >= PATIENCE and history[-1] > 0.7 * history[-1 - PATIENCE]


def _velocity(problem: ConeProblem, g: Array) -> Array:
    """y = N g + r but for the sliding of contacts without friction, which no impulse answers."""
    y = problem.product(g) + problem.r
    y[problem.mu == 0, 1:] = 0.0
    return y


def _start(
    problem: ConeProblem, guess: Array, cone: Perspective | Quadratic, options: PDIP
) -> tuple[Array, Array]:
    """Impulses on the cones' axes and multipliers of equal complementarity."""
    closing = problem.norm(_velocity(problem, np.zeros_like(problem.r))) / np.sqrt(problem.size)
    new = options.start * closing / problem.mean_diagonal
    g = np.zeros_like(problem.r)
    g[:, 0] = np.where(guess[:, 0] > 0, np.maximum(guess[:, 0], 0.1 * new), new)
    speed = problem.norm(_velocity(problem, g)) / np.sqrt(problem.size)
    mean_normal = problem.sum(g[:, 0].sum()) / problem.size
    mean_mu = problem.sum(problem.mu.sum()) / problem.size
    return g, 3 * speed * mean_normal * (mean_mu or 1.0) / -cone.value(g)


def _barrier_blocks(cone: Perspective | Quadratic, g: Array, lam: Array, f: Array, df: Array) -> Array:
    """lambda hess f + lambda/(-f) grad f grad f' (nc, 3, 3), positive definite inside the cone."""
    with phase("CCPBarrier"):
        blocks = lam[:, None, None] * cone.hessian(g)
        blocks += (lam / -f)[:, None, None] * df[:, :, None] * df[:, None, :]
        frictionless = cone.mu == 0
        if frictionless.any():  # hold the tangential impulses at zero
            stiff = 1e12 * np.maximum(blocks[frictionless, 0, 0], 1)
            blocks[frictionless, 1, 1] = blocks[frictionless, 2, 2] = stiff
        return blocks


def _step_length(
    problem: ConeProblem,
    cone: Perspective | Quadratic,
    g: Array,
    lam: Array,
    dg: Array,
    dlam: Array,
    options: PDIP,
) -> float:
    """Longest step, at most 1, inside the cones, near the central path; nan if the direction is no number."""
    if not np.isfinite(problem.sum(dg.sum() + dlam.sum())):
        return np.nan
    frictional = cone.mu > 0
    to_surface = step_to_boundary(g[frictional], dg[frictional], cone.mu[frictional])
    to_apex = step_to_zero(g[:, 0], dg[:, 0])
    step = min(1.0, options.boundary * problem.min(min(to_surface, to_apex, step_to_zero(lam, dlam))))
    while step > 1e-10:
        gap = -(lam + step * dlam) * cone.value(g + step * dg)
        mean = problem.sum(gap.sum()) / problem.size
        if problem.min(gap.min(initial=np.inf)) >= options.neighbourhood * mean:
            break
        step *= 0.8
    return step
