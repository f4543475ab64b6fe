"""Symmetric cone interior point method: Nesterov-Todd scaling, Mehrotra's predictor and corrector.

In the variables s = (mu g_n, g_t) and z = (y_n / mu, y_t) all cones are the same and self-dual. The method follows
the central path s o z = t e of

    v = G' g,    y = G v + C g + r,    s and z in the cones, s'z = 0,

with the mass-scaled momenta v as unknowns of their own: what an inexact linear solve leaves (``-ccp_newton body``)
spoils v = G' g alone, which the next step mends. With W the scaling of the pair (s, z), a step solves

    dz = G dv + C dg + r_z,    dv = G' dg - r_v,    W^-1 ds + W dz = w - W z.

Late in an iteration W^2 is large along an impulse that slides, and W^2 z, which is s, drowns in rounding when it is
multiplied out: what each contact would do alone, ds = W w - s, is formed from s instead.

For Coulomb's law z is that of the De Saxce velocity, (y_n / mu + |y_t|, y_t). Newton's method takes the derivative of
the opening along: with u = y_t / |y_t|,

    dz = T (G dv + C dg) + r_z,    T = 1 + e_n u',

which adds a term of rank one per contact to the elimination of ds, and makes the Newton systems unsymmetric. (Openings
that lag behind converge by a fifth per cone problem, each solved exactly.)

Source: Nesterov and Todd (1997), Mehrotra (1992); Acary, Armand, Nguyen and Shpakovych, "Second-order cone
programming for frictional contact mechanics using interior point algorithm", Optim. Methods Softw. (2023), for their
use with friction."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from pctt.ccp.cone import TINY, Array, add_opening, dot, tangential, times
from pctt.ccp.interior import lorentz
from pctt.ccp.interior.guess import no_larger_than_useful
from pctt.ccp.interior.lorentz import NesterovTodd
from pctt.ccp.newton import Newton
from pctt.ccp.problem import ConeProblem
from pctt.ccp.result import Limits, Result, Status
from pctt.ccp.unbounded import why_unbounded
from pctt.log import phase
from pctt.options import FRACTION, NOT_NEGATIVE, POSITIVE, option

CENTERING = 0.02  # per deviation from the central path
CLOSER = 0.01  # impulses as unknowns: what a linear solve leaves moves velocities, and they are compared with zero
SHORT = 0.8  # a step after which the direction is corrected
CORRECTIONS, FURTHER = 3, 0.3  # at most so many, for a step that goes so much further
LATE = 1e-2  # natural residual below which second-order terms are renewed, after a step with progress: else that may
# send impulses off where next to nothing bounds them
LEAST = 0.01  # part of the complementarity to aim at
NEAR = 0.1, 10.0  # the central path, in units of the complementarity that is aimed at
PATIENCE = 3  # iterations without progress before the Newton systems are sharpened
LONG_PATIENCE, SHARPER = 8, 0.01  # for Coulomb's law: before it stalls; part of the forcing term
LONGER, LESS = 1.02, 0.7  # a short step, or what a long one leaves of the complementarity, after a correction to keep


@dataclass(frozen=True)
class Conic:
    """Options ``-ccp_conic_*``."""

    start: float = option(30.0, "complementarity of the start, in units of mean(r^2) / mean diag N", check=POSITIVE)
    forcing: float = option(0.3, "residual of a linear solve, as a part of the natural residual", check=POSITIVE)
    proximal: float = option(
        1e-9, "compliance within a step, in units of mean diag N; the answer does not have it", check=NOT_NEGATIVE
    )
    boundary: float = option(0.99, "part of the way to the cone's boundary that a step may go", check=FRACTION)


def solve(
    problem: ConeProblem, guess: Array, limits: Limits, options: Conic, newton: Newton, coulomb: bool = False
) -> Result:
    """Impulses, of the cone problem or of Coulomb's law; ``guess`` (nc, 3) holds those of the last step. Default
    iteration limit 60."""
    max_it = limits.max_it if limits.max_it >= 0 else 60
    newton.begin(problem)
    if coulomb and not newton.takes_any:
        words = "Coulomb's law needs -ccp_newton body and its own linear solver"
        return Result(guess, Status.GIVEN_UP, words, np.inf, 0)
    scale, frictionless = _cone_scale(problem.mu)
    s, z = _start(problem, guess, scale, frictionless, options, coulomb)
    v = problem.momentum(s / scale)
    best, history, patience, last_gap = s / scale, [], 0, np.inf
    for iteration in range(max_it + 1):
        g = s / scale
        r_v, r_z, u = _residuals(problem, g, z, v, scale, frictionless, coulomb)
        gap = problem.dot(s, z)
        history.append(problem.natural_residual(g, _velocity(problem, g, frictionless, coulomb)))
        best = g if history[-1] <= min(history) else best
        progress = history[-1] <= 0.9 * min(history[:-1], default=np.inf) or gap <= 0.5 * last_gap
        patience, last_gap = (0 if progress else patience + 1), gap
        if history[-1] <= limits.tol or iteration == max_it or why_unbounded(problem, g):
            break
        if patience > (LONG_PATIENCE if coulomb else PATIENCE):
            if coulomb or not newton.sharpen():
                break
            patience = 0
        W = NesterovTodd.of(s, z)
        B, inverse, yielding = _barrier_blocks(problem, W, scale, frictionless, options.proximal)
        slip = _slip(problem, inverse, u, scale, options.proximal) if coulomb else None
        newton.update(B, inverse if slip is None else inverse + slip.blocks, symmetric=slip is None)
        # a residual of v = G' g makes y wrong by G times that
        tol = options.forcing * history[-1] * problem.norm(g) * np.sqrt(problem.mean_diagonal)
        tol *= 1.0 if newton.primary == "momenta" else CLOSER
        tol *= SHARPER if coulomb else 1.0
        local = Linearised(s, z, r_v, r_z, W, inverse, yielding, scale, frictionless, tol, slip)

        with phase("ConicPredictor"):
            ds, dz, dv, x = _direction(problem, newton, local, np.zeros_like(z))
            reach = min(1.0, _step(problem, s, z, ds, dz))
            target = max((1.0 - reach) ** 3, _centering(problem, s, z), LEAST) * gap / problem.size
        with phase("ConicCorrector"):
            w = _centred(W, z, ds, dz, target)
            ds, dz, dv, x = _direction(problem, newton, local, w, x)
            step = min(1.0, options.boundary * _step(problem, s, z, ds, dz))
            for _ in range(CORRECTIONS):
                short = step < SHORT
                if short:
                    w = w + _towards_path(W, z, ds, dz, min(1.0, step + FURTHER), target)
                elif newton.factored and patience == 0 and history[-1] < LATE:  # another solve costs next to nothing
                    w = _centred(W, z, ds, dz, target)
                else:
                    break
                again = _direction(problem, newton, local, w, x)
                longer = min(1.0, options.boundary * _step(problem, s, z, *again[:2]))
                if short and longer < LONGER * step:
                    break
                if not short and _left(problem, s, z, longer, *again) > LESS * _left(problem, s, z, step, ds, dz):
                    break
                step, (ds, dz, dv, x) = longer, again
        if step > 0:
            s, z, v = s + step * ds, z + step * dz, v + step * dv
    status, words = Status.STALLED, f"stalled after {iteration} iterations"
    if history[-1] <= limits.tol:
        status, words = Status.CONVERGED, "natural residual below the tolerance"
    elif iteration == max_it:
        status, words = Status.ITERATION_LIMIT, f"{max_it} iterations"
    return Result(best, status, words, min(history), iteration, newton.ksp_its, newton.fallbacks, history)


def _cone_scale(mu: Array) -> tuple[Array, Array]:
    """(mu, 1, 1) per contact (nc, 3), and which contacts have no friction: their normal is kept as it is, and their
    tangential part, which the problem does not have, is held at zero."""
    scale = np.ones((len(mu), 3))
    frictionless = mu == 0
    scale[:, 0] = np.where(frictionless, 1.0, mu)
    return scale, frictionless


def _velocity(problem: ConeProblem, g: Array, frictionless: Array, coulomb: bool) -> Array:
    """y = N g + r but for the sliding of contacts without friction, which no impulse answers; for Coulomb's law with
    its opening."""
    y = problem.product(g) + problem.r
    y[frictionless, 1:] = 0.0
    return add_opening(y, problem.mu) if coulomb else y


def _residuals(
    problem: ConeProblem, g: Array, z: Array, v: Array, scale: Array, frictionless: Array, coulomb: bool
) -> tuple[Array, Array, Array]:
    """r_v = v - G' g, r_z = y / scale - z, y with its opening for Coulomb's law, and the directions (nc, 3) in which
    contacts slide."""
    y = problem.velocity_of(v) + problem.compliance * g + problem.r
    y[frictionless, 1:] = 0.0
    u = y / np.maximum(np.maximum(tangential(y), z[:, 0]), TINY)[:, None]  # short where y_t may turn: a contact sticks
    u[:, 0] = 0.0
    if coulomb:
        add_opening(y, problem.mu)
    return v - problem.momentum(g), y / scale - z, u


class Slip(NamedTuple):
    """What the derivative of the opening does to an iteration of Coulomb's law.

    In the scaled variables ds = X (c - r_z - T G dv) with X^-1 = W^-2 + e T, e the compliance. With Y^-1 = W^-2 + e
    this is X = (1 - e p u'/ d) Y and X T = Y + p (u - e Y u)' / d, where p = Y e_n, d = 1 + e u'p.
    """

    u: Array  #: (nc, 3) direction in which a contact slides
    p: Array  #: (nc, 3)
    less: Array  #: (nc, 1) e / d
    blocks: Array  #: (nc, 3, 3) X T - Y


def _slip(problem: ConeProblem, inverse: Array, u: Array, scale: Array, proximal: float) -> Slip:
    give = problem.compliance[:, 1:2] + proximal * problem.mean_diagonal
    p = scale[:, :1] * inverse[:, :, 0]
    d = 1.0 + give * dot(u, p)[:, None]
    q = (u - give * times(inverse, u)) / d
    return Slip(u, p, give / d, p[:, :, None] * q[:, None, :])


def _start(
    problem: ConeProblem, guess: Array, scale: Array, frictionless: Array, options: Conic, coulomb: bool
) -> tuple[Array, Array]:
    """A pair on the central path near the guess: s - tau z = s_0 - tau z_0."""
    guess = no_larger_than_useful(problem, guess)
    s, z = guess * scale, _velocity(problem, guess, frictionless, coulomb) / scale
    s[frictionless, 1:] = 0.0
    diagonal = np.diagonal(problem.diagonal_blocks, axis1=1, axis2=2) / scale**2
    tau = 1.0 / np.maximum(diagonal.mean(1), 1e-3 * problem.mean_diagonal)
    closing = problem.dot(problem.r, problem.r) / problem.size
    amount = options.start * closing / problem.mean_diagonal
    return lorentz.central_pair(s - tau[:, None] * z, tau, amount)


class Linearised(NamedTuple):
    """What the directions of an iteration share: the pair, its residuals and scaling, (B + C)^-1 and, in the scaled
    variables, (B + C)^-1 B, the cones' scale, how accurately to solve, and what Coulomb's law adds."""

    s: Array
    z: Array
    r_v: Array
    r_z: Array
    W: NesterovTodd
    inverse: Array
    yielding: Array
    scale: Array
    frictionless: Array
    tol: float
    slip: Slip | None


def _direction(
    problem: ConeProblem, newton: Newton, at: Linearised, w: Array, start: Array | None = None
) -> tuple[Array, Array, Array, Array]:
    """ds, dz, dv and the Newton system's solution for the right-hand side w; ``start``: an earlier solution."""
    c = at.W.divide(w) - at.z
    alone = times(at.yielding, at.W.times(w) - at.s)
    alone /= at.scale
    alone -= times(at.inverse, at.r_z * at.scale)
    if at.slip is not None:
        alone -= at.slip.p * (at.slip.less * dot(at.slip.u, alone)[:, None])
    dg, x = newton.solve((c - at.r_z) * at.scale, at.tol, at.r_v, start, alone)
    dv = newton.momentum(x, dg, at.r_v)
    ds = dg * at.scale
    if newton.primary == "momenta":  # r_z vanishes, r_v takes the error of the linear solve
        dz = (problem.velocity_of(dv) + problem.compliance * dg) / at.scale
        if at.slip is not None:
            dz[:, 0] += dot(at.slip.u, dz)
        dz += at.r_z
    else:  # r_v vanishes, r_z takes it
        dz = c - at.W.divide(at.W.divide(ds))
    dz[at.frictionless, 1:] = ds[at.frictionless, 1:] = 0.0
    return ds, dz, dv, x


def _barrier_blocks(
    problem: ConeProblem, W: NesterovTodd, scale: Array, frictionless: Array, proximal: float
) -> tuple[Array, Array, Array]:
    """B, (B + C)^-1 and, in the scaled variables, (B + C)^-1 B (nc, 3, 3)."""
    with phase("CCPBarrier"):
        soft = proximal * problem.mean_diagonal
        give = problem.compliance[:, 1] + soft  # the same along all axes of the scaled variables
        B, inverse, yielding = W.barrier_blocks(scale, give, soft)
        if frictionless.any():
            stiff = 1e12 * np.maximum(B[frictionless, 0, 0], problem.mean_diagonal)
            B[frictionless, 1, 1] = B[frictionless, 2, 2] = stiff
            for blocks in (inverse, yielding):
                blocks[frictionless, 1:] = blocks[frictionless, :, 1:] = 0.0
        return B, inverse, yielding


def _centred(W: NesterovTodd, z: Array, ds: Array, dz: Array, target: float) -> Array:
    """The w of a direction that aims at s o z = target e, with the second-order term of the last direction."""
    aim = -lorentz.product(W.divide(ds), W.times(dz))
    aim[:, 0] += target
    return lorentz.divide(W.times(z), aim)


def _towards_path(W: NesterovTodd, z: Array, ds: Array, dz: Array, reach: float, target: float) -> Array:
    """What to add to w so that the eigenvalues of s o z, ``reach`` along the direction, come near the target.

    Source: Gondzio (1996), multiple centrality corrections; here with the eigenvalues of second-order cones."""
    centre = W.times(z)
    after = lorentz.product(centre + reach * W.divide(ds), centre + reach * W.times(dz))
    return lorentz.divide(centre, lorentz.towards_interval(after, NEAR[0] * target, NEAR[1] * target))


def _centering(problem: ConeProblem, s: Array, z: Array) -> float:
    """The least part of the complementarity to aim at: more, the further the pair is off the central path. On it s o
    z has no tangential part; off it the sliding directions of impulse and velocity differ by an angle that falls like
    the root of the complementarity only."""
    turned = lorentz.product(s, z)
    off = problem.norm(turned[:, 1:]) / max(problem.norm(turned[:, 0]), 1e-300)
    return min(CENTERING * off, 0.5)


def _left(problem: ConeProblem, s: Array, z: Array, step: float, ds: Array, dz: Array, *_: Array) -> float:
    """Complementarity after a step."""
    return problem.dot(s + step * ds, z + step * dz)


def _step(problem: ConeProblem, s: Array, z: Array, ds: Array, dz: Array) -> float:
    """Longest step that keeps both in the cones of all ranks; 0 where a direction is no number."""
    longest = problem.min(min(lorentz.step_to_boundary(s, ds), lorentz.step_to_boundary(z, dz)))
    return longest if np.isfinite(problem.sum(float(ds.sum() + dz.sum()))) else 0.0
