"""Trains of matrices given by their entries: set-up, iterations and growth with the grid, beside LAPACK's Cholesky
and the best train of the exact inverse: run/study integral_equations [-quick]. Writes
results/integral_equations.json and .png."""

from __future__ import annotations

import argparse
import resource
import statistics
import sys
from pathlib import Path
from typing import Any

import numpy as np
from shared import exponent, figure, record, say_machine

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "docs" / "examples"))
from comparison import cg, cholesky, operator, seconds
from integral_problems import Problem, fredholm, potential

from pctt import tt

REPEAT = 3
EPS = 1e-2
GROWTH = {"Fredholm": (fredholm, (64, 128, 256, 512, 1024, 2048)), "1/r": (potential, (16, 32, 64, 128))}


def solved(problem: Problem) -> dict[str, Any]:
    """CG with the train and without, medians of CPU seconds."""
    true, mat = problem.product(), operator(problem)
    rows = [cg(mat, "train", "tt", true) for _ in range(REPEAT)]
    plain = cg(mat, "plain", "none", true)
    mat.destroy()
    row = {"problem": problem.name, "unknowns": problem.size, "iterations": rows[0].iterations}
    row |= {"without": plain.iterations, "setup_s": statistics.median(r.setup_s for r in rows)}
    row |= {"solve_s": statistics.median(r.solve_s for r in rows), "plain_s": plain.solve_s}
    row |= {"residual": rows[0].residual, "bytes": rows[0].bytes}
    return row


def engine(problem: Problem) -> dict[str, Any]:
    """Seconds of cross and inverse alone."""
    digits = tt.GridDigits(problem.grid)
    crosses, inverses = [], []
    for _ in range(REPEAT):
        cross_s, found = seconds(lambda: tt.compress_cross(tt.EntryMatrix(problem.entries, digits), 100, EPS))
        inverse_s, inverse = seconds(lambda found=found: inverse_of(found.train))
        crosses.append(cross_s)
        inverses.append(inverse_s)
    return {
        "problem": problem.name, "unknowns": problem.size, "cross_s": statistics.median(crosses),
        "inverse_s": statistics.median(inverses), "ranks": [max(found.train.ranks), max(inverse.train.ranks)],
        "error": found.error, "residual": inverse.residual, "evaluations": found.evaluations,
    }  # fmt: skip


def inverse_of(train: tt.Train) -> tt.Inverse:
    """Of the matrix, which is symmetric where the train is nearly."""
    return tt.invert_near_identity(train.symmetric_part(0.1 * EPS), 100, eps=EPS)


def against_unknowns(rows: list[dict[str, Any]], part: str) -> tuple[list[float], list[float]]:
    """Unknowns and seconds of a part."""
    return [row["unknowns"] for row in rows], [row[f"{part}_s"] for row in rows]


def beside_best(problem: Problem) -> dict[str, Any]:
    """Residual of the inverse over that of the TT-SVD of the exact inverse, of the same greatest rank."""
    digits = tt.GridDigits(problem.grid)
    T = tt.compress_cross(tt.EntryMatrix(problem.entries, digits), 200, 1e-8).train
    one = np.eye(T.shape[0])
    S = one + T.full()
    exact = np.linalg.inv(S) - one
    row: dict[str, Any] = {"problem": problem.name, "ranks": [], "ratios": []}
    for eps in (1e-2, 1e-3):
        Z = tt.invert_near_identity(T, 100, eps=eps).applied
        best = tt.decompose_matrix(exact, T.rows, max_rank=max(Z.ranks))
        left, least = (float(np.linalg.norm(one - S @ (one + X.full()))) for X in (Z, best))
        row["ranks"].append(max(Z.ranks))
        row["ratios"].append(left / least)
    return row


def say(what: str, value: float, target: float, unit: str = "") -> dict[str, Any]:
    met = value <= target
    print(f"{what:58} {value:9.3g} {unit:3} target {target:g}: {'met' if met else 'MISSED'}", flush=True)
    return {"what": what, "value": value, "target": target, "met": met}


def main(given: argparse.Namespace) -> None:
    about = say_machine()
    rows: list[dict[str, Any]] = []
    for problem, setup, its in ((fredholm(512), 0.5, 4), (potential(64), 2.0, 6)):
        row = solved(problem)
        rows.append(row)
        print(f"{problem.name}, products by FFT: CG + train {row['setup_s']:.2f} + {row['solve_s']:.2f} s, "
              f"{row['iterations']} iterations; CG alone {row['plain_s']:.2f} s, "
              f"{row['without']} iterations")  # fmt: skip
        rows.append(say(f"{problem.name}: set-up", row["setup_s"], setup, "s"))
        rows.append(say(f"{problem.name}: iterations to 1e-8", row["iterations"], its))
    growth = {}
    for name, (make, sizes) in GROWTH.items():
        growth[name] = [engine(make(n)) for n in (sizes[:-1] if given.quick else sizes)]
        for row in growth[name]:
            figures = f"cross {row['cross_s']:.3f} s, inverse {row['inverse_s']:.3f} s, ranks {row['ranks']}"
            print(f"{row['problem']}: {figures}", flush=True)
        rows += growth[name]
        rows += [say(f"{name}: exponent of {part}", exponent(*against_unknowns(growth[name], part)), 0.2)
                 for part in ("cross", "inverse")]  # fmt: skip
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    last = growth["Fredholm"][-1]
    rows.append(say(f"{last['problem']}: cross and inverse", last["cross_s"] + last["inverse_s"], 10, "s"))
    rows.append(say("peak memory until here", memory, 2, "GiB"))
    for n, target in ((20, 5.0), (32, 200.0)):
        row, dense = solved(potential(n)), cholesky(potential(n), potential(n).product())
        ratio = (dense.setup_s + dense.solve_s) / (row["setup_s"] + row["solve_s"])
        rows.append(say(f"1/r {n}^3: train over dense Cholesky {dense.note}", 1 / ratio, 1 / target))
        print(f"  {ratio:.0f} times faster: {dense.setup_s:.1f} s and {row['setup_s'] + row['solve_s']:.2f} s")
    for problem in (fredholm(32), *(() if given.quick else (potential(16),))):
        row = beside_best(problem)
        rows += [row, say(f"{problem.name}: residual over the best of that rank", max(row["ratios"]), 3)]
    record("integral_equations", about, rows)
    draw(growth)


def draw(growth: dict[str, list[dict[str, Any]]]) -> None:
    """Seconds of cross and inverse against the unknowns."""
    with figure("integral_equations", 1) as panels:
        for axes in panels:
            for name, found in growth.items():
                for part, line in (("cross", "-"), ("inverse", "--")):
                    axes.loglog(*against_unknowns(found, part), line + "o", label=f"{name}, {part}")
            axes.set_xlabel("unknowns")
            axes.set_ylabel("CPU seconds")
            axes.legend()


if __name__ == "__main__":
    words = argparse.ArgumentParser("run/study integral_equations", description=__doc__)
    words.add_argument("-quick", action="store_true", help="without the largest grids")
    main(words.parse_args())
