"""The folder of a run: whether it holds one already, and how another takes its place."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

from mpi4py import MPI

from pctt.disk import RUN_FILES, Lock
from pctt.run.hdf5 import FileError, told

HARD = "hard"  # folder of the cone problems that were not solved
#: What a run leaves in its folder.
FILES = (*RUN_FILES, "frames", HARD)


def held(folder: Path) -> list[str]:
    """What is there of a run; nothing if a run may write to the folder."""
    return [name for name in FILES if (folder / name).is_file() or any((folder / name).glob("*.h5"))]


def is_checkpoint_of(folder: Path, restart: str) -> bool:
    """Whether the file of ``-restart`` is the folder's own, so that a run goes on with what is there."""
    return bool(restart) and Path(restart).resolve() == (folder / "checkpoint.h5").resolve()


def refusal(folder: Path, restart: str, overwrite: bool) -> str:
    """Why a run with these values of -restart and -overwrite may not write to the folder; empty if it may."""
    there = held(folder)
    if not there or overwrite or is_checkpoint_of(folder, restart):
        return ""
    goes_on = f", or -restart {folder / 'checkpoint.h5'} to go on with it" * ("checkpoint.h5" in there)
    allowed = f"another folder, -overwrite to replace that run{goes_on}"
    return f"-output {folder}: holds a run ({', '.join(there)}); allowed is {allowed}"


class Place:
    """The place where a run writes, ``now``. It is the run's ``folder``, unless that holds another run. Then it is a
    hidden folder in it until ``take`` replaces the other run, which stays untouched up to then.

    A run that ``goes_on`` from the folder's own checkpoint adds to the files of the earlier one. No other run has the
    folder until the ``with`` block of this place ends.
    """

    def __init__(self, folder: Path, comm: MPI.Comm, restart: str = "", overwrite: bool = False):
        """``restart`` and ``overwrite`` are the values of the options; collective. FileError on all ranks if another
        run is writing to the folder, or has written there since the options were read."""
        self.folder, self._comm, self._lock = folder, comm, Lock(folder)
        self.goes_on, replaces, refused = False, False, ""
        hidden = folder / ".new"
        if comm.rank == 0:
            with told(folder):
                folder.mkdir(parents=True, exist_ok=True)
            if self._lock.take():
                refused = refusal(folder, restart, overwrite)
            else:
                refused = f"-output {folder}: another run is writing there; allowed is another folder"
            self.goes_on = is_checkpoint_of(folder, restart)
            replaces = not self.goes_on and bool(held(folder))
            if not refused:
                shutil.rmtree(hidden, ignore_errors=True)  # of a run that ended before its first step stood
        self.goes_on, replaces, refused = comm.bcast((self.goes_on, replaces, refused))
        self.now = hidden if replaces else folder
        if refused:
            self.leave()
            raise FileError(refused)

    def __enter__(self) -> Place:
        return self

    def __exit__(self, *exception: object) -> None:
        self.leave()

    def leave(self) -> None:
        """Let other runs have the folder."""
        self._lock.release()

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
