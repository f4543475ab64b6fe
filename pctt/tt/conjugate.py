"""Conjugate gradients that can be interrupted and resumed, and races between preconditioners."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import ceil, inf, log10

import numpy as np

from pctt.tt.train import Array

Product = Callable[[Array], Array]
DIGITS = 8.0  # of the residual, that a solution gains


class ConjugateGradients:
    """The method for a symmetric positive definite matrix, one step at a time.

    times : the product with the matrix
    b : the right side, or this rank's part of it
    solve : the product with the preconditioner; None: there is none
    each : the cost of this product, that of a product with the matrix is 1
    dot : the inner product, over all ranks
    sign : -1 for a negative definite matrix, which has the same iterates

    x : the solution so far
    norms : of the residuals, one more than there were steps
    lengths, growths : of the steps, and of the squares of the residuals in the form of the preconditioner
    failed : whether the matrix or the preconditioner is not positive

    >>> run = ConjugateGradients(lambda x: 2 * x, np.ones(3))
    >>> run.step()
    >>> run.x
    array([0.5, 0.5, 0.5])
    """

    def __init__(
        self, times: Product, b: Array, solve: Product | None = None, each: float = 0.0,
        dot: Callable[[Array, Array], float] = np.dot, x: Array | None = None, sign: float = 1.0,
    ) -> None:  # fmt: skip
        self.sign = sign
        self.times, self.solve, self.dot, self.each = times, solve, dot, each
        self.x = np.zeros_like(b) if x is None else x.copy()
        self._r = b.copy() if x is None else b - times(x)
        self._p, self._rz = np.zeros_like(b), inf
        self.norms = [self._norm()]
        self.lengths: list[float] = []
        self.growths: list[float] = []
        self.failed = False

    def _norm(self) -> float:
        return float(self.dot(self._r, self._r)) ** 0.5

    @property
    def cost(self) -> float:
        """Of the steps so far, in products with the matrix."""
        return (len(self.norms) - 1) * (1 + self.each)

    def step(self) -> None:
        """One iteration; none if the residual is zero or the method has failed."""
        if self.failed or self.norms[-1] == 0:
            return
        z = self._r if self.solve is None else self.solve(self._r)
        old, self._rz = self._rz, float(self.dot(self._r, z))
        self._p = z + self._rz / old * self._p
        q = self.times(self._p)
        curvature = float(self.dot(self._p, q))
        if not (self._rz > 0 and 0 < self.sign * curvature < inf):
            self.failed = True
            return
        step = self._rz / curvature
        self.lengths.append(step)
        self.growths.append(self._rz / old)
        self.x += step * self._p
        self._r = self._r - step * q
        self.norms.append(self._norm())


def iterations(norms: Sequence[float], digits: float = DIGITS) -> float:
    """The number of iterations that gain these digits, between two norms (k + 1,); extrapolated where they have not.

    >>> iterations([1.0, 0.1, 0.001], 2), iterations([1.0, 0.1, 0.01], 4)
    (1.5, 4.0)
    """
    found = at_least(norms, digits)
    gained = log10(norms[0] / min(norms)) if min(norms) > 0 else inf
    if gained < digits:
        return found * digits / gained if gained > 0 else inf
    if found == 0 or norms[found] == 0:
        return float(found)
    before, after = (log10(norms[0] / norms[k]) for k in (found - 1, found))
    return found - (after - digits) / (after - before)


def at_least(norms: Sequence[float], digits: float = DIGITS) -> int:
    """The number of iterations that gain these digits; where the norms (k + 1,) have not gained them, k.

    >>> at_least([1.0, 0.1, 0.001], 2), at_least([1.0, 0.1, 0.01], 4)
    (2, 2)
    """
    enough = norms[0] * 10.0**-digits
    return next((k for k, norm in enumerate(norms) if norm <= enough), len(norms) - 1)


def race(runs: Sequence[ConjugateGradients], slack: float, most: float, digits: float = DIGITS) -> list[float]:
    """About what each run costs until it has gained these digits; infinite for those that fail.

    The cheapest so far makes the next step. With a preconditioner a run ends at half of the digits, and costs twice as
    much; without one it gains most of them late, so it goes on. The race ends when all others cost `slack` times as
    much as the winner, or `most`. What those that have not arrived cost is extrapolated, to no more iterations than
    there are unknowns, if they have not made more. (Who lags behind at first may win, so nobody is sent home early.)
    """
    halves = [1.0 if run.solve is None else 0.5 for run in runs]

    def gone(k: int) -> float:
        return runs[k].cost / halves[k]

    running = list(range(len(runs)))
    while running:
        k = min(running, key=gone)
        run = runs[k]
        if gone(k) >= most:
            break
        run.step()
        if run.failed:
            running.remove(k)
        elif run.norms[-1] <= run.norms[0] * 10.0 ** (-digits * halves[k]):
            running.remove(k)
            most = min(most, slack * gone(k))
    def cost(run: ConjugateGradients, half: float) -> float:
        most = max(len(run.x), (len(run.norms) - 1) / half)
        return min(iterations(run.norms, half * digits) / half, most) * (1 + run.each)

    return [inf if run.failed else cost(run, half) for run, half in zip(runs, halves)]


@dataclass(frozen=True)
class CostEstimate:
    """What a trial has shown of a preconditioner.

    each : the cost of an application, that of a product with the matrix is 1
    norms : of the residuals of conjugate gradients with it
    unpreconditioned : of those without a preconditioner, as far as they were tried, on a part of the matrix. Its
        eigenvalues lie between those of the whole, so the whole takes as many iterations at least
    spent : what the trials have cost, in products with the matrix
    """

    each: float
    norms: Sequence[float]
    unpreconditioned: Sequence[float]
    spent: float = 0.0

    @property
    def iterations(self) -> int:
        """That gain eight digits."""
        return ceil(min(iterations(self.norms), 1e9))

    def cost(self, digits: float) -> float:
        """Of a solution to these digits with the preconditioner, in products."""
        return (1 + self.each) * iterations(self.norms, digits)


#: Nothing is known of a preconditioner.
NO_ESTIMATE = CostEstimate(0.0, [1.0, 0.0], [1.0])
