"""Distributed rows and matrices brought to rank 0, and files that it writes whole or not at all."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import scipy.sparse as sp
from mpi4py import MPI
from petsc4py import PETSc

from pctt.disk import whole


def gather_rows(comm: MPI.Comm, local: np.ndarray) -> np.ndarray:
    """The rows of all ranks, in their order, on rank 0; no rows elsewhere; collective."""
    local = np.ascontiguousarray(local)
    width = int(np.prod(local.shape[1:]))
    counts = comm.gather(len(local) * width)
    total = sum(counts) if counts else 0
    whole = np.empty((total // width, *local.shape[1:]), local.dtype)
    comm.Gatherv(local, [whole, counts])
    return whole


def gather_matrix(A: PETSc.Mat) -> sp.csr_matrix:
    """A Mat without its zeros on rank 0; a matrix without rows elsewhere; collective."""
    comm = A.comm.tompi4py()
    indptr, indices, values = A.getValuesCSR()
    lengths, indices, values = (gather_rows(comm, array) for array in (np.diff(indptr), indices, values))
    whole = sp.csr_matrix(
        (values, indices, np.concatenate([[0], np.cumsum(lengths)])), shape=(len(lengths), A.getSize()[1])
    )
    whole.eliminate_zeros()
    return whole


def write_whole(path: str | Path, comm: MPI.Comm, write: Callable[[Path], None]) -> None:
    """Rank 0 lets ``write`` make a file under a temporary name and gives it its own when complete; collective.

    Raises OSError on all ranks if that fails; an earlier file under ``path`` then stays as it is.
    """
    failure = None
    if comm.rank == 0:
        try:
            with whole(Path(path)) as temporary:
                write(temporary)
        except (OSError, ValueError, RuntimeError) as error:  # h5py raises all three
            failure = f"{path}: cannot write ({error})"
    failure = comm.bcast(failure)
    if failure:
        raise OSError(failure)
