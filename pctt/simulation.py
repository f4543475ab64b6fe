"""A simulation as an object: make steps, look at bodies and forces, change motions, write the files of a run::

    import pctt

    sim = pctt.Simulation(scene, dt=0.005)  # a dem.scene.Scene, or a dem.experiment.Experiment
    sim.run(until=2.0)
    print(sim.time, sim.positions, sim.body("paddle").force)

``python -m pctt.run`` does nothing else. On several ranks every rank makes the same calls; all members are collective
that do not say otherwise. Quantities are in SI units. Arrays cannot be written to: they are what is, and `change` and
motions say what is to be.
"""

from __future__ import annotations

import dataclasses
import html
import math
from collections.abc import Callable
from functools import partial, wraps
from pathlib import Path
from typing import Any, TypeVar, cast

import numpy as np
from mpi4py import MPI

from dem import measures
from dem import record as recording
from dem.arrays import Floats, frozen
from dem.bodies import Bodies
from dem.checks import function_or_none, known_arguments, number
from dem.exchange import on_any
from dem.experiment import Experiment, SceneExperiment
from dem.measures import Sample
from dem.mesh import Mesh
from dem.model.changes import change, refuse_functions
from dem.motion import Motion
from dem.parts.loads import Load
from dem.parts.sources import Tally
from dem.parts.springs import Spring
from dem.record.energies import energy
from dem.scene import LargeBody, Scene, SurfaceVelocity
from dem.start import step_remark
from dem.start.doubts import RoomWatch, doubts
from dem.start.time_step import distance_remark, fall_remark, reason, small_remark, smallest
from dem.start.tools import PaceWatch, SwingWatch, half_turn_remark
from dem.start.turns import TurnWatch
from dem.step import Step
from dem.step.impulses import ImpulseMemory
from dem.together import barrier, together
from dem.unconstrained.loose import LooseWatch
from pctt import ccp, json_text, log
from pctt.disk import FileError
from pctt.folder import Contacts, Frame, Snapshot, Table
from pctt.options import OptionError, made, nearest, refuse_bad
from pctt.petsc import warn
from pctt.render import Picture, picture
from pctt.run import report, state
from pctt.run.dump import Dump
from pctt.run.interrupt import uninterrupted
from pctt.run.joints import JointNow
from pctt.run.output import Place, Writer, described_bodies, described_forms, refuse_unwritable
from pctt.run.overlaps import OverlapWatch
from pctt.run.settings import Run, Settings, refuse_unlike, scene_name
from pctt.run.stepper import NewStep, NoSolutionError, Stepper

Method = TypeVar("Method", bound=Callable[..., Any])


def _collective(method: Method) -> Method:
    """A method of a simulation at whose beginning all ranks meet: SceneError if some are in another one."""

    @wraps(method)
    def met(sim: Simulation, *given: Any, **named: Any) -> Any:
        barrier(sim.comm, f"{method.__name__} of a Simulation")
        return method(sim, *given, **named)

    return cast(Method, met)


def _name(call: str, given: Any, what: str = "file") -> str | Path:
    """What is given as the name of a file or folder; OptionError if it is none."""
    if not isinstance(given, (str, Path)) or not str(given):
        raise OptionError(f"{call}({given!r}): allowed is the name of a {what}")
    return given


class Simulation:
    """The bodies of a scene and the solver that moves them.

    Attributes
    ----------
    comm : the communicator
    settings : the `Settings`, with what the scene and the solver have of their own filled in
    experiment : the scene as an `Experiment`
    world : the bodies of this rank and the time, a `dem.model.world.World`
    overlap_watch : what overlaps are to be expected, and what makes the worst, a `pctt.run.overlaps.OverlapWatch`
    dt_reason : what dt was chosen for; empty if it was given
    memory, stepper : the impulses of the last step, and what makes the next, a `pctt.run.stepper.Stepper`
    last : the last step, a `dem.step.Step` with this rank's contacts and impulses; None before the first
    figures : of the last step, as in steps.jsonl and records.csv: ``iterations``, ``natural_residual``, ``converged``,
        ``seconds``, ``phases``, ``kinetic_energy [J]``, ``worst_overlap [m]`` and so on; empty before the first
    output : the files of `write`, a `pctt.run.output.Writer`; None before
    """

    def __init__(
        self, scene: Scene | Experiment, settings: Settings | None = None, *, comm: MPI.Comm = MPI.COMM_WORLD,
        restart: str | Path | state.RunState = "", compare: ccp.Comparison | None = None,
        say: Callable[[str], object] = print, program: bool = False, **changes: Any,
    ):  # fmt: skip
        """The scene at time zero, or as the checkpoint ``restart`` has it; "settled": in its settled state, which is
        made at first use.

        The settings may be given one by one, as ``dt=0.01, solver="apgd", tol=1e-5``. ``compare`` solves the Newton
        systems with other preconditioners too; ``say`` is told on the first rank how a settling goes on; ``program``:
        warnings name options as ``python -m pctt.run`` does. Raises
        OptionError (a ValueError) for a bad setting, SceneError if the scene fails, and FileError for a bad file, each
        on all ranks. Warns of a checkpoint of another text of the scene file, or of other surfaces of bodies.
        """
        if not isinstance(scene, (Scene, Experiment)):
            raise OptionError(f"scene {scene!r}: allowed is a dem.scene.Scene or an instance of an Experiment")
        if not isinstance(comm, MPI.Comm):
            raise OptionError(f"comm {comm!r}: allowed is a communicator of mpi4py, such as MPI.COMM_WORLD")
        self.comm = comm
        self.experiment = scene if isinstance(scene, Experiment) else SceneExperiment(scene)
        given = {**(vars(settings) if settings else {}), **changes}
        self._compare = compare or ccp.Comparison(comm, [])
        compared = bool(self._compare.names)
        self.settings = together(
            comm, "settings", lambda: made(Settings, given).completed_for(self.experiment, compared), own=(OptionError,)
        )
        refuse_unlike(self.settings, comm)
        restart = restart if isinstance(restart, state.RunState) else comm.bcast(restart)
        if not isinstance(restart, (str, Path, state.RunState)):
            raise OptionError(f"restart {restart!r}: allowed is the name of a checkpoint, or 'settled'")
        scene = state.built(self.experiment, comm)
        self.dt_reason = reason(scene) if self.settings.dt is None else ""
        self.settings = self.settings.fitted(scene, compared)
        idle = changes.get("overlap") if restart not in ("", "settled") else None
        if restart == "settled":
            restart = state.settled_state(self.experiment, self.settings, scene, comm, say)
        self._origin = state.origin(self.experiment, scene, self.settings.dt)
        if isinstance(restart, state.RunState):
            self.world, self.memory = state.restored(restart, scene, comm)
        elif restart:
            self.world, self.memory = state.load(Path(restart), scene, self._origin, comm, program)
        else:
            self.world = state.world_at_start(self.experiment, self.settings, scene, comm, program)
            self.memory = ImpulseMemory(comm, self.world.pairs.parts, self.world.pairs.columns)
        if idle is not None:
            warn(comm, f"overlap={idle!r} has no effect, as the simulation goes on from a checkpoint")
        falls = "" if restart else comm.bcast(fall_remark(scene, self.settings.dt))
        turned = [half_turn_remark(body, self.settings.dt) for body in self.world.large_bodies]
        if large := step_remark(self.world, self.settings.dt) or falls or next(filter(None, turned), ""):
            warn(comm, large)
        if likely := "" if restart else comm.bcast(doubts(scene)):
            warn(comm, likely)
        for other in (distance_remark(scene, self.settings.delta), small_remark(scene, self.settings.dt)):
            if told := comm.bcast(other):
                warn(comm, told)
        half = smallest(scene)
        self._watches = TurnWatch(), SwingWatch(), PaceWatch(half, scene.leaving), LooseWatch(half), RoomWatch()
        self._tell_turns()
        self._begun = restart
        self.restart = "" if isinstance(restart, state.RunState) else str(restart)  #: the file from which it goes on
        newton = ccp.newton_for(comm, self.settings.solver, self.settings.newton, self._compare)
        self.stepper = Stepper(self.settings, self.world, self.memory, newton)
        watch = OverlapWatch(scene, self.settings, float(self.world.pairs.stiffness.min()))
        self.overlap_watch = comm.bcast(watch)  # processors may round in other ways
        if soft := self.overlap_watch.soft(program):
            warn(comm, soft)
        self._program, self._jumped, self._unsolved = program, False, program
        self.last: Step | None = None
        self.figures: dict[str, Any] = {}
        self.output: Writer | None = None
        self._closed = False
        self._known = {"_known", "_row", *vars(self)}
        scene.finish()

    def __setattr__(self, name: str, value: object) -> None:
        """AttributeError for a name that a simulation does not have: it would do nothing."""
        known = vars(self).get("_known")
        if known and name not in known and not hasattr(type(self), name):
            helps = "settings are arguments of Simulation, and change(...) changes bodies, loads, the cell"
            raise AttributeError(f"a Simulation has no {name!r} to set; {helps}{nearest(name, known)}")
        super().__setattr__(name, value)

    def __getattr__(self, name: str) -> Any:
        """AttributeError that says where the name is, if it is a setting, a figure of the last step or of the world."""
        own: dict[str, Any] = {} if name.startswith("_") else vars(self)
        found = [f"{place}.{name}" for place in ("settings", "world") if hasattr(own.get(place), name)]
        found += [f"figures[{name!r}]"] if name in own.get("figures", ()) else []
        where = f"; did you mean {found[0]}?" if found else nearest(name, [*filter(str.isalpha, dir(self))])
        raise AttributeError(f"a Simulation has no attribute {name!r}{where}")

    @classmethod
    def load(cls, path: str | Path, scene: Scene | Experiment, *given: Any, **more: Any) -> Simulation:
        """The simulation that `save` kept, or a checkpoint.h5 of a run, with the same scene and time step; the other
        arguments are those of a new one. On as many ranks it goes on with the same bits."""
        return cls(scene, *given, restart=_name("load", path), **more)

    def copy(self) -> Simulation:
        """Another simulation in the same state, which goes on with the same bits, and writes no files; collective."""
        kept = state.run_state(self.world, self.memory)
        other = Simulation(self.experiment, self.settings, comm=self.comm, restart=kept, compare=self._compare)
        other.last, other.figures = self.last, dict(self.figures)
        return other

    @_collective
    def reset(self) -> None:
        """Go back to where the simulation began: time zero, or its checkpoint; collective. OptionError while `write`
        writes files."""
        if self.output is not None:
            raise OptionError(f"reset: this simulation writes to {self.output.place.folder}; allowed is a new one")
        fresh = Simulation(
            self.experiment, self.settings, comm=self.comm, restart=self._begun, compare=self._compare,
            program=self._program,
        )  # fmt: skip
        self.stepper.destroy()
        vars(self).update(vars(fresh))

    def __reduce__(self) -> tuple[Any, ...]:
        """For pickle: what `copy` takes, of a simulation of one rank; it wakes up on one rank, too."""
        if self.comm.size > 1:
            raise TypeError(f"pickle of a simulation on {self.comm.size} ranks: allowed are one rank, or save and load")
        return _revived, (self.experiment, self.settings, state.run_state(self.world, self.memory))

    def __enter__(self) -> Simulation:
        return self

    def __exit__(self, kind: type[BaseException] | None, *more: object) -> None:
        self.close() if kind is None else self._free()

    # -- steps -----------------------------------------------------------------------------------------------

    @_collective
    def step(self) -> dict[str, Any]:
        """Make a step of dt; its `figures`. Warns of a jump of energy. SceneError if a body is lost, if code of the
        scene fails, or if the contacts have no solution: the state is then that before the step, which may be tried
        again, but `last` is None."""
        self._refuse_closed("step")
        self.last = None  # frees the arrays of the last step
        try:
            made = self.stepper.step()
        except NoSolutionError:
            if self.output:
                self.output.keep()
            raise
        except KeyboardInterrupt:
            self.world.lists = None  # those of the search may be half made
            raise
        self._take(made)
        if self.figures["energy_jump"] and not self._jumped:
            self._jumped = True
            warn(self.comm, report.jump_words(self.figures, self._program))
        if cause := self.overlap_watch.look(made.step, self.figures["closing_speed"]):
            warn(self.comm, self.overlap_watch.words(cause, self.steps, self._program))
        if not self._unsolved and self.figures["status"] not in report.SOLVED:
            self._unsolved = True
            warn(self.comm, report.unsolved_words(self.figures))
        self._tell_turns()
        return self.figures

    @uninterrupted()
    def _take(self, made: NewStep) -> None:
        """Let the state be that at the end of this step, and write it."""
        output = self.output
        with log.phase("output"):
            row = recording.row(made.step, self.experiment)
            self.stepper.take(made)
            self.last, self._row, figures = made.step, row, made.figures
            figures["worst_overlap"] = self._row["worst_overlap [m]"]
            figures["energy_jump"] = self._row["energy_jump [J]"]
            if output:
                output.record(self.last, self._row)
        # a step's checkpoint is written after its figures, so its seconds count in the next step
        figures["phases"] |= log.take_seconds(("output",))
        figures["seconds"] = sum(figures["phases"].values())
        if output:
            with log.phase("output"):
                output.add(figures, self._row)
        self.figures = self._row | figures

    def _tell_turns(self) -> None:
        """Warn of a body that goes, turns or swings too far in a step, or of a joint that does not hold; collective."""
        for watch in self._watches:
            if words := watch.look(self.world, self.settings.dt):
                warn(self.comm, words)

    @_collective
    @known_arguments()
    def run(
        self, *bare: float, until: float | None = None, steps: int | None = None,
        stop: Callable[[Simulation], bool] | None = None, every: int = 1,
        call: Callable[[Simulation], object] | None = None, progress: bool = False,
    ) -> None:  # fmt: skip
        """Make steps until the time ``until`` [s], or so many ``steps``, or until ``stop(self)`` is true after one,
        whichever is first; after every ``every``-th of them, ``call(self)``. Then complete the folder of `write`. The
        first rank's values count. ``progress``: say where it is, and how long it goes on."""
        if bare:
            says = ", ".join(map(repr, bare))
            raise OptionError(f"run({says}): steps or seconds? allowed is run(steps={says}), or run(until={says}) [s]")
        for name, given in {"call": call, "stop": stop}.items():
            together(self.comm, "run", partial(function_or_none, f"run({name}=...)", given), own=(ValueError,))
        until, steps, every, endless = self.comm.bcast((until, steps, every, until is steps is stop is None))
        if endless:
            raise OptionError("run: without an end; allowed are until, steps and stop")
        refuse_bad(Run(steps=steps or 0))
        if not isinstance(every, (int, np.integer)) or every < 1:
            raise OptionError(f"run(every={every}): allowed are whole numbers from 1 on")
        left = math.inf if steps is None else steps
        if until is not None:
            left = min(left, self._steps_until(number("run(until=...)", until)))
        first, end, ends = self.steps, self.steps + left, False
        called, watched = on_any(self.comm, call is not None, call is not None or stop is not None)
        if every != 1 and not called:
            raise OptionError(f"run(every={every}): is for call=...; write(every=...) is for the recorded steps")
        progress_report = report.Progress(self.comm, quiet=not progress)
        progress_report.passed(first, self.time, end)

        def tell() -> bool:
            if call is not None and (self.steps - first) % every == 0:
                call(self)
            return stop is not None and bool(stop(self))

        while self.steps < end and not ends:
            self.step()
            if self.comm.size == 1:
                ends = tell()
            elif watched:  # an error of one rank is one of all, and the first rank decides
                ends = self.comm.bcast(together(self.comm, "call or stop of run", tell))
            progress_report.passed(self.steps, self.time, self.steps if ends else end)
        self.complete()

    def _steps_until(self, until: float) -> float:
        """How many steps lead to this time [s], inf to none."""
        dt = self.settings.dt
        if not until >= self.time - 0.5 * dt:
            raise OptionError(f"run(until={until}): the time is {self.time:g} s already; allowed is a later one")
        return math.ceil((until - self.time) / dt * (1 - 1e-12) - 1e-9) if until < math.inf else until

    # -- what there is ---------------------------------------------------------------------------------------

    @property
    def time(self) -> float:
        """[s]; not collective."""
        return self.world.time

    @property
    def expected_overlap(self) -> float:
        """The greatest to expect of the contacts as springs, as a part of a half thickness; 0 of rigid contacts. Not
        collective."""
        return self.overlap_watch.elastic

    @property
    def steps(self) -> int:
        """Steps made since time zero; not collective."""
        return self.world.step

    @property
    def ids(self) -> np.ndarray:
        """Ids (n,) of the grains that there are, in ascending order, on every rank: the order of `positions` and
        others. They count the grains in the order of the scene, then those of sources as they came."""
        return self._of_grains("id")

    def source(self, name: str) -> Tally:
        """What has come from a source: ``count``, ``mass`` [kg], and ``refused``, the steps in which it had no room.
        ValueError if there is none of that name. Not collective."""
        return self.world.passages.passed("source", name)

    def outlet(self, name: str) -> Tally:
        """What has left by an outlet: ``count`` and ``mass`` [kg]. ValueError if there is none of that name. Not
        collective."""
        return self.world.passages.passed("outlet", name)

    @property
    def positions(self) -> Floats:
        """Centres (n, 3) of all grains on every rank, in the order in which the scene added them, within the cell of a
        periodic scene [m]."""
        return self._of_grains("position")

    @property
    def orientations(self) -> Floats:
        """Quaternions (n, 4) (w, x, y, z) of all grains on every rank, in the order of the scene."""
        return self._of_grains("quaternion")

    @property
    def velocities(self) -> Floats:
        """Linear and angular velocities (n, 6) of all grains on every rank, in the order of the scene [m/s, rad/s]."""
        return self._of_grains("velocity")

    @property
    def local(self) -> Bodies:
        """The grains of this rank, a table with the columns ``id``, ``position``, ``velocity`` and so on, in any order;
        ``id`` is the number in the order of the scene. Not collective."""
        return Bodies(**{name: frozen(column.view()) for name, column in self.world.grains.columns().items()})

    def _of_grains(self, name: str) -> np.ndarray:
        grains = self.world.cell.inside(self.world.grains)
        found = self._gathered(name, id=grains.id, values=getattr(grains, name))
        return frozen(found["values"][np.argsort(found["id"])])

    def _gathered(self, what: str, **columns: np.ndarray) -> dict[str, np.ndarray]:
        """The rows of all ranks, on every rank."""
        barrier(self.comm, f"{what} of a Simulation")
        parts = self.comm.allgather(columns)
        return {name: np.concatenate([part[name] for part in parts]) for name in columns}

    @property
    def kinetic_energy(self) -> float:
        """Of all bodies that forces move [J]."""
        tables = [self.world.grains] + [self.world.large] * (self.comm.rank == 0)
        kinetic = sum(energy(table, self.world.gravity)[0] for table in tables)
        return barrier(self.comm, "kinetic_energy of a Simulation", number=kinetic)

    @property
    def contacts(self) -> Contacts:
        """The contacts of the last step of all ranks, on every rank, in an order that does not depend on the ranks:
        their ``bodies``, ``point``, ``normal``, ``gap`` and ``force``. ValueError before the first step."""
        step = self._last
        own, id = step.contacts, step.contacts.near.bodies.id
        found = self._gathered(
            "contacts",
            key=own.key,
            bodies=np.searchsorted(np.append(self.ids, self.world.large.id), np.stack([id[own.a], id[own.b]], axis=1)),
            point=step.point,
            frame=step.system.frame,
            gap=own.gap,
            moved=np.zeros_like(own.point) if own.moved is None else own.moved,
            impulse=step.impulse,
            **({} if step.moments is None else {"moment": step.moments}),
        )
        order = np.argsort(found.pop("key"))
        return Contacts(**{name: frozen(column[order]) for name, column in found.items()}, dt=step.system.dt)

    @property
    def sample(self) -> Sample:
        """The grains and contacts of this rank after the last step, for the functions of `dem.measures`. ValueError
        before the first step. Not collective."""
        return self._last.sample

    def body(self, name: str) -> Body:
        """A large body; ValueError if there is none of that name. Not collective."""
        try:
            return Body(self, self.world.large_row(name))
        except KeyError as error:
            raise ValueError(error.args[0]) from None

    @property
    def loads(self) -> dict[str, Load]:
        """The loads by name; `change` changes them. Not collective."""
        return dict(self.world.named["load"])

    @_collective
    def change(self, what: str, **values: Any) -> None:
        """Give a load, spring, joint, source, large body, pair of materials or the cell other values from now on::

            sim.change("load wind", force=(0, 0, -5.0))     # force, torque, start, end; with on=... it may begin
            sim.change("spring tie", length=0.5)            # stiffness, damping, length
            sim.change("joint boom", speed=-0.5)            # speed, target, strength, low, high
            sim.change("source rain", mass_rate=0.5)        # mass_rate or number_rate, 0 shuts it; velocity
            sim.change("body stirrer", speed=2.0)           # a parameter of its motion, motion=..., surface_velocity
            sim.change("pair grains, steel", friction=0.2)  # restitution, rolling and others, where they act
            sim.change("cell", stress=(None, None, 2e3))    # stress, strain_rate, shear_rate of a periodic one

        The first rank's values count, and checkpoints keep them. ValueError for a name that is not there, and for what
        it cannot have (`dem.model.changes.change`)."""
        self._refuse_closed("change")
        together(self.comm, what, partial(refuse_functions, what, values), own=(ValueError,))
        values = self.comm.bcast(values)
        for name in ("friction", "static_friction") if self.settings.law == ccp.COULOMB else ():
            if name in values and (steep := ccp.why_steep(number(name, values[name]), self.settings.tol)):
                raise ValueError(f"{name} {steep}")
        together(self.comm, what, partial(change, self.world, what, **values), own=(ValueError, TypeError))

    @property
    def period(self) -> Floats | None:
        """The lengths (3,) of the periodic cell now [m], inf: none along that axis; None: no axis has one. Not
        collective."""
        cell = self.world.cell
        return frozen(cell.period.copy()) if cell.periodic else None

    @property
    def springs(self) -> dict[str, Spring]:
        """The springs by name; `change` changes them. Not collective."""
        return dict(self.world.named["spring"])

    def spring_force(self, name: str) -> Floats:
        """Force (3,) of a spring on its second end, its mean over the last step [N]. ValueError before the first step,
        or if there is none of that name. Not collective."""
        return self._last.spring_force(name)

    def joint(self, name: str) -> JointNow:
        """A joint: its force, torque, angle or position, speed and motor; ValueError if there is none of that name. Not
        collective."""
        return JointNow(self, name)

    @property
    def _last(self) -> Step:
        if self.last is None:
            raise ValueError("there are no contacts and forces yet: no step was made, or the last one failed")
        return self.last

    # -- files -----------------------------------------------------------------------------------------------

    @_collective
    @uninterrupted()
    def save(self, path: str | Path) -> None:
        """Keep the state in a checkpoint, from which `load` goes on. FileError if that fails."""
        path = _name("save", self.comm.bcast(path))
        refuse_unwritable("save", Path(path).parent, self.comm)
        self._save(Path(path))

    def _save(self, path: Path) -> None:
        state.save(path, self._origin, self.world, self.memory)

    @_collective
    @uninterrupted()
    def write(
        self, folder: str | Path, *, overwrite: bool = False, every: int = 1, checkpoint_every: int = 1,
        checkpoint_minutes: float | None = None, hard: int = 5, problems: str | Path = "",
    ) -> None:  # fmt: skip
        """From now on write the files of a run (docs/files.md) to a folder, as ``-output`` does: a frame every so many
        steps (0: none), a checkpoint every so many, or in place of that after so many minutes, and the first ``hard``
        cone problems that the solver leaves; to the folder ``problems`` those of all steps.

        The first rank's values count. ``overwrite`` replaces another run there once a step is made. A simulation loaded
        from the folder's own checkpoint goes on with its files. FileError if another run has the folder.
        """
        self._refuse_closed("write")
        if self.output is not None:
            raise OptionError(f"write {folder}: this simulation writes to {self.output.place.folder} already")
        given = folder, overwrite, every, checkpoint_every, checkpoint_minutes, hard, problems
        folder, overwrite, every, checkpoint_every, checkpoint_minutes, hard, problems = self.comm.bcast(given)
        _name("write", folder, "folder")
        run = Run(
            output_every=every, checkpoint_every=checkpoint_every, checkpoint_minutes=checkpoint_minutes,
            overwrite=overwrite,
        )  # fmt: skip
        try:
            refuse_bad(run)
        except OptionError as error:  # as the argument is called here
            raise OptionError(str(error).removeprefix("output_")) from None
        if not isinstance(hard, (int, np.integer)) or hard < 0:
            raise OptionError(f"write(hard={hard}): allowed are whole numbers from 0 on")
        for name, path in {"write": folder, "problems": problems}.items():
            if path:
                refuse_unwritable(name, Path(path), self.comm)
        place = Place(Path(folder), self.comm, self.restart, overwrite, self._program)
        about = {"scene": json_text.read(self._origin["scene"]), "settings": dataclasses.asdict(self.settings)}
        about["stiffness"] = self.world.pairs.stiffness.tolist()
        self.output = Writer(place, self.world, about, self._save, self._compare.summary, run)
        self.stepper.dump = Dump(self.settings, self.experiment, self.world, place, hard, str(problems))

    @_collective
    @uninterrupted()
    def complete(self) -> None:
        """Write what the folder of `write` lacks of the last step."""
        if self.output and self.last:
            self.output.complete(self.last, self._row)

    @_collective
    @uninterrupted()
    def analyse(self) -> dict[str, float]:
        """The numbers that the scene finds in the records that `write` wrote; they also go to summary.json."""
        if not (self.output and self.last):
            raise ValueError("analyse: no step was written, so there are no records")
        return self.output.analyse(self.experiment)

    def close(self) -> None:
        """Complete and analyse the folder of `write`, leave it to others, and free the solver. The state can still be
        looked at. A simulation in a ``with`` block is closed at its end."""
        if self.output and self.last and not self._closed:
            self.complete()
            if self.output.analysis is None:
                self.analyse()
        self._free()

    def _refuse_closed(self, call: str) -> None:
        if self._closed:
            raise ValueError(f"{call}: this simulation is closed; allowed is copy(), which goes on from its state")

    def _free(self) -> None:
        self._closed = True
        self.stepper.destroy()
        if self.output:
            self.output.leave()

    # -- pictures --------------------------------------------------------------------------------------------

    def __repr__(self) -> str:
        bodies = f"{self.world.body_count} bodies on {self.comm.size} ranks"
        now = f"step {self.steps}, time {self.time:g} s"
        return f"<Simulation of {scene_name(self.experiment)}: {bodies}, {now}, {self.settings.words}>"

    def _repr_html_(self) -> str:
        """The figures of the last step as a table, for notebooks."""
        shown = [(name, value) for name, value in self.figures.items() if isinstance(value, (int, float, str))]
        texts = [(name, f"{value:.6g}" if isinstance(value, float) else str(value)) for name, value in shown]
        rows = "".join(f"<tr><th>{html.escape(name)}</th><td>{html.escape(text)}</td></tr>" for name, text in texts)
        return f"<p>{html.escape(repr(self)[1:-1])}</p><table>{rows}</table>"

    def render(self, color: str = "speed", **view: Any) -> Picture:
        """A picture of the present state, which a notebook shows and ``save`` writes. ``color`` is one of
        `pctt.render.COLOURS`; what else may be given are fields of `pctt.look.program.View`, such as azimuth=30.0
        and bodies={"blade": "orange", "box": "none"}. ImportError without VTK (the extra `pictures`), OptionError for a
        bad name or value."""
        snapshot = self._snapshot()

        def draw() -> Picture | None:
            return picture(snapshot, color, view) if self.comm.rank == 0 else None

        return self.comm.bcast(together(self.comm, "render", draw, own=(ImportError, OptionError, FileError)))

    def _snapshot(self) -> Snapshot:
        """All bodies and contacts on every rank, for those that draw."""
        world, large = self.world, self.world.large
        names = ("position", "quaternion", "velocity", "id", "shape", "size", "mass", "material")
        table = {name: np.concatenate([self._of_grains(name), getattr(large, name)]) for name in names}
        position, turn, velocity = (table.pop(name) for name in names[:3])
        grains = len(position) - len(large)
        contacts = self.contacts if self.last else Contacts.none()
        what = Table(**table, grains=grains, forms=described_forms(world))
        frame = Frame(self.steps, self.time, position, turn, velocity, contacts, what)
        return Snapshot(frame, materials=world.materials, large=described_bodies(world))


def _revived(*given: Any) -> Simulation:
    experiment, settings, kept = given
    return Simulation(experiment, settings, comm=MPI.COMM_SELF, restart=kept)


class Body:
    """A large body of a simulation, as it is now. Vectors are in the world frame; what is not said to be collective is
    not."""

    __slots__ = ("_row", "_sim")

    def __init__(self, sim: Simulation, row: int):
        self._sim, self._row = sim, row

    def __repr__(self) -> str:
        place = ", ".join(f"{x:.4g}" for x in self.position)
        speed = float(np.linalg.norm(self.velocity[:3]))
        return f"<Body {self.name!r}: {type(self.motion).__name__}, at ({place}) m, {speed:.4g} m/s>"

    @property
    def name(self) -> str:
        return self._large.name

    @property
    def _large(self) -> LargeBody:
        return self._sim.world.large_bodies[self._row]

    @property
    def position(self) -> Floats:
        """Centre of mass (3,); of a body with prescribed motion its reference point [m]."""
        return frozen(self._sim.world.large.position[self._row].copy())

    @property
    def orientation(self) -> Floats:
        """Quaternion (4,) (w, x, y, z)."""
        return frozen(self._sim.world.large.quaternion[self._row].copy())

    @property
    def velocity(self) -> Floats:
        """Linear and angular velocity (6,) in the last step [m/s, rad/s]."""
        return frozen(self._sim.world.large.velocity[self._row].copy())

    @property
    def force(self) -> Floats:
        """Sum of the contact forces (3,), their mean over the last step [N]. ValueError before the first step."""
        return self._sim._last.force_on(self.name)[:3]

    @property
    def torque(self) -> Floats:
        """Torque of the contact forces (3,) about the position, their mean over the last step [N m]."""
        return self._sim._last.force_on(self.name)[3:]

    @property
    def surface_velocity(self) -> SurfaceVelocity | None:
        """Velocity (3,) of its surface along itself in the body frame, that of a belt [m/s]; None: it has none."""
        return self._large.surface

    def triangle_forces(self) -> Floats:
        """Forces (triangles, 3) on the triangles of a body that is one mesh, of the last step, each contact's on the
        nearest [N]; collective. ValueError for another body."""
        sample, mesh = self._sim.sample, self._large.shapes[0]
        if len(self._large.shapes) > 1 or not isinstance(mesh, Mesh):
            raise ValueError(f"triangle_forces: the body {self.name!r} is not one mesh")
        return measures.triangle_forces(sample, sample.count + self._row, mesh, self.position, self.orientation)

    @property
    def motion(self) -> Motion:
        """How the body moves; `Simulation.change` changes it."""
        return self._large.motion
