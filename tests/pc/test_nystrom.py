"""Nystrom's approximation as a preconditioner of matrices that have no fast transform."""

from __future__ import annotations

import numpy as np
import pytest
from mpi4py import MPI
from petsc4py import PETSc
from train_solver import context, dense_mat, gathered, ready, report, shell, solve

from pctt.pc.nystrom import Nystrom, PartialCholesky, choose, trial

COMM = MPI.COMM_WORLD


def apart(points: np.ndarray) -> np.ndarray:
    return np.linalg.norm(points[:, None] - points, axis=2)


def grid(n: int) -> np.ndarray:
    return np.stack(np.unravel_index(np.arange(n * n), (n, n)), axis=1) / n


def masked() -> np.ndarray:
    """A disc with a hole."""
    points = grid(34)
    from_centre, from_hole = (np.linalg.norm(points - centre, axis=1) for centre in ((0.5, 0.5), (0.6, 0.6)))
    return np.exp(-apart(points[(from_centre < 0.5) & (from_hole > 0.12)]) / 0.2)


def incomplete() -> np.ndarray:
    points = grid(30)
    return np.exp(-apart(points[np.random.default_rng(1).random(len(points)) > 0.3]) / 0.3)


def noisy() -> np.ndarray:
    """With noise that differs from point to point by a factor of 1000."""
    noise = 10 ** np.random.default_rng(1).uniform(-3, 0, 676)
    return np.exp(-(apart(grid(26)) ** 2) / 0.05) + np.diag(noise)


def graded() -> np.ndarray:
    side = (np.arange(26) / 26) ** 2
    return np.exp(-apart(np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2)) / 0.3)


def gibbs() -> np.ndarray:
    """Of a length that grows from 0.05 to 0.35."""
    points = grid(26)
    length = 0.05 + 0.3 * points[:, 0]
    both = np.add.outer(length**2, length**2)
    return 2 * np.outer(length, length) / both * np.exp(-(apart(points) ** 2) / both)


def sphere() -> np.ndarray:
    points = np.random.default_rng(1).standard_normal((700, 3))
    return np.exp(-apart(points / np.linalg.norm(points, axis=1)[:, None]) / 0.7)


CASES = {case.__name__: case for case in (masked, incomplete, noisy, graded, gibbs, sphere)}


def matrix(A: np.ndarray) -> PETSc.Mat:
    return shell(lambda i, j: A[i, j], A)


@pytest.mark.parametrize("case", CASES)
def test_it_takes_half_of_the_iterations(case):
    A = CASES[case]() + 3e-3 * np.eye(len(CASES[case]()))
    its, left = solve(ready(matrix(A), rank="1"))
    ksp = ready(matrix(A), rank="auto")
    found, left_too = solve(ksp)
    assert "Nystrom's approximation of rank" in report(ksp)
    assert 2 * found < its
    assert max(left, left_too) < 1e-6


@pytest.mark.parallel(1, 2, 3)
def test_a_factorisation_is_right_at_its_pivots():
    A = gibbs() + 1e-2 * np.eye(676)
    mat = matrix(A)
    factor = PartialCholesky(mat)
    assert factor.grow(100)
    F = np.concatenate(COMM.allgather(factor.F))
    left = np.concatenate(COMM.allgather(factor.left))
    assert len(np.unique(factor.pivots)) == 100
    np.testing.assert_allclose((F @ F.T)[factor.pivots], A[factor.pivots], atol=1e-9)
    np.testing.assert_allclose(left, np.diag(A - F @ F.T), atol=1e-9)
    assert left.max() < 0.5
    own = slice(*mat.getOwnershipRange())
    for diagonal in factor.diagonals():
        D = np.concatenate(COMM.allgather(diagonal))
        assert D.min() > 0
        x = np.random.default_rng(0).standard_normal((2, 676))
        y = np.concatenate(COMM.allgather(Nystrom(COMM, factor.F, diagonal)(x[:, own])), axis=1)
        np.testing.assert_allclose(y @ (np.diag(D) + F @ F.T), x, atol=1e-6)


@pytest.mark.parallel(1, 2)
def test_a_matrix_of_low_rank_ends_the_factorisation():
    U = np.random.default_rng(0).standard_normal((90, 7))
    factor = PartialCholesky(matrix(U @ U.T))
    factor.grow(40)
    F = np.concatenate(COMM.allgather(factor.F))
    assert 7 <= F.shape[1] <= 20  # what is left is rounding
    np.testing.assert_allclose(F @ F.T, U @ U.T, atol=1e-6)


@pytest.mark.parallel(1, 2)
def test_what_does_not_pay_is_not_taken():
    """Block Jacobi hurts Hilbert's matrix with noise, helps rows of other sizes; easy matrices need nothing."""
    hilbert = 1.0 / np.add.outer(np.arange(300), np.arange(1, 301)) + 1e-3 * np.eye(300)
    found = choose(matrix(hilbert), matrix(hilbert), 0.5 * 300**2)
    assert (found.inverse, found.scaled) == (None, False)
    ksp = ready(matrix(hilbert), rank="auto")
    assert "no preconditioner" in report(ksp)
    assert solve(ksp)[0] < 40
    size = 10.0 ** np.linspace(-2, 2, 300)
    rows = size[:, None] * (hilbert + np.eye(300)) * size
    found = choose(matrix(rows), matrix(rows), 0.5 * 300**2)
    assert (found.inverse, found.scaled) == (None, True)


@pytest.mark.parallel(1, 2)
def test_a_trial_foresees_the_iterations():
    values = np.random.default_rng(0).uniform(1.0, 400.0, 500)
    A = matrix(np.diag(values))
    ksp = ready(A, rank="1")
    ksp.pc.setType("none")
    its, _ = solve(ksp)
    found = trial(A, [None])
    assert 0.4 * its < found.iterations[0] < 2.5 * its
    assert found.spent <= 0.3 * its
    assert trial(A, [lambda x: x / values[slice(*A.getOwnershipRange())]]).iterations[0] <= 3
    assert trial(matrix(np.diag(values - 10.0)), [None]).iterations[0] == np.inf


@pytest.mark.parallel(2)
def test_a_dense_mat_and_blocks():
    """Scattered points with two unknowns each."""
    points = np.random.default_rng(2).random((300, 2))
    A = np.kron(np.exp(-apart(points) / 0.5), [[1.0, 0.3], [0.3, 1.0]]) + 1e-3 * np.eye(600)
    its = solve(ready(dense_mat(A), rank="1"))[0]
    ksp = ready(dense_mat(A), rank="auto")
    assert "Nystrom" in report(ksp)
    assert 2 * solve(ksp)[0] < its
    assert gathered(ksp.getOperators()[0].getDiagonal()).shape == (600,)
    assert context(ksp).what() != ""
