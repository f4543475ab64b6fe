"""Matrices that are negative definite or singular, or have zeros on the diagonal."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
from systems import contact_matrix, contacts
from train_solver import Kernel, context, dense_mat, operator, poisson, ready, shell, solve, solver

from pctt.mat import from_entries


@pytest.mark.parallel(1, 2)
@pytest.mark.parametrize("rank", ["8", "auto"])
def test_minus_a_stored_matrix_has_minus_its_preconditioner(rank):
    mat = poisson(14)
    ksp = ready(mat, rank=rank)
    its, _ = solve(ksp)
    expected = operator(ksp)
    mat.scale(-1.0)
    ksp = ready(mat, rank=rank)
    np.testing.assert_allclose(operator(ksp), -expected, rtol=1e-6, atol=1e-8)
    again, left = solve(ksp)
    assert again == its
    assert left < 1e-6
    mat.scale(-1.0)  # with the same solver
    assert solve(ksp)[0] == its


def test_blocks():
    mat = contact_matrix(*contacts(40, 30))
    mat.scale(-1.0)
    ksp = ready(mat, rank=30)
    assert context(ksp).rank == 30
    assert solve(ksp)[1] < 1e-6


@pytest.mark.parallel(1, 2)
@pytest.mark.parametrize("rank", ["20", "auto"])
@pytest.mark.parametrize("kind", ["shell", "dense", "train"])
def test_minus_a_kernel(rank, kind):
    kernel = Kernel((12, 10), 0.5)

    def minus(i, j):
        return -kernel(i, j)

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        its = {}
        for name, entries, A in (("plus", kernel, kernel.dense), ("minus", minus, -kernel.dense)):
            if kind == "train":
                mat = from_entries(entries, kernel.grid)
            else:
                mat = shell(entries, A, grid=kernel.grid) if kind == "shell" else dense_mat(A, grid=kernel.grid)
            ksp = ready(mat, rank=rank)
            its[name], left = solve(ksp)
            assert left < 1e-6
    assert its["minus"] == its["plus"] < 15


@pytest.mark.parallel(1, 2)
@pytest.mark.parametrize("block", [1, 2])
def test_a_zero_on_the_diagonal(block):
    """As PCJACOBI: one stands in its place."""
    mat = poisson(8)
    other = poisson(8)
    for row in (6, 20):
        for A in (mat, other):
            A.zeroRowsColumns([row], diag=0.0 if A is mat else 1.0)
    if block > 1:
        mat.setBlockSize(block)
        other.setBlockSize(block)
    for A in (mat, other):
        A.setAttr("coordinates", None)
    expected = operator(ready(other, "gmres", rank=1))
    found = operator(ready(mat, "gmres", rank=1))
    if block == 1:
        np.testing.assert_allclose(found, expected)
    assert np.isfinite(found).all()
    ksp = solver(mat, "gmres", rank="auto")
    x, b = mat.createVecs()
    b.set(1.0)
    b[6] = b[20] = 0.0
    b.assemble()
    ksp.solve(b, x)
    assert ksp.getConvergedReason() > 0


def test_a_zero_on_the_diagonal_of_entries():
    A = np.diag([2.0, 0.0, 3.0])
    found = operator(ready(shell(lambda i, j: A[i, j], A), "gmres", rank=1))
    np.testing.assert_allclose(found, np.diag([0.5, 1.0, 1 / 3]))
