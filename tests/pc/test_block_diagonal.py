"""Preconditioners follow new values of a matrix, also where PETSc itself keeps old inverses of diagonal blocks."""

from __future__ import annotations

import numpy as np
import pytest
from mpi4py import MPI
from petsc4py import PETSc
from systems import contacts, dense, spd
from train_solver import columns

from pctt.blocks import block_csr_matrix, block_diagonal, inverse_diagonal_blocks, set_diagonal_blocks, symmetric_shell
from pctt.body_matrix import BodyMatrix
from pctt.ccp.newton.krylov import Krylov

COUNT, BLOCK = 5, 3


def full(kind: str, A: np.ndarray) -> PETSc.Mat:
    """A dense matrix as a Mat of this type and block size 3."""
    count = len(A) // BLOCK
    blocks = A.reshape(count, BLOCK, count, BLOCK).transpose(0, 2, 1, 3).reshape(-1, BLOCK, BLOCK)
    indptr, indices = np.arange(count + 1) * count, np.tile(np.arange(count), count)
    mat = block_csr_matrix(MPI.COMM_WORLD, len(A), len(A), indptr, indices, blocks)
    return mat if kind == "baij" else mat.convert(kind, PETSc.Mat())


def overwrite(mat: PETSc.Mat, A: np.ndarray) -> None:
    everywhere = np.arange(len(A), dtype=PETSc.IntType)
    mat.setValues(everywhere, everywhere, A)
    mat.assemble()


def preconditioner(krylov: Krylov, mat: PETSc.Mat) -> np.ndarray:
    """The preconditioner that a solve with this matrix has made, as a dense matrix."""
    x, b = mat.createVecs()
    b.set(1.0)
    krylov.solve(mat, b, x, 1e-3)
    return columns(mat, krylov.ksp.pc.apply)


TT = {"pc_type": "python", "pc_python_type": "pctt.pc.TensorTrain"}
WAYS = {
    "pbjacobi": {"pc_type": "pbjacobi"},
    "sor": {"pc_type": "sor"},
    "ilu": {"pc_type": "ilu"},
    "pbjacobi within": {"pc_type": "bjacobi", "sub_pc_type": "pbjacobi"},
    "sor within": {"pc_type": "asm", "sub_pc_type": "sor"},
    "cholesky": {"pc_type": "cholesky"},
    "train of rank 1": {**TT, "pc_tt_rank": "1"},
    "train": {**TT, "pc_tt_rank": "50", "pc_tt_reuse": "none"},
}


@pytest.mark.parametrize("kind", ["baij", "aij"])
@pytest.mark.parametrize("way", WAYS)
def test_new_values_make_the_preconditioner_that_a_new_matrix_gets(way, kind):
    krylov = Krylov(MPI.COMM_SELF, "old_", WAYS[way])
    mat = full(kind, spd(BLOCK * COUNT, 0))
    preconditioner(krylov, mat)
    for seed in (1, 2):
        A = spd(BLOCK * COUNT, seed)
        overwrite(mat, A)
        new = Krylov(MPI.COMM_SELF, "new_", WAYS[way])
        expected = preconditioner(new, full(kind, A))
        assert np.allclose(preconditioner(krylov, mat), expected, rtol=1e-6, atol=1e-8 * np.abs(expected).max())
        new.destroy()
    krylov.destroy()


@pytest.mark.parametrize("kind", ["baij", "aij"])
def test_the_blocks_are_the_present_ones(kind):
    mat = full(kind, spd(BLOCK * COUNT, 0))
    shell = symmetric_shell(MPI.COMM_SELF, BLOCK * COUNT, BLOCK, lambda x, out: None)
    for seed in (1, 2):
        A = spd(BLOCK * COUNT, seed)
        overwrite(mat, A)
        blocks = np.array([A[i : i + BLOCK, i : i + BLOCK] for i in range(0, len(A), BLOCK)])
        set_diagonal_blocks(shell, blocks)
        assert np.allclose(inverse_diagonal_blocks(mat), np.linalg.inv(blocks))
        for P in (mat, shell):
            copy = block_diagonal(P)
            assert np.allclose(copy.invertBlockDiagonal(), np.linalg.inv(blocks))
            copy.destroy()


def test_a_singular_block_is_said_to_be_one():
    mat = full("baij", np.ones((BLOCK * COUNT, BLOCK * COUNT)))
    with pytest.raises(np.linalg.LinAlgError):
        inverse_diagonal_blocks(mat)


def test_our_matrices_say_what_their_blocks_are():
    G, barrier = contacts(40, 12)
    K = BodyMatrix(MPI.COMM_WORLD, G)
    for scale in (1.0, 3.0):
        K.update(scale * np.linalg.inv(barrier))
        A = dense(K.mat)
        blocks = np.array([A[i : i + 6, i : i + 6] for i in range(0, len(A), 6)])
        assert np.allclose(inverse_diagonal_blocks(K.mat), np.linalg.inv(blocks))
    K.destroy()
