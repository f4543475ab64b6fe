"""Mats of kernels by differences, against dense matrices."""

from __future__ import annotations

import numpy as np
import pytest
from petsc4py import PETSc
from train_solver import columns, ready, solve

from pctt.mat import from_differences

GRID = (5, 4, 3)


def even(s: np.ndarray) -> np.ndarray:
    return np.exp(-np.sqrt((s**2).sum(axis=0)))


def oblique(s: np.ndarray) -> np.ndarray:
    return np.exp(-np.sqrt(((s[0] - 0.5 * s[1]) ** 2 + s[1] ** 2 + s[2] ** 2) / 4))


def upwind(s: np.ndarray) -> np.ndarray:
    """Not symmetric."""
    return even(s) * (1.0 + 0.5 * np.sign(s[0] - s[2]))


def stokeslet(s: np.ndarray) -> np.ndarray:
    r = np.sqrt((s**2).sum(axis=0))
    v = 0.2 * (np.eye(3) + np.einsum("ip,jp->pij", s, s) / np.maximum(r, 1)[:, None, None] ** 2)
    return np.where(r[:, None, None] > 0, v / np.maximum(r, 1)[:, None, None], np.eye(3))


def mixed(s: np.ndarray) -> np.ndarray:
    """Two unknowns a point, not symmetric."""
    return np.stack([even(s), upwind(s), s[0] * even(s), 2 * even(s)], axis=-1).reshape(-1, 2, 2)


def dense(kernel, block: int) -> np.ndarray:
    x = np.array(np.unravel_index(np.arange(np.prod(GRID)), GRID))
    n = x.shape[1]
    s = (x[:, :, None] - x[:, None, :]).reshape(len(GRID), -1)
    return kernel(s).reshape(n, n, block, block).transpose(0, 2, 1, 3).reshape(n * block, n * block)


@pytest.mark.parallel(1, 2)
@pytest.mark.parametrize(
    ("kernel", "block", "symmetric"),
    [(even, 1, True), (oblique, 1, True), (upwind, 1, False), (stokeslet, 3, True), (mixed, 2, False)],
)
def test_products_and_entries_are_those_of_the_kernel(kernel, block, symmetric):
    mat, A = from_differences(kernel, GRID, block), dense(kernel, block)
    mat.scale(2.0)
    mat.shift(0.5)
    A = 2 * A + 0.5 * np.eye(len(A))
    assert mat.isSymmetricKnown() == (True, symmetric)
    assert mat.getBlockSize() == block
    np.testing.assert_allclose(columns(mat, mat.mult), A, atol=1e-12)
    np.testing.assert_allclose(columns(mat, mat.multTranspose), A.T, atol=1e-12)
    i, j = np.indices(A.shape).reshape(2, -1)
    np.testing.assert_allclose(mat.getPythonContext().entries(i, j).reshape(A.shape), A)
    first, last = mat.getOwnershipRange()
    np.testing.assert_allclose(mat.getDiagonal().array_r, np.diag(A)[first:last])


@pytest.mark.parallel(1, 2)
@pytest.mark.parametrize(("kernel", "block"), [(even, 1), (oblique, 1), (stokeslet, 3)])
def test_the_preconditioner_takes_it(kernel, block):
    mat = from_differences(kernel, (6, 7, 8), block)
    mat.shift(0.1)
    iterations, residual = solve(ready(mat, rtol=1e-9))
    ksp = PETSc.KSP().create(mat.comm)
    ksp.setOperators(mat)
    ksp.setType("cg")
    ksp.setTolerances(rtol=1e-9)
    ksp.pc.setType("none")
    assert iterations <= 1.3 * solve(ksp)[0]
    assert residual < 1e-7


@pytest.mark.parallel(1, 2)
def test_wrong_kernels_are_refused_on_all_ranks():
    for kernel, block, words in (
        (lambda s: s[0] / 0.0 * 0.0, 1, "gives nan at the difference"), (lambda s: s, 1, "an array of shape"),
        (lambda s: 1j * s[0], 1, "an array of type complex128"), (lambda s: s[3], 1, "IndexError"),
        (lambda s: s[0], 2, r"shape \(11,\) for 11 differences; allowed are arrays of shape \(11, 2, 2\)"),
        (lambda s: s[0], 0, "block = 0; allowed are whole numbers >= 1"),
    ):  # fmt: skip
        with pytest.raises(ValueError, match=words), np.errstate(all="ignore"):
            from_differences(kernel, (6,), block)
    with pytest.raises(ValueError, match=r"a grid of shape \(0, 2\)"):
        from_differences(even, (0, 2))
