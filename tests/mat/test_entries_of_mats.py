"""pctt.mat: matrices given by their entries, as operators and as what preconditioners are made from."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from mpi4py import MPI
from petsc4py import PETSc
from train_solver import Kernel, context, dense_mat, gathered, operator, ready, report, shell, solve, solver

from pctt.mat import from_entries
from pctt.petsc import own_errors

GRID = (12, 9)
KERNEL = Kernel(GRID, 1.0, 20.0)
A = KERNEL.dense


@pytest.mark.parallel(1, 2, 3)
@pytest.mark.parametrize("way", ["grid", "coordinates", "natural", "dense", "train"])
def test_matrices_given_by_entries_are_preconditioned(way):
    if way == "train":
        mat = from_entries(KERNEL, GRID, 1e-10)
    elif way == "dense":
        mat = dense_mat(A, grid=GRID)
    else:
        mat = shell(KERNEL, A)
        points = np.stack(np.unravel_index(np.arange(*mat.getOwnershipRange()), GRID), axis=1)
        if way != "natural":
            mat.setAttr(way, GRID if way == "grid" else points)
    ksp = solver(mat, rank=100)
    iterations, residual = solve(ksp)
    assert residual < 1e-7
    assert iterations <= 6
    assert context(ksp).rank > 1
    assert "entries evaluated" in report(ksp)


@pytest.mark.parallel(1, 2)
def test_the_grid_of_a_dmda():
    da = PETSc.DMDA().create(GRID[::-1], dof=1, stencil_width=1, comm=PETSc.COMM_WORLD)
    sparse = da.createMat()
    natural = da.createNaturalVec()
    own = da.createGlobalVec()
    natural.array[:] = np.arange(*natural.getOwnershipRange())
    da.naturalToGlobal(natural, own)
    of_row = gathered(own).astype(int)  # natural number of each row
    sparse.setAttr("entries", lambda i, j: KERNEL(of_row[i], of_row[j]))
    ksp = ready(sparse, rank=100)
    compressed = context(ksp).made.compressed
    assert compressed.layout.order == "grid"
    assert compressed.error < 1e-2
    x, y = sparse.createVecs()
    x.set(1.0)
    ksp.pc.apply(x, y)
    np.testing.assert_allclose(gathered(y), np.linalg.solve(A, np.ones(108))[of_row], atol=0.05)


def raises_on_the_last(i: np.ndarray, j: np.ndarray) -> np.ndarray:
    if MPI.COMM_WORLD.rank == MPI.COMM_WORLD.size - 1:
        raise KeyError("the user's own")
    return KERNEL(i, j)


WRONG = {
    "raises": (raises_on_the_last, "KeyError: \"the user's own\".*test_entries_of_mats"),
    "a wrong shape": (lambda i, j: KERNEL(i, j)[:-1], "array of shape"),
    "NaN": (lambda i, j: np.where(i == 50, np.nan, KERNEL(i, j)), "nan at row 50, column"),
    "complex": (lambda i, j: 1j * KERNEL(i, j), "array of type complex128"),
    "text": (lambda i, j: "no", "array of shape"),
}


@pytest.mark.parallel(1, 2, 3)
@pytest.mark.parametrize("what", WRONG)
def test_wrong_entries_are_an_error_on_all_ranks(what):
    entries, words = WRONG[what]
    with pytest.raises(ValueError, match=words):
        from_entries(entries, GRID)
    with pytest.raises(ValueError, match=words), own_errors():
        ready(shell(entries, A, grid=GRID))
    assert MPI.COMM_WORLD.allreduce(1) == MPI.COMM_WORLD.size  # all are here


@pytest.mark.parallel(1, 2)
@pytest.mark.parametrize("grid", [(12, 8), (12, 9.0), (108, 0), (), 108, "ab"])
def test_a_grid_that_does_not_fit_is_refused(grid):
    words = "whole numbers whose product is the number of block rows, 108"
    with pytest.raises(ValueError, match=words), own_errors():
        ready(shell(KERNEL, A, grid=grid))
    if MPI.COMM_WORLD.size > 1:
        with pytest.raises(ValueError, match="differs between ranks"), own_errors():
            ready(shell(KERNEL, A, grid=(12, 9) if MPI.COMM_WORLD.rank else (9, 12)))


@pytest.mark.parametrize("order", ["grid", "morton", "rcm"])
def test_an_order_needs_what_it_goes_by(order):
    words = f"-pc_tt_order {order}: the Mat has no .*allowed without"
    with pytest.raises(ValueError, match=words), own_errors():
        ready(shell(KERNEL, A), order=order)


def test_an_indefinite_matrix_is_not_given_to_cg():
    """Its train is refused, in words, and the diagonal takes over."""
    mat = shell(lambda i, j: KERNEL(i, j) - 8.0 * (abs(i - j) == 1), A, grid=GRID)
    with pytest.warns(UserWarning, match=r"not positive, .*: block Jacobi takes over"):
        ksp = ready(mat, rank=100)
    assert context(ksp).rank == 1
    np.testing.assert_allclose(operator(ksp), np.diag(1 / np.diag(A)))


@pytest.mark.parallel(1, 2)
def test_the_inverse_multiplies_numbers_of_any_size():
    """Its products are in single precision, which ends at 1e38."""
    mat = shell(KERNEL, A, grid=GRID)
    ksp = solver(mat, rank=100, precision="single")
    assert solve(ksp)[1] < 1e-6
    x, y = mat.createVecs()
    v = np.random.default_rng(0).standard_normal(108)
    for size in (1.0, 1e-60, 1e60, 0.0):
        x.array[:] = size * v[slice(*x.getOwnershipRange())]
        ksp.pc.apply(x, y)
        np.testing.assert_allclose(gathered(y) / (size or 1.0), np.linalg.solve(A, v) * (size > 0), atol=0.05)


@pytest.mark.parametrize(("reuse", "reused"), [("none", 0), ("cores", 1)])
def test_new_values_make_a_new_train(reuse, reused):
    scale = 1.0
    mat = shell(lambda i, j: scale * KERNEL(i, j), A, grid=GRID)
    ksp = ready(mat, rank=100, reuse=reuse)
    scale = 4.0
    mat.stateIncrease()
    ksp.setOperators(mat)
    ksp.setUp()
    assert context(ksp).account.reused == reused
    assert context(ksp).made.compressed.shift == pytest.approx(8.0)


def test_the_example_of_the_documentation_runs(capfd):
    text = (Path(__file__).resolve().parents[2] / "docs" / "trains.md").read_text()
    (program,) = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    exec(program, {})
    said = capfd.readouterr().out
    assert "times less than dense" in said
    assert "transform of a grid of 256 x 256" in said
