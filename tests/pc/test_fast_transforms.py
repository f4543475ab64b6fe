"""What pctt.pc.TensorTrain makes of matrices given by their entries: fast transforms, trains, the diagonal."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
from mpi4py import MPI
from petsc4py import PETSc
from train_solver import context, dense_of, operator, ready, report, shell, solve, solver

from pctt.tt.differences import FastTransform, depend_on_differences, means_of_differences

GRID = (10, 7)
SIZE = 70


def covariance(i: np.ndarray, j: np.ndarray) -> np.ndarray:
    apart = np.subtract(np.unravel_index(i, GRID), np.unravel_index(j, GRID))
    return 0.1 * (i == j) + np.exp(-np.sqrt((apart**2).sum(axis=0)) / 4)


def oblique(i: np.ndarray, j: np.ndarray) -> np.ndarray:
    """Of differences, but other for (1, 1) than for (1, -1)."""
    x, y = np.subtract(np.unravel_index(i, GRID), np.unravel_index(j, GRID))
    return 1.0 * (i == j) + 0.3 * np.exp(-np.abs(x - 0.7 * y))


def weighted(i: np.ndarray, j: np.ndarray) -> np.ndarray:
    return (i == j) + 0.1 * np.sqrt((1 + i) * (1 + j)) * covariance(i, j)


def preconditioner(entries, **options: object) -> PETSc.KSP:
    """CG set up for a dense matrix of PETSc's type python."""
    return ready(shell(entries, dense_of(entries, SIZE), grid=GRID), rtol=1e-10, **options)


def made(ksp: PETSc.KSP):
    return context(ksp).made


def test_differences_are_recognised():
    rng = np.random.default_rng(0)
    assert depend_on_differences(covariance, GRID, None, rng) is True
    assert depend_on_differences(oblique, GRID, None, rng) is False
    for entries in (weighted, lambda i, j: covariance(i, j) + 1e-3 * i * (i == j), lambda i, j: 1.0 / (1 + i + j)):
        assert depend_on_differences(entries, GRID, None, rng) is None
    order = rng.permutation(SIZE)
    of_row = np.argsort(order)
    assert depend_on_differences(lambda i, j: covariance(of_row[i], of_row[j]), GRID, order, rng) is True
    assert depend_on_differences(lambda i, j: covariance(of_row[i], of_row[j]), GRID, None, rng) is None


@pytest.mark.parametrize(("entries", "even"), [(covariance, True), (oblique, False)])
def test_means_are_those_over_all_signs(entries, even):
    A = dense_of(entries, SIZE)
    x, y = np.unravel_index(np.arange(SIZE), GRID)
    found = means_of_differences(entries, GRID, None, even)
    for a, b in ((0, 0), (3, 2), (9, 6), (0, 4)):
        each = [A[(x[:, None] - x == s * a) & (y[:, None] - y == t * b)].mean() for s in (1, -1) for t in (1, -1)]
        assert found[a, b] == pytest.approx(np.mean(each))


@pytest.mark.parallel(1, 2, 3)
@pytest.mark.parametrize("entries", [covariance, oblique])
def test_the_preconditioner_is_the_transform(entries):
    ksp = preconditioner(entries)
    name, share = made(ksp).transform.transform.name, made(ksp).transform.transform.share
    assert f"{name} of a grid of 10 x 7" in report(ksp)
    transform = FastTransform(means_of_differences(entries, GRID, None, entries is covariance), share)
    np.testing.assert_allclose(operator(ksp).T, [transform.solve(v) for v in np.eye(SIZE)], rtol=1e-9, atol=1e-14)
    iterations, left = solve(ksp)
    assert iterations <= 20
    assert left < 1e-8


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
    assert "block Jacobi takes over" in words
    assert context(ksp).rank == 1
    np.testing.assert_allclose(operator(ksp), np.diag(1 / np.diag(dense_of(weighted, SIZE))))


@pytest.mark.parallel(1, 2)
def test_auto_takes_no_train_that_does_not_pay():
    ksp = preconditioner(weighted)
    assert context(ksp).rank == 1
    assert "so a train does not pay" in report(ksp)


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


@pytest.mark.parallel(1, 2)
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
        assert any("takes over" in str(one.message) for one in heard) == (refused and MPI.COMM_WORLD.rank == 0)
        if not refused:
            its, _ = solve(ksp)
            assert its == solve(ready(mat, rank=8))[0]


@pytest.mark.parallel(1, 2)
@pytest.mark.parametrize("limit", [3e8, 1e8])
def test_at_the_limit_of_operations_the_last_inverse_is_kept(limit):
    """So a larger rank is no worse than a small one, which ends below the limit."""
    size = 256
    A = 1.0 / np.add.outer(np.arange(size), np.arange(1, size + 1)) + 1e-3 * np.eye(size)
    its = {}
    for rank in (16, 64):
        ksp = ready(shell(lambda i, j: A[i, j], A, grid=(size,)), rank=rank, setup_limit=limit)
        assert context(ksp).rank > 1
        its[rank] = solve(ksp)[0]
    assert its[64] <= its[16] + 2
    assert "the limit of operations" in report(ksp)
