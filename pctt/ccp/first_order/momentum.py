"""Nesterov's momentum, started anew where it points uphill, and bounded for Coulomb's law."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Steering:
    """How the bound of momentum is found; without unit but where one is given. docs/notebook_ccp.md has what was
    measured."""

    damping: float = 0.08  #: 1 - the greatest momentum, at first
    range: tuple[float, float] = (0.02, 0.3)  #: the least and the most damping
    window: int = 100  #: between two changes of the damping [iterations]
    burst: int = 20  #: without damping, at the beginning of a window [iterations]
    little: float = 0.8  #: there is too much momentum if a window leaves more than this part of the residual
    much: float = 0.6  #: there is room for more if it leaves less than this part
    heavier: float = 1.5  #: factor on the damping if there is too much momentum
    lighter: float = 0.8  #: factor on the damping if there is room for more


STEERING = Steering()
#: below these residuals, where chains of force are left, which converge slowly whatever the damping is
NEAR = Steering(damping=0.03, range=(0.03, 0.3), window=1000, burst=0, heavier=2.0)
NEARER = Steering(damping=0.03, range=(0.03, 0.03), window=1000, burst=0)
STAGES = {np.inf: STEERING, 1e-4: NEAR, 1e-5: NEARER}
#: where friction is above 1: there what a burst excites does not die
STEEP = {np.inf: Steering(damping=0.05, range=(0.0, 1.0), burst=0, heavier=2.0, lighter=0.9)}


class Momentum:
    """beta, the momentum of the next step; for Coulomb's law with ``friction``, the largest coefficient.

    For a convex problem it may come arbitrarily near to 1. The projected step of Coulomb's law is no gradient step: the
    opening mu |y_t| is not the derivative of any function of the impulses. Linearised, the step is an unsymmetric map
    with complex eigenvalues a + ib. If 1 - beta < |b| / sqrt(a), momentum turns them into growing oscillations, and
    without a bound the method ends in a cycle at a residual of about 1e-4. The size of b depends on friction and on the
    sliding contacts. So the bound is found on the way: more damping if a window of iterations has brought little, less
    if it has brought much.

    Chains of force converge slowly, and need more momentum than that. So every window begins with a burst without a
    bound. What oscillates by then dies in the rest of the window.

    Near a solution such chains are all that is left. There windows are longer, without bursts, and the damping begins
    anew, with a small one; at last it stays.

    On large problems a window brings little whatever the damping is. So if more damping has made it worse, the next
    change is less damping, and the other way round. If the residual has grown, more damping is always right."""

    def __init__(self, friction: float | None = None):
        self._bounded = friction is not None
        self._stages = dict(STEEP if friction is not None and friction > 1.0 else STAGES)
        self._least, self._seen = np.inf, 0  # of the residuals seen so far, and how many
        self._enter(self._stages.pop(np.inf), 0)
        self.restart()

    def _enter(self, steering: Steering, iterations: int) -> None:
        """Begin a stage."""
        self._steering = steering
        self._damping = steering.damping  # after the burst of a window
        self._end, self._looks, self._last = iterations + steering.window, self._seen, self._least
        self._left, self._change = np.inf, steering.heavier  # by the last window; factor of the last change
        self._burst = steering.burst > 0

    def restart(self) -> None:
        self._theta, self.beta = 1.0, 0.0

    def advance(self, uphill: bool) -> None:
        """Of the next step, after one that has gone uphill or not."""
        if uphill:
            self.restart()
            return
        last, self._theta = self._theta, self._theta * (np.sqrt(self._theta**2 + 4) - self._theta) / 2
        self.beta = last * (1 - last) / (last**2 + self._theta)
        if self._bounded and not self._burst:
            self.beta = min(self.beta, 1.0 - self._damping)

    def look(self, iterations: int, residuals: list[float]) -> None:
        """Note the iterations so far, and at the end of a window choose the damping by the residuals looked at."""
        if not self._bounded:
            return
        self._least = min([self._least, *residuals[self._seen :]])
        self._seen = len(residuals)
        while self._stages and self._least < max(self._stages):
            self._enter(self._stages.pop(max(self._stages)), iterations)
        if iterations >= self._end:
            self._choose(residuals)
            self._end = iterations + self._steering.window
        self._burst = iterations < self._end - self._steering.window + self._steering.burst

    def _choose(self, residuals: list[float]) -> None:
        steering = self._steering
        least = min(residuals[self._looks :], default=self._last)
        self._looks = len(residuals)
        left = least / self._last
        if left > steering.little:
            if left >= 1:
                self._change = steering.heavier
            elif left > self._left:
                self._change = 1 / self._change
            self._damping *= self._change
        elif left < steering.much:
            self._damping *= steering.lighter
            self._change = steering.heavier
        self._damping = float(np.clip(self._damping, *steering.range))
        self._last, self._left = least, left
