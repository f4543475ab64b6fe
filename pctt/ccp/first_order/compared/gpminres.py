"""Gradient projected minimum residual method (GPMINRES).

Heyn, Anitescu, Tasora, Negrut, "Using Krylov subspace and spectral methods for solving complementarity
problems in many-body contact dynamics simulation", Int. J. Numer. Meth. Engng 95 (2013). As in the GPCG
method of More and Toraldo, SIAM J. Optim. 1 (1991): projected gradient steps until the face settles, then a Krylov
method on the objective in the face, then a search along the projection of the step so found. The Krylov
method is MINRES because N is singular in packings; written as conjugate residuals (Stiefel 1955),
which gives the same iterates for a semidefinite matrix. PETSc's TAOGPCG is for bounds only, not for cones.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pctt.ccp.cone import Array
from pctt.ccp.first_order.compared.faces import Face, GradientProjection
from pctt.ccp.first_order.progress import FirstOrder, Progress
from pctt.ccp.first_order.scaled import ScaledProblem
from pctt.ccp.problem import ConeProblem
from pctt.ccp.result import Limits, Result


@dataclass(frozen=True)
class Steering:
    """When the method changes between projections and MINRES."""

    projections: int = 10  #: most gradient projections in a row
    krylov: int = 10  #: most MINRES iterations in a row,
    reduction: float = 0.3  #: and the reduction of the residual in the face at which they end


STEERING = Steering()


def solve(problem: ConeProblem, guess: Array, limits: Limits, options: FirstOrder) -> Result:
    """Impulses from a first guess (nc, 3)."""
    scaled = ScaledProblem(problem)
    progress = Progress(scaled, limits, options)
    projection = GradientProjection(scaled)
    x = scaled.start(guess)
    y = scaled.gradient(x)
    face = Face(x, scaled.mu)
    while progress.goes_on(x, y):
        for _ in range(STEERING.projections):
            before = face
            x, y, products = projection.step(x, y)
            progress.iterations += products
            face = Face(x, scaled.mu)
            if not progress.goes_on(x, y) or not problem.max(not face.same(before)):
                break
        if progress.reason:
            break
        w = _minres(scaled, face, -face.part(y), progress)
        x, y = _projected_search(scaled, x, y, w, progress)
        face = Face(x, scaled.mu)
    return progress.result()


def _minres(problem: ScaledProblem, face: Face, r: Array, progress: Progress) -> Array:
    """w in the face with A w = r there, approximately."""
    w = np.zeros_like(r)
    Ar = face.part(problem.product(r))
    progress.iterations += 1
    p, Ap = r, Ar
    rAr, first = problem.dots((r, Ar), (r, r))
    for _ in range(STEERING.krylov):
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
        if now <= STEERING.reduction**2 * first or progress.iterations >= progress.limits.max_it:
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
    fraction = min(1.0, -slope / curvature) if curvature > 0 else 1.0
    return x + fraction * d, y + fraction * Ad
