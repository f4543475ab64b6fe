"""The paper's primal-dual interior point method (PDIP) for the cone problem.

Newton's method on the perturbed optimality conditions of min 1/2 g'Ng + r'g, f(g) <= 0 (paper, section 2.4):

    N g + r + sum lambda_i grad f_i = 0,    -lambda_i f_i = 1/t,

with the multipliers eliminated:

    S dg = -(N g + r + grad f / (-t f)),    S = N + lambda hess f + lambda/(-f) grad f grad f'.

Where the paper's form creeps (134 Newton steps at 17,911 contacts, natural residual 6e-5), this one differs
in five points, each measured in ``docs/notebook_ccp.md``: the constraint is the cone's perspective form; steps end at
0.9 of the way to the boundary and inside a neighbourhood of the central path, rather than at 0.99 and where the
multiplier residual falls; a direction that the cones' curvature cuts short is corrected, and after short steps near the
solution S has a proximal term; and the natural residual alone decides when to stop.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from pctt.ccp.cone import Array, dot, step_to_boundary, step_to_zero, times
from pctt.ccp.interior import useful_part
from pctt.ccp.newton import Newton
from pctt.ccp.problem import ConeProblem
from pctt.ccp.result import Limits, Result, Status
from pctt.log import phase
from pctt.options import FRACTION, number, option

CONSTRAINTS = ("perspective", "quadratic")


@dataclass(frozen=True)
class PDIP:
    """Options ``-ccp_pdip_*`` and the other numbers of the method; docs/notebook_ccp.md has what was measured."""

    constraint: str = option(
        "perspective", "form of the cone constraint; quadratic is the paper's", choices=CONSTRAINTS
    )
    centering: float = option(
        0.3, "complementarity aimed at, as a part of the present one (the paper: 0.1)", check=FRACTION
    )
    boundary: float = option(
        0.9, "part of the way to the cone's boundary that a step may go (the paper: 0.99)", check=FRACTION
    )
    neighbourhood: float = number(1e-4, "least complementarity of a contact, as a part of the mean; below, steps stick")
    start: float = number(10.0, "normal impulse of new contacts [rms(r) / mean diag N]: 1 N s in a settled packing")
    rtol: float = number(3e-4, "relative residual of a linear solve; with 1 it takes twice the Newton steps")
    forcing: float = number(0.03, "the same at most [velocity that the natural residual shows]; `solve`")
    short: float = number(0.5, "the direction of a shorter step is corrected; without, 1.7 times the Newton steps")
    reach: float = number(0.3, "how much further than the short step the corrected one is to reach")
    longer: float = number(1.2, "times longer that the corrected step must be; else Newton's direction is better")
    back: float = number(0.8, "factor on a step that leaves the neighbourhood, so a fifth too short at most")
    least: float = number(1e-10, "shorter steps change the impulses by less than the tightest tolerance asks")
    late: float = number(1e-3, "natural residual below which S has a proximal term; `_next_damping`")


@dataclass(frozen=True)
class Cone:
    """The friction cones as constraints f(g) <= 0, whose first and second derivatives exist inside.

    quadratic : the paper's f = 1/2 (|g_t|^2 - mu^2 g_n^2), g_n > 0. Its gradient vanishes at the apex, so that the
        multipliers of contacts that open diverge.
    perspective : the same divided by g_n, convex and of degree one. Its gradient stays away from zero.

    A contact without friction has no interior: its constraint is -g_n <= 0.
    """

    constraint: str
    mu: Array

    @property
    def frictionless(self) -> np.ndarray:
        return self.mu == 0

    def value(self, g: Array) -> Array:
        """f (nc,)."""
        f = 0.5 * (g[:, 1] ** 2 + g[:, 2] ** 2 - (self.mu * g[:, 0]) ** 2)
        if self.constraint == "perspective":
            f /= g[:, 0]
        return np.where(self.frictionless, -g[:, 0], f)

    def gradient(self, g: Array) -> Array:
        """(nc, 3)."""
        df = g.copy()
        df[:, 0] *= -(self.mu**2)
        if self.constraint == "perspective":
            df[:, 1:] /= g[:, :1]
            df[:, 0] = -0.5 * (df[:, 1] ** 2 + df[:, 2] ** 2 + self.mu**2)
        df[self.frictionless] = [-1.0, 0.0, 0.0]
        return df

    def hessian(self, g: Array) -> Array:
        """(nc, 3, 3)."""
        H = np.zeros((len(g), 3, 3))
        H[:, 1, 1] = H[:, 2, 2] = 1.0
        H[:, 0, 0] = -(self.mu**2)
        if self.constraint == "perspective":
            slope = g[:, 1:] / g[:, :1]
            H[:, 0, 0] = (slope**2).sum(1)
            H[:, 0, 1:] = H[:, 1:, 0] = -slope
            H /= g[:, :1, None]
        H[self.frictionless] = 0.0
        return H


def solve(problem: ConeProblem, guess: Array, limits: Limits, options: PDIP, newton: Newton) -> Result:
    """Impulses; ``guess`` (nc, 3) gives the normal impulses of persistent contacts, 0 elsewhere."""
    cone = Cone(options.constraint, problem.mu)
    newton.begin(problem)
    linear = newton.linear
    g, lam = _start(problem, guess, cone, options)
    history: list[float] = []
    earlier: deque[Array] = deque(maxlen=3)
    step, damping = 1.0, 0.0
    for iteration in range(limits.max_it + 1):
        # residuals
        y = _velocity(problem, g)
        errors = problem.errors(g, y)
        history.append(limits.residual(errors))
        if history[-1] <= limits.tol:
            status, reason = Status.CONVERGED, limits.met
            break
        if iteration == limits.max_it:
            status, reason = Status.ITERATION_LIMIT, f"{limits.max_it} Newton steps"
            break
        # linearisation
        f, df, hessian = cone.value(g), cone.gradient(g), cone.hessian(g)
        aim = options.centering * problem.sum(-(lam @ f)) / problem.size  # 1/t
        at = Linearised(problem, newton, cone, g, lam, y, f, df, hessian, earlier)
        damping = _next_damping(damping, step, errors.natural, options)
        newton.update(_barrier_blocks(at, damping * errors.natural * problem.mean_diagonal))
        # Newton step. The residual of a solve is a velocity. It must be only a part of those that the natural residual
        # stands for: otherwise complementarity would fall without them, and near the boundary no step makes up for that
        q = _right_side(at, aim)
        shown = errors.natural * problem.norm(g) * problem.mean_diagonal
        tol = min(options.rtol * problem.norm(q), options.forcing * shown)
        dg, dlam = _direction(at, q, aim, tol)
        step = _step_length(at, dg, dlam, options)
        # corrected step, where the cones' curvature cuts Newton's short and the other is much longer
        if step < options.short:
            curved, missed = _bend(at, dg, dlam, min(1.0, step + options.reach))
            other_dg, other_dlam = _direction(at, _right_side(at, aim + missed) - curved, aim + missed, tol)
            other = _step_length(at, other_dg, other_dlam, options)
            if other > options.longer * step:
                step, dg, dlam = other, other_dg, other_dlam
        if not step > options.least:
            status, reason = Status.STALLED, "steps became too short"
            if step != step:
                status, reason = Status.BREAKDOWN, "not a number in the Newton step"
            break
        # update
        g = g + step * dg
        lam = lam + step * dlam
    return Result(g, status, reason, history[-1], iteration, linear.iterations, linear.fallbacks, history)


class Linearised(NamedTuple):
    """The data that all directions of a Newton step share: the problem, impulses and multipliers, velocities, the
    constraints with their first and second derivatives, and the last solutions of Newton systems."""

    problem: ConeProblem
    newton: Newton
    cone: Cone
    g: Array
    lam: Array
    y: Array
    f: Array
    df: Array
    hessian: Array
    earlier: deque[Array]


def _next_damping(damping: float, step: float, natural: float, options: PDIP) -> float:
    """The factor of the proximal term natural residual * mean diag N * I in S, after a step of length ``step``.

    Forces that hold each other move no body, and only the barrier bounds them: directions along them are long, leave
    the cones at once, and cut the rest of the step short. The term shortens them. It leaves a velocity of rho dg, which
    is less than the natural residual shows. Early, impulses may have to grow by orders of magnitude: there is none."""
    if natural > options.late:
        return 0.0
    if step < 0.3:
        return min(max(1.0, 4.0 * damping), 4.0)
    return damping / 4.0 if step > 0.7 else damping


def _right_side(at: Linearised, aim: Array | float) -> Array:
    """Of the Newton system, for the complementarity ``aim``, of all contacts or of each."""
    return (aim / at.f)[:, None] * at.df - at.y


def _direction(at: Linearised, q: Array, aim: Array | float, tol: float) -> tuple[Array, Array]:
    """dg and dlam for the right-hand side q and the complementarity ``aim``."""
    dg, x = at.newton.solve(q, tol, earlier=at.earlier)
    at.earlier.append(x)
    dg[at.cone.frictionless, 1:] = 0.0
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


def _start(problem: ConeProblem, guess: Array, cone: Cone, options: PDIP) -> tuple[Array, Array]:
    """Impulses on the cones' axes and multipliers of equal complementarity."""
    closing = problem.norm(_velocity(problem, np.zeros_like(problem.r))) / np.sqrt(problem.size)
    new = options.start * closing / problem.mean_diagonal
    known = useful_part(problem, guess)[:, 0]
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
        free = at.cone.frictionless  # hold their tangential impulses at zero
        blocks[free, 1, 1] = blocks[free, 2, 2] = 1e12 * np.maximum(blocks[free, 0, 0], 1)
        return blocks


def _step_length(at: Linearised, dg: Array, dlam: Array, options: PDIP) -> float:
    """Longest step, at most 1, inside the cones, near the central path; nan if the direction is no number."""
    problem, cone, g, lam = at.problem, at.cone, at.g, at.lam
    if not np.isfinite(problem.sum(dg.sum() + dlam.sum())):
        return np.nan
    step = min(1.0, options.boundary * problem.min(min(step_to_boundary(g, dg, cone.mu), step_to_zero(lam, dlam))))
    while step > options.least:
        gap = -(lam + step * dlam) * cone.value(g + step * dg)
        mean = problem.sum(gap.sum()) / problem.size
        if problem.min(gap.min(initial=np.inf)) >= options.neighbourhood * mean:
            break
        step *= options.back
    return step
