"""Memory and seconds of a start on a cluster: run/study cluster_start [N] [-ranks 64] [-of 0,31,63] [-real 63] [-steps
2], default a bin of 33 million spheres, whose lattice has three contacts per sphere. Some of the ranks start one after
another, each in a process that stands for that rank: it gets as many grains as it gives, and no ghosts. A smaller bin
(-real) starts on two ranks and makes steps. docs/cluster.md explains. Writes results/cluster_start_nN.json."""

from __future__ import annotations

import json
import resource
import sys
import time
from typing import Any

import numpy as np
import shared
from mpi4py import MPI
from shared import Row, markdown

import pctt
from dem import exchange
from dem.arrays import Rule
from dem.contact import find_contacts
from dem.start import new_world
from pctt.scenes import Blade

PITCH, PERTURBATION = 0.205, 0.002  # [m]: gaps are below the contact distance, so that the lattice has its contacts


class OneOf:
    """The communicator of one rank of many, on which the others say the same, or nothing where each says its own."""

    def __init__(self, rank: int, size: int):
        self.rank, self.size = rank, size

    def allgather(self, mine: Any) -> list[Any]:
        return [mine] * self.size

    def bcast(self, mine: Any) -> Any:
        return mine

    def Bcast(self, mine: np.ndarray, root: int = 0) -> None:
        pass

    def Allreduce(self, *buffers: Any) -> None:
        pass

    def allreduce(self, mine: Any, op: Any = None) -> Any:
        return mine

    def Allgather(self, mine: np.ndarray, all_of_them: np.ndarray) -> None:
        counts = mine.dtype.kind == "i"
        all_of_them[:] = mine if counts else np.array([np.inf, -np.inf])[:, None]  # others have empty boxes
        all_of_them[self.rank] = mine


def scene(n: int) -> Blade:
    return Blade(n=n, pitch=PITCH, perturbation=PERTURBATION)


def peak() -> int:
    return 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


def one_of(n: int, rank: int, size: int) -> Row:
    """The start of one rank."""
    exchange._delivered = lambda comm, parts, none: np.concatenate([none, *parts.values()])  # type: ignore[assignment]
    find_contacts(new_world(scene(3).build(), MPI.COMM_SELF), 0.0)  # loads compiled loops
    built = scene(n).build()
    if built.count < size * Rule.CHUNK:  # a rank without a share in the survey would know it from the others
        built.survey()
    before, begun = peak(), time.process_time()
    world = new_world(built, OneOf(rank, size))  # type: ignore[arg-type]
    found: Row = {"ranks": size, "rank": rank, "bodies": len(world.grains), "bytes": peak() - before}
    found["seconds"] = time.process_time() - begun
    return found | {"contacts": len(find_contacts(world, 0.02)), "base": before}


def real(n: int, steps: int) -> list[Row]:
    """The start and some steps of APGD on all ranks; of the rank with the most of each."""
    comm, rows = MPI.COMM_WORLD, []
    before = begun = 0.0

    def note(what: str, sim: Any) -> None:
        contacts = len(sim.last.contacts) if sim.last else 0
        mine = peak() - before, len(sim.world.grains), contacts, time.process_time() - begun
        most = np.max(comm.allgather(mine), axis=0)
        names = ("bytes", "bodies", "contacts", "seconds")
        rows.append({"what": what, "ranks": comm.size, **dict(zip(names, most.tolist()))})

    def simulation(size: int) -> Any:
        more = {"dt": 0.005, "max_it": 40, "closing_work": np.inf, "fallback": False}
        return pctt.Simulation(scene(size), solver="apgd", comm=comm, **more)

    simulation(3).run(steps=2)
    before, begun = peak(), time.process_time()
    sim = simulation(n)
    note("start", sim)
    for _ in range(steps):
        figures = sim.step()
        note(f"step, {figures['iterations']} iterations", sim)
    return rows


def main() -> None:
    line = shared.parser("cluster_start", __doc__)
    line.add_argument("n", type=shared.at_least_one, nargs="?", default=160, help="size of the bin")
    line.add_argument("-ranks", type=shared.at_least_one, default=64, help="of the cluster")
    line.add_argument("-of", type=shared.listed(int), default="0,31,63", help="the ranks that start")
    line.add_argument("-real", type=shared.at_least_one, default=63, help="size of the bin on two ranks")
    line.add_argument("-steps", type=int, default=2, help="that these make")
    words = line.parse_args()
    rows = [start(1, "--one", words.n, rank, words.ranks) for rank in words.of]
    print(markdown(["rank", "bodies", "contacts", "MB", "bytes per body", "bytes per contact", "s of processor"], [
        [f"{row['rank']} of {row['ranks']}", *of(row)] for row in rows
    ]))  # fmt: skip
    found = start(2, "--real", words.real, words.steps)
    print(markdown(["two ranks", "bodies", "contacts", "MB", "bytes per body", "bytes per contact", "s of processor"], [
        [row["what"], *of(row)] for row in found
    ]))  # fmt: skip
    shared.record(f"cluster_start_n{words.n}", shared.say_machine(), rows + found)


def of(row: Row) -> list[str]:
    each = [row["bytes"] / max(row[name], 1) for name in ("bodies", "contacts")]
    figures = [f"{row['bytes'] / 1e6:,.0f}", f"{each[0]:,.0f}", f"{each[1]:,.0f}" if row["contacts"] else ""]
    return [f"{row['bodies']:,.0f}", f"{row['contacts']:,.0f}", *figures, f"{row['seconds']:.1f}"]


def start(ranks: int, *words: object) -> Any:
    """What rank 0 of this script says on so many ranks."""
    said, failure = shared.lines_of([shared.MPIEXEC, "-n", ranks, sys.executable, __file__, *words])
    if failure:
        sys.exit(f"run/study cluster_start: {' '.join(map(str, words))} on {ranks} ranks: {failure}")
    return said[-1]


if __name__ == "__main__":
    numbers = [int(word) for word in sys.argv[2:]] if sys.argv[1:2] in (["--one"], ["--real"]) else []
    if not numbers:
        main()
        raise SystemExit
    found: Any = one_of(*numbers) if sys.argv[1] == "--one" else real(*numbers)
    if MPI.COMM_WORLD.rank == 0:
        print(json.dumps(found))
