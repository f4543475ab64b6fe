"""Cone problems in files of any format that is known here: FCLIB, PETSc binary, Siconos' text."""

from __future__ import annotations

from pathlib import Path

from mpi4py import MPI

from pctt.ccp import fclib, petsc_binary, siconos
from pctt.ccp.stored import Stored

FORMATS = {"PETSc binary": petsc_binary, "Siconos": siconos, "FCLIB": fclib}


def load(path: str | Path, comm: MPI.Comm, compliance: float | None = None) -> Stored:
    """The cone problem of a file, its contacts in equal parts over the ranks; collective. ``compliance`` takes the
    place of the file's.

    Raises FileFormatError on every rank if the file cannot be read in the format of its first bytes: FCLIB if these are
    of no other, or cannot be read.
    """
    name = comm.bcast(_format(path) if comm.rank == 0 else "")
    return FORMATS[name].load(path, comm, compliance)


def _format(path: str | Path) -> str:
    try:
        return next((name for name in ("PETSc binary", "Siconos") if FORMATS[name].is_one(path)), "FCLIB")
    except OSError:  # its reader tells all ranks why
        return "FCLIB"
