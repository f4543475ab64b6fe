"""Conjugate gradients of bodies in compiled loops."""

from __future__ import annotations

import numpy as np
import pytest
from mpi4py import MPI
from problems import SELF

from pctt.blocks import set_diagonal_blocks, symmetric_shell
from pctt.ccp.newton.conjugate_gradients import ConjugateGradients
from pctt.ccp.newton.defaults import DEFAULTS
from pctt.ccp.newton.krylov import Krylov


def shell(comm: MPI.Comm, A: np.ndarray):
    """The shell of a dense matrix of 6 x 6 blocks, distributed by rows, and the part of the rows that is here."""
    bodies = len(A) // 6
    here = slice(6 * (comm.rank * bodies // comm.size), 6 * ((comm.rank + 1) * bodies // comm.size))

    def product(x, out):
        out.ravel()[:] = A[here] @ np.concatenate(comm.allgather(x.ravel()))

    mat = symmetric_shell(comm, here.stop - here.start, 6, product)
    rows = range(here.start, here.stop, 6)
    set_diagonal_blocks(mat, np.array([A[i : i + 6, i : i + 6] for i in rows]))
    return mat, here


def stiff(bodies: int = 30) -> np.ndarray:
    """A symmetric positive definite matrix, of blocks whose sizes differ by orders of magnitude."""
    rng = np.random.default_rng(0)
    B = rng.normal(size=(6 * bodies, 6 * bodies)) * np.repeat(10.0 ** rng.uniform(-2, 2, bodies), 6)[:, None]
    return B @ B.T + np.eye(6 * bodies)


@pytest.mark.parallel(1, 2)
def test_they_take_the_iterations_of_petsc():
    comm, A = MPI.COMM_WORLD, stiff()
    mat, here = shell(comm, A)
    x, b = mat.createVecs()
    b.array[:] = np.random.default_rng(1).normal(size=len(A))[here]
    own, petsc = ConjugateGradients(comm), Krylov(comm, "cg_", DEFAULTS["body"])
    for rtol in (1e-1, 1e-2, 1e-3):
        found, other = own.solve(mat, b, x, rtol, 1000), petsc.solve(mat, b, x, rtol)
        assert found.converged
        assert found.true_residual <= 1.01 * rtol
        assert abs(found.iterations - other.iterations) <= 2, rtol
    found = own.solve(mat, b, x, 1e-2, 3)
    assert (found.converged, found.iterations) == (False, 3)
    petsc.destroy()


def test_the_residual_is_that_of_the_solution():
    A = stiff(5)
    mat, _ = shell(SELF, A)
    x, b = mat.createVecs()
    b.array[:] = 1.0
    found = ConjugateGradients(SELF).solve(mat, b, x, 1e-8, 1000)
    left = np.linalg.norm(b.array - A @ x.array) / b.norm()
    assert found.converged
    assert left <= 2e-8
    assert found.true_residual == pytest.approx(left, rel=1e-3)


def test_a_new_matrix_and_one_that_is_not_definite():
    own = ConjugateGradients(SELF)
    indefinite = np.kron([[1.0, 2.0], [2.0, 1.0]], np.eye(6))
    for A, definite in ((np.diag(np.arange(1.0, 61.0)), True), (indefinite, False)):
        mat, _ = shell(SELF, A)
        x, b = mat.createVecs()
        b.array[:] = np.where(np.arange(len(A)) < 6, 1.0, 1.0 * definite)
        own.renew()
        found = own.solve(mat, b, x, 1e-10, 100)
        assert found.converged == definite
        if definite:  # block Jacobi is exact
            assert found.iterations <= 3
            np.testing.assert_allclose(x.array, 1.0 / np.arange(1.0, 61.0), rtol=1e-9)


def test_no_right_hand_side():
    mat, _ = shell(SELF, stiff(2))
    x, b = mat.createVecs()
    found = ConjugateGradients(SELF).solve(mat, b, x, 1e-2, 100)
    assert (found.converged, found.iterations, x.norm()) == (True, 0, 0.0)
