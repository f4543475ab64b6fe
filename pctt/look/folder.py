"""Reading the output folder of a run."""

from __future__ import annotations

import csv
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from dem.bodies import enclosing_radius
from pctt import disk, figures_json


class FolderError(RuntimeError):
    """The folder lacks data that a program needs; the message names the folder and says what to do."""


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
    """The output folder of ``python -m pctt.run``. Raises FolderError if the folder is not one.

    Attributes: ``path``; ``summary`` (dict) has the contents of summary.json; ``steps`` (list) has the numbers of the
    recorded steps, for `frame`. The numbers come from the files in frames/, because state.h5 may lack the last steps
    while the run continues.
    """

    def __init__(self, path: str | Path):
        self.path = Path(path)
        summary = self.path / "summary.json"
        if not self.path.is_dir():
            raise FolderError(f"{path}: no such folder; it is the -output of python -m pctt.run")
        try:
            self.summary: dict[str, Any] = json.loads(summary.read_text())
        except (OSError, ValueError) as error:
            raise FolderError(f"{path}: no output folder of python -m pctt.run (summary.json: {error})") from None
        self._frames = self.path / "frames"
        self.steps = sorted(int(path.stem) for path in self._frames.glob("*.h5") if path.stem.isdigit())

    def require_frames(self) -> None:
        """Read the shapes of the bodies; FolderError if these, or recorded steps, are missing."""
        if not self.steps:
            raise FolderError(f"{self.path}: no recorded steps; run with -output_every 1 or more")
        try:
            with h5py.File(self.bodies_path, "r") as file:
                self.shape: np.ndarray = file["shape"][()]
                self.size: np.ndarray = file["size"][()]
                self.mass: np.ndarray = file["mass"][()]
                self.material: np.ndarray = file["material"][()]
                #: names of the materials by their numbers; folders of earlier versions have no names
                names = file["materials"][()] if "materials" in file else np.arange(self.material.max() + 1).astype("S")
                self.materials: list[str] = [name.decode() for name in names]
                #: name and shapes of each large body, the rows after the grains
                self.large: list[dict[str, Any]] = json.loads(file["large"][()])
        except (KeyError, OSError) as error:
            raise FolderError(f"{self.bodies_path}: lacks the shapes of the bodies; run again ({error})") from None
        self.grains = len(self.shape) - len(self.large)

    @property
    def radius(self) -> np.ndarray:
        """Radii (grains,) of the spheres that enclose the grains [m]."""
        return enclosing_radius(self.shape[: self.grains], self.size[: self.grains])

    def frame(self, step: int) -> Frame:
        """A recorded step; FolderError if its file is damaged."""
        path = self.frame_path(step)
        try:
            with h5py.File(path, "r") as group:
                contact = group["contact"]
                rows = [contact[name][()] for name in ("body", "point", "frame", "gap", "impulse")]
                contacts = Contacts(*rows, float(contact.attrs["dt"]))  # type: ignore[call-arg]
                bodies = {name: group[name][()] for name in ("position", "quaternion", "velocity")}
                return Frame(step, float(group.attrs["time"]), **bodies, contacts=contacts)
        except (KeyError, OSError) as error:
            raise FolderError(f"{path}: incomplete ({error})") from None

    @property
    def bodies_path(self) -> Path:
        """The file with the data that no step changes."""
        return self._frames / "bodies.h5"

    def frame_path(self, step: int) -> Path:
        """The file of a recorded step."""
        return self._frames / f"{step:06d}.h5"

    def lines(self) -> list[dict[str, Any]]:
        """The figures of each step, in the order of the steps, from steps.jsonl; an empty list if the file is missing.

        Values that JSON has no number for (infinity and NaN) are infinite.
        """
        path = self.path / "steps.jsonl"
        try:
            return [figures_json.loads(line) for line in disk.lines(path)]
        except (OSError, ValueError) as error:
            raise FolderError(f"{path}: no list of steps ({error})") from None

    def records(self) -> dict[str, np.ndarray]:
        """Columns of records.csv by their heads, such as ``force_blade_x [N]``; empty if the file is missing."""
        return self._table("records.csv")

    def analysis(self) -> dict[str, np.ndarray]:
        """Columns of analysis.csv by their heads; empty if its rows do not match those of records.csv."""
        found, records = self._table("analysis.csv"), self.records()
        same = found and records and np.array_equal(found["time [s]"], records["time [s]"])
        return found if same else {}

    def _table(self, name: str) -> dict[str, np.ndarray]:
        path = self.path / name
        if not path.exists():
            return {}
        rows = list(csv.reader(disk.lines(path)))
        try:
            head, table = rows[0], np.array([[float(cell or "nan") for cell in row] for row in rows[1:]])
            columns = dict(zip(head, table.reshape(-1, len(head)).T))
            columns["time [s]"]
        except (IndexError, KeyError, ValueError) as error:
            raise FolderError(f"{path}: no table of numbers with a column time [s] ({error})") from None
        return columns


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
