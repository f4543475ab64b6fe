"""19 dense matrices with exact products by FFT, and harder ones without: CG to 1e-8 with `pctt.pc.TensorTrain` by its
defaults (auto) and as a train of rank 100 at most (train), and with its rivals: run/study kernels [-only NAME...]
[-ways WAY...] [-quick]. Writes results/kernels.json.

Every solution is a process of its own; CPU seconds of one thread. Rivals: CG alone, T. Chan's circulant, a block
Nystrom preconditioner (random-pivoted Cholesky of 200 columns, plus the nugget).
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
import warnings
from collections.abc import Callable
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
import numpy as np
import petsc4py
from scipy import fft, linalg

petsc4py.init([sys.argv[0]])
from kernel_problems import Array, Differences, General, Product, hard, nineteen
from petsc4py import PETSc
from shared import record, say_machine

RTOL, MOST_ITS = 1e-8, 3000
LIMIT = 60  # CPU seconds of a solution
COLUMNS, BLOCK = 200, 20  # of the Nystrom preconditioner, in all and at a time
REPEAT, SHORT = 3, 3.0  # a solution of less than SHORT seconds is repeated, the fastest counts
WAYS = ("plain", "circulant", "nystrom", "train", "auto")
OURS = {"auto": "auto", "train": "100"}  # -pc_tt_rank
QUICK = ["exp02", "yukawa50", "laplace7", "imq1", "disc"]
CLOSE, FAR = 2.0, 3.0  # ratios to the fastest that the totals count

Way = Callable[[Any], Product]  # makes the product of a preconditioner


class Shell:
    """A Mat or PC that multiplies by a function."""

    def __init__(self, times: Product) -> None:
        self.times = times

    def mult(self, mat: PETSc.Mat, x: PETSc.Vec, y: PETSc.Vec) -> None:
        y.array_w[:] = self.times(x.array_r)

    apply = mult


def circulant(problem: Differences) -> Product:
    """The circulant nearest to the matrix in Frobenius' norm (T. Chan, SIAM J. Sci. Stat. Comput. 9, 1988), its
    eigenvalues not below a tenth of the nugget or 1e-12 of the largest one."""
    column = problem.table
    for axis, n in enumerate(problem.grid):
        part = np.moveaxis(column, axis, -1)
        t = np.arange(n)
        column = np.moveaxis(((n - t) * part + t * part[..., (n - t) % n]) / n, -1, axis)
    values = fft.rfftn(column).real
    inverse = 1 / np.maximum(values, max(0.1 * problem.nugget, 1e-12 * values.max()))

    def times(r: Array) -> Array:
        spectrum = fft.rfftn(r.reshape(problem.grid))
        spectrum *= inverse
        return fft.irfftn(spectrum, problem.grid, overwrite_x=True).ravel()

    return times


def nystrom(problem: Differences | General) -> Product:
    """Of A - nugget I by random-pivoted Cholesky in blocks (Chen, Epperly, Tropp & Webber, 2023), plus the nugget."""
    rng = np.random.default_rng(0)
    n = problem.size
    every = np.arange(n)
    here = problem.entries(every, every) - problem.nugget
    factor = np.zeros((n, 0))
    while factor.shape[1] < COLUMNS:
        chance = np.maximum(here, 0)
        pivots = np.unique(rng.choice(n, BLOCK, p=chance / chance.sum()))
        rows, columns = np.broadcast_arrays(every[:, None], pivots)
        new = problem.entries(rows.ravel(), columns.ravel()).reshape(n, -1) - problem.nugget * (rows == columns)
        new -= factor @ factor[pivots].T
        values, vectors = linalg.eigh(new[pivots])
        good = values > 1e-12 * values[-1]
        new = new @ (vectors[:, good] / np.sqrt(values[good]))
        factor = np.hstack([factor, new])
        here = here - (new**2).sum(axis=1)
    small = linalg.cho_factor(factor.T @ factor + problem.nugget * np.eye(factor.shape[1]))
    return lambda r: (r - factor @ linalg.cho_solve(small, factor.T @ r)) / problem.nugget


def applies(way: str, problem: Differences | General) -> str:
    """Why a way is no way for this problem; empty if it is one."""
    if way == "circulant" and not isinstance(problem, Differences):
        return "entries do not depend on differences"
    if way == "nystrom" and not problem.nugget:
        return "no nugget"
    return ""


def solve(way: str, problem: Differences | General) -> dict[str, Any]:
    """CG to RTOL of the true residual."""
    times = problem.product()
    mat = PETSc.Mat().createPython((problem.size, problem.size), Shell(times), comm=PETSc.COMM_SELF)
    mat.setUp()
    mat.setOption(PETSc.Mat.Option.SYMMETRIC, True)
    mat.setAttr("entries", problem.entries)
    mat.setAttr("grid", problem.grid)
    ksp = PETSc.KSP().create(PETSc.COMM_SELF)
    ksp.setOperators(mat)
    ksp.setType("cg")
    ksp.setNormType(PETSc.KSP.NormType.UNPRECONDITIONED)
    ksp.setTolerances(rtol=RTOL, max_it=MOST_ITS)
    x, b = mat.createVecs()
    b.array[:] = np.random.default_rng(0).standard_normal(problem.size)
    begin = time.process_time()
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        if way == "plain":
            ksp.pc.setType("none")
        else:
            ksp.pc.setType("python")
            if way in OURS:
                ksp.pc.setPythonType("pctt.pc.TensorTrain")
                PETSc.Options()["pc_tt_rank"] = OURS[way]
            else:
                make = {"circulant": circulant, "nystrom": nystrom}[way]
                ksp.pc.setPythonContext(Shell(make(problem)))
        ksp.setFromOptions()
        ksp.setUp()
        middle = time.process_time()
        ksp.solve(b, x)
    end = time.process_time()
    left = float(np.linalg.norm(times(x.array_r) - b.array_r) / b.norm())
    row = {"setup_s": middle - begin, "solve_s": end - middle, "iterations": ksp.getIterationNumber(), "residual": left}
    row |= {"reason": ksp.getConvergedReason(), "warned": "; ".join(str(w.message) for w in said)}
    if way in OURS:
        row["what"] = ksp.pc.getPythonContext().what()
    return row


def child(name: str, way: str) -> None:
    """One solution, as a line of JSON."""
    problem = {**nineteen(), **hard()}[name]()
    row = solve(way, problem)
    for _ in range(REPEAT - 1 if row["setup_s"] + row["solve_s"] < SHORT else 0):
        again = solve(way, problem)
        row = min(row, again, key=lambda r: r["setup_s"] + r["solve_s"])
    print(json.dumps(row), flush=True)


def solution(name: str, way: str) -> dict[str, Any]:
    """That of a child process, or why there is none."""
    limited = f'ulimit -t {LIMIT}; exec timeout {3 * LIMIT} "$@"'
    command = ["bash", "-c", limited, "-", sys.executable, __file__, "-child", name, way]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    lines = [line for line in done.stdout.splitlines() if line.startswith("{")]
    if lines:
        return json.loads(lines[-1])
    if done.returncode > 0 and done.stderr.strip() and "Killed" not in done.stderr:
        return {"note": done.stderr.strip().splitlines()[-1]}
    return {"note": f"not within {LIMIT} s"}


def total(row: dict[str, Any]) -> float:
    """Seconds; infinite for a failure."""
    good = row.get("reason", -1) > 0 and row["residual"] < 3 * RTOL
    return row["setup_s"] + row["solve_s"] if good else np.inf


def text(row: dict[str, Any]) -> str:
    if "note" in row:
        return row["note"]
    good = "" if np.isfinite(total(row)) else f" LEFT {row['residual']:.0e}"
    return f"{row['setup_s']:.2f} + {row['solve_s']:.2f} ({row['iterations']}){good}"


def main(given: argparse.Namespace) -> None:
    about = say_machine()
    names = {**nineteen(), **hard()}
    chosen = given.only or (QUICK if given.quick else list(names))
    rows: list[dict[str, Any]] = []
    for name in chosen:
        problem = names[name]()
        found = {}
        for way in given.ways:
            why = applies(way, problem)
            found[way] = {"note": why} if why else solution(name, way)
        rows.append({"problem": problem.name, "name": name, "unknowns": problem.size, "ways": found})
        print(f"{problem.name}: " + " | ".join(f"{way} {text(row)}" for way, row in found.items()), flush=True)
        for way in OURS:
            if "what" in found.get(way, {}):
                row = found[way]
                warned = f"; WARNED: {row['warned']}" if row["warned"] else ""
                print(f"    {way}: {row['what']}, true residual {row['residual']:.1e}{warned}", flush=True)
    totals = [score([row for row in rows if (row["name"] in nineteen()) == fast], words)
              for fast, words in ((True, "with an FFT"), (False, "hard"))]  # fmt: skip
    record("kernels", about, rows + [score_ for score_ in totals if score_])


def score(rows: list[dict[str, Any]], words: str) -> dict[str, Any]:
    """How often TensorTrain by its defaults is the fastest, and how far it is behind."""
    ratios = {}
    for row in rows:
        best = min((total(found) for found in row["ways"].values()), default=np.inf)
        if "auto" in row["ways"] and np.isfinite(best):
            ratios[row["name"]] = total(row["ways"]["auto"]) / best
    if not ratios:
        return {}
    worst = max(ratios, key=lambda name: ratios[name])
    fastest, close, far = (sum(r <= most for r in ratios.values()) for most in (1.0, CLOSE, FAR))
    late = [row for row in rows if ratios.get(row["name"], 0) > FAR]
    silent = [row["name"] for row in late if not row["ways"]["auto"].get("warned")]
    print(
        f"{words}: TensorTrain is the fastest in {fastest} of {len(ratios)}, within {CLOSE:g} times the fastest in "
        f"{close}, within {FAR:g} in {far}; worst ratio {ratios[worst]:.3g} ({worst}); beyond {FAR:g} without a "
        f"warning: {', '.join(silent) or 'none'}"
    )
    return {"set": words, "fastest": fastest, "close": close, "of": len(ratios), "ratios": ratios, "silent": silent}


if __name__ == "__main__":
    words = argparse.ArgumentParser("run/study kernels", description=__doc__)
    words.add_argument("-only", nargs="+", choices=[*nineteen(), *hard()], help="problems")
    words.add_argument("-ways", nargs="+", choices=WAYS, default=WAYS, help="ways to solve them")
    words.add_argument("-quick", action="store_true", help="five problems")
    words.add_argument("-child", nargs=2, help=argparse.SUPPRESS)
    asked = words.parse_args()
    child(*asked.child) if asked.child else main(asked)
