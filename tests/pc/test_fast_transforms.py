"""What pctt.pc.TensorTrain makes of matrices given by their entries: fast transforms, trains, the diagonal."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
from mpi4py import MPI
from petsc4py import PETSc
from train_solver import context, dense_of, operator, ready, report, shell, solve, solver

from pctt.mat import from_differences
from pctt.pc.watch import AT_LEAST, PROBE
from pctt.tt import differences as of
from pctt.tt.conjugate import CostEstimate

GRID = (10, 7)
SIZE = 70


def covariance(i: np.ndarray, j: np.ndarray) -> np.ndarray:
    apart = np.subtract(np.unravel_index(i, GRID), np.unravel_index(j, GRID))
    return 0.1 * (i == j) + np.exp(-np.sqrt((apart**2).sum(axis=0)) / 4)


def oblique(i: np.ndarray, j: np.ndarray) -> np.ndarray:
    """Of differences, but other for (1, 1) than for (1, -1)."""
    x, y = np.subtract(np.unravel_index(i, GRID), np.unravel_index(j, GRID))
    return 0.03 * (i == j) + np.exp(-np.hypot(x - 0.4 * y, y) / 6)


def pairs(i: np.ndarray, j: np.ndarray) -> np.ndarray:
    """Two unknowns a point; mixed entries are odd in both coordinates."""
    x, y = np.subtract(np.unravel_index(i // 2, GRID), np.unravel_index(j // 2, GRID)) / 6.0
    p, q, r = i % 2, j % 2, np.hypot(x, y)
    along = np.where(p == 0, x, y) * np.where(q == 0, x, y)
    return 0.05 * (i == j) + ((p == q) * (1 + r) - along) * np.exp(-r)


def weighted(i: np.ndarray, j: np.ndarray) -> np.ndarray:
    return (i == j) + 0.1 * np.sqrt((1 + i) * (1 + j)) * covariance(i, j)


def preconditioner(entries, **options: object) -> PETSc.KSP:
    """CG set up for a dense matrix of PETSc's type python."""
    return ready(shell(entries, dense_of(entries, SIZE), grid=GRID), rtol=1e-10, **options)


def made(ksp: PETSc.KSP):
    return context(ksp).made


def test_differences_are_recognised():
    def kind(entries, block=1, order=None):
        return of.depend_on_differences(entries, GRID, block, order, rng)

    rng = np.random.default_rng(0)
    assert kind(covariance) is True
    assert kind(oblique) is False
    for entries in (weighted, lambda i, j: covariance(i, j) + 1e-3 * i * (i == j), lambda i, j: 1.0 / (1 + i + j)):
        assert kind(entries) is None
    order = rng.permutation(SIZE)
    of_row = np.argsort(order)
    assert kind(lambda i, j: covariance(of_row[i], of_row[j]), order=order) is True
    assert kind(lambda i, j: covariance(of_row[i], of_row[j])) is None
    assert kind(pairs, 2) is False
    assert kind(lambda i, j: covariance(i // 2, j // 2) * (1 + (i % 2 == j % 2)), 2) is True
    assert kind(lambda i, j: pairs(i, j) + 0.01 * (i == j) * i, 2) is None


@pytest.mark.parametrize(("entries", "even", "block"), [(covariance, True, 1), (oblique, False, 1), (pairs, False, 2)])
def test_the_differences_are_those_of_the_entries(entries, even, block):
    A = dense_of(entries, SIZE * block)
    order = np.random.default_rng(0).permutation(SIZE * block)
    of_row = np.argsort(order)
    for a in (
        of.differences_of(entries, GRID, block, None, even),
        of.differences_of(lambda i, j: entries(of_row[i], of_row[j]), GRID, block, order, even),
    ):
        assert a.even == even
        assert a.symmetric
        np.testing.assert_allclose(a.times(np.eye(len(A))), A, atol=1e-12)


@pytest.mark.parallel(1, 2, 3)
@pytest.mark.parametrize(("entries", "even", "block"), [(covariance, True, 1), (oblique, False, 1), (pairs, False, 2)])
def test_the_preconditioner_is_the_transform(entries, even, block, monkeypatch):
    monkeypatch.setattr(of, "choose", promised(of.COSINE, [1.0, 1e-8], [1.0]))
    A = dense_of(entries, SIZE * block)
    ksp = ready(shell(entries, A, grid=GRID, block=block), rtol=1e-10)
    inverse = made(ksp).transform.inverse
    assert inverse.kind
    assert f"{inverse.name} of a grid of 10 x 7" in report(ksp)
    wanted = of.FastInverse(of.differences_of(entries, GRID, block, None, even), inverse.kind)
    np.testing.assert_allclose(operator(ksp).T, wanted.solve(np.eye(len(A))), rtol=1e-9, atol=1e-14)
    iterations, left = solve(ksp)
    assert iterations <= 60
    assert left < 1e-8


@pytest.mark.parallel(1, 3)
@pytest.mark.parametrize("rank", ["auto", "20", "1"])
def test_many_vectors_are_multiplied_at_a_time(rank):
    ksp = preconditioner(covariance, rank=rank)
    A, _ = ksp.getOperators()
    X = PETSc.Mat().createDense((A.getSizes()[0], (PETSc.DECIDE, 4)), comm=A.comm)
    X.setUp()
    X.getDenseArray()[:] = np.random.default_rng(A.comm.rank).standard_normal(X.getDenseArray().shape)
    X.assemble()
    Y, y = X.duplicate(), A.createVecLeft()
    calls, times = [], made(ksp).times
    made(ksp).times = lambda x: calls.append(x.shape) or times(x)
    ksp.pc.matApply(X, Y)
    assert len(calls) == (rank != "1")
    for k in range(4):
        ksp.pc.apply(X.getColumnVector(k), y)
        np.testing.assert_allclose(Y.getDenseArray(readonly=True)[:, k], y.array_r, rtol=1e-12, atol=1e-13)


# -- watching -------------------------------------------------------------------------------------------------


def waves(s: np.ndarray) -> np.ndarray:
    """Few eigenvalues are large: conjugate gradients alone take five iterations, with a cosine transform hundreds."""
    return 0.1 * (s == 0).all(axis=0) + np.cos(0.5 * s[0]) * np.cos(0.4 * s[1])


def promised(kind: of.Kind, norms: list[float], alone: list[float]):
    """A choice of this preconditioner, whether it is good or not."""
    return lambda a: of.Choice(kind, CostEstimate(of.FastInverse(a, kind).each, norms, alone))


@pytest.mark.parallel(1, 2, 3)
@pytest.mark.parametrize("method", ["cg", "gmres", "bcgs", "minres", "fcg"])
@pytest.mark.parametrize(("norm", "guess"), [("unpreconditioned", False), ("preconditioned", True), ("natural", False)])
def test_a_preconditioner_that_breaks_its_promise_is_left(method, norm, guess, monkeypatch):
    if method not in {"cg", "fcg"} and norm != ("preconditioned" if method == "minres" else "unpreconditioned"):
        pytest.skip("PETSc has no such method, or it takes the norm of another residual")
    monkeypatch.setattr(of, "choose", promised(of.COSINE, [1.0, 1e-1, 1e-8], [1.0, 1e-1, 1e-8]))
    ksp = solver(from_differences(waves, (40, 40)), method, rtol=1e-8)
    ksp.setNormType(getattr(PETSc.KSP.NormType, norm.upper()))
    if method in {"gmres", "bcgs"} and norm == "unpreconditioned":
        ksp.setPCSide(PETSc.PC.Side.RIGHT)
    ksp.setInitialGuessNonzero(guess)
    ksp.setUp()
    A, _ = ksp.getOperators()
    x, b = A.createVecs()
    x.set(0.3)
    b.array[:] = np.random.default_rng(1).standard_normal(1600)[slice(*b.getOwnershipRange())]
    ksp.solve(b, x)
    assert ksp.getConvergedReason() > 0
    assert ksp.max_it == 2000
    assert ksp.getIterationNumber() <= AT_LEAST  # CG alone takes five
    r = b.duplicate()
    A.mult(x, r)
    r.aypx(-1.0, b)
    assert r.norm() <= 1e-6 * b.norm()
    assert "no preconditioner, no train, because conjugate gradients alone take" in report(ksp)
    ksp.setInitialGuessNonzero(False)
    ksp.solve(b, x)  # the next solve has none from the start
    assert ksp.getIterationNumber() <= 6


def test_one_that_keeps_its_promise_is_not_left():
    A = from_differences(lambda s: 0.01 * (s == 0).all(axis=0) + np.exp(-np.hypot(*s) / 12), (50, 50))
    products = []
    mult = A.getPythonContext().mult
    A.getPythonContext().mult = lambda mat, x, y: products.append(1) or mult(mat, x, y)
    ksp = ready(A, rtol=1e-8)
    iterations, left = solve(ksp)
    assert left < 1e-6
    assert len(products) <= iterations + PROBE + 2
    assert "cosine" in report(ksp)


def test_the_promise_of_a_worse_method_is_kept_where_none_is_worse_still(monkeypatch):
    """Conjugate gradients alone are tried beside, and not taken, as they are slower."""
    monkeypatch.setattr(of, "choose", promised(of.COSINE, [1.0, 1e-8], [1.0, 1e-1, 1e-8]))
    A = from_differences(lambda s: 0.01 * (s == 0).all(axis=0) + np.exp(-np.hypot(*s) / 12), (50, 50))
    ksp = ready(A, rtol=1e-8)
    iterations, left = solve(ksp)
    assert iterations < 40
    assert left < 1e-6
    assert "cosine" in report(ksp)


@pytest.mark.parallel(1, 3)
def test_a_rank_asks_for_a_train():
    ksp = preconditioner(covariance, rank=30)
    assert made(ksp).transform is None
    assert context(ksp).rank == 30


@pytest.mark.parallel(1, 2)
def test_a_limit_stops_the_set_up_and_says_so():
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        ksp = preconditioner(weighted, rank=30, setup_limit=1e6)
    words = MPI.COMM_WORLD.bcast(" ".join(str(w.message) for w in said))
    assert "the limit of 1.0e+06 operations (-pc_tt_setup_limit) ends" in words
    assert "no preconditioner takes over" in words
    np.testing.assert_allclose(operator(ksp), np.eye(SIZE))


@pytest.mark.parallel(1, 2)
@pytest.mark.parametrize("entries", [weighted, covariance])
def test_auto_takes_no_train_that_does_not_pay(entries):
    ksp = preconditioner(entries)
    assert made(ksp).inverse is None
    assert "no train" in report(ksp)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # on the first rank: the option has no effect
        assert np.array_equal(operator(preconditioner(entries, eps=1e-5)), operator(ksp))


def test_unsymmetric_and_indefinite_entries_get_no_transform():
    for entries in (lambda i, j: covariance(i, j) + 0.3 * (i > j), lambda i, j: covariance(i, j) - 1.2 * (i == j)):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            assert made(preconditioner(entries)).transform is None


class Fit:
    """Hyperparameters that change between solves, in one Mat. Entries do not depend on differences."""

    def __init__(self, side: int = 24) -> None:
        self.side, self.length, self.nugget = side, 0.0, 0.0

    def __call__(self, i: np.ndarray, j: np.ndarray) -> np.ndarray:
        x, y = (np.array(np.unravel_index(k, (self.side, self.side))) / self.side for k in (i, j))
        near = np.exp(-np.sqrt(((x - y) ** 2).sum(axis=0)) / self.length)
        return (1 + x[0]) * (1 + y[0]) * near + self.nugget * (i == j)

    def set(self, length: float, nugget: float, A: np.ndarray) -> None:
        self.length, self.nugget = length, nugget
        A[:] = dense_of(self, self.side**2)


def test_a_refusal_holds_for_its_values():
    """Easy hyperparameters after hard ones get the train that they get in a new solver."""
    fit = Fit()
    A = np.empty((fit.side**2, fit.side**2))
    mat = shell(fit, A, grid=(fit.side, fit.side))
    ksp = None
    for length, nugget, refused in ((0.3, 1e-4, True), (0.03, 1.0, False), (1.0, 1e-4, True), (0.05, 2.0, False)):
        fit.set(length, nugget, A)
        mat.stateIncrease()
        with warnings.catch_warnings(record=True) as heard:
            warnings.simplefilter("always")
            ksp = ksp or solver(mat, rank=8)
            ksp.setOperators(mat)
            ksp.setUp()
        assert bool(made(ksp).failure) == refused
        assert any("takes over" in str(one.message) for one in heard) == refused
        if not refused:
            its, _ = solve(ksp)
            assert its == solve(ready(mat, rank=8))[0]


@pytest.mark.parallel(1, 2)
def test_at_the_limit_of_operations_the_last_inverse_is_kept():
    """So a larger rank is no worse than a small one, which ends below the limit."""
    size = 256
    A = 1.0 / np.add.outer(np.arange(size), np.arange(1, size + 1)) + 1e-3 * np.eye(size)
    its = {}
    for rank in (16, 64):
        ksp = ready(shell(lambda i, j: A[i, j], A, grid=(size,)), rank=rank, setup_limit=1e8)
        assert context(ksp).rank > 1
        its[rank] = solve(ksp)[0]
    assert its[64] <= its[16] + 4  # none takes 28
    assert "the limit of operations" in report(ksp)


def test_a_larger_rank_is_no_worse_at_a_tiny_limit():
    """Of a kernel with weights on a square; the diagonal takes 56."""
    n = 30
    x, y = (np.indices((n, n)).reshape(2, -1) + 0.5) / n
    r, weight = np.hypot(x[:, None] - x, y[:, None] - y), 10 * x * y + 0.1
    A = np.eye(n * n) + weight[:, None] * (100 / n**2 * np.exp(-10 * r)) * weight
    its = []
    for rank in (10, 100):
        ksp = ready(shell(lambda i, j: A[i, j], A, grid=(n, n)), rank=rank, setup_limit=3e7)
        its.append(solve(ksp)[0])
        assert its[-1] <= min(its) + 4
