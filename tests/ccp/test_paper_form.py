"""The paper's form of the interior point method: its matrix from first principles, its start, its line search, and its
solutions."""

from __future__ import annotations

import numpy as np
import pytest
from mpi4py import MPI
from problems import SELF, dense_of, from_graph, from_matrix, heap

from pctt import ccp
from pctt.ccp import Limits, Status
from pctt.ccp.interior import paper
from pctt.ccp.interior.pdip import PDIP
from pctt.ccp.newton.kkt import KKT

PAPER = PDIP(form="paper")
BY_PDIP = {"type": "pdip", "law": ccp.RELAXATION}


@pytest.fixture
def steps(monkeypatch):
    """What the Newton matrix was made of in each step."""
    seen: list[KKT] = []
    linearise = ccp.Newton.linearise

    def record(self, kkt):
        seen.append(kkt)
        linearise(self, kkt)

    monkeypatch.setattr(ccp.Newton, "linearise", record)
    return seen


def residual(N, r, mu, t, z):
    """r_t of the paper at z = (g, lambda): 2Nc constraints, those of the cones first."""
    nc = len(mu)
    g, lam = z[: 3 * nc].reshape(-1, 3), z[3 * nc :].reshape(2, nc)
    f = np.array([0.5 * (g[:, 1] ** 2 + g[:, 2] ** 2 - mu**2 * g[:, 0] ** 2), -g[:, 0]])
    slope = lam[0][:, None] * g * np.column_stack([-(mu**2), np.ones(nc), np.ones(nc)])
    slope[:, 0] -= lam[1]
    return np.concatenate([N @ g.ravel() + r.ravel() + slope.ravel(), (-lam * f - 1 / t).ravel()])


@pytest.mark.parametrize("form", ["contact", "kkt"])
def test_the_matrix_is_the_derivative_of_the_residual(form):
    """And S = N + M - B E^-1 C its Schur complement; the direction is Newton's on r_t."""
    known, graph = heap(0, contacts=12, bodies=6)
    nc, mu, N, t = 12, known.mu, known.N, 7.0
    rng = np.random.default_rng(1)
    g = np.column_stack([rng.uniform(0.5, 2.0, nc), np.zeros((nc, 2))])
    g[:, 1:] = 0.6 * (mu * g[:, 0])[:, None] * rng.uniform(-1, 1, (nc, 2))
    lam = rng.uniform(0.1, 3.0, (nc, 2))
    z = np.concatenate([g.ravel(), lam.T.ravel()])
    J = np.column_stack([
        (residual(N, known.r, mu, t, z + h) - residual(N, known.r, mu, t, z - h)) / 2e-5 for h in 1e-5 * np.eye(5 * nc)
    ])  # fmt: skip
    M, B, C, E = J[: 3 * nc, : 3 * nc], J[: 3 * nc, 3 * nc :], J[3 * nc :, : 3 * nc], J[3 * nc :, 3 * nc :]
    S = M - B @ np.linalg.solve(E, C)
    exact = np.linalg.solve(J, -residual(N, known.r, mu, t, z))

    f = paper.constraints(g, mu)
    newton = ccp.Newton(SELF, form)
    newton.begin(from_graph(known, graph))
    newton.linearise(KKT(paper.curvature(f, lam, mu), paper.gradients(g, mu), f, lam))
    if form == "contact":
        np.testing.assert_allclose(dense_of(newton.system.entries()), S, atol=1e-7 * np.abs(S).max())
        assert np.linalg.eigvalsh(S - N).min() > 0
    right = -residual(N, known.r, mu, t, z)
    dg, dlam, _ = newton.step(right[: 3 * nc].reshape(-1, 3), right[3 * nc :].reshape(2, nc).T, 1e-12)
    found = np.concatenate([dg.ravel(), dlam.T.ravel()])
    np.testing.assert_allclose(found, exact, atol=1e-6 * np.abs(exact).max())
    newton.destroy()


PROBLEMS = {
    "singular N": {},
    "no friction": {"mu": 0.0},
    "mixed friction": {"mu": np.arange(40) % 4 * 0.3},
    "high friction": {"mu": 3.0, "bodies": 40},
    "one contact": {"contacts": 1, "bodies": 1, "seed": 3},
}


@pytest.mark.parallel(1, 2)
@pytest.mark.parametrize("name", PROBLEMS)
@pytest.mark.parametrize("form", ["contact", "kkt"])
def test_reaches_the_known_optimum(name, form):
    """By the map and by the matrix in turns."""
    comm = MPI.COMM_WORLD
    known, graph = heap(**PROBLEMS[name])
    by_map = (list(PROBLEMS).index(name) + (form == "kkt")) % 2
    problem = from_graph(known, graph, comm) if by_map else from_matrix(known, comm)
    newton = ccp.newton_for(comm, "pdip", form)
    result = ccp.solve(problem, limits=Limits(1e-6, fallback=False), options=PAPER, newton=newton, **BY_PDIP)
    assert result.converged, result.reason
    assert result.accuracy.natural_residual <= 1.01e-6
    assert result.accuracy.cone_violation <= 1e-12 * result.accuracy.impulse_norm
    assert result.accuracy.objective == pytest.approx(known.objective, rel=1e-5)
    assert result.accuracy.velocity_norm == pytest.approx(np.linalg.norm(known.y), rel=1e-3)
    # BiCGStab may break down on an unsymmetric matrix, by the last bits of a processor; a factor is as good
    assert result.fallbacks <= (0.1 * result.iterations if form == "kkt" else 0)
    newton.destroy()


@pytest.mark.parametrize("other", ["apgd", "conic"])
def test_finds_the_impulses_of_the_other_methods(other):
    """Where N is regular they are unique."""
    known, graph = heap(4, bodies=60, mu=np.arange(40) % 4 * 0.2)
    problem = from_graph(known, graph)
    ours = ccp.solve(problem, limits=Limits(1e-7, fallback=False), options=PAPER, **BY_PDIP)
    theirs = ccp.solve(problem, type=other, limits=Limits(1e-9), law=ccp.RELAXATION)
    assert ours.converged
    assert theirs.converged
    assert np.linalg.norm(ours.impulse - theirs.impulse) < 1e-4 * np.linalg.norm(theirs.impulse)


def test_two_positive_multipliers_per_contact_carry_the_velocities(steps):
    known, graph = heap(bodies=30, mu=np.arange(40) % 4 * 0.3)
    result = ccp.solve(from_graph(known, graph), limits=Limits(1e-6, fallback=False), options=PAPER, **BY_PDIP)
    assert result.iterations == len(steps) > 10
    for kkt in steps:
        assert kkt.lam.shape == kkt.f.shape == (40, 2)
        assert kkt.lam.min() > 0 > kkt.f.max()
    last = steps[-1]
    gap = -(last.lam * last.f).sum()
    assert gap < 1e-4 * -(steps[0].lam * steps[0].f).sum()
    pushed = -np.einsum("ck,cki->ci", last.lam, last.df)  # y = -sum lambda_i grad f_i
    rough = known.mu > 0
    assert np.linalg.norm((pushed - known.y)[rough]) < 0.1 * np.linalg.norm(known.y[rough])


def test_begins_with_the_last_impulses_or_one_and_multipliers_on_the_central_path(steps):
    """With 1/t = |N g + r| |g| / 2Nc."""
    known, graph = heap()
    guess = np.zeros((40, 3))
    guess[::3] = [2.5, 0.1, -0.2]
    guess[1] = [-1.0, 0.0, 0.0]
    ccp.solve(from_graph(known, graph), guess, limits=Limits(1e-6, 1, fallback=False), options=PAPER, **BY_PDIP)
    normal = np.where(np.arange(40) % 3 == 0, 2.5, 1.0)
    f = np.column_stack([-0.5 * (known.mu * normal) ** 2, -normal])
    np.testing.assert_allclose(steps[0].f, f, rtol=1e-14)
    g = np.column_stack([normal, np.zeros((40, 2))])
    speed = np.linalg.norm(known.N @ g.ravel() + known.r.ravel())
    np.testing.assert_allclose(steps[0].lam, -speed * np.linalg.norm(g) / 80 / f, rtol=1e-12)


def test_its_two_numbers_are_options_and_have_their_own_defaults():
    known, graph = heap(contacts=15, bodies=12)
    counts = [
        ccp.solve(from_graph(known, graph), limits=Limits(1e-5, fallback=False), options=options, **BY_PDIP).iterations
        for options in (
            PAPER,
            PDIP(form="paper", centering=0.1, boundary=0.99),
            PDIP(form="paper", centering=0.5),
            PDIP(form="paper", boundary=0.3),
        )
    ]
    assert counts[0] == counts[1]
    assert counts[2] != counts[0] != counts[3]


def test_a_line_search_that_fails_is_said(monkeypatch):
    """A direction along which the residual grows."""
    step = ccp.Newton.step

    def backwards(self, *args):
        dg, dlam, x = step(self, *args)
        return -dg, -dlam, x

    monkeypatch.setattr(ccp.Newton, "step", backwards)
    known, graph = heap()
    result = ccp.solve(from_graph(known, graph), limits=Limits(1e-6, fallback=False), options=PAPER, **BY_PDIP)
    assert result.status is Status.STALLED
    assert "line search" in result.reason
    assert result.iterations == 0
