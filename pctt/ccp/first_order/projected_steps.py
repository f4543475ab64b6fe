"""Projected steps whose length comes from a line search: `barzilai_borwein`, `spectral` and `jacobi`.

The first two alternate between the two Barzilai-Borwein lengths of a projected step. They differ in when a step is
shortened, as the objective need not fall in every one of them. All take one product with N per iteration.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from pctt.arrays import Array
from pctt.ccp.first_order.scaled import FirstOrder, ScaledProblem, begin
from pctt.ccp.problem import ConeProblem
from pctt.ccp.result import Limits, Result
from pctt.options import number

# from slope and curvature, of the change slope t + curvature t^2 / 2 of the objective: the part t of the step to take
LineSearch = Callable[[float, float], float]


@dataclass(frozen=True)
class BarzilaiBorwein(FirstOrder):
    """The numbers of `barzilai_borwein` and `spectral`, set from Python."""

    window: int = number(10, "objectives that the line search compares with; Dai and Fletcher's L, Birgin's M")


def adaptive(problem: ConeProblem, guess: Array, limits: Limits, options: BarzilaiBorwein) -> Result:
    """Impulses from a first guess (nc, 3), by the adaptive nonmonotone line search.

    Dai and Fletcher, "Projected Barzilai-Borwein methods for large-scale box-constrained quadratic programming", Numer.
    Math. 100 (2005); here on cones, as the method needs nothing but the projection. A step is shortened, to the exact
    minimiser on its segment, only where the objective would rise above a reference value: the worst of the values since
    the best one, taken over when ``window`` steps have brought no new best.
    """
    reference, best, worst, since = np.inf, 0.0, 0.0, 0  # objectives, less that of the present point

    def line_search(slope: float, curvature: float) -> float:
        nonlocal reference, best, worst, since
        part = minimiser(slope, curvature) if slope + 0.5 * curvature > reference else 1.0
        change = part * slope + 0.5 * part**2 * curvature
        reference, best, worst = reference - change, best - change, worst - change
        if best > 0:
            best, worst, since = 0.0, 0.0, 0
        else:
            worst, since = max(worst, 0.0), since + 1
            if since == options.window:
                reference, worst, since = worst, 0.0, 0
        return part

    return _descend(problem, guess, limits, options, line_search)


def spectral(problem: ConeProblem, guess: Array, limits: Limits, options: BarzilaiBorwein) -> Result:
    """Impulses from a first guess (nc, 3), by preconditioned spectral projected gradient with fallback (P-SPG-FB).

    Heyn, Anitescu, Tasora, Negrut, "Using Krylov subspace and spectral methods for solving complementarity problems in
    many-body contact dynamics simulation", Int. J. Numer. Meth. Engng 95 (2013), after Birgin, Martinez, Raydan,
    "Nonmonotone spectral projected gradient methods on convex sets", SIAM J. Optim. 10 (2000). The preconditioner is
    the diagonal of N (`ScaledProblem`), taken so that the projection stays exact in its metric. Steps are accepted by
    the nonmonotone test of Grippo, Lampariello and Lucidi: sufficient descent below the largest of the last ``window``
    objectives. The fallback is that the result is the best point seen (`Progress`).
    """
    rises = np.zeros(1)  # objectives of the last points, less that of the present one

    def line_search(slope: float, curvature: float) -> float:
        nonlocal rises
        part, change = sufficient(slope, curvature, rises.max())
        rises = np.append(rises - change, 0.0)[-options.window :]
        return part

    return _descend(problem, guess, limits, options, line_search)


def sufficient(slope: float, curvature: float, rise: float) -> tuple[float, float]:
    """The part of a step to take, and the change of the objective, with the constants of Birgin, Martinez and Raydan.

    ``rise``: how far above the present objective the next one may be."""
    part, change = 1.0, slope + 0.5 * curvature
    while change > rise + 1e-4 * part * slope and slope < 0:
        part *= min(max(-slope / (curvature * part), 0.1), 0.9)
        change = part * slope + 0.5 * part**2 * curvature
    return part, change


def jacobi(problem: ConeProblem, guess: Array, limits: Limits, options: FirstOrder) -> Result:
    """Impulses from a first guess (nc, 3), by projected block Jacobi, relaxed by an exact line search.

    Each contact takes the projected gradient step of its own 3 x 3 problem with all others held, of length 1 over the
    largest eigenvalue of its block, which no such step can overshoot; the common relaxation is the exact minimiser of
    the objective on the segment to that point. Every step descends from any start for any N (semidefinite too); without
    the relaxation the method diverges where a body has more than a few contacts. Projected Jacobi as in Tasora and
    Anitescu, "A matrix-free cone complementarity approach for solving large-scale, nonsmooth, rigid body dynamics",
    Comput. Methods Appl. Mech. Eng. 200 (2011), who fix the relaxation; the line search on the direction to the block
    minimisers is Bertsekas, Nonlinear Programming, section 2.2.
    """
    return _descend(problem, guess, limits, options, minimiser, ScaledProblem.block_steps)


def minimiser(slope: float, curvature: float) -> float:
    """The part of a step at which slope t + curvature t^2 / 2 is least."""
    return min(1.0, -slope / curvature) if curvature > 0 else 1.0


def _descend(
    problem: ConeProblem, guess: Array, limits: Limits, options: FirstOrder, line_search: LineSearch,
    lengths: Callable[[ScaledProblem], Array] | None = None,
) -> Result:  # fmt: skip
    """Impulses by projected steps with any line search, of given ``lengths`` (nc, 3) or those of Barzilai and
    Borwein."""
    scaled, progress, x, y = begin(problem, guess, limits, options)
    step = 1.0 if lengths is None else lengths(scaled)  # A has a diagonal of about one
    while progress.goes_on(x, y):
        d = scaled.cones.move(x, y, step)
        Ad = scaled.product(d)
        progress.iterations += 1
        slope, bound, length, curvature, stretch = scaled.dots((y, d), (d, d / step), (d, d), (d, Ad), (Ad, Ad))
        slope = min(slope, -bound)  # so it is for a projection; y'd drowns in rounding near the solution
        part = line_search(slope, curvature)
        if part != 1.0:
            d *= part
            Ad *= part
        x = np.add(x, d, out=d)
        y += Ad
        if lengths is None:
            step = 1.0
            if curvature > 1e-14 * length:  # else rounding decides its sign
                step = float(length / curvature if progress.iterations % 2 else curvature / stretch)
    return progress.result()
