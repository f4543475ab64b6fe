"""``python -m pctt.plot DIR``: figures of a run."""

from __future__ import annotations

import sys
from functools import partial

from mpi4py import MPI

from pctt.disk import FileError, whole
from pctt.folder import Folder
from pctt.look.program import made_folder, parser, run


def main(comm: MPI.Comm) -> None:
    text = "figures of a run: its steps, the columns of records.csv, and the compared preconditioners"
    line = parser("plot", text, "figures", steps=False)
    line.add_argument("-format", choices=("png", "pdf", "svg"), default="png", help="kind of file")
    given = line.parse_args()
    if comm.rank != 0:
        return
    folder = Folder(given.folder)
    target = made_folder(given.output or folder.path / "figures")

    import matplotlib as mpl

    from pctt.look import figures

    with mpl.rc_context(figures.STYLE):  # type: ignore[arg-type]
        made = figures.figures(folder)
        if not made:
            raise FileError(f"{folder.path}: nothing to plot: no steps, no records, no comparison")
        for name, figure in made.items():
            path = target / f"{name}.{given.format}"
            with whole(path) as temporary:
                figure.savefig(temporary, format=given.format)
    print(f"{len(made)} figures: {target}/" + ", ".join(f"{name}.{given.format}" for name in made))


#: The command pctt-plot; its exit status.
program = partial(run, main, "plot")


if __name__ == "__main__":
    sys.exit(program())
