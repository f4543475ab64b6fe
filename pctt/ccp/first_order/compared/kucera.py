"""Kucera's method: conjugate gradients in a face, proportioning, and gradient projection between faces.

Kucera, "Minimizing quadratic functions with separable quadratic constraints", Optim. Methods Softw. 22 (2007);
"Convergence rate of an optimization algorithm for minimizing quadratic functions with separable convex
constraints", SIAM J. Optim. 19 (2008); after Dostal and Schoeberl's MPRGP for bounds. An iterate is called
proportional where at least half of the descent of a projected gradient step lies along its face; then a
conjugate gradient step is made in the face, else the projected gradient step. A conjugate gradient step that
would leave the face goes as far as it can, and a projected gradient step from there finds the next face.

Kucera holds contacts on the cone's surface fixed during the conjugate gradients. Here a sliding contact may move
along its ray, which is a face of the cone too: in a packing a large part of the contacts slides. PETSc's TAO has
this family (TAOGPCG, TAOBNCG) for bounds only, not for cones.
"""

from __future__ import annotations

import numpy as np

from pctt.ccp.cone import Array
from pctt.ccp.first_order.compared.faces import Face, GradientProjection
from pctt.ccp.first_order.progress import FirstOrder, Progress
from pctt.ccp.first_order.scaled import ScaledProblem
from pctt.ccp.problem import ConeProblem
from pctt.ccp.result import Limits, Result

PROPORTION = 1.0  # descent across the face, in units of that along it, up to which conjugate gradients go on


def solve(problem: ConeProblem, guess: Array, limits: Limits, options: FirstOrder) -> Result:
    """Impulses from a first guess (nc, 3)."""
    scaled = ScaledProblem(problem)
    progress = Progress(scaled, limits, options)
    projection = GradientProjection(scaled)
    x = scaled.start(guess)
    y = scaled.gradient(x)
    face = Face(x, scaled.mu)
    p = Ap = np.zeros_like(x)  # the last conjugate direction in this face
    curvature, fresh = 1.0, True
    while progress.goes_on(x, y):
        d = projection.move(x, y)
        gradient = face.part(y)
        descent, along = scaled.dots((y, d), (gradient, d))
        leaves = True
        if descent >= (1 + PROPORTION) * along:
            p = gradient if fresh else gradient - scaled.dots((gradient, Ap))[0] / curvature * p
            Ap = scaled.product(p)
            progress.iterations += 1
            slope, curvature = scaled.dots((gradient, p), (p, Ap))
            wanted = slope / curvature if curvature > 0 else np.inf
            step = min(wanted, problem.min(face.way(x, -p)))
            leaves = step < wanted or not np.isfinite(step)
            if np.isfinite(step):
                x = x - step * p
                y -= step * Ap
        if leaves:
            x, y, products = projection.step(x, y)
            progress.iterations += products
            face = Face(x, scaled.mu)
        fresh = leaves
    return progress.result()
