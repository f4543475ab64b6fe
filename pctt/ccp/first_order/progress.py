"""The looks of a first-order method at its accuracy, its reasons to stop, and its result."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from pctt.ccp.cone import Array
from pctt.ccp.first_order.scaled import ScaledProblem
from pctt.ccp.result import Limits, Result, Status
from pctt.ccp.unbounded import why_unbounded
from pctt.options import AT_LEAST_ONE, option

GiveUp = Callable[[int, float], str]  # from iterations and residual: why not to go on, or ""


@dataclass(frozen=True)
class Steering:
    """When a method has stalled."""

    patience: int = 5000  #: without progress [iterations]: these methods have plateaus of thousands
    patience_in_single: int = 300  #: the same in single precision, where double precision takes over [iterations]
    progress: float = 0.99  #: a natural residual below this part of the best one is progress; rounding alone is not


STEERING = Steering()


@dataclass(frozen=True)
class FirstOrder:
    """Options of every first-order method."""

    check: int = option(10, "iterations between two looks at the natural residual", check=AT_LEAST_ONE)


class Progress:
    """Counts the iterations of a method (products with N) and keeps its best point.

    The objective of these methods need not fall in every step, and the natural residual falls steadily in none of them.
    So the result is the best of all points that were looked at.
    """

    def __init__(
        self,
        problem: ScaledProblem,
        limits: Limits,
        options: FirstOrder,
        give_up: GiveUp | None = None,
        before: Progress | None = None,
    ):
        """``before`` is the progress in lower precision, whose iterations and history go on."""
        self.problem, self.limits, self.check, self.give_up = problem, limits, options.check, give_up
        self.iterations: int = before.iterations if before else 0
        self.history: list[float] = before.history if before else []
        self.status, self.reason = Status.STALLED, ""
        self._best, self._point = np.inf, np.zeros((0, 3))
        self._patience = STEERING.patience if problem.precision == np.float64 else STEERING.patience_in_single
        self._looks = self._next_look = 0
        self._suspicious, self._unbounded = limits.tol, ""
        self._gain = (np.inf, self.iterations)  # residual and iteration of the last progress

    def goes_on(self, x: Array, gradient: Array | None = None) -> bool:
        """Whether to iterate further from x. Every ``check`` iterations this computes the residual.

        ``gradient`` is A x + b if the method has it."""
        if self.iterations < min(self._next_look, self.limits.max_it):
            return True
        self._next_look = self.iterations + self.check
        residual = self._residual(x, gradient)
        self.history.append(residual)
        if residual < self._best or self._looks == 0:
            self._best, self._point = residual, x.copy()
        self._looks += 1
        self.status, self.reason = self._why_stop(residual)
        return not self.reason

    @property
    def impulse(self) -> Array:
        """Of the best point (nc, 3)."""
        return self.problem.impulse(self._point)

    def result(self) -> Result:
        status = Status.CONVERGED if self._best <= self.limits.tol else self.status
        return Result(self.impulse, status, self.reason, self._best, self.iterations, history=self.history)

    def _residual(self, x: Array, gradient: Array | None) -> float:
        """The residual that the tolerance is for; nan where x or its gradient is no number."""
        if gradient is not None:
            residual = self._judge(x, gradient)
            # inf where x = 0, or x is no number; methods that update the gradient collect rounding: look twice
            if self.limits.tol < residual < np.inf:
                return residual
        gradient = self.problem.gradient(x)
        finite = np.isfinite(self.problem.dots((x, gradient))[0])
        return self._judge(x, gradient) if finite else np.nan

    def _judge(self, x: Array, gradient: Array) -> float:
        """The residual that the tolerance is for. Where only the closing work is too large, the problem may have no
        solution: this is found out whenever the natural residual has fallen to a tenth."""
        natural, residual = self.problem.residuals(self.limits, x, gradient)
        if natural <= self._suspicious and residual > self.limits.tol:
            self._suspicious = 0.1 * natural
            self._unbounded = why_unbounded(self.problem.problem, self.problem.impulse(x))
        return residual

    def _why_stop(self, residual: float) -> tuple[Status, str]:
        """The reason is empty as long as there is none."""
        if residual <= self.limits.tol:
            return Status.CONVERGED, self.limits.met
        if self._unbounded:
            return Status.UNBOUNDED, self._unbounded
        if np.isnan(residual):
            return Status.BREAKDOWN, f"not a number after {self.iterations} iterations"
        if self.iterations >= self.limits.max_it:
            return Status.ITERATION_LIMIT, f"{self.iterations} iterations"
        if residual < STEERING.progress * self._gain[0]:
            self._gain = (residual, self.iterations)
        if self.iterations - self._gain[1] >= self._patience:
            return Status.STALLED, f"no progress in the last {self._patience} of {self.iterations} iterations"
        return Status.GIVEN_UP, self.give_up(self.iterations, residual) if self.give_up else ""
