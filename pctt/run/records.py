"""The records of a run: records.csv with a row per step, and analysis.csv with the series that the scene derives from
them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from mpi4py import MPI

from dem.experiment import Experiment
from pctt.run.hdf5 import FileError, write_text
from pctt.run.lines import StepLines
from pctt.run.place import Place


class Records:
    """Writes records.csv, a row at every step; the first columns are the step and the time."""

    def __init__(self, place: Place, comm: MPI.Comm, kept_steps: int):
        """Rows of an earlier run in this place up to the step ``kept_steps`` stay; collective."""
        self._place, self._comm = place, comm
        header, failure = None, None
        if comm.rank == 0:
            try:
                header = self._take_over(kept_steps)
            except (OSError, ValueError) as error:
                failure = str(error)
        self._header, failure = comm.bcast((header, failure))
        if failure:
            raise FileError(f"{place.folder}/records.csv: cannot be continued ({failure})")

    def _take_over(self, kept_steps: int) -> str | None:
        """The header, if rows stay."""
        self._lines = StepLines(self._place, "records.csv", _step, kept_steps)
        header, *rows = [*self._lines] or [None]
        if rows:
            return header
        self._lines = StepLines(self._place, "records.csv", _step, last=-1)  # not even a header stays
        return None

    def add(self, row: Mapping[str, float]) -> None:
        """Append the row of a step, the same on all ranks; collective. FileError if its names differ from those of
        earlier rows."""
        header = ",".join(row)
        if self._header not in (None, header):
            path = self._place.folder / "records.csv"
            old, new = self._header.split(","), list(row)
            odd = ", ".join([name for name in old if name not in new] + [name for name in new if name not in old])
            remedy = "record must return the same names in all steps; for a run with others choose another -output"
            raise FileError(f"{path}: has other columns than step {row['step']:g} ({odd or 'their order'}); {remedy}")
        if self._comm.rank == 0:
            line = _row(*row.values())
            self._lines.add(line if self._header else f"{header}\n{line}")
        self._header = header

    def columns(self) -> dict[str, np.ndarray]:
        """All rows as arrays by name; rank 0."""
        header, *rows = self._lines
        table = np.array([[float(cell) for cell in row.split(",")] for row in rows])
        return dict(zip(header.split(","), table.T))

    def analyse(self, scene: Experiment) -> dict[str, float]:
        """The scene's analysis of all rows: writes its series to analysis.csv and returns its numbers; rank 0."""
        records = self.columns()
        found = scene.analyse(records)
        figures = {name: float(value) for name, value in found.items() if np.ndim(value) == 0}
        series = {name: np.asarray(value) for name, value in found.items() if name not in figures}
        if series:
            leading = {name: records[name] for name in list(records)[:2]}
            write_text(self._place.now / "analysis.csv", _table({**leading, **series}))
        return figures


def _step(line: str) -> int:
    """The step of a row; 0 of the header."""
    first = line.partition(",")[0]
    return 0 if first == "step" else int(first)


def _table(columns: Mapping[str, Sequence[float] | np.ndarray]) -> str:
    lengths = {name: len(column) for name, column in columns.items()}
    if len(set(lengths.values())) > 1:
        raise ValueError(f"the arrays of analyse need one entry per record, their lengths are {lengths}")
    rows = (_row(*values) for values in zip(*columns.values()))
    return "\n".join([",".join(columns), *rows]) + "\n"


def _row(step: float, *values: float) -> str:
    return ",".join([str(int(step)), *(repr(float(value)) for value in values)])
