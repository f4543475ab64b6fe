"""The simulation of a scene: steps, and what is written and said after each."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from mpi4py import MPI

from dem.experiment import Experiment
from dem.impulses import ImpulseMemory
from dem.together import together
from dem.world import World
from pctt import ccp, log
from pctt.compiled import tell_first_compilation
from pctt.run import checkpoint, interrupt, leftovers, report
from pctt.run.dump import Dump
from pctt.run.hdf5 import FileError
from pctt.run.place import Place
from pctt.run.results import Results
from pctt.run.settings import DEMO, Options, scene_name
from pctt.run.settling import built, settled_state, world_at_start
from pctt.run.stepper import Stepper


def simulate(options: Options, comm: MPI.Comm) -> None:
    """Run the scene of the options, or settle it with ``-settle``. InterruptError if a signal asks for the end."""
    progress = report.Progress(comm.rank == 0 and not options.run.quiet, options.run.monitor)
    tell_first_compilation(progress.say)
    if options.run.settle:
        path = settled_state(options, built(options.scene, comm), comm, progress, anew=True)
        progress.say(f"settled state: {path}")
        return
    if options.demo:
        progress.say("no options: the demo; -help lists the options")
    world, memory = first_state(options, comm, progress)
    with Place(Path(options.run.output), comm, options.run.restart, options.run.overwrite) as place:
        _make_steps(options, comm, progress, world, memory, place)


def _make_steps(
    options: Options, comm: MPI.Comm, progress: report.Progress, world: World, memory: ImpulseMemory, place: Place
) -> None:
    """The steps of a run and its output."""
    dump = Dump(options, world, place)
    compare = ccp.Comparison(comm, options.run.compared(), options.run.compare_every)
    output = Output(options, place, world, memory, compare)
    newton = ccp.newton_for(comm, options.run.ccp_type, options.run.ccp_newton, compare)
    _say_start(options, world, newton, progress)
    start, end = world.step, world.step + options.run.steps
    with Stepper(options, world, memory, newton, dump) as stepper:
        while world.step < end:
            progress.doing(f"step {world.step + 1}, time {world.time:.3f} s")
            line = stepper.step()
            interrupted = interrupt.asked(comm) and world.step < end
            output.step(stepper, line, last=world.step == end or interrupted)
            progress.say(report.step_line(line), level=1)
            progress.say(report.accuracy_lines(line, stepper.history), level=2)
            if interrupted:
                output.results.link(world)
                raise interrupt.InterruptError(_how_to_go_on(options, world.step, output.results.checkpoint, end))
        if world.step > start:
            output.end(progress)
            if what := newton.what():
                progress.say(f"Newton systems: {what}")
        if compare.names and world.step > start:
            progress.say("\n" + report.compare_table(compare.summary()))
    if left := leftovers.remark():
        progress.say(left)
    if world.step > start:
        progress.say(f"\nresults: {place.folder}/state.h5, records.csv, steps.jsonl, summary.json, checkpoint.h5")


class Output:
    """What a run leaves in its folder after each step, and what it says at its end."""

    def __init__(
        self, options: Options, place: Place, world: World, memory: ImpulseMemory, compare: ccp.Comparison
    ):
        self._options, self._world, self._memory, self._compare = options, world, memory, compare
        self._made_with = checkpoint.origin(scene_name(options.run.scene), options.scene, options.dt)
        self._start, self._outside = world.step, 0.0
        self.results = Results(place, world.comm, self._made_with["scene"], world)

    def step(self, stepper: Stepper, line: dict[str, Any], last: bool) -> None:
        """Write records, state, figures and checkpoint after a step; ``last`` says whether it is the last one of the
        run. Collective."""
        run, world, results = self._options.run, self._world, self.results
        with log.phase("output"):
            row = stepper.records()
            line["worst_overlap"] = row["worst_overlap [m]"]
            self._outside = row.get("grains_outside", 0.0)
            results.records.add(row)
            if run.output_every and (world.step % run.output_every == 0 or last):
                results.record_step(world, stepper.contacts, stepper.system, stepper.impulse, row)
        _count_output(line)
        with log.phase("output"):
            # before the checkpoint: a run that goes on from there must find the step
            results.add_step(world, line, self._compare.summary())
            if (world.step - self._start) % run.checkpoint_every == 0 or last:
                checkpoint.save(results.checkpoint, self._made_with, world, self._memory)
            results.stands(world, line)

    def end(self, progress: report.Progress) -> None:
        """Analyse the records, and say what the steps have taken and shown; collective."""
        results, comm = self.results, self._world.comm
        results.link(self._world)
        figures = _analyse(self._options.scene, results, comm)
        results.write_summary(self._world, self._compare.summary(), analysis=figures)
        if comm.rank == 0:
            lines = [line for line in results.steps() if line["step"] > self._start]
            progress.say("\n" + report.phase_table(lines))
            progress.say(report.law_line(lines, self._options.limits.tol))
            progress.say(report.forces_line(lines, self._options.limits.closing_work))
        if figures:
            progress.say(report.figure_table(figures))
        if comm.rank == 0:
            progress.say(report.overlap_line(results.worst_overlap()))
        if self._outside:
            progress.say(f"{self._outside:.0f} grains have left the domain of the scene")


def _say_start(options: Options, world: World, newton: ccp.Newton, progress: report.Progress) -> None:
    method = f"{options.run.ccp_type} to {options.limits.tol:g}, {report.law(options.coulomb is not None)}"
    progress.say(f"{world.body_count} bodies on {world.comm.size} ranks, {method}")
    if ccp.SOLVERS[options.run.ccp_type].needs != ccp.NEWTON and options.limits.tol > ccp.Limits().tol:
        progress.say(report.loose_line(options.limits.tol))
    if ccp.SOLVERS[options.run.ccp_type].newton:
        progress.say(f"Newton systems: {newton.words()}")
    if options.run.steps:
        progress.say(report.columns(newton.compare is not None), level=1)
    progress.start(options.run.steps)


def _how_to_go_on(options: Options, step: int, state: Path, end: int) -> str:
    """What a user who has interrupted a run before its end is told."""
    words = f"-restart {state} -steps {end - step}"
    if options.demo:
        kept = {name: value for name, value in DEMO.items() if name not in ("restart", "steps", "overwrite")}
        words = " ".join([*(f"-{name} {value}" for name, value in kept.items()), words])
    return f"interrupted after step {step}; the same command with {words} at its end goes on"


def _analyse(scene: Experiment, results: Results, comm: MPI.Comm) -> dict[str, float]:
    """The numbers that the scene finds in the records; SceneError if it fails on them."""
    what = f"analyse of the scene {type(scene).__name__}"

    def analyse() -> dict[str, float]:
        return results.records.analyse(scene) if comm.rank == 0 else {}

    return comm.bcast(together(comm, what, analyse, own=(FileError,)))


def _count_output(line: dict[str, Any]) -> None:
    """Add the seconds of output since the last count to the figures of a step. A step's checkpoint is written after its
    figures, so its seconds count in the next step."""
    phases = line["phases"]
    phases |= log.take_seconds(("output",))
    line["seconds"] = sum(phases.values())


def first_state(options: Options, comm: MPI.Comm, progress: report.Progress) -> tuple[World, ImpulseMemory]:
    """The world and the impulses that a run begins with: the scene's own, or those of ``-restart``."""
    run, scene = options.run, built(options.scene, comm)
    if not run.restart:
        return world_at_start(options.scene, scene, comm), ImpulseMemory(comm)
    path = settled_state(options, scene, comm, progress) if run.restart == "settled" else Path(run.restart)
    made_with = checkpoint.origin(scene_name(run.scene), options.scene, options.dt)
    world, memory = checkpoint.load(path, scene, made_with, comm, run.restart_changed_file)
    progress.say(f"from {path}: step {world.step}, time {world.time:g} s")
    return world, memory
