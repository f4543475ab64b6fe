"""The preconditioners as parts of PETSc programs: matrices that are unusual, and calls in an unusual order."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
import scipy.sparse as sp
import train_solver
from mpi4py import MPI
from petsc4py import PETSc
from systems import dense, spd
from train_solver import poisson

SMALL = {"rank": 20}


def stored(A: np.ndarray, kind: str = "aij", block: int = 1, pattern: np.ndarray | None = None) -> PETSc.Mat:
    """A sequential Mat of this type; ``pattern`` has nonzeros also at zeros that are stored."""
    where = sp.csr_matrix(A if pattern is None else pattern)
    row = np.repeat(np.arange(len(A)), np.diff(where.indptr))
    mat = PETSc.Mat().create(PETSc.COMM_SELF)
    mat.setSizes(A.shape)
    mat.setBlockSize(block)
    mat.setType("aij")
    mat.setPreallocationCSR((where.indptr, where.indices, A[row, where.indices]))
    if kind == "sbaij":
        mat.setOption(PETSc.Mat.Option.SYMMETRIC, True)
    return mat if kind == "aij" else mat.convert(kind, PETSc.Mat())


def solver(mat: PETSc.Mat, method="cg", prefix="", **options: object) -> PETSc.KSP:
    """With a train, to a true residual of 1e-9."""
    ksp = train_solver.solver(mat, method, 1e-9, prefix, **options)
    ksp.setNormType(PETSc.KSP.NormType.UNPRECONDITIONED)
    return ksp


def left(ksp: PETSc.KSP, transposed: bool = False) -> float:
    """The relative true residual of a solve, computed by numpy."""
    mat = ksp.getOperators()[0]
    x, b = mat.createVecs()
    b.array[:] = np.random.default_rng(0).standard_normal(b.getLocalSize())
    (ksp.solveTranspose if transposed else ksp.solve)(b, x)
    A = dense(mat).T if transposed else dense(mat)
    return float(np.linalg.norm(A @ x.array - b.array) / b.norm())


def ring(n: int, distance: int) -> np.ndarray:
    """Each row has its neighbours ``distance`` before and after."""
    off = np.roll(np.eye(n), distance, axis=1)
    return 3 * np.eye(n) - off - off.T


def test_a_dense_matrix_is_set_up_once():
    """Not for every product, as it would be if reading the matrix counted as a change of it."""
    mat = stored(spd(30, 0), "dense")
    ksp = solver(mat)
    for _ in range(2):
        assert left(ksp) < 1e-8
    assert ksp.pc.getPythonContext().account.setups == 1


@pytest.mark.parametrize("kind", ["aij", "baij", "sbaij", "dense"])
def test_a_matrix_without_rows(kind):
    """Block Jacobi has such blocks on ranks without rows."""
    ksp = solver(stored(np.zeros((0, 0)), kind))
    x, b = ksp.getOperators()[0].createVecs()
    ksp.solve(b, x)
    assert ksp.getConvergedReason() > 0
    ksp.reset()
    ksp.setOperators(stored(ring(20, 1)))
    assert left(ksp) < 1e-8


def test_a_view_before_the_set_up(capfd):
    solver(stored(ring(20, 1))).view()
    assert "pctt.pc.TensorTrain" in capfd.readouterr().out


def test_options_for_all_levels_are_those_of_each():
    PETSc.Options().insertString("-mg_levels_pc_tt_rank 7")
    ksp = solver(poisson(8), prefix="mg_levels_1_")
    assert ksp.pc.getPythonContext().options.rank == "7"


def test_new_options_are_those_of_the_next_set_up():
    ksp = solver(poisson(8), rank=2)
    assert left(ksp) < 1e-8
    PETSc.Options()["pc_tt_rank"] = "12"
    ksp.setFromOptions()
    ksp.setOperators(poisson(8))
    assert left(ksp) < 1e-8
    assert ksp.pc.getPythonContext().rank == 12


def test_a_new_context_of_a_solver_in_use():
    """PETSc makes one whenever the type is in the database, and does not set it up."""
    PETSc.Options().insertString("-pc_type python -pc_python_type pctt.pc.TensorTrain")
    ksp = solver(poisson(8), **SMALL)
    assert left(ksp) < 1e-8
    ksp.setFromOptions()
    assert left(ksp) < 1e-8


@pytest.mark.parametrize("block", [1, 3])
def test_zeros_that_are_stored(block):
    """MatZeroRowsColumns leaves such zeros."""
    A = ring(36, block)
    ksp = solver(stored(A, block=block, pattern=A + ring(36, 2 * block)), **SMALL)
    assert left(ksp) < 1e-8
    assert ksp.pc.getPythonContext().rank == 20
    assert ksp.getIterationNumber() < 9


def test_another_pattern_with_as_many_nonzeros():
    mat = stored(ring(40, 1))
    ksp = solver(mat, reuse="cores", **SMALL)
    left(ksp)
    other = sp.csr_matrix(ring(40, 7))
    mat.setPreallocationCSR((other.indptr, other.indices, other.data))
    ksp.setOperators(mat)
    assert left(ksp) < 1e-8
    train = ksp.pc.getPythonContext().made.hierarchy
    np.testing.assert_allclose(train.norm(), np.linalg.norm(ring(40, 7) / 3 - np.eye(40)))


def test_rows_with_names_in_blocks_of_another_size():
    ksp = None
    for block, count in ((3, 20), (1, 20), (2, 19)):
        mat = stored(spd(block * count, 0), block=block)
        mat.setAttr("coordinates", np.linspace(0, 1, count)[:, None])
        mat.setAttr("key", np.arange(count))
        if ksp is None:
            ksp = solver(mat, **SMALL)
        ksp.reset()
        ksp.setOperators(mat)
        assert left(ksp) < 1e-8


@pytest.mark.parametrize("size", [1, 2, 7, 24])
def test_a_dense_multiple_of_the_identity(size):
    assert left(solver(stored(4.0 * np.eye(size), "dense"))) < 1e-12


@pytest.mark.parametrize("transposed", [False, True])
def test_methods_that_need_the_transpose(transposed):
    """BiCG diverges if block Jacobi and its transpose are the same for blocks that are not symmetric."""
    A = spd(24, 0) + np.triu(np.random.default_rng(1).standard_normal((24, 24)), 1) * 6
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        ksp = solver(stored(A, block=3), method="bicg")
        assert left(ksp, transposed) < 1e-7


@pytest.mark.parallel(2, 3)
@pytest.mark.parametrize("size", [1, 2, 5])
def test_ranks_without_rows(size):
    comm = MPI.COMM_WORLD
    own = size if comm.rank == comm.size - 1 else 0
    csr = sp.csr_matrix(ring(size, 1)[:own] if size > 2 else 2.0 * np.eye(size)[:own])
    mat = PETSc.Mat().createAIJ(((own, size), (own, size)), csr=(csr.indptr, csr.indices, csr.data), comm=comm)
    mat.setAttr("coordinates", np.arange(3.0 * own).reshape(own, 3))
    ksp = solver(mat)
    x, b = mat.createVecs()
    b.set(1.0)
    ksp.solve(b, x)
    np.testing.assert_allclose(x.array, 1.0 if size > 2 else 0.5)


def test_a_right_side_that_is_no_number_is_not_the_fault_of_the_train():
    """The method ends with PETSc's reason, and the train stays for other right sides."""
    ksp = solver(stored(ring(40, 1)), **SMALL)
    x, b = ksp.getOperators()[0].createVecs()
    b.set(1.0)
    b[3] = np.nan
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        ksp.solve(b, x)
    assert ksp.getConvergedReason() == PETSc.KSP.ConvergedReason.DIVERGED_NANORINF
    assert left(ksp) < 1e-8
    assert ksp.pc.getPythonContext().rank == 20


@pytest.mark.parametrize("fallback", ["jacobi", "none"])
def test_products_that_are_no_numbers_end_with_the_reason_of_petsc(fallback):
    """The train is that of another matrix, which has numbers."""

    class NoNumbers:
        def mult(self, mat, x, y):
            y.set(np.nan)

    P = stored(ring(40, 1))
    A = PETSc.Mat().createPython((40, 40), NoNumbers(), comm=PETSc.COMM_SELF)
    A.setUp()
    ksp = solver(P, fallback=fallback, **SMALL)
    ksp.setOperators(A, P)
    x, b = P.createVecs()
    b.set(1.0)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        ksp.solve(b, x)
    assert ksp.getConvergedReason() == PETSc.KSP.ConvergedReason.DIVERGED_NANORINF


@pytest.mark.parametrize(
    ("options", "idle"),
    [
        ({"eps": 1e-3}, ["eps"]),
        ({"variant": "paper", "order": "natural", "rank": 1}, ["variant", "order"]),
        ({"setup_limit": 1e9, "rank": 12}, ["setup_limit"]),
        ({"reuse": "trains", "fallback": "none"}, []),
    ],
)
def test_options_without_an_effect_are_named(options, idle):
    ksp = solver(poisson(8), prefix="a_", **options)
    with warnings.catch_warnings(record=True) as heard:
        warnings.simplefilter("always")
        for _ in range(2):
            left(ksp)
            ksp.getOperators()[0].scale(2.0)
    words = [str(one.message) for one in heard if "no effect" in str(one.message)]
    assert [line.split(" has no effect")[0].split()[-1] for line in words] == [f"-a_pc_tt_{name}" for name in idle]


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"variant": "paper", "rank": 20}, "-pc_tt_variant has no effect: it is for sparse matrices"),
        ({"eps": 1e-3, "rank": 1}, "-pc_tt_eps has no effect: there is no train of rank 1"),
        ({"eps": 1e-3}, "-pc_tt_eps has no effect: auto tries no train"),
    ],
)
def test_options_without_an_effect_on_entries_are_named(options, words):
    ksp = solver(stored(ring(20, 1), "dense"), **options)
    with pytest.warns(UserWarning, match=words):
        ksp.setUp()
