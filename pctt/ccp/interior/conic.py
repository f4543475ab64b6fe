"""Symmetric cone interior point method: Nesterov-Todd scaling, Mehrotra's predictor and corrector.

In the variables s = (mu g_n, g_t) and z = (y_n / mu, y_t) all cones are the same and self-dual. A contact that resists
rolling and spinning has three such pairs, with one g_n, and y_n is what their z sum to: s = A g and y = A'z
(`pctt.ccp.cones.lorentz`). The method follows the central path s o z = t e of

    v = G' g,    y = G v + C g + r,    s and z in the cones, s'z = 0,

with the mass-scaled momenta v as unknowns of their own: the residual of an inexact linear solve (``-ccp_newton body``)
spoils v = G' g alone, and the next step mends that. With W the scaling of the pair (s, z), a step solves

    A'dz = G dv + C dg + r_y,    dv = G' dg - r_v,    W^-1 ds + W dz = w - W z,    ds = A dg.

Late in an iteration W^2 is large along an impulse that slides, and the product W^2 z, which equals s, drowns in
rounding. So the change of each cone without the others, ds = W w - s, is formed from s instead.

For Coulomb's law z belongs to the De Saxce velocity, (y_n / mu + |y_t|, y_t), and the step takes the derivative of its
term along: with u = y_t / |y_t|,

    A'T^-1 dz = G dv + C dg + r_y,    T = 1 + e_n u',

which makes the Newton systems unsymmetric. (Terms that lag behind converge by a fifth per cone problem, each solved
exactly.) A step is straight in y, so that z takes the term as it is, and not by its derivative.

Source: Nesterov and Todd (1997), Mehrotra (1992); Acary, Armand, Nguyen and Shpakovych, "Second-order cone
programming for frictional contact mechanics using interior point algorithm", Optim. Methods Softw. (2023), for their
use with friction."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from pctt.arrays import TINY, Array, dot, tangential
from pctt.ccp.cones import lorentz
from pctt.ccp.cones.friction import step_to_zero
from pctt.ccp.cones.lorentz import ArrowInverse, NesterovTodd
from pctt.ccp.interior import useful_part
from pctt.ccp.problem import ConeProblem, Errors
from pctt.ccp.result import Limits, Result, Status
from pctt.ccp.unbounded import why_unbounded
from pctt.log import phase
from pctt.options import number

if TYPE_CHECKING:
    from pctt.ccp.newton import Newton

LARGE = 100.0  # of the impulses that the data suggest: smaller ones of an unbounded problem are far from the tolerance
LESS, HALF = 0.9, 0.5  # of the least residual, and of the last complementarity, that count as progress


@dataclass(frozen=True)
class Conic:
    """The numbers of the method; docs/notebook_ccp.md has what was measured. Those ``with_law`` are for Coulomb's law,
    with which a contact next to the boundary has no room to turn."""

    start: float = number(30.0, "complementarity of the start [mean(r^2) / mean diag N]; below 1 steps are short")
    forcing: float = number(0.3, "residual of a linear solve [velocity that the natural residual shows]; 1: 2x steps")
    forcing_with_law: float = number(0.03, "the same; with 0.3 it stalls at 1e-4")
    forcing_of_impulses: float = number(0.003, "the same in the form `contact`, where no step mends it; 0.3: it stalls")
    boundary: float = number(0.99, "part of the way to the cone's boundary that a step may go")
    boundary_with_law: float = number(0.9, "the same; with 0.99 it stalls at 1e-4")
    least: float = number(0.06, "part of the complementarity to aim at at least; with 0.01 some end at 1e-9")
    short: float = number(0.8, "the direction of a shorter step is corrected; without, 1.15 times the iterations")
    reach: float = number(0.3, "how much further than the short step the corrected one is to reach")
    spread: float = number(10.0, "eigenvalues of s o z within this factor of the target stay (Gondzio)")
    proximal: float = number(1e-9, "compliance within a step [mean diag N], bounds (B + C)^-1; 1e-8 to 1e-12 do too")
    patience: int = number(8, "iterations without progress before it gives up; of Coulomb's law some take 6")


def solve(
    problem: ConeProblem, guess: Array, limits: Limits, options: Conic, newton: Newton, coulomb: bool = False
) -> Result:
    """Impulses, of the cone problem or of Coulomb's law; ``guess`` (nc, 3) holds those of the last step."""
    given, problem = problem, newton.begin(problem)
    if coulomb and not newton.linear.takes_unsymmetric:
        words = "Coulomb's law needs the Newton form body and its own linear solver"
        return Result(guess, Status.GIVEN_UP, words, np.inf, 0)
    conic = ConicProblem(problem, options, coulomb, newton.system.error_in_momenta)
    at, history, waited, least, last_gap = conic.start(guess), list[float](), 0, np.inf, np.inf
    recent: tuple[Array, ...] = ()  # solutions of the last step: those of this one are alike
    while True:
        # residuals
        found, gap = conic.residuals(at), problem.dot(at.s, at.z)
        history.append(limits.residual(found.errors))
        limits.report(len(history) - 1, history[-1])
        large = problem.norm(found.g) > LARGE * problem.norm(problem.r) / problem.mean_diagonal
        unbounded = why_unbounded(given, found.g, found.y) if large else ""
        if unbounded or history[-1] == min(history):
            best = found.g
        progress = found.errors.natural <= LESS * least or gap <= HALF * last_gap
        waited = 0 if progress else waited + 1
        least, last_gap = min(found.errors.natural, least), gap
        if history[-1] <= limits.aimed or unbounded or len(history) > limits.max_it or waited > options.patience:
            break
        # scaling
        linear = conic.linearised(at, found)
        newton.update(*linear.blocks(), symmetric=not coulomb)
        # affine step
        with phase("ConicPredictor"):
            affine = linear.direction(newton, np.zeros(at.z.shape), *recent)
        # centring: the further the affine step may go, the less (Mehrotra)
        target = max((1.0 - min(1.0, linear.reach(affine))) ** 3, options.least) * gap / conic.count
        with phase("ConicCorrector"):
            # combined step, with the second-order term of the affine one
            w = linear.mehrotra_correction(affine, target)
            direction = linear.direction(newton, w, affine.x)
            # length: of a step that the cones cut short, towards the central path if that is longer
            step = linear.step(direction)
            if step < options.short:
                w += linear.gondzio_correction(direction, min(1.0, step + options.reach), target)
                other = linear.direction(newton, w, direction.x)
                step, direction = max((step, direction), (linear.step(other), other), key=lambda pair: pair[0])
        # update
        if step > 0:
            at, recent = conic.moved(at, direction, step), (affine.x, direction.x)
    iterations = len(history) - 1
    status, words = Status.STALLED, f"stalled after {iterations} iterations"
    if unbounded:
        status, words = Status.UNBOUNDED, unbounded
    elif min(history) <= limits.tol:
        status, words = Status.CONVERGED, limits.met
    elif iterations == limits.max_it:
        status, words = Status.ITERATION_LIMIT, f"{iterations} iterations"
    counts = newton.linear.iterations, newton.linear.fallbacks
    return Result(best, status, words, min(history), iterations, *counts, history)


class Point(NamedTuple):
    """An iterate: s and z inside the Lorentz cones, mass-scaled momenta."""

    s: Array
    z: Array
    v: Array


class Residuals(NamedTuple):
    """Of an iterate: its impulses and their velocities y = N g + r (rows, 3), their errors, v - G' g, and
    y - A'z with the y of v, z without De Saxce's term."""

    g: Array
    y: Array
    errors: Errors
    r_v: Array
    r_y: Array


class Direction(NamedTuple):
    """A change of a `Point`, and the Newton system's solution ``x`` that it was made from. ``dy`` is dz without the
    change of De Saxce's term."""

    ds: Array
    dz: Array
    dy: Array
    dv: Array
    x: Array


class ConicProblem:
    """The problem in its Lorentz cones: s = A g, y = A'z.

    error_in_momenta : whether the error of an inexact solve is one of momenta, which the next step mends
    compliance, tangential : (count,), and of all cones (k count,), the parts of C within a step
    within : (count, width) the same but for the problem's own C
    """

    def __init__(self, problem: ConeProblem, options: Conic, coulomb: bool, error_in_momenta: bool):
        self.problem, self.options, self.coulomb, self.error_in_momenta = problem, options, coulomb, error_in_momenta
        self.form = problem.cones.lorentz()
        self.count = problem.size * self.form.number  # of Lorentz cones on all ranks
        self.proximal = options.proximal * problem.mean_diagonal
        self.compliance = problem.compliance[: self.form.count, 0] + self.proximal * (self.form.weight**2).sum(0)
        self.tangential = np.full(self.form.weight.size, self.proximal)
        self.tangential[: self.form.count] += problem.compliance[: self.form.count, 1]
        self.within = np.full((self.form.count, self.form.width), self.proximal)
        self.within[:, 0] = self.proximal * (self.form.weight**2).sum(0)
        self.boundary = options.boundary_with_law if coulomb else options.boundary
        forcing = options.forcing_with_law if coulomb else options.forcing
        self.forcing = forcing if error_in_momenta else options.forcing_of_impulses
        self._still = np.zeros((self.form.weight.size, 3))

    def start(self, guess: Array) -> Point:
        """A pair on the central path near the guess: s - tau z = s_0 - tau z_0. Where cones share a normal impulse all
        get the greatest one."""
        problem, form = self.problem, self.form
        guess = useful_part(problem, guess) * form.mask
        y = (problem.product(guess) + problem.r) * form.mask
        diagonal = form.apply(problem.diagonal)
        diagonal[:, 0] /= form.weight.ravel() ** 3
        tau = 1.0 / np.maximum(diagonal.mean(1), 1e-3 * problem.mean_diagonal)
        amount = self.options.start * problem.dot(problem.r, problem.r) / problem.size / problem.mean_diagonal
        z = form.right_inverse(y)
        s, z = lorentz.central_pair(form.apply(guess) - tau[:, None] * z, tau, amount)
        g = form.impulses(s)
        return Point(form.apply(g), z, problem.momentum(g))

    def residuals(self, at: Point) -> Residuals:
        problem, form = self.problem, self.form
        g = form.impulses(at.s)
        momentum = problem.momentum(g)
        rest = problem.compliance * g + problem.r
        y = (problem.velocity_of(momentum) + rest) * form.mask
        r_y = (problem.velocity_of(at.v) + rest) * form.mask
        r_y -= form.transpose(without_de_saxce(at.z) if self.coulomb else at.z)
        return Residuals(g, y, problem.errors(g, y, self.coulomb), at.v - momentum, r_y)

    def linearised(self, at: Point, found: Residuals) -> Linearised:
        """The linear equations of an iterate."""
        with phase("CCPBarrier"):
            W = NesterovTodd(*lorentz.scaling(at.s, at.z))
            u = sliding_directions(at.z) if self.coulomb else self._still
            arrow = self.form.arrow(*W, u, self.compliance, self.tangential) if self.error_in_momenta else None
        # the velocities that the natural residual stands for
        shown = found.errors.natural * self.problem.norm(found.g) * self.problem.mean_diagonal
        return Linearised(self, at, found, W, u, arrow, self.forcing * shown)

    def moved(self, at: Point, d: Direction, step: float) -> Point:
        """The point after a step; for Coulomb's law with De Saxce's terms of its velocities."""
        z = with_de_saxce(without_de_saxce(at.z) + step * d.dy) if self.coulomb else at.z + step * d.dz
        return Point(at.s + step * d.ds, z, at.v + step * d.dv)


class Linearised(NamedTuple):
    """An iteration's linear equations, which all its directions share.

    at, found : the iterate and its residuals
    W : scaling of the pair
    u : directions in which contacts slide, for T; zero without Coulomb's law
    arrow : (B + C)^-1, where errors are those of momenta
    tol : residual to which Newton systems are solved [m/s]
    """

    conic: ConicProblem
    at: Point
    found: Residuals
    W: NesterovTodd
    u: Array
    arrow: ArrowInverse | None
    tol: float

    def blocks(self) -> tuple[Array | None, Array | None]:
        """What `Newton.update` takes: the blocks B, with the compliance that problems do not have, or (B + C)^-1."""
        if self.arrow is not None:
            return None, self.arrow.X
        return self.conic.form.barriers(*self.W, self.u, self.conic.problem.mean_diagonal, self.conic.within), None

    def direction(self, newton: Newton, w: Array, *earlier: Array) -> Direction:
        """The direction of the right-hand side w; ``earlier``: solutions of the Newton system to begin from."""
        problem, form, found = self.conic.problem, self.conic.form, self.found
        if self.arrow is not None:  # r_y vanishes, r_v takes the error of the linear solve
            f = lorentz.uncoupled_changes(*self.W, self.at.s, w)
            dg, x = newton.solve(None, self.tol, found.r_v, earlier, self.arrow.uncoupled(f, found.r_y))
            dv, ds = newton.system.momenta(x, dg, found.r_v), form.apply(dg)
            dy = newton.system.velocity + problem.compliance * dg + found.r_y
            dy = self.arrow.dual_step(dy, f, ds)
        else:  # r_v vanishes, r_y takes it
            c = lorentz.right_hand_sides(*self.W, self.at.z, self.u, w)
            dg, x = newton.solve(form.transpose(c) - found.r_y, self.tol, found.r_v, earlier)
            dv, ds = newton.system.momenta(x, dg, found.r_v), form.apply(dg)
            dy = lorentz.subtract_inverse_squared(*self.W, self.u, c, ds)
        return Direction(ds, self._turned(dy), dy, dv, x)

    def _turned(self, dy: Array) -> Array:
        """T dy, the change of z to first order."""
        if not self.conic.coulomb:
            return dy
        dz = dy.copy()
        dz[:, 0] += dot(self.u, dy)
        return dz

    def reach(self, d: Direction) -> float:
        """Longest step that keeps both in the cones of all ranks; 0 where a direction is no number."""
        problem, at = self.conic.problem, self.at
        if not self.conic.coulomb:
            return problem.min(min(lorentz.step_inside(at.s, d.ds), lorentz.step_inside(at.z, d.dz)))
        of_z = step_to_zero(without_de_saxce(at.z)[:, 0], d.dy[:, 0])
        longest = problem.min(min(lorentz.step_inside(at.s, d.ds), of_z))
        return longest if np.isfinite(problem.sum(float(d.dz.sum()))) else 0.0

    def step(self, d: Direction) -> float:
        """The step to take, at most 1 and not up to the boundary."""
        return min(1.0, self.conic.boundary * self.reach(d))

    def mehrotra_correction(self, d: Direction, target: float) -> Array:
        """The w of a direction that aims at s o z = target e, with the second-order term of the last direction."""
        return lorentz.mehrotra_correction(*self.W, self.at.z, d.ds, d.dz, target)

    def gondzio_correction(self, d: Direction, reach: float, target: float) -> Array:
        """What to add to w so that the eigenvalues of s o z, ``reach`` along the direction, come near the target, up
        to the factor ``spread``.

        Source: Gondzio (1996), multiple centrality corrections; here with the eigenvalues of second-order cones."""
        spread = self.conic.options.spread
        return lorentz.gondzio_correction(*self.W, self.at.z, d.ds, d.dz, reach, 1.0 / spread * target, spread * target)


def with_de_saxce(y: Array) -> Array:
    """(y_n + |y_t|, y_t) of scaled velocities y (nc, 3): inside the cones if y_n > 0."""
    z = y.copy()
    z[:, 0] += tangential(y)
    return z


def without_de_saxce(z: Array) -> Array:
    """The y (nc, 3) that z is of, `with_de_saxce`."""
    y = z.copy()
    y[:, 0] = lorentz.determinant(z) / (z[:, 0] + tangential(z))
    return y


def sliding_directions(z: Array) -> Array:
    """The directions (nc, 3) in which contacts with scaled velocities z slide; zero without sliding."""
    u = z.copy()
    u[:, 0] = 0.0
    return u / np.maximum(tangential(z), TINY)[:, None]
