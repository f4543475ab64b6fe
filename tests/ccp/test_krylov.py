"""The KSP of a Newton system: its defaults, the user's options, and what it says of itself."""

from __future__ import annotations

import numpy as np
import pytest
from mpi4py import MPI
from petsc4py import PETSc
from problems import SELF, dense_of, from_graph, heap, matrix

from pctt import memory
from pctt.ccp import Newton
from pctt.ccp.newton.krylov import Krylov
from pctt.ksp_options import unused


def system(shift: float = 1.0, comm: MPI.Comm = SELF):
    """A symmetric positive definite matrix, its Mat, a right-hand side and room for the solution."""
    rng = np.random.default_rng(0)
    A = rng.normal(size=(60, 60)) * np.exp(rng.normal(size=60))
    dense = A @ A.T + shift * np.eye(60)
    S = matrix(comm, dense)
    x, b = S.createVecs()
    b.array[:] = rng.normal(size=60)[slice(*b.getOwnershipRange())]
    return dense, S, x, b


def overwrite(S, dense: np.ndarray) -> None:
    """New values in the old structure."""
    everywhere = np.arange(len(dense), dtype=PETSc.IntType)
    S.setValues(everywhere, everywhere, dense)
    S.assemble()


@pytest.mark.parallel(1, 2, 3)
@pytest.mark.parametrize("pc", ["none", "jacobi", "pbjacobi", "ilu", "icc", "sor", "gamg", "hypre", "cholesky", "lu"])
@pytest.mark.parametrize("method", ["bcgs", "cg", "gmres"])
def test_the_true_residual_is_the_true_one(pc, method):
    """||b - S x|| / ||b|| from S, x and b themselves, and small where the solve says that it converged. It must where
    the condition number is 9.3; where it is 8,300, rounding decides. On several ranks the factorisations of one rank
    work within each."""
    comm = MPI.COMM_WORLD
    krylov = Krylov(comm, f"{pc}_{method}_", {"pc_type": pc, "ksp_type": method}, rtol=1e-7)
    for shift in (1.0, 1000.0):
        dense, S, x, b = system(shift, comm)
        done = krylov.solve(S, b, x)
        solution, rhs = (np.concatenate(comm.allgather(v.array)) for v in (x, b))
        residual = np.linalg.norm(rhs - dense @ solution) / np.linalg.norm(rhs)
        assert done.true_residual == pytest.approx(residual, rel=1e-3, abs=1e-12)
        assert done.true_residual <= 2e-7 or not done.converged
        assert done.converged or shift == 1.0, done
        assert min(done.setup_s, done.solve_s) > 0
        assert comm.allgather((done.iterations, done.converged)) == [(done.iterations, done.converged)] * comm.size
        within = comm.size > 1 and pc in ("ilu", "icc")
        assert krylov.ksp.pc.getType() == ("bjacobi" if within else pc)
        krylov.forget()


def test_defaults_and_the_users_options(database):
    ksp = Krylov(SELF).ksp
    assert (ksp.getType(), ksp.pc.getType(), ksp.getPCSide()) == ("bcgs", "pbjacobi", PETSc.PC.Side.RIGHT)
    assert ksp.getTolerances()[0] == 1e-3
    assert ksp.getTolerances()[3] == 1000
    database["one_pc_type"] = "sor"
    database["one_ksp_rtol"] = 1e-9
    ksp = Krylov(SELF, "one_", {"pc_type": "jacobi", "ksp_type": "cg"}, rtol=1e-2).ksp
    assert (ksp.getType(), ksp.pc.getType(), ksp.getTolerances()[0]) == ("cg", "sor", 1e-9)


@pytest.mark.parallel(1, 2)
def test_viewers_and_monitors_outlive_the_structure_of_a_matrix(database, tmp_path, capfd):
    """KSPReset drops the viewers. Files go on; nothing is shown twice; a python preconditioner stays the same one."""
    comm = MPI.COMM_WORLD
    database["ccp_pc_type"], database["ccp_pc_python_type"] = "python", "pctt.pc.TensorTrain"
    for name in ("ksp_view", "ksp_view_final_residual", "ksp_monitor"):
        database[f"ccp_{name}"] = f"ascii:{tmp_path}/{name}"
    database["ccp_ksp_view_pre"], database["ccp_ksp_rtol"], database["ccp_ksp_type"] = None, "1e-9", "cg"
    before = database.getAll()
    krylov = Krylov(comm)
    context = krylov.ksp.pc.getPythonContext()
    done = []
    for _ in range(3):
        _, S, x, b = system(shift=100.0, comm=comm)
        done += [krylov.solve(S, b, x) for _ in range(2)]
        assert (krylov.ksp.getType(), krylov.ksp.getTolerances()[0]) == ("cg", 1e-9)
        assert krylov.ksp.pc.getPythonContext() is context
        krylov.forget()
    krylov.destroy()
    assert database.getAll() == before
    assert len({solve.iterations for solve in done}) == 1
    said = comm.allgather(capfd.readouterr().out)[0]
    comm.Barrier()
    assert said.count("KSP Object: (ccp_)") == 6
    texts = {path.name: path.read_text() for path in tmp_path.iterdir()}
    assert texts["ksp_view"].count("KSP Object: (ccp_)") == texts["ksp_view"].count("tensor train: rank 1") == 6
    assert texts["ksp_view_final_residual"].count("KSP final norm of residual") == 6
    assert texts["ksp_monitor"].count("KSP Residual norm") == sum(solve.iterations + 1 for solve in done)


def test_options_count_as_used_once_a_system_is_solved_with_them(database):
    mine = {"ccp_ksp_rtol": "1e-3", "ccp_pc_type": "ilu", "ccp_pc_factor_levels": "1", "ccp_pc_sor_its": "2"}
    for name, value in mine.items():
        database[name] = value
    krylov, other = Krylov(SELF), Krylov(SELF, "ccp_compare_x_", {"pc_type": "jacobi"})
    assert krylov.words() == "BiCGStab (right), ilu"
    assert set(unused(mine)) == set(mine)
    _, S, x, b = system(shift=100.0)
    other.solve(S, b, x)
    assert set(unused(mine)) == set(mine) - {"ccp_ksp_rtol"}
    krylov.solve(S, b, x)
    assert unused(mine) == ["ccp_pc_sor_its"]


def test_eisenstat_works_on_scalar_rows():
    """On blocks of three PETSc 3.18 ends in a segmentation fault."""
    dense, S, x, b = system(shift=1000.0)
    assert Krylov(SELF, "e_", {"pc_type": "eisenstat"}, rtol=1e-7).solve(S, b, x).iterations > 1
    assert np.linalg.norm(dense @ x.array - b.array) <= 1e-5 * np.linalg.norm(b.array)


@pytest.mark.parametrize("pc", ["lu", "cholesky", "ilu", "icc", "hypre", "pbjacobi", "none", "python"])
def test_a_breakdown_is_reported_and_forgotten(pc):
    """A matrix with a NaN, or a set-up that fails: nothing is raised, and the next matrix is solved as if nothing had
    been."""
    dense, S, x, b = system(shift=1000.0)
    krylov = Krylov(SELF, "broken_", {"pc_type": pc}, rtol=1e-6)
    broken = dense.copy()
    broken[4, 4] = np.nan
    overwrite(S, broken)
    done = krylov.solve(S, b, x)
    assert not done.converged
    assert done.true_residual == 1.0
    assert np.array_equal(x.array, np.zeros(60))
    overwrite(S, dense)
    assert krylov.solve(S, b, x).converged or pc == "python"


def test_a_right_hand_side_of_zero():
    _, S, x, b = system()
    b.zeroEntries()
    x.array[:] = 1.0
    done = Krylov(SELF).solve(S, b, x)
    assert done.converged
    assert np.array_equal(x.array, np.zeros(60))


# -- Newton systems -----------------------------------------------------------------------------------------


def newton_of() -> Newton:
    """The system of a heap, with the barrier blocks 1 + A A'."""
    newton = Newton(SELF)
    newton.begin(from_graph(*heap()))
    A = np.random.default_rng(0).normal(size=(40, 3, 3))
    newton.update(A @ A.transpose(0, 2, 1) + np.eye(3))
    return newton


def solved(newton: Newton, rhs: np.ndarray, rtol: float) -> np.ndarray:
    return newton.solve(rhs, rtol * np.linalg.norm(rhs) / np.sqrt(newton.problem.mean_diagonal))[0]


@pytest.mark.parametrize("better", ["ccp_", "ccp_fallback_"])
def test_where_both_fail_the_step_is_the_better_one(better, database):
    """By the true residual; zero where neither is any good."""
    rhs = np.random.default_rng(1).normal(size=(40, 3))
    for prefix in ("ccp_", "ccp_fallback_"):
        database[prefix + "ksp_type"] = "cg"
        database[prefix + "pc_type"] = "jacobi"
        database[prefix + "ksp_max_it"] = 8 if prefix == better else 1
    newton = newton_of()
    mat = newton.system.matrix
    S = dense_of(mat)
    x, b = mat.createVecs()
    b.array[:] = rhs.ravel()
    best = Krylov(SELF, better, rtol=1e-12).solve(mat, b, x).true_residual
    assert best < 1.0
    x = solved(newton, rhs, 1e-12)
    assert np.linalg.norm(S @ x.ravel() - rhs.ravel()) / np.linalg.norm(rhs) == pytest.approx(best, rel=1e-6)
    newton.destroy()
    for prefix in ("ccp_", "ccp_fallback_"):
        database[prefix + "pc_type"] = "python"
    newton = newton_of()
    assert np.array_equal(solved(newton, rhs, 1e-8), np.zeros((40, 3)))
    newton.destroy()


def test_without_memory_a_failing_ksp_has_no_fallback(database, monkeypatch):
    monkeypatch.setattr(memory, "available", lambda comm: 1e3)
    database["ccp_pc_type"] = "python"
    newton = newton_of()
    assert np.array_equal(solved(newton, np.ones((40, 3)), 1e-8), np.zeros((40, 3)))
    assert newton.linear.fallbacks == 1
    newton.destroy()
