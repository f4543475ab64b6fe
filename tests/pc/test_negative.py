"""Matrices that are negative definite or singular, or have zeros on the diagonal."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
from petsc4py import PETSc
from systems import contact_matrix, contacts
from train_solver import Kernel, context, dense_mat, left, operator, poisson, ready, shell, solve, solver

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
    again, residual = solve(ksp)
    assert again == its
    assert residual < 1e-6
    ksp.setType("minres")  # its preconditioner must be positive
    assert solve(ksp)[0] <= its
    ksp.setType("cg")
    mat.scale(-1.0)  # with the same solver
    assert solve(ksp)[0] == its


def test_blocks():
    mat = contact_matrix(*contacts(40, 30))
    mat.scale(-1.0)
    ksp = ready(mat, rank=30)
    assert context(ksp).rank == 30
    assert solve(ksp)[1] < 1e-6


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
            its[name], residual = solve(ksp)
            assert residual < 1e-6
    assert its["minus"] == pytest.approx(its["plus"], abs=3)  # starts of trains are random
    assert its["plus"] < 15


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


def neumann(n: int, coefficient: bool) -> PETSc.Mat:
    """The five-point stencil without fixed values; its null space is the constant."""
    mat = poisson(n)
    first, last = mat.getOwnershipRange()
    x, y = np.divmod(np.arange(n * n), n)
    size = 1.0 + coefficient * (x + 2.0 * y) / n
    indptr, indices, _ = mat.getValuesCSR()
    row = np.repeat(np.arange(first, last), np.diff(indptr))
    values = np.where(row == indices, 0.0, -np.sqrt(size[row] * size[indices]))
    values[row == indices] = -np.bincount(row - first, values)
    mat.setValuesCSR(indptr, indices, values)
    mat.assemble()
    return mat


@pytest.mark.parallel(1, 2)
@pytest.mark.parametrize("attached", [True, False])
@pytest.mark.parametrize("coefficient", [False, True])
def test_a_singular_matrix(coefficient, attached):
    its = {}
    for rank in (1, 16):
        mat = neumann(20, coefficient)
        if attached:
            mat.setNullSpace(PETSc.NullSpace().create(constant=True, comm=mat.comm))
        ksp = solver(mat, rank=rank)
        x, b = mat.createVecs()
        b.array[:] = np.random.default_rng(0).standard_normal(400)[slice(*b.getOwnershipRange())]
        b.shift(-b.sum() / 400)
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            ksp.solve(b, x)
        its[rank] = ksp.getIterationNumber()
        assert context(ksp).rank == rank
        assert left(ksp, x, b) < 1e-6
    assert 3 * its[16] < its[1]
