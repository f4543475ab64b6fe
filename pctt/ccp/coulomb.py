"""Coulomb's law by a fixed-point iteration around the convex cone problem, and the ladder that this is a rung of.

The cone problem is a relaxation: a contact that slides with speed |y_t| gets the normal velocity mu |y_t|, and opens by
dt mu |y_t| in a step. In Coulomb's law g_n and y_n themselves are complementary. With the De Saxce velocity y + (mu
|y_t|, 0, 0) this is a cone problem again, but no convex one. For a given opening s,

    min 1/2 g'Ng + (r + s n)'g over the friction cones,    y = N g + r,

is convex, and g obeys Coulomb's law where s = mu |y_t|. Source: De Saxce and Feng (1998); Acary, Cadoux, Lemarechal and
Malick, "A formulation of the linear discrete Coulomb friction problem via convex optimization", ZAMM 91 (2011).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from pctt.ccp.cone import Array, tangential
from pctt.ccp.problem import ConeProblem
from pctt.ccp.result import COULOMB, FIXED_POINT, Limits, Result, Status
from pctt.options import AT_LEAST_ONE, COUNT, NOT_NEGATIVE, option


@dataclass(frozen=True)
class Steering:
    """Numbers that steer the fixed-point iteration."""

    #: accuracy of a cone problem, as a part of the Coulomb residual before it, or of the tolerance: more exact ones
    #: cost iterations without saving a cone problem, less exact ones hide from Anderson what the opening has changed
    inner: float = 0.3
    first: float = 1e-2  #: accuracy of the first cone problem, whose opening is a guess [natural residual]
    restart: float = 3.0  #: growth of the residual over its best at which Anderson's earlier openings are forgotten
    #: natural residual of Coulomb's law, over the tolerance, from which cone problems would only lead away
    near: float = 10.0
    singular: float = 1e-12  #: singular values of Anderson's system below this part of the largest count as zero


STEERING = Steering()


@dataclass(frozen=True)
class Coulomb:
    """Options ``-ccp_coulomb_*``."""

    max_it: int = option(200, "cone problems before the iteration gives up", check=AT_LEAST_ONE)
    tol: float = option(0.0, "Coulomb residual at which it ends; 0: that of -ccp_tol", check=NOT_NEGATIVE)
    memory: int = option(5, "earlier openings from which Anderson's acceleration takes the next", check=COUNT)


def opening(problem: ConeProblem, y: Array) -> Array:
    """mu |y_t| (nc,) of velocities y (nc, 3)."""
    return problem.mu * tangential(y)


def ladder(
    problem: ConeProblem,
    guess: Array,
    limits: Limits,
    options: Coulomb,
    convex: Callable[[ConeProblem, Array, float], Result],
    ways: Sequence[Callable[[ConeProblem, Array, float], Result]],
) -> Result:
    """Impulses of Coulomb's law by the first rung that converges, or the best of all; see `pctt.ccp.solve`.

    ``convex(problem, guess, tol)`` solves a cone problem; each of ``ways``, called alike, looks for Coulomb's law by
    itself, from the point of the one before; one that gives up has none.
    """
    limits = limits.to(options.tol or limits.tol)
    tried: list[Result] = []
    for way in ways:
        tried.append(way(problem, tried[-1].impulse if tried else guess, limits.tol))
        tried[-1].law = COULOMB
        if tried[-1].final:
            return _last_of(tried)
        if tried[-1].status is Status.GIVEN_UP:
            break
    tried.sort(key=lambda result: -result.residual)
    if tried and _near(problem, limits, tried[-1]):
        return _last_of(tried)
    tried.append(solve(problem, tried[-1].impulse if tried else guess, limits, options, convex))
    if tried[-1].final:
        return _last_of(tried)
    plain = convex(problem, guess, limits.tol)
    y = problem.product(plain.impulse) + problem.r
    plain.residual, plain.status = _residual(problem, limits, plain.impulse, y), Status.STALLED
    plain.reason = f"relaxation, as Coulomb's law was not met: {tried[-1].reason}"
    tried.append(plain)
    return _last_of(sorted(tried, key=lambda result: -result.residual))


def _near(problem: ConeProblem, limits: Limits, found: Result) -> bool:
    """Whether a result is so near to Coulomb's law that cone problems would not do better. Its closing work may be too
    large all the same."""
    if found.status is Status.GIVEN_UP:
        return False
    y = problem.product(found.impulse) + problem.r
    return problem.natural_residual(found.impulse, y, coulomb=True) <= STEERING.near * limits.tol


def _residual(problem: ConeProblem, limits: Limits, g: Array, y: Array) -> float:
    """That of Coulomb's law for impulses g (nc, 3) with y = N g + r."""
    return limits.residual(problem.natural_residual(g, y, coulomb=True), problem, g, y)


def _last_of(tried: list[Result]) -> Result:
    """The last result, with what all have cost."""
    for count in ("iterations", "ksp_its", "fallbacks"):
        setattr(tried[-1], count, sum(getattr(result, count) for result in tried))
    return tried[-1]


def solve(
    problem: ConeProblem,
    guess: Array,
    limits: Limits,
    options: Coulomb,
    convex: Callable[[ConeProblem, Array, float], Result],
) -> Result:
    """Impulses that obey Coulomb's law; ``convex(problem, guess, tol)`` solves a cone problem.

    The result's residual and history are those of Coulomb's law, one value per cone problem; its iterations are those
    of all cone problems. ``problem.r`` is changed during the iteration and restored.
    """
    # a lone contact that slides answers an opening s by -gain s: the step leads to its fixed point at once
    N = problem.diagonal_blocks
    gain = problem.mu**2 * 0.5 * (N[:, 1, 1] + N[:, 2, 2]) / np.where(N[:, 0, 0] > 0, N[:, 0, 0], np.inf)
    relaxation = 1.0 / (1.0 + gain)
    s = opening(problem, problem.product(guess) + problem.r) if problem.norm(guess) > 0 else np.zeros_like(problem.mu)
    best: Result | None = None
    history: list[float] = []
    failed, spent, tol = 0, np.zeros(3, int), limits.tol  # iterations, Krylov iterations, fallbacks
    accuracy, g, r = max(STEERING.first, STEERING.inner * tol), guess, problem.r
    anderson = Anderson(problem, relaxation, options.memory)
    while len(history) < options.max_it:
        problem.r = r + np.stack([s, 0 * s, 0 * s], axis=1)
        try:
            inner = convex(problem, g, accuracy)
        finally:
            problem.r = r
        g = inner.impulse
        spent += (inner.iterations, inner.ksp_its, inner.fallbacks)
        failed = 0 if inner.converged else failed + 1
        y = problem.product(g) + r
        history.append(_residual(problem, limits, g, y))
        if best is None or history[-1] <= min(history):
            best = inner
        if history[-1] <= tol or failed > 1 or inner.status is Status.UNBOUNDED:
            break
        if history[-1] > STEERING.restart * min(history):
            anderson.forget()
        accuracy = min(accuracy, STEERING.inner * max(tol, history[-1]))
        s = np.maximum(anderson.next(s, opening(problem, y) - s), 0.0)
    assert best is not None
    status, words = Status.CONVERGED, "Coulomb residual below the tolerance"
    if min(history) > tol:
        status = inner.status if not inner.converged else Status.ITERATION_LIMIT
        words = f"Coulomb's law not met: residual {min(history):.1e} at best in {len(history)} cone problems"
        if not inner.converged:
            words = inner.reason if inner.status is Status.UNBOUNDED else f"{words}, the last: {inner.reason}"
    iterations, ksp_its, fallbacks = spent.tolist()
    found = Result(best.impulse, status, words, min(history), iterations, ksp_its, fallbacks, history)
    found.cone_problems, found.solver, found.law = len(history), best.solver, FIXED_POINT
    return found


class Anderson:
    """Anderson's acceleration of s = F(s), for distributed arrays (nc,); Walker and Ni (2011).

    The residual f = F(s) - s is taken as linear over the last ``memory`` points. ``relaxation`` (nc,) is the length of
    the step along the remaining residual.
    """

    def __init__(self, problem: ConeProblem, relaxation: Array, memory: int):
        self.problem, self.relaxation, self.memory = problem, relaxation, memory
        self.forget()

    def forget(self) -> None:
        self._last: tuple[Array, Array] | None = None
        self._steps: list[tuple[Array, Array]] = []

    def next(self, s: Array, f: Array) -> Array:
        """The point after s, where F(s) - s is f."""
        if self._last is not None:
            self._steps = [*self._steps, (s - self._last[0], f - self._last[1])][-self.memory :] if self.memory else []
        self._last = (s, f)
        best = s + self.relaxation * f
        if not self._steps:
            return best
        changes = np.stack([df for _, df in self._steps])
        normal, right = self.problem.sum(changes @ changes.T), self.problem.sum(changes @ f)
        weights = np.linalg.lstsq(normal, right, rcond=STEERING.singular)[0]
        for weight, (ds, df) in zip(weights, self._steps):
            best = best - weight * (ds + self.relaxation * df)
        return best
