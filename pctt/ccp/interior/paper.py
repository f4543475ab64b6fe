"""The paper's primal-dual interior point method for the cone problem, as the paper gives it (section 2.4).

    min 1/2 g'Ng + r'g,    f_i = 1/2 (|g_t|^2 - mu^2 g_n^2) <= 0,    f_{Nc+i} = -g_n <= 0,

with a multiplier for each of the 2Nc constraints, and Newton's method on r_t(g, lambda) = 0,

    r_t = (N g + r + sum lambda_i grad f_i,  -lambda_i f_i - 1/t).

The paper asks for "a backtracking line search, and a strategy to increase t", and says of the start that g_t = 0 and
that g_n is the last impulse of a contact or "a constant preset value (e.g. 1)", here 1 N s. What it leaves open is
taken from Boyd and Vandenberghe, Convex Optimization (2004), section 11.7, whose notation it has:

- the multipliers of the start are -1/(t f_i); the t of the start is 2Nc / (|N g + r| |g|). (The book takes t = 1, which
  has a unit. Steps in which jams come loose are then not solved.)
- t = 10 m / (-f'lambda), m = 2Nc (algorithm 11.2), but only after a step of at least 0.5, and not after each as in the
  book: so the path would be lost (settled mixer, 2,142 contacts: natural residual 3e-4 to 7e-4 after 300 steps, where
  it takes 97 to 113 to 1e-4);
- the line search begins at 0.99 of the way to lambda = 0 and asks for (1 - alpha s) ||r_t||, alpha = 0.01, beta = 0.8
  (the book: 0.3 to 0.8; with 0.5 the residual is 2e-4 to 4e-4 after 300 steps there).

The paper says neither what its target accuracy of 1e-4 measures nor how accurate its linear solves are. Here the
natural residual decides, as in all methods of the project, and the residual of a linear solve is a thousandth of the
right-hand side and 0.03 of the velocity that the natural residual shows, as in `pdip`. Without the second bound a heap
of 40 contacts is not solved in 400 steps. Two slips of the paper are corrected: M-hat has the normal entries
-mu^2 lambda_i (printed mu^2 lambda_i), and multipliers are positive (printed lambda_i < 0).

A contact without friction has no interior: its first constraint is the second, and its tangential impulses are held
at zero.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from pctt.arrays import Array
from pctt.ccp.cones.friction import step_to_zero
from pctt.ccp.interior import end_of, hold, no_step, velocity
from pctt.ccp.newton.kkt import KKT
from pctt.ccp.problem import ConeProblem
from pctt.ccp.result import Limits, Result

if TYPE_CHECKING:
    from pctt.ccp.newton import Newton


def solve(
    problem: ConeProblem, guess: Array, limits: Limits, newton: Newton, target: float, boundary: float
) -> Result:
    """Impulses. ``guess`` (nc, 3) holds the last impulses of persistent contacts, 0 elsewhere; ``target`` is the
    complementarity 1/t aimed at, as a part of the present one, and ``boundary`` the part of the way to lambda = 0."""
    mu, m, free = problem.mu, 2 * problem.size, problem.mu == 0
    newton.begin(problem)
    g = np.zeros_like(problem.r)
    g[:, 0] = np.where(guess[:, 0] > 0, guess[:, 0], 1.0)
    aim = problem.norm(velocity(problem, g)) * problem.norm(g) / m  # 1/t
    lam = -aim / constraints(g, mu)
    history, step = list[float](), 1.0
    last_g, last_y = g, velocity(problem, g)
    for iteration in range(limits.max_it + 1):
        y, f, df = velocity(problem, g), constraints(g, mu), gradients(g, mu)
        errors = problem.errors(g, y)
        history.append(limits.residual(errors))
        limits.report(iteration, history[-1])
        if end := end_of(problem, limits, history, g - last_g, y - last_y):
            break
        last_g, last_y = g, y
        if step >= 0.5:
            aim = target * problem.sum(-np.vdot(f, lam)) / m
        r_g, r_lam = y + np.einsum("ck,cki->ci", lam, df), -lam * f - aim
        kkt = KKT(curvature(f, lam, mu), df, f, lam)
        newton.linearise(kkt)
        shown = errors.natural * problem.norm(g) * problem.mean_diagonal
        tol = min(1e-3 * problem.norm(kkt.reduced(r_g, r_lam)), 0.03 * shown)
        dg, dlam, _ = newton.step(-r_g, -r_lam, tol)
        dg[free, 1:] = 0.0
        step = _line_search(problem, (g, lam, y), (dg, dlam), aim, boundary)
        if not step > 0:
            end = no_step(step, "the line search found no step that makes the residual smaller")
            break
        g, lam = g + step * dg, lam + step * dlam
    assert end is not None
    return Result(g, *end, history[-1], iteration, newton.linear.iterations, newton.linear.fallbacks, history)


def constraints(g: Array, mu: Array) -> Array:
    """f (nc, 2), at impulses g (nc, 3)."""
    cone = 0.5 * (g[:, 1] ** 2 + g[:, 2] ** 2 - (mu * g[:, 0]) ** 2)
    return np.stack([np.where(mu > 0, cone, -g[:, 0]), -g[:, 0]], axis=1)


def gradients(g: Array, mu: Array) -> Array:
    """grad f (nc, 2, 3)."""
    df = np.zeros((len(g), 2, 3))
    df[:, 0], df[:, 1, 0] = g, -1.0
    df[:, 0, 0] *= -(mu**2)
    df[mu == 0, 0] = [-1.0, 0.0, 0.0]
    return df


def curvature(f: Array, lam: Array, mu: Array) -> Array:
    """M-hat = sum lambda_i hess f_i (nc, 3, 3), diagonal; and what holds contacts without friction."""
    M = np.zeros((len(mu), 3, 3))
    M[:, 0, 0], M[:, 1, 1], M[:, 2, 2] = -(mu**2) * lam[:, 0], lam[:, 0], lam[:, 0]
    hold(M, mu == 0, lam[:, 1] / -f[:, 1])
    return M


def _line_search(
    problem: ConeProblem, at: tuple[Array, Array, Array], along: tuple[Array, Array], aim: float, boundary: float
) -> float:
    """The length s of a step from g, lambda and y ``along`` dg and dlambda: at most 1, inside the constraints, and so
    that ||r_t|| falls by a part alpha s. 0 if there is none, nan if the direction is no number."""
    alpha, beta, least = 0.01, 0.8, 1e-10
    (g, lam, y), (dg, dlam) = at, along
    if not np.isfinite(problem.sum(dg.sum() + dlam.sum())):
        return np.nan
    dy = velocity(problem, dg) - velocity(problem, np.zeros_like(dg))

    def residual(s: float) -> float:
        to, other = g + s * dg, lam + s * dlam
        r_g = y + s * dy + np.einsum("ck,cki->ci", other, gradients(to, problem.mu))
        r_lam = -other * constraints(to, problem.mu) - aim
        return float(np.hypot(problem.norm(r_g), problem.norm(r_lam)))

    now = residual(0.0)
    s = min(1.0, boundary * problem.min(step_to_zero(lam.ravel(), dlam.ravel())))
    while s > least:
        inside = problem.max(constraints(g + s * dg, problem.mu).max(initial=-np.inf)) < 0
        if inside and residual(s) <= (1 - alpha * s) * now:
            return s
        s *= beta
    return 0.0
