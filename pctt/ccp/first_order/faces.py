"""Two methods that minimise in the faces of the friction cones: `kucera` and `gpminres`.

A friction cone has three kinds of faces: the cone itself (3 dimensions, sticking contacts), the rays of its surface (1,
sliding contacts), and the apex (0, open contacts). Every point of the cones is in the interior of one face, and there a
quadratic function can be minimised freely, by a Krylov method. Projected gradient steps find the next face. PETSc's
TAO has these families (TAOGPCG, TAOBNCG) for bounds only, not for cones.
"""

from __future__ import annotations

import numpy as np

from pctt.arrays import Array
from pctt.ccp.cones.friction import step_to_boundary, step_to_zero
from pctt.ccp.first_order.projected_steps import minimiser
from pctt.ccp.first_order.scaled import FirstOrder, Progress, ScaledProblem, begin
from pctt.ccp.problem import ConeProblem
from pctt.ccp.result import Limits, Result


def kucera(problem: ConeProblem, guess: Array, limits: Limits, options: FirstOrder) -> Result:
    """Impulses from a first guess (nc, 3), by conjugate gradients in a face, proportioning, and gradient projection
    between faces.

    Kucera, "Minimizing quadratic functions with separable quadratic constraints", Optim. Methods Softw. 22 (2007);
    "Convergence rate of an optimization algorithm for minimizing quadratic functions with separable convex
    constraints", SIAM J. Optim. 19 (2008); after Dostal and Schoeberl's MPRGP for bounds. An iterate is called
    proportional where at least half of the descent of a projected gradient step lies along its face; then a conjugate
    gradient step is made in the face, else the projected gradient step. A conjugate gradient step that would leave the
    face goes as far as it can, and a projected gradient step from there finds the next face.

    Kucera holds contacts on the cone's surface fixed during the conjugate gradients. Here a sliding contact may move
    along its ray, which is a face of the cone too: in a packing a large part of the contacts slides.
    """
    scaled, progress, x, y = begin(problem, guess, limits, options)
    projection = GradientProjection(scaled)
    face = Face(x, scaled.cones.mu)
    p = Ap = np.zeros_like(x)  # the last conjugate direction in this face
    curvature, fresh = 1.0, True
    while progress.goes_on(x, y):
        d = projection.move(x, y)
        gradient = face.part(y)
        descent, along = scaled.dots((y, d), (gradient, d))
        leaves = True
        if descent >= 2 * along:
            p = gradient if fresh else gradient - scaled.dots((gradient, Ap))[0] / curvature * p
            Ap = scaled.product(p)
            progress.iterations += 1
            slope, curvature = scaled.dots((gradient, p), (p, Ap))
            wanted = slope / curvature if curvature > 0 else np.inf
            step = min(wanted, problem.min(face.reach(x, -p)))
            leaves = step < wanted or not np.isfinite(step)
            if np.isfinite(step):
                x = x - step * p
                y -= step * Ap
        if leaves:
            x, y, products = projection.step(x, y)
            progress.iterations += products
            face = Face(x, scaled.cones.mu)
        fresh = leaves
    return progress.result()


def gpminres(problem: ConeProblem, guess: Array, limits: Limits, options: FirstOrder) -> Result:
    """Impulses from a first guess (nc, 3), by the gradient projected minimum residual method.

    Heyn, Anitescu, Tasora, Negrut, "Using Krylov subspace and spectral methods for solving complementarity problems in
    many-body contact dynamics simulation", Int. J. Numer. Meth. Engng 95 (2013). As in the GPCG method of More and
    Toraldo, SIAM J. Optim. 1 (1991): at most ten projected gradient steps, until the face settles, then a Krylov method
    on the objective in the face, then a search along the projection of the step so found.
    """
    scaled, progress, x, y = begin(problem, guess, limits, options)
    projection = GradientProjection(scaled)
    face = Face(x, scaled.cones.mu)
    while progress.goes_on(x, y):
        for _ in range(10):
            before = face
            x, y, products = projection.step(x, y)
            progress.iterations += products
            face = Face(x, scaled.cones.mu)
            if not progress.goes_on(x, y) or not problem.max(not face.same(before)):
                break
        if progress.reason:
            break
        w = _minres(scaled, face, -face.part(y), progress)
        x, y = _projected_search(scaled, x, y, w, progress)
        face = Face(x, scaled.cones.mu)
    return progress.result()


def _minres(problem: ScaledProblem, face: Face, r: Array, progress: Progress) -> Array:
    """w in the face with A w = r there, approximately: until 0.3 of the residual is left, in ten iterations at most.

    MINRES, because N is singular in packings; written as conjugate residuals (Stiefel 1955), which gives the same
    iterates for a semidefinite matrix."""
    w = np.zeros_like(r)
    Ar = face.part(problem.product(r))
    progress.iterations += 1
    p, Ap = r, Ar
    rAr, first = problem.dots((r, Ar), (r, r))
    for _ in range(10):
        squared = problem.dots((Ap, Ap))[0]
        if not (rAr > 0 and squared > 0):
            break
        step = rAr / squared
        w += step * p
        r = r - step * Ap
        Ar = face.part(problem.product(r))
        progress.iterations += 1
        before = rAr
        rAr, now = problem.dots((r, Ar), (r, r))
        if now <= 0.3**2 * first or progress.iterations >= progress.limits.max_it:
            break
        p = r + rAr / before * p
        Ap = Ar + rAr / before * Ap
    return w


def _projected_search(
    problem: ScaledProblem, x: Array, y: Array, w: Array, progress: Progress
) -> tuple[Array, Array]:
    """The minimiser between x and the projection of x + w, of x + w/2, ...: the first that lies downhill."""
    for _ in range(20):
        d = problem.project(x + w) - x
        slope = problem.dots((y, d))[0]
        if slope < 0:
            break
        w = 0.5 * w
    else:
        return x, y
    Ad = problem.product(d)
    progress.iterations += 1
    curvature = problem.dots((d, Ad))[0]
    fraction = minimiser(slope, curvature)
    return x + fraction * d, y + fraction * Ad


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

    def reach(self, x: Array, p: Array) -> float:
        """Largest a with x + a p in the face, on this rank."""
        i, s = self.inside, self.sliding
        with np.errstate(over="ignore"):  # of a p that is nearly zero: no limit
            return min(step_to_boundary(x[i], p[i], self.mu[i]), step_to_zero(x[s, 0], p[s, 0]))

    def same(self, other: Face) -> bool:
        """Whether contacts stick, slide and open alike on this rank."""
        return bool((self.inside == other.inside).all() and (self.sliding == other.sliding).all())


class GradientProjection:
    """Projected gradient steps of the fixed length 1.9 / L, below the limit 2 / L of descent.

    L is an estimate of the largest eigenvalue of A, raised where a step shows it to be too small.
    """

    def __init__(self, problem: ScaledProblem):
        self.problem = problem
        self.lipschitz = problem.largest_curvature()

    def move(self, x: Array, y: Array) -> Array:
        """P(x - 1.9 / L y) - x."""
        return self.problem.cones.move(x, y, 1.9 / self.lipschitz)

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
