"""The threshold incomplete Cholesky factors by blocks."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
import scipy.sparse as sp
from mpi4py import MPI
from petsc4py import PETSc
from systems import contact_matrix, contacts, dense
from train_solver import poisson

from pctt.blocks import put_diagonal_blocks, set_diagonal_blocks, symmetric_shell
from pctt.options import OptionError
from pctt.petsc import own_errors

NAME = "pctt.pc.BlockICC"


def solver(mat: PETSc.Mat, method: str = "cg", **options: object) -> PETSc.KSP:
    """A KSP to a true residual of 1e-8, with options ``-pc_bic_*``."""
    ksp, database = PETSc.KSP().create(mat.comm), PETSc.Options()
    ksp.setOperators(mat)
    ksp.setType(method)
    ksp.setNormType(PETSc.KSP.NormType.UNPRECONDITIONED)
    if method == "bcgs":
        ksp.setPCSide(PETSc.PC.Side.RIGHT)
    ksp.setTolerances(rtol=1e-8, max_it=2000)
    names = {f"pc_bic_{name}": str(value) for name, value in options.items()}
    for name, value in names.items():
        database[name] = value
    try:
        ksp.pc.setType("python")
        ksp.pc.setPythonType(NAME)
        with own_errors():
            ksp.setFromOptions()
    finally:
        for name in names:
            database.delValue(name)
    return ksp


def solve(ksp: PETSc.KSP) -> tuple[int, float]:
    """Iterations, and the relative true residual."""
    mat = ksp.getOperators()[0]
    x, b = mat.createVecs()
    b.array[:] = np.random.default_rng(mat.comm.rank).standard_normal(b.getLocalSize())
    ksp.solve(b, x)
    return ksp.getIterationNumber(), (b - mat * x).norm() / b.norm()


def preconditioner(ksp: PETSc.KSP) -> np.ndarray:
    """M as a dense matrix, of a KSP on one rank."""
    ksp.setUp()
    x, y = ksp.getOperators()[0].createVecs()
    columns = []
    for row in np.eye(x.getSize()):
        x.array[:] = row
        ksp.pc.apply(x, y)
        columns.append(y.array.copy())
    return np.array(columns).T


def context(ksp: PETSc.KSP):
    return ksp.pc.getPythonContext()


def barrier(count: int, seed: int = 0) -> np.ndarray:
    """Diagonal blocks (count, 3, 3) over eight orders of magnitude, as late in an interior point method."""
    rng = np.random.default_rng(seed)
    Q = np.linalg.qr(rng.standard_normal((count, 3, 3)))[0]
    return np.einsum("nij,nj,nkj->nik", Q, 10.0 ** rng.uniform(-4, 4, (count, 3)), Q)


def newton_matrix(bodies: int, count: int, seed: int = 0) -> PETSc.Mat:
    """A contact matrix with a barrier."""
    mat = contact_matrix(*contacts(count, bodies))
    own = dense(mat).reshape(count, 3, count, 3)[range(count), :, range(count)]
    put_diagonal_blocks(mat, own + barrier(count, seed))
    return mat


def in_blocks(A: np.ndarray, size: int, kind: str) -> PETSc.Mat:
    """A dense array as a Mat of this type and block size."""
    mat = PETSc.Mat().createBAIJ((A.shape, A.shape), size, comm=PETSc.COMM_SELF)
    rows = sp.bsr_matrix(A, blocksize=(size, size))
    rows.sort_indices()
    mat.setPreallocationCSR((rows.indptr, rows.indices, rows.data))
    mat.setOption(PETSc.Mat.Option.SYMMETRIC, True)
    return mat if kind == "baij" else mat.convert(kind, PETSc.Mat())


@pytest.mark.parametrize("size", [1, 2, 3, 4, 5, 6, 7])
def test_blocks_of_any_size_in_any_type_give_nearly_the_inverse_where_nothing_is_dropped(size):
    rng = np.random.default_rng(size)
    n = 11 * size
    B = rng.standard_normal((n, n)) * (rng.random((n, n)) < 0.1)
    scale = 10.0 ** rng.uniform(-6, 6, n)
    A = scale[:, None] * (B @ B.T + np.eye(n)) * scale
    for kind in ("baij", "aij", "sbaij", "dense"):
        M = preconditioner(solver(in_blocks(A, size, kind), tau=0, shift=0))
        T = scale[:, None] * M * scale @ (B @ B.T + np.eye(n))
        assert np.abs(M - M.T).max() <= 1e-12 * np.abs(M).max()
        # eight bits round entries of at most 1 by 0.004
        assert np.linalg.norm(np.linalg.eigvals(T) - 1, np.inf) < 0.5


def test_it_takes_a_third_of_the_iterations_of_block_jacobi_on_newton_systems():
    mat = newton_matrix(200, 600)
    ksp = solver(mat)
    its, left = solve(ksp)
    jacobi = solver(mat)
    jacobi.pc.setType("pbjacobi")
    assert left < 1e-7
    assert its < solve(jacobi)[0] / 3


def test_it_is_linear_to_rounding_so_that_bicgstab_reaches_what_it_reports():
    its, left = solve(solver(newton_matrix(200, 600), "bcgs"))
    assert its > 1
    assert left < 2e-8


def test_new_values_give_the_factor_of_the_new_matrix_and_keep_the_order():
    mat = newton_matrix(40, 100)
    ksp = solver(mat)
    ksp.setUp()
    order = context(ksp).factor.blocks_of
    put_diagonal_blocks(mat, 3.0 * barrier(100, 1) + 5.0 * np.eye(3))
    ksp.setOperators(mat)
    renewed = preconditioner(ksp)
    assert context(ksp).factor.blocks_of is order
    assert np.array_equal(renewed, preconditioner(solver(mat)))


def test_a_matrix_with_another_pattern_gets_another_order():
    ksp = solver(newton_matrix(40, 100))
    ksp.setUp()
    other = newton_matrix(30, 80)
    ksp.reset()
    ksp.setOperators(other)
    assert np.array_equal(preconditioner(ksp), preconditioner(solver(other)))


def breaking(rows: int = 90) -> PETSc.Mat:
    """A matrix that is hardly definite, whose pivots are negative if much of it is dropped."""
    B = np.random.default_rng(3).standard_normal((rows, rows // 3))
    A = B @ B.T + 1e-3 * np.eye(rows)
    return in_blocks(A, 3, "baij")


def test_a_bad_pivot_raises_the_shift_and_the_shift_is_told():
    ksp = solver(breaking(), tau=0.3)
    its, left = solve(ksp)
    assert left < 1e-7
    assert its < 200
    assert context(ksp).factor.shift > 0.3
    assert f"shift {context(ksp).factor.shift:.2g}" in context(ksp).what()


def test_a_given_shift_that_is_too_small_fails_with_its_name():
    ksp = solver(breaking(), tau=0.3, shift=0.01)
    with pytest.warns(UserWarning, match="pivot is not positive with -pc_bic_shift 0.01: raise it"):
        solve(ksp)
    assert ksp.getConvergedReason() < 0


def test_a_matrix_that_is_not_positive_definite_ends_the_krylov_method():
    ksp = solver(in_blocks(np.diag([1.0, 1.0, -1.0]), 3, "baij"))
    with pytest.warns(UserWarning, match="diagonal block of the matrix is not positive definite"):
        solve(ksp)
    assert ksp.getConvergedReason() < 0
    mat = in_blocks(np.eye(3), 3, "baij")  # it works again with a matrix that is
    ksp.setOperators(mat)
    assert solve(ksp)[1] < 1e-12


@pytest.mark.parametrize("place", [(4, 4), (4, 5), (4, 9)])
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_matrix_that_is_no_number_is_said_to_be_so(value, place):
    mat = PETSc.Mat().createAIJ((12, 12), nnz=12, comm=PETSc.COMM_SELF)
    mat.setUp()
    mat[:, :] = 20.0 * np.eye(12) + 1.0
    mat[place] = mat[place[::-1]] = value
    mat.assemble()
    ksp = solver(mat)
    with pytest.warns(UserWarning, match="BlockICC: the matrix has entries that are NaN or infinite"):
        solve(ksp)
    assert ksp.getConvergedReason() < 0


@pytest.mark.parametrize("unit", [1e-120, 1e-90, 1e90, 1e120])
def test_the_unit_of_a_matrix_changes_nothing_but_the_unit_of_its_inverse(unit):
    """Numbers of single precision end at 1e38; squares of a matrix of 1e-160 would be zero for PETSc, too."""
    n = 12
    mat, scaled = poisson(n), poisson(n)
    scaled.scale(unit)
    for one in (mat, scaled):
        one.setAttr("coordinates", None)
    M, scaled_M = preconditioner(solver(mat)), preconditioner(solver(scaled))
    np.testing.assert_allclose(unit * scaled_M, M, rtol=0, atol=1e-6 * np.abs(M).max())


def test_a_matrix_that_is_not_symmetric_is_warned_of():
    mat = PETSc.Mat().createAIJ((3, 3), csr=([0, 2, 3, 4], [0, 1, 1, 2], [2.0, 1.0, 2.0, 2.0]), comm=PETSc.COMM_SELF)
    with pytest.warns(UserWarning, match="not symmetric"):
        solver(mat).setUp()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"tau": 2}, "-pc_bic_tau 2: allowed is a number >= 0 and below 1"),
        ({"shift": -1}, "-pc_bic_shift -1: allowed is auto or a number from 0 to 1e6"),
        ({"shift": 1e300}, r"-pc_bic_shift 1e\+300: allowed is auto or a number from 0 to 1e6"),
        ({"taw": 1}, "-pc_bic_taw: no such option; did you mean -pc_bic_tau"),
    ],
)
def test_bad_options_are_named(options, words):
    with pytest.raises(OptionError, match=words):
        solver(newton_matrix(4, 6), **options)


def test_a_shell_of_the_project_gives_its_diagonal_blocks():
    blocks = barrier(5)

    def times(x: np.ndarray, y: np.ndarray) -> None:
        y[:] = np.einsum("nij,nj->ni", blocks, x.reshape(-1, 3)).ravel()

    shell = symmetric_shell(MPI.COMM_SELF, 15, 3, times)
    set_diagonal_blocks(shell, blocks)
    assert solve(solver(shell, shift=0))[0] <= 2


def test_a_matrix_without_entries_is_refused():
    shell = PETSc.Mat().createPython((9, 9), type("Shell", (), {"mult": lambda *_: None})())
    shell.setUp()
    with pytest.raises(ValueError, match="no entries to read; allowed are aij"), own_errors():
        solver(shell).setUp()


def test_points_that_are_told_to_the_preconditioner_order_its_rows():
    n = 24
    mat = poisson(n)
    mat.setAttr("coordinates", None)
    ksp = solver(mat)
    ksp.pc.setCoordinates(np.stack(np.divmod(np.arange(n * n), n), axis=1).astype(float))
    its, left = solve(ksp)
    assert left < 1e-7
    assert its < 25
    assert "PCSetCoordinates" in "\n".join(context(ksp).report())


@pytest.mark.parallel(2, 3)
def test_each_rank_has_a_factor_of_its_own_rows():
    comm = MPI.COMM_WORLD
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        n = 24
        mat = poisson(n)
        ksp = solver(mat)
        its, left = solve(ksp)
    assert left < 1e-7
    assert its < 80
    assert len(set(comm.allgather(context(ksp).what()))) == 1
    bad = 1.0 if comm.rank == 0 else -1.0
    rows = PETSc.Mat().createAIJ(((2, None), (2, None)), nnz=1, comm=comm)
    first, last = rows.getOwnershipRange()
    for row in range(first, last):
        rows.setValue(row, row, bad)
    rows.assemble()
    failing = solver(rows)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        solve(failing)
    assert failing.getConvergedReason() < 0


@pytest.mark.parallel(1, 2, 3)
@pytest.mark.parametrize("kind", ["aij", "dense"])
@pytest.mark.parametrize("size", [0, 1, 50])
def test_ranks_without_rows(kind, size):
    first = MPI.COMM_WORLD.rank == 0
    local = (size if first else 0, size)
    mat = PETSc.Mat().createAIJ((local, local), nnz=3)
    for row in range(*mat.getOwnershipRange()):
        for column in range(max(row - 1, 0), min(row + 2, size)):
            mat.setValue(row, column, 2.1 if row == column else -1.0)
    mat.assemble()
    mat, (x, b) = mat.convert(kind, PETSc.Mat()), mat.createVecs()
    b.set(1.0)
    ksp = solver(mat)
    ksp.solve(b, x)
    assert ksp.getIterationNumber() <= size
    assert (b - mat * x).norm() <= 1e-7 * b.norm()
