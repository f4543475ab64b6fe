"""The primal-dual interior point method (PDIP) for the cone problem, in the project's form; `paper` has the paper's.

Newton's method on the perturbed optimality conditions of min 1/2 g'Ng + r'g, f(g) <= 0 (paper, section 2.4):

    N g + r + sum lambda_i grad f_i = 0,    -lambda_i f_i = 1/t,

with one constraint per contact. With the multipliers eliminated a step is

    S dg = -(N g + r + grad f / (-t f)),    S = N + lambda hess f + lambda/(-f) grad f grad f'.

Where the paper's form creeps, this one differs, as measured in ``docs/notebook_ccp.md``: the constraint is the cone's
perspective form; the complementarity aimed at falls by less; steps end at 0.9 of the way to the boundary and inside a
neighbourhood of the central path, rather than where ||r_t|| falls; a direction that the cones' curvature cuts short is
corrected, and after short steps near the solution S has a proximal term.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import NamedTuple, Optional

import numpy as np

from pctt.arrays import Array, dot
from pctt.ccp.cones.friction import step_to_zero, times
from pctt.ccp.interior import end_of, hold, no_step, paper, useful_part, velocity
from pctt.ccp.newton import Newton
from pctt.ccp.newton.kkt import KKT
from pctt.ccp.problem import ConeProblem
from pctt.ccp.result import Limits, Result
from pctt.log import phase
from pctt.options import FRACTION, number, option

#: Steps after which the proximal term grows or shrinks by the factor; it is at most the factor.
SHORT, LONG, FACTOR = 0.3, 0.7, 4.0
PERSPECTIVE, PAPER = FORMS = ("perspective", "paper")


@dataclass(frozen=True)
class PDIP:
    """Options ``-ccp_pdip_*`` and the other numbers of the method; docs/notebook_ccp.md has what was measured."""

    form: str = option(
        PERSPECTIVE,
        "perspective: one smooth constraint per contact; paper: the paper's two, with its start and its line search",
        choices=FORMS,
    )  # fmt: skip
    centering: Optional[float] = option(
        None, "complementarity aimed at, as a part of the present one; none: 0.3, and 0.1 in the form paper",
        check=FRACTION,
    )  # fmt: skip
    boundary: Optional[float] = option(
        None, "part of the way to the boundary that a step may go: of the cones, and in the form paper of lambda > 0; "
        "none: 0.9, and 0.99 in the form paper", check=FRACTION,
    )  # fmt: skip
    neighbourhood: float = number(1e-4, "least complementarity of a contact, as a part of the mean; below, steps stick")
    start: float = number(10.0, "normal impulse of new contacts [rms(r) / mean diag N]: 1 N s in a settled packing")
    rtol: float = number(3e-4, "relative residual of a linear solve; with 1 it takes twice the Newton steps")
    forcing: float = number(0.03, "the same at most [velocity that the natural residual shows]; `solve`")
    short: float = number(0.5, "the direction of a shorter step is corrected; without, 1.7 times the Newton steps")
    reach: float = number(0.3, "how much further than the short step the corrected one is to reach")
    longer: float = number(1.2, "times longer that the corrected step must be; else Newton's direction is better")
    backtracking: float = number(0.8, "factor on a step that leaves the neighbourhood, so a fifth too short at most")
    least: float = number(1e-10, "shorter steps change the impulses by less than the tightest tolerance asks")
    late: float = number(1e-3, "natural residual below which S has a proximal term; `_next_damping`")


@dataclass(frozen=True)
class PerspectiveConstraint:
    """The friction cones as constraints f(g) <= 0, with first and second derivatives inside: the perspective form
    f = 1/2 (|g_t|^2 / g_n - mu^2 g_n), convex and of degree one. Its gradient stays away from zero.

    A contact without friction has no interior: its constraint is -g_n <= 0.
    """

    mu: Array

    @property
    def frictionless(self) -> np.ndarray:
        return self.mu == 0

    def value(self, g: Array) -> Array:
        """f (nc,)."""
        f = 0.5 * (g[:, 1] ** 2 + g[:, 2] ** 2 - (self.mu * g[:, 0]) ** 2) / g[:, 0]
        return np.where(self.frictionless, -g[:, 0], f)

    def gradient(self, g: Array) -> Array:
        """(nc, 3)."""
        df = g / g[:, :1]
        df[:, 0] = -0.5 * (df[:, 1] ** 2 + df[:, 2] ** 2 + self.mu**2)
        df[self.frictionless] = [-1.0, 0.0, 0.0]
        return df

    def hessian(self, g: Array) -> Array:
        """(nc, 3, 3)."""
        H, slope = np.zeros((len(g), 3, 3)), g[:, 1:] / g[:, :1]
        H[:, 0, 0] = (slope**2).sum(1)
        H[:, 0, 1:] = H[:, 1:, 0] = -slope
        H[:, 1, 1] = H[:, 2, 2] = 1.0
        H /= g[:, :1, None]
        H[self.frictionless] = 0.0
        return H

    def kkt(self, f: Array, df: Array, hessian: Array, lam: Array, proximal: float) -> KKT:
        """What the constraints, with these values, derivatives and multipliers, and a term ``proximal`` I add to N."""
        M = lam[:, None, None] * hessian
        M[:, [0, 1, 2], [0, 1, 2]] += proximal
        hold(M, self.frictionless, lam / -f)
        return KKT(M, df[:, None], f[:, None], lam[:, None])


def solve(problem: ConeProblem, guess: Array, limits: Limits, options: PDIP, newton: Newton) -> Result:
    """Impulses; ``guess`` (nc, 3) gives the normal impulses of persistent contacts, 0 elsewhere."""
    if options.form == PAPER:
        return paper.solve(problem, guess, limits, newton, options.centering or 0.1, options.boundary or 0.99)
    newton.begin(problem)
    barrier = BarrierProblem(problem, options)
    at, history, step, damping = barrier.start(guess), list[float](), 1.0, 0.0
    last, earlier = at, deque[Array](maxlen=3)
    for iteration in range(limits.max_it + 1):
        # residuals
        errors = problem.errors(at.g, at.y)
        history.append(limits.residual(errors))
        limits.report(iteration, history[-1])
        if end := end_of(problem, limits, history, at.g - last.g, at.y - last.y):
            break
        # linearisation
        damping = _next_damping(damping, step, errors.natural, options)
        linear = barrier.linearised(at, errors.natural, damping, newton, earlier)
        # Newton step
        direction = linear.direction()
        step = linear.step(direction)
        # corrected step, where the cones' curvature cuts Newton's short and the other is much longer
        if step < options.short:
            other = linear.direction(*linear.second_order(direction, min(1.0, step + options.reach)))
            longer = linear.step(other)
            if longer > options.longer * step:
                step, direction = longer, other
        if not step > options.least:
            end = no_step(step, "steps became too short")
            break
        # update
        last, at = at, barrier.moved(at, direction, step)
    counts = newton.linear.iterations, newton.linear.fallbacks
    assert end is not None
    return Result(at.g, *end, history[-1], iteration, *counts, history)


class Point(NamedTuple):
    """An iterate: impulses inside the cones, their velocities, and the multipliers."""

    g: Array
    y: Array
    lam: Array


class Direction(NamedTuple):
    """A change of a `Point`."""

    dg: Array
    dlam: Array


class BarrierProblem:
    """The cone problem with a constraint, and a multiplier, for each contact."""

    def __init__(self, problem: ConeProblem, options: PDIP):
        self.problem, self.options = problem, options
        self.constraint = PerspectiveConstraint(problem.mu)
        self.centering, self.boundary = options.centering or 0.3, options.boundary or 0.9

    def start(self, guess: Array) -> Point:
        """Impulses on the cones' axes and multipliers of equal complementarity."""
        problem = self.problem
        closing = problem.norm(velocity(problem, np.zeros_like(problem.r))) / np.sqrt(problem.size)
        new = self.options.start * closing / problem.mean_diagonal
        known = useful_part(problem, guess)[:, 0]
        g = np.zeros_like(problem.r)
        g[:, 0] = np.where(known > 0, np.maximum(known, 0.1 * new), new)
        y = velocity(problem, g)
        speed = problem.norm(y) / np.sqrt(problem.size)
        mean_normal = problem.sum(g[:, 0].sum()) / problem.size
        mean_mu = problem.sum(problem.mu.sum()) / problem.size
        return Point(g, y, 3 * speed * mean_normal * (mean_mu or 1.0) / -self.constraint.value(g))

    def linearised(
        self, at: Point, natural: float, damping: float, newton: Newton, earlier: deque[Array]
    ) -> Linearised:
        """The linear equations of an iterate with this natural residual; ``earlier`` solutions are where their solves
        begin."""
        problem, constraint = self.problem, self.constraint
        f, df, hessian = constraint.value(at.g), constraint.gradient(at.g), constraint.hessian(at.g)
        aim = self.centering * problem.sum(-(at.lam @ f)) / problem.size  # 1/t
        with phase("CCPBarrier"):
            kkt = constraint.kkt(f, df, hessian, at.lam, damping * natural * problem.mean_diagonal)
        newton.linearise(kkt)
        # The residual of a solve is a velocity. It must be only a part of those that the natural residual stands for:
        # otherwise complementarity would fall without them, and near the boundary no step makes up for that
        r_g, r_lam = -(at.y + at.lam[:, None] * df), (at.lam * f + aim)[:, None]
        shown = natural * problem.norm(at.g) * problem.mean_diagonal
        tol = min(self.options.rtol * problem.norm(kkt.reduced(r_g, r_lam)), self.options.forcing * shown)
        return Linearised(self, at, newton, f, df, hessian, aim, r_g, tol, earlier)

    def moved(self, at: Point, d: Direction, step: float) -> Point:
        """The point after a step."""
        g = at.g + step * d.dg
        return Point(g, velocity(self.problem, g), at.lam + step * d.dlam)


class Linearised(NamedTuple):
    """An iteration's linear equations, which all its directions share.

    at : the iterate
    f, df, hessian : the constraints there, and their first and second derivatives
    aim : the complementarity 1/t
    r_g : the first part of -r_t (nc, 3)
    tol : residual to which Newton systems are solved [m/s]
    earlier : the last solutions of Newton systems
    """

    barrier: BarrierProblem
    at: Point
    newton: Newton
    f: Array
    df: Array
    hessian: Array
    aim: float
    r_g: Array
    tol: float
    earlier: deque[Array]

    def direction(self, curved: Array | float = 0.0, missed: Array | float = 0.0) -> Direction:
        """The direction for the right-hand side less ``curved`` (nc, 3), and ``missed`` (nc,) more complementarity."""
        r_lam = (self.at.lam * self.f + (self.aim + missed))[:, None]
        dg, dlam, x = self.newton.step(self.r_g - curved, r_lam, self.tol, earlier=self.earlier)
        self.earlier.append(x)
        dg[self.barrier.constraint.frictionless, 1:] = 0.0
        return Direction(dg, dlam[:, 0])

    def second_order(self, d: Direction, reach: float) -> tuple[Array, Array]:
        """The terms that the linearised conditions lack at ``reach`` along a direction, divided by ``reach``: those of
        second order of sum lambda_i grad f_i (without third derivatives) and of lambda_i f_i. A contact that slides has
        to turn its impulse along the cone, and straight steps leave it soon."""
        turned = times(self.hessian, d.dg)
        missed = d.dlam * dot(self.df, d.dg) + 0.5 * self.at.lam * dot(d.dg, turned)
        return reach * d.dlam[:, None] * turned, reach * missed

    def step(self, d: Direction) -> float:
        """Longest step, at most 1, inside the cones, near the central path; nan if the direction is no number."""
        problem, options, value = self.barrier.problem, self.barrier.options, self.barrier.constraint.value
        g, lam = self.at.g, self.at.lam
        if not np.isfinite(problem.sum(d.dg.sum() + d.dlam.sum())):
            return np.nan
        longest = problem.min(min(problem.cones.step_length(g, d.dg), step_to_zero(lam, d.dlam)))
        step = min(1.0, self.barrier.boundary * longest)
        while step > options.least:
            gap = -(lam + step * d.dlam) * value(g + step * d.dg)
            mean = problem.sum(gap.sum()) / problem.size
            if problem.min(gap.min(initial=np.inf)) >= options.neighbourhood * mean:
                break
            step *= options.backtracking
        return step


def _next_damping(damping: float, step: float, natural: float, options: PDIP) -> float:
    """The factor of the proximal term natural residual * mean diag N * I in S, after a step of length ``step``.

    Forces that hold each other move no body, and only the barrier bounds them: directions along them are long, leave
    the cones at once, and cut the rest of the step short. The term shortens them. It leaves a velocity of rho dg, which
    is less than the natural residual shows. Early, impulses may have to grow by orders of magnitude: there is none."""
    if natural > options.late:
        return 0.0
    if step < SHORT:
        return min(max(1.0, FACTOR * damping), FACTOR)
    return damping / FACTOR if step > LONG else damping
