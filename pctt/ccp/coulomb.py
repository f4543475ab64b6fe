"""Coulomb's law by a fixed-point iteration around the convex cone problem.

The cone problem is a relaxation: a contact that slides with speed |y_t| gets the normal velocity mu |y_t|, and opens by
dt mu |y_t| in a step. In Coulomb's law g_n and y_n themselves are complementary. With the De Saxce velocity y + (mu
|y_t|, 0, 0) this is a cone problem again, but no convex one. For given De Saxce terms s,

    min 1/2 g'Ng + (r + s n)'g over the friction cones,    y = N g + r,

is convex, and g obeys Coulomb's law where s = mu |y_t|. Source: De Saxce and Feng (1998); Acary, Cadoux, Lemarechal and
Malick, "A formulation of the linear discrete Coulomb friction problem via convex optimization", ZAMM 91 (2011).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from pctt.arrays import Array, tangential
from pctt.ccp.problem import ConeProblem
from pctt.ccp.result import FIXED_POINT, Limits, Result, Status

#: Cone problems before the iteration gives up.
MOST = 200
#: Earlier points of Anderson's acceleration; docs/notebook_ccp.md compares 0 to 10.
DEPTH = 5
#: Accuracy of a cone problem, as a part of the Coulomb residual before it, or of the tolerance: more exact ones cost
#: iterations without saving a cone problem, less exact ones hide from Anderson what the term has changed.
INNER = 0.3
#: Growth of the residual over its best at which earlier points are forgotten.
RESTART = 3.0


def fixed_point(
    convex: Callable[..., Result], problem: ConeProblem, guess: Array, limits: Limits, most: int = MOST,
    depth: int = DEPTH,
) -> Result:  # fmt: skip
    """The iteration finds impulses that obey Coulomb's law; ``convex(problem, guess, limits)`` solves a cone problem.

    The result's residual and history are those of Coulomb's law, one value per cone problem; its iterations are those
    of all cone problems, of which there are at most ``most``.
    """
    # a lone contact that slides answers a term s by -gain s: the step leads to its fixed point at once
    N = problem.diagonal_blocks
    gain = problem.mu**2 * 0.5 * (N[:, 1, 1] + N[:, 2, 2]) / np.where(N[:, 0, 0] > 0, N[:, 0, 0], np.inf)
    anderson = Anderson(problem, 1.0 / (1.0 + gain), depth)
    r, g, tol = problem.r, guess, limits.tol
    s = problem.mu * tangential(problem.product(g) + r) if problem.norm(g) > 0 else np.zeros_like(problem.mu)
    accuracy = max(1e-2, INNER * tol)  # the first term is a guess
    best, failed = Result(guess, Status.STALLED, "", np.inf, 0), 0
    history: list[float] = []
    spent: list[Result] = []
    while len(history) < most:
        relaxed = problem.with_r(r + np.stack([s, 0 * s, 0 * s], axis=1))
        inner = convex(relaxed, g, limits.to(accuracy).unwatched).after(*spent)
        g, spent = inner.impulse, [inner]
        y = problem.product(g) + r
        history.append(limits.residual(problem.errors(g, y, coulomb=True)))
        limits.report(inner.iterations, history[-1])
        best = inner if history[-1] <= min(history) else best
        failed = 0 if inner.converged else failed + 1
        if history[-1] <= tol or failed > 1 or inner.status is Status.UNBOUNDED:
            break
        if history[-1] > RESTART * min(history):
            anderson.forget()
        accuracy = min(accuracy, INNER * max(tol, history[-1]))
        s = np.maximum(anderson.next(s, problem.mu * tangential(y) - s), 0.0)
    least, count = min(history), len(history)
    status, words = Status.CONVERGED, "Coulomb residual below the tolerance"
    if least > tol:
        status = Status.ITERATION_LIMIT if inner.converged else inner.status
        if status is Status.UNBOUNDED:  # of a convex problem; the law may have a solution where that has none
            status = Status.STALLED
        words = f"Coulomb's law not met: residual {least:.1e} at best in {count} cone problems"
        words += "" if inner.converged else f", the last: {inner.reason}"
    found = Result(best.impulse, status, words, least, 0, history=history, cone_problems=count, law=FIXED_POINT)
    return found.after(inner)


class Anderson:
    """Anderson's acceleration of s = F(s), for distributed arrays (nc,); Walker and Ni (2011).

    The residual f = F(s) - s is taken as linear over the last ``depth`` points. ``relaxation`` (nc,) is the length of
    the step along the remaining residual.
    """

    def __init__(self, problem: ConeProblem, relaxation: Array, depth: int):
        self.problem, self.relaxation, self.depth = problem, relaxation, depth
        self.forget()

    def forget(self) -> None:
        self._last: tuple[Array, Array] | None = None
        self._steps: list[tuple[Array, Array]] = []

    def next(self, s: Array, f: Array) -> Array:
        """The point after s, where F(s) - s is f."""
        if self._last is not None:
            self._steps = [*self._steps, (s - self._last[0], f - self._last[1])][-self.depth :] if self.depth else []
        self._last = (s, f)
        best = s + self.relaxation * f
        if not self._steps:
            return best
        changes = np.stack([df for _, df in self._steps])
        normal, right = self.problem.sum(changes @ changes.T), self.problem.sum(changes @ f)
        if not (np.isfinite(normal).all() and np.isfinite(right).all()):
            return best
        shares = np.linalg.lstsq(normal, right, rcond=1e-12)[0]
        for share, (ds, df) in zip(shares, self._steps):
            best = best - share * (ds + self.relaxation * df)
        return best
