"""The options of a program that uses the library are those of its own KSPs."""

from __future__ import annotations

import numpy as np
import pytest
from mpi4py import MPI
from petsc4py import PETSc
from problems import from_graph, heap

import pctt
from pctt import ccp
from pctt.ccp import Comparison, Limits
from pctt.ccp.newton.krylov import Krylov
from pctt.ksp_options import unused
from pctt.scenes import Mixer

SELF = MPI.COMM_SELF
OF_HOST = {
    "ksp_rtol": "0.5", "ksp_type": "richardson", "pc_type": "lu", "ksp_max_it": "1", "ksp_monitor": None,
    "pc_factor_mat_solver_type": "none_such", "pc_python_type": "none.such", "sub_pc_type": "none_such",
    "fallback_ksp_type": "preonly", "compare_ilu_ksp_max_it": "1", "mat_mumps_icntl_14": "1",
}  # fmt: skip


def set_all(database: PETSc.Options) -> None:
    for name, value in OF_HOST.items():
        database[name] = value


@pytest.mark.parametrize("given_by_matrix", [False, True])
@pytest.mark.parametrize("type", ["conic", "pdip"])
def test_a_cone_problem_is_solved_as_without_them(type, given_by_matrix, database, capfd, monkeypatch):
    monkeypatch.setattr("pctt.ccp.newton.by_elimination.FEW", 0)  # else conic has no KSP here
    known, graph = heap()
    problem = from_graph(known, graph)
    problem = problem.by_matrix(problem.operator) if given_by_matrix and hasattr(problem.operator, "local") else problem
    expected = ccp.solve(problem, type=type, limits=Limits(1e-6, fallback=False), law=ccp.RELAXATION)
    set_all(database)
    result = ccp.solve(problem, type=type, limits=Limits(1e-6, fallback=False), law=ccp.RELAXATION)
    assert result.converged
    assert (result.iterations, result.ksp_its) == (expected.iterations, expected.ksp_its)
    assert result.ksp_its > 0
    np.testing.assert_allclose(result.impulse, expected.impulse, rtol=1e-9, atol=1e-12)
    assert "Residual" not in capfd.readouterr().out
    assert set(unused(OF_HOST)) == set(OF_HOST)  # they are still to be read by their owner


def test_compared_preconditioners_are_as_without_them(database):
    known, graph = heap()
    problem = from_graph(known, graph)

    def counts() -> list[int]:
        comparison = Comparison(SELF, ["ilu", "cholesky", "pbjacobi"])
        newton = ccp.newton_for(SELF, "pdip", compare=comparison)
        ccp.solve(problem, type="pdip", limits=Limits(1e-6), newton=newton, law=ccp.RELAXATION)
        newton.destroy()
        return [solve.iterations for solves in comparison.solves.values() for solve in solves]

    expected = counts()
    set_all(database)
    assert counts() == expected
    assert len(expected) > 20


def test_a_simulation_is_as_without_them(database):
    def steps() -> tuple[list[int], np.ndarray]:
        figures: list[int] = []
        with pctt.Simulation(Mixer(n=1, margin=0.7), solver="pdip", comm=SELF, dt=0.1) as sim:
            sim.run(steps=4, call=lambda sim: figures.append(sim.figures["ksp_its"]))
            return figures, sim.velocities

    expected = steps()
    set_all(database)
    found = steps()
    assert found[0] == expected[0]
    assert sum(found[0]) > 0
    np.testing.assert_allclose(found[1], expected[1], rtol=1e-9, atol=1e-12)


class Own:
    """A python PC that tells of itself, without a class of the project's above it."""

    name = "tests.Own"

    def apply(self, pc: PETSc.PC, x: PETSc.Vec, y: PETSc.Vec) -> None:
        x.copy(y)

    def report(self) -> list[str]:
        return ["does nothing"]

    def what(self) -> str:
        return "the identity"


class Silent:
    def apply(self, pc: PETSc.PC, x: PETSc.Vec, y: PETSc.Vec) -> None:
        x.copy(y)


def test_any_preconditioner_that_tells_of_itself_is_heard(database):
    database["ccp_pc_type"], database["ccp_pc_python_type"] = "python", f"{__name__}.Own"
    told = Krylov(SELF)
    assert told.words() == "BiCGStab (right), tests.Own"
    assert (told.what(), told.report()) == ("the identity", ["does nothing"])
    database["ccp_pc_python_type"] = f"{__name__}.Silent"
    silent = Krylov(SELF)
    assert (silent.words(), silent.what(), silent.report()) == (f"BiCGStab (right), {__name__}.Silent", "", [])
    told.destroy()
    silent.destroy()
