"""Faces of the friction cones: the parts of the boundary on which a quadratic function can be minimised freely.

A friction cone has three kinds of faces: the cone itself (3 dimensions, sticking contacts), the rays of its
surface (1, sliding contacts), and the apex (0, open contacts). Every point of the cones is in the interior of
one face.
"""

from __future__ import annotations

import numpy as np

from pctt.ccp.cone import Array, step_to_boundary, step_to_zero
from pctt.ccp.first_order.scaled import ScaledProblem


class Face:
    """The face of x (nc, 3): ``inside`` (nc,) of the cones, ``ray`` (nc, 3) unit vectors, zero elsewhere."""

    def __init__(self, x: Array, mu: Array):
        """x comes from a projection: of a point outside it is on the surface but for rounding."""
        tangential = np.hypot(x[:, 1], x[:, 2])
        self.mu = mu
        self.inside = tangential < mu * x[:, 0] * (1 - 1e-12)
        self.sliding = ~self.inside & (x[:, 0] > 0)
        self.ray = np.zeros_like(x)
        self.ray[self.sliding] = x[self.sliding] / np.hypot(x[:, 0], tangential)[self.sliding, None]
        self._free = np.repeat(self.inside, 3).reshape(-1, 3).astype(float)

    def part(self, v: Array) -> Array:
        """The part of v along the face (nc, 3)."""
        along = v[:, 0] * self.ray[:, 0]
        along += v[:, 1] * self.ray[:, 1]
        along += v[:, 2] * self.ray[:, 2]
        out = v * self._free
        for k in range(3):
            out[:, k] += along * self.ray[:, k]
        return out

    def way(self, x: Array, p: Array) -> float:
        """Largest a with x + a p in the face, on this rank."""
        i, s = self.inside, self.sliding
        with np.errstate(over="ignore"):  # of a p that is nearly zero: no limit
            return min(step_to_boundary(x[i], p[i], self.mu[i]), step_to_zero(x[s, 0], p[s, 0]))

    def same(self, other: Face) -> bool:
        """Whether contacts stick, slide and open alike on this rank."""
        return bool((self.inside == other.inside).all() and (self.sliding == other.sliding).all())


class GradientProjection:
    """Projected gradient steps of the fixed length LENGTH / L, below the limit 2 / L of descent.

    L is an estimate of the largest eigenvalue of A, raised where a step shows it to be too small.
    """

    LENGTH = 1.9

    def __init__(self, problem: ScaledProblem):
        self.problem = problem
        self.lipschitz = problem.largest_curvature()

    def move(self, x: Array, y: Array) -> Array:
        """P(x - LENGTH / L y) - x."""
        return self.problem.projected_move(x, y, self.LENGTH / self.lipschitz)

    def step(self, x: Array, y: Array) -> tuple[Array, Array, int]:
        """The next point, its gradient, and the products with A that it took."""
        products = 0
        while True:
            d = self.move(x, y)
            Ad = self.problem.product(d)
            products += 1
            curvature, length = self.problem.dots((d, Ad), (d, d))
            if not curvature > self.lipschitz * length * (1 + 1e-12):  # also ends on a number that is none
                return x + d, y + Ad, products
            self.lipschitz = 1.1 * curvature / length
