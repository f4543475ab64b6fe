"""Projected block Jacobi, relaxed by an exact line search.

Each contact takes the projected gradient step of its own 3 x 3 problem with all others held, of length 1 over
the largest eigenvalue of its block, which no such step can overshoot; the common relaxation is the exact minimiser
of the objective on the segment to that point. Every step descends from any start for any N (semidefinite
too); without the relaxation the method diverges where a body has more than a few contacts. Projected Jacobi as
in Tasora and Anitescu, "A matrix-free cone complementarity approach for solving large-scale, nonsmooth,
rigid body dynamics", Comput. Methods Appl. Mech. Eng. 200 (2011), who fix the relaxation; the line
search on the direction to the block minimisers is Bertsekas, Nonlinear Programming, section 2.2.
"""

from __future__ import annotations

from pctt.ccp.cone import Array
from pctt.ccp.first_order.scaled import FirstOrder, Progress, ScaledProblem
from pctt.ccp.problem import ConeProblem
from pctt.ccp.result import Limits, Result


def solve(problem: ConeProblem, guess: Array, limits: Limits, options: FirstOrder) -> Result:
    """Impulses from a first guess (nc, 3)."""
    scaled = ScaledProblem(problem)
    progress = Progress(scaled, limits, options)
    x = scaled.start(guess)
    y = scaled.gradient(x)
    length = scaled.block_steps()
    while progress.goes_on(x, y):
        d = scaled.project(x - length * y) - x
        Ad = scaled.product(d)
        progress.iterations += 1
        slope, curvature, bound = scaled.dots((y, d), (d, Ad), (d, d / length))
        slope = min(slope, -bound)  # so it is for a projection; y'd alone drowns in rounding near the solution
        relaxation = min(1.0, -slope / curvature) if curvature > 0 else 1.0
        x = x + relaxation * d
        y += relaxation * Ad
    return progress.result()
