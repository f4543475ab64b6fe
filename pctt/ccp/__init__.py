"""Cone complementarity problems with friction: the problem, its solvers, and how good a solution is.

>>> from pctt import ccp
>>> result = ccp.solve(problem)                       # doctest: +SKIP
>>> result.accuracy                                   # doctest: +SKIP
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray
from petsc4py import PETSc

from dem.compiled import loop
from dem.contact_map import BlockRows, CompactRows
from dem.exchange import greatest, on_each
from pctt.arrays import Array, all_from
from pctt.ccp.accuracy import Accuracy, figures, measure
from pctt.ccp.cones import FrictionCones, RollingCones
from pctt.ccp.coulomb import fixed_point
from pctt.ccp.door import Operator
from pctt.ccp.newton import FORMS, Newton
from pctt.ccp.newton.compare import Comparison
from pctt.ccp.problem import ConeProblem
from pctt.ccp.registry import MATRIX, NEWTON, SOLVERS, why_no_form, why_refused
from pctt.ccp.result import COULOMB, FIXED_POINT, LAWS, RELAXATION, Counts, Limits, Result, Status
from pctt.ccp.unbounded import why_indefinite, why_unanswered, why_unbounded
from pctt.log import phase
from pctt.options import function_or_none, instance, known_arguments, short

__all__ = [
    "COULOMB", "FORMS", "LAWS", "NEWTON", "RELAXATION", "SOLVERS", "Accuracy", "BlockRows", "CompactRows", "Comparison",
    "ConeProblem", "FrictionCones", "Limits", "Newton", "Operator", "Result", "RollingCones", "Status", "measure",
    "newton_for", "solve", "solved", "watched", "with_part",
]  # fmt: skip

GRIPS = 10.0  #: more friction than anything has, and so with any tolerance
STEEP = 0.1  #: mu tol; with 0.05 a sphere rolls as it should, with 0.5 it may roll backwards


@known_arguments(limits=Limits)
def solve(
    problem: ConeProblem, guess: Array | None = None, type: str = "auto",
    limits: Limits | Mapping[str, Any] | None = None, options: Any = None, newton: Newton | None = None,
    law: str = COULOMB, monitor: Callable[[int, float], None] | None = None,
) -> Result:  # fmt: skip
    """Find impulses of Coulomb's law by a method of SOLVERS; with the ``law`` RELAXATION solve the cone problem.

    Where the method does not solve it, one other goes on from its impulses, with its own limit of iterations: `apgd`,
    or `conic` after `apgd`. If that does not solve it either, the result is the one with the smaller residual, and its
    status says that it is not converged. With ``limits.fallback`` false the asked method is alone.

    Coulomb's law is found by the method itself if it can (`Solver.has_law`), else by a sequence of cone problems
    (`pctt.ccp.coulomb`). If one of these has no solution, the other method decides whether the law has one.

    A problem with `RollingCones`, whose impulses are (2 nc, 3), is for `conic`, `apgd` and `auto`. A problem given by a
    `pctt.ccp.Operator` is for all methods but `gauss_seidel`; ValueError for a preconditioner that reads entries.

    ``guess`` (nc, 3) holds the last impulses of persistent contacts and zeros elsewhere; ``options`` is an instance of
    the method's options class, and ``limits`` of `Limits`, or a dict of some fields; ``newton``, for methods that solve
    Newton systems, keeps solvers and preconditioners from one problem to the next; ``monitor(iterations, residual)`` is
    called wherever the residual is known, on every rank. A problem without a solution has the status UNBOUNDED.
    """
    if not isinstance(problem, ConeProblem):
        raise ValueError(f"the problem {short(problem)}: allowed is a ConeProblem")
    if not isinstance(type, str) or type not in SOLVERS:
        raise ValueError(f"the solver {type!r}: allowed are {', '.join(SOLVERS)}")
    if law not in LAWS:
        raise ValueError(f"the law {law!r}: allowed are {', '.join(LAWS)}")
    if why := why_refused(type, problem.cones.__class__):
        raise ValueError(f"the solver {type!r}: the problem has {why}")
    if newton is not None and not isinstance(newton, Newton):
        raise ValueError(f"newton {short(newton)}: allowed is what newton_for(comm, type, form) gives, or None")
    function_or_none("monitor", monitor)
    if problem.cones.parts > 1 and newton is not None and newton.form != "body":
        raise ValueError(f"the Newton form {newton.form!r}: with {problem.cones.what} allowed is body")
    _refuse_form(type, newton.form if newton is not None else "")
    if not problem.has_entries and SOLVERS[type].needs == MATRIX:
        allowed = ", ".join(name for name, method in SOLVERS.items() if method.needs != MATRIX)
        raise ValueError(f"the solver {type!r} reads rows of N, but N is given by its products; allowed are {allowed}")
    limits = watched(problem.comm, instance(Limits, "limits", limits), monitor)
    if law == COULOMB and (steep := why_steep(greatest(problem.comm, float(problem.mu.max(initial=0.0))), limits.tol)):
        raise ValueError(f"mu {steep}")
    options = instance(SOLVERS[type].options, "options", options, f" for {type}")
    start = problem.taken("a guess", problem.shown(np.zeros(problem.r.shape)) if guess is None else guess, finite=True)
    result = solved(problem, start, type, limits, options, newton, law)
    for each in (result,) if result.asked is None else (result, result.asked):
        _tell_states(problem, each)
        each.impulse = problem.shown(each.impulse)
    return result


def why_steep(mu: float, tol: float) -> str:
    """Why friction of this coefficient cannot be solved for with a tolerance; empty if it can. De Saxce's term is mu
    times as large as slip, so that a residual of `tol` lets contacts close at mu tol times the speed of all."""
    if mu <= max(STEEP / tol, GRIPS):
        return ""
    says = f"a residual of tol lets contacts close at {mu * tol:.1g} times the speeds of the problem"
    return f"{mu:g} with tol {tol:g}: {says}; allowed is up to {max(STEEP / tol, GRIPS):.3g}, which holds as well"


def watched(comm: MPI.Comm, limits: Limits, monitor: Callable[[int, float], None] | None = None) -> Limits:
    """The limits with a ``watch`` that calls a monitor, or prints, where either is asked for."""
    if monitor is None and not limits.monitor:
        return limits
    watch = monitor or partial(_print, comm)
    return limits.but(watch=lambda *at: on_each(comm, "monitor", lambda: watch(*at)))


def solved(
    problem: ConeProblem, start: Array, type: str, limits: Limits, options: Any, newton: Newton | None, law: str
) -> Result:
    """The same from impulses in the cones (nc, 3), by settings that are checked already, without velocities and states
    of the contacts: a step has no use for them."""
    result = asked = _by(type, problem, start, limits, options, newton, law)
    other = "conic" if asked.solver == "apgd" else "apgd"
    wrong = asked.status is Status.BREAKDOWN and other == "conic"  # products are no numbers
    # impulses that grow show that the relaxation has no solution; the law, which `apgd` follows, may have one
    grown = asked.status is Status.UNBOUNDED and asked.iterations > 0
    doubtful = grown and law == COULOMB and asked.solver != "apgd"
    hopeless = (asked.final and not doubtful) or asked.exhausted or wrong
    if limits.fallback and not hopeless:
        rest = dataclasses.replace(limits.after(asked.iterations), max_it=-1)
        second = _by(other, problem, start if doubtful else asked.impulse, rest, None, newton, law)
        better = second.final or (asked.law == FIXED_POINT if doubtful else second.residual < asked.residual)
        result = second.after(asked) if better else dataclasses.replace(asked).after(second)
        result.asked, result.reason = asked, f"{type}: {asked.reason}; {other}: {second.reason}"
    return result


def with_part(problem: ConeProblem, result: Result, rows: NDArray[np.intp], part: Result) -> Result:
    """Return the result with the impulses of these rows from a result of their own (`ConeProblem.part`), and with its
    cost. Collective."""
    impulse = result.impulse.copy()
    impulse[rows] = part.impulse
    result = dataclasses.replace(result, impulse=impulse).after(part)
    _measure(problem, result)
    return result


def _by(
    name: str, problem: ConeProblem, guess: Array, limits: Limits, options: Any, newton: Newton | None, law: str
) -> Result:
    """What one method makes of the problem. Impulses that are no numbers become zero."""
    method, coulomb = SOLVERS[name], law == COULOMB
    cold = problem.natural_residual(np.zeros(problem.r.shape), problem.r, coulomb)
    if cold == 0:
        words = "no contact closes" if problem.size else "no contacts"
        result = Result(np.zeros(problem.r.shape), Status.CONVERGED, words, 0.0, 0, solver=name, law=law)
        _measure(problem, result)
        return result
    if words := why_unanswered(problem, coulomb):
        result = Result(np.zeros(problem.r.shape), Status.UNBOUNDED, words, cold, 0, solver=name, law=law)
        _measure(problem, result)
        return result
    limits = limits.but(max_it=method.iterations) if limits.max_it < 0 else limits
    own = newton_for(problem.comm, name) if method.newton and newton is None else None
    systems = newton or own if method.newton else None
    if systems is not None:
        systems.check(problem)
    given = (options or method.options(), *([] if systems is None else [systems]))

    run = method.function
    try:
        with phase("CCPSolve"):
            found = _enough(problem, guess, limits, coulomb) if method.needs == NEWTON else None
            if found is None and coulomb and method.has_law:
                found = run(problem, guess, limits, *given, coulomb=True)
            # conic has no systems of Coulomb's law where options name their solver, or N has no entries
            if coulomb and (found is None or (found.status is Status.GIVEN_UP and problem.contact_map is None)):
                result = fixed_point(lambda *convex: run(*convex, *given), problem, guess, limits)
            else:
                result = found or run(problem, guess, limits, *given)
                result.law = law
        if systems is not None and systems.linear.remark:
            result.reason += f"; {systems.linear.remark}"
    finally:
        if own is not None:
            own.destroy()
    result.solver = result.solver or name
    if method.needs == NEWTON:
        result.newton_its = result.iterations
    if problem.sum(int(not all_from(result.impulse.ravel(), -np.inf))):
        result.reason = f"impulses are no numbers: {result.reason}"
        result.impulse, result.status, result.residual = np.zeros(problem.r.shape), Status.BREAKDOWN, cold
        result.accuracy = None
    elif unbounded := why_unbounded(problem, result.impulse):
        result.status, result.reason = Status.UNBOUNDED, unbounded
    elif result.converged and (indefinite := why_indefinite(problem)):
        result.status, result.reason, result.exhausted = Status.BREAKDOWN, indefinite, True
    accuracy = result.accuracy or _measure(problem, result)  # which `auto` may have done
    if result.converged and (squeezed := limits.squeezed(accuracy, coulomb)):
        result.status, result.reason = Status.SQUEEZED, squeezed
    return result


def _enough(problem: ConeProblem, guess: Array, limits: Limits, coulomb: bool) -> Result | None:
    """A guess that meets the limits already, as the result of a method whose path would leave it; else None."""
    if problem.norm(guess) == 0.0:
        return None
    g = problem.cones.project(guess, np.empty_like(guess))
    residual = limits.residual(problem.errors(g, problem.product(g) + problem.r, coulomb))
    if not residual <= limits.aimed:
        return None
    limits.report(0, residual)
    return Result(g, Status.CONVERGED, limits.met, residual, 0, history=[residual])


def _measure(problem: ConeProblem, result: Result) -> Accuracy:
    """Tell the result what its impulses do to the bodies, and how accurate they are."""
    result.momentum = problem.momentum(result.impulse)
    result.accuracy = figures(problem, result.impulse, problem.velocity_of(result.momentum))
    return result.accuracy


def _tell_states(problem: ConeProblem, result: Result) -> None:
    """Tell the result what the contacts do; collective."""
    y = problem.velocity_of(result.momentum) + problem.r + problem.compliance * result.impulse
    result.velocity = y if problem.units is None else problem.velocities_by(result.impulse)
    terms = problem.cones.de_saxce(y) if result.law == RELAXATION else np.zeros(0)
    result.states, here = states(result.impulse, y, problem.diagonal, problem.mu, terms)
    result.counts = Counts(*map(int, problem.sums(*here)))


@loop
def states(
    g: Array, y: Array, diagonal: Array, mu: Array, terms: Array
) -> tuple[NDArray[np.int8], tuple[int, int, int]]:
    """Which contacts (nc,) are open (0), slide (1) and stick (2), and how many do: of each two numbers that are
    complementary, impulses in units of velocities, the larger one decides. With De Saxce's `terms` (nc,) of the
    relaxation, or none."""
    out, opens, slides = np.empty(len(mu), np.int8), 0, 0
    for c in range(len(mu)):
        opening = y[c, 0] - terms[c] if len(terms) else y[c, 0]
        room = mu[c] * g[c, 0] - np.sqrt(g[c, 1] * g[c, 1] + g[c, 2] * g[c, 2])
        opened = diagonal[c, 0] * g[c, 0] <= opening
        room *= 0.5 * (diagonal[c, 1] + diagonal[c, 2])
        slid = not opened and room < np.sqrt(y[c, 1] * y[c, 1] + y[c, 2] * y[c, 2])
        out[c] = 0 if opened else 1 if slid else 2
        opens, slides = opens + opened, slides + slid
    return out, (opens, slides, len(mu) - opens - slides)


def _print(comm: MPI.Comm, iterations: int, residual: float) -> None:
    PETSc.Sys.Print(f"{iterations:5d} residual {residual:.6e}", comm=comm)


def newton_for(comm: MPI.Comm, type: str, form: str = "auto", compare: Comparison | None = None) -> Newton:
    """Return the Newton systems that a method of SOLVERS works with; ``form`` is auto or of FORMS. ValueError for one
    that the method cannot have."""
    if type not in SOLVERS:
        raise ValueError(f"the solver {type!r}: allowed are {', '.join(SOLVERS)}")
    _refuse_form(type, form)
    if compare is not None and not compare.names:
        compare = None
    if form == "auto":
        form = "contact" if type == "pdip" or compare is not None else "body"
    return Newton(comm, form, compare)


def _refuse_form(type: str, form: str) -> None:
    if why := why_no_form(type, form):
        raise ValueError(f"the Newton form {form!r}: {why}")
