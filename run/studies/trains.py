"""Trains on the Newton systems of settled mixer steps, as the paper measures them:

    run/study trains ranks [N] [-caps 10,100] [-every K]   its tables 1 and 2: ranks, errors and seconds per PDIP solve
    run/study trains reuse [N ...] [-steps K] [-every K]   seconds of set-up without over those with reuse of trains,
                                                           set-ups that keep or make one, iterations with either
    run/study trains scaling [N ...]                       seconds of set-up and application against the contacts

The systems are those of `pdip` with block Jacobi, from a cold start and of rigid contacts, recorded and handed to every
configuration; `apgd` makes the time steps. Writes results/trains_WHAT.json, and figures of reuse and scaling.
"""

from __future__ import annotations

import sys
import time
from argparse import Namespace
from typing import Any

import petsc4py

petsc4py.init([sys.argv[0]])

import numpy as np
from newton_systems import COMM, Replay, replays
from petsc4py import PETSc
from shared import Row, Table, figure, listed, median_seconds, parser, record, say_machine

from pctt.ksp_options import entered
from pctt.pc import TensorTrain
from pctt.pc.sparse_train import SparseTrain

EPS = (1e-2, 1e-3, 1e-4)
# (eps, cap): average ranks of matrix and inverse, seconds of compression and inversion per PDIP solve
PAPER = {
    (1e-2, 10): (4.6, 4.4, 10), (1e-2, 100): (10.5, 6.7, 25), (1e-2, 1000): (10.5, 6.7, 25),
    (1e-3, 10): (8.7, 8.5, 16), (1e-3, 100): (59.3, 45.2, 1244), (1e-3, 1000): (65.2, 46.4, 1317),
    (1e-4, 10): (9.1, 9.0, 16), (1e-4, 100): (68.6, 58.1, 2740), (1e-4, 1000): (113.3, 91.2, 8157),
}  # fmt: skip
LEVELS = ("none", "newton", "trains")  # of reuse: nothing, cores within a time step, whole trains from step to step
REUSE = ("none", "cores", "trains")  # their -pc_tt_reuse
COUNTS = ("made", "kept", "none", "anew")  # of the last level
SOLVED = ("none", "trains", "pbjacobi")  # levels whose trains solve a system, and the preconditioner without a train
CAP = 1000  # iterations
EARLY, REPEAT = 6, 3  # `scaling` takes the last two of so many Newton systems, so often

# -- set-ups, watched -----------------------------------------------------------------------------------------


class WatchedSparseTrain(SparseTrain):
    """Whose phases are timed into ``rows[-1]``, the list of its `WatchedTrain`."""

    rows: list[Row]

    def _compress(self, warm: bool):
        start = time.perf_counter()
        found = super()._compress(warm)
        self.rows[-1] |= {"compress_s": time.perf_counter() - start, "error": found.error}
        self.rows[-1] |= {"matrix_rank": mean_rank(found.train.ranks)}
        return found

    def _invert(self, warm: bool, null: list[np.ndarray]):
        start = time.perf_counter()
        inverse = super()._invert(warm, null)
        self.rows[-1] |= {"invert_s": time.perf_counter() - start, "residual": inverse.residual}
        # what is stored of I + Z is Z, of one rank less
        self.rows[-1] |= {"inverse_rank": mean_rank(inverse.applied.ranks) + inverse.identity}
        return inverse

    def _is_positive(self, P: PETSc.Mat) -> bool:
        self.rows[-1] |= {"positive": super()._is_positive(P)}
        return self.rows[-1]["positive"]


class WatchedTrain(TensorTrain):
    """A tensor train whose set-ups are timed phase by phase; a rank that failed is always tried again at once.

    Attributes
    ----------
    rows : a dict of figures per set-up; ``rank`` is 1 where no positive inverse came of it
    """

    sparse_train = WatchedSparseTrain

    def create(self, pc: PETSc.PC) -> None:
        super().create(pc)
        self.rows: list[Row] = []

    def update(self, pc: PETSc.PC, P: PETSc.Mat) -> None:
        assert isinstance(self.made, WatchedSparseTrain)
        self.made.rows, self.made.failure = self.rows, ""
        self.rows.append({})
        super().update(pc, P)
        self.rows[-1] |= {"setup_s": self._made_in, "rank": self.rank}


def mean_rank(ranks: tuple[int, ...]) -> float:
    """Of the inner bonds of a train."""
    return float(np.mean(ranks[1:-1])) if len(ranks) > 2 else 1.0


def train_pc(**options: Any) -> PETSc.PC:
    """A train with these options -pc_tt_*, of a fixed rank if they have one."""
    pc = PETSc.PC().create(COMM)
    pc.setOptionsPrefix("watched_")
    pc.setType("python")
    pc.setPythonContext(WatchedTrain())
    with entered({f"watched_pc_tt_{name}": str(value) for name, value in options.items()}):
        pc.setFromOptions()
    return pc


def set_up(pc: PETSc.PC, matrix: PETSc.Mat) -> Row:
    """Make the preconditioner; the figures of the set-up."""
    pc.setOperators(matrix)
    pc.setUp()
    return pc.getPythonContext().rows[-1]


# -- ranks ----------------------------------------------------------------------------------------------------


def of_cap(replay: Replay, eps: float, cap: int, scaling: str, every: int) -> Row:
    """Averages over the systems, and seconds per PDIP solve: means times all its Newton steps."""
    pc = train_pc(eps=eps, rank=cap, variant=scaling, reuse="cores")
    done = [dict(set_up(pc, replay.matrix(system))) for system in replay.systems[::every]]
    pc.destroy()
    rows = [row for row in done if "inverse_rank" in row]
    row: Row = {"scaling": scaling, "eps": eps, "cap": cap, "contacts": replay.contacts}
    row |= {"newton_steps": len(replay.systems), "set_ups": len(done), "positive": sum(row["positive"] for row in rows)}
    row |= {name: float(np.mean([row[name] for row in rows])) for name in ("matrix_rank", "inverse_rank", "error")}
    row["residual"] = float(np.median([row["residual"] for row in rows]))
    for name in ("compress_s", "invert_s"):
        row[name] = len(replay.systems) * float(np.mean([row[name] for row in rows]))
    return row


def ranks(given: Namespace) -> list[Row]:
    """Average ranks of trains and of their inverses, with and without block scaling."""
    steps = replays(given.n)
    replay = next(steps)
    print(f"mixer n = {given.n}: {replay.contacts} contacts, {len(replay.systems)} Newton steps, 1 rank")
    print("means over the Newton steps (residual: median); seconds per PDIP solve; paper: ranks and seconds")
    table = Table(
        scaling=("scaling", "<8"), eps=("eps", "8.0e"), cap=("cap", "5d"), rank_S=("matrix_rank", "6.1f"),
        rank_X=("inverse_rank", "6.1f"), paper=("paper", "18"), error=("error", "9.3g"), residual=("residual", "9.3g"),
        positive=(lambda row: f"{row['positive']}/{row['set_ups']}", "8"), compress_s=("compress_s", "10.2f"),
        invert_s=("invert_s", "10.2f"),
    )  # fmt: skip
    rows: list[Row] = []
    for scaling, cap, eps in [(way, cap, eps) for way in ("own", "unscaled") for cap in given.caps for eps in EPS]:
        every = given.every if cap <= 10 else max(given.every, len(replay.systems) // 3)
        rows.append(of_cap(replay, eps, cap, scaling, every))
        paper = "{}/{} {} s".format(*PAPER[eps, cap]) if (eps, cap) in PAPER else "-"
        table.add({**rows[-1], "paper": paper})
    steps.close()
    return rows


# -- reuse ----------------------------------------------------------------------------------------------------


def reuse(given: Namespace) -> list[Row]:
    """A row per time step: set-ups of every Newton system by every level of reuse."""
    rows: list[Row] = []
    names = [f"{what}, {level}" for level in LEVELS[1:] for what in ("first", "all")]
    print("seconds of set-up without reuse / with reuse within a time step (newton) and from step to step (trains):")
    print("of the first Newton system of a step, and of all; then how many trains the last level made, how many")
    print("set-ups kept one or had no positive one, and how often its slots were found anew; BiCGStab iterations for")
    print("the middle Newton system with a train of its own, with that of the last level, and with block Jacobi")
    table = Table(n=("n", "3d"), step=("step", "6"), contacts=("contacts", "9"), Newton=("newton", "7"),
                  **{name: (name, "13.2f") for name in names}, **{name: (name, "7") for name in COUNTS},
                  **{f"its_{name}": (f"its {name}", "10") for name in SOLVED})  # fmt: skip
    for n in given.n:
        pcs = {level: train_pc(reuse=of_level, rank=10, eps=1e-2) for level, of_level in zip(LEVELS, REUSE)}
        account, before = pcs["trains"].getPythonContext().account, dict.fromkeys(COUNTS, 0)
        for step, replay in enumerate(replays(n, given.steps), start=1):
            seconds: dict[str, list[float]] = {level: [] for level in LEVELS}
            row: Row = {"n": n, "step": step, "contacts": replay.contacts, "newton": len(replay.systems)}
            pcs["newton"].destroy()
            pcs["newton"] = train_pc(reuse="cores", rank=10, eps=1e-2)
            pcs["trains"].reset()
            timed = (step - 2) % given.every == 0
            levels = LEVELS if timed else LEVELS[-1:]
            for k, system in enumerate(replay.systems):
                matrix = replay.matrix(system)
                for turn in range(len(levels)):
                    level = levels[(k + turn) % len(levels)]  # each is the first, with a cold cache, as often
                    if level == "none":
                        pcs[level].reset()
                    seconds[level].append(set_up(pcs[level], matrix)["setup_s"])
                if timed and k == len(replay.systems) // 2:
                    row |= {f"its {name}": iterations(pcs.get(name), matrix, system.b) for name in SOLVED}
            for level in LEVELS[1:] if timed else ():
                row[f"first, {level}"] = seconds["none"][0] / seconds[level][0]
                row[f"all, {level}"] = sum(seconds["none"]) / sum(seconds[level])
            none = sum(account.fallbacks.values())
            after = {"made": account.setups - account.kept - none, "kept": account.kept, "none": none}
            after["anew"] = account.resets
            row |= {name: after[name] - before[name] for name in COUNTS}
            before = after
            rows.append(row | {"seconds": seconds})
            if step > 1:  # the first step of a run has nothing to start from
                table.add(row)
        for pc in pcs.values():
            pc.destroy()
        later = [row for row in rows if row["n"] == n][1:]
        every = [*names, *(f"its {name}" for name in SOLVED)]
        timed_rows = [row for row in later if names[0] in row]
        medians = {name: float(np.median([row[name] for row in timed_rows])) for name in every}
        table.add({"n": n, "step": "median", **medians})
        table.add({"n": n, "step": "sum", **{name: sum(row[name] for row in later) for name in ("newton", *COUNTS)}})
        with figure(f"trains_reuse_n{n}", 2) as panels:
            for axes, what in zip(panels, ("first", "all")):
                for level in LEVELS[1:]:
                    ratios = [row[f"{what}, {level}"] for row in timed_rows]
                    axes.semilogy([row["step"] for row in timed_rows], ratios, ".", label=level)
                axes.set(title=f"{what} Newton systems of a step", xlabel="time step", ylabel="set-up without / with")
                axes.legend()
    return rows


def iterations(pc: PETSc.PC | None, matrix: PETSc.Mat, right_side: np.ndarray) -> int:
    """Of BiCGStab, to 1e-4, with this preconditioner, which is set up, or with block Jacobi; the cap is the paper's."""
    ksp = PETSc.KSP().create(COMM)
    if pc is not None:
        ksp.setPC(pc)
    ksp.setOperators(matrix)
    if pc is None:
        ksp.getPC().setType("pbjacobi")
    ksp.setType("bcgs")
    ksp.setPCSide(PETSc.PC.Side.RIGHT)
    ksp.setTolerances(rtol=1e-4, max_it=CAP)
    x, b = matrix.createVecs()
    b.array[:] = right_side
    ksp.solve(b, x)
    its = ksp.getIterationNumber()
    ksp.destroy()
    return int(its)


# -- scaling --------------------------------------------------------------------------------------------------


def phases(replay: Replay) -> Row:
    """Seconds for a cold start with a matrix and a warm one with the next, medians; of an application, and of S x."""
    runs: dict[str, list[float]] = {}
    for way in ("own", "cross") * REPEAT:
        pc = train_pc(variant=way, rank=10, eps=1e-2, reuse="cores")
        for state, system in zip(("cold", "warm"), replay.systems[-2:]):
            done = set_up(pc, replay.matrix(system))
            runs.setdefault(f"{way} {state}", []).append(done["compress_s"])
            if way == "own":
                runs.setdefault(f"invert {state}", []).append(done["invert_s"])
                runs.setdefault(f"set-up {state}", []).append(done["setup_s"])
        pc.destroy()
    row: Row = {name: float(np.median(seconds)) for name, seconds in runs.items()}
    matrix = replay.matrix(replay.systems[-1])
    pc = train_pc(rank=10, eps=1e-2)
    x, y = matrix.createVecs()
    x.array[:] = np.random.default_rng(0).standard_normal(x.getLocalSize())
    good = set_up(pc, matrix)["rank"] > 1  # else it is block Jacobi
    row["apply"] = median_seconds(lambda: pc.apply(x, y)) if good else np.nan
    row["product"] = median_seconds(lambda: matrix.mult(x, y))
    pc.destroy()
    return row


def scaling(given: Namespace) -> list[Row]:
    """A row per size, and the exponents p of the seconds ~ contacts^p, by least squares of the logarithms."""
    rows: list[Row] = []
    print(f"rank 10, eps 1e-2, 1 rank; medians of {REPEAT} set-ups, 5 applications; seconds")
    for n in given.n:
        (row,) = ({"n": n, "contacts": replay.contacts, **phases(replay)} for replay in replays(n, max_it=EARLY))
        names = [*row][2:]
        if not rows:
            table = Table(n=("n", "3"), contacts=("contacts", "9"), **{name: (name, "11.4f") for name in names})
        rows.append(row)
        table.add(row)
    contacts = [row["contacts"] for row in rows]
    powers: Row = dict.fromkeys(names, np.nan)
    for name in names if len(rows) > 1 else ():
        powers[name] = float(np.polyfit(np.log(contacts), np.log([row[name] for row in rows]), 1)[0])
    table.add({"contacts": "exponent", **powers})
    with figure("trains_scaling", 1) as panels:
        for axes in panels:
            for name in names:
                axes.loglog(contacts, [row[name] for row in rows], "o-", label=f"{name}: Nc^{powers[name]:.2f}")
            axes.set(xlabel="contacts Nc", ylabel="seconds")
            axes.legend(fontsize="small")
    return [*rows, {"exponents": powers}]


if __name__ == "__main__":
    words = parser("trains", __doc__)
    kinds = words.add_subparsers(dest="what", required=True)
    of_ranks, of_reuse, of_scaling = (kinds.add_parser(name) for name in ("ranks", "reuse", "scaling"))
    of_ranks.add_argument("n", type=int, nargs="?", default=8, help="size of the mixer (8; the paper's is 16)")
    of_ranks.add_argument("-caps", default="10,100", type=listed(int), help="of ranks, with commas between (10,100)")
    of_ranks.add_argument("-every", type=int, default=1, help="every K-th system (1; caps over 10: three in all)")
    of_reuse.add_argument("n", type=int, nargs="*", default=[4, 8], help="sizes of the mixer (4 8)")
    of_reuse.add_argument("-steps", type=int, default=31, help="time steps of each, the first not counted (31)")
    of_reuse.add_argument("-every", type=int, default=1, help="levels that forget are set up in every K-th step (1)")
    of_scaling.add_argument("n", type=int, nargs="*", default=[2, 4, 8, 16], help="sizes of the mixer (2 4 8 16)")
    given = words.parse_args()
    about = say_machine()
    record(f"trains_{given.what}", about, {"ranks": ranks, "reuse": reuse, "scaling": scaling}[given.what](given))
