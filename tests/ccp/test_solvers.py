"""The solvers on problems whose optimum is known by construction."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from mpi4py import MPI
from problems import SELF, Graph, Known, from_graph, from_matrix, heap, matrix, random_graph

from pctt import ccp
from pctt.ccp import Limits
from pctt.ccp.registry import NEWTON

EVERY = pytest.mark.parametrize("solver", ccp.SOLVERS)
PROBLEMS = {
    "singular N": {},
    "regular N": {"bodies": 60},
    "a body with many contacts": {"hub": True, "seed": 1},
    "no friction": {"mu": 0.0},
    "mixed friction": {"mu": np.arange(40) % 4 * 0.3},
    "little friction": {"mu": 1e-3, "bodies": 60},
    "high friction": {"mu": 3.0, "bodies": 40},
    "one contact": {"contacts": 1, "bodies": 1, "seed": 3},
    "one contact without friction": {"contacts": 1, "bodies": 1, "mu": 0.0, "seed": 3},
    "one dynamic body per contact": {"one_body": 1.0, "bodies": 20},
}
# every solver with every problem, and both with both ways to give it
WAYS = ("by its map", "by its matrix")
CASES = [(solver, name, WAYS[(i + k) % 2]) for i, solver in enumerate(ccp.SOLVERS) for k, name in enumerate(PROBLEMS)]
TOL = 1e-7
# methods without acceleration or with restarts at every new face: to a hundred times that, lest it takes minutes
SLOW = ("barzilai_borwein", "spectral", "kucera", "gpminres", "gauss_seidel", "jacobi")


def tolerance(solver: str, tol: float = TOL) -> float:
    return 100 * tol if solver in SLOW else tol


def check(known: Known, problem: ccp.ConeProblem, result: ccp.Result, tol: float = TOL) -> None:
    """The result is the optimum: in the cones, and of the one objective and velocity that an optimum has."""
    assert result.converged, result.reason
    assert result.residual <= tol
    figures = ccp.measure(problem, result.impulse)
    assert figures.natural_residual <= 1.01 * tol
    assert figures.natural_residual == pytest.approx(result.residual, rel=1e-3, abs=1e-12)
    assert figures.cone_violation <= 1e-12 * figures.impulse_norm
    assert figures.objective == pytest.approx(known.objective, rel=10 * tol)
    velocity = problem.product(result.impulse) + problem.r
    assert np.linalg.norm(velocity - known.y) <= 1e3 * tol * np.linalg.norm(known.r)


@EVERY
@pytest.mark.parametrize("factor", [1e-20, 1e20])
def test_impulses_scale_with_r(solver, factor):
    """The problem has no unit of velocity: any r is as easy, and none is too small to be solved."""
    known, graph = heap(bodies=60)
    one, other = (from_graph(dataclasses.replace(known, r=size * known.r), graph) for size in (1.0, factor))
    tol = tolerance(solver, 1e-6)
    usual, found = (ccp.solve(each, type=solver, limits=Limits(tol), law=ccp.RELAXATION) for each in (one, other))
    assert found.converged, found.reason
    assert found.iterations < 1.2 * usual.iterations + 10
    velocity = other.product(found.impulse) / factor + known.r
    assert np.linalg.norm(velocity - known.y) <= 1e3 * tol * np.linalg.norm(known.r)


@pytest.mark.parametrize(("solver", "name", "way"), CASES)
def test_reaches_the_known_optimum(solver, name, way):
    known, graph = heap(**PROBLEMS[name])
    problem = from_graph(known, graph) if way == "by its map" else from_matrix(known)
    tol = tolerance(solver)
    check(known, problem, ccp.solve(problem, type=solver, limits=Limits(tol), law=ccp.RELAXATION), tol)


def test_contacts_that_share_no_body_are_solved_one_by_one():
    """Isolated contacts, each a problem of its own: also the other way round, all in one."""
    alone = [heap(seed, 1, 1) for seed in range(12)]
    graph = Graph(np.arange(13), np.arange(12), np.concatenate([g.blocks for _, g in alone]), 12)
    parts = [known for known, _ in alone]
    r, mu, g, y = (np.concatenate([getattr(k, name) for k in parts]) for name in ("r", "mu", "g", "y"))
    G = graph.dense()
    together = Known(G @ G.T, r, mu, g, y)
    for solver in ccp.SOLVERS:
        # what some processors reach of 1e-9 is 1.2e-9
        result = ccp.solve(from_graph(together, graph), type=solver, limits=Limits(1e-8, 100_000), law=ccp.RELAXATION)
        check(together, from_graph(together, graph), result, 1e-8)
        assert np.allclose(result.impulse, g, atol=1e-5)  # every N is regular: the impulses are unique


@EVERY
def test_one_contact_worked_out_by_hand(solver):
    """A unit mass falls with speed 1 on a floor and slides with speed s: it stops, or keeps s - mu.

    N = 1, r = (-1, s, 0). Sticking: g = (1, -s, 0). Sliding, the cone's surface g = g_n (1, -mu, 0) and
    y = c (mu, 1, 0): g_n = (1 + mu s) / (1 + mu^2).
    """
    mu = 0.5
    for s, expected in ((0.3, [1.0, -0.3, 0.0]), (2.0, [1.6, -0.8, 0.0])):
        problem = ccp.ConeProblem(SELF, np.array([[-1.0, s, 0.0]]), np.array([mu]), N=matrix(SELF, np.eye(3)))
        result = ccp.solve(problem, type=solver, limits=Limits(1e-9), law=ccp.RELAXATION)
        assert np.allclose(result.impulse, [expected], atol=1e-7)


@pytest.mark.parametrize("solver", ["pdip", "apgd", "gauss_seidel"])
def test_impulses_are_numbers_where_their_squares_overflow(solver):
    known, _ = heap()
    problem = from_matrix(known).with_r(1e300 * known.r)  # which the door refuses
    result = ccp.solve(problem, type=solver, limits=Limits(1e-4), law=ccp.RELAXATION)
    assert np.isfinite(result.impulse).all()


@EVERY
def test_no_contacts_are_solved(solver):
    graph = random_graph(0, 0, 3)
    problem = ccp.ConeProblem(SELF, np.zeros((0, 3)), np.zeros(0), G=graph.part(SELF))
    result = ccp.solve(problem, type=solver, law=ccp.RELAXATION)
    assert (result.converged, result.reason, result.iterations) == (True, "no contacts", 0)
    assert result.impulse.shape == (0, 3)


@EVERY
@pytest.mark.parametrize("mu", [0.0, 0.4])
def test_contacts_that_all_open_get_no_impulse(solver, mu):
    """r in the dual cones. Also with friction 0, for which any sliding is inside."""
    graph = random_graph(0, 20, 8)
    rng = np.random.default_rng(0)
    r = rng.normal(size=(20, 3))
    r[:, 0] = mu * np.hypot(r[:, 1], r[:, 2]) + rng.uniform(0.01, 1, 20)
    r[5] = [1.0, 0.0, 0.0]
    problem = ccp.ConeProblem(SELF, r, np.full(20, mu), G=graph.part(SELF))
    result = ccp.solve(problem, np.ones((20, 3)), solver, law=ccp.RELAXATION)
    assert (result.converged, result.reason) == (True, "no contact closes")
    assert np.array_equal(result.impulse, np.zeros((20, 3)))
    assert ccp.measure(problem, result.impulse).natural_residual == 0


@EVERY
def test_one_of_many_contacts_closes_a_little(solver):
    """The impulses are then a millionth of what the velocities suggest."""
    N = np.kron(np.eye(4), np.diag([1.0, 2.0, 2.0]))
    r = np.tile([1.0, 0.0, 0.0], (4, 1))
    r[2, 0] = -1e-6
    problem = ccp.ConeProblem(SELF, r, np.full(4, 0.3), N=matrix(SELF, N))
    result = ccp.solve(problem, type=solver, limits=Limits(1e-6), law=ccp.RELAXATION)
    assert result.converged
    assert result.impulse[2, 0] == pytest.approx(1e-6, rel=1e-5)


@pytest.mark.parametrize("sliding", [1.0, 1e4])
def test_sliding_without_friction_does_not_disturb_the_other_contacts(sliding):
    """No impulse answers it; neither the start nor the tolerance of a Newton step may depend on it."""
    known, graph = heap(3, mu=np.arange(40) % 4 * 0.3)
    r = known.r.copy()
    r[known.mu == 0, 1] += sliding
    y = known.y.copy()
    y[known.mu == 0, 1] += sliding
    results = []
    for one in (known, dataclasses.replace(known, r=r, y=y)):
        problem = from_graph(one, graph)
        results.append(ccp.solve(problem, limits=Limits(TOL), type="pdip", law=ccp.RELAXATION))
        check(one, problem, results[-1])
    assert results[0].iterations == results[1].iterations
    assert np.allclose(results[0].impulse, results[1].impulse, rtol=0, atol=1e-9 * sliding)


@EVERY
@pytest.mark.parametrize("seed", [0, 10])
def test_bodies_of_very_different_mass(solver, seed, database):
    """A mass ratio of 1e4, with Newton systems solved to less than the outer tolerance."""
    database["ccp_ksp_rtol"] = 1e-6
    known, graph = heap(seed, mass_ratio=1e4)
    problem = from_graph(known, graph)
    tol = tolerance(solver, 1e-5)
    check(known, problem, ccp.solve(problem, type=solver, limits=Limits(tol), law=ccp.RELAXATION), tol)


def in_units(known: Known, a: float, b: float) -> Known:
    """min 1/2 g'(aN)g + (br)'g has the solution b/a g and the velocities b y."""
    return Known(a * known.N, b * known.r, known.mu, b / a * known.g, b * known.y)


@EVERY
def test_units_that_are_powers_of_two_change_nothing_but_the_units(solver):
    """To the last bit, but where a direct solver scales its matrix: no constant of a solver has a unit."""
    (known, _), a, b = heap(2), 2.0**-30, 2.0**50
    problem = from_matrix(in_units(known, a, b))
    limits = Limits(tolerance(solver, 1e-6))
    plain = ccp.solve(from_matrix(known), type=solver, limits=limits, law=ccp.RELAXATION)
    scaled = ccp.solve(problem, type=solver, limits=limits, law=ccp.RELAXATION)
    rounding = 1e-6 if solver in ("conic", "auto") else 0.0  # auto may go over to conic
    assert scaled.history == pytest.approx(plain.history, rel=rounding, abs=0.0)
    assert np.allclose(scaled.impulse, b / a * plain.impulse, rtol=rounding, atol=rounding * b / a)


@EVERY
def test_a_start_near_the_solution_leads_to_the_same(solver):
    known, graph = heap()
    problem = from_graph(known, graph)
    tol = tolerance(solver)
    check(known, problem, ccp.solve(problem, known.g, solver, Limits(tol), law=ccp.RELAXATION), tol)
    rough = known.g * np.random.default_rng(0).uniform(0, 2, (40, 1))
    check(known, problem, ccp.solve(problem, rough, solver, Limits(tol), law=ccp.RELAXATION), tol)


# -- ends without a solution --------------------------------------------------------------------------------


@EVERY
@pytest.mark.parametrize("max_it", [0, 1, 4])
def test_giving_up_is_said_and_leaves_an_impulse_in_the_cones(solver, max_it):
    known, graph = heap()
    problem = from_graph(known, graph)
    result = ccp.solve(problem, type=solver, limits=Limits(1e-8, max_it, fallback=False), law=ccp.RELAXATION)
    assert not result.converged
    newton = ccp.SOLVERS[solver].needs == NEWTON
    assert str(max_it if newton else result.iterations) in result.reason
    assert max_it <= result.iterations <= max_it + 10 * (not newton)  # a line search repeats steps
    assert np.isfinite(result.impulse).all()
    figures = ccp.measure(problem, result.impulse)
    assert figures.cone_violation <= 1e-12 * figures.impulse_norm
    if max_it or newton:  # the others start from zero, of residual infinity
        assert result.residual == pytest.approx(figures.natural_residual, rel=1e-6)
    assert result.residual == pytest.approx(min(result.history), rel=1e-6)  # of single precision in that of apgd
    assert result.residual > 1e-8


@pytest.mark.parametrize(
    "options",
    [
        {"ccp_ksp_max_it": 1},
        {"ccp_pc_type": "python"},  # without a class: its set-up fails
        {"ccp_ksp_type": "preonly", "ccp_pc_type": "jacobi"},  # claims to have converged
    ],
    ids=str,
)
def test_systems_that_the_asked_for_method_cannot_solve_are_solved_and_counted(options, database):
    known, graph = heap()
    problem = from_graph(known, graph)
    expected = ccp.solve(problem, limits=Limits(1e-6), type="pdip", law=ccp.RELAXATION)
    for name in database.getAll():
        database.delValue(name)
    for name, value in options.items():
        database[name] = value
    result = ccp.solve(problem, limits=Limits(1e-6), type="pdip", law=ccp.RELAXATION)
    check(known, problem, result, 1e-6)
    assert 0 < result.fallbacks <= 2 * result.iterations  # a Newton step solves one system or two
    assert abs(result.iterations - expected.iterations) <= 3
    assert expected.fallbacks == 0


# -- several ranks ------------------------------------------------------------------------------------------



@pytest.mark.parallel(2, 4)
@pytest.mark.parametrize("solver", [solver for solver in ccp.SOLVERS if solver not in SLOW])
def test_the_answer_does_not_depend_on_the_ranks(solver):
    """Also with ranks that have no contact: all but the last in "uneven", one or more in "few".

    The slow methods are compared after a number of iterations in test_first_order.py.
    """
    comm, limits = MPI.COMM_WORLD, Limits(1e-6)
    last = comm.size - 1
    known, graph = heap(1, mu=np.arange(40) % 4 * 0.3)
    few, few_graph = heap(1, contacts=3, bodies=2)
    for optimum, problem in (
        (known, from_graph(known, graph, comm)),
        (known, from_matrix(known, comm)),
        (known, from_graph(known, graph, comm, [0] * last + [40], [12] * comm.size)),  # uneven
        (few, from_graph(few, few_graph, comm)),
    ):
        result = ccp.solve(problem, type=solver, limits=limits, law=ccp.RELAXATION)
        figures = ccp.measure(problem, result.impulse)
        said = (figures, result.converged, result.reason, result.iterations, result.history)
        assert comm.allgather(said) == [said] * comm.size
        assert result.converged
        assert figures.objective == pytest.approx(optimum.objective, rel=1e-5)
        assert figures.velocity_norm == pytest.approx(np.linalg.norm(optimum.y), rel=1e-3)
        assert result.fallbacks == 0
        if solver == "pdip":  # an iteration more or less is rounding
            alone = ccp.solve(from_matrix(optimum), type=solver, limits=limits, law=ccp.RELAXATION)
            assert abs(result.iterations - alone.iterations) <= 1
        problem.destroy()
