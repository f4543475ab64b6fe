"""Interior point methods for the cone problem."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from pctt.arrays import TINY, Array
from pctt.ccp.cones.lorentz import HELD
from pctt.ccp.result import Limits, Status

if TYPE_CHECKING:
    from pctt.ccp.problem import ConeProblem

INDEFINITE = "N is not positive semidefinite: a step has negative curvature"


def useful_part(problem: ConeProblem, guess: Array) -> Array:
    """The part t guess, 0 <= t <= 1, of the guess (nc, 3) with the least objective.

    The impulses of a jam that has come loose are too large by orders of magnitude, and an interior point method takes
    dozens of steps to get rid of them, or stalls."""
    along, bent = problem.dot(problem.r, guess), problem.dot(problem.product(guess), guess)
    return float(np.clip(-along / max(bent, TINY), 0.0, 1.0)) * guess


def velocity(problem: ConeProblem, g: Array) -> Array:
    """y = N g + r (nc, 3) but for the sliding of contacts without friction, which no impulse answers."""
    y = problem.product(g) + problem.r
    y[problem.mu == 0, 1:] = 0.0
    return y


def end_of(
    problem: ConeProblem, limits: Limits, history: list[float], dg: Array, dy: Array
) -> tuple[Status, str] | None:
    """Why Newton steps end that have left the residuals ``history``, the last of which has changed impulses and
    velocities by dg and dy (nc, 3); None if they go on."""
    if history[-1] <= limits.tol:
        return Status.CONVERGED, limits.met
    if len(history) > limits.max_it:
        return Status.ITERATION_LIMIT, f"{limits.max_it} Newton steps"
    curvature, square = problem.sum(np.array([np.vdot(dg, dy), np.vdot(dg, dg)]))
    return (Status.BREAKDOWN, INDEFINITE) if curvature < -1e-10 * problem.mean_diagonal * square else None  # rounding


def no_step(length: float, words: str) -> tuple[Status, str]:
    """The end of a method that has found no step of a useful length."""
    return (Status.STALLED, words) if length == length else (Status.BREAKDOWN, "not a number in the Newton step")


def hold(blocks: Array, free: NDArray[np.bool_], stiff: Array) -> None:
    """Hold the tangential impulses of contacts that are ``free`` of friction at zero: in their blocks (nc, 3, 3), with
    a number that is large beside ``stiff`` (nc,), the normal entry of the barrier."""
    blocks[free, 1, 1] = blocks[free, 2, 2] = HELD * np.maximum(stiff[free], 1.0)
