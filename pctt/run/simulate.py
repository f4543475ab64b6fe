"""The simulation of a scene: search contacts, solve the cone problem, move the bodies, record."""

from __future__ import annotations

import dataclasses
import math
import resource
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
from mpi4py import MPI

from dem import record as recording
from dem.contact import Contacts, find_contacts, find_overrun
from dem.experiment import Experiment
from dem.impulses import ImpulseMemory
from dem.partition import rebalance
from dem.scene import Scene
from dem.start import new_world
from dem.stepper import advance
from dem.system import ContactSystem
from dem.together import SceneError, together
from dem.world import World
from pctt import ccp, log
from pctt.compiled import tell_first_compilation
from pctt.options import OptionError
from pctt.run import checkpoint, interrupt, leftovers, report
from pctt.run.dump import Dump
from pctt.run.hdf5 import FileError
from pctt.run.place import Place
from pctt.run.results import Results
from pctt.run.settings import DEMO, Options, scene_name


def simulate(options: Options, comm: MPI.Comm) -> None:
    """Run the scene of the options, or settle it with ``-settle``. InterruptError if a signal asks for the end."""
    progress = report.Progress(comm.rank == 0 and not options.run.quiet, options.run.monitor)
    tell_first_compilation(progress.say)
    if options.run.settle:
        path = settled_state(options, comm, progress, anew=True)
        progress.say(f"settled state: {path}")
        return
    if options.demo:
        progress.say("no options: the demo; -help lists the options")
    world, memory = first_state(options, comm, progress)
    place = Place(Path(options.run.output), comm, options.run.restart)
    dump = Dump(options, world, place)
    made_with = checkpoint.origin(scene_name(options.run.scene), options.scene, options.dt)
    results = Results(place, comm, made_with["scene"], world)
    compare = ccp.Comparison(comm, options.compare_names(), options.run.compare_every)
    newton = ccp.newton_for(comm, options.run.ccp_type, options.run.ccp_newton, compare)
    method = f"{options.run.ccp_type} to {options.limits.tol:g}, {report.law(options.coulomb is not None)}"
    progress.say(f"{world.body_count} bodies on {comm.size} ranks, {method}")
    if ccp.SOLVERS[options.run.ccp_type].needs != ccp.NEWTON and options.limits.tol > ccp.Limits().tol:
        progress.say(report.loose_line(options.limits.tol))
    progress.say(report.columns(bool(compare.names)), level=1)
    start, end = world.step, world.step + options.run.steps
    progress.start(options.run.steps)
    with Stepper(options, world, memory, newton, dump) as stepper:
        while world.step < end:
            progress.doing(f"step {world.step + 1}, time {world.time:.3f} s")
            line = stepper.step()
            interrupted = interrupt.asked(comm) and world.step < end
            last = world.step == end or interrupted
            with log.phase("output"):
                row = stepper.records()
                line["worst_overlap"] = row["worst_overlap [m]"]
                results.records.add(row)
                if options.run.output_every and (world.step % options.run.output_every == 0 or last):
                    results.record_step(world, stepper.contacts, stepper.system, stepper.impulse, row)
            _count_output(line)
            with log.phase("output"):
                # before the checkpoint: a run that goes on from there must find the step
                results.add_step(world, line, compare.summary())
                if (world.step - start) % options.run.checkpoint_every == 0 or last:
                    checkpoint.save(results.checkpoint, made_with, world, memory)
                results.stands(world, line)
            progress.say(report.step_line(line), level=1)
            progress.say(report.accuracy_lines(line, stepper.history), level=2)
            if interrupted:
                results.link(world)
                raise interrupt.InterruptError(_how_to_go_on(options, world.step, results.checkpoint, end))
        if world.step > start:
            results.link(world)
            figures = _analyse(options.scene, results, comm)
            results.write_summary(world, compare.summary(), analysis=figures)
            if comm.rank == 0:
                lines = [line for line in results.steps() if line["step"] > start]
                progress.say("\n" + report.phase_table(lines))
                progress.say(report.law_line(lines, options.limits.tol))
            if figures:
                progress.say(report.figure_table(figures))
            if comm.rank == 0:
                progress.say(report.overlap_line(results.worst_overlap()))
            if row.get("grains_outside"):
                progress.say(f"{row['grains_outside']:.0f} grains have left the domain of the scene")
        if compare.names:
            progress.say("\n" + report.compare_table(compare.summary(), compare.labels()))
    if left := leftovers.remark():
        progress.say(left)
    if world.step > start:
        progress.say(f"\nresults: {place.folder}/state.h5, records.csv, steps.jsonl, summary.json, checkpoint.h5")


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
    """Add the seconds of output since the last count to the figures of a step: those of its checkpoint count in the
    next step, as the figures are written before."""
    phases = line["phases"]
    phases |= log.take_seconds(("output",))
    line["seconds"] = sum(phases.values())


#: An overlap by a contact that the search did not foresee is solved for if it would be deeper than this part of delta.
OVERRUN = 0.01


class Stepper:
    """One time step after another of a world; keeps the last step's contacts and impulses for output.

    Owns what it is given as ``newton`` and the PETSc objects of the step under way, which `destroy` frees.
    """

    contacts: Any
    system: ContactSystem
    impulse: np.ndarray
    history: list[float]  #: natural residual by iteration

    def __init__(
        self,
        options: Options,
        world: World,
        memory: ImpulseMemory,
        newton: ccp.Newton | None = None,
        dump: Dump | None = None,
    ):
        self.options, self.world, self.memory, self.newton, self.dump = options, world, memory, newton, dump
        self._problem: ccp.ConeProblem | None = None

    def __enter__(self) -> Stepper:
        return self

    def __exit__(self, *exception: object) -> None:
        self.destroy()

    def destroy(self) -> None:
        self._release()
        if self.newton is not None:
            self.newton.destroy()

    def _release(self) -> None:
        """Free the PETSc objects of the present problem."""
        if self._problem is not None:
            self._problem.destroy()
            self._problem = None

    def step(self) -> dict[str, Any]:
        """Advance the world by dt; the step's figures. SceneError if a body is lost (its position is no
        number)."""
        options, world = self.options, self.world
        with log.phase("search"):
            rebalance(world)
            try:
                contacts = find_contacts(world, options.delta, options.dt)
            except FloatingPointError as error:  # raised on all ranks alike
                raise SceneError(f"step {world.step + 1}: {error}") from None
        problem, guess = self._assemble(contacts, self.memory)
        with log.phase("solve"):
            result, solver, newton_its = self.solve(problem, guess)
        while again := self._overrun(problem, result.impulse):
            problem, guess = self._assemble(*again)
            with log.phase("solve"):
                first, (result, solver, more_its) = result, self.solve(problem, guess)
            newton_its += more_its
            result.iterations += first.iterations
            result.ksp_its += first.ksp_its
            result.fallbacks += first.fallbacks
        with log.phase("solve"):
            accuracy = ccp.measure(problem, result.impulse)
        with log.phase("output"):
            files = self.dump.step(self.system, problem, guess, result, self._asked) if self.dump else {}
        with log.phase("advance"):
            self.impulse, self.history = result.impulse, result.history
            advance(world, self.system.velocity(self.impulse), options.dt)
            self.memory.remember(self.system.key, self.impulse, self.system.frame)
        self._release()
        newton = self.newton
        pc_report = newton.pc_report if newton is not None else []
        compare = newton.compare if newton is not None else None
        phases = ("search", "assembly", "solve", *(["compare"] if compare else []), "advance")
        return {
            "step": world.step,
            "time": world.time,
            "contacts": problem.size,
            "newton_its": newton_its,
            "iterations": result.iterations,
            "ksp_its": result.ksp_its,
            "cone_problems": result.cone_problems,
            **dataclasses.asdict(accuracy),
            "converged": result.converged,
            "status": result.status.value,
            "reason": result.reason,
            "fallbacks": result.fallbacks,
            "solver": solver,
            "law": result.law,
            "asked_solver": options.run.ccp_type,
            **({"pc_report": pc_report} if pc_report else {}),
            **files,
            **({"compare": compare.take_solves()} if compare else {}),
            "peak_memory": _peak_memory(world.comm),
            "phases": log.take_seconds(phases),
        }

    def _assemble(self, contacts: Contacts, memory: ImpulseMemory) -> tuple[ccp.ConeProblem, np.ndarray]:
        """The problem of these contacts, which takes the place of the last, and the impulses remembered."""
        options = self.options
        with log.phase("assembly"):
            self._release()
            self.contacts = contacts
            self.system = ContactSystem(self.world, contacts, options.dt, options.run.recovery_speed)
            self._problem = cone_problem(
                self.system, self.world.comm, options.run.ccp_compliance or 0.0, options.run.ccp_operator
            )
            guess, _ = memory.recall(self.system.key, self.system.frame)
        return self._problem, guess

    def _overrun(self, problem: ccp.ConeProblem, impulse: np.ndarray) -> tuple[Contacts, ImpulseMemory] | None:
        """The contacts with those that nobody foresaw, as impulses of the step sent a grain further than its margin,
        and the impulses so far; None if it runs into nothing there."""
        world, options = self.world, self.options
        with log.phase("search"):
            velocity = self.system.velocity(impulse)
            wider = find_overrun(world, self.contacts, velocity, options.delta, options.dt)
        if wider is None:
            return None
        with log.phase("assembly"):
            unseen = wider.take(~np.isin(wider.key, self.contacts.key))
            system = ContactSystem(world, unseen, options.dt, options.run.recovery_speed)
            with cone_problem(system, world.comm) as beyond:
                opening = (beyond.velocity_of(problem.momentum(impulse)) + beyond.r)[:, 0]
                closes = options.dt * beyond.min(opening.min(initial=0.0)) < -OVERRUN * options.delta
        if not closes:
            return None
        memory = ImpulseMemory(world.comm)
        memory.remember(self.system.key, impulse, self.system.frame)
        return wider, memory

    def records(self) -> dict[str, float]:
        """What the last step shows, by name; collective. SceneError if the scene's own records are at fault."""
        step = recording.Step(self.world, self.contacts, self.system, self.impulse)
        return recording.row(step, self.options.scene)

    def solve(self, problem: ccp.ConeProblem, guess: np.ndarray) -> tuple[ccp.Result, str, int]:
        """Solve as asked; where that does not converge, go on with APGD from there and keep the better.

        The result, the method that it is of, and the Newton steps made."""
        options = self.options
        asked = options.run.ccp_type
        result = ccp.solve(problem, guess, asked, options.limits, options.solver, self.newton, options.coulomb)
        self._asked, used = result, result.solver or asked
        newton_its = result.iterations if ccp.SOLVERS[used].newton else 0
        if result.final or used == "apgd":
            return result, used, newton_its
        limits = dataclasses.replace(options.limits, max_it=-1)
        second = ccp.solve(problem, result.impulse, "apgd", limits, coulomb=options.coulomb)
        if second.natural_residual < result.natural_residual:
            second.ksp_its, second.fallbacks = result.ksp_its, result.fallbacks
            return second, "apgd", newton_its
        return result, used, newton_its


def _peak_memory(comm: MPI.Comm) -> int:
    """The most memory that the ranks have had so far, their sum [bytes]; collective."""
    unit = 1 if sys.platform == "darwin" else 1024
    return int(comm.allreduce(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit))


def cone_problem(
    system: ContactSystem, comm: MPI.Comm, compliance: float = 0.0, operator: str = "auto"
) -> ccp.ConeProblem:
    """The cone problem of a step's contacts."""
    G = ccp.CompactRows(*system.contact_map, columns=system.owned_bodies)
    return ccp.ConeProblem(
        comm,
        system.r,
        system.mu,
        G=G,
        point=system.point,
        key=system.key,
        compliance=compliance,
        operator=operator,
    )


def first_state(options: Options, comm: MPI.Comm, progress: report.Progress) -> tuple[World, ImpulseMemory]:
    run, scene = options.run, options.scene
    if not run.restart:
        return _new_world(scene, comm), ImpulseMemory(comm)
    path = settled_state(options, comm, progress) if run.restart == "settled" else Path(run.restart)
    made_with = checkpoint.origin(scene_name(run.scene), scene, options.dt)
    world, memory = checkpoint.load(path, _built(scene, comm), made_with, comm, run.restart_changed_file)
    progress.say(f"from {path}: step {world.step}, time {world.time:g} s")
    return world, memory


def _new_world(scene: Experiment, comm: MPI.Comm) -> World:
    try:
        return new_world(_built(scene, comm), comm)
    except ValueError as error:
        raise OptionError(f"scene {type(scene).__name__}: {error}") from None


def _built(scene: Experiment, comm: MPI.Comm) -> Scene:
    """What the scene builds; SceneError on all ranks if that fails on any."""

    def build() -> Scene:
        built = scene.build()
        if not isinstance(built, Scene):
            raise TypeError(f"build must return a dem.scene.Scene, not {type(built).__name__}")
        return built

    return together(comm, f"build of the scene {type(scene).__name__}", build)


def settled_state(options: Options, comm: MPI.Comm, progress: report.Progress, anew: bool = False) -> Path:
    """The cached settled state of the scene, made if it is not there (or ``anew``): the scene's settling time
    with APGD, its last tenth with the contacts and ten times the accuracy, so that no overlap is left that
    a first accurate step would have to push apart. What an interrupted or killed settling has left is gone on from."""
    settling = dataclasses.replace(
        options,
        run=dataclasses.replace(options.run, ccp_type="apgd", ccp_compliance=None),
        delta=options.run.settle_delta,
        limits=ccp.Limits(tol=options.run.settle_tol),
        solver=ccp.SOLVERS["apgd"].options(),
        coulomb=None,
    )
    if not options.scene.settling_time:
        raise OptionError(f"-scene {options.run.scene}: has no settling_time and so no settled state")
    made_with = checkpoint.origin(scene_name(options.run.scene), options.scene, options.dt)
    settings: dict[str, Any] = {
        "dt": options.dt,
        "delta": [options.run.settle_delta, options.delta],
        "recovery_speed": options.run.recovery_speed,
        "tol": options.run.settle_tol,
    }
    if options.scene.digest:
        settings["file"] = options.scene.digest  # a file that was changed may build another scene
    path = checkpoint.settled_path(made_with["scene"], settings)
    if not anew and comm.bcast(checkpoint.intact(path) if comm.rank == 0 else None):
        return path
    steps = math.ceil(options.scene.settling_time / options.dt * (1 - 1e-12))
    tenth = max(1, steps // 10)
    progress.say(f"settling {options.run.scene}, {steps} steps with APGD to {options.run.settle_tol:g}:")
    unfinished = path.with_suffix(".unfinished.h5")
    if comm.rank == 0:
        path.parent.mkdir(parents=True, exist_ok=True)
    if comm.bcast(unfinished.exists()):
        world, memory = checkpoint.load(unfinished, _built(options.scene, comm), made_with, comm)
        progress.say(f"  goes on after step {world.step}, from {unfinished}")
    else:
        world, memory = _new_world(options.scene, comm), ImpulseMemory(comm)
    start = time.perf_counter()
    progress.start(steps - world.step)
    with Stepper(settling, world, memory) as stepper:
        while world.step < steps:
            progress.doing(f"settling, time {world.time:.3f} s")
            if world.step + 1 >= steps - steps // 10:
                limits = ccp.Limits(tol=0.1 * options.run.settle_tol)
                stepper.options = dataclasses.replace(settling, delta=options.delta, limits=limits)
            line = stepper.step()
            interrupted = interrupt.asked(comm)
            if world.step % tenth == 0 or world.step == steps or interrupted:
                checkpoint.save(unfinished, made_with, world, memory)
                spent = time.perf_counter() - start
                progress.say(
                    f"  step {world.step:5d}  time {line['time']:6.2f} s  contacts {line['contacts']:8d}"
                    f"  residual {line['natural_residual']:.1e}  {spent:7.1f} s spent"
                )
            if interrupted:
                words = f"settling interrupted after step {world.step} of {steps}; the same command goes on there"
                raise interrupt.InterruptError(words)
    checkpoint.save(path, made_with, world, memory)
    if comm.rank == 0:
        checkpoint.write_checksum(path)
        unfinished.unlink(missing_ok=True)
    comm.Barrier()
    return path
