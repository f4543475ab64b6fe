"""Cone problems in files of any format that is known here: FCLIB, PETSc binary, Siconos' text."""

from __future__ import annotations

from pathlib import Path

from mpi4py import MPI

from pctt.ccp import fclib, petsc_binary, siconos
from pctt.ccp.stored import Stored

FORMATS = {"PETSc binary": petsc_binary, "Siconos": siconos, "FCLIB": fclib}


def load(path: str | Path, comm: MPI.Comm, compliance: float | None = None, operator: str = "auto") -> Stored:
    """The cone problem of a file, its contacts in equal parts over the ranks; collective. ``compliance`` takes the
    place of the file's.

    Raises FileFormatError on every rank if the file cannot be read in the format of its first bytes: FCLIB if these are
    of no other.
    """
    begins = [name for name, module in FORMATS.items() if comm.rank == 0 and name != "FCLIB" and module.is_one(path)]
    return FORMATS[comm.bcast([*begins, "FCLIB"][0])].load(path, comm, compliance, operator)
