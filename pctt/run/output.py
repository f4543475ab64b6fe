"""Writing the folder of a run, whose layout `pctt.folder` has: the place of the files, and what each step adds.

A line is added to steps.jsonl with one write; every other file is written as `pctt.disk.whole` does it. So a killed run
leaves whole files, and what is written per step does not grow with the number of steps.
"""

from __future__ import annotations

import os
import shutil
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from itertools import chain
from pathlib import Path
from shlex import quote
from typing import Any

import numpy as np
from mpi4py import MPI

from dem import bodies, checks
from dem.exchange import exchange
from dem.experiment import Experiment
from dem.model.world import World
from dem.motion import Dynamic
from dem.scene import least_half
from dem.shapes import described
from dem.step import Step
from dem.together import together
from pctt import disk, json_text
from pctt.disk import FileError, Lock, on_first, texts, write_rows, write_text
from pctt.folder import DERIVED, FILES, HARD, PLACES, TABLE, Folder, write_table
from pctt.options import OptionError
from pctt.petsc import warn
from pctt.run.settings import Run


def refusal(folder: Path, restart: str, overwrite: bool, program: bool) -> str:
    """Why a run with these values of -restart and -overwrite may not write to the folder; empty if it may. Options are
    named as Python or, if so, the program has them."""
    there = _held(folder)
    if not there or overwrite or _goes_on(folder, restart):
        return ""
    path, ways = str(folder / "checkpoint.h5"), ("overwrite=True", "Simulation.load({!r}, ...)")
    if program:
        path, ways = quote(path), ("-overwrite", "-restart {}")
    goes_on = f", or {ways[1].format(path)} to go on with it" * ("checkpoint.h5" in there)
    allowed = f"another folder, {ways[0]} to replace that run{goes_on}"
    return f"{'-output ' * program}{folder}: holds a run ({', '.join(there)}); allowed is {allowed}"


def refuse_unwritable(name: str, folder: Path, comm: MPI.Comm) -> None:
    """Make a folder; OptionError for the option ``name`` if files cannot be written there; collective."""

    def write() -> None:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass

    try:
        on_first(comm, folder, write)
    except FileError as error:
        raise OptionError(f"{name} {error}; allowed is a folder that can be written") from None


def _held(folder: Path) -> list[str]:
    """What is there of a run; nothing if a run may write to the folder."""
    return [name for name in FILES if (folder / name).is_file() or any((folder / name).glob("*.h5"))]


def _goes_on(folder: Path, restart: str) -> bool:
    """Whether the file of ``-restart`` is the folder's own, so that a run goes on with what is there."""
    return bool(restart) and Path(restart).resolve() == (folder / "checkpoint.h5").resolve()


class Place:
    """The place where a run writes, ``now``. It is the run's ``folder``, unless that holds another run. Then it is a
    hidden folder in it until ``take`` replaces the other run, which stays untouched up to then.

    A run that ``goes_on`` from the folder's own checkpoint adds to the files of the earlier one. No other run has the
    folder until ``leave``.
    """

    def __init__(
        self, folder: Path, comm: MPI.Comm, restart: str = "", overwrite: bool = False, program: bool = False
    ):  # fmt: skip
        """``restart`` and ``overwrite`` are the values of the options; collective. FileError on all ranks if another
        run is writing to the folder, or has written there since the options were read; ``program`` as of `refusal`."""
        self.folder, self._comm, self._lock = folder, comm, Lock(folder)

        def begin() -> tuple[bool, Path]:
            folder.mkdir(parents=True, exist_ok=True)
            if not self._lock.take():
                name = f"{'-output ' * program}{folder}"
                raise FileError(f"{name}: another run is writing there; allowed is another folder")
            if refused := refusal(folder, restart, overwrite, program):
                self.leave()
                raise FileError(refused)
            shutil.rmtree(folder / ".new", ignore_errors=True)  # of a run that ended before its first step stood
            goes_on = _goes_on(folder, restart)
            return goes_on, folder / ".new" if _held(folder) and not goes_on else folder

        self.goes_on, self.now = on_first(comm, folder, begin)

    def leave(self) -> None:
        """Let other runs have the folder."""
        self._lock.release()

    def make(self, name: str = ".") -> None:
        """Make the folder, or one within it; collective."""
        on_first(self._comm, self.folder, lambda: (self.now / name).mkdir(parents=True, exist_ok=True))

    def take(self) -> None:
        """Put what was written in the place of the earlier run; collective."""
        now, self.now = self.now, self.folder

        def replace() -> None:
            (now / ".old").mkdir()
            for name in FILES:  # renames come first: a kill between two of them would leave parts of both runs
                for source, target in ((self.folder / name, now / ".old" / name), (now / name, self.folder / name)):
                    if source.exists():
                        os.replace(source, target)
            shutil.rmtree(now)

        if now != self.folder:
            on_first(self._comm, self.folder, replace)


class Writer:
    """Writes the steps of a run to a place: of each by `record` and then `add`, and at the end by `complete`.

    The options ``run`` say when a frame is recorded, and when ``save(path)`` writes a checkpoint: after some steps, or
    after some minutes by the clock of the first rank. A run that goes on from the folder's own checkpoint adds to the
    files of the earlier run; any other run replaces them. Either removes nothing before its first step is written.
    Methods are collective.
    """

    def __init__(
        self, place: Place, world: World, about: dict[str, Any], save: Callable[[Path], None],
        compare: Callable[[], dict[str, Any]], run: Run,
    ):  # fmt: skip
        """``about``: what settings.json says; ``compare()``: the summary of the compared preconditioners."""
        self.place, self._world, self._save, self._compare, self.comm = place, world, save, compare, world.comm
        self._run, self._saved_at = run, time.monotonic()
        self._start = self._recorded = self._saved = world.step
        self._kept_steps = world.step if place.goes_on else 0
        self._begun = self._stands = self._stale = False
        self.analysis: dict[str, float] | None = None  #: the scene's numbers of all steps so far
        tables = world.grains, world.passages.extremes()
        smallest = min(float(bodies.least_half_thickness(table).min(initial=np.inf)) for table in tables)
        radius = self.comm.allreduce(smallest, MPI.MIN)
        if np.isinf(radius):
            radius = min(least_half(body) for body in world.large_bodies if isinstance(body.motion, Dynamic))
        self._about = {**about, "bodies": world.body_count, "ranks": self.comm.size, "smallest_radius [m]": radius}
        kept = on_first(self.comm, self._lines, lambda: {step for step, _ in self._kept()})  # which can be gone on with
        if place.goes_on and len(kept) <= self._start - min(kept, default=self._start):
            warn(self.comm, f"{self._lines}: has no figures of some of the steps up to {self._start}")

    @property
    def checkpoint(self) -> Path:
        return self.place.now / "checkpoint.h5"

    @property
    def folder(self) -> Folder:
        """What is written so far; on rank 0."""
        return Folder(self.place.now)

    @property
    def _lines(self) -> Path:
        return self.place.now / "steps.jsonl"

    def _kept(self) -> Iterator[tuple[int, str]]:
        """The steps that stay of an earlier run, and their lines; FileError if a line is damaged."""
        for number, line in enumerate(disk.lines(self._lines), 1):
            try:
                step = int(json_text.read(line)["step"])
            except (LookupError, TypeError, ValueError) as error:
                words = f"line {number} is no step ({error}); delete it, and the run goes on with the others"
                raise FileError(f"{self._lines}: cannot be continued: {words}") from None
            if step <= self._kept_steps:
                yield step, line

    def record(self, step: Step, row: Mapping[str, float], always: bool = False) -> None:
        """Write the frame of a step if that is due: its state, the contacts and impulses that led to it, and the row of
        its records as attributes of the group `record`.

        Bodies are in the order of their ids (grains, then large bodies).
        """
        world, contacts, frames = step.world, step.contacts, self.place.now / "frames"
        every = self._run.output_every
        due = every and (always or world.step % every == 0)
        if not due or self._recorded == world.step:
            return
        if self._recorded == self._start:
            self.place.make("frames")
            table = frames / "bodies.h5"
            if not on_first(self.comm, table, lambda: self.place.goes_on and table.exists()):  # of the first frame
                rows = _by_id(world, TABLE[1:])
                large = np.bytes_(json_text.written(described_bodies(world)))
                shared = {"materials": texts(world.materials), "large": large}
                if world.forms:
                    shared["forms"] = np.bytes_(json_text.written(described_forms(world)))
                write_rows(table, self.comm, rows, shared, {})
        near, count = contacts.near.bodies, contacts.near.grains
        start = near.position[:count], near.position[count + contacts.near.ghosts :]
        rows = {
            **_by_id(world, (*PLACES, *(TABLE if world.passages else ())), start=start),
            "contact/key": contacts.key,
            "contact/body": np.stack([near.id[contacts.a], near.id[contacts.b]], axis=1),
            "contact/point": step.point,
            "contact/frame": step.system.frame,
            "contact/moved": np.zeros_like(contacts.point) if contacts.moved is None else contacts.moved,
            "contact/gap": contacts.gap,
            "contact/impulse": step.impulse,
        }
        if (moments := step.moments) is not None:
            rows["contact/moment"] = moments
        top = {"step": world.step, "time": world.time, **world.cell.attributes()}
        about = {"/": top, "record": row, "contact": {"dt": step.system.dt}}
        write_rows(frames / f"{world.step:06d}.h5", self.comm, rows, {}, about)
        self._recorded = world.step

    def add(self, line: Mapping[str, Any], row: Mapping[str, float]) -> None:
        """Write the figures of a step with the row of its records, and the checkpoint if that is due."""
        due = on_first(self.comm, self._lines, lambda: self._add(json_text.written({**line, "record": row})))
        if due:  # after the figures: a run that goes on from the checkpoint must find the step
            self._checkpoint()
        if not self._stands:
            self.place.take()
            on_first(self.comm, self.place.folder, lambda: self._remove_later(Path(line["hard_problem"]).name))
            self._stands = True
        self.analysis, self._stale = None, True

    def _add(self, line: str) -> bool:
        """Whether a checkpoint is due after this line. The first line replaces the file, with the lines that stay;
        every other one is a single write."""
        self.place.now.mkdir(parents=True, exist_ok=True)
        if self._begun:
            disk.append(self._lines, line)
        else:
            self._begin(line)
        if self._run.checkpoint_minutes is not None:
            return time.monotonic() - self._saved_at >= 60.0 * self._run.checkpoint_minutes
        return (self._world.step - self._start) % self._run.checkpoint_every == 0

    def _begin(self, line: str) -> None:
        write_text(self.place.now / "settings.json", json_text.written(self._about, indent=1) + "\n")
        with disk.whole(self._lines) as temporary, open(temporary, "w") as file:
            file.writelines(f"{text}\n" for text in chain((text for _, text in self._kept()), [line]))
        self._begun = True

    def keep(self) -> None:
        """Write the checkpoint of the present state, if it is not there."""
        if self._saved < self._world.step:
            self._checkpoint()

    def complete(self, step: Step, row: Mapping[str, float]) -> None:
        """Write the frame and the checkpoint of the last step, if they are not there, and what follows from all."""
        self.record(step, row, always=True)
        self.keep()
        if self._stale:
            self._derive()

    def analyse(self, scene: Experiment) -> dict[str, float]:
        """The numbers that the scene finds in the records, which also go to summary.json; SceneError if it fails."""
        what = f"analyse of the scene {type(scene).__name__}"
        self.analysis = self.comm.bcast(together(self.comm, what, lambda: self._analyse(scene), own=(FileError,)))
        self._derive()
        return self.analysis

    def _analyse(self, scene: Experiment) -> dict[str, float]:
        if self.comm.rank > 0:
            return {}
        records = self.folder.records()
        found: Any = scene.analyse(records)
        if not isinstance(found, Mapping):
            raise ValueError(f"analyse must return a dict of numbers and arrays by name, not {type(found).__name__}")
        single = {name: value for name, value in found.items() if np.ndim(value) == 0}
        figures = {name: checks.number(f"analyse returns {name!r}", value) for name, value in single.items()}
        series = {name: np.asarray(value) for name, value in found.items() if name not in figures}
        if series:
            leading = {name: records[name] for name in list(records)[:2]}
            write_table(self.place.now / "analysis.csv", {**leading, **series})
        return figures

    def _derive(self) -> None:
        more = {"analysis": self.analysis or {}, "compare": self._compare()}
        on_first(self.comm, self.place.now, lambda: self.folder.derive(**more))
        self._stale = False

    def leave(self) -> None:
        """Let other runs have the folder. A run that an error ends writes what follows from its files."""
        if self.comm.rank == 0 and self._stands and self._stale:
            with suppress(FileError):  # which has said so already
                self.folder.derive(compare=self._compare())
        self.place.leave()

    def _checkpoint(self) -> None:
        """The lines of steps.jsonl come to the disk first: a run goes on from the checkpoint with them."""
        on_first(self.comm, self._lines, lambda: disk.flush(self._lines))
        self._save(self.checkpoint)
        self._saved, self._saved_at = self._world.step, time.monotonic()

    def _remove_later(self, hard: str) -> None:
        """Remove what followed from an earlier run's steps, and its later steps, but not those of this run's first
        step, such as the file ``hard``."""
        folder, kept = self.folder, self._kept_steps
        for name in DERIVED:  # first of all: no link is without its file
            (folder.path / name).unlink(missing_ok=True)
        for step in folder.steps:
            if step > kept and step != self._recorded:
                folder.frame_path(step).unlink()
        for path in (folder.path / HARD).glob("step??????_*its.h5"):
            if int(path.name[4:10]) > kept and path.name != hard:
                path.unlink()


def described_bodies(world: World) -> list[dict[str, Any]]:
    """The names and shapes of the large bodies, as JSON has them."""
    large = [
        {"name": body.name, "shapes": [described(shape) for shape in body.shapes]}
        for body in world.large_bodies
    ]
    return json_text.read(json_text.written(large))  # arrays as lists


def described_forms(world: World) -> list[dict[str, Any]]:
    """The kind of each form of grains, as of `dem.bodies`, and its surface in the frame of a grain of scale one."""
    return [{"kind": form.BASE + n, **form.described()} for n, form in enumerate(world.forms)]


def _by_id(world: World, names: Sequence[str], **more: tuple[np.ndarray, np.ndarray]) -> dict[str, np.ndarray]:
    """Columns of the table of all bodies, in the order of their ids, spread over the ranks, and `more` columns by name,
    of grains and large bodies; collective."""
    grains, comm = world.cell.inside(world.grains), world.comm
    columns = {"id": grains.id, **{name: getattr(grains, name) for name in names}}
    columns |= {name: own for name, (own, _) in more.items()}
    starts = np.arange(comm.size + 1) * world.ids // comm.size
    rows = exchange(comm, columns, np.searchsorted(starts, grains.id, side="right") - 1)
    order, last = np.argsort(rows["id"]), comm.rank == comm.size - 1
    large = {name: getattr(world.large, name) for name in names} | {name: of for name, (_, of) in more.items()}
    return {name: np.concatenate([rows[name][order], of if last else of[:0]]) for name, of in large.items()}
