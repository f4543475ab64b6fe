"""The output folder of a run: its layout, read and written.

    settings.json    what was simulated how
    steps.jsonl      what each step took, how well it was solved, and its records (`dem.record`): a JSON object per line
    frames/          one file per recorded step, and bodies.h5 with what no step changes
    checkpoint.h5    all that ``-restart`` needs
    hard/            cone problems that the asked-for solver did not solve

From these follow, at the end of a run or by `Folder.derive`:

    state.h5         group steps/000012 per recorded step, each a link to its own file in frames/
    records.csv      a row per step
    summary.json     figures of the whole run, and of the compared preconditioners
    analysis.csv     the series that the scene makes of the records

A line is added to steps.jsonl with one write; every other file is written under a temporary name and renamed. So a
killed run leaves whole files, and what is written per step does not grow with the number of steps.
"""

from __future__ import annotations

import csv
import json
import math
import os
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from mpi4py import MPI

from dem import bodies
from dem.exchange import exchange
from dem.experiment import Experiment
from dem.shapes import described
from dem.step import Step
from dem.together import together
from dem.world import World
from pctt import disk
from pctt.disk import FileError, Lock, on_first, texts, told, write_rows, write_text

HARD = "hard"  # folder of the cone problems that were not solved
DERIVED = ("state.h5", "records.csv", "summary.json", "analysis.csv")
#: The files of a run in its folder, and with its folders all that it leaves.
RUN_FILES = ("settings.json", "steps.jsonl", "checkpoint.h5", *DERIVED)
FILES = (*RUN_FILES, "frames", HARD)

CONTENTS = (
    "steps/STEP: position m, quaternion (w, x, y, z), velocity m/s and rad/s, by body id; "
    "record: attributes as in records.csv; "
    "contact: bodies a and b, point m, frame rows (normal from a to b, t1, t2), gap m, "
    "impulse on b N s; attribute dt s. bodies: shape, size m, mass kg, material by body id; "
    "materials: the names of the materials, of which material is the index; "
    "large: names and shapes of the large bodies, the last of the ids, in their frames"
)
LINKS = (
    "This file holds nothing but links to the folder frames beside it, and is empty without that folder. "
    "python -m pctt.export FOLDER -single FILE.h5 makes one file of all."
)


class FolderError(FileError):
    """The folder lacks data that a program needs; the message names the folder and says what to do."""


# -- figures as JSON, which has no infinity and no NaN: they are written as null -------------------------------


def dumps(figures: Any, indent: int | None = None) -> str:
    """The JSON text of figures: numbers, and dicts and lists of them."""
    return json.dumps(_finite(figures), indent=indent, default=lambda number: number.item())  # of numpy


def loads(line: str) -> dict[str, Any]:
    """The figures of a JSON text by name; null becomes infinity. ValueError if the text is not JSON."""
    return {name: math.inf if value is None else value for name, value in json.loads(line).items()}


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _finite(item) for name, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def totals(steps: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """The figures of a whole run, from those of its steps; nothing of no steps."""
    if not steps:
        return {}
    worst = max(steps, key=lambda line: line["worst_overlap"])
    names = dict.fromkeys(name for line in steps for name in line["phases"])
    contacts = [line["contacts"] for line in steps]
    return {
        "steps": len(steps),
        "first_step": steps[0]["step"],
        "last_step": steps[-1]["step"],
        "time": steps[-1]["time"],
        "contacts": [min(contacts), max(contacts)],
        **{name: sum(line[name] for line in steps) for name in ("newton_its", "ksp_its", "fallbacks", "seconds")},
        "not_converged": sum(not line["converged"] for line in steps),
        **{
            name: max(line[name] for line in steps)
            for name in ("natural_residual", "coulomb_residual", "peak_memory")
        },
        "worst_overlap": {"overlap [m]": worst["worst_overlap"], "step": worst["step"]},
        "phases": {name: sum(line["phases"].get(name, 0.0) for line in steps) for name in names},
    }


# -- reading -------------------------------------------------------------------------------------------------

@dataclass(frozen=True)
class Contacts:
    """The contacts of a step between bodies a and b, and the impulses that acted in the step."""

    bodies: np.ndarray  #: (nc, 2) numbers of a and b in the order of the scene: grains, then large bodies
    point: np.ndarray  #: (nc, 3) in the middle between the surfaces, at the start of the step [m]
    frame: np.ndarray  #: (nc, 3, 3) with rows normal (from a to b), t1, t2
    gap: np.ndarray  #: (nc,) at the start of the step, negative if the bodies overlap [m]
    impulse: np.ndarray  #: (nc, 3) on b, in the contact frame [N s]
    dt: float  #: length of the step in which the impulses acted [s]

    @classmethod
    def none(cls) -> Contacts:
        """Those of no step."""
        vectors = np.zeros((0, 3))
        return cls(np.zeros((0, 2), np.int64), vectors, np.zeros((0, 3, 3)), np.zeros(0), vectors, 1.0)

    def __len__(self) -> int:
        return len(self.gap)

    @property
    def normal(self) -> np.ndarray:
        """Unit vectors (nc, 3) from a to b."""
        return self.frame[:, 0]

    @property
    def force(self) -> np.ndarray:
        """Mean forces (nc, 3) on b in the step, in the world frame [N]."""
        return np.einsum("ci,cij->cj", self.impulse, self.frame) / self.dt


@dataclass(frozen=True)
class Frame:
    """A recorded step. The rows of the arrays are the bodies in the order of their ids: first the grains, then the
    large bodies."""

    step: int
    time: float  #: [s]
    position: np.ndarray  #: (n, 3) [m]
    quaternion: np.ndarray  #: (n, 4) (w, x, y, z)
    velocity: np.ndarray  #: (n, 6) linear [m/s] and angular [rad/s]
    contacts: Contacts

    @property
    def speed(self) -> np.ndarray:
        """Speeds (n,) of the centres [m/s]."""
        return np.linalg.norm(self.velocity[:, :3], axis=1)

    def load(self) -> np.ndarray:
        """Sums (n,) of the magnitudes of the contact forces on each body [N]."""
        size = np.linalg.norm(self.contacts.force, axis=1)
        return np.bincount(self.contacts.bodies.ravel(), np.repeat(size, 2), minlength=len(self.position))


class Folder:
    """The output folder of a run. Raises FolderError if the folder is not one.

    Attributes: ``path``; ``steps`` (list) has the numbers of the recorded steps, for `frame`.
    """

    def __init__(self, path: str | Path):
        self.path = Path(path)
        if not self.path.is_dir():
            raise FolderError(f"{path}: no such folder; it is the -output of python -m pctt.run")
        if not any((self.path / name).is_file() for name in ("settings.json", "steps.jsonl", "summary.json")):
            raise FolderError(f"{path}: no output folder of python -m pctt.run (it has no steps.jsonl)")
        self.steps = sorted(int(path.stem) for path in self._frames.glob("*.h5") if path.stem.isdigit())

    @property
    def _frames(self) -> Path:
        return self.path / "frames"

    @property
    def bodies_path(self) -> Path:
        """The file with the data that no step changes."""
        return self._frames / "bodies.h5"

    def frame_path(self, step: int) -> Path:
        """The file of a recorded step."""
        return self._frames / f"{step:06d}.h5"

    def require_frames(self) -> None:
        """Read the shapes of the bodies; FolderError if these, or recorded steps, are missing."""
        if not self.steps:
            raise FolderError(f"{self.path}: no recorded steps; run with -output_every 1 or more")

        def take(file: h5py.File, sealed: bool) -> list[Any]:
            return [file[name][()] for name in ("shape", "size", "mass", "material", "materials", "large")]

        found = self._read(self.bodies_path, "lacks the shapes of the bodies; run again", take)
        self.shape, self.size, self.mass, self.material = found[:4]
        #: names of the materials by their numbers; name and shapes of each large body, the rows after the grains
        self.materials: list[str] = [name.decode() for name in found[4]]
        self.large: list[dict[str, Any]] = json.loads(found[5])
        self.grains = len(self.shape) - len(self.large)

    @property
    def radius(self) -> np.ndarray:
        """Radii (grains,) of the spheres that enclose the grains [m]."""
        return bodies.enclosing_radius(self.shape[: self.grains], self.size[: self.grains])

    def frame(self, step: int) -> Frame:
        """A recorded step; FolderError if its file is damaged."""

        def take(file: h5py.File, sealed: bool) -> Frame:
            contact = file["contact"]
            rows = [contact[name][()] for name in ("body", "point", "frame", "gap", "impulse")]
            contacts = Contacts(*rows, float(contact.attrs["dt"]))  # type: ignore[call-arg]
            table = {name: file[name][()] for name in ("position", "quaternion", "velocity")}
            return Frame(step, float(file.attrs["time"]), **table, contacts=contacts)

        return self._read(self.frame_path(step), "incomplete", take)

    def _read(self, path: Path, what: str, take: Callable[[h5py.File, bool], Any]) -> Any:
        try:
            return disk.read(path, MPI.COMM_SELF, take)
        except FileError as error:
            raise FolderError(f"{path}: {what} ({error})") from None

    def lines(self) -> list[dict[str, Any]]:
        """The figures of each step, in the order of the steps, from steps.jsonl; an empty list if the file is missing.

        Values that JSON has no number for (infinity and NaN) are infinite.
        """
        path = self.path / "steps.jsonl"
        try:
            return [loads(line) for line in disk.lines(path)]
        except (OSError, ValueError) as error:
            raise FolderError(f"{path}: no list of steps ({error})") from None

    def records(self) -> dict[str, np.ndarray]:
        """Columns of the records by their heads, such as ``force_blade_x [N]``, an entry per step; NaN where a step has
        no number."""
        return _records(self.lines())

    def analysis(self) -> dict[str, np.ndarray]:
        """Columns of analysis.csv by their heads; empty if the scene made none, or not of all these records."""
        path, records = self.path / "analysis.csv", self.records()
        if not (path.exists() and records):
            return {}
        try:
            table = csv.DictReader(disk.lines(path))
            found = _columns([{name: float(value or "nan") for name, value in row.items()} for row in table])
            return found if np.array_equal(found["time [s]"], records["time [s]"]) else {}
        except (KeyError, TypeError, ValueError) as error:
            raise FolderError(f"{path}: no table of numbers with a column time [s] ({error})") from None

    @property
    def summary(self) -> dict[str, Any]:
        """What summary.json has, or would have."""
        return self._json("summary.json") or self._summary(self.lines())

    def _json(self, name: str) -> dict[str, Any]:
        """A file's contents; nothing if there is none. FolderError if it is no JSON."""
        path = self.path / name
        try:
            return json.loads(path.read_text()) if path.exists() else {}
        except (OSError, ValueError) as error:
            raise FolderError(f"{path}: no figures ({error})") from None

    def _summary(self, lines: list[dict[str, Any]], **more: Any) -> dict[str, Any]:
        """``more`` is what only the run knows: `analysis` and `compare`."""
        about, found = self._json("settings.json"), totals(lines)
        radius = {"smallest_radius [m]": about.pop("smallest_radius [m]", math.inf)}
        if found:
            found["worst_overlap"] |= radius
        return {**about, **found, "analysis": {}, "compare": {}, **more}

    def derive(self, **more: Any) -> None:
        """Write records.csv, summary.json and state.h5, which follow from the other files; FileError if that fails.
        ``more`` goes to the summary."""
        lines = self.lines()
        if lines:
            _write_table(self.path / "records.csv", _records(lines))
        write_text(self.path / "summary.json", dumps(self._summary(lines, **more), indent=1) + "\n")
        if self.steps:
            self._link()

    def _link(self) -> None:
        """Let state.h5 lead to all recorded steps."""
        self.require_frames()
        path = self.path / "state.h5"
        with told(path), disk.whole(path) as temporary:
            disk.make_hdf5(temporary, numbers=4096 + 128 * len(self.steps), items=0)
            with h5py.File(temporary, "r+") as file:
                file.attrs["scene"] = json.dumps(self._json("settings.json").get("scene", {}))
                file.attrs["large_bodies"] = [body["name"] for body in self.large]
                file.attrs["contents"], file.attrs["links"] = CONTENTS, LINKS
                file["bodies"] = h5py.ExternalLink("frames/bodies.h5", "/")
                for step in self.steps:
                    file[f"steps/{step:06d}"] = h5py.ExternalLink(f"frames/{step:06d}.h5", "/")


def _records(lines: Sequence[Mapping[str, Any]]) -> dict[str, np.ndarray]:
    return _columns([line["record"] for line in lines if line.get("record")])


def _columns(rows: Sequence[Mapping[str, float | None]]) -> dict[str, np.ndarray]:
    """A table by columns; NaN where a row has no number."""
    names = dict.fromkeys(name for row in rows for name in row)
    return {name: np.array([row.get(name) for row in rows], dtype=float) for name in names}


def _write_table(path: Path, columns: Mapping[str, np.ndarray]) -> None:
    """Write columns as CSV, the first of which are whole numbers, the steps. ValueError for different lengths."""
    lengths = {name: len(column) for name, column in columns.items()}
    if len(set(lengths.values())) > 1:
        raise ValueError(f"the arrays of analyse need one entry per record, their lengths are {lengths}")
    rows = (",".join([str(int(step)), *map(repr, values)]) for step, *values in zip(*map(_floats, columns.values())))
    write_text(path, "\n".join([",".join(columns), *rows, ""]))


def _floats(column: np.ndarray) -> list[float]:
    return np.asarray(column, dtype=float).tolist()


class Snapshot(Folder):
    """The present state of a simulation, as a folder with one recorded step."""

    def __init__(
        self, frame: Frame, shape: np.ndarray, size: np.ndarray, material: np.ndarray, materials: Sequence[str],
        large: list[dict[str, Any]],
    ):  # fmt: skip
        self.path, self.steps, self._present = Path(), [frame.step], frame
        self.shape, self.size, self.material, self.materials, self.large = shape, size, material, [*materials], large
        self.grains = len(shape) - len(large)

    def frame(self, step: int) -> Frame:
        return self._present


# -- writing -------------------------------------------------------------------------------------------------


def refusal(folder: Path, restart: str, overwrite: bool) -> str:
    """Why a run with these values of -restart and -overwrite may not write to the folder; empty if it may."""
    there = _held(folder)
    if not there or overwrite or _goes_on(folder, restart):
        return ""
    goes_on = f", or -restart {folder / 'checkpoint.h5'} to go on with it" * ("checkpoint.h5" in there)
    allowed = f"another folder, -overwrite to replace that run{goes_on}"
    return f"-output {folder}: holds a run ({', '.join(there)}); allowed is {allowed}"


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

    def __init__(self, folder: Path, comm: MPI.Comm, restart: str = "", overwrite: bool = False):
        """``restart`` and ``overwrite`` are the values of the options; collective. FileError on all ranks if another
        run is writing to the folder, or has written there since the options were read."""
        self.folder, self._comm, self._lock = folder, comm, Lock(folder)

        def begin() -> tuple[bool, Path]:
            folder.mkdir(parents=True, exist_ok=True)
            if not self._lock.take():
                raise FileError(f"-output {folder}: another run is writing there; allowed is another folder")
            if refused := refusal(folder, restart, overwrite):
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

    A frame is recorded every ``every`` steps (0: never), and ``save(path)`` writes a checkpoint every
    ``checkpoint_every``. A run that goes on from the folder's own checkpoint adds to the files of the earlier run; any
    other run replaces them. Either removes nothing before its first step is written. Methods are collective.
    """

    def __init__(
        self, place: Place, world: World, about: dict[str, Any], save: Callable[[Path], None],
        compare: Callable[[], dict[str, Any]], every: int, checkpoint_every: int,
    ):  # fmt: skip
        """``about``: what settings.json says; ``compare()``: the summary of the compared preconditioners."""
        self.place, self._world, self._save, self._compare, self.comm = place, world, save, compare, world.comm
        self._every, self._checkpoint_every = every, checkpoint_every
        self._start = self._recorded = self._saved = world.step
        self._kept_steps = world.step if place.goes_on else 0
        self._first_frame: int | None = None
        self._begun = self._stands = self._stale = False
        self.analysis: dict[str, float] | None = None  #: the scene's numbers of all steps so far
        smallest = float(bodies.least_half_thickness(world.grains).min(initial=np.inf))
        radius = self.comm.allreduce(smallest, MPI.MIN)
        self._about = {**about, "bodies": world.body_count, "ranks": self.comm.size, "smallest_radius [m]": radius}
        on_first(self.comm, self._lines, lambda: sum(1 for _ in self._kept()))  # which can be gone on with

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

    def _kept(self) -> Iterator[str]:
        """The lines of the steps that stay of an earlier run; FileError if one is damaged."""
        for line in disk.lines(self._lines):
            try:
                step = json.loads(line)["step"]
            except (LookupError, TypeError, ValueError) as error:
                raise FileError(f"{self._lines}: cannot be continued ({error})") from None
            if step <= self._kept_steps:
                yield line

    def record(self, step: Step, row: Mapping[str, float]) -> None:
        """Write the frame of a step, with the row of its records, if that is due."""
        if self._every and step.world.step % self._every == 0:
            self._record(step, row)

    def add(self, line: Mapping[str, Any], row: Mapping[str, float]) -> None:
        """Write the figures of a step with the row of its records, and the checkpoint if that is due."""
        self.place.make()
        on_first(self.comm, self._lines, lambda: self._add(dumps({**line, "record": row})))
        # after the figures: a run that goes on from the checkpoint must find the step
        if (self._world.step - self._start) % self._checkpoint_every == 0:
            self._checkpoint()
        if not self._stands:
            self.place.take()
            on_first(self.comm, self.place.folder, lambda: self._remove_later(Path(line["hard_problem"]).name))
            self._stands = True
        self.analysis, self._stale = None, True

    def _add(self, line: str) -> None:
        """The first line replaces the file, with the lines that stay; every other one is a single write."""
        if self._begun:
            disk.append(self._lines, line)
            return
        write_text(self.place.now / "settings.json", dumps(self._about, indent=1) + "\n")
        with disk.whole(self._lines) as temporary, open(temporary, "w") as file:
            file.writelines(f"{text}\n" for text in chain(self._kept(), [line]))
        self._begun = True

    def complete(self, step: Step, row: Mapping[str, float]) -> None:
        """Write the frame and the checkpoint of the last step, if they are not there, and what follows from all."""
        if self._every and self._recorded < self._world.step:
            self._record(step, row)
        if self._saved < self._world.step:
            self._checkpoint()
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
        found = scene.analyse(records)
        figures = {name: float(value) for name, value in found.items() if np.ndim(value) == 0}
        series = {name: np.asarray(value) for name, value in found.items() if name not in figures}
        if series:
            leading = {name: records[name] for name in list(records)[:2]}
            _write_table(self.place.now / "analysis.csv", {**leading, **series})
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
        self._save(self.checkpoint)
        self._saved = self._world.step

    def _record(self, step: Step, row: Mapping[str, float]) -> None:
        """Write the state at the end of a step, the contacts and impulses that led to it, and the row of its records
        as attributes of the group `record`.

        Bodies are in the order of their ids (grains, then large bodies).
        """
        world, contacts, frames = step.world, step.contacts, self.place.now / "frames"
        if self._first_frame is None:
            self.place.make("frames")
            rows = _by_id(world, ("shape", "size", "mass", "material"))
            large = np.bytes_(json.dumps(described_bodies(world)))
            shared = {"materials": texts(world.materials), "large": large}
            write_rows(frames / "bodies.h5", self.comm, rows, shared, {})
            self._first_frame = world.step
        near = contacts.near.bodies
        rows = {
            **_by_id(world, ("position", "quaternion", "velocity")),
            "contact/key": contacts.key,
            "contact/body": np.stack([near.id[contacts.a], near.id[contacts.b]], axis=1),
            "contact/point": contacts.point,
            "contact/frame": step.system.frame,
            "contact/gap": contacts.gap,
            "contact/impulse": step.impulse,
        }
        about = {"/": {"step": world.step, "time": world.time}, "record": row, "contact": {"dt": step.system.dt}}
        write_rows(frames / f"{world.step:06d}.h5", self.comm, rows, {}, about)
        self._recorded = world.step

    def _remove_later(self, hard: str) -> None:
        """Remove what followed from an earlier run's steps, and its later steps, but not those of this run's first
        step, such as the file ``hard``."""
        folder, kept = self.folder, self._kept_steps
        for name in DERIVED:  # first of all: no link is without its file
            (folder.path / name).unlink(missing_ok=True)
        for step in folder.steps:
            if step > kept and step != self._first_frame:
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
    return json.loads(json.dumps(large, default=list))  # arrays as lists


def _by_id(world: World, names: Sequence[str]) -> dict[str, np.ndarray]:
    """Columns of the table of all bodies, in the order of their ids, spread over the ranks; collective."""
    grains, comm = world.grains, world.comm
    columns = {"id": grains.id, **{name: getattr(grains, name) for name in names}}
    starts = np.arange(comm.size + 1) * int(world.slabs[-1]) // comm.size
    rows = exchange(comm, columns, np.searchsorted(starts, grains.id, side="right") - 1)
    order, last = np.argsort(rows["id"]), comm.rank == comm.size - 1
    large = {name: getattr(world.large, name) for name in names}
    return {name: np.concatenate([rows[name][order], large[name] if last else large[name][:0]]) for name in names}
