"""APGD, as long as it is expected to finish before the conic interior point method would; then that method.

Costs are in iterations of APGD: the conic method's by a table (`conic_cost`), APGD's own by extrapolation.

1. Begin with APGD. From a tenth of the conic method's cost on, fit its natural residual of the iterations k/4 to k by
   log rho = a - b sqrt(k), which lies between the power law of its beginning and the geometric decay of its end.
   Where the line meets the tolerance is the number of iterations that it will need (`forecast`).
2. If the remaining iterations cost more than the conic method would from here, change to it. It begins at APGD's point,
   which saves about as much as APGD has cost so far (up to 0.3 of its own cost): trying APGD is almost free.
3. If it stalls, go back to APGD, from the better of the two points, to the end.

For Coulomb's law the conic method stalls often, but the path that it follows leads to the neighbourhood of a solution.
There it begins at the first guess, is stopped at the residual ``basin``, and APGD goes on from the end of its path.

From the second cone problem on, a `Memory` helps. It holds the iterations that APGD needed, or was expected to need,
and the measured cost of the conic method. Without it (``-ccp_auto_remember false``) the rules count iterations only, so
that a repeated run repeats its choices. docs/measurements.md compares the cost of these rules with that of the better
of the two methods.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from time import perf_counter
from typing import NamedTuple

import numpy as np
from mpi4py import MPI

from pctt.ccp.cone import Array
from pctt.ccp.first_order import apgd
from pctt.ccp.interior import conic
from pctt.ccp.newton import Newton
from pctt.ccp.problem import ConeProblem
from pctt.ccp.result import Limits, Result, Status
from pctt.options import POSITIVE, option


@dataclass(frozen=True)
class Auto:
    """Options ``-ccp_auto_*``."""

    bias: float = option(
        1.0, "factor on the cost of the conic method: above 1, APGD is given more time", check=POSITIVE
    )
    remember: bool = option(True, "use what the last cone problems have cost, by the clock")


@dataclass(frozen=True)
class Steering:
    """Numbers that steer the choice; costs are in iterations of APGD (docs/ccp.md has what was measured)."""

    conic_it: int = 60  #: limit of the conic method's iterations
    earliest: float = 0.1  #: part of the conic method's cost before which there is no forecast
    looks: int = 8  #: looks at the natural residual before which there is no forecast
    saved: float = 0.3  #: part of the conic method's cost, at most, by beginning at APGD's point
    far: float = 4.0  #: times that cost: more iterations of APGD than this need not be told apart
    #: complementarity of the conic method's start, by APGD's natural residual; its own default at most
    start: float = 3e4
    #: Coulomb residual at which the conic method's path has come so near to a solution that APGD gets there soon
    basin: float = 3e-4
    #: factor on the conic method's cost for Coulomb's law, at least: its Newton systems are unsymmetric
    law: float = 2.0
    law_contacts: float = 1000.0  #: the factor is the 2/3 power of contacts over this: LU factors fill in


STEERING = Steering()


class Needed(NamedTuple):
    """Iterations that APGD needed for a problem: counted, or the last forecast before it was given up."""

    iterations: float
    counted: bool


@dataclass
class Memory:
    """Observations on the cone problems so far, by decade of their tolerance. It lives as long as a `Newton`.

    needed : by APGD for the last problem
    factor : what the conic method cost / what `conic_cost` says
    """

    needed: dict[int, Needed] = field(default_factory=dict)
    factor: dict[int, float] = field(default_factory=dict)

    def keep_cost(self, tol: float, ratio: float) -> None:
        """The geometric mean with what was known: one slow moment of the machine is not to decide alone."""
        mean = np.sqrt(self.factor.get(decade(tol), 1.0) * ratio)
        self.factor[decade(tol)] = float(np.clip(mean, 0.25, 4.0))


def solve(
    problem: ConeProblem, guess: Array, limits: Limits, options: Auto, newton: Newton, coulomb: bool = False
) -> Result:
    """Impulses, of the cone problem or of Coulomb's law, by the method that is expected to be faster; ``solver`` of the
    result names it, ``reason`` says why."""
    memory = _memory(newton) if options.remember else Memory()
    model = conic_cost(problem.size, problem.softness, limits.tol)
    model *= law_factor(problem.size) if coulomb else 1.0
    cost = options.bias * memory.factor.get(decade(limits.tol), 1.0) * model
    watch = Watch(limits.tol, cost, memory.needed.get(decade(limits.tol)), problem.comm)

    start = perf_counter()
    first = apgd.solve(problem, guess, limits, apgd.APGD(), watch, coulomb)
    switched = perf_counter()
    if first.converged or first.iterations >= limits.max_it:
        memory.needed[decade(limits.tol)] = Needed(first.iterations, True)
        words = f"{first.reason}; conic would have cost about {cost:.0f} iterations"
        return dataclasses.replace(first, solver="apgd", reason=words)
    second = _conic(problem, guess, first, limits, newton, coulomb)
    if second.status is Status.GIVEN_UP:  # these Newton systems take no unsymmetric matrices
        return dataclasses.replace(first, status=Status.GIVEN_UP, reason=f"{first.reason}; conic: {second.reason}")
    result, solver, words = second, "conic", f"{first.reason}; conic: {second.reason}"
    if not (second.final or limits.max_it <= STEERING.conic_it):
        # with Coulomb's law the end of a path is a better beginning than a point with a smaller residual
        begin = second if coulomb else min(first, second, key=lambda result: result.residual)
        result = apgd.solve(problem, begin.impulse, limits, apgd.APGD(), None, coulomb)
        result.ksp_its, result.fallbacks = second.ksp_its, second.fallbacks
        result.history = second.history + result.history
        words, solver = f"{words}; apgd: {result.reason}", "apgd"
        if coulomb and first.residual < result.residual:
            result = dataclasses.replace(result, impulse=first.impulse, residual=first.residual)
    # the slowest rank's seconds, the same on all
    before, after = (problem.max(s) for s in (switched - start, perf_counter() - switched))
    done = first.iterations
    memory.needed[decade(limits.tol)] = Needed(watch.needed, False)
    memory.keep_cost(limits.tol, (after * max(done, 1) / before + min(done, STEERING.saved * model)) / model)
    return dataclasses.replace(result, solver=solver, reason=words)


def _conic(
    problem: ConeProblem, guess: Array, first: Result, limits: Limits, newton: Newton, coulomb: bool
) -> Result:
    """By the conic method what APGD has given up at its result ``first``. For Coulomb's law the path from the first
    guess, which is not at its end where its status is STALLED."""
    inner = dataclasses.replace(limits, max_it=min(STEERING.conic_it, limits.max_it))
    if not coulomb:
        begin = conic.Conic(start=min(conic.Conic().start, STEERING.start * first.residual))
        return conic.solve(problem, first.impulse, inner, begin, newton, coulomb)
    near = limits.tol < STEERING.basin
    if near:
        inner = dataclasses.replace(inner, tol=STEERING.basin, closing_work=np.inf)
    path = conic.solve(problem, guess, inner, conic.Conic(), newton, coulomb)
    if near and path.converged:
        path.status = Status.STALLED
    return path


class Watch:
    """Looks at APGD's course, and says when to give it up."""

    def __init__(self, tol: float, cost: float, last: Needed | None, comm: MPI.Comm = MPI.COMM_SELF):
        self.tol, self.cost, self.last, self._comm = tol, cost, last, comm
        self.needed = np.inf  # the last forecast
        self._course: list[tuple[int, float]] = []

    def __call__(self, iterations: int, residual: float) -> str:
        """The reason to give APGD up, or "". The first rank decides for all: on other ranks logarithms may differ in
        the last bit."""
        words, self.needed = self._comm.bcast((self._look(iterations, residual), self.needed))
        return words

    def _look(self, iterations: int, residual: float) -> str:
        if iterations > 0 and np.isfinite(residual):
            self._course.append((iterations, residual))
        if iterations < STEERING.earliest * self.cost or len(self._course) < STEERING.looks:
            return ""
        k, rho = np.array(self._course).T
        self.needed = expected(forecast(k, rho, self.tol), self.last, iterations, self.cost)
        rest = self.cost - min(iterations, STEERING.saved * self.cost)
        if self.needed - iterations <= rest:
            return ""
        learnt = "" if self.last is None else f" (the last problem {self.last.iterations:.0f})"
        return (
            f"apgd at {residual:.0e} after {iterations} iterations, of about {self.needed:.0f}{learnt}; "
            f"conic will cost as much as {rest:.0f} more"
        )


def forecast(k: Array, rho: Array, tol: float) -> float:
    """The number of iterations at which the natural residual will reach tol, from its values rho after k iterations;
    inf if it does not fall."""
    recent = k >= 0.25 * k[-1]
    x, y = np.sqrt(k[recent]), np.log(np.minimum.accumulate(rho)[recent])
    x_mean, y_mean = x.mean(), y.mean()
    slope = ((x - x_mean) @ (y - y_mean)) / max((x - x_mean) @ (x - x_mean), 1e-300)
    if not slope < 0:
        return np.inf
    return float(max(k[-1], (x_mean + (np.log(tol) - y_mean) / slope) ** 2))


def expected(forecast: float, last: Needed | None, iterations: int, cost: float) -> float:
    """The iterations that APGD is expected to need in all, from its present forecast and from the last problem.

    A counted number is believed: steps differ little, and residuals from a warm start have plateaus. If the number of
    the last problem is a forecast too, the geometric mean of both is taken. Once APGD has made more iterations than the
    last problem's number, the forecast alone counts."""
    forecast = min(forecast, iterations + STEERING.far * cost)
    if last is None or iterations >= last.iterations:
        return forecast
    if last.counted:
        return last.iterations
    return float(np.sqrt(forecast * min(last.iterations, STEERING.far * cost)))


def conic_cost(contacts: int, softness: float, tol: float) -> float:
    """The cost of the conic method from a cold start, in iterations of APGD. It grows as the cube root of the number of
    contacts, measured on settled mixers of 18,483 and 142,175 (docs/measurements.md). Small problems have fixed
    costs."""
    accuracy, rigid, soft = [-8, -7, -6, -4, -2], [375, 340, 300, 185, 60], [345, 305, 265, 155, 52]
    per_root = np.interp(np.log10(tol), accuracy, soft if softness >= 1e-6 else rigid)
    return float(per_root * np.cbrt(max(contacts, 400)))


def law_factor(contacts: int) -> float:
    """What Coulomb's law costs the conic method, over the relaxation: measured 2 to 3 at 3,800 contacts, 6 to 12 at
    19,000 to 27,000."""
    return max(STEERING.law, (contacts / STEERING.law_contacts) ** (2.0 / 3.0))


def decade(tol: float) -> int:
    return round(np.log10(tol))


def _memory(newton: Newton) -> Memory:
    """That of the problems that were solved with these Newton systems."""
    if not isinstance(newton.memory, Memory):
        newton.memory = Memory()
    return newton.memory
