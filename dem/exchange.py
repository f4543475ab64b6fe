"""Sending rows of tables to other ranks, and what all ranks are told together."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeVar

import numpy as np
from mpi4py import MPI

from dem.arrays import Floats, Ints

Out = TypeVar("Out")


#: Exchanges have two tags in turn: a rank may begin the next one while another still listens for messages of this one.
TAGS, _TURN = (4712, 4713), MPI.Comm.Create_keyval()


def exchange(comm: MPI.Comm, columns: Mapping[str, np.ndarray], destination: Ints) -> dict[str, np.ndarray]:
    """Send row i of every column to the rank destination[i]; collective. Messages go only to ranks that get rows.

    columns: arrays (n, ...) of the same names, types and trailing shapes on every rank; destination: (n,).
    Rows arrive in the order of the sending ranks and, from one rank, in the order sent. A single rank gets the arrays
    themselves, without a copy.
    """
    if comm.size == 1:
        return dict(columns)
    order = np.argsort(destination, kind="stable")
    # All columns travel as one message: each row is the bytes of its entries side by side.
    packed = np.concatenate([_as_bytes(column) for column in columns.values()], axis=1)[order]
    ranks, first = np.unique(destination[order], return_index=True)
    arrived = _received(comm, dict(zip(ranks.tolist(), np.split(packed, first[1:]))), packed[:0])
    out, start = {}, 0
    for name, column in columns.items():
        width = _as_bytes(column[:0]).shape[1]
        block = np.ascontiguousarray(arrived[:, start : start + width])
        out[name] = block.view(column.dtype).reshape((len(arrived), *column.shape[1:]))
        start += width
    return out


def _received(comm: MPI.Comm, parts: dict[int, np.ndarray], none: np.ndarray) -> np.ndarray:
    """The rows that other ranks have for this one, in the order of the ranks; `parts`: the rows of bytes for each rank
    that gets some, `none`: no rows. Collective.

    No rank knows who sends to it. So it takes what comes until its own messages have been taken, says so in a barrier
    that does not block, and takes what comes until all have said so: Hoefler, Siebert, Lumsdaine, "Scalable
    communication protocols for dynamic sparse data exchange", PPoPP 2010."""
    turn = comm.Get_attr(_TURN) or 0
    comm.Set_attr(_TURN, 1 - turn)
    tag, row = TAGS[turn], MPI.BYTE.Create_contiguous(none.shape[1]).Commit()
    found = {comm.rank: parts.pop(comm.rank, none)}
    sent = [comm.Issend([part, len(part), row], rank, tag) for rank, part in parts.items()]
    status, said = MPI.Status(), None
    while said is None or not said.Test():
        message = comm.Improbe(MPI.ANY_SOURCE, tag, status)
        if message is not None:
            part = np.empty((status.Get_count(row), none.shape[1]), np.uint8)
            message.Recv([part, len(part), row])
            found[status.Get_source()] = part
        elif said is None and MPI.Request.Testall(sent):
            said = comm.Ibarrier()
    row.Free()
    return np.concatenate([found[rank] for rank in sorted(found)])


def _as_bytes(column: np.ndarray) -> np.ndarray:
    """The rows of an array (n, ...) as bytes (n, bytes per row)."""
    entries = int(np.prod(column.shape[1:]))
    return np.ascontiguousarray(column).reshape(len(column), entries).view(np.uint8)


def offsets(comm: MPI.Comm, count: int) -> Ints:
    """The first global index of each rank's part, then the total number (size + 1,); collective."""
    ends = np.zeros(comm.size + 1, np.int64)
    comm.Allgather(np.array([count]), ends[1:])
    return np.cumsum(ends)


def on_any(comm: MPI.Comm, *here: bool | np.bool_) -> list[bool]:
    """Of each of some facts, whether it holds on any rank; collective, without a message per rank."""
    if comm.size == 1:
        return list(map(bool, here))
    held = np.array(here, dtype=np.int64)
    comm.Allreduce(MPI.IN_PLACE, held, MPI.MAX)
    return held.astype(bool).tolist()


def on_all(comm: MPI.Comm, here: bool | np.bool_) -> bool:
    """Whether a fact holds on all ranks; collective."""
    return not on_any(comm, not here)[0]


def summed(comm: MPI.Comm, here: Floats) -> Floats:
    """The sum of an array over the ranks; collective."""
    if comm.size == 1:
        return here
    out = np.empty(here.shape, here.dtype)
    comm.Allreduce(np.ascontiguousarray(here), out)
    return out


def reduced(
    comm: MPI.Comm, sums: Sequence[float] | Floats, most: Sequence[float] | Floats
) -> tuple[list[float], list[float]]:
    """Some numbers summed over the ranks, and the greatest of some others, by one reduction. Collective."""
    if comm.size == 1:
        return list(map(float, sums)), list(map(float, most))
    numbers = np.array([len(sums), *sums, *most], float)
    kind = MPI.DOUBLE.Create_contiguous(len(numbers)).Commit()  # so that MPI never cuts the numbers apart
    comm.Allreduce(MPI.IN_PLACE, [numbers, 1, kind], _SUMS_AND_MOST)
    kind.Free()
    return numbers[1 : len(sums) + 1].tolist(), numbers[len(sums) + 1 :].tolist()


def broadcast(comm: MPI.Comm, value: Out) -> Out:
    """What the first rank has, on all ranks: processors may round in other ways. Collective."""
    return value if comm.size == 1 else comm.bcast(value)


def greatest(comm: MPI.Comm, value: Out) -> Out:
    """The greatest value of all ranks; collective."""
    return value if comm.size == 1 else comm.allreduce(value, MPI.MAX)


def _sums_and_most(here: Any, everywhere: Any, kind: MPI.Datatype) -> None:
    one, both = np.frombuffer(here), np.frombuffer(everywhere)
    most = int(one[0]) + 1
    both[1:most] += one[1:most]
    np.maximum(both[most:], one[most:], out=both[most:])


_SUMS_AND_MOST = MPI.Op.Create(_sums_and_most, commute=True)


#: The type and the words of an error.
Failure = tuple[type[Exception], str]


def common_error(failures: Sequence[Failure | None]) -> Exception:
    """The error that all ranks raise, from the failures of each: that of the first that has one, with the ranks that
    have the same, if not all do."""
    failed = [rank for rank, failure in enumerate(failures) if failure]
    kind, text = failures[failed[0]]  # type: ignore[misc]
    alike = [rank for rank in failed if failures[rank] == failures[failed[0]]]
    others = [rank for rank in failed if rank not in alike]
    remark = "" if len(alike) == len(failures) else f" (on {_ranks(alike)} of {len(failures)})"
    return kind(text + remark + (f"; another failure on {_ranks(others)}" if others else ""))


def _ranks(ranks: list[int]) -> str:
    return f"rank{'s' if len(ranks) > 1 else ''} {', '.join(map(str, ranks))}"


def agreed(
    comm: MPI.Comm, call: Callable[[], Out], own: tuple[type[Exception], ...] = (Exception,),
    failure: Callable[[Exception], Failure] = lambda error: (type(error), str(error)),
) -> Out:  # fmt: skip
    """What `call` returns on this rank. If it raises one of the errors `own` on any rank, all raise what `failure`
    makes of it. Collective."""
    found = None
    try:
        result = call()
    except own as error:
        found = failure(error)
    if on_any(comm, found is not None)[0]:
        raise common_error(comm.allgather(found))
    return result


def refuse(comm: MPI.Comm, wrong: str) -> None:
    """ValueError on all ranks if any rank has words for what is wrong with the user's data. Collective."""
    if on_any(comm, bool(wrong))[0]:
        raise common_error(comm.allgather((ValueError, wrong) if wrong else None))


def on_each(comm: MPI.Comm, what: str, work: Callable[[], Out]) -> Out:
    """What a user's `work` gives on this rank. If it raises on any of several ranks, all raise a RuntimeError that says
    `what` was called. Collective."""
    if comm.size == 1:
        return work()
    error, value, words = None, None, ""
    try:
        value = work()
    except Exception as raised:
        error, words = raised, f"{what}: {type(raised).__name__}: {raised}"
    if on_any(comm, error is not None)[0]:
        rank, words = next((rank, each) for rank, each in enumerate(comm.allgather(words)) if each)
        raise RuntimeError(f"{words} (on rank {rank})") from error
    return value  # type: ignore[return-value]


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
