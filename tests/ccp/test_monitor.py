"""What a result shows when it is printed, and what is told during a solve."""

from __future__ import annotations

import numpy as np
import pytest
from mpi4py import MPI
from problems import SELF, from_graph, from_matrix, heap

from pctt import ccp
from pctt.ccp.registry import SOLVERS

LIMITS = ccp.Limits(1e-7)


@pytest.mark.parametrize("law", ccp.LAWS)
@pytest.mark.parametrize("solver", SOLVERS)
def test_every_solver_tells_its_iterations_and_residuals(solver, law):
    known, _ = heap(contacts=12, bodies=6)
    told: list[tuple[int, float]] = []
    problem = from_matrix(known)
    result = ccp.solve(problem, None, solver, LIMITS, law=law, monitor=lambda *each: told.append(each))
    iterations, residuals = zip(*told)
    assert len(told) >= 2
    assert list(iterations) == sorted(iterations)
    assert iterations[-1] <= result.iterations
    assert min(residuals) == result.residual


def test_what_goes_on_counts_on():
    known, graph = heap()
    told: list[int] = []
    limits = ccp.Limits(1e-9, max_it=5)
    problem = from_graph(known, graph)
    result = ccp.solve(problem, None, "apgd", limits, law=ccp.RELAXATION, monitor=lambda k, _: told.append(k))
    assert result.solver == "conic"
    assert told == sorted(told)
    assert told[-1] == result.iterations > 10


@pytest.mark.parallel(2)
def test_all_ranks_are_told_the_same():
    comm = MPI.COMM_WORLD
    known, graph = heap()
    told: list[tuple[int, float]] = []
    problem = from_graph(known, graph, comm)
    limits = ccp.Limits(1e-6, aim=0.01)  # few contacts are gathered on the first rank for it
    ccp.solve(problem, None, "auto", limits, monitor=lambda *each: told.append(each))
    assert told
    assert all(each == told for each in comm.allgather(told))


def test_the_monitor_prints_a_line_for_each_look(capfd):
    known, _ = heap(contacts=12, bodies=6)
    ccp.solve(from_matrix(known), None, "conic", ccp.Limits(1e-7, monitor=True), law=ccp.RELAXATION)
    lines = capfd.readouterr().out.splitlines()
    assert [int(line.split()[0]) for line in lines] == list(range(len(lines)))
    assert all(line.split()[1] == "residual" for line in lines)
    assert float(lines[-1].split()[2]) <= 1e-7


@pytest.mark.parametrize("solver", ["conic", "pdip", "apgd"])
def test_a_result_is_a_small_table_whose_counts_are_those_of_the_solution(solver):
    known, _ = heap(contacts=300, bodies=400)
    result = ccp.solve(from_matrix(known), None, solver, LIMITS, law=ccp.RELAXATION)
    g, y = known.g, known.y
    opened, slides = g[:, 0] == 0, (g[:, 0] > 0) & (np.hypot(y[:, 1], y[:, 2]) > 0)
    counted = (opened.sum(), slides.sum(), 300 - opened.sum() - slides.sum())
    assert result.counts == counted
    text = str(result)
    assert len(text.splitlines()) == 5
    assert "status      converged" in text
    assert f"solver      {solver}, relaxation of Coulomb's law" in text
    assert f"contacts    300 ({counted[0]} open, {counted[1]} sliding, {counted[2]} sticking)" in text
    assert max(map(len, text.splitlines())) <= 120


def test_contacts_of_all_ranks_are_counted():
    still = ccp.ConeProblem(SELF, np.array([[-1.0, 0.1, 0], [-1.0, 3.0, 0], [1.0, 0, 0]]), np.ones(3), N=np.eye(9))
    result = ccp.solve(still)
    assert result.counts == (1, 1, 1)
    assert result.states.tolist() == [2, 1, 0]
