"""The output folder of a run: its layout, and how to read it.

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

`pctt.run.output` writes the files of the first list.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from mpi4py import MPI

from dem import bodies
from dem.arrays import Tabular
from pctt import disk, json_text
from pctt.disk import FileError, same_rows, write_text

#: The columns of the bodies: where they are, and what they are; those of the latter but ids are in bodies.h5.
PLACES, TABLE = ("position", "quaternion", "velocity"), ("id", "shape", "size", "mass", "material")
HARD = "hard"  # folder of the cone problems that were not solved
DERIVED = ("state.h5", "records.csv", "summary.json", "analysis.csv")
#: The files of a run in its folder, and with its folders all that it leaves.
RUN_FILES = ("settings.json", "steps.jsonl", "checkpoint.h5", *DERIVED)
FILES = (*RUN_FILES, "frames", HARD)

CONTENTS = (
    "steps/STEP: position m, quaternion (w, x, y, z), velocity m/s and rad/s, start m, the position before the step, "
    "by body id; attributes of a periodic cell: lattice m, the ways to the next images along each axis, drift m/s, "
    "their velocities, and rate 1/s, with which the periods grew; "
    "record: attributes as in records.csv; "
    "contact: bodies a and b, point m as seen from a, moved m from b to where it is as seen from a, "
    "frame rows (normal from a to b, t1, t2), gap m, "
    "impulse on b N s, and moment on b in the world N m where contacts resist rolling or spinning; attribute dt s. "
    "bodies: shape, size m, mass kg, material by body id; "
    "materials: the names of the materials, of which material is the index; "
    "large: names and shapes of the large bodies, the last of the ids, in their frames"
)
LINKS = (
    "This file holds nothing but links to the folder frames beside it, and is empty without that folder. "
    "python -m pctt.export FOLDER -single FILE.h5 makes one file of all."
)


def totals(steps: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return the figures of a whole run, from those of its steps; nothing of no steps."""
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
        **{
            name: sum(line[name] for line in steps)
            for name in ("iterations", "newton_its", "ksp_its", "fallbacks", "seconds")
        },
        "not_converged": sum(not line["converged"] for line in steps),
        "squeezed": sum(line["status"] == "squeezed" for line in steps),  # of those
        "energy_jumps": sum(line.get("energy_jump", 0.0) > 0.0 for line in steps),
        **{
            name: max(line[name] for line in steps)
            for name in ("natural_residual", "coulomb_residual", "peak_memory")
        },
        "worst_overlap": {"overlap [m]": worst["worst_overlap"], "step": worst["step"]},
        "phases": {name: sum(line["phases"].get(name, 0.0) for line in steps) for name in names},
    }


# -- reading -------------------------------------------------------------------------------------------------

@dataclass(frozen=True, repr=False)
class Contacts(Tabular):
    """The contacts of a step between bodies a and b, and the impulses that acted in the step."""

    bodies: np.ndarray  #: (nc, 2) numbers of a and b in the order of the scene: grains, then large bodies
    point: np.ndarray  #: (nc, 3) on a, in an overlap between both, as seen from a at the start of the step [m]
    frame: np.ndarray  #: (nc, 3, 3) with rows normal (from a to b), t1, t2
    gap: np.ndarray  #: (nc,) at the start of the step, negative if the bodies overlap [m]
    impulse: np.ndarray  #: (nc, 3) on b, in the contact frame [N s]
    dt: float  #: length of the step in which the impulses acted [s]
    moment: np.ndarray | None = None  #: (nc, 3) on b in the world, where contacts resist rolling or spinning [N m]
    moved: np.ndarray | None = None  #: (nc, 3) from body b to where it is as seen from a; None in files before 0.3 [m]

    @classmethod
    def none(cls) -> Contacts:
        """Those of no step."""
        vectors = np.zeros((0, 3))
        return cls(np.zeros((0, 2), np.int64), vectors, np.zeros((0, 3, 3)), np.zeros(0), vectors, 1.0)

    def __len__(self) -> int:
        return len(self.gap)

    def flat(self) -> dict[str, np.ndarray]:
        """Columns (nc,) by name: bodies a and b, and of point [m], normal and force [N] x, y, z; gap [m]."""
        found = {"a": self.bodies[:, 0], "b": self.bodies[:, 1], "gap": self.gap}
        vectors = {"point": self.point, "normal": self.normal, "force": self.force}
        return found | {f"{name}_{'xyz'[k]}": array[:, k] for name, array in vectors.items() for k in range(3)}

    @property
    def normal(self) -> np.ndarray:
        """Unit vectors (nc, 3) from a to b."""
        return self.frame[:, 0]

    @property
    def force(self) -> np.ndarray:
        """Mean forces (nc, 3) on b in the step, in the world frame [N]."""
        return np.einsum("ci,cij->cj", self.impulse, self.frame) / self.dt


@dataclass(frozen=True, repr=False)
class Frame:
    """A recorded step. The rows of the arrays are the bodies in the order of their ids: first the grains, then the
    large bodies."""

    step: int
    time: float  #: [s]
    position: np.ndarray  #: (n, 3) [m]
    quaternion: np.ndarray  #: (n, 4) (w, x, y, z)
    velocity: np.ndarray  #: (n, 6) linear [m/s] and angular [rad/s]
    contacts: Contacts  #: their bodies are rows
    table: Table  #: what the bodies are
    #: (3, 3) ways to the next images along each axis [m], and their velocities [m/s]; 0: no period, or an older file
    lattice: np.ndarray = field(default_factory=lambda: np.zeros((3, 3)))
    drift: np.ndarray = field(default_factory=lambda: np.zeros((3, 3)))
    rate: np.ndarray = field(default_factory=lambda: np.zeros(3))  #: (3,) with which periods grew in the step [1/s]
    start: np.ndarray | None = None  #: (n, 3) positions before the step, maybe in another cell; None in older files [m]

    def __repr__(self) -> str:
        bodies, contacts = len(self.position), len(self.contacts)
        return f"<Frame of step {self.step}, time {self.time:g} s: {bodies} bodies, {contacts} contacts>"

    @property
    def speed(self) -> np.ndarray:
        """Speeds (n,) of the centres [m/s]."""
        return np.linalg.norm(self.velocity[:, :3], axis=1)

    def load(self) -> np.ndarray:
        """Sums (n,) of the magnitudes of the contact forces on each body [N]."""
        size = np.linalg.norm(self.contacts.force, axis=1)
        return np.bincount(self.contacts.bodies.ravel(), np.repeat(size, 2), minlength=len(self.position))


@dataclass(frozen=True)
class Table:
    """What the bodies of a frame are, in its rows."""

    id: np.ndarray  #: (n,)
    shape: np.ndarray  #: (n,) kinds, as of `dem.bodies`
    size: np.ndarray  #: (n, 3) [m]
    mass: np.ndarray  #: (n,) [kg]
    material: np.ndarray  #: (n,)
    grains: int  #: the first rows
    forms: Sequence[dict[str, Any]] = ()  #: kinds, and surfaces as of `dem.shapes.forms.Form.described`

    @property
    def radius(self) -> np.ndarray:
        """Radii (grains,) of the spheres that enclose the grains [m]."""
        return bodies.enclosing_radius(self.shape[: self.grains], self.size[: self.grains])


class Folder:
    """The output folder of a run. Raises FileError if the folder is not one.

    Attributes: ``path``; ``steps`` (list) has the numbers of the recorded steps, for `frame`.
    """

    def __init__(self, path: str | Path):
        self.path = Path(path)
        if not self.path.is_dir():
            raise FileError(f"{path}: no such folder of a run")
        if not any((self.path / name).is_file() for name in ("settings.json", "steps.jsonl", "summary.json")):
            raise FileError(f"{path}: no output folder of python -m pctt.run (it has no steps.jsonl)")
        self.steps = sorted(int(path.stem) for path in self._frames.glob("*.h5") if path.stem.isdigit())

    def __repr__(self) -> str:
        steps = f", {self.steps[0]} to {self.steps[-1]}" if self.steps else ""
        return f"<Folder {str(self.path)!r}: {len(self.steps)} recorded steps{steps}>"

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

    @property
    def lost(self) -> list[int]:
        """The recorded steps to which state.h5 leads without an end."""
        try:
            with h5py.File(self.path / "state.h5", "r") as file:
                return sorted({int(name) for name in file["steps"]} - {*self.steps})
        except (KeyError, OSError, ValueError):  # it is made again from what is there
            return []

    def require_frames(self) -> None:
        """Read the shapes of the bodies; FileError if these, or recorded steps, are missing."""
        if not self.steps:
            raise FileError(f"{self.path}: no recorded steps; -output_every, or write(every=...), makes them")

        def take(file: h5py.File) -> list[Any]:
            same_rows(file, TABLE[1:])
            forms = file["forms"][()] if "forms" in file else "[]"
            return [*(file[name][()] for name in (*TABLE[1:], "materials", "large")), forms]

        found = disk.read(self.bodies_path, MPI.COMM_SELF, take, sealed=False)
        self.shape, self.size, self.mass, self.material = found[:4]
        #: names of the materials by their numbers; name and shapes of each large body, the rows after the grains
        self.materials: list[str] = [name.decode() for name in found[4]]
        self.large: list[dict[str, Any]] = json_text.read(found[5])
        self.forms: list[dict[str, Any]] = json_text.read(found[6])
        self.grains = len(self.shape) - len(self.large)

    @property
    def table(self) -> Table:
        """What the bodies are; in scenes with sources or outlets those of the first frame, and each frame has its
        own."""
        columns = np.arange(len(self.shape)), self.shape, self.size, self.mass, self.material
        return Table(*columns, self.grains, self.forms)

    @property
    def radius(self) -> np.ndarray:
        """Radii (grains,) of the spheres that enclose the grains [m]."""
        return self.table.radius

    def frame(self, step: int) -> Frame:
        """A recorded step; FileError if there is no such step, or if its file is damaged."""
        if not isinstance(step, (int, np.integer)) or not self.frame_path(step).exists():
            raise FileError(f"no step {step!r} in {self!r}")
        if not hasattr(self, "large"):
            self.require_frames()

        def take(file: h5py.File) -> Frame:
            contact, names = file["contact"], ("body", "point", "frame", "gap", "impulse")
            same_rows(file, (f"contact/{name}" for name in (*names, "moment", "moved") if name in contact))
            rows = [contact[name][()] for name in names]
            moment, moved = (contact[name][()] if name in contact else None for name in ("moment", "moved"))
            columns = [*PLACES, *(["start"] if "start" in file else [])]
            same_rows(file, (*columns, *(TABLE if "id" in file else ())), None if "id" in file else len(self.shape))
            places = {name: file[name][()] for name in columns}
            if "id" in file:  # of a scene with sources or outlets
                own = {name: file[name][()] for name in TABLE}
                count = len(own["id"]) - len(self.large)
                table = Table(**own, grains=count, forms=self.forms)
                rows[0] = np.searchsorted(table.id, rows[0])
            else:
                table = self.table
            contacts = Contacts(*rows, float(contact.attrs["dt"]), moment, moved)  # type: ignore[call-arg]
            cell = {name: file.attrs[name] for name in ("lattice", "drift", "rate") if name in file.attrs}
            return Frame(step, float(file.attrs["time"]), **places, contacts=contacts, table=table, **cell)

        return disk.read(self.frame_path(step), MPI.COMM_SELF, take, sealed=False)

    def lines(self) -> list[dict[str, Any]]:
        """The figures of each step, in the order of the steps, from steps.jsonl; an empty list if the file is missing.

        Values that JSON has no number for (infinity and NaN) are infinite.
        """
        path = self.path / "steps.jsonl"
        try:
            return [json_text.figures(line) for line in disk.lines(path)]
        except (OSError, ValueError) as error:
            raise FileError(f"{path}: no list of steps ({error})") from None

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
            raise FileError(f"{path}: no table of numbers with a column time [s] ({error})") from None

    @property
    def summary(self) -> dict[str, Any]:
        """What summary.json has, or would have: one of other steps than steps.jsonl is of a run before, which one that
        was killed went on from."""
        found, lines = self._json("summary.json"), self.lines()
        stale = bool(lines) and found.get("steps") != len(lines)
        return self._summary(lines) if stale or not found else found

    def _json(self, name: str) -> dict[str, Any]:
        """A file's contents; nothing if there is none. FileError if it is no JSON."""
        path = self.path / name
        try:
            return json_text.read(path.read_text()) if path.exists() else {}
        except (OSError, ValueError) as error:
            raise FileError(f"{path}: no figures ({error})") from None

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
            write_table(self.path / "records.csv", _records(lines))
        write_text(self.path / "summary.json", json_text.written(self._summary(lines, **more), indent=1) + "\n")
        if self.steps:
            self._link()

    def _link(self) -> None:
        """Let state.h5 lead to all recorded steps."""
        self.require_frames()
        with disk.whole(self.path / "state.h5") as temporary, disk.hdf5(temporary) as file:
            file.attrs["scene"] = json_text.written(self._json("settings.json").get("scene", {}))
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


def write_table(path: Path, columns: Mapping[str, np.ndarray]) -> None:
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
        self, frame: Frame, materials: Sequence[str], large: list[dict[str, Any]],
    ):  # fmt: skip
        self.path, self.steps, self._present = Path(), [frame.step], frame
        self.shape, self.size, self.mass = frame.table.shape, frame.table.size, frame.table.mass
        self.material, self.materials, self.large = frame.table.material, [*materials], large
        self.grains, self.forms = frame.table.grains, [*frame.table.forms]

    def frame(self, step: int) -> Frame:
        return self._present
