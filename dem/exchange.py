"""Sending rows of tables to other ranks, and what all ranks are told together."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TypeVar

import numpy as np
from mpi4py import MPI

from dem.arrays import Ints

Out = TypeVar("Out")


def exchange(comm: MPI.Comm, columns: Mapping[str, np.ndarray], destination: Ints) -> dict[str, np.ndarray]:
    """Send row i of every column to the rank destination[i]; collective.

    columns: arrays (n, ...) of the same names, types and trailing shapes on every rank; destination: (n,).
    Rows arrive in the order of the sending ranks and, from one rank, in the order sent. A single rank gets the arrays
    themselves, without a copy.
    """
    if comm.size == 1:
        return dict(columns)
    order = np.argsort(destination, kind="stable")
    # All columns travel as one message: each row is the bytes of its entries side by side.
    packed = np.concatenate([_as_bytes(column) for column in columns.values()], axis=1)[order]
    send = np.bincount(destination, minlength=comm.size)
    receive = np.empty_like(send)
    comm.Alltoall(send, receive)
    arrived = np.empty((int(receive.sum()), packed.shape[1]), np.uint8)
    row = MPI.BYTE.Create_contiguous(packed.shape[1]).Commit()
    comm.Alltoallv([packed, (send, None), row], [arrived, (receive, None), row])
    row.Free()
    out, start = {}, 0
    for name, column in columns.items():
        width = _as_bytes(column[:0]).shape[1]
        block = np.ascontiguousarray(arrived[:, start : start + width])
        out[name] = block.view(column.dtype).reshape((len(arrived), *column.shape[1:]))
        start += width
    return out


def _as_bytes(column: np.ndarray) -> np.ndarray:
    """The rows of an array (n, ...) as bytes (n, bytes per row)."""
    entries = int(np.prod(column.shape[1:]))
    return np.ascontiguousarray(column).reshape(len(column), entries).view(np.uint8)


def offsets(comm: MPI.Comm, count: int) -> Ints:
    """The first global index of each rank's part, then the total number (size + 1,); collective."""
    ends = np.zeros(comm.size + 1, np.int64)
    comm.Allgather(np.array([count]), ends[1:])
    return np.cumsum(ends)


def on_any(comm: MPI.Comm, *here: bool) -> list[bool]:
    """Of each of some facts, whether it holds on any rank; collective, without a message per rank."""
    held = np.array(here, dtype=np.int64)
    comm.Allreduce(MPI.IN_PLACE, held, MPI.MAX)
    return held.astype(bool).tolist()


def refuse(comm: MPI.Comm, wrong: str) -> None:
    """ValueError on all ranks if any rank has words for what is wrong with the user's data. Collective."""
    if not on_any(comm, bool(wrong))[0]:
        return
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
