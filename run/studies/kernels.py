"""19 dense matrices with exact products by FFT, 26 others of this kind, and harder ones without: CG to 1e-8 with
`pctt.pc.TensorTrain` by its defaults (auto) and as a train of rank 100 at most (train), and with its rivals: run/study
kernels [-only NAME...] [-ways WAY...] [-quick] [-products]. Writes results/kernels.json, or with -products a table of
products: trials and solution of auto beside CG alone and a circulant.

Entries of the 19 depend on differences, so that products by FFT are exact. The unit of length is the side of the
domain, in one dimension the spacing. Every solution is a process of its own; CPU seconds of one thread. Rivals: CG
alone, T. Chan's circulant, a block Nystrom preconditioner (random-pivoted Cholesky of 200 columns, plus the nugget).
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
import warnings
from collections.abc import Callable
from math import prod

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
import numpy as np
import petsc4py
from scipy import fft, linalg, special

petsc4py.init([sys.argv[0]])
from petsc4py import PETSc
from shared import Row, lines_of, parser, record, say_machine

from pctt.tt import differences
from pctt.tt.conjugate import ConjugateGradients

Array = np.ndarray
Product = Callable[[Array], Array]
Kernel = Callable[[Array, float], Array]  # takes distances, and the spacing of the grid
TORUS = 4096  # points along a side of the torus on which a fractional Laplacian is computed
SQUARE_LOG = -1.0612  # mean of log r over a square of side 1 around 0
CUBE = 2.38  # mean of 1/r over a cube of side 1 around 0
RTOL, MOST_ITS = 1e-8, 3000
LIMIT = 60  # CPU seconds of a solution
COLUMNS, BLOCK = 200, 20  # of the Nystrom preconditioner, in all and at a time
REPEAT, SHORT = 3, 3.0  # a solution of less than SHORT seconds is repeated, the fastest counts
WAYS = ("plain", "circulant", "nystrom", "train", "auto")
OURS = {"auto": "auto", "train": "100"}  # -pc_tt_rank
QUICK = ["exp02", "yukawa50", "laplace7", "imq1", "disc"]
TICK = 1e-3  # seconds that are too few to compare
CLOSE, FAR = 2.0, 3.0  # ratios to the fastest that the totals count

# -- matrices -------------------------------------------------------------------------------------------------


class Problem:
    """A matrix of the unknowns of a grid by its ``entries``. ``times``: its product, None if there is no fast one."""

    a: differences.Differences | None = None

    def __init__(
        self, grid: tuple[int, ...], entries: Callable[[Array, Array], Array], times: Product | None, nugget: float
    ):  # fmt: skip
        self.grid, self.entries, self.times, self.nugget, self.size = grid, entries, times, nugget, prod(grid)

    def product(self) -> Product:
        """Without a fast one: with the dense matrix."""
        if self.times is not None:
            return self.times
        j = np.arange(self.size)
        dense = np.stack([self.entries(np.full(self.size, i), j) for i in j])
        return lambda v: dense @ v


class Differences(Problem):
    """A(x, y) = a(x - y) for the points of a grid; the nugget is in a(0)."""

    def __init__(self, a: differences.Differences, nugget: float = 0.0):
        super().__init__(a.shape, self._entry, a.times, nugget)
        self.a = a

    def _entry(self, i: Array, j: Array) -> Array:
        x, y = np.unravel_index(i, self.grid), np.unravel_index(j, self.grid)
        apart = [np.abs(u - v) if self.a.even else u - v for u, v in zip(x, y)]
        return self.a.values[(*apart, 0, 0)]


def radial(shape: tuple[int, ...], kernel: Kernel, nugget: float = 0.0, h: float | None = None) -> Differences:
    """Of points on a grid with the spacing h; without h the first side of the grid is of length 1."""
    h = h or 1 / shape[0]
    squares = sum(np.meshgrid(*[(np.arange(n) * h) ** 2 for n in shape], indexing="ij", sparse=True))
    table = np.asarray(kernel(np.sqrt(squares), h), float)
    table.flat[0] += nugget
    return Differences(differences.Differences.of_even(table), nugget)


def signed(shape: tuple[int, ...], kernel: Callable[..., Array], nugget: float) -> Differences:
    """Of a function of the differences of grid indices along each axis."""
    axes = [np.concatenate([np.arange(n), np.arange(1 - n, 0)]).astype(float) for n in shape]
    table = np.asarray(kernel(*np.meshgrid(*axes, indexing="ij")), float)
    table.flat[0] += nugget
    return Differences(differences.Differences(shape, table[..., None, None]).compact(), nugget)


def log(factor: float) -> Kernel:
    """factor h^2 (-log(r / 2)): of a square with a diagonal shorter than 2, so it is positive definite."""
    own = SQUARE_LOG
    return lambda r, h: -factor * h**2 * np.where(r > 0, np.log(np.maximum(r, h) / 2), np.log(h / 2) + own)


def exponential(length: float) -> Kernel:
    return lambda r, h: np.exp(-r / length)


def matern(length: float) -> Kernel:
    """Matern's covariance of smoothness 3/2."""
    c = 3**0.5 / length
    return lambda r, h: (1 + c * r) * np.exp(-c * r)


def yukawa(k: float, factor: float) -> Kernel:
    own = factor / (4 * np.pi)
    return lambda r, h: own * h**3 * np.exp(-k * r) * np.where(r > 0, 1 / np.maximum(r, h), CUBE / h)


def fractional(n: int, power: float) -> Differences:
    """(-Laplace)^power by the symbol (4 - 2 cos - 2 cos)^power, restricted to a square: zero outside."""
    t = 2 - 2 * np.cos(2 * np.pi * np.arange(TORUS) / TORUS)
    table = fft.irfft2((t[:, None] + t[: TORUS // 2 + 1]) ** power)[:n, :n]
    return Differences(differences.Differences.of_even(np.ascontiguousarray(table)))


def multiquadric(width: float) -> Kernel:
    """The inverse one."""
    return lambda r, h: 1 / np.sqrt(1 + (r / width) ** 2)


def wendland(radius: float) -> Kernel:
    """C2"""
    return lambda r, h: np.maximum(1 - r / radius, 0) ** 4 * (4 * r / radius + 1)


def gauss(factor: float, width: float) -> Kernel:
    return lambda r, h: factor * h**2 * np.exp(-((r / width) ** 2) / 2)


def nineteen() -> dict[str, Callable[[], Problem]]:
    """The kernels with a product by FFT. A nugget of 1 makes an integral equation of the second kind."""
    small, large, cube, row, odd = (256, 256), (512, 512), (64, 64, 64), (2**16,), (509, 521)
    return {
        "log1": lambda: radial(large, log(100), 1.0),
        "log3": lambda: radial(large, log(1), 1e-3),
        "log5": lambda: radial(large, log(1), 1e-5),
        "exp02": lambda: radial(small, exponential(0.02), 0.01),
        "exp05": lambda: radial(large, exponential(0.05), 0.01),
        "exp1": lambda: radial(small, exponential(0.1), 0.01),
        "matern256": lambda: radial(small, matern(0.02), 0.01),
        "matern512": lambda: radial(large, matern(0.02), 0.01),
        "yukawa1000": lambda: radial(cube, yukawa(10, 1000), 1.0),
        "yukawa1": lambda: radial(cube, yukawa(1, 1), 1e-3),
        "yukawa10": lambda: radial(cube, yukawa(10, 1), 1e-5),
        "yukawa50": lambda: radial(cube, yukawa(50, 1), 1e-6),
        "laplace3": lambda: fractional(256, 0.3),
        "laplace7": lambda: fractional(256, 0.7),
        "imq1": lambda: radial(row, multiquadric(1), h=1.0),
        "imq3": lambda: radial(row, multiquadric(3), h=1.0),
        "wendland": lambda: radial(row, wendland(30), h=1.0),
        "gauss_odd": lambda: radial(odd, gauss(100, 0.1), 1.0, 1 / 512),
        "exp_odd": lambda: radial(odd, exponential(0.02), 0.1, 1 / 512),
    }


def matern5(d: Array) -> Array:
    """Matern's covariance of smoothness 5/2."""
    return (1 + 5**0.5 * d + 5 / 3 * d**2) * np.exp(-(5**0.5) * d)


def turned(x: Array, y: Array, angle: float, long: float, short: float) -> Array:
    """Distances in lengths along and across a direction."""
    c, s = np.cos(angle), np.sin(angle)
    return np.hypot((c * x + s * y) / long, (c * y - s * x) / short)


def around(x: Array, n: int) -> Array:
    """Distances on a circle."""
    return np.minimum(np.abs(x), n - np.abs(x))


def others() -> dict[str, Callable[[], Problem]]:
    """Kernels by differences that others have tried or that the choice was not made with: rotated, moving, periodic,
    oscillating, separable, of a few waves, of long correlations. Lengths in spacings."""
    season = lambda t, period: np.exp(-2 * np.sin(np.pi * t / period) ** 2)  # noqa: E731
    wave = lambda x, y, a, b: np.cos(a * x + b * y)  # noqa: E731
    return {
        "matern_axes": lambda: signed((200, 200), lambda x, y: matern5(turned(x, y, 0, 20, 4)), 0.01),
        "matern_30": lambda: signed((200, 200), lambda x, y: matern5(turned(x, y, 0.52, 20, 4)), 0.01),
        "exp_60": lambda: signed((160, 120), lambda x, y: np.exp(-turned(x, y, 1.05, 30, 2)), 0.001),
        "gauss_23": lambda: signed((128, 128), lambda x, y: np.exp(-turned(x, y, 0.4, 15, 3) ** 2 / 2), 0.01),
        "matern_box": lambda: signed((24,) * 3, lambda x, y, z: matern5(np.hypot(turned(x, y, 0, 8, 4), z / 2)), 0.01),
        "gp_64": lambda: signed((64, 64, 64), lambda x, y, z: matern5(np.hypot(np.hypot(x, y), z) / 6), 0.1),
        "sinc": lambda: signed((24,) * 3, lambda x, y, z: np.sinc(0.3 / np.pi * np.hypot(np.hypot(x, y), z)), 0.1),
        "bessel": lambda: signed((128, 128), lambda x, y: special.j0(0.3 * np.hypot(x, y)), 0.1),
        "separable": lambda: signed((24, 24, 20), lambda x, y, t: np.exp(-np.hypot(x, y) / 6 - np.abs(t) / 8), 0.01),
        "gneiting": lambda: signed(
            (24, 24, 20),
            lambda x, y, t: np.exp(-np.hypot(x, y) / (36 + 7.2 * np.abs(t)) ** 0.5) / (1 + np.abs(t) / 5), 0.01),
        "moving": lambda: signed((96, 96), lambda x, t: np.exp(-np.hypot((x - 0.8 * t) / 6, t / 12)), 0.01),
        "moving3": lambda: signed(
            (24, 24, 20), lambda x, y, t: np.exp(-np.hypot(np.hypot(x - 0.5 * t, y) / 6, t / 9)), 0.01),
        "season": lambda: signed((96, 96), lambda x, t: matern5(np.abs(x) / 8) * season(t, 12), 0.01),
        "season_100": lambda: signed((100, 100), lambda x, t: matern5(np.abs(x) / 8) * season(t, 12), 0.01),
        "season_365": lambda: signed((64, 365), lambda x, t: np.exp(-np.abs(x) / 8) * season(t, 30.4), 0.05),
        "quasi": lambda: signed((8192,), lambda t: np.exp(-np.abs(t) / 500) * season(t, 37), 0.01),
        "torus": lambda: signed((64, 64), lambda x, y: np.exp(-(around(x, 64) + around(y, 64)) / 5), 0.01),
        "torus_129": lambda: signed((129, 129), lambda x, y: np.exp(-(around(x, 129) + around(y, 129)) / 7), 0.01),
        "cylinder": lambda: signed((163, 178), lambda x, y: np.exp(-around(x, 163) / 5 - np.abs(y) / 2), 0.003),
        "product": lambda: signed((128, 128), lambda x, y: np.cos(0.5 * x) * np.cos(0.5 * y), 0.1),
        "waves": lambda: signed((150, 150), lambda x, y: wave(x, y, 0.3, 0.1) + wave(x, y, 0.2, -0.4), 0.5),
        "power": lambda: signed((30000,), lambda x: (1 + np.abs(x)) ** -0.5, 0.0),
        "gauss_60": lambda: signed((256, 256), lambda x, y: np.exp(-(np.hypot(x, y) / 60) ** 2 / 2), 0.01),
        "gauss_100": lambda: signed((256, 128), lambda x, y: np.exp(-turned(x, y, 0, 100, 15) ** 2 / 2), 0.1),
        "rational": lambda: signed((300, 200), lambda x, y: 1 / (1 + turned(x, y, 0, 30, 10) ** 2), 0.001),
        "tent": lambda: signed((146, 144), lambda x, y: np.maximum(1 - turned(x, y, 0.8, 70, 100), 0) ** 2, 0.01),
    }  # fmt: skip


def more() -> dict[str, Callable[[], Problem]]:
    """Ten that are turned, moving, periodic with noise, on lines, in a box; and of sizes that are no powers of two."""
    season = lambda t, period: np.exp(-2 * np.sin(np.pi * t / period) ** 2)  # noqa: E731
    matern3 = lambda d: (1 + 3**0.5 * d) * np.exp(-(3**0.5) * d)  # noqa: E731
    return {
        "exp_15": lambda: signed((120, 90), lambda x, y: np.exp(-turned(x, y, 0.26, 25, 5)), 0.01),
        "matern3_45": lambda: signed((100, 100), lambda x, y: matern3(turned(x, y, 0.785, 15, 3)), 0.05),
        "matern5_75": lambda: signed((144, 96), lambda x, y: matern5(turned(x, y, 1.31, 10, 2)), 0.001),
        "moving_fast": lambda: signed((80, 125), lambda x, t: np.exp(-np.hypot((x - 1.7 * t) / 8, t / 10)), 0.02),
        "moving_gauss": lambda: signed((90, 84), lambda x, t: np.exp(-(((x + 0.4 * t) / 5) ** 2) - (t / 9) ** 2), 0.05),
        "line_matern3": lambda: signed((5000,), lambda x: matern3(np.abs(x) / 40), 0.01),
        "line_season": lambda: signed((3600,), lambda x: np.exp(-np.abs(x) / 300) * season(x, 24), 0.1),
        "periodic": lambda: signed((120, 135), lambda x, y: np.exp(-((around(x, 120) / 9) ** 2) - np.abs(y) / 6), 0.05),
        "matern5_noisy": lambda: signed((100, 81), lambda x, y: matern5(np.hypot(x, y) / 3), 1.0),
        "exp_box": lambda: signed((30, 25, 20), lambda x, y, z: np.exp(-np.hypot(turned(x, y, 0, 12, 4), z / 2)), 0.02),
    }  # fmt: skip


def weighted(n: int, weight: Callable[[Array, Array], Array]) -> Problem:
    """I + a K a with K = 100 h^2 exp(-10 r) and a weight a(x, y) of the points of the square."""
    kernel = radial((n, n), lambda r, h: 100 * h**2 * np.exp(-10 * r))
    axis = (np.arange(n) + 0.5) / n
    a = np.broadcast_to(weight(axis[:, None], axis), (n, n)).ravel()
    fast = kernel.product()
    return Problem(
        (n, n), lambda i, j: (i == j) + a[i] * kernel.entries(i, j) * a[j], lambda v: v + a * fast(a * v), 1.0
    )  # fmt: skip


def scattered(points: Array) -> Problem:
    """The inverse multiquadric of width 1 between points on a line, plus 0.01 I."""
    kernel = multiquadric(1)
    return Problem((len(points),), lambda i, j: 0.01 * (i == j) + kernel(points[i] - points[j], 1.0), None, 0.0)


def hard() -> dict[str, Callable[[], Problem]]:
    """Matrices whose entries do not depend on differences: weights that are smooth, 20 in a disc, 1 and 30 on a
    checkerboard, random in 16 x 16 blocks; points that are jittered, or Chebyshev's."""
    n, rng = 256, np.random.default_rng(5)

    def blocks(x: Array, y: Array) -> Array:
        return rng.uniform(0, 3, (16, 16))[np.ix_((16 * x[:, 0]).astype(int), (16 * y).astype(int))]

    few = np.arange(2**12)
    return {
        "smooth": lambda: weighted(n, lambda x, y: 1 + np.sin(3 * x) * np.cos(2 * y)),
        "disc": lambda: weighted(n, lambda x, y: 20.0 * (np.hypot(x - 0.5, y - 0.5) < 0.3)),
        "checker": lambda: weighted(n, lambda x, y: 1 + 29.0 * ((np.floor(8 * x) + np.floor(8 * y)) % 2)),
        "blocks": lambda: weighted(n, blocks),
        "jittered": lambda: scattered(few + rng.uniform(-0.3, 0.3, len(few))),
        "chebyshev": lambda: scattered(0.5 * len(few) * (1 - np.cos(np.pi * few / len(few)))),
    }


# -- ways to solve --------------------------------------------------------------------------------------------


class Shell:
    """A Mat or PC that multiplies by a function."""

    def __init__(self, times: Product) -> None:
        self.times = times

    def mult(self, mat: PETSc.Mat, x: PETSc.Vec, y: PETSc.Vec) -> None:
        y.array_w[:] = self.times(x.array_r)

    apply = mult


def circulant(problem: Problem) -> Product:
    """The circulant nearest to the matrix in Frobenius' norm (T. Chan, SIAM J. Sci. Stat. Comput. 9, 1988)."""
    return differences.FastInverse(problem.a, differences.CIRCULANT).solve


def nystrom(problem: Problem) -> Product:
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


def applies(way: str, problem: Problem) -> str:
    """Why a way is no way for this problem; empty if it is one."""
    if way == "circulant" and problem.a is None:
        return "entries do not depend on differences"
    if way == "nystrom" and not problem.nugget:
        return "no nugget"
    return ""


def solve(way: str, problem: Problem) -> Row:
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
    problem = {**nineteen(), **others(), **more(), **hard()}[name]()
    row = solve(way, problem)
    for _ in range(REPEAT - 1 if row["setup_s"] + row["solve_s"] < SHORT else 0):
        again = solve(way, problem)
        row = min(row, again, key=lambda r: r["setup_s"] + r["solve_s"])
    print(json.dumps(row), flush=True)


def solution(name: str, way: str) -> Row:
    """That of a child process, or why there is none."""
    limited = f'ulimit -t {LIMIT}; exec timeout {3 * LIMIT} "$@"'
    rows, failure = lines_of(["bash", "-c", limited, "-", sys.executable, __file__, "-child", name, way])
    if rows:
        return rows[-1]
    return {"note": failure if ":" in failure and "Killed" not in failure else f"not within {LIMIT} s"}


def total(row: Row) -> float:
    """Seconds; infinite for a failure."""
    good = row.get("reason", -1) > 0 and row["residual"] < 3 * RTOL
    return row["setup_s"] + row["solve_s"] if good else np.inf


def text(row: Row) -> str:
    if "note" in row:
        return row["note"]
    good = "" if np.isfinite(total(row)) else f" LEFT {row['residual']:.0e}"
    return f"{row['setup_s']:.2f} + {row['solve_s']:.2f} ({row['iterations']}){good}"


class Counted(ConjugateGradients):
    """Counts products and applications, times the unknowns."""

    spent = 0.0

    def step(self) -> None:
        before = len(self.norms)
        super().step()
        Counted.spent += (len(self.norms) - before) * (1 if self.solve is None else 2) * len(self.x)


def products(names: list[str]) -> None:
    """A table: iterations of CG alone and with a circulant, and trials and iterations of auto, in products with the
    matrix. An application of a preconditioner counts as one, a product with a part of the matrix as this part."""
    problems = {**nineteen(), **others(), **more()}
    vars(differences)["ConjugateGradients"] = Counted

    def iterations(a: differences.Differences, kind: differences.Kind) -> int:
        inverse, b = differences.FastInverse(a, kind), np.random.default_rng(1).standard_normal(prod(a.shape))
        run = ConjugateGradients(a.times, b, inverse.solve if kind else None)
        while run.norms[-1] > RTOL * run.norms[0] and len(run.norms) <= MOST_ITS and not run.failed:
            run.step()
        return len(run.norms) - 1

    print("| kernel | CG alone | circulant | trials | auto | in all, of the better | auto took |")
    print("|---|---|---|---|---|---|---|")
    for name in names:
        a = problems[name]().a
        assert a is not None
        Counted.spent = 0.0
        choice = differences.choose(a)
        assert choice is not None
        trials = Counted.spent / prod(a.shape)
        kinds = differences.NOTHING, differences.CIRCULANT, choice.kind
        alone, circulant, auto = (iterations(a, kind) for kind in kinds)
        ratio = (trials + auto * (2 if choice.kind else 1)) / min(alone, 2 * circulant)
        took = differences.FastInverse(a, choice.kind).name
        print(f"| {name} | {alone} | {circulant} | {trials:.1f} | {auto} | {ratio:.2f} | {took} |", flush=True)


def main(given: argparse.Namespace) -> None:
    if given.products:
        products(given.only or list({**nineteen(), **others(), **more()}))
        return
    about = say_machine()
    names = {**nineteen(), **others(), **more(), **hard()}
    chosen = given.only or (QUICK if given.quick else list(names))
    rows: list[Row] = []
    for name in chosen:
        problem = names[name]()
        found = {}
        for way in given.ways:
            why = applies(way, problem)
            found[way] = {"note": why} if why else solution(name, way)
        rows.append({"name": name, "unknowns": problem.size, "ways": found})
        said = " | ".join(f"{way} {text(row)}" for way, row in found.items())
        print(f"{name}, {' x '.join(map(str, problem.grid))}: {said}", flush=True)
        for way in OURS:
            if "what" in found.get(way, {}):
                row = found[way]
                warned = f"; WARNED: {row['warned']}" if row["warned"] else ""
                print(f"    {way}: {row['what']}, true residual {row['residual']:.1e}{warned}", flush=True)
    sets = (("with an FFT", nineteen()), ("others with an FFT", {**others(), **more()}), ("hard", hard()))
    totals = [score([row for row in rows if row["name"] in names], words) for words, names in sets]
    record("kernels", about, rows + [score_ for score_ in totals if score_])


def score(rows: list[Row], words: str) -> Row:
    """How often TensorTrain by its defaults is the fastest, and how far it is behind."""
    ratios = {}
    for row in rows:
        best = min((total(found) for found in row["ways"].values()), default=np.inf)
        if "auto" in row["ways"] and np.isfinite(best):
            ratios[row["name"]] = total(row["ways"]["auto"]) / max(best, TICK)
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
    more = iterations_beyond(rows)
    if more:
        worst = max(more, key=lambda name: more[name])
        print(f"    iterations: at most {more[worst]:.2f} times the fewer of CG alone and the circulant ({worst})")
    found = {"set": words, "fastest": fastest, "close": close, "of": len(ratios), "ratios": ratios, "silent": silent}
    return found | {"iteration_ratios": more}


def iterations_beyond(rows: list[Row]) -> dict[str, float]:
    """The iterations of TensorTrain by its defaults, divided by the fewer of CG alone and the circulant."""
    ratios = {}
    for row in rows:
        its = {way: found["iterations"] for way, found in row["ways"].items() if np.isfinite(total(found))}
        rivals = [its[way] for way in ("plain", "circulant") if way in its]
        if rivals and "auto" in row["ways"]:
            ratios[row["name"]] = its.get("auto", np.inf) / min(rivals)
    return ratios


if __name__ == "__main__":
    words = parser("kernels", __doc__)
    words.add_argument("-only", nargs="+", choices=[*nineteen(), *others(), *more(), *hard()], help="problems")
    words.add_argument("-ways", nargs="+", choices=WAYS, default=WAYS, help="ways to solve them")
    words.add_argument("-products", action="store_true", help="a table of products")
    words.add_argument("-quick", action="store_true", help="five problems")
    words.add_argument("-child", nargs=2, help=argparse.SUPPRESS)
    asked = words.parse_args()
    child(*asked.child) if asked.child else main(asked)
