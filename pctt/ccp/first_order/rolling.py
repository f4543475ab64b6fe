"""The scaled problem of contacts that resist rolling and spinning."""

from __future__ import annotations

import numpy as np

from pctt.ccp import rolling
from pctt.ccp.cone import Array
from pctt.ccp.first_order.scaled import Iterate, ScaledProblem
from pctt.ccp.problem import ConeProblem
from pctt.ccp.rolling import RollingProblem


class ScaledRolling(ScaledProblem):
    """A `ScaledProblem` with the cones of `pctt.ccp.rolling`. Moments about the normal and those about the tangents
    have sizes of their own, so that discs stay discs."""

    problem: RollingProblem

    def __init__(
        self, problem: RollingProblem, coulomb: bool = False, precision: type[np.floating] = np.float64
    ) -> None:
        super().__init__(problem, coulomb, precision)
        nc = len(problem.spinning)
        normal, moments = self._scale[:nc, 0], self._scale[nc:]
        self.mu[nc:] = problem.mu[nc:] * moments[:, 1] / normal
        self.sigma = self._rounded(problem.spinning * moments[:, 0] / normal)

    def start(self, guess: Array) -> Array:
        return self.project(self._rounded(guess * self._scale))

    def impulse(self, x: Array) -> Array:
        g = x * self.shrink
        return g if self.precision is np.float64 else rolling.project_to(g, self.problem.mu, self.problem.spinning, g)

    def project(self, x: Array) -> Array:
        return rolling.project_to(x, self.mu, self.sigma, x)

    def fall_asleep(self, now: Iterate, last: Iterate, y: Array, length: float) -> None:
        faster = float(5 * length / np.sqrt(max(self.problem.size, 1)))
        self._awake = self._operator.among(rolling.not_idle(now.x, last.x, y, self.mu, self.sigma, faster))

    def step(self, now: Iterate, last: Iterate, beta: float, y: Array, length: float, new: Iterate) -> list[float]:
        work, square, uphill = rolling.accelerated_step(
            now.x, last.x, y, self._soft, beta, length, self.mu, self.sigma, float(self.coulomb), new.x
        )
        return self.image_of_step(now, last, beta, new, work, square, uphill)


def in_equal_sizes(
    problem: ConeProblem, coulomb: bool = False, precision: type[np.floating] = np.float64
) -> ScaledProblem:
    """The scaled problem that belongs to the cones of a problem."""
    if isinstance(problem, RollingProblem):
        return ScaledRolling(problem, coulomb, precision)
    return ScaledProblem(problem, coulomb, precision)
