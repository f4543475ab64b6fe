"""Trains of rank 1 to 40 and every other preconditioner on an early, a middle and a late Newton system of one time
step: run/study study_ranks [N] [-packing mixer|fcc|cubic] [-rtol TOL] [-seconds S], default the settled mixer of
n = 4. Writes results/study_ranks_PACKING_nN.json."""

from __future__ import annotations

import argparse
import time
from typing import Any

from mpi4py import MPI
from newton_systems import Replay, replay_steps, settled
from petsc4py import PETSc
from shared import record, say_machine

from pctt.ccp.newton.compare import NAMED
from pctt.ccp.newton.krylov import Krylov

PARTS = (0.15, 0.5, 0.85)  # of the Newton steps: the systems that are solved
CAPS = (1, 2, 4, 10, 20, 40)
NAMES = ("none", "pbjacobi", "ilu", "ilu-shifted", "sor", "icc-shifted", "gamg", "hypre", "cholesky")
FACTORS = 50_000  # contacts above which nothing is factorised completely: memory
TRAIN = {"pc_type": "python", "pc_python_type": "pctt.pc.TensorTrain"}


def methods() -> dict[str, dict[str, str]]:
    """PETSc options of each by name."""
    trains = {f"tt {cap}": {**TRAIN, "pc_tt_rank": str(cap)} for cap in CAPS}
    return {**{name: NAMED.get(name, {"pc_type": name}) for name in NAMES}, **trains}


def limited(ksp: PETSc.KSP, rtol: float, seconds: float) -> None:
    """PETSc's test of convergence, and an end when a solve has taken so many seconds."""
    start = first = 0.0

    def test(ksp: PETSc.KSP, its: int, norm: float) -> int:
        nonlocal start, first
        if its == 0:
            start, first = time.perf_counter(), norm
        if norm <= rtol * first:
            return PETSc.KSP.ConvergedReason.CONVERGED_RTOL
        if not norm < 1e5 * first:
            return PETSc.KSP.ConvergedReason.DIVERGED_DTOL
        late = time.perf_counter() - start > seconds
        return PETSc.KSP.ConvergedReason.DIVERGED_MAX_IT if late else PETSc.KSP.ConvergedReason.ITERATING

    ksp.setConvergenceTest(test)


def solve(matrix: PETSc.Mat, b: PETSc.Vec, name: str, given: argparse.Namespace) -> dict[str, Any]:
    """One system by one method, from nothing; the figures."""
    x = b.duplicate()
    krylov = Krylov(MPI.COMM_WORLD, name.replace(" ", "") + "_", methods()[name], rtol=given.rtol)
    if krylov.method != "preonly":
        limited(krylov.ksp, given.rtol, given.seconds)
    done = krylov.solve(matrix, b, x)
    row = {"its": done.iterations, "setup_s": done.setup_s, "solve_s": done.solve_s}
    row |= {"solved": done.true_residual <= 2 * given.rtol, "true_residual": done.true_residual}
    row["reason"] = done.reason if done.solve_s < given.seconds or done.converged else f"{given.seconds:g} s"
    if name.startswith("tt"):
        train = krylov.ksp.pc.getPythonContext()
        row |= {"cap": int(train.options.rank), "rank": train.rank, "fallbacks": train.account.fallbacks}
    krylov.destroy()
    x.destroy()
    return row


def cell(row: dict[str, Any]) -> str:
    if "its" not in row:
        return f"{row['reason']:>28}"
    mark = "" if row["solved"] else f" {row['true_residual']:.0e}!"
    fell = "j" if row.get("rank") == 1 < row["cap"] else ""
    return f"{row['its']:5d}{fell:1} {row['setup_s']:7.3f} {row['solve_s']:7.3f}{mark:>7}"


def main(given: argparse.Namespace) -> None:
    about = say_machine()
    rows: list[dict[str, Any]] = []

    def look(replay: Replay) -> None:
        count = len(replay.systems)
        chosen = sorted({min(count - 1, round(part * count)) for part in PARTS})
        print(f"{given.packing} n = {given.n}: {replay.contacts} contacts, {count} Newton steps, 1 rank")
        print(f"BiCGStab from the right to a true residual of {given.rtol:g}; per system iterations, set-up s, solve s")
        print("!: true residual of what was not solved; j: no positive train of this rank, block Jacobi in its place")
        print(f"{'Newton step':12} " + " ".join(f"{k + 1:>28}" for k in chosen))
        for name in methods():
            cells = []
            for k in chosen:
                matrix = replay.matrix(replay.systems[k])
                b = matrix.createVecLeft()
                b.array[:] = replay.systems[k].b
                factor = name == "cholesky" and replay.contacts > FACTORS
                row = {"reason": "not run: memory"} if factor else solve(matrix, b, name, given)
                b.destroy()
                rows.append({"name": name, "newton_step": k + 1, "contacts": replay.contacts, **row})
                cells.append(cell(row))
            print(f"{name:12} " + " ".join(cells), flush=True)

    words = settled(given.n)
    if given.packing != "mixer":
        words = ["-scene", "run/studies/crystal.py", "-scene_n", given.n, "-scene_lattice", given.packing]
    (step,) = replay_steps(words, 1, look)
    print(f"pdip with block Jacobi: natural residual {step['natural_residual']:.1e}, {step['reason']}")
    record(f"study_ranks_{given.packing}_n{given.n}", about, rows)


if __name__ == "__main__":
    words = argparse.ArgumentParser("run/study study_ranks", description=__doc__)
    words.add_argument("n", type=int, nargs="?", default=4, help="size of the packing (4)")
    words.add_argument("-packing", choices=("mixer", "fcc", "cubic"), default="mixer",
                       help="the settled mixer, or a crystal of spheres at rest (mixer)")  # fmt: skip
    words.add_argument("-rtol", type=float, default=1e-4, help="true residual, relative (1e-4)")
    words.add_argument("-seconds", type=float, default=60, help="after which a solve is given up (60)")
    main(words.parse_args())
