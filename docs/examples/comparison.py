"""A problem solved in several ways: seconds of set-up and solve, iterations, true residual, bytes."""

from __future__ import annotations

import resource
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import petsc4py
from scipy import linalg

petsc4py.init(sys.argv)
from integral_problems import Problem
from petsc4py import PETSc

from pctt.ksp_options import entered
from pctt.mat import from_entries
from pctt.petsc import options_database

RTOL = 1e-8
DENSE = 8192  # unknowns of the largest dense matrix that is factorised; times beyond are extrapolated


@dataclass
class Row:
    """How one way did; ``note`` says what was not measured."""

    way: str
    setup_s: float
    solve_s: float
    iterations: int
    residual: float
    bytes: float
    note: str = ""

    def __str__(self) -> str:
        return (
            f"{self.way:36} {self.setup_s:9.3g} {self.solve_s:9.3g} {self.iterations or '':>6} {self.residual:9.1e} "
            f"{self.bytes:9.2e}  {self.note}"
        )


HEAD = f"{'':36} {'set-up s':>9} {'solve s':>9} {'its':>6} {'residual':>9} {'bytes':>9}"


class Shell:
    """A Mat that multiplies by a function."""

    def __init__(self, product: Callable[[np.ndarray], np.ndarray]) -> None:
        self.product = product

    def mult(self, mat: PETSc.Mat, x: PETSc.Vec, y: PETSc.Vec) -> None:
        y.array_w[:] = self.product(x.array_r)


class Inverse:
    """A PC that multiplies by a function."""

    def __init__(self, product: Callable[[np.ndarray], np.ndarray]) -> None:
        self.product = product

    def apply(self, pc: PETSc.PC, x: PETSc.Vec, y: PETSc.Vec) -> None:
        y.array_w[:] = self.product(x.array_r)


def seconds(work: Callable[[], Any]) -> tuple[float, Any]:
    """CPU seconds of one thread, which other work on the machine does not change, and what came out."""
    start = time.process_time()
    out = work()
    return time.process_time() - start, out


def operator(problem: Problem) -> PETSc.Mat:
    """The Mat of a user who has a fast product, with the entries as attribute."""
    mat = PETSc.Mat().createPython((problem.size, problem.size), Shell(problem.product()), comm=PETSc.COMM_SELF)
    mat.setUp()
    mat.setOption(PETSc.Mat.Option.SYMMETRIC, True)
    mat.setAttr("entries", problem.entries)
    mat.setAttr("grid", problem.grid)
    return mat


def right_side(size: int) -> np.ndarray:
    return np.random.default_rng(0).standard_normal(size)


def cg(
    mat: PETSc.Mat, way: str, pc: str | Inverse, true: Callable, setup: float = 0.0, bytes_: float = 0.0
) -> Row:  # fmt: skip
    """CG to RTOL of the true residual with a preconditioner: none, tt (a train of the entries), auto (what TensorTrain
    takes by itself) or a function."""
    ksp = PETSc.KSP().create(PETSc.COMM_SELF)
    ksp.setOperators(mat)
    ksp.setType("cg")
    ksp.setNormType(PETSc.KSP.NormType.UNPRECONDITIONED)
    ksp.setTolerances(rtol=RTOL, max_it=5000)
    ksp.pc.setType("none" if pc == "none" else "python")
    if isinstance(pc, Inverse):
        ksp.pc.setPythonContext(pc)
    elif pc != "none":
        ksp.pc.setPythonType("pctt.pc.TensorTrain")
        with entered({"pc_tt_rank": "100" if pc == "tt" else "auto"} | options_database()):
            ksp.setFromOptions()
    x, b = mat.createVecs()
    b.array[:] = right_side(b.getLocalSize())
    setup += seconds(ksp.setUp)[0]
    solve = seconds(lambda: ksp.solve(b, x))[0]
    note = ""
    if pc in ("tt", "auto"):
        made = ksp.pc.getPythonContext().made
        note = made.base
        if made.inverse is not None:
            Z = made.inverse.train
            bytes_ += 8 * (Z.storage + made.compressed.train.storage)
            note = f"ranks {max(made.compressed.train.ranks)}, {max(Z.ranks)}"
    left = float(np.linalg.norm(true(x.array_r) - b.array_r) / b.norm())
    its = ksp.getIterationNumber()
    ksp.destroy()
    return Row(way, setup, solve, its, left, bytes_, note)


def cholesky(problem: Problem, true: Callable) -> Row:
    """Dense, by LAPACK; of a smaller grid, and extrapolated by N^3 and N^2, where N is large."""
    small = problem
    if problem.size > DENSE:
        small = shrunk(problem)
    i = np.arange(small.size)
    A = np.concatenate([small.entries(*map(np.ravel, np.meshgrid(r, i, indexing="ij"))) for r in np.array_split(i, 64)])
    A = A.reshape(small.size, -1)
    setup, factor = seconds(lambda: linalg.cho_factor(A, check_finite=False, overwrite_a=True))
    b = right_side(small.size)
    solve, x = seconds(lambda: linalg.cho_solve(factor, b, check_finite=False))
    left = float(np.linalg.norm(small.product()(x) - b) / np.linalg.norm(b))
    grow = problem.size / small.size
    note = "" if small is problem else f"extrapolated from N = {small.size}"
    return Row("dense Cholesky", setup * grow**3, solve * grow**2, 0, left, 8.0 * problem.size**2, note)


def shrunk(problem: Problem) -> Problem:
    """The same on a grid of at most DENSE points (the kernel keeps its old h: seconds are those of any matrix)."""
    n = int(DENSE ** (1 / len(problem.grid)) + 1e-9)
    return Problem(problem.name, n, len(problem.grid), problem.kernel, problem.nugget, problem.weight)


def dense_products(problem: Problem, its: int) -> Row:
    """CG with dense products, from the seconds of one with a smaller matrix: memory-bound, so linear in N^2."""
    rows, columns = 1024, min(problem.size, 16384)
    A, v = np.ones((rows, columns)), np.ones(columns)
    one = min(seconds(lambda: A @ v)[0] for _ in range(5)) / (rows * columns)
    return Row("CG, dense products", 0.0, its * one * problem.size**2, its, RTOL, 8.0 * problem.size**2, "extrapolated")


def compare(problem: Problem, eps: float | None = 1e-6, dense: bool = True) -> list[Row]:
    """All ways; prints a table.

    eps : of the train that is the operator itself; None: there is none
    dense : also dense products and Cholesky factors
    """
    print(f"{problem.name}: {problem.size} unknowns, CG to {RTOL:g}, CPU seconds of one thread")
    print(HEAD)
    true = problem.product()
    fast = operator(problem)
    rows: list[Row] = []

    def add(row: Row) -> Row:
        rows.append(row)
        print(row, flush=True)
        return row

    add(cg(fast, "CG + TensorTrain auto, FFT products", "auto", true))
    add(cg(fast, "CG + train, FFT products", "tt", true))
    if eps is not None:
        setup, slow = seconds(lambda: from_entries(problem.entries, problem.grid, eps, comm=PETSc.COMM_SELF))
        compressed = slow.getPythonContext().compressed
        row = cg(slow, "CG + train, train products", "tt", true, setup, 8 * compressed.train.storage)
        row.note += f"; operator: rank {max(compressed.train.ranks)}, error {compressed.error:.0e}"
        add(row)
        slow.destroy()
    if problem.weight is None:
        setup, inverse = seconds(problem.circulant)
        add(cg(fast, "CG + circulant, FFT products", Inverse(inverse), true, setup, bytes_=4.0 * problem.size))
    plain = add(cg(fast, "CG, FFT products", "none", true))
    if dense:
        add(dense_products(problem, plain.iterations))
        add(cholesky(problem, true))
    fast.destroy()
    print(f"peak memory {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20:.2f} GiB")
    return rows


def draw(**tables: list[Row]) -> None:
    """Seconds of set-up and solve of each way, side by side for the titles, into the file that the command names."""
    if not sys.argv[1:]:
        return
    import matplotlib.pyplot as plt

    ways = [row.way for row in next(iter(tables.values()))]
    figure, columns = plt.subplots(1, len(tables), sharey=True, squeeze=False, figsize=(6.4, 3.2), layout="constrained")
    for (title, rows), axes in zip(tables.items(), columns[0]):
        took = {row.way: row.setup_s + row.solve_s for row in rows}
        axes.barh(ways[::-1], [took.get(way, 0.0) for way in ways[::-1]])
        wide = max(took.values()) > 30 * min(took.values())
        axes.set(title=title, xscale="log" if wide else "linear")
    figure.supxlabel("CPU s of set-up and solve", fontsize=10)
    figure.savefig(sys.argv[1], dpi=100)
