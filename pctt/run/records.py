"""The records of a run: records.csv with a row per step, and analysis.csv with what the scene makes of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from mpi4py import MPI

from dem.experiment import Experiment
from pctt.run.hdf5 import FileError, write_text


class Records:
    """Writes records.csv, whole at every step; the first columns are the step and the time."""

    def __init__(self, folder: Path, comm: MPI.Comm, kept_steps: int):
        """Rows of earlier runs up to the step ``kept_steps`` stay, all others go; collective."""
        self._folder, self._comm = folder, comm
        self._lines: list[str] = []
        header, failure = None, None
        if comm.rank == 0:
            (folder / "analysis.csv").unlink(missing_ok=True)
            try:
                header = self._take_over(folder / "records.csv", kept_steps)
            except (OSError, ValueError) as error:
                failure = str(error)
        self._header, failure = comm.bcast((header, failure))
        if failure:
            raise FileError(f"{folder}/records.csv: cannot be continued ({failure})")

    def _take_over(self, path: Path, kept_steps: int) -> str | None:
        if not path.exists():
            return None
        header, *lines = path.read_text().splitlines() or [""]
        if kept_steps:
            self._lines = [line for line in lines if int(line.partition(",")[0]) <= kept_steps]
        if self._lines:
            return header
        path.unlink()
        return None

    def add(self, row: Mapping[str, float]) -> None:
        """Append the row of a step, the same on all ranks; collective. FileError if its names are not those of the
        rows before."""
        header = ",".join(row)
        if self._header not in (None, header):
            raise FileError(f"{self._folder}/records.csv: has other columns than this run, choose another -output")
        self._header = header
        if self._comm.rank == 0:
            step, *rest = row.values()
            self._lines.append(",".join([str(int(step)), *(repr(float(value)) for value in rest)]))
            write_text(self._folder / "records.csv", "\n".join([header, *self._lines]) + "\n")

    def columns(self) -> dict[str, np.ndarray]:
        """All rows as arrays by name; rank 0."""
        assert self._header is not None
        table = np.array([[float(cell) for cell in line.split(",")] for line in self._lines])
        return dict(zip(self._header.split(","), table.T))

    def analyse(self, scene: Experiment) -> dict[str, float]:
        """The scene's analysis of all rows: writes its series to analysis.csv and returns its numbers; rank 0."""
        records = self.columns()
        found = scene.analyse(records)
        figures = {name: float(value) for name, value in found.items() if np.ndim(value) == 0}
        series = {name: np.asarray(value) for name, value in found.items() if name not in figures}
        if series:
            leading = {name: records[name] for name in list(records)[:2]}
            write_text(self._folder / "analysis.csv", _table({**leading, **series}))
        return figures


def _table(columns: Mapping[str, Sequence[float] | np.ndarray]) -> str:
    lengths = {name: len(column) for name, column in columns.items()}
    if len(set(lengths.values())) > 1:
        raise ValueError(f"the arrays of analyse need one entry per record, their lengths are {lengths}")
    steps, *rest = columns.values()
    rows = (f"{int(step)}," + ",".join(repr(float(value)) for value in row) for step, *row in zip(steps, *rest))
    return "\n".join([",".join(columns), *rows]) + "\n"
