"""What a step would take on a cluster: run/study cluster_model [N] [-sizes 2,4,8,16] [-copies 3,3,2] [-latency S]
[-bandwidth B], default the settled mixer of n = 16. Its bed, and copies of it side by side, are cut into the pieces of
up to 1,024 ranks, one after another in one process, and contacts, ghosts, messages and bytes are counted. Iterations
and CPU seconds are those of steps on one and two ranks. Seconds on more are a model of them; docs/cluster.md explains.
With -conic N it counts what `conic` takes of a mixer instead. Writes results/cluster_model.json."""

from __future__ import annotations

import json
import statistics
import sys
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import shared
from mpi4py import MPI
from petsc4py import PETSc
from shared import Row, markdown, next_problem, settled

from dem import bodies
from dem.contact import Contacts, find_contacts
from dem.contact_map.halo import Halo, Messages
from dem.geometry.morton import morton_codes
from dem.model import neighbourhood
from dem.model.partition import frame_of_most, redistribute, splitters
from dem.model.world import World
from dem.unconstrained import unconstrained
from pctt import ccp
from pctt.ccp.newton.multifrontal import MultifrontalFactors
from pctt.scenes import Mixer

BODY = 6 * 4  # bytes of a body's velocity or momentum in single precision, which is that of `apgd` to 2e-6
BOXES = 8 * 6 * 8  # bytes of the boxes of a rank
SIZES = {8: (4_915, 18_300), 16: (35_939, 137_700), 32: (274_627, 1_150_000)}  # bodies, contacts of settled mixers
MODEL = (1, 2, 4, 16, 64, 256, 1024)  # ranks
SHARE = 100_000  # contacts of a rank where the problem grows with the ranks
LOAD = 1.05  # of the rank with the most, over the mean: the curve is cut again above (`dem.model.partition.rebalance`)
OUTSIDE = 22  # collective calls of a step outside of the solve (tests/run/test_collectives.py)
FEW = 30  # bodies of a piece, on average, at least
STEPS = 12  # that are measured, after 3
SMALL, LARGE = 8, 2**20  # bytes of the messages that latency and bandwidth are measured with


# -- the pieces of many ranks, counted on one ---------------------------------------------------------------


def pieces(world: World, body: np.ndarray, ranks: int) -> dict[str, np.ndarray]:
    """What each of so many ranks (ranks,) has after a cut of the curve: contacts, bodies, ghosts, the messages that it
    sends in a product, and the numbers of bodies in them.

    world : on one rank, its grains in the order of the curve (`dem.model.partition.redistribute`), searched
    body : (nc, 2) global indices of the bodies of the contacts; -1 for a body that no impulse moves
    """
    owner = owners(world, ranks)
    here = owner[np.where(body < 0, len(owner) - 1, body).min(axis=1)]  # a contact is with its body of lower index
    row, side = np.nonzero(body >= 0)
    ghost = np.unique(here[row] * len(owner) + body[row, side])
    rank, ghost = np.divmod(ghost, len(owner))
    away = owner[ghost] != rank
    asked, given = rank[away], owner[ghost[away]]
    pair = np.unique(asked * ranks + given)

    def each(rank: np.ndarray) -> np.ndarray:
        return np.bincount(rank, minlength=ranks)

    return {
        "contacts": each(here), "bodies": each(owner), "ghosts": each(asked),
        "messages": each(pair // ranks) + each(pair % ranks), "moved": each(asked) + each(given),
    }  # fmt: skip


def moving(world: World, contacts: Contacts) -> np.ndarray:
    """The bodies of contacts (nc, 2) by global index, -1 for those that no impulse moves."""
    moves = np.append(np.ones(world.slabs[-1], bool), bodies.is_dynamic(world.large))
    return np.where(moves[contacts.body], contacts.body, -1)


def owners(world: World, ranks: int) -> np.ndarray:
    """The rank of each body by its global index, the large ones with the last."""
    grains = world.grains
    codes = morton_codes(grains.position, frame_of_most(world.comm, grains.position))
    cuts = splitters(world.comm, codes, grains.weight + 1.0, ranks)
    return np.append(np.searchsorted(cuts, codes, side="right"), np.full(len(world.large), ranks - 1))


def copies(world: World, times: list[int]) -> World:
    """The grains of a world so many times (3,) side by side along the axes, without tools and walls."""
    grains = world.grains
    size = np.ptp(grains.position, axis=0) + 2 * bodies.bounding_radius(grains).max()
    place = np.indices(times).reshape(3, -1).T
    many = grains.take(np.tile(np.arange(len(grains)), len(place)))
    many.position += np.repeat(place * size, len(grains), axis=0)
    many.id = np.arange(len(many))
    return World(world.comm, (), world.gravity, world.pairs, world.materials, many, world.large.take(slice(0)))


def counted(n: int, times: list[int]) -> list[Row]:
    """Of the bed of a mixer, and of copies of it, for each number of ranks."""
    sim = settled(Mixer(n=n))
    rows: list[Row] = []
    for world in (sim.world, copies(sim.world, times)):
        for _ in range(2):  # the second time with the contacts of the first
            redistribute(world)
            contacts = find_contacts(world, sim.settings.delta, unconstrained(world, sim.settings.dt))
            world.lists, world.grains.weight = contacts.lists, contacts.owned
        body = moving(world, contacts)
        for ranks in (2**k for k in range(1, 11) if 2**k * FEW <= len(world.grains)):
            found = pieces(world, body, ranks)
            row: Row = {"bed": len(world.grains), "ranks": ranks, "touched_s": seconds_of_boxes(world, ranks)}
            rows.append(row | {name: {"most": int(of.max()), "mean": of.mean()} for name, of in found.items()})
    return rows


def seconds_of_boxes(world: World, ranks: int) -> float:
    """CPU seconds in which the last of so many ranks finds which of its grains the boxes of the others touch."""
    grains, of_lists = world.grains, world.lists.near.margin[: len(world.grains)]
    ends = np.searchsorted(owners(world, ranks)[: len(grains)], np.arange(ranks + 1))
    radius = bodies.bounding_radius(grains) + of_lists
    parts = [(grains.position[a:b], radius[a:b]) for a, b in zip(ends, ends[1:])]
    boxes = np.stack([neighbourhood.chunk_boxes(*part, 8) for part in parts])
    return least_seconds(lambda: neighbourhood.seen_by(*parts[-1], np.zeros((1, 3)), boxes[:-1]), 3)


def least_seconds(do: Callable[[], object], repeat: int) -> float:
    """CPU seconds, the least of some times."""
    spent = []
    for _ in range(repeat):
        start = time.process_time()
        do()
        spent.append(time.process_time() - start)
    return min(spent)


# -- on one and two ranks: steps, messages, `conic` ---------------------------------------------------------


def steps(n: int) -> Row:
    """Of steps of a settled mixer by `apgd` and default settings, CPU seconds of the rank that takes the most."""
    comm = MPI.COMM_WORLD
    sim = settled(Mixer(n=n), comm=comm, solver="apgd")
    rows = []
    for _ in range(STEPS + 3):
        lists, solve = sim.world.lists, InSolve()
        start = time.process_time()
        with solve:
            sim.step()
        rows.append(solve.row | {"outside_s": time.process_time() - start - solve.row["solve_s"]})
        rows[-1] |= {"contacts": len(sim.last.contacts), "new_lists": sim.world.lists is not lists}
    del rows[:3]
    row: Row = {"n": n, "ranks": comm.size}
    row |= {name: statistics.median(one[name] for one in rows) for name in ("its", "contacts", "outside_s")}
    row |= {name: sum(one[name] for one in rows) / sum(one["its"] for one in rows) for name in ("halos", "reductions")}
    row["new_lists"] = statistics.mean(one["new_lists"] for one in rows)
    row["iteration_s"] = min(one["solve_s"] / one["its"] for one in rows)
    row["own_s"] = min(min(one["solve_s"], one["own_s"]) / one["its"] for one in rows)
    for name in ("contacts", "outside_s", "iteration_s", "own_s"):
        row[name] = comm.allreduce(row[name], MPI.MAX)
    return row


class Spent:
    """Counts the calls of a method of a class while it is entered, and its seconds."""

    def __init__(self, of: type, name: str):
        self.of, self.name, self.original, self.calls, self.seconds = of, name, getattr(of, name), 0, 0.0

    def __enter__(self) -> Spent:
        setattr(self.of, self.name, lambda *arguments: self._called(*arguments))
        return self

    def _called(self, *arguments: Any) -> Any:
        start = time.perf_counter()  # the clock of the processor takes two microseconds
        found = self.original(*arguments)
        self.calls, self.seconds = self.calls + 1, self.seconds + time.perf_counter() - start
        return found

    def __exit__(self, *exception: object) -> None:
        setattr(self.of, self.name, self.original)


class InSolve:
    """What the cone solver takes while this is entered: CPU seconds, seconds in which it waits for no other rank,
    iterations, halves of products, reductions."""

    def __enter__(self) -> InSolve:
        self.row, self._solve = dict.fromkeys(("solve_s", "own_s", "its", "halos", "reductions"), 0.0), ccp.solve
        ccp.solve = self._timed  # type: ignore[assignment]
        return self

    def _timed(self, *arguments: Any, **more: Any) -> ccp.Result:
        cpu, start = time.process_time(), time.perf_counter()
        with Spent(Halo, "_wait") as halos, Spent(ccp.ConeProblem, "_reduced") as reductions:
            result = self._solve(*arguments, **more)
        own = time.perf_counter() - start - halos.seconds - reductions.seconds
        found = {"solve_s": time.process_time() - cpu, "own_s": own, "its": result.iterations}
        found |= {"halos": halos.calls, "reductions": reductions.calls}
        self.row = {name: self.row[name] + of for name, of in found.items()}
        return result

    def __exit__(self, *exception: object) -> None:
        ccp.solve = self._solve


def conic(n: int) -> list[Row]:
    """A cold start by conjugate gradients with block Jacobi, as `conic` does by itself, and by `apgd`."""
    sim = settled(Mixer(n=n), comm=MPI.COMM_WORLD)
    rows = []
    with next_problem(sim) as problem:
        about: Row = {"n": n, "ranks": problem.comm.size}
        for tol in (1e-4, 1e-6):
            for kind, pc in (("apgd", ""), ("conic, block Jacobi", "pbjacobi"), ("conic", "")):
                if pc:
                    PETSc.Options().setValue("ccp_pc_type", pc)
                    PETSc.Options().setValue("ccp_ksp_type", "cg")
                rows.append({**about, "tol": tol, "kind": kind, **solved(problem, kind.partition(",")[0], tol)})
                for name in ("ccp_pc_type", "ccp_ksp_type") if pc else ():
                    PETSc.Options().delValue(name)
    return rows


def solved(problem: ccp.ConeProblem, solver: str, tol: float) -> Row:
    """Counts and CPU seconds of a cold start."""
    newton = ccp.newton_for(problem.comm, solver) if ccp.SOLVERS[solver].newton else None
    ccp.solve(problem, None, solver, ccp.Limits(0.1), newton=newton, law=ccp.RELAXATION)  # loads compiled loops
    before, start = PETSc.Log.Event("CCPSolve").getPerfInfo()["numReductions"], time.process_time()
    with Spent(Halo, "_wait") as halos, Spent(ccp.ConeProblem, "_reduced") as own, Factors() as factors:
        result = ccp.solve(
            problem, None, solver, ccp.Limits(tol, closing_work=np.inf, fallback=False), newton=newton,
            law=ccp.RELAXATION,
        )
    seconds = time.process_time() - start
    of_petsc = PETSc.Log.Event("CCPSolve").getPerfInfo()["numReductions"] - before
    if newton is not None:
        newton.destroy()
    found: Row = {"its": result.iterations, "krylov": result.ksp_its, "seconds": seconds, "halos": halos.calls}
    found |= {"reductions": own.calls + of_petsc, "converged": result.converged}
    return found | {"factors": len(factors.operations), "operations": sum(factors.operations)}


class Factors:
    """The operations of the Cholesky factors by fronts (of one rank) that are made while this is entered."""

    def __enter__(self) -> Factors:
        self.operations, self._init = list[float](), MultifrontalFactors.__init__
        MultifrontalFactors.__init__ = lambda *arguments: self._made(*arguments)  # type: ignore[assignment]
        return self

    def _made(self, fronts: MultifrontalFactors, *arguments: Any) -> None:
        self._init(fronts, *arguments)
        made = fronts.own + fronts.shared
        sizes = np.array([(front.diagonal.shape[0], front.below.shape[0]) for front in made], float)
        own, rest = sizes.T
        self.operations.append(float((own**3 / 3 + own**2 * rest + own * rest**2).sum()))

    def __exit__(self, *exception: object) -> None:
        MultifrontalFactors.__init__ = self._init  # type: ignore[method-assign]


def seconds_of_messages() -> tuple[float, float]:
    """Seconds of a message of half a product, and of a reduction, of a rank with itself."""
    one, many = (of_many(partial(exchange, *messages(count))) for count in (1, 16))
    numbers = np.zeros(3)
    return (many - one) / 15, of_many(lambda: MPI.COMM_SELF.Allreduce(MPI.IN_PLACE, numbers.copy()))


def messages(count: int) -> tuple[Messages, np.ndarray]:
    """So many messages of one body each, and the table that they are for."""
    each, rows = [(0, slice(k, k + 1)) for k in range(count)], np.arange(count)
    kind = (True, (6,), np.dtype(np.float32))
    return Messages(MPI.COMM_SELF, kind, rows, count + rows, each, each), np.zeros((2 * count, 6), np.float32)


def exchange(messages: Messages, values: np.ndarray) -> None:
    messages.start(values)
    for rows, arrived in messages.wait():
        values[rows] += arrived


def of_many(do: Callable[[], object]) -> float:
    """CPU seconds of a short call."""
    return least_seconds(lambda: [do() for _ in range(200)], 20) / 200


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


class Model:
    """Seconds on a cluster. An exchange takes one latency, beside what the processor takes for each message, and the
    bytes (Culler et al., "LogP: towards a realistic model of parallel computation", PPoPP 1993).

    alone, two, beds : the rows of `steps` on one and on two ranks, of sizes that grow, and of `counted`
    own : seconds of a message and of a reduction (`seconds_of_messages`)
    latency, bandwidth : of a message (s, bytes/s)
    """

    def __init__(self, alone: list[Row], two: list[Row], beds: list[Row], own: tuple[float, float],
                 latency: float, bandwidth: float):  # fmt: skip
        self.alone, self.beds, self.own, self.latency, self.bandwidth = alone, beds, own, latency, bandwidth
        self.halos, self.reductions = two[-1]["halos"], two[-1]["reductions"]
        #: what a rank with neighbours takes more in an iteration, and in a step outside of the solve, however few
        #: contacts it has
        self.ghosts, self.others = (
            max(statistics.median(row[name] - self.of_one(name, row["contacts"]) for row in two[:3]), 0.0)
            for name in ("own_s", "outside_s")
        )

    def of_one(self, name: str, contacts: float) -> float:
        """What one rank with so many contacts takes, without messages: as measured, between sizes along a line, and
        beyond the last in proportion."""
        sizes = [row["contacts"] for row in self.alone]
        seconds = np.interp(min(contacts, sizes[-1]), sizes, [row[name] for row in self.alone])
        return float(seconds) * max(contacts / sizes[-1], 1.0)

    def iteration(self, ranks: int, contacts: float) -> tuple[float, float, float, float]:
        """Work on contacts with the fixed part of Python, exchanges, reductions (s); kB that a rank sends in a
        product."""
        work = self.of_one("own_s", contacts / ranks * (LOAD if ranks > 1 else 1.0))
        if ranks == 1:
            return work, 0.0, 0.0, 0.0
        row = self._bed(ranks, contacts)
        share = contacts / ranks / row["contacts"]["mean"]
        sent = BODY * row["moved"]["most"] * share ** (2 / 3)
        product = 2 * self.latency + row["messages"]["most"] * self.own[0] + sent / self.bandwidth
        exchange = self.ghosts + self.halos / 2 * product
        return work, exchange, self.reductions * self.reduction(ranks), sent / 1e3

    def reduction(self, ranks: int) -> float:
        return float(self.own[1] + 2 * np.ceil(np.log2(ranks)) * self.latency)

    def _bed(self, ranks: int, contacts: float) -> Row:
        """The bed whose pieces are the nearest in size."""
        beds = [row for row in self.beds if row["ranks"] == ranks]
        return min(beds, key=lambda row: abs(np.log(row["contacts"]["mean"] * ranks / contacts)))

    def outside(self, ranks: int, contacts: float) -> tuple[float, float]:
        """Of a step outside of the solve: work, and waiting for all (s)."""
        work = self.of_one("outside_s", contacts / ranks * (LOAD if ranks > 1 else 1.0))
        if ranks == 1:
            return work, 0.0
        lists = self._bed(ranks, contacts)["touched_s"] + ranks * BOXES / self.bandwidth
        return work, self.others + OUTSIDE * self.reduction(ranks) + self.alone[-1]["new_lists"] * lists

    def cell(self, ranks: int, contacts: float, its: float) -> str:
        """Milliseconds of a step, with the part of an iteration that is work."""
        work, exchange, reductions, _ = self.iteration(ranks, contacts)
        whole = work + exchange + reductions
        step = its * whole + sum(self.outside(ranks, contacts))
        return f"{1e3 * step:,.3g} ({work / whole:.2f})"


def main() -> None:
    line = shared.parser("cluster_model", __doc__)
    line.add_argument("n", type=shared.at_least_one, nargs="?", default=16, help="size of the mixer that is cut")
    line.add_argument("-sizes", type=shared.listed(int), default="1,2,4,8,16", help="of mixers that make steps")
    line.add_argument("-copies", type=shared.listed(int), default="3,3,2", help="of the bed along x, y, z")
    line.add_argument("-latency", type=float, default=2e-6, help="seconds of a message between nodes, assumed")
    line.add_argument("-bandwidth", type=float, default=1e9, help="bytes per second of a rank between nodes, assumed")
    line.add_argument("-conic", type=shared.at_least_one, help="size of the mixer that `conic` solves")
    words = line.parse_args()
    if not words.latency > 0 or not words.bandwidth > 0:
        line.error("-latency, -bandwidth: allowed are numbers > 0")
    if len(words.copies) != 3 or min(words.copies) < 1 or sorted(set(words.sizes)) != words.sizes or not words.sizes:
        line.error("-copies: allowed are three numbers > 0; -sizes: numbers > 0 that grow")
    about = shared.say_machine() | {"latency": words.latency, "bandwidth": words.bandwidth}
    if words.conic:
        rows = [row for ranks in (1, 2) for row in start(ranks, "--conic", words.conic)]
        print(markdown(list(rows[0]), [list(row.values()) for row in rows]))
        shared.record(f"cluster_model_conic_n{words.conic}", about, rows)
        return
    beds = start(1, "--pieces", words.n, *words.copies)
    print(table(beds))
    alone, both = ([start(ranks, "--steps", n) for n in words.sizes] for ranks in (1, 2))
    about["here"], about["own"] = start(2, "--ping"), start(1, "--messages")
    names = list(alone[0])
    print(markdown(names, [[f"{row[name]:.4g}" for name in names] for row in alone + both]))
    print("seconds of a message and a reduction within a rank:", about["own"])
    print("seconds of a message between the ranks here, bytes per second:", about["here"])
    here = Model(alone, both, beds, about["own"], *about["here"])
    print(f"ghosts take {1e6 * here.ghosts:.0f} us in an iteration, {1e3 * here.others:.1f} ms outside")
    for row, two in zip(alone, both):
        whole, outside = sum(here.iteration(2, row["contacts"])[:3]), sum(here.outside(2, row["contacts"]))
        print(f"n = {row['n']}, two ranks: an iteration takes {1e6 * two['iteration_s']:.0f} us, by the model "
              f"{1e6 * whole:.0f}; outside {1e3 * two['outside_s']:.1f} ms, {1e3 * outside:.1f}")  # fmt: skip
    model, its = Model(alone, both, beds, about["own"], words.latency, words.bandwidth), alone[-1]["its"]
    heads = ["ranks", *(f"n = {n}" for n in SIZES), f"{SHARE:,} contacts a rank"]
    of_ranks = [ranks for ranks in MODEL if ranks <= beds[-1]["ranks"]]
    sizes = [[contacts for _, contacts in SIZES.values()] + [ranks * SHARE] for ranks in of_ranks]
    print(markdown(heads, [
        [ranks, *(model.cell(ranks, contacts, its) for contacts in row)]
        for ranks, row in zip(of_ranks, sizes)
    ]))  # fmt: skip
    ranks = of_ranks[-1]
    for contacts in (SIZES[32][1], ranks * SHARE):
        parts = [*model.iteration(ranks, contacts), *model.outside(ranks, contacts)]
        print(f"{ranks} ranks, {contacts:,} contacts: work, exchanges, reductions (s), kB, outside, waiting (s)", parts)
    shared.record("cluster_model", about, alone + both + beds)


def table(rows: list[Row]) -> str:
    """What was counted, of the rank that has the most of it."""
    heads = ["bodies", "ranks", "contacts, most / mean", "bodies, most", "ghosts", "ghosts / bodies^(2/3)"]
    heads += ["messages, most, mean", "kB per product", "boxes, ms"]
    return markdown(heads, [
        [
            f"{row['bed']:,}", row["ranks"],
            f"{row['contacts']['most']:,} / {row['contacts']['most'] / row['contacts']['mean']:.3f}",
            f"{row['bodies']['most']:,}", f"{row['ghosts']['most']:,}",
            f"{row['ghosts']['most'] / row['bodies']['mean'] ** (2 / 3):.1f}",
            f"{row['messages']['most']}, {row['messages']['mean']:.1f}", f"{BODY * row['moved']['most'] / 1e3:.1f}",
            f"{1e3 * row['touched_s']:.2g}",
        ]
        for row in rows
    ])  # fmt: skip


def start(ranks: int, *words: object) -> Any:
    """What rank 0 of this script says on so many ranks."""
    said, failure = shared.lines_of([shared.MPIEXEC, "-n", ranks, sys.executable, __file__, *words])
    if failure:
        sys.exit(f"run/study cluster_model: {' '.join(map(str, words))} on {ranks} ranks: {failure}")
    return said[-1]


if __name__ == "__main__":
    what, numbers = sys.argv[1:2], sys.argv[2:]
    if what == ["--pieces"]:
        found: Any = counted(int(numbers[0]), [int(number) for number in numbers[1:]])
    elif what == ["--steps"]:
        found = steps(int(numbers[0]))
    elif what == ["--conic"]:
        PETSc.Log.begin()
        found = conic(int(numbers[0]))
    elif what == ["--ping"]:
        found = ping_pong()
    elif what == ["--messages"]:
        found = seconds_of_messages()
    else:
        main()
        raise SystemExit
    if MPI.COMM_WORLD.rank == 0:
        print(json.dumps(found))
