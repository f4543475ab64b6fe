"""Nesterov's momentum, started anew where it points uphill, and bounded for Coulomb's law."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Steering:
    """How the bound of momentum is found; without unit but where one is given. docs/notebook_ccp.md has what was
    measured."""

    damping: float = 0.05  #: 1 - the greatest momentum, at first
    window: int = 100  #: between two changes of the damping [iterations]
    little: float = 0.8  #: there is too much momentum if a window leaves more than this part of the residual
    much: float = 0.6  #: there is room for more if it leaves less than this part
    heavier: float = 2.0  #: factor on the damping if there is too much momentum
    lighter: float = 0.9  #: factor on the damping if there is room for more


STEERING = Steering()


class Momentum:
    """beta, the momentum of the next step.

    For a convex problem it may come arbitrarily near to 1. The projected step of Coulomb's law is no gradient step: the
    opening mu |y_t| is not the derivative of any function of the impulses. Linearised, the step is an unsymmetric map
    with complex eigenvalues a + ib. If 1 - beta < |b| / sqrt(a), momentum turns them into growing oscillations, and
    without a bound the method ends in a cycle at a residual of about 1e-4. The size of b depends on friction and on the
    sliding contacts. So the bound is found on the way: more damping if a window of iterations has brought little, less
    if it has brought much.

    On large problems a window brings little whatever the damping is. So if more damping has made it worse, the next
    change is less damping, and the other way round. If the residual has grown, more damping is always right."""

    def __init__(self, bounded: bool):
        self.bounded, self.damping = bounded, STEERING.damping if bounded else 0.0
        self._end, self._looks, self._last = STEERING.window, 0, np.inf
        self._left, self._change = np.inf, STEERING.heavier  # by the last window; factor of the last change
        self.restart()

    def restart(self) -> None:
        self._theta, self.beta = 1.0, 0.0

    def advance(self, uphill: bool) -> None:
        """Of the next step, after one that has gone uphill or not."""
        if uphill:
            self.restart()
            return
        last, self._theta = self._theta, self._theta * (np.sqrt(self._theta**2 + 4) - self._theta) / 2
        self.beta = min(last * (1 - last) / (last**2 + self._theta), 1.0 - self.damping)

    def look(self, iterations: int, residuals: list[float]) -> None:
        """Choose the damping by the residuals that were looked at; nothing happens within a window."""
        if not self.bounded or iterations < self._end:
            return
        least = min(residuals[self._looks :], default=self._last)
        self._end, self._looks = iterations + STEERING.window, len(residuals)
        left = least / self._last
        if left > STEERING.little:
            if left >= 1:
                self._change = STEERING.heavier
            elif left > self._left:
                self._change = 1 / self._change
            self.damping = min(self._change * self.damping, 1.0)
        elif left < STEERING.much:
            self.damping *= STEERING.lighter
            self._change = STEERING.heavier
        self._last, self._left = least, left
