"""Cone complementarity problems with friction: the problem, its solvers, and how good a solution is.

>>> from pctt import ccp
>>> result = ccp.solve(problem)                       # doctest: +SKIP
>>> ccp.measure(problem, result.impulse)              # doctest: +SKIP
"""

from __future__ import annotations

import dataclasses
from functools import partial
from typing import Any

import numpy as np
from mpi4py import MPI

from dem.contact_map import BlockRows, CompactRows
from dem.exchange import refuse
from pctt.ccp import coulomb as coulombs_law
from pctt.ccp.accuracy import Accuracy, measure
from pctt.ccp.auto import Auto
from pctt.ccp.cone import Array
from pctt.ccp.coulomb import Coulomb
from pctt.ccp.newton import FORMS, Newton
from pctt.ccp.newton.compare import Comparison
from pctt.ccp.problem import ConeProblem
from pctt.ccp.registry import NEWTON, SOLVERS, Solver
from pctt.ccp.result import Limits, Result, Status
from pctt.ccp.unbounded import why_unbounded
from pctt.log import phase

__all__ = [
    "FORMS",
    "NEWTON",
    "SOLVERS",
    "Accuracy",
    "BlockRows",
    "CompactRows",
    "Comparison",
    "ConeProblem",
    "Coulomb",
    "Limits",
    "Newton",
    "Result",
    "Status",
    "measure",
    "newton_for",
    "solve",
]


def solve(
    problem: ConeProblem,
    guess: Array | None = None,
    type: str = "pdip",
    limits: Limits | None = None,
    options: Any = None,
    newton: Newton | None = None,
    coulomb: Coulomb | None = None,
) -> Result:
    """Solve a cone problem by a method of SOLVERS; with ``coulomb`` find impulses of Coulomb's law.

    For Coulomb's law there is a ladder. The first rung is the method's own way, if it has one (`Solver.has_law`). That
    of `conic` and `auto` is the way of `auto`: `apgd`, then the path of `conic` and `apgd` from its end; where that
    fails, `conic` and `apgd` once more. If none of them comes near the law, the second rung is a sequence of cone
    problems (`pctt.ccp.coulomb`). If that does not converge either, the result is the best of all and of the
    relaxation, by the Coulomb residual, and counts as not converged. ``law`` of the result names the rung.

    ``guess`` (nc, 3) holds the last impulses of persistent contacts and zeros elsewhere; ``options`` is an instance of
    the method's options class; ``newton``, for methods that solve Newton systems, keeps solvers and preconditioners
    from one problem to the next. A problem without a solution has the status UNBOUNDED.
    """
    if type not in SOLVERS:
        raise ValueError(f"the solver {type!r}: allowed are {', '.join(SOLVERS)}")
    solver = SOLVERS[type]
    limits = limits or Limits()
    if not limits.tol > 0.0:
        raise ValueError(f"the tolerance {limits.tol}: allowed is a positive number")
    if limits.max_it < 0:
        limits = dataclasses.replace(limits, max_it=solver.iterations)
    guess = _start(problem, guess)
    own = newton_for(problem.comm, type) if solver.newton and newton is None else None

    def by(method: Solver, problem: ConeProblem, guess: Array, tol: float, law: bool = False) -> Result:
        if method is solver:
            return _once(problem, guess, method, limits.to(tol), options or method.options(), newton or own, law)
        to = dataclasses.replace(limits.to(tol), max_it=method.iterations)
        # without a look at the clock, so that a repeated run of `conic` repeats its choices
        defaults = Auto(remember=False) if method.name == "auto" else method.options()
        result = _once(problem, guess, method, to, defaults, newton or own, law)
        result.solver = result.solver or method.name
        return result

    try:
        if coulomb is None:
            return _with_momentum(problem, by(solver, problem, guess, limits.tol))
        methods = [solver] if solver.has_law or problem.size == 0 else []
        if solver.has_law and solver.newton:
            methods = [SOLVERS[name] for name in ("auto", "conic", "apgd")]
        ways = [partial(by, method, law=True) for method in methods]
        result = coulombs_law.ladder(problem, guess, limits, coulomb, partial(by, solver), ways)
        return _with_momentum(problem, result)
    finally:
        if own is not None:
            own.destroy()


def _with_momentum(problem: ConeProblem, result: Result) -> Result:
    result.momentum = problem.momentum(result.impulse)
    return result


def _start(problem: ConeProblem, guess: Array | None) -> Array:
    """The guess as an array (nc, 3) of float64, zero without one; ValueError on all ranks for another shape or if it is
    no number."""
    start = np.zeros_like(problem.r) if guess is None else np.ascontiguousarray(guess, dtype=float)
    wrong = "" if np.isfinite(start).all() else "a guess with a NaN or an infinite number"
    if start.shape != problem.r.shape:
        wrong = f"a guess of shape {start.shape}; allowed is {problem.r.shape}"
    refuse(problem.comm, wrong)
    return start


def _once(
    problem: ConeProblem, guess: Array, solver: Solver, limits: Limits, options: Any, newton: Newton | None, law: bool
) -> Result:
    """Solve the cone problem as it is, or with ``law`` have the method find Coulomb's law. Impulses that are no numbers
    become zero."""
    nothing = np.zeros_like(problem.r)
    if problem.size == 0:
        return Result(nothing, Status.CONVERGED, "no contacts", 0.0, 0)
    cold = problem.natural_residual(nothing, problem.r)
    if cold == 0:
        return Result(nothing, Status.CONVERGED, "no contact closes", 0.0, 0)
    arguments = (problem, guess, limits, options, *([newton] if solver.newton else []))
    with phase("CCPSolve"):
        result = solver.function(*arguments, **({"coulomb": True} if law else {}))
        if problem.sum(np.count_nonzero(~np.isfinite(result.impulse))):
            reason = f"impulses are no numbers: {result.reason}"
            return dataclasses.replace(
                result, impulse=nothing, status=Status.BREAKDOWN, reason=reason, residual=cold
            )
        unbounded = why_unbounded(problem, result.impulse)
        if unbounded:
            result.status, result.reason = Status.UNBOUNDED, unbounded
        return result


def newton_for(comm: MPI.Comm, type: str, form: str = "auto", compare: Comparison | None = None) -> Newton:
    """The Newton systems that a method of SOLVERS works with; ``form`` is auto or of FORMS."""
    if compare is not None and not compare.names:
        compare = None
    if form == "auto":
        form = "body" if type in ("conic", "auto") and compare is None else "contact"
    return Newton(comm, form, compare)
