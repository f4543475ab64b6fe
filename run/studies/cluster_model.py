"""What an iteration of APGD would take on a cluster: run/study cluster_model [N] [-ranks 1,2,4,8,16] [-latency S]
[-bandwidth B], default the settled mixer of n = 8. Contacts, bodies, ghosts, messages and bytes per product and
reductions per iteration are counted on so many ranks of this machine, more than it has cores; seconds are a model of
them. docs/cluster.md explains. Writes results/cluster_model_nN.json."""

from __future__ import annotations

import json
import statistics
import sys
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import shared
from mpi4py import MPI
from petsc4py import PETSc
from shared import Row, markdown, median_seconds, next_problem, settled

from dem.contact import find_contacts
from dem.exchange import offsets
from dem.partition import imbalance, rebalance
from dem.scenes import Mixer
from pctt import ccp
from pctt.ccp.first_order.scaled import ScaledProblem

TOL = 1e-6
SOLVERS = ("apgd", "conic")
BODY = 6 * 8  # bytes of a body's velocity or momentum
SIZES = {8: (4_915, 18_500), 16: (35_939, 144_700), 32: (274_627, 1_150_000)}  # bodies, contacts of settled mixers
MODEL = (1, 4, 16, 64, 256, 1024, 4096)  # ranks
SHARE = 100_000  # contacts of a rank where the problem grows with the ranks
MESSAGES_PER_DOUBLING = 2.5  # beyond the ranks counted here; partitions alone, on 64 to 1,024 ranks, had 12 to 23
SOLVED = 4  # ranks up to which the step is solved: more wait for each other on few cores, and do the same
SMALL, LARGE = 8, 2**20  # bytes of the messages that latency and bandwidth are measured with

class Counter:
    """Counts the calls of methods of a class while it is entered."""

    def __init__(self, of: type, *names: str):
        self.of, self.calls, self.originals = of, 0, {name: getattr(of, name) for name in names}

    def __enter__(self) -> Counter:
        for name, original in self.originals.items():
            setattr(self.of, name, self._counted(original))
        return self

    def _counted(self, original: Callable[..., Any]) -> Callable[..., Any]:
        def method(*arguments: Any) -> Any:
            self.calls += 1
            return original(*arguments)

        return method

    def __exit__(self, *exception: object) -> None:
        for name, original in self.originals.items():
            setattr(self.of, name, original)


# -- on many ranks: counts ----------------------------------------------------------------------------------


def count(n: int) -> Row:
    """The figures of the first step after the settled state of a mixer; collective."""
    comm = MPI.COMM_WORLD
    for name, value in {"ksp_type": "cg", "pc_type": "pbjacobi"}.items():  # factors are another story
        PETSc.Options().setValue(name, value)
    sim = settled(Mixer(n=n), dt=0.025, comm=comm)
    world, settings = sim.world, sim.settings
    contacts = find_contacts(world, settings.delta, settings.dt)
    if rebalance(world):
        contacts = None
    with next_problem(sim, contacts) as problem:
        row = {"ranks": comm.size, "imbalance": imbalance(world), **shares(problem)}
        for solver in SOLVERS if comm.size <= SOLVED else ():
            row |= {f"{solver} {name}": value for name, value in solved(problem, solver).items()}
        row["product_s"] = seconds_of_product(problem)
        row["iteration_s"] = seconds_of_iteration(problem)
    return row


def shares(problem: ccp.ConeProblem) -> Row:
    """What each rank has: contacts, bodies, ghosts, and the ranks that it hears from and speaks to."""
    G, comm = problem.contact_map.given, problem.comm
    starts = offsets(comm, G.columns)
    away = np.unique(G.body[(G.body >= 0) & ((G.body < starts[comm.rank]) | (G.body >= starts[comm.rank + 1]))])
    asked = np.bincount(np.searchsorted(starts, away, side="right") - 1, minlength=comm.size)  # ghosts by owner
    given = np.array(comm.alltoall(asked.tolist()))
    mine = {
        "contacts": len(problem.mu),
        "bodies": G.columns,
        "ghosts": len(away),
        "neighbours": int(((asked > 0) | (given > 0)).sum()),
        # G' g sends the momenta of ghosts, G v the velocities of bodies that are ghosts elsewhere
        "messages": int((asked > 0).sum() + (given > 0).sum()),
        "bytes": BODY * int(asked.sum() + given.sum()),
    }
    everyone = comm.allgather(mine)
    return {
        name: {"most": max(values), "mean": statistics.mean(values)}
        for name, values in ((name, [each[name] for each in everyone]) for name in mine)
    }


def solved(problem: ccp.ConeProblem, solver: str) -> Row:
    """Iterations, products and reductions of a cold start, rank 0's."""
    krylov = ccp.newton_for(problem.comm, solver) if ccp.SOLVERS[solver].newton else None
    ccp.solve(problem, None, solver, ccp.Limits(0.1), newton=krylov)  # loads compiled loops
    before = _petsc_reductions()
    with (
        Counter(type(problem.contact_map), "add_delassus", "find_image", "through") as products,
        Counter(ccp.ConeProblem, "sum", "min", "max") as reductions,
        Counter(ScaledProblem, "sums") as first_order,
    ):
        result = ccp.solve(problem, None, solver, ccp.Limits(TOL, closing_work=np.inf, fallback=False), newton=krylov)
    of_petsc = _petsc_reductions() - before
    if krylov is not None:
        krylov.destroy()
    count = reductions.calls + first_order.calls + of_petsc
    return {"its": result.iterations, "products": products.calls, "reductions": count, "converged": result.converged}


def _petsc_reductions() -> float:
    return PETSc.Log.Event("CCPSolve").getPerfInfo()["numReductions"]


def seconds_of_product(problem: ccp.ConeProblem) -> float:
    """Of y += N g, median."""
    g, y = np.ones_like(problem.r), np.zeros_like(problem.r)
    return median_seconds(lambda: problem.contact_map.add_delassus(g, y), 50)


def seconds_of_iteration(problem: ccp.ConeProblem) -> float:
    """CPU seconds of an iteration of APGD on this rank; the best of five solves, each of 200 iterations."""
    limits, spent = ccp.Limits(1e-14, 200, np.inf, fallback=False), []
    for _ in range(5):
        start = time.process_time()
        result = ccp.solve(problem, None, "apgd", limits)
        spent.append((time.process_time() - start) / result.iterations)
    return min(spent)


def ping_pong() -> tuple[float, float]:
    """Seconds of a short message and bytes per second of long ones, from rank 0 to 1 and back; medians."""
    comm, took = MPI.COMM_WORLD, {}
    for size in (SMALL, LARGE):
        buffer, spent = np.zeros(size, np.uint8), []
        for _ in range(1000 if size == SMALL else 100):
            start = time.perf_counter()
            if comm.rank == 0:
                comm.Send(buffer, 1)
                comm.Recv(buffer, 1)
            elif comm.rank == 1:
                comm.Recv(buffer, 0)
                comm.Send(buffer, 0)
            spent.append(0.5 * (time.perf_counter() - start))
        took[size] = statistics.median(spent)
    return took[SMALL], LARGE / max(took[LARGE] - took[SMALL], 1e-9)


# -- the model ----------------------------------------------------------------------------------------------


def modelled(rows: list[Row], fixed: float, ranks: int, bodies: int, contacts: int, latency: float,
             bandwidth: float) -> tuple[float, float]:  # fmt: skip
    """Seconds of an iteration of APGD on so many ranks, and those of them that are work on contacts.

    fixed: seconds of an iteration on hardly any contacts. The rest of the work of one rank is divided by the ranks, and
    multiplied by the worst load; every product exchanges velocities and momenta of ghosts, whose number grows as the
    surface of a rank's share; every reduction is a tree of messages.
    """
    one, most = rows[0], rows[-1]
    work = (one["iteration_s"] - fixed) * contacts / one["contacts"]["most"] / ranks
    if ranks == 1:
        return fixed + work, work
    its = one["apgd its"]
    reductions = [row["apgd reductions"] for row in rows if "apgd reductions" in row][-1] / its
    work *= max(row["contacts"]["most"] / row["contacts"]["mean"] for row in rows)
    counted = [row["messages"]["most"] for row in rows if row["ranks"] >= ranks]
    beyond = most["messages"]["most"] + MESSAGES_PER_DOUBLING * np.log2(ranks / most["ranks"])
    surface = most["bytes"]["most"] / (most["bodies"]["mean"]) ** (2 / 3)
    product = (counted[0] if counted else beyond) * latency + surface * (bodies / ranks) ** (2 / 3) / bandwidth
    reduction = 2 * np.ceil(np.log2(ranks)) * latency
    return fixed + work + one["apgd products"] / its * product + reductions * reduction, work


def table(rows: list[Row]) -> str:
    """What was counted, of the rank that has the most of it."""
    heads = ["ranks", "contacts, most / mean", "bodies", "ghosts", "ghosts / bodies^(2/3)", "neighbours"]
    heads += ["messages, kB per product", *(f"{solver}: iterations, products, reductions" for solver in SOLVERS)]
    lines = []
    for row in rows:
        surface = row["ghosts"]["most"] / row["bodies"]["mean"] ** (2 / 3)
        lines.append([
            row["ranks"], f"{row['contacts']['most']:,} / {row['contacts']['most'] / row['contacts']['mean']:.2f}",
            f"{row['bodies']['most']:,}", f"{row['ghosts']['most']:,}", f"{surface:.1f}",
            row["neighbours"]["most"], f"{row['messages']['most']}, {row['bytes']['most'] / 1e3:.0f}",
        ])  # fmt: skip
        for solver in SOLVERS:
            counts = (row.get(f"{solver} {name}") for name in ("its", "products", "reductions"))
            lines[-1].append(", ".join("" if count is None else f"{count:,.0f}" for count in counts).strip(", "))
    return markdown(heads, lines)


def main() -> None:
    line = shared.parser("cluster_model", __doc__)
    line.add_argument("n", type=int, nargs="?", default=8, help="size of the mixer")
    line.add_argument("-ranks", type=shared.listed(int), default="1,2,4,8,16", help="of this machine; 1 is the first")
    line.add_argument("-latency", type=float, default=2e-6, help="seconds of a message between nodes, assumed")
    line.add_argument("-bandwidth", type=float, default=1e9, help="bytes per second of a rank between nodes, assumed")
    words = line.parse_args()
    if words.n < 1 or not words.latency > 0 or not words.bandwidth > 0:
        line.error("n, -latency, -bandwidth: allowed are numbers > 0")
    ranks = words.ranks
    if ranks[:1] != [1] or len(ranks) < 2 or sorted(set(ranks)) != ranks:
        line.error(f"-ranks {','.join(map(str, ranks))}: allowed are whole numbers that grow, the first of them 1")
    about = shared.say_machine() | {"latency": words.latency, "bandwidth": words.bandwidth}
    about["here"] = dict(zip(("latency", "bandwidth"), start(2, "--ping")))
    print(f"a message here takes {about['here']['latency'] * 1e6:.1f} us, {about['here']['bandwidth'] / 1e9:.1f} GB/s")
    rows = []
    for count_ in ranks:
        rows.append(start(count_, "--count", str(words.n)))
        milliseconds = 1e3 * rows[-1]["product_s"]
        print(f"{count_} ranks: product {milliseconds:.2f} ms, load {rows[-1]['imbalance']:.3f}", flush=True)
    print("\n" + table(rows))
    about["fixed_s"] = fixed = start(2, "--count", "1")["iteration_s"]
    slope = (rows[0]["iteration_s"] - fixed) / rows[0]["contacts"]["most"]
    print(f"\nan iteration takes {1e6 * fixed:.0f} us, and {1e9 * slope:.0f} ns per contact of the rank; modelled:")
    ways = (words.latency, words.bandwidth)
    for n, (bodies, contacts) in SIZES.items():
        times = {r: modelled(rows, fixed, r, bodies, contacts, *ways) for r in MODEL}
        say(f"mixer n = {n}, {contacts:,} contacts", times)
    per_contact = SIZES[32][0] / SIZES[32][1]
    grown = {r: modelled(rows, fixed, r, int(r * SHARE * per_contact), r * SHARE, *ways) for r in MODEL}
    say(f"{SHARE:,} contacts per rank", grown)
    shared.record(f"cluster_model_n{words.n}", about, rows)


def say(name: str, iteration: dict[int, tuple[float, float]]) -> None:
    """Print the microseconds of an iteration for each number of ranks, and the part of them that is work."""
    cells = ", ".join(f"{ranks}: {1e6 * whole:,.0f} ({work / whole:.2f})" for ranks, (whole, work) in iteration.items())
    print(f"{name}: {cells}")


def start(ranks: int, *words: str) -> Any:
    """What rank 0 of this script says on so many ranks."""
    said, failure = shared.lines_of([shared.MPIEXEC, "-n", ranks, sys.executable, __file__, *words])
    if failure:
        sys.exit(f"run/study cluster_model: {' '.join(words)} on {ranks} ranks: {failure}")
    return said[-1]


if __name__ == "__main__":
    if sys.argv[1:2] == ["--count"]:
        PETSc.Log.begin()
        found: Any = count(int(sys.argv[2]))
    elif sys.argv[1:2] == ["--ping"]:
        found = ping_pong()
    else:
        main()
        raise SystemExit
    if MPI.COMM_WORLD.rank == 0:
        print(json.dumps(found))
