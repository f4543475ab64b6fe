"""APGD as long as it is expected to need less than the conic interior point method, then that.

APGD's natural residual falls about like the square of its iterations: with k made, and a residual rho, it will need
k sqrt(rho / tol) in all. The conic method takes about the same work for every problem of a size and accuracy. So:

1. begin with APGD; from the 100th iteration on compare what it still needs with what the conic method would;
2. where that is half of it or less, go over to it, from the guess of the beginning;
3. where it stalls, go back to APGD, from the better of the two points, to the end.

The rules count iterations and look at no clock, so that a repeated run repeats its choices.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np

from pctt.ccp.cone import Array
from pctt.ccp.first_order import apgd
from pctt.ccp.interior import conic
from pctt.ccp.newton import Newton
from pctt.ccp.problem import ConeProblem
from pctt.ccp.result import Limits, Result
from pctt.options import POSITIVE, option

TRIAL = 100  # iterations of APGD before its residual says much
CONIC_IT = 60


@dataclass(frozen=True)
class Auto:
    """Options ``-ccp_auto_*``."""

    bias: float = option(
        2.0, "factor on the cost of the conic method: above 1, APGD is given more time", check=POSITIVE
    )


def solve(problem: ConeProblem, guess: Array, limits: Limits, options: Auto, newton: Newton) -> Result:
    """Impulses by the method that is expected to be faster; ``solver`` of the result names it, ``reason`` says why."""
    most = limits.max_it if limits.max_it >= 0 else 20_000
    worth = options.bias * conic_cost(problem, limits.tol)

    def give_up(iterations: int, residual: float) -> str:
        if iterations < TRIAL:
            return ""
        needed = iterations * (np.sqrt(residual / limits.tol) - 1.0)
        if needed <= worth:
            return ""
        return f"apgd at {residual:.0e} after {iterations} iterations, about {needed:.0f} more to go"

    first = apgd.solve(problem, guess, dataclasses.replace(limits, max_it=most), apgd.APGD(), give_up)
    if first.converged or first.iterations >= most:
        return _named(first, "apgd", first.reason)
    inner = dataclasses.replace(limits, max_it=min(CONIC_IT, most))
    second = conic.solve(problem, guess, inner, conic.Conic(), newton)
    words = f"{first.reason}; conic: {second.reason}"
    if second.converged or second.reason.startswith("unbounded") or most <= CONIC_IT:
        return _named(second, "conic", words)
    best = min(first, second, key=lambda result: result.natural_residual)
    third = apgd.solve(problem, best.impulse, dataclasses.replace(limits, max_it=most), apgd.APGD())
    third.ksp_its, third.fallbacks = second.ksp_its, second.fallbacks
    third.history = second.history + third.history
    return _named(third, "apgd", f"{words}; apgd: {third.reason}")


def conic_cost(problem: ConeProblem, tol: float) -> float:
    """What the conic method costs, in iterations of APGD: measured on mixers of 2,600 and 18,000 contacts
    (docs/ccp.md). With compliance it is a fraction of that."""
    size = max(1.0, np.sqrt(problem.size / 2600.0))  # small problems: a Newton step has its fixed costs
    accuracy = np.interp(np.log10(tol), [-8.0, -6.0, -4.0, -2.0], [3600.0, 1450.0, 1050.0, 600.0])
    return float(size * accuracy * (0.25 if problem.softness >= 1e-6 else 1.0))


def _named(result: Result, solver: str, reason: str) -> Result:
    result.solver, result.reason = solver, reason
    return result
