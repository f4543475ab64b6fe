"""Conjugate gradients that can be interrupted and resumed, and races between preconditioners."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import inf, log10

import numpy as np

from pctt.tt.train import Array

Product = Callable[[Array], Array]
DIGITS = 8.0  # of the residual, that a solution gains
AT_LEAST = 24.0  # products of a solution that are too few to be watched
PATIENCE = 3.0  # what a preconditioner may cost, in costs that its trial has shown


class ConjugateGradients:
    """The method for a symmetric positive definite matrix, one step at a time.

    times : the product with the matrix
    b : the right side, or this rank's part of it
    solve : the product with the preconditioner; None: there is none
    each : the cost of this product, that of a product with the matrix is 1
    dot : the inner product, over all ranks

    x : the solution so far
    norms : of the residuals, one more than there were steps
    failed : whether the matrix or the preconditioner is not positive

    >>> run = ConjugateGradients(lambda x: 2 * x, np.ones(3))
    >>> run.step()
    >>> run.x
    array([0.5, 0.5, 0.5])
    """

    def __init__(
        self, times: Product, b: Array, solve: Product | None = None, each: float = 0.0,
        dot: Callable[[Array, Array], float] = np.dot, x: Array | None = None,
    ) -> None:  # fmt: skip
        self.times, self.solve, self.dot, self.each = times, solve, dot, each
        self.x = np.zeros_like(b) if x is None else x.copy()
        self._r = b.copy() if x is None else b - times(x)
        self._p, self._rz = np.zeros_like(b), inf
        self.norms = [self._norm()]
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
        if not (self._rz > 0 and 0 < curvature < inf):
            self.failed = True
            return
        step = self._rz / curvature
        self.x += step * self._p
        self._r = self._r - step * q
        self.norms.append(self._norm())


def iterations(norms: Sequence[float], digits: float = DIGITS) -> float:
    """The number of iterations that gain these digits, extrapolated where the norms (k + 1,) have not gained them.

    >>> iterations([1.0, 0.1, 0.001], 2), iterations([1.0, 0.1, 0.01], 4)
    (2.0, 4.0)
    """
    enough = norms[0] * 10.0**-digits
    for k, norm in enumerate(norms):
        if norm <= enough:
            return float(k)
    gained = _gained(norms)
    return (len(norms) - 1) * digits / gained if gained > 0 else inf


def _gained(norms: Sequence[float]) -> float:
    """Digits; the norms are not zero."""
    return log10(norms[0] / min(norms))


def race(runs: Sequence[ConjugateGradients], slack: float, most: float, digits: float = DIGITS) -> list[float]:
    """What each run has cost when it had gained these digits; infinite for those that have lost.

    The cheapest so far makes the next step. The race ends when all others have cost `slack` times as much as the
    winner, or `most`. If nobody has gained the digits then, the costs are extrapolated. (Who lags behind at first may
    win, so nobody is sent home early.)
    """
    found = [inf] * len(runs)
    running = list(range(len(runs)))
    while running:
        k = min(running, key=lambda k: runs[k].cost)
        run = runs[k]
        if run.cost >= most:
            break
        run.step()
        if run.failed:
            running.remove(k)
        elif run.norms[-1] <= run.norms[0] * 10.0**-digits:
            running.remove(k)
            found[k] = run.cost
            most = min(most, slack * run.cost)
    if min(found) == inf:
        for k in running:
            found[k] = iterations(runs[k].norms, digits) * (1 + runs[k].each)
    return found


@dataclass(frozen=True)
class Promise:
    """What a trial has shown of a preconditioner.

    each : the cost of an application, that of a product with the matrix is 1
    norms : of the residuals of conjugate gradients with it
    alone : of those without a preconditioner
    """

    each: float
    norms: Sequence[float]
    alone: Sequence[float]

    @classmethod
    def of_iterations(cls, each: float, found: float, alone: float) -> Promise:
        """From these numbers of iterations that gain eight digits, all as much."""
        return cls(each, [1.0, 10 ** (-DIGITS / found)], [1.0, 10 ** (-DIGITS / alone)])

    @property
    def iterations(self) -> int:
        """That gain eight digits."""
        return int(min(iterations(self.norms), 1e9))

    def patience(self, digits: float) -> float:
        """The products that a solution to these digits may cost before conjugate gradients alone are tried beside.

        The matrix of the trial may be a principal submatrix. Then the eigenvalues of the whole are spread more widely,
        so without a preconditioner the whole takes as many iterations at least.
        """
        promised = PATIENCE * (1 + self.each) * iterations(self.norms, digits)
        return max(AT_LEAST, min(promised, iterations(self.alone, digits)))
