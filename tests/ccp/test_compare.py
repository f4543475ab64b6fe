"""Preconditioners compared on the same Newton systems: records, failures, names, options."""

from __future__ import annotations

import json
import re
import time

import numpy as np
import pytest
from mpi4py import MPI
from problems import SELF, from_graph, heap, matrix

from pctt import ccp, log
from pctt.ccp import Comparison, Limits
from pctt.ccp.newton.krylov import Krylov
from pctt.options import OptionError
from pctt.run.report import compare_table

FIELDS = {"type", "what", "systems", "converged", "ksp_its_mean", "ksp_its_max", "setup_s", "solve_s", "entries_s"}
FIELDS |= {"true_residual_max", "excess_max"}


def system(size: int = 40):
    """A Newton system like those of a heap: its dense matrix, Mat, right-hand side, room for the solution."""
    dense = heap(contacts=size, bodies=3 * size // 4)[0].N + 0.05 * np.eye(3 * size)
    S = matrix(SELF, dense)
    x, b = S.createVecs()
    b.array[:] = np.random.default_rng(0).normal(size=3 * size)
    return dense, S, b, x


def by(comparison: Comparison) -> ccp.Newton:
    return ccp.newton_for(SELF, "pdip", compare=comparison)


def compared(names: list[str], **keywords) -> Comparison:
    comparison = Comparison(SELF, names)
    _, S, b, x = system()
    comparison.run(S, b, x, **{"rtol": 1e-6, **keywords})
    comparison.destroy()
    return comparison


def test_every_preconditioner_solves_every_system():
    names = ["none", "jacobi", "pbjacobi", "ilu", "ilu-shifted", "icc-shifted", "sor", "cholesky"]
    comparison = Comparison(SELF, names)
    known, graph = heap()
    result = ccp.solve(
        from_graph(known, graph), limits=Limits(1e-5), newton=by(comparison), type="pdip", law=ccp.RELAXATION
    )
    assert result.converged
    summary = comparison.summary()
    assert list(summary) == names
    for name, solves in comparison.solves.items():
        figures = summary[name]
        assert set(figures) == FIELDS
        assert figures["systems"] == len(solves) >= result.iterations  # one system or more in an iteration
        assert figures["ksp_its_mean"] == pytest.approx(np.mean([s.iterations for s in solves]))
        assert figures["excess_max"] == max(s.true_residual / s.asked for s in solves)
        assert all(s.converged <= (s.true_residual <= 2 * s.asked) for s in solves)
        assert figures["setup_s"] == pytest.approx(sum(s.setup_s for s in solves))
    taken = comparison.take_solves()
    assert [len(taken[name]) for name in names] == [summary[name]["systems"] for name in names]
    assert not any(comparison.take_solves().values())
    assert summary["cholesky"]["converged"] == summary["cholesky"]["systems"]
    assert summary["cholesky"]["ksp_its_max"] == 1
    assert summary["none"]["ksp_its_mean"] > summary["pbjacobi"]["ksp_its_mean"] > 1
    json.dumps(summary, allow_nan=False)


def test_records_are_of_the_same_systems_as_if_each_were_alone():
    """One preconditioner leaves nothing behind that the next one sees."""
    dense, S, b, x = system()
    names = ["jacobi", "pbjacobi", "icc"]
    comparison = Comparison(SELF, names)
    comparison.run(S, b, x, 1e-6)
    for name in names:
        alone = Krylov(SELF, "alone_" + name, {"pc_type": name}, 1e-6).solve(S, b, x)
        assert comparison.solves[name][0].iterations == alone.iterations
        assert comparison.solves[name][0].true_residual == pytest.approx(alone.true_residual, rel=1e-3)
        assert np.linalg.norm(dense @ x.array - b.array) <= 2e-6 * np.linalg.norm(b.array)


@pytest.mark.parametrize("failing", ["python", "shell", "galerkin", "composite"])
def test_what_fails_is_recorded_as_failed(failing):
    """Not raised: these have no way to be set up by a name alone."""
    summary = compared(["jacobi", failing, "pbjacobi"]).summary()
    assert summary[failing]["systems"] == 1
    assert summary[failing]["converged"] == 0
    assert summary[failing]["true_residual_max"] == 1.0
    assert summary["jacobi"]["converged"] == summary["pbjacobi"]["converged"] == 1


def test_the_first_that_converged_is_used(database):
    """In the order of the names, whatever the residuals; and not one that gave up at a smaller residual."""
    database["ccp_compare_sor_ksp_rtol"] = 1e-12
    database["ccp_compare_jacobi_ksp_max_it"] = 1
    database["ccp_compare_icc_ksp_rtol"] = 1e-16
    database["ccp_compare_icc_ksp_max_it"] = 30
    dense, S, b, x = system()

    def used(*names: str) -> str:
        comparison = Comparison(SELF, list(names))
        done = comparison.run(S, b, x, 1e-4)
        residual = np.linalg.norm(dense @ x.array - b.array) / np.linalg.norm(b.array)
        assert done.true_residual == pytest.approx(residual, rel=1e-2)
        assert all(len(solves) == 1 for solves in comparison.solves.values())
        given_up = [solves[0] for solves in comparison.solves.values() if not solves[0].converged]
        assert names[0] != "icc" or given_up[0].true_residual < residual
        (name,) = [n for n in names if comparison.solves[n][0] is done]
        return name

    assert used("pbjacobi", "sor") == "pbjacobi"
    assert used("sor", "pbjacobi") == "sor"
    assert used("python", "jacobi", "pbjacobi", "sor") == "pbjacobi"
    assert used("icc", "pbjacobi") == "pbjacobi"


def test_where_none_converged_the_best_is_used_and_the_step_is_saved(database):
    database["ccp_ksp_max_it"] = 3
    database["ccp_compare_jacobi_ksp_max_it"] = 1
    dense, S, b, x = system()
    comparison = Comparison(SELF, ["jacobi", "python", "icc", "none"])
    done = comparison.run(S, b, x, 1e-12)
    assert not done.converged
    best = min(solves[0].true_residual for solves in comparison.solves.values())
    assert done.true_residual == best == pytest.approx(np.linalg.norm(dense @ x.array - b.array) / b.norm())
    known, graph = heap()
    comparison = Comparison(SELF, ["none"])
    result = ccp.solve(
        from_graph(known, graph), limits=Limits(1e-5), newton=by(comparison), type="pdip", law=ccp.RELAXATION
    )
    assert result.converged
    assert 0 < result.fallbacks <= comparison.summary()["none"]["systems"]
    figures = ccp.measure(from_graph(known, graph), result.impulse)
    assert figures.objective == pytest.approx(known.objective, rel=1e-4)


def test_the_seconds_of_all_but_the_chosen_are_apart():
    """pbjacobi, the first, gives the answers: what `none` and `jacobi` take is no part of the solve."""
    known, graph = heap()
    comparison = Comparison(SELF, ["pbjacobi", "none", "jacobi"])
    log.take_seconds(("solve", "compare"))
    start = time.perf_counter()
    with log.phase("solve"):
        result = ccp.solve(
            from_graph(known, graph), limits=Limits(1e-5), newton=by(comparison), type="pdip", law=ccp.RELAXATION
        )
    whole = time.perf_counter() - start
    assert result.converged
    own, *others = (sum(s.setup_s + s.solve_s for s in solves) for solves in comparison.solves.values())
    assert all(solve.converged for solve in comparison.solves["pbjacobi"])
    seconds = log.take_seconds(("solve", "compare"))
    assert seconds["compare"] >= sum(others) > 0
    assert own <= seconds["solve"] <= whole - sum(others)


def test_the_count_goes_on_over_several_problems():
    every, second = (Comparison(SELF, ["pbjacobi", "icc", "cholesky"], k) for k in (1, 2))
    for contacts in (5, 30, 12):  # of other structures: nothing of the last may be left
        known, graph = heap(contacts, contacts)
        problem = from_graph(known, graph)
        for comparison in (every, second):
            assert ccp.solve(
                problem, limits=Limits(1e-4), newton=by(comparison), type="pdip", law=ccp.RELAXATION
            ).converged
        problem.destroy()
    systems = every.summary()["icc"]["systems"]
    assert second.summary()["icc"]["systems"] == -(-systems // 2)
    assert second.summary()["cholesky"]["converged"] == -(-systems // 2)


@pytest.mark.parametrize(
    ("entries", "words"),
    [
        ("jacobi,jacobi", "the label jacobi is there twice; allowed is LABEL:jacobi"),
        ("a:jacobi,a:ilu", "the label a is there twice"),
        ("tt,tt:ilu", "the label tt is there twice"),
        (":jacobi", "allowed is TYPE or LABEL:TYPE"),
        ("a b:jacobi", "letters, digits, _ and -"),
        ("a:b:jacobi", "letters, digits, _ and -"),
        ("é:jacobi", "letters, digits, _ and -"),
        ("a:nosuch", "-compare nosuch: PETSc has no such preconditioner.*ilu-shifted"),
        ("none,ILU", "-compare ILU: PETSc has no such preconditioner"),
        ("a:", "PETSc has no such preconditioner"),
        ("a_b:jacobi,a:jacobi", r"-compare a_b:jacobi,a:jacobi: -compare_a_b_... would be an option of a too"),
    ],
)
def test_bad_labels_are_refused(entries, words):
    with pytest.raises(OptionError, match=words):
        Comparison(SELF, entries.split(","))


def test_a_type_stands_in_the_table_several_times_with_options_of_its_own(database):
    database["ccp_compare_ten_pc_tt_rank"] = "10"
    database["ccp_compare_f-2_pc_factor_levels"] = "2"
    entries = ["one:tt", "ten:tt", "ilu", "f-2:ilu"]
    comparison = Comparison(SELF, entries)
    _, S, b, x = system()
    comparison.run(S, b, x, 1e-6)
    summary = comparison.summary()
    assert [(name, figures["type"]) for name, figures in summary.items()] == [
        ("one", "tt"), ("ten", "tt"), ("ilu", "ilu"), ("f-2", "ilu"),
    ]  # fmt: skip
    what = [figures["what"] for figures in summary.values()]
    assert what[0] == "rank 1: block Jacobi"
    assert re.fullmatch("rank ([2-9]|10)", what[1])
    assert what[2:] == ["", ""]
    assert summary["f-2"]["ksp_its_mean"] < summary["ilu"]["ksp_its_mean"]
    assert summary["ten"]["ksp_its_mean"] != summary["one"]["ksp_its_mean"]
    rows = compare_table(summary).splitlines()
    assert rows[0].endswith("what it was")
    assert [row.split()[0] for row in rows[2:]] == entries
    assert rows[2].endswith("  rank 1: block Jacobi")
    assert rows[3].endswith(f"  {what[1]}")


def test_own_options_act_on_one_and_those_without_prefix_on_all(database):
    def first(names: list[str], rtol: float = 1e-6) -> list:
        return [solves[0] for solves in compared(names, rtol=rtol).solves.values()]

    plain = first(["ilu", "icc"])
    database["ccp_compare_ilu_pc_factor_levels"] = 1
    filled = first(["ilu", "icc"])
    assert filled[0].iterations < plain[0].iterations
    assert filled[1].iterations == plain[1].iterations
    database["ccp_ksp_type"] = "gmres"
    database["ccp_ksp_rtol"] = 1e-10
    assert all(done.converged and done.true_residual < 2e-10 for done in first(["jacobi", "icc"], 1e-2))
    database["ccp_ksp_max_it"] = 4
    assert [(done.iterations, done.converged) for done in first(["none", "jacobi"])] == [(4, False)] * 2


@pytest.mark.parallel(2)
def test_on_two_ranks_factorisations_work_within_each_rank_and_say_so(database):
    comm = MPI.COMM_WORLD
    comparison = Comparison(comm, ["ilu", "ilu-shifted", "icc", "own:sor", "pbjacobi", "python"])
    known, graph = heap(bodies=30)
    newton = ccp.newton_for(comm, "pdip", compare=comparison)
    result = ccp.solve(
        from_graph(known, graph, comm), limits=Limits(1e-5), newton=newton, type="pdip", law=ccp.RELAXATION
    )
    with pytest.raises(OptionError):
        Comparison(comm, ["nonsense"])
    assert result.converged
    assert {name: figures["what"] for name, figures in comparison.summary().items()} == {
        "ilu": "within each rank",
        "ilu-shifted": "within each rank",
        "icc": "within each rank",
        "own": "within each rank",
        "pbjacobi": "",
        "python": "",
    }
    counts = {n: (s["systems"], s["converged"], s["ksp_its_mean"]) for n, s in comparison.summary().items()}
    assert comm.allgather(counts) == [counts] * comm.size
    (systems,) = {systems for systems, _, _ in counts.values()}
    assert counts["ilu"][1] == counts["ilu-shifted"][1] == counts["pbjacobi"][1] == systems >= result.iterations
    assert counts["python"][1] == 0
    assert max(counts["ilu"][2], counts["ilu-shifted"][2]) < counts["pbjacobi"][2]
