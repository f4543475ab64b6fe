"""pctt.mat: matrices given by their entries, as operators and as what preconditioners are made from."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from mpi4py import MPI
from petsc4py import PETSc
from train_solver import dense_of, left, solver
from train_solver import shell as shell_of

from pctt.mat import from_entries
from pctt.petsc import own_errors

GRID = (12, 9)


def kernel(i: np.ndarray, j: np.ndarray) -> np.ndarray:
    apart = np.subtract(np.unravel_index(i, GRID), np.unravel_index(j, GRID))
    return (i == j) + 0.1 * np.exp(-(apart**2).sum(axis=0) / 20.0)


def dense(entries=kernel) -> np.ndarray:
    return dense_of(entries, 108)


def shell(entries=kernel, **attributes: object) -> PETSc.Mat:
    """With the products of the kernel, whatever the entries are."""
    return shell_of(entries, dense(), **attributes)


def solve(mat: PETSc.Mat, **options: object) -> tuple[PETSc.KSP, float]:
    """By CG to 1e-8; the true residual."""
    ksp = solver(mat, **options)
    ksp.setNormType(PETSc.KSP.NormType.UNPRECONDITIONED)
    x, b = mat.createVecs()
    first, last = b.getOwnershipRange()
    b.array[:] = np.random.default_rng(0).standard_normal(mat.getSize()[0])[first:last]
    with own_errors():
        ksp.solve(b, x)
    return ksp, left(ksp, x, b)


@pytest.mark.parallel(1, 2, 3)
@pytest.mark.parametrize("way", ["grid", "coordinates", "natural", "dense", "train"])
def test_matrices_given_by_entries_are_preconditioned(way):
    points = np.stack(np.unravel_index(np.arange(108), GRID), axis=1)
    if way == "train":
        mat = from_entries(kernel, GRID, 1e-10)
    elif way == "dense":
        mat = PETSc.Mat().createDense(((PETSc.DECIDE, 108), (PETSc.DECIDE, 108)), comm=PETSc.COMM_WORLD)
        mat.setUp()
        first, last = mat.getOwnershipRange()
        mat.setValues(np.arange(first, last, dtype=np.int32), np.arange(108, dtype=np.int32), dense()[first:last])
        mat.assemble()
        mat.setAttr("grid", GRID)
    else:
        mat = shell()
        own = slice(*mat.getOwnershipRange())
        if way != "natural":
            mat.setAttr(way, GRID if way == "grid" else points[own])
    ksp, residual = solve(mat, rank=100)
    assert residual < 1e-7
    assert ksp.getIterationNumber() <= 6
    assert ksp.pc.getPythonContext().rank > 1
    assert "entries evaluated" in " ".join(ksp.pc.getPythonContext().report())


@pytest.mark.parallel(1, 2)
def test_the_grid_of_a_dmda():
    da = PETSc.DMDA().create(GRID[::-1], dof=1, stencil_width=1, comm=PETSc.COMM_WORLD)
    sparse = da.createMat()
    natural = da.createNaturalVec()
    own = da.createGlobalVec()
    natural.array[:] = np.arange(*natural.getOwnershipRange())
    da.naturalToGlobal(natural, own)
    of_row = np.concatenate(MPI.COMM_WORLD.allgather(own.array.astype(int)))  # natural number of each row
    sparse.setAttr("entries", lambda i, j: kernel(of_row[i], of_row[j]))
    ksp = solver(sparse, rank=100)
    ksp.setUp()
    compressed = ksp.pc.getPythonContext().made.compressed
    assert compressed.layout.order == "grid"
    assert compressed.error < 1e-2
    x, y = sparse.createVecs()
    x.set(1.0)
    ksp.pc.apply(x, y)
    expected = np.linalg.solve(dense(), np.ones(108))[of_row[slice(*y.getOwnershipRange())]]
    np.testing.assert_allclose(y.array, expected, atol=0.05)


def raises_on_the_last(i: np.ndarray, j: np.ndarray) -> np.ndarray:
    if MPI.COMM_WORLD.rank == MPI.COMM_WORLD.size - 1:
        raise KeyError("the user's own")
    return kernel(i, j)


WRONG = {
    "raises": (raises_on_the_last, "KeyError: \"the user's own\".*test_entries_of_mats"),
    "a wrong shape": (lambda i, j: kernel(i, j)[:-1], "array of shape"),
    "NaN": (lambda i, j: np.where(i == 50, np.nan, kernel(i, j)), "nan at row 50, column"),
    "complex": (lambda i, j: 1j * kernel(i, j), "array of type complex128"),
    "text": (lambda i, j: "no", "array of shape"),
}


@pytest.mark.parallel(1, 2, 3)
@pytest.mark.parametrize("what", WRONG)
def test_wrong_entries_are_an_error_on_all_ranks(what):
    entries, words = WRONG[what]
    with pytest.raises(ValueError, match=words):
        from_entries(entries, GRID)
    with pytest.raises(ValueError, match=words):
        solve(shell(entries, grid=GRID))
    assert MPI.COMM_WORLD.allreduce(1) == MPI.COMM_WORLD.size  # all are here


@pytest.mark.parallel(1, 2)
@pytest.mark.parametrize("grid", [(12, 8), (12, 9.0), (108, 0), (), 108, "ab"])
def test_a_grid_that_does_not_fit_is_refused(grid):
    with pytest.raises(ValueError, match="whole numbers whose product is the number of block rows, 108"):
        solve(shell(grid=grid))
    if MPI.COMM_WORLD.size > 1:
        with pytest.raises(ValueError, match="differs between ranks"):
            solve(shell(grid=(12, 9) if MPI.COMM_WORLD.rank else (9, 12)))


@pytest.mark.parametrize("order", ["grid", "morton", "rcm"])
def test_an_order_needs_what_it_goes_by(order):
    with pytest.raises(ValueError, match=f"-pc_tt_order {order}: the Mat has no .*allowed without"):
        solve(shell(), order=order)


def test_an_indefinite_matrix_is_not_given_to_cg():
    """Its train is refused, in words, and the diagonal takes over."""
    mat = shell(lambda i, j: kernel(i, j) - 8.0 * (abs(i - j) == 1), grid=GRID)
    ksp = solver(mat, rank=100)
    with pytest.warns(UserWarning, match=r"not positive, .*: block Jacobi takes over"):
        ksp.setUp()
    assert ksp.pc.getPythonContext().rank == 1
    x, y = mat.createVecs()
    x.set(1.0)
    ksp.pc.apply(x, y)
    np.testing.assert_allclose(y.array, 1 / np.diag(dense()))


@pytest.mark.parallel(1, 2)
def test_the_inverse_multiplies_numbers_of_any_size():
    """Its products are in single precision, which ends at 1e38."""
    mat = shell(grid=GRID)
    ksp, _ = solve(mat, rank=100, precision="single")
    x, y = mat.createVecs()
    first, last = x.getOwnershipRange()
    v = np.random.default_rng(0).standard_normal(108)
    expected = np.linalg.solve(dense(), v)[first:last]
    for size in (1.0, 1e-60, 1e60):
        x.array[:] = size * v[first:last]
        ksp.pc.apply(x, y)
        np.testing.assert_allclose(y.array / size, expected, atol=0.05)
    x.set(0.0)
    ksp.pc.apply(x, y)
    assert not y.array.any()


def test_new_values_make_a_new_train():
    scale = 1.0
    mat = shell(lambda i, j: scale * kernel(i, j), grid=GRID)
    ksp, _ = solve(mat, rank=100)
    scale = 4.0
    mat.stateIncrease()
    ksp.setOperators(mat)
    ksp.setUp()
    assert ksp.pc.getPythonContext().account.reused == 1
    assert ksp.pc.getPythonContext().made.compressed.shift == pytest.approx(4.4)


def test_the_example_of_the_documentation_runs():
    text = (Path(__file__).resolve().parents[2] / "docs" / "trains.md").read_text()
    (program,) = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr
    assert "times less than dense" in done.stdout
    assert "cosine transform of a grid of 256 x 256" in done.stdout
