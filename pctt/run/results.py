"""The output folder of a run.

    state.h5         group steps/000012 per recorded step, each a link to its own file in frames/
    frames/          one file per recorded step, and bodies.h5 with what no step changes; state.h5 links to it
    records.csv      a row per step, see ``dem.record`` and ``pctt.run.records``
    analysis.csv     the series that the scene makes of them at the end
    checkpoint.h5    all that ``-restart`` needs
    summary.json     figures per step, and of the compared preconditioners
    hard/            cone problems that the asked-for solver did not solve

Every file is written under a temporary name and renamed, so that a killed run leaves whole files only.
"""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from mpi4py import MPI

from dem import bodies
from dem.contact.search import Contacts
from dem.exchange import exchange
from dem.system import ContactSystem
from dem.world import World
from pctt.disk import reserve
from pctt.run.dump import HARD
from pctt.run.hdf5 import FileError, RowWriter, write_text, written
from pctt.run.records import Records


class Results:
    """Writes the output folder.

    A run that goes on from this folder's own checkpoint adds to what the earlier one left; any other replaces it.
    """

    def __init__(self, folder: Path, comm: MPI.Comm, record: str, world: World, restart: str):
        self.folder, self.comm, self.record = folder, comm, record
        self.checkpoint = folder / "checkpoint.h5"
        self._frames = folder / "frames"
        self._described = False
        self._recorded: list[int] = []
        self._steps: list[dict[str, Any]] = []
        smallest = float(bodies.least_half_thickness(world.grains).min(initial=np.inf))
        self._smallest_radius = comm.allreduce(smallest, MPI.MIN)
        goes_on = comm.bcast(bool(restart) and Path(restart).resolve() == self.checkpoint.resolve())
        if comm.rank == 0:
            try:
                self._frames.mkdir(parents=True, exist_ok=True)
                self._take_over(world, goes_on)
            except OSError as error:
                raise FileError(f"{folder}: cannot write ({error.strerror})", alone=True) from None
        comm.Barrier()
        self.records = Records(folder, comm, kept_steps=world.step if goes_on else 0)

    def _take_over(self, world: World, goes_on: bool) -> None:
        """Keep what is there up to the step from which this run goes on, and remove the rest."""
        try:
            old = json.loads((self.folder / "summary.json").read_text()) if goes_on else {}
        except (OSError, ValueError):
            old = {}
        self._steps = [line for line in old.get("steps", []) if line["step"] <= world.step]
        frames = {int(path.stem): path for path in self._frames.glob("*.h5") if path.stem.isdigit()}
        self._recorded = sorted(step for step in frames if goes_on and step <= world.step)
        # first the links, then what they led to: a run killed in between leaves no link without a file
        if self._recorded:
            self._link_frames(world)
        else:
            (self.folder / "state.h5").unlink(missing_ok=True)
        for step in frames.keys() - set(self._recorded):
            frames[step].unlink()
        for path in (self.folder / HARD).glob("step??????_*its.h5"):
            if not goes_on or int(path.name[4:10]) > world.step:
                path.unlink()

    def record_step(
        self, world: World, contacts: Contacts, system: ContactSystem, impulse: np.ndarray, row: dict[str, float]
    ) -> None:
        """Write the state at the end of a step, the contacts and impulses that led to it, and the row of its records
        as attributes of the group `record`; collective.

        Bodies are in the order of their ids (grains, then large bodies).
        """
        if not self._described:
            with written(self._frames / "bodies.h5", self.comm) as file:
                _write_constants(file, world)
            self._described = True
        name = f"{world.step:06d}.h5"
        with written(self._frames / name, self.comm) as file:
            file.attributes("/", {"step": world.step, "time": world.time})
            file.attributes("record", row)
            _write_bodies(file, world)
            near = contacts.near.bodies
            file.rows("contact/key", contacts.key)
            file.rows("contact/body", np.stack([near.id[contacts.a], near.id[contacts.b]], axis=1))
            file.rows("contact/point", contacts.point)
            file.rows("contact/frame", system.frame)
            file.rows("contact/gap", contacts.gap)
            file.rows("contact/impulse", impulse)
            file.attributes("contact", {"dt": system.dt})
        if self.comm.rank == 0:
            self._recorded.append(world.step)
            self._link_frames(world)

    def _link_frames(self, world: World) -> None:
        temporary = self.folder / ".state.h5.tmp"
        try:
            reserve(temporary, 1024, items=len(self._recorded))
            self._write_links(temporary, world)
            temporary.replace(self.folder / "state.h5")
        except OSError as error:
            temporary.unlink(missing_ok=True)
            raise FileError(f"{self.folder / 'state.h5'}: cannot write ({error.strerror})", alone=True) from None

    def _write_links(self, path: Path, world: World) -> None:
        with h5py.File(path, "w") as file:
            file.attrs["scene"] = self.record
            file.attrs["large_bodies"] = [body.name for body in world.large_bodies]
            file.attrs["contents"] = (
                "steps/STEP: position m, quaternion (w, x, y, z), velocity m/s and rad/s, by body id; "
                "record: attributes as in records.csv; "
                "contact: bodies a and b, point m, frame rows (normal from a to b, t1, t2), gap m, "
                "impulse on b N s; attribute dt s. bodies: shape, size m, mass kg, material by body id; "
                "large: names and shapes of the large bodies, the last of the ids, in their frames"
            )
            file["bodies"] = h5py.ExternalLink("frames/bodies.h5", "/")
            for step in self._recorded:
                file[f"steps/{step:06d}"] = h5py.ExternalLink(f"frames/{step:06d}.h5", "/")

    def worst_overlap(self) -> dict[str, float]:
        """The deepest overlap at the start of a step so far, the step, and the radius of the smallest grain (half the
        least side of a box); on rank 0."""
        deepest = max(self._steps, key=lambda line: line.get("worst_overlap", 0.0), default={})
        return {
            "overlap [m]": deepest.get("worst_overlap", 0.0),
            "step": deepest.get("step", 0),
            "smallest_radius [m]": self._smallest_radius,
        }

    def write_summary(
        self,
        world: World,
        compare: dict[str, Any],
        line: dict[str, Any] | None = None,
        analysis: dict[str, float] | None = None,
    ) -> None:
        """Write summary.json with what is known so far, the figures of a new step and those of the analysis."""
        if self.comm.rank != 0:
            return
        if line is not None:
            self._steps.append(line)
        totals = {"bodies": world.body_count, "ranks": self.comm.size, "compare": compare}
        totals["worst_overlap"] = self.worst_overlap()
        scene = json.loads(self.record)
        summary = {**totals, "scene": scene, "analysis": analysis or {}, "steps": self._steps}
        write_text(self.folder / "summary.json", json.dumps(_finite(summary), indent=1) + "\n")


def _finite(value: Any) -> Any:
    """The same with null for numbers that JSON has no word for."""
    if isinstance(value, dict):
        return {name: _finite(item) for name, item in value.items()}
    if isinstance(value, list):
        return [_finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _write_bodies(file: RowWriter, world: World) -> None:
    _write_by_id(file, world, ("position", "quaternion", "velocity"))


def _write_constants(file: RowWriter, world: World) -> None:
    """What no step changes: columns of the table of bodies, and the shapes of the large ones as JSON."""
    _write_by_id(file, world, ("shape", "size", "mass", "material"))
    large = [
        {"name": body.name, "shapes": [{"kind": type(s).__name__, **dataclasses.asdict(s)} for s in body.shapes]}
        for body in world.large_bodies
    ]
    file.whole("large", np.bytes_(json.dumps(large, default=list)))  # arrays as lists


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
