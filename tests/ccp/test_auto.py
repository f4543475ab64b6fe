"""Which method finds the answer: `auto`'s rule, the one fallback of `ccp.solve`, and what a result says about them."""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest
from mpi4py import MPI
from problems import SELF, from_graph, from_matrix, heap, known_optimum, part
from test_unbounded import squeezed

from pctt import ccp
from pctt.ccp import Limits, Status, auto, gathered
from pctt.ccp.auto import Auto
from pctt.ccp.interior import conic
from pctt.ccp.newton import by_elimination

DONE = "natural residual and closing work below the tolerance"


def solve(type, tol=1e-8, max_it=-1, options=None, comm=SELF, law=ccp.RELAXATION, fallback=True, contacts=40):
    known, graph = heap(contacts=contacts, bodies=contacts // 5)
    limits = Limits(tol, max_it, fallback=fallback)
    return ccp.solve(from_graph(known, graph, comm), None, type, limits, options, law=law)


def test_auto_takes_apgd_where_it_is_quick():
    result = solve("auto", 1e-3, options=Auto(elimination=100.0))
    assert (result.converged, result.solver, result.newton_its, result.ksp_its) == (True, "apgd", 0, 0)
    assert result.iterations == solve("apgd", 1e-3).iterations


@pytest.mark.parametrize(("contacts", "tol"), [(40, 1e-8), (200, 1e-5)])
@pytest.mark.parametrize("law", ccp.LAWS)
def test_auto_goes_over_to_conic_where_apgd_takes_long(law, contacts, tol, monkeypatch):
    """To the end; for Coulomb's law, where contacts are not few, to the end of its path, from where APGD goes on. All
    iterations are counted."""
    monkeypatch.setattr(by_elimination, "FEW", 100)
    options, coulomb, few = Auto(elimination=1.0, patience=0.3), law == ccp.COULOMB, contacts == 40
    result = solve("auto", tol, options=options, law=law, contacts=contacts)
    begun = options.iterations(from_graph(*heap(contacts=contacts, bodies=contacts // 5), SELF), tol, coulomb, few)
    words = [f"apgd: {begun} iterations", "conic: ", "apgd: "][: 3 if coulomb and not few else 2]
    assert result.converged, result.reason
    parts = result.reason.split("; ")
    assert [part.startswith(word) for part, word in zip(parts, words)] == [True] * len(parts)
    assert len(parts) == len(words)
    assert result.solver == ("apgd" if len(words) == 3 else "conic")
    assert 0 < result.newton_its <= 60
    assert result.iterations >= begun + result.newton_its
    assert result.ksp_its > 0


@pytest.mark.parallel(1, 2)
def test_much_friction_is_solved_in_turns():
    """Of 3 random problems of friction 3, of which the conic method alone leaves some unsolved."""
    limits, comm, alone, unsolved = Limits(5e-4, closing_work=0.5, fallback=False), MPI.COMM_WORLD, 0, 0
    for seed in (11, 24, 30):
        known, graph = heap(seed, contacts=30, bodies=9, mu=np.full(30, 3.0))
        G = graph.part(comm)
        mine = part(comm, 30)
        problem = ccp.ConeProblem(comm, known.r.reshape(-1, 3)[mine], np.full(G.rows, 3.0), G=G, compliance=0.003)
        alone += not ccp.solve(problem, type="conic", limits=limits, law=ccp.COULOMB).converged
        result = ccp.solve(problem, type="auto", limits=limits, law=ccp.COULOMB)
        unsolved += not result.converged
        assert result.iterations < 600  # on several ranks, too, whose few contacts one of them takes
    assert alone >= 1
    assert unsolved <= alone // 2


@pytest.mark.parallel(2, 3)
def test_few_contacts_of_several_ranks_are_gathered_once(monkeypatch):
    rows, made, comm = gathered.rows_in_blocks, [], MPI.COMM_WORLD
    monkeypatch.setattr(gathered, "rows_in_blocks", lambda N: made.append(N) or rows(N))
    known, graph = heap()
    problem = from_graph(known, graph, comm)
    found = gathered.whole(problem)
    given = problem.r, np.zeros_like(problem.r), Limits(1e-6, 60), conic.Conic()
    results = [found.solve(*given) for _ in range(2)]
    assert len(made) == 1
    assert [ccp.measure(problem, result.impulse).natural_residual < 1e-5 for result in results] == [True, True]
    assert gathered.whole(problem.with_r(1e200 * problem.r)) is None  # no squares of such velocities are numbers
    newton = ccp.newton_for(comm, "auto")
    tried = auto.Attempts(problem, Limits(1e-6, 60), newton, coulomb=False)
    tried.beyond(np.zeros_like(problem.r), few=True)  # the limits that APGD has met
    newton.destroy()
    assert tried.best.converged
    assert len(made) == 2


def test_cone_problems_from_the_best_impulses_solve_what_all_else_left():
    """Nine random problems of friction 3 that have a solution of the law."""
    solved = 0
    for contacts, bodies, seeds in (8, 3, (3, 75, 80, 148)), (12, 4, (12, 15, 34, 56, 141)):
        for seed in seeds:
            solved += ccp.solve(with_solution(seed, contacts, bodies, mu=3.0)).converged
    assert solved >= 6


def test_squeezed_impulses_are_no_answer_where_others_are():
    """Of 4 random problems of masses 1 to 1e8 that have a solution of the law, where an attempt grows along impulses
    that all but cancel on the bodies: the natural residual is relative to them."""
    given = [(119, 16, 7, 2.0), (1602, 15, 3, 3.0), (1664, 10, 2, 1.0), (1746, 14, 2, 2.0)]
    results = [ccp.solve(with_solution(*size, mu=mu, mass_ratio=1e8)) for *size, mu in given]
    assert sum("squeezed" in result.reason for result in results) >= 3
    assert sum(result.converged for result in results) >= 3
    assert all(result.accuracy.closing_work <= 0.05 for result in results if result.converged)


def with_solution(seed, contacts, bodies, **more):
    """A random problem that has a solution of Coulomb's law: contacts that slide do not open."""
    known, graph = heap(seed, contacts, bodies, **more)
    r, slip = known.r.copy(), known.mu * np.linalg.norm(known.y[:, 1:], axis=1)
    r[:, 0] -= np.where(known.g[:, 0] > 0.0, slip, 0.0)
    problem = ccp.ConeProblem(SELF, r, known.mu, G=graph.part(SELF))
    assert problem.natural_residual(known.g, known.y + r - known.r, coulomb=True) < 1e-9
    return problem


@pytest.mark.parametrize("few", [0, 1000])
def test_a_given_matrix_that_fills_its_factors_is_no_case_for_cone_problems(few, monkeypatch):
    """150 contacts of a full matrix without bodies, and without contacts that are few: the conic method finds the law
    by itself, in as many iterations as that of the bodies would."""
    monkeypatch.setattr(by_elimination, "FEW", few)
    rng, contacts = np.random.default_rng(5), 150
    G = rng.normal(size=(3 * contacts, 3 * contacts))
    known = known_optimum(6, G @ G.T, rng.uniform(0.0, 1.0, contacts))
    result = ccp.solve(from_matrix(known), type="conic", limits=Limits(1e-6, fallback=False))
    assert (result.converged, result.cone_problems, result.law) == (True, 1, ccp.COULOMB)
    assert result.iterations < 30
    assert ccp.measure(from_matrix(known), result.impulse).coulomb_residual < 1e-6


def test_the_iterations_of_apgd_grow_with_size_and_accuracy():
    def of(contacts, *more, **few):
        return Auto().iterations(SimpleNamespace(size=contacts, comm=SELF), *more, **few)

    assert of(40, 1e-4, False) < of(40, 1e-8, False) < of(9000, 1e-8, False) < of(9000, 1e-8, True)
    assert 8411 < of(9000, 1e-4, True) < 22_000 / 2  # a rigid bed of 80 layers: its hardest step, and half of `conic`
    assert of(10, 1e-6, False) == of(300, 1e-6, False)  # small problems have fixed costs
    assert of(10, 1e-6, False, few=True) < of(10, 1e-6, False)


@pytest.mark.parametrize("type", ccp.SOLVERS)
def test_where_a_method_fails_one_other_goes_on(type):
    """`conic` after `apgd`, else `apgd`."""
    alone = solve(type, max_it=2, fallback=False)
    assert (alone.converged, alone.asked, alone.solver) == (False, None, "apgd" if type == "auto" else type)
    result = solve(type, max_it=2)
    other = "conic" if alone.solver == "apgd" else "apgd"
    assert result.converged
    assert result.solver == other
    assert result.reason == f"{type}: {alone.reason}; {other}: {DONE}"
    assert result.asked.reason == alone.reason
    assert result.iterations > alone.iterations
    assert result.newton_its == {"conic": 2, "pdip": 2}.get(type, 0) + (other == "conic") * (result.iterations - 2)


@pytest.mark.parallel(1, 2)
def test_where_both_fail_the_better_result_is_used(monkeypatch):
    monkeypatch.setitem(ccp.SOLVERS, "apgd", dataclasses.replace(ccp.SOLVERS["apgd"], iterations=1000))
    result = solve("pdip", 1e-30, 30, comm=MPI.COMM_WORLD)
    alone = solve("pdip", 1e-30, 30, comm=MPI.COMM_WORLD, fallback=False)
    assert result.status is not Status.CONVERGED
    assert result.residual <= alone.residual
    assert result.iterations > 30
    assert result.reason.startswith(f"pdip: {alone.reason}; apgd: ")
    assert MPI.COMM_WORLD.allgather(result.reason) == [result.reason] * MPI.COMM_WORLD.size


def test_a_problem_without_solution_needs_no_other_method():
    result = ccp.solve(squeezed((1.0, 1.0), 0.0, 0.5), type="conic", limits=Limits(1e-6), law=ccp.RELAXATION)
    assert (result.status, result.asked) == (Status.UNBOUNDED, None)


@pytest.mark.parametrize("type", ["apgd", "conic"])
def test_a_result_has_the_momenta_of_its_impulses(type):
    known, graph = heap()
    problem = from_graph(known, graph)
    result = ccp.solve(problem, type=type, law=ccp.RELAXATION)
    assert np.array_equal(result.momentum, problem.momentum(result.impulse))
    assert np.allclose(result.momentum, graph.dense().T @ result.impulse.ravel())


def test_the_conic_method_begins_where_apgd_ends(monkeypatch):
    begun, ended = [], []
    method, first = auto.conic.solve, auto.apgd.solve

    def noted(problem, guess, *rest, **more):
        begun.append(guess)
        return method(problem, guess, *rest, **more)

    def ending(*given, **more):
        ended.append(first(*given, **more))
        return ended[-1]

    monkeypatch.setattr(auto.conic, "solve", noted)
    monkeypatch.setattr(auto.apgd, "solve", ending)
    known, graph = heap(3)
    result = ccp.solve(from_graph(known, graph), type="auto", limits=ccp.Limits(1e-7), law=ccp.RELAXATION)
    assert result.converged
    np.testing.assert_array_equal(begun[0], ended[0].impulse)
    assert begun[0].any()
