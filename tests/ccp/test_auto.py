"""Which method `auto` takes, and that it says so."""

from __future__ import annotations

import dataclasses

import pytest
from problems import from_graph, heap

from pctt import ccp
from pctt.ccp import Limits, auto
from pctt.ccp.auto import Auto


def solve(tol=1e-8, bias=1.0, max_it=-1):
    known, graph = heap(bodies=8)
    return ccp.solve(from_graph(known, graph), None, "auto", Limits(tol, max_it), Auto(bias))


def test_apgd_where_it_is_quick():
    result = solve(bias=100.0)
    assert (result.converged, result.solver, result.ksp_its) == (True, "apgd", 0)


def test_conic_where_apgd_is_expected_to_take_longer():
    result = solve(tol=1e-8, bias=1e-6)
    assert (result.converged, result.solver) == (True, "conic")
    assert result.reason.startswith("apgd at ")
    assert result.reason.split(" after ")[1].startswith("1")  # the first look from the 100th iteration on
    assert result.reason.endswith("conic: natural residual below the tolerance")


def test_back_to_apgd_where_conic_stalls(monkeypatch):
    conic = auto.conic.solve

    def stalls(problem, guess, limits, options, newton):
        return conic(problem, guess, dataclasses.replace(limits, max_it=3), options, newton)

    monkeypatch.setattr(auto.conic, "solve", stalls)
    result = solve(tol=1e-10, bias=1e-6)
    assert (result.converged, result.solver) == (True, "apgd")
    assert "conic: 3 iterations; apgd: natural residual below" in result.reason
    assert result.ksp_its > 0


def test_the_iteration_limit_holds():
    result = solve(tol=1e-12, max_it=120)
    assert not result.converged
    assert result.iterations <= 130


def test_the_estimate_grows_with_size_and_accuracy():
    costs = []
    for contacts, tol, e in ((40, 1e-4, 0), (40, 1e-8, 0), (9000, 1e-8, 0), (9000, 1e-8, 1e-5)):
        known, graph = heap(bodies=8)
        problem = from_graph(known, graph)
        problem.size, problem.softness = contacts, e
        costs.append(auto.conic_cost(problem, tol))
    assert costs[0] < costs[1] < costs[2]
    assert costs[3] == pytest.approx(0.25 * costs[2])
