"""Which method `auto` takes, that it says so, and what it learns from one problem for the next."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from problems import SELF, from_graph, heap

from pctt import ccp
from pctt.ccp import ConeProblem, Limits, auto
from pctt.ccp.auto import Auto, Memory, Needed, Watch, conic_cost, expected, forecast


def solve(tol=1e-8, bias=1.0, max_it=-1):
    known, graph = heap(bodies=8)
    return ccp.solve(from_graph(known, graph), None, "auto", Limits(tol, max_it), Auto(bias))


def test_apgd_where_it_is_quick():
    result = solve(bias=100.0)
    assert (result.converged, result.solver, result.ksp_its) == (True, "apgd", 0)
    assert "conic would have cost about" in result.reason


def test_conic_where_apgd_is_expected_to_take_longer():
    result = solve(tol=1e-8, bias=1e-6)
    assert (result.converged, result.solver) == (True, "conic")
    assert result.reason.startswith("apgd at ")
    assert 70 <= int(result.reason.split(" after ")[1].split()[0]) <= 120  # eight looks, ten iterations each
    assert result.reason.endswith("conic: natural residual and closing work below the tolerance")


def test_back_to_apgd_where_conic_stalls(monkeypatch):
    conic = auto.conic.solve

    def stalls(problem, guess, limits, options, newton, coulomb):
        return conic(problem, guess, dataclasses.replace(limits, max_it=3), options, newton)

    monkeypatch.setattr(auto.conic, "solve", stalls)
    result = solve(tol=1e-10, bias=1e-6)
    assert (result.converged, result.solver) == (True, "apgd")
    assert "conic: 3 iterations; apgd: natural residual and closing work below" in result.reason
    assert result.ksp_its > 0


def test_the_iteration_limit_holds():
    result = solve(tol=1e-16, max_it=120)
    assert not result.converged
    assert result.iterations <= 130


# -- forecasts ---------------------------------------------------------------------------------------------

LOOKS = np.arange(10, 401, 10)


@pytest.mark.parametrize(
    ("course", "needed", "within"),
    [
        (lambda k: 0.1 * np.exp(-0.4 * np.sqrt(k)), 828, 1.02),  # what the fit assumes
        (lambda k: 0.1 * np.exp(-0.015 * k), 768, 1.4),  # geometric decay
        (lambda k: 1.0 / k**2, 1000, 2.5),  # the bound of accelerated methods
    ],
    ids=["between", "geometric", "power"],
)
def test_a_forecast_of_courses_that_are_known(course, needed, within):
    """Also where the residual goes up and down, as APGD's does."""
    assert needed / within <= forecast(LOOKS, course(LOOKS), 1e-6) <= needed * within
    noise = np.random.default_rng(0).lognormal(sigma=0.5, size=len(LOOKS))
    assert needed / (1.7 * within) <= forecast(LOOKS, course(LOOKS) * noise, 1e-6) <= needed * 1.7 * within


def test_a_forecast_where_nothing_falls_or_all_is_done():
    for course in (np.full(len(LOOKS), 1e-3), 1e-3 + 1e-6 * LOOKS):
        assert forecast(LOOKS, course, 1e-6) > 1e20  # never; rounding may see it fall by 1e-17
    assert forecast(LOOKS, np.exp(-LOOKS), 1e-6) == LOOKS[-1]


def given_up_after(course, cost, last=None, tol=1e-6, most=3000):
    """The iterations after which APGD is given up; None if it is done before."""
    watch = Watch(tol, cost, last)
    for k in range(0, most, 10):
        rho = course(k) if k else np.inf
        if rho <= tol:
            return None
        if watch(k, rho):
            return k
    raise AssertionError("no end")


def decay(needed):
    """A course that comes to 1e-6 after so many iterations."""
    return lambda k: 0.1 * np.exp(-np.log(1e5) * np.sqrt(k / needed))


def test_apgd_is_given_up_at_once_or_not_at_all():
    assert given_up_after(decay(700), 1000) is None
    assert given_up_after(decay(1500), 1000) == 100
    assert given_up_after(lambda k: 1e-3, 1000) == 100
    assert given_up_after(lambda k: max(1e-4, 0.1 * np.exp(-0.05 * k)), 1000) < 700  # falls first, then stays


def test_what_the_last_problem_needed_joins_in():
    counted, forecasted = Needed(700.0, True), Needed(700.0, False)
    assert expected(9999.0, None, 100, 1000.0) == 4100.0
    assert expected(9999.0, counted, 100, 1000.0) == 700.0
    assert expected(9999.0, counted, 690, 1000.0) == 700.0
    assert expected(2000.0, forecasted, 100, 1000.0) == pytest.approx(np.sqrt(2000.0 * 700.0))
    assert expected(2000.0, counted, 700, 1000.0) == 2000.0
    assert given_up_after(decay(2500), 1000, counted) == 700
    assert given_up_after(decay(1500), 1000, forecasted) < 700
    assert given_up_after(decay(700), 1000, Needed(2000.0, True)) == 100


def test_the_cost_grows_with_size_and_accuracy():
    assert conic_cost(40, 0, 1e-4) < conic_cost(40, 0, 1e-8) < conic_cost(9000, 0, 1e-8)
    assert conic_cost(9000, 1e-5, 1e-8) < conic_cost(9000, 0, 1e-8)
    assert conic_cost(10, 0, 1e-6) == conic_cost(300, 0, 1e-6)  # small problems have fixed costs


def test_coulombs_law_costs_conic_more_in_large_problems():
    assert auto.law_factor(100) == auto.law_factor(1000) == 2.0
    assert 2.0 <= auto.law_factor(3_800) < 3.0
    assert 6.0 < auto.law_factor(19_000) < auto.law_factor(27_000) < 12.0


# -- memory ------------------------------------------------------------------------------------------------


def test_a_sequence_of_problems_is_learnt_from(monkeypatch):
    """Steps whose right-hand sides differ little, with a clock by which the conic method is ten times as slow as the
    table says: it is taken at first, with a bias towards it, and not when that is known."""
    known, graph = heap(bodies=8)
    newton = ccp.newton_for(SELF, "auto")
    now = [0.0]
    monkeypatch.setattr(auto, "perf_counter", lambda: now[0])
    apgd, conic = auto.apgd.solve, auto.conic.solve

    def timed_apgd(*arguments):
        result = apgd(*arguments)
        now[0] += result.iterations
        return result

    def timed_conic(*arguments):
        now[0] += 10 * conic_cost(40, 0, 1e-6)
        return conic(*arguments)

    monkeypatch.setattr(auto.apgd, "solve", timed_apgd)
    monkeypatch.setattr(auto.conic, "solve", timed_conic)
    picked = []
    for step in range(4):
        r = known.r * (1 + 0.01 * step)
        problem = ConeProblem(SELF, r, known.mu, G=graph.part(SELF))
        result = ccp.solve(problem, None, "auto", Limits(1e-6), Auto(bias=0.25), newton)
        assert result.converged
        picked.append(result.solver)
    assert picked == ["conic", "apgd", "apgd", "apgd"]
    assert newton.memory.factor[-6] > 2
    assert newton.memory.needed[-6] == (result.iterations, True)
    newton.destroy()


def test_nothing_is_remembered_if_so_asked():
    known, graph = heap()
    newton = ccp.newton_for(SELF, "auto")
    newton.memory = Memory({-8: Needed(1e6, True)}, {-8: 0.25})
    for remember, solver in ((False, "apgd"), (True, "conic")):
        options = Auto(bias=4.0, remember=remember)
        result = ccp.solve(from_graph(known, graph), None, "auto", Limits(1e-8), options, newton)
        assert result.solver == solver
        assert ("the last problem 1000000" in result.reason) == remember
    newton.destroy()
