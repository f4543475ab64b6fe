"""pctt.pc.TensorTrain as any petsc4py program uses it."""

from __future__ import annotations

import re
import warnings

import numpy as np
import pytest
import scipy.sparse as sp
from mpi4py import MPI
from petsc4py import PETSc
from systems import contact_matrix, contacts, dense
from train_solver import context, operator, poisson, ready, report, solve, solver

from pctt import memory
from pctt.pc import sparse_train


def set_up(ksp: PETSc.KSP) -> None:
    """For new values of the same matrix."""
    ksp.setOperators(ksp.getOperators()[0])
    ksp.setUp()


@pytest.mark.parallel(1, 2)
def test_without_memory_for_a_train_block_jacobi_takes_over(monkeypatch):
    monkeypatch.setattr(memory, "available", lambda comm: 1e4)
    mat = poisson(16)
    ksp = solver(mat, rank=4)
    _, left = solve(ksp)
    assert left < 1e-7
    assert context(ksp).rank == 1
    assert "fell back: there is no memory for the tables of a train (1 times)" in context(ksp).report()
    monkeypatch.undo()
    again = ready(mat, rank=4)
    assert context(again).rank == 4


def test_auto_is_block_jacobi_for_a_sparse_matrix():
    G, barrier = contacts(40, 30)
    mat = contact_matrix(G, barrier)
    ksp = ready(mat, rank="auto")
    blocks = dense(mat).reshape(40, 3, 40, 3)[np.arange(40), :, np.arange(40)]
    expected = np.zeros((40, 3, 40, 3))
    expected[np.arange(40), :, np.arange(40)] = np.linalg.inv(blocks)
    assert np.allclose(operator(ksp), expected.reshape(120, 120))


@pytest.mark.parametrize("block", [1, 3])
def test_applied_operator_is_symmetric_and_positive(block):
    G, barrier = contacts(60, 25)
    mat = poisson(12) if block == 1 else contact_matrix(G, 30 * barrier)
    ksp = ready(mat, rank=6)
    M = operator(ksp)
    assert context(ksp).rank == 6
    assert np.allclose(M, M.T, atol=1e-10 * np.abs(M).max())
    assert np.linalg.eigvalsh(0.5 * (M + M.T)).min() > 0


def test_new_values_start_from_the_old_train():
    mat = poisson(16)
    ksp = solver(mat, rank=8, reuse="cores")
    solve(ksp)
    mat.shift(0.5)
    assert solve(ksp)[1] < 1e-6
    assert (context(ksp).account.reused, context(ksp).account.kept) == (1, 0)
    assert context(ksp).made.compression.error <= 1.2 * context(ready(mat, rank=8)).made.compression.error


def test_a_train_is_kept_for_a_matrix_that_differs_by_its_scaling():
    mat = poisson(16)
    ksp = solver(mat, rank=8, order="morton", reuse="trains")  # in the order of the grid a new one would be better
    its, _ = solve(ksp)
    train = context(ksp).made.inverse
    scaling = mat.createVecLeft()
    scaling.array[:] = 10 ** np.random.default_rng(1).uniform(-2, 2, mat.getSize()[0])
    mat.diagonalScale(scaling, scaling)
    for setups in range(2, 8):
        mat.scale(2.0)
        set_up(ksp)
        assert context(ksp).made.inverse is train
        assert context(ksp).account.setups == setups
    assert context(ksp).account.reused == 2  # tried for the third and the sixth matrix, and found no better
    again, _ = solve(ksp)
    assert abs(again - its) <= 0.1 * its + 1


def test_a_kept_train_goes_where_a_new_one_is_better():
    mat = poisson(16)
    ksp = solver(mat, rank=8, reuse="trains")
    solve(ksp)
    train = context(ksp).made.inverse
    rows, columns, values = mat.getValuesCSR()
    weak = np.abs(columns - np.repeat(np.arange(len(rows) - 1), np.diff(rows))) == 1
    mat.setValuesCSR(rows, columns, np.where(weak, 0.02 * values, values))  # one direction is loosened
    mat.assemble()
    set_up(ksp)
    assert context(ksp).made.inverse is train
    mat.scale(2.0)
    set_up(ksp)
    assert context(ksp).made.inverse is not train
    assert "kept 1 times" in report(ksp)
    its, _ = solve(ksp)
    cold_its, _ = solve(solver(mat, rank=8))
    assert its <= 1.2 * cold_its + 1


def another(mat: PETSc.Mat, **options: object) -> int:
    """Iterations of a new solver."""
    return solve(solver(mat, **options))[0]


@pytest.mark.parallel(1, 2)
def test_a_matrix_with_other_values_gets_a_train_of_its_own():
    """As PETSc has it: whoever wants to keep a preconditioner says so."""
    mat = poisson(18)
    ksp = solver(mat, rank=16)
    for more in (0.0, 3.0, 0.7, -3.65, 9.0):
        mat.shift(more)
        assert solve(ksp)[0] == another(mat, rank=16)
    assert context(ksp).account.reused == context(ksp).account.kept == 0


def test_a_refusal_holds_for_its_values():
    mat = poisson(8)
    entry = mat[5, 5]
    ksp = solver(mat, rank=10)
    for factor, rank in ((-1.0, 1), (1.0, 10), (-1.0, 1), (1.0, 10)):
        mat[5, 5] = factor * entry
        mat.assemble()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            set_up(ksp)
        assert context(ksp).rank == rank
        assert ("not positive definite" in report(ksp).splitlines()[0]) == (rank == 1)
    assert "the next matrix is tried again" in report(ksp)


def test_similar_matrices_are_tried_at_doubling_intervals():
    mat = poisson(8)
    mat[5, 5] = -1.0
    mat.assemble()
    ksp = solver(mat, rank=10, reuse="trains")
    counts = []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for _ in range(8):
            mat.scale(2.0)
            set_up(ksp)
            counts.append(sum(context(ksp).account.fallbacks.values()))
    assert counts == [1, 1, 2, 2, 2, 2, 3, 3]


@pytest.mark.parametrize("value", [np.nan, np.inf])
@pytest.mark.parametrize("place", [(5, 5), (5, 6)])
def test_a_matrix_with_nan_is_said_to_have_it(value, place):
    mat = poisson(8)
    mat[place] = mat[place[::-1]] = value
    mat.assemble()
    with pytest.warns(UserWarning, match="NaN or infinite"):
        solver(mat, "gmres", rank=10).setUp()


def test_block_jacobi_of_a_matrix_with_an_infinite_diagonal_ends_no_solve_as_converged():
    mat = poisson(8)
    mat.scale(np.inf)
    ksp = solver(mat, "cg")
    x, b = mat.createVecs()
    b.set(1.0)
    ksp.solve(b, x)
    assert ksp.getConvergedReason() < 0


@pytest.mark.parallel(1, 2)
def test_a_warning_names_the_solver():
    with warnings.catch_warnings(record=True) as heard:
        warnings.simplefilter("default")
        for prefix in ("one_", "other_"):
            mat = poisson(8)
            mat.shift(-20.0)
            mat.shift(17.0)
            solver(mat, "gmres", prefix=prefix, rank=4).setUp()
    words = [str(one.message) for one in heard if "TensorTrain" in str(one.message)]
    if MPI.COMM_WORLD.rank == 0:
        assert all(any(f"TensorTrain of {prefix}: " in line for line in words) for prefix in ("one_", "other_"))


def test_a_train_that_leaves_more_than_half_is_said_to():
    """A random graph in an order without sense."""
    rng = np.random.default_rng(0)
    i, j = rng.integers(0, 400, (2, 1200))
    links = sp.coo_matrix((np.ones(1200), (i, j)), (400, 400))
    links = links + links.T
    graph = (sp.diags(np.asarray(links.sum(axis=1)).ravel() + 6.0) - links).tocsr()
    mat = PETSc.Mat().createAIJ(graph.shape, csr=(graph.indptr, graph.indices, graph.data))
    ksp = solver(mat, rank=4, order="natural")
    with pytest.warns(UserWarning, match="leaves 0.[5-9]"):
        ksp.setUp()
    assert context(ksp).rank == 4
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        solver(poisson(16), rank=16).setUp()


@pytest.mark.parametrize(("ksp_type", "way"), [
    ("cg", {}), ("bcgs", {}), ("gmres", {}), ("fgmres", {}),
    ("cg", {"variant": "cross"}), ("cg", {"variant": "unscaled"}), ("cg", {"variant": "paper"}),
])  # fmt: skip
def test_every_way_to_a_train_takes_fewer_iterations_than_jacobi(ksp_type, way):
    jacobi_its, _ = solve(solver(poisson(16), ksp_type, rank=1))
    ksp = solver(poisson(16), ksp_type, rank=8, **way)
    its, residual = solve(ksp)
    assert context(ksp).rank == 8, context(ksp).account.fallbacks
    assert residual < 1e-6
    assert its < jacobi_its


@pytest.mark.parametrize("entry", [-1.0, 0.0])
def test_a_diagonal_that_is_not_positive_falls_back_to_block_jacobi(entry):
    mat = poisson(8)
    diagonal = mat.getDiagonal()
    diagonal.array[5] = entry
    mat.setDiagonal(diagonal)
    ksp = ready(mat, "gmres", rank=10)
    assert context(ksp).rank == 1
    assert any("not positive definite" in why for why in context(ksp).account.fallbacks)


def test_it_says_what_it_was():
    for rank, words in (("auto", "rank 1: block Jacobi"), ("1", "rank 1: block Jacobi"), ("8", "rank [2-8]")):
        ksp = ready(poisson(16), rank=rank)
        assert context(ksp).what() == ""  # set up, but no system solved
        for _ in range(2):
            assert solve(ksp)[1] < 1e-6
        assert re.fullmatch(words, context(ksp).what())


@pytest.mark.parallel(1, 3)
def test_any_number_of_ranks():
    ksp = solver(poisson(20), rank=8, order="morton", reuse="trains")
    its, residual = solve(ksp)
    assert context(ksp).rank == 8, context(ksp).account.fallbacks
    assert its < 60
    assert residual < 1e-6
    for _ in range(2):
        ksp.getOperators()[0].scale(3.0)
        solve(ksp)
    assert context(ksp).account.kept == 2


@pytest.mark.parallel(2, 3)
def test_all_ranks_have_the_inverse_of_one_also_where_they_round_otherwise(monkeypatch):
    comm = MPI.COMM_WORLD
    invert = sparse_train.invert_near_identity

    def rounded(*arguments, **named):
        found = invert(*arguments, **named)
        for core in found.applied.cores:
            core *= 1 + 1e-7 * comm.rank
        return found

    monkeypatch.setattr(sparse_train, "invert_near_identity", rounded)
    ksp = solver(poisson(16), rank=6)
    _, residual = solve(ksp)
    assert residual < 1e-6
    assert context(ksp).rank == 6
    cores = comm.allgather(context(ksp).made.inverse.applied.cores)
    assert all(np.array_equal(core, first) for own in cores for core, first in zip(own, cores[0]))
