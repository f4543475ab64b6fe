"""What the program does: it simulates or settles a scene, or solves the cone problem of an FCLIB file."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from mpi4py import MPI

from dem.compiled import tell_first_compilation
from pctt import ccp, log
from pctt.arrays import Array
from pctt.ccp import fclib
from pctt.ccp.fclib import FileFormatError, Stored
from pctt.disk import FileError, on_first, write_text
from pctt.json_text import written
from pctt.ksp_options import remark
from pctt.options import OptionError
from pctt.run import interrupt, report
from pctt.run.dump import unwritten
from pctt.run.output import Place
from pctt.run.settings import DEMO, Options
from pctt.run.state import built, settled_state
from pctt.simulation import Simulation


class NotConvergedError(Exception):
    """No solver has solved the problem of a file; its figures are written. Raised on all ranks alike."""


def simulate(options: Options, comm: MPI.Comm) -> None:
    """Run the scene of the options, or settle it with ``-settle``. InterruptError if a signal asks for the end."""
    run, progress = options.run, report.Progress(comm, options.run.quiet)
    tell_first_compilation(progress.say)
    if run.settle:
        scene = built(options.scene, comm)
        path = settled_state(options.scene, options.settings, scene, comm, progress.say, anew=True)
        progress.say(f"settled state: {path}")
        return
    if options.demo:
        progress.say("no options: the demo; -help lists the options")
    if run.dump_problem:
        scene = built(options.scene, comm)
        if why := unwritten(scene.pairs(np.inf), scene.named, scene.cell.deforms):
            raise OptionError(f"-dump_problem: {why}")
    compare = ccp.Comparison(comm, run.compared(), run.compare_every)
    with Simulation(
        options.scene, options.settings, comm=comm, restart=run.restart, compare=compare, say=progress.say, program=True
    ) as sim:
        if sim.restart:
            progress.say(f"from {sim.restart}: step {sim.steps}, time {sim.time:g} s")
            if "overlap" in options.given and run.restart != "settled":  # whose command begins with a start
                what = f"-overlap {options.given['overlap']}"
                progress.say(f"options without effect in this run, as it goes on from a checkpoint: {what}")
        sim.write(
            run.output, overwrite=run.overwrite, every=run.output_every, checkpoint_every=run.checkpoint_every,
            checkpoint_minutes=run.checkpoint_minutes, problems=run.dump_problem,
        )  # fmt: skip
        _make_steps(options, sim, progress, compare)


def _make_steps(options: Options, sim: Simulation, progress: report.Progress, compare: ccp.Comparison) -> None:
    """The steps of a run, and what is said about them."""
    newton, settings, output = sim.stepper.newton, sim.settings, sim.output
    assert newton is not None
    assert output is not None
    steps = options.run.steps_of(settings.dt)
    end = sim.steps + steps
    progress.say(f"{sim.world.body_count} bodies on {sim.comm.size} ranks, {settings.words}")
    if sim.dt_reason:
        progress.say(f"dt {settings.dt:g} s, for {sim.dt_reason}; -dt takes another")
    watch = sim.overlap_watch
    progress.say(report.stiffness_line(sim.world.pairs.stiffness, watch.elastic, watch.steps))
    if "recovery_speed" in options.given and np.isfinite(sim.world.pairs.stiffness).all():
        what = f"-recovery_speed {options.given['recovery_speed']}"
        progress.say(f"options without effect in this run, as no contact is rigid: {what}")
    if settings.tol > report.LOOSE:
        progress.say(f"WARNING: -ccp_tol {settings.tol:g}: {report.LOOSE_BECAUSE}")
    solver = ccp.SOLVERS[settings.solver]
    if solver.newton and solver.has_law and settings.law == ccp.COULOMB and not newton.own:
        progress.say(f"WARNING: {report.NOT_THE_LAW}")
    elif solver.newton:
        some = " of conic, for steps that apgd leaves to it" if settings.solver == "auto" else ""
        progress.say(f"Newton systems{some}: {newton.linear.words()}")
    if steps:
        progress.say(report.columns(newton.compare is not None))

    def say(sim: Simulation) -> None:
        progress.say(report.step_line(sim.figures))
        progress.doing(sim.steps, sim.time, end)

    progress.doing(sim.steps, sim.time, end)
    interrupt.note_signals(sim.comm)
    sim.run(steps=steps, call=say, stop=lambda sim: interrupt.is_requested(sim.comm))
    if sim.steps < end:
        words = _how_to_go_on(options, output.checkpoint, end - sim.steps, settings.dt)
        raise interrupt.InterruptError(f"interrupted after step {sim.steps}; the same command with {words}")
    if sim.last:
        figures = sim.analyse()
        if sim.comm.rank == 0:
            lines = [line for line in output.folder.lines() if line["step"] > end - steps]
            worst = output.folder.summary["worst_overlap"]
            progress.say("\n" + report.ending(lines, settings.tol, settings.closing_work, figures, worst, watch.cause))
        if what := newton.linear.what():
            progress.say(f"Newton systems: {what}")
        if compare.names:
            progress.say("\n" + report.compare_table(compare.summary()))
    if left := remark(options.given, newton.ksp_systems):
        progress.say(left)
    if sim.last:
        folder = output.place.folder
        progress.say(f"\nresults: {folder}/state.h5, records.csv, steps.jsonl, summary.json, checkpoint.h5")


def _how_to_go_on(options: Options, state: Path, steps: int, dt: float) -> str:
    """What a user who has interrupted a run before its end is told."""
    rest = f"-steps {steps}" if options.run.seconds is None else f"-seconds {steps * dt:.13g}"  # which has precedence
    words = f"-restart {state} {rest}"
    if options.demo:
        kept = {name: value for name, value in DEMO.items() if name not in ("restart", "steps", "overwrite")}
        words = " ".join([*(f"-{name} {value}" for name, value in kept.items()), words])
    return f"{words} at its end goes on"


# -- a problem of a file -------------------------------------------------------------------------------------


def solve_file(options: Options, comm: MPI.Comm) -> None:
    """Solve, print the figures, and write them to summary.json in the output folder. NotConvergedError after that, if
    the problem is not solved."""
    try:
        stored = fclib.load(options.run.problem, comm)
    except FileFormatError as error:
        raise FileError(str(error)) from None
    compare = ccp.Comparison(comm, options.run.compared(), options.run.compare_every)
    newton = ccp.newton_for(comm, options.settings.solver, options.settings.newton, compare)
    with stored.problem:
        summary = _solve(stored, options, compare, newton)
    progress = report.Progress(comm, options.run.quiet)
    width = max(map(len, summary))
    for name, value in summary.items():
        if not isinstance(value, dict) and value != "":
            shown = f"{value:.12g}" if isinstance(value, float) else value
            progress.say(f"{name:{width}}  {shown}")
    for name, figures in summary["references"].items():
        listed = ", ".join(f"{word} {figure:.6g}" for word, figure in figures.items())
        progress.say(f"the file's {name}: {listed}")
    if compare.names:
        progress.say("\n" + report.compare_table(compare.summary()))
    if left := remark(options.given, newton.ksp_systems):
        progress.say(left)
    place = Place(Path(options.run.output), comm, overwrite=options.run.overwrite, program=True)
    try:
        place.make()
        path = place.now / "summary.json"
        on_first(comm, path, lambda: write_text(path, written(summary, indent=1) + "\n"))
        place.take()
    finally:
        place.leave()
    if not summary["converged"]:
        raise NotConvergedError(f"-problem {options.run.problem}: NOT CONVERGED: {summary['reason']}")


def _solve(stored: Stored, options: Options, compare: ccp.Comparison, newton: ccp.Newton) -> dict[str, Any]:
    """The figures of solving a stored problem as the options say."""
    problem, guess, comm = stored.problem, stored.guess, stored.problem.comm
    settings = options.settings
    try:
        with log.phase("solve"):
            result = ccp.solve(
                problem, guess, settings.solver, settings.limits, settings.options, newton, settings.law
            )
        used = result.solver or settings.solver
        by_newton = ccp.SOLVERS[used].newton
        systems = "; ".join(filter(None, (newton.linear.words(), newton.linear.what()))) if by_newton else ""
    except ValueError as error:
        raise OptionError(f"-problem {options.run.problem}: {error}") from None
    finally:
        newton.destroy()
    seconds = log.take_seconds(("solve", "compare"))
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
        "law": settings.law,
        "mean_compliance": problem.sum(problem.compliance[:, 0].sum()) / max(problem.size, 1),
        **vars(result.accuracy),
        "cone_problems": result.cone_problems,
        "newton_its": result.newton_its,
        "iterations": result.iterations,
        "ksp_its": result.ksp_its,
        "newton_systems": systems,
        "seconds": seconds["solve"],
        **({"compare_seconds": seconds["compare"]} if compare.names else {}),
        "converged": result.converged,
        "status": result.status.value,
        "reason": result.reason,
        "references": {
            name: _distance(problem, result.impulse, impulse)
            for name, impulse in (("solution", stored.solution), ("guess", stored.guess))
            if impulse is not None
        },
        "compare": {
            name: {**figures, "solves": solves[name]} for name, figures in compare.summary().items()
        },
    }


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
