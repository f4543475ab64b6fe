"""Symmetric cone interior point method: Nesterov-Todd scaling, Mehrotra's predictor and corrector.

In the variables s = (mu g_n, g_t) and z = (y_n / mu, y_t) all cones are the same and self-dual. The method follows
the central path s o z = t e of

    v = G' g,    y = G v + C g + r,    s and z in the cones, s'z = 0,

with the mass-scaled momenta v as unknowns of their own: the residual of an inexact linear solve (``-ccp_newton body``)
spoils v = G' g alone, and the next step mends that. With W the scaling of the pair (s, z), a step solves

    dz = G dv + C dg + r_z,    dv = G' dg - r_v,    W^-1 ds + W dz = w - W z.

Late in an iteration W^2 is large along an impulse that slides, and the product W^2 z, which equals s, drowns in
rounding. So the change of each contact without the others, ds = W w - s, is formed from s instead.

For Coulomb's law z belongs to the De Saxce velocity, (y_n / mu + |y_t|, y_t); `slip` has the additional terms. A step
is straight in y, so that z takes the opening as it is, and not by its derivative.

Source: Nesterov and Todd (1997), Mehrotra (1992); Acary, Armand, Nguyen and Shpakovych, "Second-order cone
programming for frictional contact mechanics using interior point algorithm", Optim. Methods Softw. (2023), for their
use with friction."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from pctt.ccp.cone import Array, step_to_zero, times
from pctt.ccp.interior import lorentz
from pctt.ccp.interior.guess import no_larger_than_useful
from pctt.ccp.interior.lorentz import NesterovTodd
from pctt.ccp.interior.slip import Slip, closed, opened, sliding_directions
from pctt.ccp.newton import Newton
from pctt.ccp.problem import ConeProblem
from pctt.ccp.result import Limits, Result, Status
from pctt.ccp.unbounded import why_unbounded
from pctt.log import phase
from pctt.options import FRACTION, POSITIVE, option


@dataclass(frozen=True)
class Conic:
    """Options ``-ccp_conic_*``."""

    start: float = option(30.0, "complementarity of the start, in units of mean(r^2) / mean diag N", check=POSITIVE)
    forcing: float = option(0.3, "residual of a linear solve, as a part of the natural residual", check=POSITIVE)
    boundary: float = option(0.99, "part of the way to the cone's boundary that a step may go", check=FRACTION)


@dataclass(frozen=True)
class Steering:
    """Numbers that steer the method, without unit but where one is given; docs/notebook_ccp.md has the measurements."""

    #: compliance within a step [mean diag N]; it bounds (B + C)^-1, and the answer does not have it
    proximal: float = 1e-9
    #: factor on the forcing where impulses are the unknowns: there a residual changes velocities that should be zero
    closer: float = 0.01
    sharper: float = 0.1  #: factor on the forcing for Coulomb's law
    centering: float = 0.02  #: part of the complementarity to aim at, per deviation from the central path
    least: float = 0.01  #: part of the complementarity to aim at in any case
    near: tuple[float, float] = (0.1, 10.0)  #: what counts as near the central path [complementarity aimed at]
    short: float = 0.8  #: the direction of a shorter step is corrected
    corrections: int = 3  #: of a direction at most
    further: float = 0.3  #: a correction of a short step aims at a step that is longer by this
    longer: float = 1.02  #: a corrected short step is kept if it is so many times as long
    less: float = 0.7  #: a corrected long step is kept if it leaves this part of the complementarity
    #: natural residual below which long steps are corrected too, after a step with progress; before, a correction may
    #: enlarge impulses that next to nothing bounds
    late: float = 1e-2
    patience: int = 3  #: iterations without progress before the Newton systems are sharpened
    patience_with_law: int = 8  #: the same for Coulomb's law, before the method gives up
    #: for Coulomb's law, part of the way to the boundary at most: next to it a contact has no room to turn
    boundary_with_law: float = 0.9
    near_start: float = 3e4  #: for Coulomb's law, ``-ccp_conic_start`` at most, per residual of the guess or tolerance


STEERING = Steering()


def solve(
    problem: ConeProblem, guess: Array, limits: Limits, options: Conic, newton: Newton, coulomb: bool = False
) -> Result:
    """Impulses, of the cone problem or of Coulomb's law; ``guess`` (nc, 3) holds those of the last step."""
    newton.begin(problem)
    if coulomb and not newton.takes_any:
        words = "Coulomb's law needs -ccp_newton body and its own linear solver"
        return Result(guess, Status.GIVEN_UP, words, np.inf, 0)
    cones = Cones.of(problem, coulomb)
    start = options.start
    if coulomb:  # from a point near the law, the end of another path
        off = max(problem.natural_residual(guess, cones.velocity(guess), coulomb), limits.tol)
        start = min(start, STEERING.near_start * off)
    at = _start(cones, guess, start)
    course = Course(cones, limits)
    while not course.ends(at, newton):
        scaled = Scaled.of(cones, at, newton, options, course)
        with phase("ConicPredictor"):
            predictor = scaled.direction(np.zeros_like(at.z))
            target = scaled.target(predictor)
        with phase("ConicCorrector"):
            direction, step = _corrected(scaled, predictor, target, course)
        if step > 0:
            at = cones.moved(at, direction, step)
    return course.result(newton)


class Point(NamedTuple):
    """An iterate: scaled impulses and velocities (nc, 3) inside the cones, mass-scaled momenta."""

    s: Array
    z: Array
    v: Array


class Direction(NamedTuple):
    """A change of a `Point`, and the Newton system's solution ``x`` that it was made from. ``dy`` is dz without the
    change of the opening."""

    ds: Array
    dz: Array
    dy: Array
    dv: Array
    x: Array


@dataclass(frozen=True)
class Cones:
    """The problem in the scaled variables s = scale g, z = y / scale.

    scale : (nc, 3) mu, 1, 1 per contact; 1, 1, 1 without friction
    frictionless : (nc,) contacts whose tangential part, which the problem does not have, is held at zero
    coulomb : whether velocities have the opening of Coulomb's law
    """

    problem: ConeProblem
    scale: Array
    frictionless: Array
    coulomb: bool

    @classmethod
    def of(cls, problem: ConeProblem, coulomb: bool) -> Cones:
        scale, frictionless = np.ones((problem.mu.size, 3)), problem.mu == 0
        scale[:, 0] = np.where(frictionless, 1.0, problem.mu)
        return cls(problem, scale, frictionless, coulomb)

    def velocity(self, g: Array) -> Array:
        """y = N g + r but for the sliding of contacts without friction, which no impulse answers."""
        y = self.problem.product(g) + self.problem.r
        y[self.frictionless, 1:] = 0.0
        return y

    def residuals(self, at: Point) -> tuple[Array, Array]:
        """r_v = v - G' g, and r_y = y / scale - z with y from v and z without its opening."""
        problem, g = self.problem, at.s / self.scale
        y = problem.velocity_of(at.v) + problem.compliance * g + problem.r
        y[self.frictionless, 1:] = 0.0
        z = closed(at.z) if self.coulomb else at.z
        return at.v - problem.momentum(g), y / self.scale - z

    def moved(self, at: Point, d: Direction, step: float) -> Point:
        """The point after a step; for Coulomb's law with the openings of its velocities."""
        z = opened(closed(at.z) + step * d.dy) if self.coulomb else at.z + step * d.dz
        return Point(at.s + step * d.ds, z, at.v + step * d.dv)

    def reach(self, at: Point, d: Direction) -> float:
        """The longest step that keeps both in the cones of this rank."""
        of_z = step_to_zero(closed(at.z)[:, 0], d.dy[:, 0]) if self.coulomb else lorentz.step_to_boundary(at.z, d.dz)
        return min(lorentz.step_to_boundary(at.s, d.ds), of_z)


class Course:
    """The course of the iterations so far, and the test that ends them.

    history : residual of every iterate
    natural : natural residual of the last one
    waited : iterations without progress
    """

    def __init__(self, cones: Cones, limits: Limits):
        self._cones, self._limits = cones, limits
        self._patience = STEERING.patience_with_law if cones.coulomb else STEERING.patience
        self.history: list[float] = []
        self.natural, self.waited, self._least, self._last_gap = np.inf, 0, np.inf, np.inf

    @property
    def residual(self) -> float:
        return self.history[-1]

    def ends(self, at: Point, newton: Newton) -> bool:
        """Note an iterate; whether it is the last. Without progress the Newton systems are sharpened, once."""
        problem, g = self._cones.problem, at.s / self._cones.scale
        gap = problem.dot(at.s, at.z)
        y = self._cones.velocity(g)
        natural = problem.natural_residual(g, y, self._cones.coulomb)
        residual = self._limits.residual(natural, problem, g, y)
        unbounded = bool(why_unbounded(problem, g))
        if unbounded or residual <= min(self.history, default=residual):
            self._best = g
        progress = natural <= 0.9 * self._least or gap <= 0.5 * self._last_gap
        self.waited, self._last_gap = (0 if progress else self.waited + 1), gap
        self.natural, self._least = natural, min(natural, self._least)
        self.history.append(residual)
        if residual <= self._limits.tol or len(self.history) > self._limits.max_it or unbounded:
            return True
        if self.waited > self._patience:
            if self._cones.coulomb or not newton.sharpen():
                return True
            self.waited = 0
        return False

    def result(self, newton: Newton) -> Result:
        """The best iterate, and why it was the last."""
        iterations = len(self.history) - 1
        status, words = Status.STALLED, f"stalled after {iterations} iterations"
        if self.residual <= self._limits.tol:
            status, words = Status.CONVERGED, self._limits.met
        elif iterations == self._limits.max_it:
            status, words = Status.ITERATION_LIMIT, f"{iterations} iterations"
        least = min(self.history)
        return Result(self._best, status, words, least, iterations, newton.ksp_its, newton.fallbacks, self.history)


@dataclass(frozen=True)
class Scaled:
    """An iteration's linear equations, which all its directions share.

    at, r_v, r_y, r_z : the iterate and its residuals; r_z is r_y with the change of the opening
    W : scaling of the pair
    inverse, barrier_share : (nc, 3, 3) (B + C)^-1 and, in the scaled variables, (B + C)^-1 B
    slip : what Coulomb's law adds
    tol : residual to which Newton systems are solved
    boundary : part of the way to the boundary that a step may go
    """

    cones: Cones
    newton: Newton
    at: Point
    r_v: Array
    r_y: Array
    r_z: Array
    W: NesterovTodd
    inverse: Array
    barrier_share: Array
    slip: Slip | None
    tol: float
    boundary: float

    @classmethod
    def of(cls, cones: Cones, at: Point, newton: Newton, options: Conic, course: Course) -> Scaled:
        """Scaling and residuals of an iterate; the Newton systems get its matrix."""
        problem = cones.problem
        r_v, r_y = cones.residuals(at)
        r_z = r_y
        W = NesterovTodd.of(at.s, at.z)
        B, inverse, barrier_share = _barrier_blocks(cones, W)
        slip = None
        if cones.coulomb:
            compliance = problem.compliance[:, 1:2] + STEERING.proximal * problem.mean_diagonal
            slip = Slip.of(inverse, sliding_directions(at.z), cones.scale, compliance)
            r_z = slip.change(r_y)
        newton.update(B, inverse if slip is None else inverse + slip.blocks, symmetric=slip is None)
        # a residual of v = G' g makes y wrong by G times that
        tol = options.forcing * course.natural * problem.norm(at.s / cones.scale) * np.sqrt(problem.mean_diagonal)
        tol *= 1.0 if newton.primary == "momenta" else STEERING.closer
        tol *= STEERING.sharper if cones.coulomb else 1.0
        boundary = min(options.boundary, STEERING.boundary_with_law) if cones.coulomb else options.boundary
        return cls(cones, newton, at, r_v, r_y, r_z, W, inverse, barrier_share, slip, tol, boundary)

    def direction(self, w: Array, *earlier: Array) -> Direction:
        """The direction of the right-hand side w; ``earlier``: solutions of the Newton system to begin from."""
        problem, newton, scale = self.cones.problem, self.newton, self.cones.scale
        c = self.W.divide(w) - self.at.z
        uncoupled = times(self.barrier_share, self.W.times(w) - self.at.s)
        uncoupled /= scale
        uncoupled -= times(self.inverse, self.r_z * scale)
        if self.slip is not None:
            self.slip.reduce(uncoupled)
        dg, x = newton.solve((c - self.r_z) * scale, self.tol, self.r_v, earlier, uncoupled)
        dv = newton.momentum(x, dg, self.r_v)
        ds = dg * scale
        if newton.primary == "momenta":  # r_y vanishes, r_v takes the error of the linear solve
            dy = (problem.velocity_of(dv) + problem.compliance * dg) / scale + self.r_y
        else:  # r_v vanishes, r_y takes it
            dy = c - self.W.divide(self.W.divide(ds))
        dy[self.cones.frictionless, 1:] = ds[self.cones.frictionless, 1:] = 0.0
        return Direction(ds, dy if self.slip is None else self.slip.change(dy), dy, dv, x)

    def reach(self, d: Direction) -> float:
        """Longest step that keeps both in the cones of all ranks; 0 where a direction is no number."""
        problem = self.cones.problem
        longest = problem.min(self.cones.reach(self.at, d))
        return longest if np.isfinite(problem.sum(float(d.ds.sum() + d.dz.sum()))) else 0.0

    def step(self, d: Direction) -> float:
        """The step to take, at most 1 and not up to the boundary."""
        return min(1.0, self.boundary * self.reach(d))

    def left(self, d: Direction, step: float) -> float:
        """Complementarity after a step."""
        return self.cones.problem.dot(self.at.s + step * d.ds, self.at.z + step * d.dz)

    def target(self, predictor: Direction) -> float:
        """The complementarity of a contact to aim at: the further the predictor may go, the less (Mehrotra)."""
        problem = self.cones.problem
        part = max((1.0 - min(1.0, self.reach(predictor))) ** 3, _centering(problem, self.at), STEERING.least)
        return part * problem.dot(self.at.s, self.at.z) / problem.size

    def centred(self, d: Direction, target: float) -> Array:
        """The w of a direction that aims at s o z = target e, with the second-order term of the last direction."""
        aim = -lorentz.product(self.W.divide(d.ds), self.W.times(d.dz))
        aim[:, 0] += target
        return lorentz.divide(self.W.times(self.at.z), aim)

    def towards_path(self, d: Direction, reach: float, target: float) -> Array:
        """What to add to w so that the eigenvalues of s o z, ``reach`` along the direction, come near the target.

        Source: Gondzio (1996), multiple centrality corrections; here with the eigenvalues of second-order cones."""
        centre = self.W.times(self.at.z)
        after = lorentz.product(centre + reach * self.W.divide(d.ds), centre + reach * self.W.times(d.dz))
        low, high = STEERING.near
        return lorentz.divide(centre, lorentz.towards_interval(after, low * target, high * target))


def _corrected(scaled: Scaled, predictor: Direction, target: float, course: Course) -> tuple[Direction, float]:
    """Mehrotra's corrector and the length of its step; then further corrections, as long as they pay: of a direction
    that the cones cut short, and late of a long one, where another solve costs next to nothing."""
    w = scaled.centred(predictor, target)
    direction = scaled.direction(w, predictor.x)
    step = scaled.step(direction)
    for _ in range(STEERING.corrections):
        short = step < STEERING.short
        if short:
            w = w + scaled.towards_path(direction, min(1.0, step + STEERING.further), target)
        elif scaled.newton.factored and course.waited == 0 and course.residual < STEERING.late:
            w = scaled.centred(direction, target)
        else:
            break
        other = scaled.direction(w, direction.x)
        longer = scaled.step(other)
        if short and longer < STEERING.longer * step:
            break
        if not short and scaled.left(other, longer) > STEERING.less * scaled.left(direction, step):
            break
        direction, step = other, longer
    return direction, step


def _start(cones: Cones, guess: Array, start: float) -> Point:
    """A pair on the central path near the guess: s - tau z = s_0 - tau z_0; ``start`` as ``-ccp_conic_start``."""
    problem, scale = cones.problem, cones.scale
    guess = no_larger_than_useful(problem, guess)
    s, z = guess * scale, cones.velocity(guess) / scale
    s[cones.frictionless, 1:] = 0.0
    diagonal = np.diagonal(problem.diagonal_blocks, axis1=1, axis2=2) / scale**2
    tau = 1.0 / np.maximum(diagonal.mean(1), 1e-3 * problem.mean_diagonal)
    closing = problem.dot(problem.r, problem.r) / problem.size
    amount = start * closing / problem.mean_diagonal
    s, z = lorentz.central_pair(s - tau[:, None] * z, tau, amount)
    return Point(s, z, problem.momentum(s / scale))


def _barrier_blocks(cones: Cones, W: NesterovTodd) -> tuple[Array, Array, Array]:
    """B, (B + C)^-1 and, in the scaled variables, (B + C)^-1 B (nc, 3, 3)."""
    with phase("CCPBarrier"):
        problem, free = cones.problem, cones.frictionless
        proximal = STEERING.proximal * problem.mean_diagonal
        compliance = problem.compliance[:, 1] + proximal  # the same along all axes of the scaled variables
        B, inverse, barrier_share = W.barrier_blocks(cones.scale, compliance, proximal)
        if free.any():
            B[free, 1, 1] = B[free, 2, 2] = 1e12 * np.maximum(B[free, 0, 0], problem.mean_diagonal)
            for blocks in (inverse, barrier_share):
                blocks[free, 1:] = blocks[free, :, 1:] = 0.0
        return B, inverse, barrier_share


def _centering(problem: ConeProblem, at: Point) -> float:
    """The least part of the complementarity to aim at: more, the further the pair is off the central path. On it s o
    z has no tangential part; off it the sliding directions of impulse and velocity differ by an angle that falls like
    the root of the complementarity only."""
    turned = lorentz.product(at.s, at.z)
    off = problem.norm(turned[:, 1:]) / max(problem.norm(turned[:, 0]), 1e-300)
    return min(STEERING.centering * off, 0.5)
