"""Contact systems solved through the bodies."""

from __future__ import annotations

import numpy as np
import pytest
from mpi4py import MPI
from petsc4py import PETSc
from systems import contact_matrix, contacts, dense, poisson

from pctt.blocks import BlockRows
from pctt.body_matrix import BodyMatrix
from pctt.petsc import own_errors


def solve(mat: PETSc.Mat, ksp_type: str, rtol: float, **options: object) -> tuple[float, np.ndarray, np.ndarray]:
    """True residual, solution, right-hand side."""
    for name, value in options.items():
        PETSc.Options()[name] = str(value)
    ksp = PETSc.KSP().create(mat.comm)
    ksp.setOperators(mat)
    ksp.setType(ksp_type)
    ksp.setTolerances(rtol=rtol)
    ksp.pc.setType("python")
    ksp.pc.setPythonType("pctt.pc.BodySchur")
    ksp.setFromOptions()
    ksp.setTolerances(rtol=rtol)
    x, b = mat.createVecs()
    b.array[:] = np.random.default_rng(1).standard_normal(b.getLocalSize())
    ksp.solve(b, x)
    residual = b - mat * x
    return residual.norm() / b.norm(), x.array.copy(), b.array.copy()


@pytest.mark.parametrize("rtol", [1e-3, 1e-6, 1e-10])
def test_reaches_the_tolerance_in_one_application(rtol):
    mat = contact_matrix(*contacts(80, 30))
    residual, x, b = solve(mat, "preonly", rtol)
    assert residual <= rtol
    if rtol < 1e-9:
        assert np.allclose(x, np.linalg.solve(dense(mat), b))


@pytest.mark.parametrize(("pc", "shift"), [("pbjacobi", 0.03), ("ilu", 0.03), ("cholesky", 0.0)])
def test_every_inner_preconditioner(pc, shift):
    mat = contact_matrix(*contacts(60, 20, seed=3))
    residual, _, _ = solve(mat, "preonly", 1e-8, body_pc_type=pc, pc_body_shift=shift)
    assert residual <= 1e-8


def test_preconditions_fgmres():
    mat = contact_matrix(*contacts(60, 20, seed=4))
    residual, _, _ = solve(mat, "fgmres", 1e-9, pc_body_rtol=1e-2)
    assert residual <= 1e-8


def test_refinement_mends_what_rounding_spoils_where_barriers_are_tiny():
    G, barrier = contacts(60, 60, seed=6)
    barrier *= 10 ** np.random.default_rng(0).uniform(-11, 0, len(barrier))[:, None, None]
    mat = contact_matrix(G, barrier)
    options = {"body_pc_type": "cholesky", "pc_body_shift": 0.0, "ksp_norm_type": "unpreconditioned"}
    spoilt, _, _ = solve(mat, "preonly", 1e-10, **options)
    refined, _, _ = solve(mat, "richardson", 1e-10, **options)
    assert spoilt > 1e-9
    assert refined <= 1e-10


def test_a_breakdown_of_the_inner_method_is_that_of_the_solve():
    """``preonly`` itself would call the solve converged."""
    for size in (-1.0, np.nan):
        mat = contact_matrix(*contacts(30, 20))
        mat.setAttr("barrier", np.tile(size * np.eye(3), (30, 1, 1)))
        ksp = PETSc.KSP().create(mat.comm)
        ksp.setOperators(mat)
        ksp.setType("preonly")
        ksp.pc.setType("python")
        ksp.pc.setPythonType("pctt.pc.BodySchur")
        x, b = mat.createVecs()
        b.set(1.0)
        ksp.solve(b, x)
        assert ksp.getConvergedReason() < 0


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("barrier", None, "barrier of the Mat is missing"),
        ("barrier", np.zeros((30, 3, 3)), "has a singular block"),
        ("barrier", np.ones((29, 3, 3)), r"has the shape \(29, 3, 3\); allowed are \(30, 3, 3\)"),
        ("contact_map", contacts(29, 20)[0], "has 29 rows, S has 90"),
        ("contact_map", 3, "has None rows"),
    ],
)
def test_parts_that_do_not_fit_the_matrix_are_refused(name, value, words):
    mat = contact_matrix(*contacts(30, 20))
    mat.setAttr(name, value)
    with pytest.raises(ValueError, match=words), own_errors():
        solve(mat, "fgmres", 1e-3)


def test_follows_new_barriers():
    G, barrier = contacts(50, 20, seed=5)
    mat = contact_matrix(G, barrier)
    before, _, _ = solve(mat, "preonly", 1e-8)
    rows = np.arange(G.rows, dtype=PETSc.IntType)[:, None]
    mat.setValuesBlockedRCV(rows, rows, 6.0 * barrier.reshape(-1, 9), PETSc.InsertMode.ADD_VALUES)
    mat.assemble()
    mat.setAttr("barrier", 7.0 * barrier)
    after, _, _ = solve(mat, "preonly", 1e-8)
    assert max(before, after) <= 1e-8


def test_a_matrix_that_does_not_say_what_it_is_made_of_is_refused():
    with pytest.raises((ValueError, PETSc.Error)):
        solve(poisson(4), "preonly", 1e-3)


def test_a_matrix_that_has_forgotten_it_is_refused():
    """``MatCopy`` from another pattern takes the attributes away."""
    mat = contact_matrix(*contacts(30, 20))
    ksp = PETSc.KSP().create(mat.comm)
    ksp.setOperators(mat)
    ksp.pc.setType("python")
    ksp.pc.setPythonType("pctt.pc.BodySchur")
    ksp.setUp()
    mat.setAttr("contact_map", None)
    mat.scale(2.0)
    with pytest.raises(ValueError, match="no attribute contact_map"), own_errors():
        ksp.pc.setUp()


@pytest.mark.parallel(2)
def test_a_part_that_one_rank_lacks_is_missed_on_all():
    comm = MPI.COMM_WORLD
    mat = PETSc.Mat().createAIJ(((6, None), (6, None)), nnz=1, comm=comm)
    first = mat.getOwnershipRange()[0]
    for row in range(first, first + 6):
        mat[row, row] = 2.0
    mat.assemble()
    blocks = np.hstack([np.eye(3), np.zeros((3, 3))])[None].repeat(2, axis=0)
    mat.setAttr("barrier", np.tile(np.eye(3), (2, 1, 1)))
    mat.setAttr("contact_map", BlockRows(np.arange(3), np.arange(2), blocks, 2) if comm.rank == 0 else None)
    with pytest.raises(ValueError, match="no attribute contact_map"), own_errors():
        solve(mat, "fgmres", 1e-3)


def test_bodies_are_numbered_in_64_bits():
    """G of a file has 32 bits; 70,000 squared has more."""
    bodies = 70_000
    last = np.array([0, bodies - 1, bodies - 2, bodies - 1], np.int32)
    G = BlockRows(np.array([0, 2, 4], np.int32), last, np.ones((4, 3, 6)), bodies)
    K = BodyMatrix(MPI.COMM_SELF, G)
    K.update(np.tile(np.eye(3), (2, 1, 1)))
    first, final = (np.arange(6 * body, 6 * body + 6, dtype=PETSc.IntType) for body in (0, bodies - 1))
    for rows, columns in ((first, final), (final, first)):
        assert np.array_equal(K.mat.getValues(rows, columns), np.full((6, 6), 3.0))
    K.destroy()
