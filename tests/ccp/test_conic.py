"""The conic interior point method where it is hard: degenerate, badly scaled, and to high accuracy."""

from __future__ import annotations

import os

import numpy as np
import pytest
from problems import SELF, Known, from_graph, from_matrix, heap, known_optimum, random_graph

from dem.contact_map import BlockRows
from pctt import ccp, memory
from pctt.ccp import ConeProblem, Limits, Newton, newton_for
from pctt.ccp.interior.conic import Conic
from pctt.ccp.newton import by_elimination
from pctt.ccp.newton import factor as factor_of
from pctt.ccp.newton.conjugate_gradients import ConjugateGradients
from pctt.ccp.newton.krylov import Krylov

FORMS = pytest.mark.parametrize("form", ["contact", "body"])
CASES = {
    "rank deficient": {"bodies": 4},  # N of rank 24 at most, of 120
    "no friction": {"mu": 0.0},
    "friction 1.5": {"mu": 1.5, "bodies": 40},
    "mass ratio 1e4": {"mass_ratio": 1e4},
    "hub": {"hub": True, "seed": 1},
    "one contact": {"contacts": 1, "bodies": 1, "seed": 3},
    "mixed friction": {"mu": np.arange(40) % 3 * 0.75},
}


@pytest.fixture(autouse=True)
def few(request, monkeypatch):
    """Contacts of the problems that get factors by blocks: none, unless a test says more."""
    monkeypatch.setattr(by_elimination, "FEW", getattr(request, "param", 0))


def packing(side: int = 5, seed: int = 0) -> tuple[BlockRows, np.ndarray, np.ndarray]:
    """G, r and mu of side^3 spheres at rest in a jittered cubic pile: neighbours touch, the lowest the floor; gravity
    acts for a step. Three contacts per sphere: N has the kernel that packings have."""
    rng = np.random.default_rng(seed)
    place = np.stack(np.meshgrid(*[np.arange(side)] * 3, indexing="ij"), -1).reshape(-1, 3)
    name = np.arange(side**3).reshape(side, side, side)
    centre = place + 0.05 * rng.normal(size=place.shape)
    pairs = [(name[1:], name[:-1]), (name[:, 1:], name[:, :-1]), (name[:, :, 1:], name[:, :, :-1])]
    pairs = np.concatenate([np.stack([one.ravel(), two.ravel()], 1) for one, two in pairs])
    floor = name[:, :, 0].ravel()
    normal = np.concatenate([centre[pairs[:, 0]] - centre[pairs[:, 1]], np.tile([0.0, 0, 1], (len(floor), 1))])
    normal /= np.linalg.norm(normal, axis=1)[:, None]
    first = np.cross(normal, [0.3, 0.9, 0.1])
    first /= np.linalg.norm(first, axis=1)[:, None]
    frame = np.stack([normal, first, np.cross(normal, first)], axis=1)
    turn = np.cross(-0.5 * normal[:, None, :], frame) / (0.5 * np.sqrt(0.4))
    count = np.r_[np.full(len(pairs), 2), np.ones(len(floor), int)]
    indptr = np.r_[0, np.cumsum(count)]
    indices, blocks = np.zeros(indptr[-1], int), np.zeros((indptr[-1], 3, 6))
    start = indptr[:-1]
    indices[start], blocks[start] = np.r_[pairs[:, 0], floor], np.concatenate([frame, turn], axis=2)
    second = start[: len(pairs)] + 1
    indices[second] = pairs[:, 1]
    blocks[second] = np.concatenate([-frame, turn], axis=2)[: len(pairs)]
    G = BlockRows(indptr, indices, blocks, side**3)
    r = 0.01 * np.abs(rng.normal(size=(len(count), 1))) * [1.0, 0, 0]
    r[len(pairs) :] -= 0.25 * frame[len(pairs) :, :, 2]  # it falls: relative velocities between spheres are zero
    r[:, 1:] += 0.02 * rng.normal(size=(len(count), 2))
    return G, r, np.full(len(count), 0.25)


def solve(problem: ConeProblem, tol: float, form: str = "auto") -> ccp.Result:
    newton = newton_for(problem.comm, "conic", form)
    result = ccp.solve(problem, None, "conic", Limits(tol), newton=newton, law=ccp.RELAXATION)
    newton.destroy()
    return result


def check(problem: ConeProblem, result: ccp.Result, tol: float) -> None:
    assert result.converged, f"{result.reason}: {result.residual:.1e}"
    figures = ccp.measure(problem, result.impulse)
    assert figures.natural_residual <= 1.01 * tol
    assert figures.cone_violation <= 1e-12 * figures.impulse_norm


def check_known(known: Known, problem: ConeProblem, result: ccp.Result, tol: float) -> None:
    check(problem, result, tol)
    velocity = problem.product(result.impulse) + problem.r
    assert np.linalg.norm(velocity - known.y) <= 1e3 * tol * np.linalg.norm(known.r)


@FORMS
@pytest.mark.parametrize("tol", [1e-8, 1e-10])
def test_a_packing_to_high_accuracy(form, tol):
    G, r, mu = packing()
    problem = ConeProblem(SELF, r, mu, G=G)
    result = solve(problem, tol, form)
    check(problem, result, tol)
    assert result.iterations <= 17 + 4 * (form == "contact")  # 21 with what contacts do alone in a rounded form


@pytest.mark.parametrize("room", [True, False])
def test_its_systems_change_from_block_jacobi_to_factors_if_the_memory_has_room(room, monkeypatch):
    used = []

    def note(kind, name):
        once = kind.solve

        def noted(krylov, *arguments, **keywords):
            used.append(name(krylov))
            return once(krylov, *arguments, **keywords)

        monkeypatch.setattr(kind, "solve", noted)

    note(Krylov, lambda krylov: (krylov.ksp.getType(), krylov.ksp.pc.getType()))
    note(ConjugateGradients, lambda krylov: ("cg", "pbjacobi"))
    monkeypatch.setattr(factor_of, "EASY", 6.0)
    if not room:
        monkeypatch.setattr(memory, "available", lambda comm: 1e5)
    G, r, mu = packing(8 if room else 5)
    newton = newton_for(SELF, "conic")
    assert ccp.solve(
        ConeProblem(SELF, r, mu, G=G), None, "conic", Limits(1e-6), newton=newton, law=ccp.RELAXATION
    ).converged
    assert newton.linear.fallbacks == 0
    jacobi, factor = ("cg", "pbjacobi"), ("cg", "python")
    assert list(dict.fromkeys(used)) == ([jacobi, factor] if room else [jacobi])  # in the order of their first use
    newton.destroy()


def test_linear_solves_begin_from_those_of_the_last_step(monkeypatch):
    """Those of a predictor from both of the step before, of a corrector from the predictor's."""
    found, begun = [], []

    def solved(newton, q, tol, r_v=None, earlier=(), uncoupled=None):
        dg, x = once(newton, q, tol, r_v, earlier, uncoupled)
        begun.append([next(k for k, other in enumerate(found) if other is each) for each in earlier])
        found.append(x)
        return dg, x

    once = Newton.solve
    monkeypatch.setattr(Newton, "solve", solved)
    G, r, mu = packing()
    limits, two = Limits(1e-10, 3, fallback=False), Conic(short=0.0)  # directions in each step
    ccp.solve(ConeProblem(SELF, r, mu, G=G), None, "conic", limits, two, law=ccp.RELAXATION)
    assert begun == [[], [0], [0, 1], [2], [2, 3], [4]]


def test_the_share_of_the_memory_is_a_part_of_what_the_machine_has():
    share = memory.available(SELF)
    assert share > 0
    if share < np.inf:  # Linux
        assert share <= os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")


@pytest.mark.parametrize("few", [0, 400], indirect=True)
@pytest.mark.parametrize("tol", [1e-8, 1e-10])
@pytest.mark.parametrize("case", CASES)
def test_no_breakdown(case, tol):
    if case == "rank deficient" and tol < 1e-8:
        pytest.skip("rounding ends it at 2e-9")
    known, graph = heap(**CASES[case])
    problem = from_graph(known, graph)
    check_known(known, problem, solve(problem, tol), tol)


@FORMS
def test_little_compliance_on_a_rank_deficient_heap(form):
    known, graph = heap(bodies=8)
    rigid = from_graph(known, graph)
    problem = ConeProblem(SELF, rigid.r, rigid.mu, G=rigid.contact_map.source, compliance=1e-6)
    tol = 1e-9  # rounding ends it at 1e-10 to 1e-9
    check(problem, solve(problem, tol, form), tol)


# -- compliance ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("along", [0.0, 3.5])
@pytest.mark.parametrize("compliance", [1e-4, 1e-2])
def test_methods_agree_on_the_compliant_optimum(compliance, along):
    """Its normal impulses are unique as well. The tangents yield, too, or do not."""
    known, graph = heap(bodies=8)
    soft = np.tile([compliance, along * compliance], (len(known.mu), 1))
    problem = ConeProblem(SELF, known.r, known.mu, G=graph.part(SELF), compliance=soft)
    tol = 1e-3 * compliance
    found = {name: ccp.solve(
        problem, type=name, limits=Limits(tol), law=ccp.RELAXATION
    ) for name in ("conic", "pdip", "apgd")}
    for result in found.values():
        check(problem, result, tol)
        normal, best = result.impulse[:, 0], found["conic"].impulse[:, 0]
        assert np.linalg.norm(normal - best) <= 0.1 * np.linalg.norm(best)


def test_a_rounded_singular_matrix_keeps_none_from_the_tolerance():
    """Files have N in a few digits: then it is indefinite, and factors put off pivots, for which they need room."""
    N = random_graph(0, 200, 60).dense()
    rounded = np.vectorize(lambda value: float(f"{value:.5g}"))(N @ N.T)
    known = known_optimum(0, 0.5 * (rounded + rounded.T), np.ones(200))
    found = ccp.solve(from_matrix(known), None, "conic", Limits(1e-8), law=ccp.RELAXATION)
    assert found.converged
    assert found.fallbacks == 0
