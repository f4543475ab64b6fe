"""The memory that a rank can still take."""

from __future__ import annotations

from pathlib import Path

from mpi4py import MPI

GROUPS = Path("/sys/fs/cgroup")


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
    """The memory that Linux can give without swapping, within the limits of this process's control groups [bytes]."""
    try:
        words = Path("/proc/meminfo").read_text().split()
        free = [1024.0 * float(words[words.index("MemAvailable:") + 1])]
    except (OSError, ValueError):
        free = []
    return min(free + _of_groups(), default=float("inf"))


def _of_groups() -> list[float]:
    """What each limited control group of this process can still take [bytes]; they may be nested, as Slurm's are."""
    try:
        (own,) = [line for line in Path("/proc/self/cgroup").read_text().split() if line.startswith("0::")]
    except (OSError, ValueError):
        own = "0::/"
    left, group = [], GROUPS / own[4:]
    for folder in {GROUPS, group, *(parent for parent in group.parents if GROUPS in parent.parents)}:
        try:
            limit, used = ((folder / name).read_text().strip() for name in ("memory.max", "memory.current"))
            left += [] if limit == "max" else [float(limit) - float(used)]
        except (OSError, ValueError):  # the root has none
            continue
    return left
