"""The output folder of a run.

    state.h5         group steps/000012 per recorded step, each a link to its own file in frames/
    frames/          one file per recorded step, and bodies.h5 with what no step changes
    records.csv      a row per step, see ``dem.record`` and ``pctt.run.records``
    steps.jsonl      what each step took and how well it was solved, a JSON object per line
    analysis.csv     the series that the scene makes of the records at the end
    checkpoint.h5    all that ``-restart`` needs
    summary.json     figures of the whole run, and of the compared preconditioners
    hard/            cone problems that the asked-for solver did not solve

The data written per step do not grow with the number of steps. Tables get a line with one write; every other file is
written under a temporary name and renamed. So a killed run leaves whole files.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from mpi4py import MPI

from dem import bodies
from dem.exchange import exchange
from dem.experiment import Experiment
from dem.impulses import ImpulseMemory
from dem.shapes import described
from dem.step import Step
from dem.together import together
from dem.world import World
from pctt import disk, figures_json
from pctt.ccp import Comparison
from pctt.run import checkpoint, totals
from pctt.run.hdf5 import FileError, RowWriter, replaced, told, write_text, written
from pctt.run.lines import StepLines
from pctt.run.place import HARD, Place
from pctt.run.records import Records

#: state.h5 is written anew when this part of its links is missing: so many links a step, however many there are.
LAG = 0.01

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


class Results:
    """Writes the files of a run: of each step by `record` and then `add`, and at the end by `complete` and `analyse`.

    A frame of state.h5 is recorded every ``every`` steps (0: never), a checkpoint written every ``checkpoint_every``.
    A run that continues from the folder's own checkpoint adds to the files of the earlier run; any other run replaces
    them. Either removes nothing before its first step ``stands``. Methods are collective.
    """

    def __init__(
        self, place: Place, world: World, memory: ImpulseMemory, made_with: dict[str, Any], compare: Comparison,
        every: int, checkpoint_every: int,
    ):  # fmt: skip
        self.place, self._world, self._memory, self._made_with, self._compare = place, world, memory, made_with, compare
        self.comm = comm = world.comm
        self._every, self._checkpoint_every = every, checkpoint_every
        self._start = self._recorded = self._saved = self._analysed = world.step
        self._kept_steps = world.step if place.goes_on else 0
        self._links = self._unlinked = 0  # in state.h5, and recorded since it was written
        self._first_frame: int | None = None
        self._stands = False
        smallest = float(bodies.least_half_thickness(world.grains).min(initial=np.inf))
        self._smallest_radius = comm.allreduce(smallest, MPI.MIN)
        self.records = Records(place, comm, self._kept_steps)
        self._steps = StepLines(place, "steps.jsonl", _step_of, self._kept_steps)
        self._totals: totals.Totals = {}
        if comm.rank == 0:
            try:
                self._totals = totals.of(self.steps())
            except (OSError, LookupError, ValueError) as error:
                raise FileError(f"{self._steps.path}: cannot be continued ({error})", one_rank=True) from None

    @property
    def checkpoint(self) -> Path:
        return self.place.now / "checkpoint.h5"

    def record(self, step: Step, row: dict[str, float], last: bool) -> None:
        """Write the row of a step's records, and its frame if that is due, or if the step is the ``last``."""
        self.records.add(row)
        if self._every and (step.world.step % self._every == 0 or last):
            self._record(step, row)

    def add(self, line: dict[str, Any], last: bool) -> None:
        """Write the figures of a step, the summary with them, and the checkpoint if that is due."""
        if self.comm.rank == 0:
            self._steps.add(figures_json.dumps(line))
            self._totals = totals.add(self._totals, line)
        self._write_summary()
        # after the figures: a run that goes on from the checkpoint must find the step
        if (self._world.step - self._start) % self._checkpoint_every == 0 or last:
            self._save()
        self.stands(line)

    def complete(self, step: Step, row: dict[str, float]) -> None:
        """Write the frame and the checkpoint of the last step, if they are not there, and let state.h5 have all."""
        if self._every and self._recorded < self._world.step:
            self._record(step, row)
        if self._saved < self._world.step:
            self._save()
        self.link()

    def analyse(self, scene: Experiment) -> dict[str, float]:
        """The numbers that the scene finds in the records, which also go to summary.json; SceneError if it fails."""

        def analyse() -> dict[str, float]:
            return self.records.analyse(scene) if self.comm.rank == 0 else {}

        what = f"analyse of the scene {type(scene).__name__}"
        figures = self.comm.bcast(together(self.comm, what, analyse, own=(FileError,)))
        self._write_summary(figures)
        self._analysed = self._world.step
        return figures

    @property
    def analysed(self) -> bool:
        """Whether `analyse` has seen all steps."""
        return self._analysed == self._world.step

    def _save(self) -> None:
        checkpoint.save(self.checkpoint, self._made_with, self._world, self._memory)
        self._saved = self._world.step

    def _record(self, step: Step, row: dict[str, float]) -> None:
        """Write the state at the end of a step, the contacts and impulses that led to it, and the row of its records
        as attributes of the group `record`.

        Bodies are in the order of their ids (grains, then large bodies).
        """
        world, contacts, frames = step.world, step.contacts, self.place.now / "frames"
        if self._first_frame is None:
            self.place.make("frames")
            with written(frames / "bodies.h5", self.comm) as file:
                _write_constants(file, world)
            self._first_frame = world.step
        with written(frames / f"{world.step:06d}.h5", self.comm) as file:
            file.attributes("/", {"step": world.step, "time": world.time})
            file.attributes("record", row)
            _write_by_id(file, world, ("position", "quaternion", "velocity"))
            near = contacts.near.bodies
            file.rows("contact/key", contacts.key)
            file.rows("contact/body", np.stack([near.id[contacts.a], near.id[contacts.b]], axis=1))
            file.rows("contact/point", contacts.point)
            file.rows("contact/frame", step.system.frame)
            file.rows("contact/gap", contacts.gap)
            file.rows("contact/impulse", step.impulse)
            file.attributes("contact", {"dt": step.system.dt})
        self._recorded = world.step
        self._unlinked += 1
        if self._unlinked >= LAG * self._links:
            self.link()

    def link(self) -> None:
        """Let state.h5 lead to all recorded steps."""
        if self._unlinked and self.comm.rank == 0:
            self._link([step for step in self._frames() if step <= self._world.step])
        self._unlinked = 0

    def _link(self, steps: list[int]) -> None:
        path = self.place.now / "state.h5"
        with replaced(path) as temporary:
            disk.make_hdf5(temporary, numbers=4096 + 128 * len(steps), items=0)
            with h5py.File(temporary, "r+") as file:
                file.attrs["scene"] = self._made_with["scene"]
                file.attrs["large_bodies"] = [body.name for body in self._world.large_bodies]
                file.attrs["contents"], file.attrs["links"] = CONTENTS, LINKS
                file["bodies"] = h5py.ExternalLink("frames/bodies.h5", "/")
                for step in steps:
                    file[f"steps/{step:06d}"] = h5py.ExternalLink(f"frames/{step:06d}.h5", "/")
        self._links = len(steps)

    def _frames(self) -> list[int]:
        """The steps that are recorded in files."""
        return sorted(int(path.stem) for path in (self.place.now / "frames").glob("*.h5") if path.stem.isdigit())

    def steps(self) -> Iterator[dict[str, Any]]:
        """The figures of all steps, also of the earlier run that this one continues; on rank 0."""
        return map(figures_json.loads, self._steps)

    def stands(self, line: dict[str, Any]) -> None:
        """Say that the step with these figures is written. After the first one, the files that it replaces are
        removed."""
        if self._stands:
            return
        self.place.take()
        if self.comm.rank == 0:
            with told(self.place.folder):
                self._remove_later(Path(line["hard_problem"]).name)
        self._stands = True

    def _remove_later(self, hard: str) -> None:
        """Remove the files of an earlier run's later steps, but not those of this run's first step, such as the file
        ``hard``."""
        folder, kept = self.place.folder, self._kept_steps
        (folder / "analysis.csv").unlink(missing_ok=True)
        steps = self._frames()
        stay = [step for step in steps if step <= kept or step == self._first_frame]
        if stay != steps:
            self._link(stay)  # before the files go, so that a run killed in between leaves no link without one
        for step in set(steps) - set(stay):
            (folder / "frames" / f"{step:06d}.h5").unlink()
        for path in (folder / HARD).glob("step??????_*its.h5"):
            if int(path.name[4:10]) > kept and path.name != hard:
                path.unlink()

    def worst_overlap(self) -> dict[str, float]:
        """The deepest overlap at the start of a step so far, the step, and the radius of the smallest grain (half the
        least side of a box); on rank 0."""
        return {**self._totals["worst_overlap"], "smallest_radius [m]": self._smallest_radius}

    def _write_summary(self, analysis: dict[str, float] | None = None) -> None:
        """Write summary.json with what is known so far, and the figures of the analysis."""
        if self.comm.rank == 0:
            summary = {
                "scene": json.loads(self._made_with["scene"]),
                "bodies": self._world.body_count,
                "ranks": self.comm.size,
                **self._totals,
                "worst_overlap": self.worst_overlap(),
                "analysis": analysis or {},
                "compare": self._compare.summary(),
            }
            write_text(self.place.now / "summary.json", figures_json.dumps(summary, indent=1) + "\n")


def _step_of(line: str) -> int:
    return int(json.loads(line)["step"])


def _write_constants(file: RowWriter, world: World) -> None:
    """Write the data that are the same in all steps: columns of the table of bodies, the names of the materials, and
    the shapes of the large bodies as JSON."""
    _write_by_id(file, world, ("shape", "size", "mass", "material"))
    file.texts("materials", world.materials)
    file.whole("large", np.bytes_(json.dumps(described_bodies(world))))


def described_bodies(world: World) -> list[dict[str, Any]]:
    """The names and shapes of the large bodies, as JSON has them."""
    large = [
        {"name": body.name, "shapes": [described(shape) for shape in body.shapes]}
        for body in world.large_bodies
    ]
    return json.loads(json.dumps(large, default=list))  # arrays as lists


def _write_by_id(file: RowWriter, world: World, names: Sequence[str]) -> None:
    """Columns of the table of all bodies, in the order of their ids."""
    grains, comm = world.grains, world.comm
    columns = {"id": grains.id, **{name: getattr(grains, name) for name in names}}
    starts = np.arange(comm.size + 1) * int(world.slabs[-1]) // comm.size
    rows = exchange(comm, columns, np.searchsorted(starts, grains.id, side="right") - 1)
    order = np.argsort(rows["id"])
    last = comm.rank == comm.size - 1
    for name in names:
        large = getattr(world.large, name)
        file.rows(name, np.concatenate([rows[name][order], large if last else large[:0]]))
