"""Interior point methods for the cone problem."""

from __future__ import annotations

import numpy as np

from pctt.ccp.cone import TINY, Array
from pctt.ccp.problem import ConeProblem


def useful_part(problem: ConeProblem, guess: Array) -> Array:
    """The part t guess, 0 <= t <= 1, of the guess (nc, 3) with the least objective.

    The impulses of a jam that has come loose are too large by orders of magnitude, and an interior point method takes
    dozens of steps to get rid of them, or stalls."""
    along, bent = problem.dot(problem.r, guess), problem.dot(problem.product(guess), guess)
    return float(np.clip(-along / max(bent, TINY), 0.0, 1.0)) * guess
