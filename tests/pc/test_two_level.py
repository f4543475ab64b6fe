"""Block Jacobi with a coarse space on boxes of block rows."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse as sp
from mpi4py import MPI
from petsc4py import PETSc
from systems import contact_matrix, dense, poisson

from pctt.blocks import BlockRows
from pctt.body_matrix import BodyMatrix
from pctt.ccp.newton.compare import NAMED
from pctt.ccp.newton.krylov import Krylov
from pctt.options import OptionError
from pctt.pc.two_level import bisect


def solver(mat: PETSc.Mat, **options: object) -> PETSc.KSP:
    """CG with TwoLevel; options without their prefix."""
    for name, value in options.items():
        PETSc.Options()["pc_two_" + name] = str(value)
    ksp = PETSc.KSP().create(mat.comm)
    ksp.setOperators(mat)
    ksp.setType("cg")
    ksp.setNormType(PETSc.KSP.NormType.UNPRECONDITIONED)
    ksp.setTolerances(rtol=1e-6, max_it=2000)
    ksp.pc.setType("python")
    ksp.pc.setPythonType("pctt.pc.TwoLevel")
    ksp.setFromOptions()
    ksp.setUp()
    return ksp


def iterations(ksp: PETSc.KSP) -> int:
    """Of a solve that reaches a true residual of 1e-6."""
    mat = ksp.getOperators()[0]
    x, b = mat.createVecs()
    first = mat.getOwnershipRange()[0]
    b.array[:] = np.sin(1.0 + 0.37 * (first + np.arange(b.getLocalSize())))
    ksp.solve(b, x)
    assert (b - mat * x).norm() <= 1.1e-6 * b.norm()
    return ksp.getIterationNumber()


def block_jacobi(mat: PETSc.Mat) -> PETSc.KSP:
    ksp = PETSc.KSP().create(mat.comm)
    ksp.setOperators(mat)
    ksp.setType("cg")
    ksp.setNormType(PETSc.KSP.NormType.UNPRECONDITIONED)
    ksp.setTolerances(rtol=1e-6, max_it=2000)
    ksp.pc.setType("pbjacobi")
    return ksp


def matrix_of(ksp: PETSc.KSP) -> np.ndarray:
    """The preconditioner as a dense array."""
    x, y = ksp.getOperators()[0].createVecs()
    columns = []
    for unit in np.eye(x.getLocalSize()):
        x.array[:] = unit
        ksp.pc.apply(x, y)
        columns.append(y.array.copy())
    return np.stack(columns, axis=1)


def chain(count: int, comm: MPI.Comm = MPI.COMM_SELF, stiffness: float = 100.0) -> tuple[BodyMatrix, np.ndarray]:
    """K of unequal bodies in a square lattice's rows, each glued to its neighbours, and the points of contact."""
    line = np.arange(count * 4)
    place = np.stack([line % count, line // count, np.zeros_like(line)], axis=1).astype(float)
    right = np.stack([line, line + 1], axis=1)[line % count < count - 1]
    above = np.stack([line, line + count], axis=1)[line // count < 3]
    pairs = np.concatenate([right, above])
    point = place[pairs].mean(axis=1)
    mass = 1.0 + 0.5 * np.sin(line)
    blocks = np.zeros((len(pairs), 2, 3, 6))
    for side, sign in enumerate((-1.0, 1.0)):
        body = pairs[:, side]
        arm = point - place[body]
        blocks[:, side, :, :3] = sign * np.eye(3) / np.sqrt(mass[body])[:, None, None]
        turn = np.cross(np.eye(3)[None], arm[:, None]).transpose(0, 2, 1)  # w -> w x arm
        blocks[:, side, :, 3:] = sign * turn / np.sqrt(0.1 * mass[body])[:, None, None]
    first, last = (len(pairs) * r // comm.size for r in (comm.rank, comm.rank + 1))
    bodies = 4 * count * (comm.rank + 1) // comm.size - 4 * count * comm.rank // comm.size
    G = BlockRows(
        2 * np.arange(last - first + 1), pairs[first:last].ravel(), blocks[first:last].reshape(-1, 3, 6), bodies
    )
    K = BodyMatrix(comm, G)
    K.update(stiffness * np.tile(np.eye(3), (last - first, 1, 1)))
    K.mat.setAttr("coordinates", K.places(point[first:last]))
    K.set_rigid_modes(point[first:last])
    return K, point[first:last]


def test_rigid_motions_break_no_contact():
    K, _ = chain(10)
    K.update(1e6 * np.tile(np.eye(3), (K.G.rows, 1, 1)))
    modes = K.mat.getNearNullSpace().getVecs()
    assert len(modes) == 6
    for mode in modes:
        assert mode.norm() == pytest.approx(1)
        assert (K.mat * mode).norm() == pytest.approx(1, rel=1e-3)  # of K = I + 1e6 G'G the I alone


def test_bisection_makes_boxes_of_equal_number():
    points = np.random.default_rng(0).random((1000, 3)) * [4, 1, 1]
    box = bisect(points, 20)
    assert np.ptp(np.bincount(box)) <= 1
    assert box.max() == 15
    halves = points[box < 8, 0], points[box >= 8, 0]
    assert halves[0].max() <= halves[1].min()
    assert bisect(points[:3], 64).max() == 1


def test_is_the_formula():
    mat = poisson(8)
    ksp = solver(mat, boxes=8)
    A = dense(mat)
    box = bisect(np.asarray(mat.getAttr("coordinates"), float), 8)
    Z = (box[:, None] == np.arange(8)).astype(float)
    Q = Z @ np.linalg.solve(Z.T @ A @ Z, Z.T)
    D = np.diag(1 / np.diag(A))
    assert np.allclose(matrix_of(ksp), D + Q)


@pytest.mark.parametrize("options", [{}, {"pc_mg_type": "multiplicative", "mg_levels_ksp_type": "chebyshev"}])
def test_is_symmetric_and_positive(options):
    for name, value in options.items():
        PETSc.Options()["two_" + name] = value
    M = matrix_of(solver(chain(12)[0].mat, boxes=16))
    assert np.allclose(M, M.T, atol=1e-10 * abs(M).max())
    assert np.linalg.eigvalsh(M).min() > 0


def test_takes_fewer_iterations_than_block_jacobi():
    """With PETSc's own cycles, by its options."""
    PETSc.Options()["two_pc_mg_type"] = "multiplicative"
    PETSc.Options()["two_mg_levels_ksp_type"] = "chebyshev"
    mat = chain(20)[0].mat
    assert iterations(solver(mat, boxes=64)) < 0.7 * iterations(block_jacobi(mat))


def test_scalar_matrices_with_and_without_places():
    for attribute in (True, False):
        mat = poisson(24)
        if not attribute:
            mat.setAttr("coordinates", None)
        assert iterations(solver(mat, boxes=64)) < 0.8 * iterations(block_jacobi(mat))


def test_follows_new_values():
    K, point = chain(12)
    ksp = solver(K.mat, boxes=16)
    before = matrix_of(ksp)
    K.update(7.0 * np.tile(np.eye(3), (len(point), 1, 1)))
    ksp.setUp()
    anew = solver(chain(12, stiffness=7.0)[0].mat, boxes=16)
    assert np.allclose(matrix_of(ksp), matrix_of(anew))
    assert not np.allclose(matrix_of(ksp), before)


def test_rows_that_have_no_modes():
    """A near null space that vanishes on a box leaves block Jacobi there."""
    mat = poisson(8)
    mode = mat.createVecRight()
    mode.array[:32] = 1.0
    mode.normalize()
    mat.setNearNullSpace(PETSc.NullSpace().create(constant=False, vectors=[mode], comm=mat.comm))
    M = matrix_of(solver(mat, boxes=4))
    assert np.allclose(M[32:, 32:], np.eye(32) / 4)
    assert not np.allclose(M[:32, :32], np.eye(32) / 4)


def test_the_unit_of_the_matrix_does_not_matter():
    """No pivot of a small matrix counts as zero: all solves take the same iterations."""
    counts = []
    for factor in (1.0, 1e-15, 1e15):
        mat = poisson(12)
        mat.scale(factor)
        counts.append(iterations(solver(mat, boxes=16)))
    assert len(set(counts)) == 1


def test_a_singular_matrix_with_its_null_space():
    """Poisson's equation without boundary values: the graph Laplacian of a grid, and its constants."""
    mat = poisson(12)
    diagonal, ones = mat.createVecs()
    ones.set(1.0)
    mat.mult(ones, diagonal)  # what the boundary adds to the diagonal
    diagonal.scale(-1.0)
    mat.setDiagonal(diagonal, PETSc.InsertMode.ADD_VALUES)
    mat.setNullSpace(PETSc.NullSpace().create(constant=True, comm=mat.comm))
    x, b = mat.createVecs()
    b.array[:] = np.sin(np.arange(144))
    b.shift(-b.sum() / 144)
    solver(mat, boxes=16).solve(b, x)
    assert (b - mat * x).norm() <= 1.1e-6 * b.norm()


@pytest.mark.parallel(2)
def test_a_matrix_that_stores_no_diagonal_leaves_no_rank_waiting():
    """Its blocks are singular, so the set-up has failed: on all ranks."""
    mat = poisson(8)
    indptr, indices, values = mat.getValuesCSR()
    first, last = mat.getOwnershipRange()
    row = np.repeat(np.arange(first, last), np.diff(indptr))
    kept = indices != row
    indptr = np.concatenate([[0], np.cumsum(np.bincount(row[kept] - first, minlength=last - first))])
    csr = (indptr.astype(PETSc.IntType), indices[kept], values[kept])
    hollow = PETSc.Mat().createAIJ(mat.getSizes(), csr=csr, comm=mat.comm)
    ksp = solver(hollow, boxes=32)
    x, b = hollow.createVecs()
    b.set(1.0)
    ksp.solve(b, x)
    assert ksp.getConvergedReason() < 0


@pytest.mark.parametrize(("name", "value"), [("boxes", "0"), ("box", "3")])
def test_bad_options(name, value):
    with pytest.raises((OptionError, PETSc.Error)) as error:
        solver(poisson(4), **{name: value})
    assert "pc_two_" + name in str(error.value) or isinstance(error.value, PETSc.Error)


@pytest.mark.parallel(2, 3)
def test_any_number_of_ranks():
    mats = (chain(12, comm, stiffness=1.0)[0].mat for comm in (MPI.COMM_WORLD, MPI.COMM_SELF))
    here, alone = (iterations(solver(mat, boxes=16)) for mat in mats)
    assert abs(here - alone) <= 1


def test_system_with_gamg_and_two_levels_inside_body_schur():
    """The inner preconditioners that -compare knows as body-two and body-gamg."""
    K, point = chain(12)
    S = contact_matrix(K.G, np.tile(0.01 * np.eye(3), (len(point), 1, 1)))
    S.setAttr("coordinates", point)
    x, b = S.createVecs()
    b.array[:] = sp.random(1, b.getLocalSize(), 1.0, random_state=0).toarray().ravel()
    for name in ("body-two", "body-gamg"):
        krylov = Krylov(MPI.COMM_SELF, f"compare_{name}_", NAMED[name])
        done = krylov.solve(S, b, x, 1e-6)
        assert done.converged, (name, done)
        krylov.destroy()
