"""The folder of a run: whether it holds one already, and how another takes its place."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

from mpi4py import MPI

from pctt.run.hdf5 import told

HARD = "hard"  # folder of the cone problems that were not solved
#: What a run leaves in its folder.
FILES = ("state.h5", "records.csv", "steps.jsonl", "analysis.csv", "summary.json", "checkpoint.h5", "frames", HARD)


def held(folder: Path) -> list[str]:
    """What is there of a run; nothing if a run may write to the folder."""
    return [name for name in FILES if (folder / name).is_file() or any((folder / name).glob("*.h5"))]


def is_checkpoint_of(folder: Path, restart: str) -> bool:
    """Whether the file of ``-restart`` is the folder's own, so that a run goes on with what is there."""
    return bool(restart) and Path(restart).resolve() == (folder / "checkpoint.h5").resolve()


class Place:
    """The place where a run writes, ``now``. It is the run's ``folder``, unless that holds another run. Then it is a
    hidden folder in it until ``take`` replaces the other run, which stays untouched up to then.

    A run that ``goes_on`` from the folder's own checkpoint adds to the files of the earlier one.
    """

    def __init__(self, folder: Path, comm: MPI.Comm, restart: str = ""):
        """``restart`` is the value of -restart; collective."""
        self.folder, self._comm = folder, comm
        self.goes_on, replaces = False, False
        hidden = folder / ".new"
        if comm.rank == 0:
            self.goes_on = is_checkpoint_of(folder, restart)
            replaces = not self.goes_on and bool(held(folder))
            shutil.rmtree(hidden, ignore_errors=True)  # of a run that ended before its first step stood
        self.goes_on, replaces = comm.bcast((self.goes_on, replaces))
        self.now = hidden if replaces else folder

    def make(self, *names: str) -> None:
        """Make the folder, and folders within it; collective."""
        if self._comm.rank == 0:
            with told(self.folder):
                for name in (".", *names):
                    (self.now / name).mkdir(parents=True, exist_ok=True)
        self._comm.Barrier()

    def take(self) -> None:
        """Put what was written in the place of the earlier run; collective."""
        now, self.now = self.now, self.folder
        if now != self.folder and self._comm.rank == 0:
            with told(self.folder):
                _replace(self.folder, now)
        self._comm.Barrier()


def _replace(folder: Path, new: Path) -> None:
    """Renames come first, as a kill between two of them would leave parts of both runs."""
    old = new / ".old"
    old.mkdir()
    for name in FILES:
        for source, target in ((folder / name, old / name), (new / name, folder / name)):
            if source.exists():
                os.replace(source, target)
    shutil.rmtree(new)
