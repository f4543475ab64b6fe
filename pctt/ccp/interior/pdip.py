"""The paper's primal-dual interior point method (PDIP) for the cone problem.

Newton's method on the perturbed optimality conditions of min 1/2 g'Ng + r'g, f(g) <= 0 (paper, section 2.4):

    N g + r + sum lambda_i grad f_i = 0,    -lambda_i f_i = 1/t,

with the multipliers eliminated:

    S dg = -(N g + r + grad f / (-t f)),    S = N + lambda hess f + lambda/(-f) grad f grad f'.

Where the paper's form creeps (134 Newton steps at 17,911 contacts, natural residual 6e-5), this one differs
in five points, each measured in ``docs/notebook_ccp.md``: the constraint is the cone's perspective form
(``barrier.py``); steps end at 0.9 of the way to the boundary and inside a neighbourhood of the central
path, rather than at 0.99 and where the multiplier residual falls; a direction that the cones' curvature cuts
short is corrected, and short steps near the solution give S a proximal term rho I; and the natural residual alone
decides when to stop.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from pctt.ccp.cone import Array, dot, step_to_boundary, step_to_zero, times
from pctt.ccp.interior.barrier import CONSTRAINTS, Perspective, Quadratic
from pctt.ccp.interior.guess import no_larger_than_useful
from pctt.ccp.newton import Newton
from pctt.ccp.problem import ConeProblem
from pctt.ccp.result import Limits, Result, Status
from pctt.log import phase
from pctt.options import FRACTION, POSITIVE, option


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


@dataclass(frozen=True)
class Steering:
    """Numbers that steer the method, without unit; docs/notebook_ccp.md has what was measured."""

    rtol: float = 3e-4  #: relative residual of the linear solves, if ``-ksp_rtol`` gives no other
    forcing: float = 0.03  #: residual of a linear solve at most, as a part of what the natural residual shows
    stuck: float = 0.1  #: after a shorter step the next one only centres
    #: natural residual below which S has a proximal term; before, impulses may have to grow by orders of magnitude
    late: float = 1e-3
    cut: float = 0.3  #: after a shorter step the proximal term grows
    whole: float = 0.7  #: after a longer step it falls
    factor: float = 4.0  #: by which it grows or falls
    damping: tuple[float, float] = (1.0, 4.0)  #: its bounds where it grows [natural residual times mean diag N]
    short: float = 0.5  #: the direction of a shorter step is corrected
    further: float = 0.3  #: the correction aims at a step that is longer by this
    bent: float = 100.0  #: no correction helps if terms of second order enlarge the right-hand side by this factor
    longer: float = 1.2  #: a corrected step is taken if it is so many times as long
    earlier: int = 3  #: a linear solve begins from the best combination of so many earlier solutions


STEERING = Steering()


def solve(problem: ConeProblem, guess: Array, limits: Limits, options: PDIP, newton: Newton) -> Result:
    """Impulses; ``guess`` (nc, 3) gives the normal impulses of persistent contacts, 0 elsewhere."""
    cone = CONSTRAINTS[options.constraint](problem.mu)
    newton.begin(problem)
    g, lam = _start(problem, guess, cone, options)
    history: list[float] = []
    earlier: deque[Array] = deque(maxlen=STEERING.earlier)
    step, damping = 1.0, 0.0
    for iteration in range(limits.max_it + 1):
        y = _velocity(problem, g)
        natural = problem.natural_residual(g, y)
        history.append(limits.residual(natural, problem, g, y))
        if history[-1] <= limits.tol:
            status, reason = Status.CONVERGED, limits.met
            break
        if iteration == limits.max_it:
            status, reason = Status.ITERATION_LIMIT, f"{limits.max_it} Newton steps"
            break
        f, df, hessian = cone.value(g), cone.gradient(g), cone.hessian(g)
        centering = options.centering if step > STEERING.stuck else 1.0
        aim = centering * problem.sum(-(lam @ f)) / problem.size  # 1/t
        at = Linearised(problem, newton, cone, g, lam, y, f, df, hessian, aim, earlier)
        damping = _next_damping(damping, step, natural)
        newton.update(_barrier_blocks(at, damping * min(natural, STEERING.late) * problem.mean_diagonal))
        step, dg, dlam = _corrected(at, natural, options)
        if not step > 1e-10:
            status, reason = Status.STALLED, "steps became too short"
            if step != step:
                status, reason = Status.BREAKDOWN, "not a number in the Newton step"
            break
        g = g + step * dg
        lam = lam + step * dlam
    return Result(g, status, reason, history[-1], iteration, newton.ksp_its, newton.fallbacks, history)


class Linearised(NamedTuple):
    """The data that all directions of a Newton step share: the problem, impulses and multipliers, velocities, the
    constraints with their first and second derivatives, the target 1/t of the complementarity, and the last solutions
    of Newton systems."""

    problem: ConeProblem
    newton: Newton
    cone: Perspective | Quadratic
    g: Array
    lam: Array
    y: Array
    f: Array
    df: Array
    hessian: Array
    barrier: float
    earlier: deque[Array]


def _accuracy(at: Linearised, q: Array, residual: float) -> float:
    """How accurately to solve a Newton system with the right-hand side q (momenta, sqrt J).

    The residual of a solve is a velocity. It must be only a part of the velocities that the natural residual stands
    for: otherwise complementarity would fall without them, and near the boundary no step makes up for that."""
    problem = at.problem
    shown = residual * problem.norm(at.g) * problem.mean_diagonal
    left = min(STEERING.rtol * problem.norm(q), STEERING.forcing * shown)
    return left / float(np.sqrt(problem.mean_diagonal))


def _next_damping(damping: float, step: float, residual: float) -> float:
    """The factor of the proximal term after a step of length ``step``, as a part of the natural residual.

    Forces that hold each other move no body, and only the barrier bounds them: directions along them are long, leave
    the cones at once, and cut the rest of the step short. The proximal term shortens them. It leaves a velocity of rho
    dg, which is less than the natural residual shows."""
    if residual > STEERING.late:
        return 0.0
    if step < STEERING.cut:
        return float(np.clip(STEERING.factor * damping, *STEERING.damping))
    return damping / STEERING.factor if step > STEERING.whole else damping


def _corrected(at: Linearised, residual: float, options: PDIP) -> tuple[float, Array, Array]:
    """The step to take, and the direction dg, dlam: Newton's, corrected once where the cones' curvature cuts it short
    and that pays."""
    q = _right_side(at, at.barrier)
    tol = _accuracy(at, q, residual)
    dg, dlam = _direction(at, q, at.barrier, tol)
    step = _step_length(at, dg, dlam, options)
    if not step < STEERING.short:
        return step, dg, dlam
    curved, missed = _bend(at, dg, dlam, min(1.0, step + STEERING.further))
    bent = _right_side(at, at.barrier + missed) - curved
    if at.problem.norm(bent) < STEERING.bent * at.problem.norm(q):
        other_dg, other_dlam = _direction(at, bent, at.barrier + missed, tol)
        other = _step_length(at, other_dg, other_dlam, options)
        if other > STEERING.longer * step:
            return other, other_dg, other_dlam
    return step, dg, dlam


def _right_side(at: Linearised, aim: Array | float) -> Array:
    """Of the Newton system, for the complementarity ``aim``, of all contacts or of each."""
    return (aim / at.f)[:, None] * at.df - at.y


def _direction(at: Linearised, q: Array, aim: Array | float, tol: float) -> tuple[Array, Array]:
    """dg and dlam for the right-hand side q and the complementarity ``aim``."""
    dg, x = at.newton.solve(q, tol, earlier=at.earlier)
    at.earlier.append(x)
    dg[at.problem.mu == 0, 1:] = 0.0
    return dg, -(at.lam + aim / at.f + at.lam / at.f * dot(at.df, dg))


def _bend(at: Linearised, dg: Array, dlam: Array, reach: float) -> tuple[Array, Array]:
    """The terms that the linearised conditions lack at ``reach`` along a direction, divided by ``reach``: those of
    second order of sum lambda_i grad f_i (without third derivatives) and of lambda_i f_i. A contact that slides has to
    turn its impulse along the cone, and straight steps leave it soon."""
    turned = times(at.hessian, dg)
    missed = dlam * dot(at.df, dg) + 0.5 * at.lam * dot(dg, turned)
    return reach * dlam[:, None] * turned, reach * missed


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
    known = no_larger_than_useful(problem, guess)[:, 0]
    g = np.zeros_like(problem.r)
    g[:, 0] = np.where(known > 0, np.maximum(known, 0.1 * new), new)
    speed = problem.norm(_velocity(problem, g)) / np.sqrt(problem.size)
    mean_normal = problem.sum(g[:, 0].sum()) / problem.size
    mean_mu = problem.sum(problem.mu.sum()) / problem.size
    return g, 3 * speed * mean_normal * (mean_mu or 1.0) / -cone.value(g)


def _barrier_blocks(at: Linearised, proximal: float) -> Array:
    """lambda hess f + lambda/(-f) grad f grad f' + rho I (nc, 3, 3), positive definite inside the cone."""
    with phase("CCPBarrier"):
        blocks = at.lam[:, None, None] * at.hessian
        blocks += (at.lam / -at.f)[:, None, None] * at.df[:, :, None] * at.df[:, None, :]
        blocks[:, [0, 1, 2], [0, 1, 2]] += proximal
        frictionless = at.problem.mu == 0
        if frictionless.any():  # hold the tangential impulses at zero
            stiff = 1e12 * np.maximum(blocks[frictionless, 0, 0], 1)
            blocks[frictionless, 1, 1] = blocks[frictionless, 2, 2] = stiff
        return blocks


def _step_length(at: Linearised, dg: Array, dlam: Array, options: PDIP) -> float:
    """Longest step, at most 1, inside the cones, near the central path; nan if the direction is no number."""
    problem, cone, g, lam = at.problem, at.cone, at.g, at.lam
    if not np.isfinite(problem.sum(dg.sum() + dlam.sum())):
        return np.nan
    step = min(1.0, options.boundary * problem.min(min(step_to_boundary(g, dg, cone.mu), step_to_zero(lam, dlam))))
    while step > 1e-10:
        gap = -(lam + step * dlam) * cone.value(g + step * dg)
        mean = problem.sum(gap.sum()) / problem.size
        if problem.min(gap.min(initial=np.inf)) >= options.neighbourhood * mean:
            break
        step *= 0.8
    return step
