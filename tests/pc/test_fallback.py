"""A train that was asked for and cannot be used: what takes over, and who hears of it."""

from __future__ import annotations

import subprocess
import sys
import warnings

import numpy as np
import pytest
from mpi4py import MPI
from petsc4py import PETSc
from train_solver import context, poisson, report, solve, solver

from pctt.pc.mat import is_symmetric
from pctt.pc.sparse_train import SparseTrain

PC_FAILED = PETSc.KSP.ConvergedReason.DIVERGED_PCSETUP_FAILED


@pytest.fixture
def refused(monkeypatch):
    monkeypatch.setattr(SparseTrain, "make", lambda self, A, P: self._refuse("the inverse is not positive"))


@pytest.mark.parallel(1, 2)
def test_block_jacobi_takes_over_with_one_warning(refused):
    ksp = solver(poisson(8), rank=5)
    with warnings.catch_warnings(record=True) as heard:
        warnings.simplefilter("always")
        for _ in range(3):
            assert solve(ksp)[1] < 1e-6
            ksp.getOperators()[0].scale(2.0)
    words = [str(one.message) for one in heard if "tensor" in str(one.message).lower()]
    assert len(words) == (MPI.COMM_WORLD.rank == 0)
    assert all("the inverse is not positive: block Jacobi takes over" in line for line in words)
    assert all(line.endswith("for sparse matrices try pctt.pc.BlockICC") for line in words)
    assert "fell back: the inverse is not positive" in report(ksp)


@pytest.mark.parallel(1, 2)
def test_without_a_fallback_the_ksp_ends_with_the_reason_of_petsc(refused, monkeypatch):
    mat = poisson(8)
    ksp = solver(mat, rank=5, fallback="none")
    x, b = mat.createVecs()
    b.set(1.0)
    with warnings.catch_warnings(record=True) as heard:
        warnings.simplefilter("always")
        ksp.solve(b, x)
    if MPI.COMM_WORLD.rank == 0:
        assert "there is no preconditioner" in str(heard[0].message)
    assert ksp.getConvergedReason() == PC_FAILED
    monkeypatch.undo()  # the next matrix has a train
    ksp.setOperators(poisson(8))
    assert solve(ksp)[1] < 1e-6
    assert context(ksp).rank == 5


def test_without_a_fallback_an_error_ends_the_program_that_wants_one(refused):
    PETSc.Options()["ksp_error_if_not_converged"] = "true"
    mat = poisson(8)
    ksp = solver(mat, rank=5, fallback="none")
    x, b = mat.createVecs()
    b.set(1.0)
    with pytest.warns(UserWarning, match="no preconditioner"), pytest.raises(PETSc.Error):
        ksp.solve(b, x)


@pytest.mark.parallel(2)
def test_a_warning_that_is_an_error_is_one_on_all_ranks(refused):
    """Else the others would wait for the rank that raises it."""
    ksp = solver(poisson(8), rank=5)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with pytest.raises((UserWarning, PETSc.Error)):
            ksp.setUp()


def test_a_warning_shows_the_line_of_the_user():
    source = "from petsc4py import PETSc\nfrom pctt.petsc import warn\nwarn(PETSc.COMM_SELF.tompi4py(), 'a word')\n"
    done = subprocess.run([sys.executable, "-c", source], capture_output=True, text=True, timeout=60, check=True)
    assert "<string>:3: UserWarning: a word" in done.stderr


@pytest.mark.parallel(1, 2)
def test_a_matrix_that_is_said_not_to_be_symmetric_is_tried():
    """SLEPc says so of matrices whose symmetry it does not know."""
    mat = poisson(8)
    mat.setOption(PETSc.Mat.Option.SYMMETRIC, False)
    assert mat.isSymmetricKnown() == (True, False)
    assert is_symmetric(mat)


@pytest.mark.parametrize("value", [np.inf, np.nan])
@pytest.mark.parametrize("row", [(0, 0), (0, 1)])
def test_a_matrix_that_is_no_number(value, row):
    """The KSP says so, and nothing is raised or waits."""
    mat = poisson(8)
    mat[row] = value
    mat[row[::-1]] = value
    mat.assemble()
    ksp = solver(mat, rank=4)
    x, b = mat.createVecs()
    b.set(1.0)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        ksp.solve(b, x)
    assert ksp.getConvergedReason() < 0
