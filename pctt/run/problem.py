"""Solve the cone problem of an FCLIB file: ``python -m pctt.run -problem FILE``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from mpi4py import MPI

from pctt import ccp, figures_json, log
from pctt.ccp import fclib
from pctt.ccp.cone import Array
from pctt.ccp.fclib import FileFormatError, Stored
from pctt.ksp_options import remark
from pctt.run.hdf5 import FileError, write_text
from pctt.run.place import Place
from pctt.run.report import Progress, compare_table
from pctt.run.settings import Options


def solve_file(options: Options, comm: MPI.Comm) -> None:
    """Solve, print the figures, and write them to summary.json in the output folder."""
    stored = _load(options.run.problem, comm, options.run.ccp_compliance)
    compare = ccp.Comparison(comm, options.run.compared(), options.run.compare_every)
    with stored.problem:
        summary = _solve(stored, options, compare)
    progress = Progress(comm.rank == 0 and not options.run.quiet)
    width = max(map(len, summary))
    for name, value in summary.items():
        if not isinstance(value, dict) and value != "":
            shown = f"{value:.12g}" if isinstance(value, float) else value
            progress.say(f"{name:{width}}  {shown}")
    for name, figures in summary["references"].items():
        listed = ", ".join(f"{word} {figure:.6g}" for word, figure in figures.items())
        progress.say(f"the file's {name}: {listed}")
    if compare.names:
        progress.say("\n" + compare_table(compare.summary()))
    if not summary["converged"]:
        progress.say(f"NOT CONVERGED: {summary['reason']}")
    if left := remark():
        progress.say(left)
    with Place(Path(options.run.output), comm, overwrite=options.run.overwrite) as place:
        place.make()
        if comm.rank == 0:
            write_text(place.now / "summary.json", figures_json.dumps(summary, indent=1) + "\n")
        place.take()


def _solve(stored: Stored, options: Options, compare: ccp.Comparison) -> dict[str, Any]:
    """The figures of solving a stored problem as the options say."""
    problem, guess, comm = stored.problem, stored.guess if options.run.problem_guess else None, stored.problem.comm
    settings = options.settings
    newton = ccp.newton_for(comm, settings.solver, settings.newton, compare)
    try:
        with log.phase("solve"):
            result = ccp.solve(
                problem, guess, settings.solver, settings.limits, settings.options, newton, settings.coulomb or None
            )
        used = result.solver or settings.solver
        by_newton = ccp.SOLVERS[used].newton
        systems = "; ".join(filter(None, (newton.words(), newton.what()))) if by_newton else ""
    finally:
        newton.destroy()
    seconds = log.take_seconds(("solve", "compare"))
    accuracy = ccp.measure(problem, result.impulse)
    solves = compare.take_solves()
    return {
        "problem": options.run.problem,
        "format": stored.form,
        "title": stored.title,
        "note": stored.note,
        "start": "cold" if guess is None else "the guess in the file",
        "contacts": problem.size,
        "ranks": comm.size,
        "solver": used,
        "law": "Coulomb" if settings.coulomb else "cone problem",
        "compliance": problem.softness,
        "objective": accuracy.objective,
        "natural_residual": accuracy.natural_residual,
        "rigid_residual": accuracy.rigid_residual,
        "coulomb_residual": accuracy.coulomb_residual,
        "cone_problems": result.cone_problems,
        "newton_its": result.iterations if by_newton else 0,
        "iterations": result.iterations,
        "ksp_its": result.ksp_its,
        "newton_systems": systems,
        "seconds": seconds["solve"],
        **({"compare_seconds": seconds["compare"]} if compare.names else {}),
        "converged": result.converged,
        "status": result.status.value,
        "reason": result.reason,
        "cone_violation": accuracy.cone_violation,
        "dual_violation": accuracy.dual_violation,
        "complementarity": accuracy.complementarity,
        "closing_work": accuracy.closing_work,
        "opening_work": accuracy.opening_work,
        "velocity_norm": accuracy.velocity_norm,
        "references": {
            name: _distance(problem, result.impulse, impulse)
            for name, impulse in (("solution", stored.solution), ("guess", stored.guess))
            if impulse is not None
        },
        "compare": {
            name: {**figures, "solves": solves[name]} for name, figures in compare.summary().items()
        },
    }


def _load(path: str, comm: MPI.Comm, compliance: float | None) -> Stored:
    """The problem in a file, with another compliance if one is given. FileError on all ranks if the file holds no
    problem."""
    try:
        return fclib.load(path, comm, compliance)
    except FileFormatError as error:
        raise FileError(str(error)) from None


def _distance(problem: ccp.ConeProblem, impulse: Array, reference: Array) -> dict[str, Any]:
    """The distance of W r + q from the same vector for the impulses in the file, and how accurate those impulses are.
    At the optimum W r + q is unique, r is not."""
    distance = problem.norm(problem.product(impulse - reference))
    accuracy = ccp.measure(problem, reference)
    return {
        "velocity_distance": distance,
        "relative_distance": distance / (accuracy.velocity_norm or 1.0),
        "natural_residual": accuracy.natural_residual,
        "objective": accuracy.objective,
    }
