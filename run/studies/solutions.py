"""Solutions of dense systems by conjugate gradients (CG) with one preconditioner or another, and how they compare."""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable
from math import inf, prod
from typing import Any

import numpy as np
import petsc4py
from scipy import linalg

petsc4py.init([])
from petsc4py import PETSc
from shared import Row

from pctt.tt.differences import CIRCULANT, COSTS, Differences, FastInverse

Array = np.ndarray
Product = Callable[[Array], Array]
RTOL = 1e-8  # of the true residual
COLUMNS, BLOCK = 200, 20  # of Nystrom's approximation, in all and at a time
TOO_MANY = 1.3  # times what the better of CG alone and the circulant takes
#: The ways to solve, and their heads in tables.
WAYS = {
    "plain": "CG alone", "jacobi": "Jacobi", "circulant": "circulant", "nystrom": "block Nystrom",
    "train": "train, rank 100 at most", "auto": "auto",
}  # fmt: skip
RANKS = {"auto": "auto", "train": "100"}  # -pc_tt_rank


class System:
    """A symmetric matrix of the unknowns of a grid by its ``entries``, with ``block`` unknowns a point.

    times : the product with it; None: by the dense matrix
    a : its differences, if entries depend on them only
    nugget : what the diagonal has more than a smooth kernel, if that is known
    """

    def __init__(
        self, grid: tuple[int, ...], entries: Callable[[Array, Array], Array], times: Product | None,
        a: Differences | None = None, block: int = 1, nugget: float = 0.0,
    ) -> None:  # fmt: skip
        self.grid, self.entries, self.times, self.a, self.block, self.nugget = grid, entries, times, a, block, nugget
        self.size = prod(grid) * block

    @classmethod
    def of(cls, a: Differences, nugget: float = 0.0) -> System:
        """A(x, y) = a(x - y); the nugget is in a(0)."""

        def entries(i: Array, j: Array) -> Array:
            x, y = (np.unravel_index(k // a.block, a.shape) for k in (i, j))
            apart = [np.abs(u - v) if a.even else u - v for u, v in zip(x, y)]
            return a.values[(*apart, i % a.block, j % a.block)]

        return cls(a.shape, entries, a.times, a, a.block, nugget)

    def product(self) -> Product:
        if self.times is not None:
            return self.times
        j = np.arange(self.size)
        dense = np.stack([self.entries(np.full(self.size, i), j) for i in j])
        return lambda v: dense @ v


# -- the preconditioners -----------------------------------------------------------------------------------------


def jacobi(given: System) -> Product:
    """The inverses of the diagonal blocks."""
    rows = np.arange(given.size).reshape(-1, given.block)
    i, j = np.broadcast_arrays(rows[:, :, None], rows[:, None])
    inverses = np.linalg.inv(given.entries(i.ravel(), j.ravel()).reshape(i.shape))
    return lambda r: (inverses @ r.reshape(*rows.shape, 1)).ravel()


def circulant(given: System) -> Product:
    """The circulant nearest to the matrix in Frobenius' norm (T. Chan, SIAM J. Sci. Stat. Comput. 9, 1988)."""
    assert given.a is not None
    return FastInverse(given.a, CIRCULANT).solve


def nystrom(given: System) -> Product:
    """Of A - nugget I by random-pivoted Cholesky in blocks (Chen, Epperly, Tropp & Webber, 2023), plus the nugget."""
    rng, n = np.random.default_rng(0), given.size
    every = np.arange(n)
    here = given.entries(every, every) - given.nugget
    factor = np.zeros((n, 0))
    while factor.shape[1] < COLUMNS:
        chance = np.maximum(here, 0)
        pivots = np.unique(rng.choice(n, BLOCK, p=chance / chance.sum()))
        rows, columns = np.broadcast_arrays(every[:, None], pivots)
        new = given.entries(rows.ravel(), columns.ravel()).reshape(n, -1) - given.nugget * (rows == columns)
        new -= factor @ factor[pivots].T
        values, vectors = linalg.eigh(new[pivots])
        good = values > 1e-12 * values[-1]
        new = new @ (vectors[:, good] / np.sqrt(values[good]))
        factor = np.hstack([factor, new])
        here = here - (new**2).sum(axis=1)
    small = linalg.cho_factor(factor.T @ factor + given.nugget * np.eye(factor.shape[1]))
    return lambda r: (r - factor @ linalg.cho_solve(small, factor.T @ r)) / given.nugget


MAKERS = {"jacobi": jacobi, "circulant": circulant, "nystrom": nystrom}
EACH = {"plain": 0.0, "jacobi": 0.0, "circulant": COSTS["circulant"]}  # costs of applications, in products


def why_not(way: str, given: System) -> str:
    """Why a way is none for this system; empty if it is one."""
    if way == "circulant" and given.a is None:
        return "entries do not depend on differences"
    if way == "nystrom" and not given.nugget:
        return "no nugget"
    if way == "jacobi" and given.a is not None and given.block == 1:
        return "the diagonal is constant"
    return ""


# -- solutions ---------------------------------------------------------------------------------------------------


class Counting:
    """A Mat or a PC that multiplies by a function."""

    def __init__(self, times: Product) -> None:
        self.times, self.count = times, 0

    def mult(self, mat: Any, x: PETSc.Vec, y: PETSc.Vec) -> None:
        self.count += 1
        y.array_w[:] = self.times(x.array_r)

    apply = mult


def solve(given: System, way: str, rank: str | None = None, most: int = 4000) -> Row:
    """CG to RTOL of the true residual: seconds, iterations, products, what was used, and of which residual it ended.

    Iterations are those that the KSP tells. Products are those with the matrix, by trials, by the solution and by CG
    alone where `TensorTrain` has let it go in turns with the KSP, and applications of the preconditioner, as much as
    their operations are of a product; NaN where these are not known.
    """
    context = Counting(given.product())
    mat = PETSc.Mat().create(PETSc.COMM_SELF)
    mat.setSizes((given.size, given.size), given.block)
    mat.setType(PETSc.Mat.Type.PYTHON)
    mat.setPythonContext(context)
    mat.setUp()
    mat.setOption(PETSc.Mat.Option.SYMMETRIC, True)
    mat.setAttr("entries", given.entries)
    mat.setAttr("grid", given.grid)
    ksp = PETSc.KSP().create(PETSc.COMM_SELF)
    ksp.setOperators(mat)
    ksp.setType("cg")
    ksp.setNormType(PETSc.KSP.NormType.UNPRECONDITIONED)
    ksp.setTolerances(rtol=RTOL, max_it=most)
    x, b = mat.createVecs()
    b.array[:] = np.random.default_rng(0).standard_normal(given.size)
    each, trials, what, inner = EACH.get(way, np.nan), 0.0, "", Counting(lambda r: r)
    begin = time.process_time()
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        if way == "plain":
            ksp.pc.setType("none")
        elif way in MAKERS:
            ksp.pc.setType("python")
            ksp.pc.setPythonContext(inner := Counting(MAKERS[way](given)))
        else:
            PETSc.Options()["pc_tt_rank"] = rank or RANKS[way]
            ksp.pc.setType("python")
            ksp.pc.setPythonType("pctt.pc.TensorTrain")
            ksp.setFromOptions()
        ksp.setUp()
        context.count, tried = 0, context.count
        middle = time.process_time()
        if way in RANKS:
            ours = ksp.pc.getPythonContext()
            made, applied = ours.made, ours.apply
            what = made.words() if ours.rank > 1 else "block Jacobi"
            parts = getattr(made.transform, "cost_estimate", None)  # of the grid; other trials multiply by the matrix
            trials = tried + (0.0 if parts is None else parts.spent)
            known = 0.0 if ours.rank == 1 or way == "auto" else np.nan
            each = known if made.cost_estimate is None else made.cost_estimate.each

            def apply(pc: PETSc.PC, r: PETSc.Vec, z: PETSc.Vec) -> None:
                inner.count += 1
                applied(pc, r, z)

            ours.apply = apply
        ksp.solve(b, x)
    end = time.process_time()
    left = float(np.linalg.norm(context.times(x.array_r) - b.array_r) / b.norm())
    good = ksp.getConvergedReason() > 0 and left < 3 * RTOL
    row: Row = {"setup_s": middle - begin, "solve_s": end - middle, "residual": left, "trials": trials, "what": what}
    row["warned"] = "; ".join(str(w.message) for w in said)
    row["iterations"] = ksp.getIterationNumber() if good else inf
    row["products"] = context.count + trials + each * inner.count if good else inf
    if way == "auto" and "conjugate gradients alone take" in "\n".join(ours.report()):
        row["what"] += ", LEFT"
    return row


# -- comparison --------------------------------------------------------------------------------------------------


def ratio(found: dict[str, Row], figure: str) -> float:
    """What auto takes of iterations or products, over the better of CG alone and the circulant; NaN if both fail."""
    best = min((found[way][figure] for way in ("plain", "circulant") if figure in found.get(way, {})), default=inf)
    return found["auto"].get(figure, inf) / best if best < inf else np.nan


def verdict(found: dict[str, dict[str, Row]]) -> list[str]:
    """Lines on the ratios of systems by their names: how many are below one and too large, and the worst."""
    lines = []
    for figure in ("iterations", "products"):
        ratios = {name: ratio(rows, figure) for name, rows in found.items()}
        known = {name: value for name, value in ratios.items() if not np.isnan(value)}
        if known:
            worst = max(known, key=lambda name: known[name])
            beyond = ", ".join(f"{name} ({value:.2f})" for name, value in known.items() if value > TOO_MANY)
            lines.append(
                f"{figure} of auto over the better of CG alone and the circulant, {len(known)} systems: fewer in "
                f"{sum(value < 1 for value in known.values())}, at most {known[worst]:.2f} ({worst}); more than "
                f"{TOO_MANY} times in {sum(value > TOO_MANY for value in known.values())}: {beyond or 'none'}"
            )
    return lines
