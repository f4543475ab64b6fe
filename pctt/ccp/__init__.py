"""Cone complementarity problems with friction: the problem, its solvers, and how good a solution is.

>>> from pctt import ccp
>>> result = ccp.solve(problem)                       # doctest: +SKIP
>>> ccp.measure(problem, result.impulse)              # doctest: +SKIP
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from pctt.blocks import BlockRows
from pctt.ccp import apgd, pdip
from pctt.ccp.accuracy import Accuracy, measure
from pctt.ccp.compare import Comparison
from pctt.ccp.cone import Array
from pctt.ccp.problem import ConeProblem
from pctt.ccp.result import Limits, Result
from pctt.log import phase

__all__ = [
    "SOLVERS",
    "Accuracy",
    "BlockRows",
    "Comparison",
    "ConeProblem",
    "Limits",
    "Result",
    "measure",
    "solve",
]


@dataclass(frozen=True)
class Solver:
    """A method of the registry: its function, its options class, whether it solves Newton systems."""

    function: Callable[..., Result]
    options: type
    newton: bool
    help: str


SOLVERS = {
    "pdip": Solver(pdip.solve, pdip.PDIP, True, "the paper's primal-dual interior point method"),
    "apgd": Solver(apgd.solve, apgd.APGD, False, "accelerated projected gradient descent with restart"),
}


def solve(
    problem: ConeProblem,
    guess: Array | None = None,
    type: str = "pdip",
    limits: Limits | None = None,
    options: Any = None,
    compare: Comparison | None = None,
) -> Result:
    """Solve a cone problem by a method of SOLVERS.

    ``guess`` (nc, 3) holds the last impulses of persistent contacts and zeros elsewhere; ``options`` is an
    instance of the method's options class; ``compare`` works with methods that solve Newton systems.
    """
    solver = SOLVERS[type]
    guess = np.zeros_like(problem.r) if guess is None else guess
    nothing = np.zeros_like(problem.r)
    if problem.size == 0:
        return Result(nothing, True, "no contacts", 0.0, 0)
    if problem.natural_residual(nothing, problem.r) == 0:
        return Result(nothing, True, "no contact closes", 0.0, 0)
    extra = {"compare": compare} if solver.newton else {}
    with phase("CCPSolve"):
        return solver.function(problem, guess, limits or Limits(), options or solver.options(), **extra)
