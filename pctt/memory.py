"""How much memory a rank may still take."""

from __future__ import annotations

from pathlib import Path

from mpi4py import MPI

KIB = 1024.0


def available(comm: MPI.Comm) -> float:
    """Bytes that each rank may still take if all take as much: what its node has available, shared by the ranks there,
    the least of all ranks; inf where the system does not say. Collective."""
    node = comm.Split_type(MPI.COMM_TYPE_SHARED)
    share = _of_node() / node.size
    node.Free()
    return comm.allreduce(share, op=MPI.MIN)


def _of_node() -> float:
    """What Linux could hand out without swapping [bytes], within the limit of the control group of this process."""
    try:
        lines = Path("/proc/meminfo").read_text().splitlines()
    except OSError:
        return float("inf")
    free = [KIB * float(line.split()[1]) for line in lines if line.startswith("MemAvailable:")]
    return min(free + _of_group(), default=float("inf"))


def _of_group() -> list[float]:
    """What a container may still take [bytes], in a list; none where it has no limit."""
    group = Path("/sys/fs/cgroup")
    try:
        limit, used = ((group / name).read_text().strip() for name in ("memory.max", "memory.current"))
        return [] if limit == "max" else [float(limit) - float(used)]
    except (OSError, ValueError):
        return []
