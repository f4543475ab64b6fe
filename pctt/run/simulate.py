"""The simulation of a scene by the program: its options, what it says, and its end by a signal."""

from __future__ import annotations

from pathlib import Path

from mpi4py import MPI

from pctt import ccp
from pctt.compiled import tell_first_compilation
from pctt.ksp_options import remark
from pctt.run import interrupt, report
from pctt.run.dump import dump_steps, refuse_absent
from pctt.run.settings import DEMO, Options
from pctt.run.settling import Settling, built, settled_state
from pctt.simulation import Simulation


def simulate(options: Options, comm: MPI.Comm) -> None:
    """Run the scene of the options, or settle it with ``-settle``. InterruptError if a signal asks for the end."""
    run, progress = options.run, report.Progress(comm.rank == 0 and not options.run.quiet, options.run.monitor)
    tell_first_compilation(progress.say)
    if run.settle:
        path = settled_state(Settling.asked(options), built(options.scene, comm), comm, progress, anew=True)
        progress.say(f"settled state: {path}")
        return
    if options.demo:
        progress.say("no options: the demo; -help lists the options")
    compare = ccp.Comparison(comm, run.compared(), run.compare_every)
    with first_state(options, comm, progress, compare) as sim:
        refuse_absent(run, sim.steps)
        sim.write(
            run.output, overwrite=run.overwrite, every=run.output_every, checkpoint_every=run.checkpoint_every,
            hard=run.dump_hard, problems=run.dump_problem, problem_steps=dump_steps(run),
        )  # fmt: skip
        _make_steps(options, sim, progress, compare)


def _make_steps(options: Options, sim: Simulation, progress: report.Progress, compare: ccp.Comparison) -> None:
    """The steps of a run, and what is said about them."""
    newton = sim.stepper.newton
    assert newton is not None
    _say_start(options, sim, newton, progress)
    end = sim.steps + options.run.steps

    def doing(sim: Simulation) -> None:
        if sim.steps < end:
            progress.doing(f"step {sim.steps + 1}, time {sim.time:.3f} s")

    def say(sim: Simulation) -> None:
        progress.say(report.step_line(sim.figures), level=1)
        progress.say(report.accuracy_lines(sim.figures, sim.stepper.history), level=2)
        doing(sim)

    doing(sim)
    sim.run(steps=options.run.steps, call=say, stop=lambda sim: interrupt.asked(sim.comm))
    assert sim.output is not None
    if sim.steps < end:
        raise interrupt.InterruptError(_how_to_go_on(options, sim.steps, sim.output.checkpoint, end))
    if sim.last:
        _say_end(options, sim, progress)
        if what := newton.what():
            progress.say(f"Newton systems: {what}")
    if compare.names and sim.last:
        progress.say("\n" + report.compare_table(compare.summary()))
    if left := remark():
        progress.say(left)
    if sim.last:
        folder = sim.output.place.folder
        progress.say(f"\nresults: {folder}/state.h5, records.csv, steps.jsonl, summary.json, checkpoint.h5")


def _say_start(options: Options, sim: Simulation, newton: ccp.Newton, progress: report.Progress) -> None:
    settings = sim.settings
    method = f"{settings.solver} to {settings.tol:g}, {report.law(bool(settings.coulomb))}"
    progress.say(f"{sim.world.body_count} bodies on {sim.comm.size} ranks, {method}")
    if ccp.SOLVERS[settings.solver].needs != ccp.NEWTON and settings.tol > ccp.Limits().tol:
        progress.say(report.loose_line(settings.tol))
    if ccp.SOLVERS[settings.solver].newton:
        progress.say(f"Newton systems: {newton.words()}")
    if options.run.steps:
        progress.say(report.columns(newton.compare is not None), level=1)
    progress.start(options.run.steps)


def _say_end(options: Options, sim: Simulation, progress: report.Progress) -> None:
    """What the steps have taken and shown."""
    assert sim.output is not None
    figures, results = sim.analyse(), sim.output
    if sim.comm.rank == 0:
        lines = [line for line in results.steps() if line["step"] > sim.steps - options.run.steps]
        progress.say("\n" + report.phase_table(lines))
        progress.say(report.law_line(lines, sim.settings.tol))
        progress.say(report.forces_line(lines, sim.settings.closing_work))
    if figures:
        progress.say(report.figure_table(figures))
    if sim.comm.rank == 0:
        progress.say(report.overlap_line(results.worst_overlap()))
    if outside := sim.figures.get("grains_outside"):
        progress.say(f"{outside:.0f} grains have left the domain of the scene")


def _how_to_go_on(options: Options, step: int, state: Path, end: int) -> str:
    """What a user who has interrupted a run before its end is told."""
    words = f"-restart {state} -steps {end - step}"
    if options.demo:
        kept = {name: value for name, value in DEMO.items() if name not in ("restart", "steps", "overwrite")}
        words = " ".join([*(f"-{name} {value}" for name, value in kept.items()), words])
    return f"interrupted after step {step}; the same command with {words} at its end goes on"


def first_state(
    options: Options, comm: MPI.Comm, progress: report.Progress, compare: ccp.Comparison | None = None
) -> Simulation:
    """What a run begins with: the scene's own state, or that of ``-restart``."""
    path = options.run.restart
    if path == "settled":
        path = str(settled_state(Settling.asked(options), built(options.scene, comm), comm, progress))
    changed = options.run.restart_changed_file
    sim = Simulation(options.scene, options.settings, comm=comm, restart=path, changed_file=changed, compare=compare)
    if path:
        progress.say(f"from {path}: step {sim.steps}, time {sim.time:g} s")
    return sim
