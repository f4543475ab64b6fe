"""The friction cone as a smooth convex constraint f(g) <= 0, as the interior point method needs it.

``quadratic`` is the paper's, 1/2 (g_1^2 + g_2^2 - mu^2 g_n^2) for g_n > 0. Its gradient vanishes at the
apex, so the multipliers of opening contacts diverge. ``perspective`` divides it by g_n: the same cone, but
a function that is convex and of degree one, whose gradient stays away from zero and whose multipliers stay
bounded.

A contact without friction has no interior; its constraint is -g_n <= 0, its tangential impulses stay zero.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pctt.ccp.cone import Array


@dataclass(frozen=True)
class Perspective:
    """f = 1/2 (|g_t|^2 / g_n - mu^2 g_n)."""

    mu: Array

    def value(self, g: Array) -> Array:
        f = 0.5 * ((g[:, 1] ** 2 + g[:, 2] ** 2) / g[:, 0] - self.mu**2 * g[:, 0])
        return np.where(self.mu > 0, f, -g[:, 0])

    def gradient(self, g: Array) -> Array:
        df = np.empty_like(g)
        df[:, 1:] = g[:, 1:] / g[:, :1]
        df[:, 0] = -0.5 * (df[:, 1] ** 2 + df[:, 2] ** 2 + self.mu**2)
        df[self.mu == 0] = [-1.0, 0.0, 0.0]
        return df

    def hessian(self, g: Array) -> Array:
        slope = g[:, 1:] / g[:, :1]
        H = np.zeros((len(g), 3, 3))
        H[:, 0, 0] = (slope**2).sum(1)
        H[:, 0, 1:] = H[:, 1:, 0] = -slope
        H[:, 1, 1] = H[:, 2, 2] = 1.0
        H /= g[:, 0][:, None, None]
        H[self.mu == 0] = 0.0
        return H


@dataclass(frozen=True)
class Quadratic:
    """f = 1/2 (|g_t|^2 - mu^2 g_n^2), the paper's; its Hessian is diag(-mu^2, 1, 1)."""

    mu: Array

    def value(self, g: Array) -> Array:
        f = 0.5 * (g[:, 1] ** 2 + g[:, 2] ** 2 - (self.mu * g[:, 0]) ** 2)
        return np.where(self.mu > 0, f, -g[:, 0])

    def gradient(self, g: Array) -> Array:
        df = g * np.stack([-(self.mu**2), np.ones_like(self.mu), np.ones_like(self.mu)], axis=1)
        df[self.mu == 0] = [-1.0, 0.0, 0.0]
        return df

    def hessian(self, g: Array) -> Array:
        H = np.zeros((len(g), 3, 3))
        H[:, 0, 0] = -(self.mu**2)
        H[:, 1, 1] = H[:, 2, 2] = self.mu > 0
        return H


CONSTRAINTS: dict[str, type[Perspective] | type[Quadratic]] = {
    "perspective": Perspective,
    "quadratic": Quadratic,
}
