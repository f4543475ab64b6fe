"""Newton systems in their forms against dense linear algebra, with hub bodies, on several ranks."""

from __future__ import annotations

import dataclasses
import traceback
from pathlib import Path

import numpy as np
import pytest
import scipy.sparse as sp
from mpi4py import MPI
from problems import SELF, dense_of, from_graph, from_matrix, heap, matrix, part, random_graph
from scipy.linalg import block_diag

from pctt import ccp, memory
from pctt.blocks import Shell
from pctt.ccp import delassus, newton_for
from pctt.ccp.interior.pdip import PDIP
from pctt.ccp.newton import by_elimination, elimination
from pctt.ccp.newton import factor as factors
from pctt.ccp.newton.elimination import Factors, ordered
from pctt.ccp.newton.forms import BodyForm, ContactForm
from pctt.ccp.newton.kkt import KKT

FORMS = pytest.mark.parametrize("form", ["contact", "body"])  # those that take any barrier blocks


@pytest.fixture(autouse=True)
def few(request, monkeypatch):
    """Contacts of the problems that get factors by blocks: none, unless a test says more."""
    monkeypatch.setattr(by_elimination, "FEW", getattr(request, "param", 0))


def barrier_and_side(count: int = 40) -> tuple[np.ndarray, np.ndarray]:
    """Definite blocks B (count, 3, 3) and a right-hand side q (count, 3)."""
    rng = np.random.default_rng(0)
    root = rng.standard_normal((count, 3, 3))
    return root @ root.transpose(0, 2, 1) + 0.1 * np.eye(3), rng.standard_normal((count, 3))


@pytest.mark.parallel(1, 2, 3, 4)
@FORMS
@pytest.mark.parametrize("many", [20, 1000])
def test_the_forms_agree_with_dense_algebra(form, many, monkeypatch):
    """Also where a body, here one that half of the contacts touch, has more contacts than N is filled with."""
    monkeypatch.setattr(delassus, "DENSE", many)
    comm, contacts, bodies, e = MPI.COMM_WORLD, 120, 30, 1e-2
    graph = random_graph(0, contacts, bodies, hub=True)
    G, here, own = graph.dense(), part(comm, contacts), part(comm, bodies)
    barrier, q = barrier_and_side(contacts)
    momenta = np.random.default_rng(1).standard_normal((bodies, 6))
    N = G @ G.T + e * np.diag(np.tile([1.0, 0.0, 0.0], contacts))
    exact = np.linalg.solve(N + block_diag(*barrier), q.ravel() + G @ momenta.ravel())
    problem = ccp.ConeProblem(comm, q[here], np.full(contacts, 0.5)[here], G=graph.part(comm), compliance=e)
    newton = ccp.Newton(comm, form)
    newton.begin(problem)
    newton.update(barrier[here])
    r_v = momenta[own].ravel()
    dg, x = newton.solve(q[here], 1e-9, r_v)
    dv = newton.system.momenta(x, dg, r_v).reshape(-1, 6)
    np.testing.assert_allclose(dg, exact.reshape(-1, 3)[here], rtol=0, atol=1e-6)
    np.testing.assert_allclose(dv, ((G.T @ exact).reshape(-1, 6) - momenta)[own], rtol=0, atol=1e-6)
    np.testing.assert_allclose(problem.product(q[here]), (N @ q.ravel()).reshape(-1, 3)[here], rtol=0, atol=1e-6)
    assert newton.linear.fallbacks == 0
    assert problem.has_dense_columns == (many == 20)
    newton.destroy()


@pytest.mark.parametrize(
    ("form", "solver"), [*((form, "pdip") for form in ccp.FORMS), ("body", "conic"), ("contact", "conic")]
)
def test_every_form_gives_the_optimum(form, solver):
    known, graph = heap(3)
    problem = from_graph(known, graph)
    newton = ccp.newton_for(SELF, solver, form)
    result = ccp.solve(problem, type=solver, limits=ccp.Limits(1e-6), newton=newton, law=ccp.RELAXATION)
    assert result.converged, result.reason
    assert np.linalg.norm(problem.product(result.impulse) + problem.r - known.y) < 1e-3 * np.linalg.norm(known.y)
    newton.destroy()


@pytest.mark.parallel(1, 2)
@pytest.mark.parametrize("form", ccp.FORMS)
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
            result = ccp.solve(problem, type="pdip", limits=ccp.Limits(1e-8), newton=newton, law=ccp.RELAXATION)
            alone = ccp.solve(problem, type="pdip", limits=ccp.Limits(1e-8), law=ccp.RELAXATION)
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
    barrier, q = barrier_and_side()
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


# -- with multipliers ----------------------------------------------------------------------------------------


def conditions(contacts: int, each: int, seed: int = 0) -> KKT:
    """Of so many constraints per contact, with values and multipliers over six orders of magnitude."""
    rng = np.random.default_rng(seed)
    f, lam = (10.0 ** rng.uniform(-3, 3, (contacts, each)) for _ in range(2))
    M = np.zeros((contacts, 3, 3))
    M[:, [0, 1, 2], [0, 1, 2]] = rng.uniform(0.1, 2.0, (contacts, 3))
    return KKT(M, rng.standard_normal((contacts, each, 3)), -f, lam)


def dense_kkt(N: np.ndarray, kkt: KKT) -> np.ndarray:
    """[N + M, B; C, E] of the paper."""
    B = block_diag(*kkt.df).T
    C = -kkt.lam.reshape(-1, 1) * B.T
    return np.block([[N + block_diag(*kkt.M), B], [C, np.diag(-kkt.f.ravel())]])


@pytest.mark.parallel(1, 2, 3)
@pytest.mark.parametrize("form", ccp.FORMS)
@pytest.mark.parametrize(("each", "many"), [(1, 1000), (2, 1000), (2, 20)])
def test_all_forms_give_the_step_of_the_matrix_with_multipliers(form, each, many, monkeypatch, database):
    """Also where a body has more contacts than N is filled with, and for a second problem of the same contacts."""
    monkeypatch.setattr(delassus, "DENSE", many)
    database["ksp_max_it"] = 5000
    comm, contacts, bodies, e = MPI.COMM_WORLD, 60, 20, 1e-2
    graph, here = random_graph(0, contacts, bodies, hub=True), part(comm, contacts)
    newton = ccp.Newton(comm, form)
    for seed in range(2):
        graph = dataclasses.replace(graph, blocks=(1 + seed) * graph.blocks)
        G, rows = graph.dense(), graph.part(comm)
        kkt, rng = conditions(contacts, each, seed), np.random.default_rng(5)
        r_g, r_lam = rng.standard_normal((contacts, 3)), rng.standard_normal((contacts, each))
        N = G @ G.T + e * np.diag(np.tile([1.0, 0.0, 0.0], contacts))
        exact = np.linalg.solve(dense_kkt(N, kkt), np.concatenate([r_g.ravel(), r_lam.ravel()]))
        newton.begin(ccp.ConeProblem(comm, r_g[here], np.full(contacts, 0.5)[here], G=rows, compliance=e))
        newton.linearise(KKT(*(part_[here] for part_ in kkt)))
        dg, dlam, _ = newton.step(r_g[here], r_lam[here], 1e-11 * np.linalg.norm(kkt.reduced(r_g, r_lam)))
        right_g, right_lam = exact[: 3 * contacts].reshape(-1, 3), exact[3 * contacts :].reshape(-1, each)
        np.testing.assert_allclose(dg, right_g[here], rtol=0, atol=1e-7 * np.abs(right_g).max())
        np.testing.assert_allclose(dlam, right_lam[here], rtol=1e-5, atol=1e-7 * np.abs(right_lam).max())
    newton.destroy()


@pytest.mark.parallel(1, 2)
def test_the_matrix_with_multipliers_has_entries_and_a_transposed_product():
    comm, contacts = MPI.COMM_WORLD, 40
    known, graph = heap(3)
    here, kkt = part(comm, contacts), conditions(contacts, 2)
    newton = ccp.Newton(comm, "kkt")
    rng = np.random.default_rng(0)
    for factor in (1.0, 3.0):  # a second problem of the same contacts
        rows = dataclasses.replace(graph, blocks=factor * graph.blocks).part(comm)
        newton.begin(ccp.ConeProblem(comm, known.r[here], known.mu[here], G=rows))
        newton.linearise(KKT(*(part_[here] for part_ in kkt)))
        A = newton.system.matrix
        assert A.getSize() == (5 * contacts, 5 * contacts)
        entries = newton.system.entries()
        assert entries.getType() in ("seqaij", "mpiaij")
        (x, y), u = A.createVecs(), A.createVecLeft()
        x.array[:] = rng.standard_normal(x.local_size)
        for one, other in ((A.mult, entries.mult), (A.multTranspose, entries.multTranspose)):
            one(x, y), other(x, u)
            np.testing.assert_allclose(y.array, u.array, rtol=0, atol=1e-9 * y.norm())
        # the paper's matrix, after the scaling of the rows and columns of multipliers
        order = np.concatenate([3 * np.arange(contacts)[:, None] + [0, 1, 2],
                                3 * contacts + 2 * np.arange(contacts)[:, None] + [0, 1]], axis=1).ravel()  # fmt: skip
        size = np.linalg.norm(kkt.df, axis=2)
        row, column = np.ones((contacts, 5)), np.ones((contacts, 5))
        row[:, 3:], column[:, 3:] = size / -kkt.f, 1 / size
        paper = dense_kkt(factor**2 * known.N, kkt)[np.ix_(order, order)] * column.ravel()
        whole = np.concatenate(comm.allgather(x.array.copy()))
        A.mult(x, y)
        expected = (row.ravel() * (paper @ whole)).reshape(contacts, 5)[here].ravel()
        np.testing.assert_allclose(y.array, expected, rtol=1e-9, atol=1e-9 * y.norm())
    newton.destroy()


def test_methods_without_multipliers_refuse_them_as_unknowns():
    for solver in ("conic", "auto", "apgd"):
        with pytest.raises(ValueError, match=f"the Newton form 'kkt': {solver} .* allowed .* pdip"):
            ccp.newton_for(SELF, solver, "kkt")
        newton = ccp.Newton(SELF, "kkt")
        with pytest.raises(ValueError, match="the Newton form 'kkt'"):
            ccp.solve(from_matrix(heap()[0]), type=solver, newton=newton, law=ccp.RELAXATION)
        newton.destroy()


def test_few_contacts_are_never_kept_apart():
    G, some = delassus.without_dense_columns(SELF, from_graph(*heap(3)).contact_map.source)
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
    barrier, q = barrier_and_side()
    other = q[::-1]
    newton.update(barrier[here])
    (dg, x), (_, away) = newton.solve(q[here], 1e-10), newton.solve(other[here], 1e-10)
    iterations = newton.linear.iterations
    again, _ = newton.solve(q[here], 1e-7, earlier=[2 * x + away, away - x, np.zeros_like(x), away])
    assert newton.linear.iterations == iterations
    assert np.allclose(again, dg, rtol=0, atol=1e-6)
    newton.destroy()


def test_a_tolerance_of_the_user_is_kept_where_earlier_solutions_leave_less_than_is_wanted(database):
    """The barrier changes a little; then the earlier solution is good enough for the method, but not for the user."""
    database["ccp_ksp_rtol"] = 1e-10
    known, graph = heap(3)
    problem = ccp.ConeProblem(SELF, known.r, known.mu, G=graph.part(SELF))
    newton = ccp.Newton(SELF, "contact")
    newton.begin(problem)
    barrier, q = barrier_and_side()
    newton.update(barrier)
    _, x = newton.solve(q, 1.0)
    newton.update(1.01 * barrier)
    dg, _ = newton.solve(q, 1e3, earlier=[x])
    left = problem.product(dg) + (1.01 * barrier @ dg[:, :, None])[:, :, 0] - q
    assert np.linalg.norm(left) < 1e-8 * np.linalg.norm(q)
    newton.destroy()


@pytest.mark.parametrize("few", [400], indirect=True)
@pytest.mark.parametrize("symmetric", [True, False])
def test_few_contacts_get_factors_by_blocks(symmetric):
    """Of the form of the contacts, whether bodies are known or not; options for the KSP are obeyed instead."""
    known, graph = heap(3)
    barrier, q = barrier_and_side()
    if not symmetric:
        barrier[:, 0] *= 1.5
    S = known.N + block_diag(*barrier)
    newton = ccp.Newton(SELF, "body")
    for problem in (from_graph(known, graph), from_matrix(known)):
        assert newton.begin(problem).contact_map is None
        newton.update(barrier, symmetric=symmetric)
        dg, _ = newton.solve(q, 1e-12)
        assert np.linalg.norm(S @ dg.ravel() - q.ravel()) <= 2e-12
        assert newton.linear.takes_unsymmetric
        assert "_mat" not in vars(newton.system)  # no object of PETSc
        assert (newton.linear.iterations <= 2, newton.linear.fallbacks) == (True, 0)
    newton.destroy()


@pytest.mark.parametrize("few", [400], indirect=True)
def test_contacts_that_would_fill_the_factors_are_not_few(monkeypatch):
    """The same where a body touches too many of them for their matrix to be made."""
    assert ccp.Newton(SELF, "body").has_elimination(from_graph(*heap(3, hub=True)))
    monkeypatch.setattr(elimination, "LEAST", 1)
    for pairs, rest in ((10, 40), (300, 40), (10**6, 5)):
        newton = ccp.Newton(SELF, "body")  # it keeps the order of contacts between the same bodies
        monkeypatch.setattr(by_elimination, "PAIRS", pairs)
        monkeypatch.setattr(by_elimination, "REST", rest)
        problem = from_graph(*heap(3, hub=True))
        assert not newton.has_elimination(problem)
        assert newton.begin(problem) is problem
        newton.destroy()


@pytest.mark.parametrize("few", [400], indirect=True)
def test_an_elimination_may_be_dear_where_no_bodies_are_known(monkeypatch):
    """Then no other factors are cheaper, but APGD may be."""
    monkeypatch.setattr(elimination, "LEAST", 1)
    monkeypatch.setattr(by_elimination, "PAIRS", 20)
    newton, problem = ccp.Newton(SELF, "body"), from_matrix(heap(3)[0])
    newton.begin(problem)
    assert isinstance(newton.linear, by_elimination.ByElimination)
    assert not newton.has_elimination(problem)
    newton.destroy()


@pytest.mark.parallel(1, 2)
def test_systems_of_a_given_matrix_may_be_unsymmetric():
    """Few or many, on one rank or on several."""
    known, (barrier, q) = heap(3)[0], barrier_and_side()
    barrier[:, 0] *= 1.5
    here, newton = part(MPI.COMM_WORLD, len(q)), ccp.Newton(MPI.COMM_WORLD, "body")
    newton.begin(from_matrix(known, MPI.COMM_WORLD))
    assert newton.linear.takes_unsymmetric
    newton.update(barrier[here], symmetric=False)
    dg, _ = newton.solve(q[here], 1e-9)
    exact = np.linalg.solve(known.N + block_diag(*barrier), q.ravel()).reshape(-1, 3)
    assert np.allclose(dg, exact[here], rtol=0, atol=1e-8 * np.linalg.norm(exact))
    assert newton.linear.fallbacks == 0
    newton.destroy()


@pytest.mark.parametrize("few", [400], indirect=True)
@pytest.mark.parametrize("symmetric", [True, False])
def test_where_these_factors_fail_a_ksp_takes_over(symmetric, monkeypatch):
    monkeypatch.setattr(Factors, "solve", lambda self, b, wanted: (b, 0))
    known, graph = heap(3)
    barrier, q = barrier_and_side()
    if not symmetric:
        barrier[:, 0] *= 1.5
    S = known.N + block_diag(*barrier)
    newton = ccp.Newton(SELF, "body")
    newton.begin(from_graph(known, graph))
    for times in (1.0, 2.0):
        newton.update(times * barrier, symmetric=symmetric)
        dg, _ = newton.solve(q, 1e-9)
        left = S @ dg.ravel() + (times - 1.0) * block_diag(*barrier) @ dg.ravel() - q.ravel()
        assert np.linalg.norm(left) <= 2e-9
    assert newton.linear.fallbacks == 0
    newton.destroy()


# -- factors by blocks ---------------------------------------------------------------------------------------


def blocks_of(N: np.ndarray) -> tuple[sp.bsr_matrix, np.ndarray]:
    """A matrix in 3 x 3 blocks, and those of its diagonal."""
    here = np.arange(len(N) // 3)
    return sp.csr_matrix(N).tobsr((3, 3)), N.reshape(len(here), 3, len(here), 3)[here, :, here]


@pytest.mark.parametrize("symmetric", [True, False])
@pytest.mark.parametrize("least", [1, 12, 1000])
def test_an_elimination_by_blocks(symmetric, least, monkeypatch):
    """With a dense rest and without."""
    monkeypatch.setattr(elimination, "LEAST", least)
    for contacts, bodies in ((1, 1), (60, 100), (60, 20), (60, 3)):
        G = random_graph(0, contacts, bodies).dense()
        N, diagonal = blocks_of(G @ G.T)
        barrier, q = barrier_and_side(contacts)
        barrier[:, 0] *= 1.0 if symmetric else 1.5
        order = ordered(N.indptr, N.indices, 10**6, contacts)
        assert np.array_equal(np.sort(order.number), np.arange(contacts))
        assert order.rest <= (0 if least > contacts else contacts)
        x, count = Factors(N, order, diagonal + barrier, symmetric).solve(q, 1e-11)
        left = (G @ G.T + block_diag(*barrier)) @ x.ravel() - q.ravel()
        assert np.linalg.norm(left) <= 2e-11
        assert count <= 2


@pytest.mark.parametrize("spread", [1e6, 1e12])
def test_an_elimination_keeps_the_digits_of_blocks_of_very_different_numbers(spread):
    """Barriers have eigenvalues that differ by so much; the residual is one of rounding in the sizes of the terms."""
    G = random_graph(0, 60, 40).dense()
    N, diagonal = blocks_of(G @ G.T)
    rng = np.random.default_rng(0)
    axis = rng.standard_normal((60, 3, 1))
    barrier, q = spread * axis @ axis.transpose(0, 2, 1) + 1e-3 * np.eye(3), rng.standard_normal((60, 3))
    order = ordered(N.indptr, N.indices, 10**6, 60)
    x, count = Factors(N, order, diagonal + barrier, True).solve(q, 1e-13 * spread * np.abs(q).max())
    assert count == 1


@pytest.mark.parametrize("symmetric", [True, False])
@pytest.mark.parametrize("least", [1, 10])
def test_factors_say_where_they_fail_and_take_what_is_indefinite(symmetric, least, monkeypatch):
    monkeypatch.setattr(elimination, "LEAST", least)
    N, _ = blocks_of(np.ones((6, 6)))
    order = ordered(N.indptr, N.indices, 100, 2)
    assert Factors(N, order, np.ones((2, 3, 3)), symmetric).solve(np.arange(6.0).reshape(2, 3), 1e-9)[1] == 0
    assert Factors(N, order, np.tile(-4.0 * np.eye(3), (2, 1, 1)), symmetric).solve(np.ones((2, 3)), 1e-9)[1] > 0


def test_systems_with_multipliers_go_from_one_constraint_of_a_contact_to_two_and_back():
    newton, problem = newton_for(SELF, "pdip", "kkt"), from_graph(*heap(bodies=30))
    for form in ("perspective", "paper", "perspective"):
        found = ccp.solve(problem, None, "pdip", ccp.Limits(1e-6), PDIP(form=form), newton, ccp.RELAXATION)
        assert found.converged, found.reason
        assert found.solver == "pdip"
    newton.destroy()


@pytest.mark.parametrize(("solver", "form"), [("pdip", "contact"), ("pdip", "kkt"), ("conic", "body")])
def test_few_calls_lie_between_a_solve_and_a_product_of_its_matrix(solver, form, monkeypatch):
    depths: list[int] = []
    product = Shell.mult

    def noted(*given):
        names = [(Path(frame.filename).parent.name, frame.name) for frame in traceback.extract_stack()]
        depths.append(len(names) - names.index(("ccp", "solved")) - 1)  # without this one
        product(*given)

    monkeypatch.setattr(Shell, "mult", noted)
    newton = newton_for(SELF, solver, form)
    ccp.solve(from_graph(*heap(bodies=30)), None, solver, ccp.Limits(1e-6), newton=newton, law=ccp.RELAXATION)
    newton.destroy()
    assert depths
    assert max(depths) <= 9
    assert min(depths) <= 7  # without a factor


def test_the_memory_is_looked_up_once(monkeypatch):
    """What else runs on the machine changes no later choice; a result says where a factor had no room."""
    looks: list[int] = []
    monkeypatch.setattr(memory, "available", lambda comm: looks.append(0) or (1e5 if len(looks) == 1 else 1e12))
    monkeypatch.setattr(factors, "EASY", 0.1)
    newton = newton_for(SELF, "conic")
    known, graph = heap(bodies=30)
    for _ in range(2):
        problem = from_graph(known, graph)
        found = ccp.solve(problem, None, "conic", ccp.Limits(1e-8), newton=newton, law=ccp.RELAXATION)
        assert found.converged
        assert found.reason.endswith("; no room for a factor in 0.0001 GB of memory")
    assert len(looks) == 1
    newton.destroy()
