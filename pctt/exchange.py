"""Sending rows of arrays to other ranks."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import numpy as np
from mpi4py import MPI

Out = TypeVar("Out")


def offsets(comm: MPI.Comm, count: int) -> np.ndarray:
    """The first global index of each rank's part, then the total number (size + 1,)."""
    return np.concatenate([[0], np.cumsum(comm.allgather(count))])


def refuse(comm: MPI.Comm, wrong: str) -> None:
    """ValueError on all ranks if any rank has words for what is wrong with the user's data. Collective."""
    for rank, words in enumerate(comm.allgather(wrong)):
        if words:
            raise ValueError(words + (f" (on rank {rank})" if comm.size > 1 else ""))


def on_first(comm: MPI.Comm, work: Callable[[], Out]) -> Out:
    """What `work` gives on the first rank, on all ranks, or the error that it raises there. Collective."""
    value, error = None, None
    if comm.rank == 0:
        try:
            value = work()
        except Exception as raised:
            error = raised
    value, error = comm.bcast((value, error))
    if error is not None:
        raise error
    return value  # type: ignore[return-value]


def send_rows(
    comm: MPI.Comm, arrays: list[np.ndarray], rank: np.ndarray
) -> tuple[list[np.ndarray], np.ndarray]:
    """Send row i of each array to ``rank[i]``. Returns the received rows and the ranks that sent them."""
    order = np.argsort(rank, kind="stable")
    send = np.bincount(rank, minlength=comm.size).astype(np.int64)
    receive = np.empty_like(send)
    comm.Alltoall(send, receive)
    received = []
    for array in arrays:
        width = int(np.prod(array.shape[1:]))
        out = np.empty((int(receive.sum()), *array.shape[1:]), array.dtype)
        kind = MPI._typedict[array.dtype.char].Create_contiguous(width).Commit()
        comm.Alltoallv([np.ascontiguousarray(array[order]), send, kind], [out, receive, kind])
        kind.Free()
        received.append(out)
    return received, np.repeat(np.arange(comm.size), receive)
