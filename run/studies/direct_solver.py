"""The train as a direct solver, `pctt.mat.inverse`, for I + 1/(4 pi r) on n^3 points:
run/study direct_solver [-n N ...] [-seconds S]. Each row is a process of its own with a limit of S seconds. Writes
results/direct_solver.json.

The seconds of the inversion contain a product and an application, with which `inverse` measures its error."""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
from shared import record, say_machine

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "docs" / "examples"))
from comparison import right_side, seconds
from integral_problems import Problem, potential
from petsc4py import PETSc

from pctt.mat import from_entries, inverse

SIZES, EPS = (16, 32, 64, 128), (1e-3, 1e-6)
MAX_RANK = 300
HEAD = f"{'':24}{'compress s':>11}{'rank':>5}{'MB':>7}{'invert s':>10}{'rank':>5}{'MB':>7}{'apply s':>9}" \
       f"{'residual':>10}{'peak GiB':>9}"  # fmt: skip


def problem(n: int) -> Problem:
    """u(x) + int u(y) / (4 pi |x - y|) dy = f(x) in a cube."""
    strong = potential(n)
    return Problem(f"I + 1/(4 pi r), {n}^3", n, 3, lambda r: strong.kernel(r) / 40)


def residual(n: int, x: np.ndarray) -> float:
    """||b - A x|| / ||b||, with the exact product by FFT."""
    b = right_side(n**3)
    return float(np.linalg.norm(b - problem(n).product()(x)) / np.linalg.norm(b))


def train(n: int, eps: float) -> dict[str, Any]:
    """Compression, inversion and a solve."""
    of = problem(n)
    compress_s, A = seconds(lambda: from_entries(of.entries, of.grid, eps, MAX_RANK, comm=PETSc.COMM_SELF))
    invert_s, X = seconds(lambda: inverse(A, eps, MAX_RANK))
    x, b = X.createVecs()
    b.array[:] = right_side(n**3)
    apply_s, _ = seconds(lambda: X.mult(b, x))
    a, z = A.getPythonContext(), X.getPythonContext()
    return {
        "compress_s": compress_s, "rank": max(a.ranks), "bytes": a.bytes, "invert_s": invert_s,
        "inverse_rank": max(z.ranks), "inverse_bytes": z.bytes, "apply_s": apply_s, "residual": residual(n, x.array_r),
        "inverse_residual": z.residual, "error": z.error,
        "peak_gib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20,
    }  # fmt: skip


def in_process(n: int, eps: float, limit: float) -> dict[str, Any]:
    """`train` in a process of its own; a note if it takes too long."""
    command = [sys.executable, __file__, "-one", str(n), str(eps)]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=limit, check=False)
    except subprocess.TimeoutExpired:
        return {"note": f"not finished after {limit:g} s"}
    if done.returncode:
        return {"note": (done.stderr.strip().splitlines() or ["failed"])[-1]}
    return json.loads(next(line for line in done.stdout.splitlines() if line.startswith("{")))  # PETSc may add words


def say(name: str, row: dict[str, Any]) -> None:
    if "note" in row:
        print(f"{name:24}{row['note']}", flush=True)
        return
    print(
        f"{name:24}{row['compress_s']:11.3g}{row['rank']:5}{row['bytes'] / 1e6:7.3g}{row['invert_s']:10.3g}"
        f"{row['inverse_rank']:5}{row['inverse_bytes'] / 1e6:7.3g}{row['apply_s']:9.2g}{row['residual']:10.1e}"
        f"{row['peak_gib']:9.2f}",
        flush=True,
    )


def main(given: argparse.Namespace) -> None:
    about = say_machine()
    rows = []
    print(f"{problem(2).name.split(',')[0]}: CPU seconds of one thread\n{HEAD}")
    for n in given.n:
        for eps in EPS:
            rows.append({"n": n, "eps": eps, **in_process(n, eps, given.seconds)})
            say(f"train {n}^3, {eps:g}", rows[-1])
    record("direct_solver", about, rows)


if __name__ == "__main__":
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    words = argparse.ArgumentParser("run/study direct_solver", description=__doc__)
    words.add_argument("-n", type=int, nargs="+", default=SIZES, help="points along an edge")
    words.add_argument("-seconds", type=float, default=120, help="limit of a row")
    words.add_argument("-one", nargs=2, help=argparse.SUPPRESS)
    found = words.parse_args()
    if found.one:
        print(json.dumps(train(int(found.one[0]), float(found.one[1]))))
    else:
        main(found)
