"""What a preconditioner costs that turns out worse than its trial has shown: at most twice as many products as none."""

from __future__ import annotations

import numpy as np
import pytest
from petsc4py import PETSc
from train_solver import context, ready, report, shell

from pctt.mat import from_differences
from pctt.pc.watch import AT_LEAST
from pctt.tt import differences as of
from pctt.tt.conjugate import CostEstimate

SIZE = 900  # unknowns of the dense matrices
CHOOSE = of.choose


def points() -> np.ndarray:
    return np.stack(np.unravel_index(np.arange(SIZE), (30, 30)), axis=1) / 30


def covariance(length: np.ndarray, nugget: float) -> np.ndarray:
    """Of a length that varies; so entries do not depend on differences."""
    apart, both = np.linalg.norm(points()[:, None] - points(), axis=2), np.add.outer(length, length) / 2
    return np.sqrt(np.outer(length, length)) / both * np.exp(-apart / both) + nugget * np.eye(SIZE)


def gibbs() -> np.ndarray:
    return covariance(0.05 + 0.3 * points()[:, 0], 0.01)


def weighted() -> np.ndarray:
    """Rows of other sizes, which the diagonal mends, and an easy kernel."""
    size = 10 ** np.linspace(-0.6, 0.6, SIZE)
    return size[:, None] * covariance(np.full(SIZE, 0.02) + 1e-4 * points()[:, 1], 1.0) * size


def dense(A: np.ndarray) -> PETSc.Mat:
    return shell(lambda i, j: A[i, j], A, grid=(SIZE,))


def smooth(s: np.ndarray) -> np.ndarray:
    return 0.01 * (s == 0).all(axis=0) + np.exp(-np.hypot(*s) / 12)


def oscillating(s: np.ndarray) -> np.ndarray:
    return 0.1 * (s == 0).all(axis=0) + np.sinc(0.15 * s[0]) * np.sinc(0.1 * s[1])


def counted(A: PETSc.Mat) -> list[int]:
    """One for each product."""
    found, shell_ = [], A.getPythonContext()
    mult = shell_.mult
    shell_.mult = lambda mat, x, y: found.append(1) or mult(mat, x, y)
    return found


def products_alone(A: PETSc.Mat, b: PETSc.Vec, rtol: float) -> int:
    ksp, x = PETSc.KSP().create(A.comm), b.duplicate()
    ksp.setOperators(A)
    ksp.setType("cg")
    ksp.setNormType(PETSc.KSP.NormType.UNPRECONDITIONED)
    ksp.setTolerances(rtol=rtol, max_it=5000)
    ksp.pc.setType("none")
    ksp.solve(b, x)
    assert ksp.getConvergedReason() > 0
    return ksp.getIterationNumber()


def spoil(ksp: PETSc.KSP, name: str) -> None:
    """Put a positive matrix that has nothing to do with A in place of the preconditioner that was chosen."""
    inner = context(ksp)
    A, _ = ksp.getOperators()
    wrong = 10 ** np.random.default_rng(3).uniform(-2, 2, A.getSize()[0])[slice(*A.getOwnershipRange())]
    if name == "block Jacobi":
        diagonal = PETSc.Mat().createAIJ(A.getSizes(), nnz=1, comm=A.comm)
        vec = A.createVecLeft()
        vec.array_w[:] = wrong
        diagonal.setDiagonal(vec)
        diagonal.assemble()
        inner._jacobi.setOperators(diagonal)
        inner._jacobi.setUp()
    else:
        inner.made.times = lambda x: wrong * x


def solved(ksp: PETSc.KSP, b: PETSc.Vec, rtol: float) -> None:
    """Solve; the residual is as asked."""
    A, _ = ksp.getOperators()
    ksp.setNormType(PETSc.KSP.NormType.UNPRECONDITIONED)
    x, r = A.createVecs()
    ksp.solve(b, x)
    assert ksp.getConvergedReason() > 0
    A.mult(x, r)
    r.aypx(-1.0, b)
    assert r.norm() <= 2 * rtol * b.norm()


def right_side(A: PETSc.Mat, kind: str) -> PETSc.Vec:
    b = A.createVecLeft()
    values = np.random.default_rng(1).standard_normal(A.getSize()[0]) if kind == "random" else np.ones(A.getSize()[0])
    b.array_w[:] = values[slice(*b.getOwnershipRange())]
    return b


CASES = {
    "transform": (lambda: from_differences(smooth, (60, 50)), "auto", "cosine"),
    "Nystrom": (lambda: dense(gibbs()), "auto", "Nystrom"),
    "block Jacobi": (lambda: dense(weighted()), "auto", "block Jacobi"),
    "train": (
        lambda: dense(1.0 / np.add.outer(np.arange(SIZE), np.arange(1, SIZE + 1)) + 1e-3 * np.eye(SIZE)),
        20,
        "Z",
    ),
}


@pytest.mark.parallel(1, 2)
@pytest.mark.parametrize(("rtol", "side"), [(1e-8, "random"), (1e-5, "ones")])
@pytest.mark.parametrize("name", CASES)
def test_a_preconditioner_that_turns_out_wrong_costs_as_much_as_none_again(name, rtol, side):
    make, rank, words = CASES[name]
    A = make()
    b = right_side(A, side)
    alone, found = products_alone(A, b, rtol), counted(A)
    ksp = ready(A, rank=rank, rtol=rtol)
    ksp.setTolerances(rtol=rtol, max_it=5000)
    assert words in report(ksp)
    cost_estimate = context(ksp).made.cost_estimate
    on_parts = cost_estimate.spent if name == "transform" else 0.0
    spoil(ksp, name)
    solved(ksp, b, rtol)
    assert on_parts + len(found) <= 2 * alone + AT_LEAST
    assert "conjugate gradients alone take" in report(ksp)
    found.clear()
    vars(context(ksp).made).pop("times", None)
    solved(ksp, b, rtol)  # the next solve has none from the start
    assert len(found) <= alone + 2


@pytest.mark.parametrize("kind", [of.CIRCULANT, (("sine", 1.0),), (("embedding", 1.0),)])
@pytest.mark.parametrize(
    "entries", [oscillating, lambda s: 0.1 * (s == 0).all(axis=0) + np.cos(0.4 * s[0] - 0.3 * s[1])]
)
def test_a_wrong_choice_costs_twice_as_much_as_none(kind, entries, monkeypatch):
    """What the trial shows of it is wrong, what it shows of none is not."""

    def wrong(a: of.Differences) -> of.Choice:
        honest = CHOOSE(a).cost_estimate
        each = of.FastInverse(a, kind).each
        return of.Choice(kind, CostEstimate(each, [1.0, 1e-1, 1e-8], honest.unpreconditioned, honest.spent))

    monkeypatch.setattr(of, "choose", wrong)
    A = from_differences(entries, (60, 50))
    b = right_side(A, "random")
    alone, found = products_alone(A, b, 1e-8), counted(A)
    ksp = ready(A, rtol=1e-8)
    solved(ksp, b, 1e-8)
    assert context(ksp).account.setups == 1
    assert len(found) <= 2 * alone + AT_LEAST


@pytest.mark.parallel(1, 2)
def test_trials_may_have_cost_more_than_none(monkeypatch):
    """Then none are in turns from the first norm of a residual that PETSc knows."""

    def dear(a: of.Differences) -> of.Choice:
        return of.Choice(of.COSINE, CostEstimate(0.25, [1.0, 1e-8], [1.0], 1000.0))

    monkeypatch.setattr(of, "choose", dear)
    A = from_differences(smooth, (60, 50))
    solved(ready(A, rtol=1e-8), right_side(A, "random"), 1e-8)
