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
    try:
        groups = [line for line in Path("/proc/self/cgroup").read_text().split() if line.startswith("0::/")]
        return limits(GROUPS, groups[0][4:]) if groups else []
    except (OSError, ValueError):
        return []


def limits(top: Path, group: str) -> list[float]:
    """What each limited control group can still take [bytes], from this one up to the top. They may be nested, as
    Slurm's are."""
    folders = [folder for folder in (top / group, *(top / group).parents) if folder == top or top in folder.parents]
    limited = [folder for folder in folders if (folder / "memory.max").is_file()]  # the root has no such file
    texts = [((folder / "memory.max").read_text(), (folder / "memory.current").read_text()) for folder in limited]
    return [float(most) - float(used) for most, used in texts if most.strip() != "max"]
