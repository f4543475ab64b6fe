"""``python -m pctt.plot DIR``: figures of a run."""

from __future__ import annotations

import argparse
import sys
from functools import partial
from pathlib import Path

from mpi4py import MPI

from pctt.folder import Folder, FolderError
from pctt.look.program import made_folder, parser, run, whole

FORMATS = ("png", "pdf", "svg")


def arguments() -> argparse.Namespace:
    line = parser(
        "plot",
        "figures of a run: its steps, the columns of records.csv, the compared preconditioners, and, for one recorded"
        " step, the sparsity of the Newton matrix and the graphs of bodies and contacts",
    )
    line.add_argument("-step", type=int, help="recorded step of sparsity and graphs; without: the last with contacts")
    line.add_argument("-format", choices=FORMATS, default="png", help="kind of file")
    line.add_argument("-output", metavar="DIR", help="folder to write to; without: figures/ in the output folder")
    return line.parse_args()


def main(comm: MPI.Comm) -> None:
    given = arguments()
    if comm.rank != 0:
        return
    folder = Folder(given.folder)
    if given.step is not None and given.step not in folder.steps:
        there = f"there are {folder.steps[0]} to {folder.steps[-1]}" if folder.steps else "there is none"
        raise FolderError(f"-step {given.step}: {folder.path} has no such recorded step; {there}")
    target = made_folder(Path(given.output) if given.output else folder.path / "figures")

    import matplotlib as mpl

    from pctt.look import figures, structure

    with mpl.rc_context(figures.STYLE):  # type: ignore[arg-type]
        made = {}
        lines = folder.lines()
        if lines:
            made["steps"] = figures.steps(lines)
        columns = folder.records()
        if columns:
            made.update(figures.records(columns))
            made.update(figures.curves(columns, folder.analysis()))
        if folder.summary.get("compare"):
            made["compare"] = figures.compare(folder.summary["compare"])
        frame = _frame(folder, given.step)
        if frame is not None:
            made["sparsity"] = structure.sparsity(folder, frame)
            made["graphs"] = structure.graphs(folder, frame)
        if not made:
            raise FolderError(f"{folder.path}: nothing to plot: no steps, no comparison, no recorded contacts")
        for name, figure in made.items():
            with whole(target / f"{name}.{given.format}") as path:
                figure.savefig(path, format=given.format)
    print(f"{len(made)} figures: {target}/" + ", ".join(f"{name}.{given.format}" for name in made))


def _frame(folder: Folder, step: int | None):
    """The frame of ``step`` if it has contacts, by default the last frame with contacts; None without such a frame."""
    if not folder.steps:
        return None
    folder.require_frames()
    for candidate in [step] if step is not None else reversed(folder.steps):
        frame = folder.frame(candidate)
        if len(frame.contacts.gap):
            return frame
    return None


#: The command pctt-plot; its exit status.
program = partial(run, main, "plot")


if __name__ == "__main__":
    sys.exit(program())
