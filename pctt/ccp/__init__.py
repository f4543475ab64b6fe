"""Cone complementarity problems with friction: the problem, its solvers, and how good a solution is.

>>> from pctt import ccp
>>> result = ccp.solve(problem)                       # doctest: +SKIP
>>> ccp.measure(problem, result.impulse)              # doctest: +SKIP
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from pctt.blocks import BlockRows
from pctt.ccp.accuracy import Accuracy, measure
from pctt.ccp.compare import Comparison
from pctt.ccp.cone import Array
from pctt.ccp.problem import ConeProblem
from pctt.ccp.registry import SOLVERS
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
    limits = limits or Limits()
    if limits.max_it < 0:
        limits = dataclasses.replace(limits, max_it=solver.iterations)
    guess = np.zeros_like(problem.r) if guess is None else guess
    nothing = np.zeros_like(problem.r)
    if problem.size == 0:
        return Result(nothing, True, "no contacts", 0.0, 0)
    if problem.natural_residual(nothing, problem.r) == 0:
        return Result(nothing, True, "no contact closes", 0.0, 0)
    extra = {"compare": compare} if solver.newton else {}
    with phase("CCPSolve"):
        return solver.function(problem, guess, limits, options or solver.options(), **extra)
