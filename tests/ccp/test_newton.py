"""Newton systems in their two forms against dense linear algebra, with hub bodies, on several ranks."""

from __future__ import annotations

import numpy as np
import pytest
from mpi4py import MPI
from problems import SELF, dense_of, from_graph, from_matrix, heap, matrix, part
from scipy.linalg import block_diag

from pctt import ccp
from pctt.ccp import delassus
from pctt.ccp.newton.forms import BodyForm, ContactForm
from pctt.ccp.newton.linear import Dense, Settings

FORMS = pytest.mark.parametrize("form", ccp.FORMS)


@pytest.fixture(autouse=True)
def few(request, monkeypatch):
    """Rows of the problems that get dense factors: none, unless a test says more."""
    monkeypatch.setattr(Settings, "few", getattr(request, "param", 0))


def definite(rng: np.random.Generator, count: int) -> np.ndarray:
    """Blocks (count, 3, 3)."""
    root = rng.standard_normal((count, 3, 3))
    return root @ root.transpose(0, 2, 1) + 0.1 * np.eye(3)


@pytest.mark.parallel(1, 2, 3, 4)
@pytest.mark.parametrize("many", [20, 1000])
def test_the_forms_agree_with_dense_algebra(many, monkeypatch):
    """Also where a body has more contacts than N is filled with."""
    monkeypatch.setattr(delassus, "HUB", many)
    comm = MPI.COMM_WORLD
    contacts, bodies = 120, 30
    rng = np.random.default_rng(0)
    # the last body, a press, has 40 % of the contacts; some contacts are of the press and a wall alone
    one = rng.integers(0, bodies - 1, contacts)
    press = rng.random(contacts) < 0.4
    other = np.where(press, bodies - 1, (one + 1 + rng.integers(0, bodies - 2, contacts)) % (bodies - 1))
    pairs = np.sort(np.stack([one, other], axis=1), axis=1)
    pieces = rng.standard_normal((contacts, 2, 3, 6))
    alone = press & (rng.random(contacts) < 0.2)
    dense = np.zeros((contacts, 3, bodies, 6))
    for c in range(contacts):
        for side in (0, 1):
            if not (alone[c] and pairs[c, side] != bodies - 1):
                dense[c, :, pairs[c, side]] += pieces[c, side]
    dense = dense.reshape(3 * contacts, 6 * bodies)
    cut, own = ([k * size // comm.size for k in range(comm.size + 1)] for size in (contacts, bodies))
    here = slice(cut[comm.rank], cut[comm.rank + 1])
    kept = ~(alone[here, None] & (pairs[here] != bodies - 1))
    indptr = np.concatenate([[0], np.cumsum(kept.sum(1))])
    G = ccp.BlockRows(indptr, pairs[here][kept], pieces[here][kept], own[comm.rank + 1] - own[comm.rank])
    mu, r, barrier = np.full(contacts, 0.5), rng.standard_normal((contacts, 3)), definite(rng, contacts)
    q, e = rng.standard_normal((contacts, 3)), 1e-2
    N = dense @ dense.T
    N += e * np.diag(np.tile([1.0, 0.0, 0.0], contacts))
    S = N + block_diag(*barrier)
    momenta = rng.standard_normal(6 * bodies)
    mine = slice(6 * own[comm.rank], 6 * own[comm.rank + 1])
    exact = np.linalg.solve(S, q.ravel() + dense @ momenta)
    for form in ccp.FORMS:
        problem = ccp.ConeProblem(comm, r[here], mu[here], G=G, compliance=e)
        newton = ccp.Newton(comm, form)
        newton.begin(problem)
        newton.update(barrier[here])
        dg, x = newton.solve(q[here], 1e-9, momenta[mine])
        dv = newton.system.momenta(x, dg, momenta[mine])
        parts = [
            np.abs(dg.ravel() - exact[3 * here.start : 3 * here.stop]).max(),
            np.abs(dv - (dense.T @ exact - momenta)[mine]).max(),
            np.abs(problem.product(q[here]).ravel() - (N @ q.ravel())[3 * here.start : 3 * here.stop]).max(),
        ]
        assert max(parts) < 1e-6, form
        assert newton.linear.fallbacks == 0
        assert problem.has_hubs == (many == 20)
        newton.destroy()


@FORMS
@pytest.mark.parametrize("solver", ["pdip", "conic"])
def test_every_form_gives_the_optimum(form, solver):
    known, graph = heap(3)
    problem = from_graph(known, graph)
    newton = ccp.newton_for(SELF, solver, form)
    result = ccp.solve(problem, type=solver, limits=ccp.Limits(1e-6), newton=newton)
    assert result.converged, result.reason
    assert np.linalg.norm(problem.product(result.impulse) + problem.r - known.y) < 1e-3 * np.linalg.norm(known.y)
    newton.destroy()


@pytest.mark.parallel(1, 2)
@FORMS
def test_a_matrix_with_entries_in_other_places_is_another_one(form):
    """The first N is destroyed: the second one may have its address."""
    comm = MPI.COMM_WORLD
    newton = ccp.newton_for(comm, "pdip", form)
    r, mu = np.tile([-1.0, 0.3, 0.2], (4, 1)), np.full(4, 0.5)
    here = part(comm, 4)
    for seed, pairs in enumerate((((0, 1), (2, 3)), ((0, 3), (1, 2)))):
        dense = 10.0 * np.eye(12)
        for i, j in pairs:
            block = np.random.default_rng(seed).standard_normal((3, 3))
            dense[3 * i : 3 * i + 3, 3 * j : 3 * j + 3] = block
            dense[3 * j : 3 * j + 3, 3 * i : 3 * i + 3] = block.T
        N = matrix(comm, dense)
        with ccp.ConeProblem(comm, r[here], mu[here], N=N) as problem:
            result = ccp.solve(problem, type="pdip", limits=ccp.Limits(1e-8), newton=newton)
            alone = ccp.solve(problem, type="pdip", limits=ccp.Limits(1e-8))
            assert result.converged
            assert result.fallbacks == alone.fallbacks == 0
            assert np.allclose(result.impulse, alone.impulse, atol=1e-7)
        N.destroy()
    newton.destroy()


@FORMS
def test_one_object_serves_one_problem_after_another(form):
    """Its matrix stays while the contacts are the same. A problem without bodies has the form of the contacts."""
    newton = ccp.Newton(SELF, form)
    known, graph = heap(3)
    rng = np.random.default_rng(0)
    barrier, q = definite(rng, 40), rng.standard_normal((40, 3))
    S = known.N + block_diag(*barrier)
    found, matrices = [], []
    for problem in (*(from_graph(known, graph) for _ in range(2)), from_matrix(known), from_graph(known, graph)):
        newton.begin(problem)
        assert isinstance(newton.system, BodyForm if form == "body" and problem.contact_map else ContactForm)
        newton.update(barrier)
        found.append(newton.solve(q, 1e-9)[0])
        matrices.append(newton.system.matrix)
        np.testing.assert_allclose(found[-1], found[0], atol=1e-7)
        if isinstance(newton.system, ContactForm):  # written anew every time, not added up
            newton.update(barrier)
            np.testing.assert_allclose(dense_of(newton.system.entries()), S, atol=1e-12)
            np.testing.assert_allclose(dense_of(problem.N), known.N, atol=1e-12)
    assert matrices[0] is matrices[1]
    newton.begin(from_graph(*heap(4)))
    assert newton.system.matrix is not matrices[-1]
    newton.destroy()


def test_few_contacts_are_never_kept_apart():
    G, some = delassus.without_hubs(SELF, from_graph(*heap(3)).contact_map.given)
    assert not some
    assert G.rows == 40


@pytest.mark.parallel(1, 2, 3)
@FORMS
def test_a_solve_begins_from_the_best_combination_of_earlier_solutions(form):
    """Where the solution is a combination of them, nothing is left to solve."""
    comm = MPI.COMM_WORLD
    known, graph = heap(3)
    here = part(comm, len(known.mu))
    problem = ccp.ConeProblem(comm, known.r[here], known.mu[here], G=graph.part(comm))
    newton = ccp.Newton(comm, form)
    newton.begin(problem)
    rng = np.random.default_rng(0)
    newton.update(definite(rng, 40)[here])
    q, other = rng.standard_normal((2, 40, 3))
    (dg, x), (_, away) = newton.solve(q[here], 1e-10), newton.solve(other[here], 1e-10)
    iterations = newton.linear.iterations
    again, _ = newton.solve(q[here], 1e-7, earlier=[2 * x + away, away - x, np.zeros_like(x), away])
    assert newton.linear.iterations == iterations
    assert np.allclose(again, dg, rtol=0, atol=1e-6)
    newton.destroy()


def test_a_tolerance_of_the_user_is_kept_where_earlier_solutions_leave_less_than_is_wanted(database):
    """The barrier changes a little; then the earlier solution is good enough for the method, but not for the user."""
    database["ksp_rtol"] = 1e-10
    known, graph = heap(3)
    problem = ccp.ConeProblem(SELF, known.r, known.mu, G=graph.part(SELF))
    newton = ccp.Newton(SELF, "contact")
    newton.begin(problem)
    rng = np.random.default_rng(0)
    barrier, q = definite(rng, 40), rng.standard_normal((40, 3))
    newton.update(barrier)
    _, x = newton.solve(q, 1.0)
    newton.update(1.01 * barrier)
    dg, _ = newton.solve(q, 1e3, earlier=[x])
    left = problem.product(dg) + (1.01 * barrier @ dg[:, :, None])[:, :, 0] - q
    assert np.linalg.norm(left) < 1e-8 * np.linalg.norm(q)
    newton.destroy()


@pytest.mark.parametrize("few", [400], indirect=True)
@pytest.mark.parametrize("symmetric", [True, False])
def test_few_contacts_get_dense_factors(symmetric):
    """Of the form of the contacts, whether bodies are known or not; options for the KSP are obeyed instead."""
    known, graph = heap(3)
    rng = np.random.default_rng(0)
    barrier, q = definite(rng, 40), rng.standard_normal((40, 3))
    if not symmetric:
        barrier[:, 0] *= 1.5
    S = known.N + block_diag(*barrier)
    newton = ccp.Newton(SELF, "body")
    for problem in (from_graph(known, graph), from_matrix(known)):
        newton.begin(problem)
        newton.update(barrier, symmetric=symmetric)
        dg, _ = newton.solve(q, 1e-12)
        assert np.linalg.norm(S @ dg.ravel() - q.ravel()) <= 2e-12
        assert newton.linear.takes_any
        assert (newton.linear.iterations <= 2, newton.linear.fallbacks) == (True, 0)
    newton.destroy()


def test_dense_factors_say_where_they_fail():
    assert Dense(-np.eye(3), True).solve(np.ones(3), 1e-9)[1] == 0
    assert Dense(np.ones((3, 3)), False).solve(np.arange(3.0), 1e-9)[1] == 0
    wrong = np.diag([1.0, 2.0, 3.0]) + np.triu(np.full((3, 3), 0.1), 1)  # its factor is that of the lower triangle
    x, count = Dense(wrong, True).solve(np.ones(3), 1e-12)
    assert count > 1
    np.testing.assert_allclose(wrong @ x, 1.0, atol=1e-11)
