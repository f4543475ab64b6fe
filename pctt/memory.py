"""The memory that a rank can still take."""

from __future__ import annotations

from pathlib import Path

from mpi4py import MPI

KIB = 1024.0


def available(comm: MPI.Comm) -> float:
    """The bytes that each rank can still take if all ranks take the same amount. Collective.

    It is the available memory of a node divided by its number of ranks, the smallest value of all nodes; inf if the
    system does not tell.
    """
    node = comm.Split_type(MPI.COMM_TYPE_SHARED)
    share = _of_node() / node.size
    node.Free()
    return comm.allreduce(share, op=MPI.MIN)


def _of_node() -> float:
    """The memory that Linux can give without swapping, within the limit of this process's control group [bytes]."""
    try:
        lines = Path("/proc/meminfo").read_text().splitlines()
    except OSError:
        return float("inf")
    free = [KIB * float(line.split()[1]) for line in lines if line.startswith("MemAvailable:")]
    return min(free + _of_group(), default=float("inf"))


def _of_group() -> list[float]:
    """A list with the memory that a container can still take [bytes]; empty if the container has no limit."""
    group = Path("/sys/fs/cgroup")
    try:
        limit, used = ((group / name).read_text().strip() for name in ("memory.max", "memory.current"))
        return [] if limit == "max" else [float(limit) - float(used)]
    except (OSError, ValueError):
        return []
