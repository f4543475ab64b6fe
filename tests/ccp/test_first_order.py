"""First-order methods: what they share, their steps, and how they end. All of the registry that solve no Newton
systems are tested; that they find known optima is in test_solvers.py."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse as sp
from mpi4py import MPI
from problems import SELF, from_graph, from_matrix, heap

from dem.contact_map import find_halo
from pctt import ccp
from pctt.ccp import Limits
from pctt.ccp.cones.friction import project
from pctt.ccp.first_order import apgd, gauss_seidel, projected_steps
from pctt.ccp.first_order.faces import Face
from pctt.ccp.first_order.scaled import Progress, ScaledProblem

METHODS = [name for name, solver in ccp.SOLVERS.items() if not solver.newton]
EVERY = pytest.mark.parametrize("method", METHODS)


def margin(x, mu):
    """How far inside the cone a point is along the tangents."""
    return mu * x[:, 0] - np.hypot(x[:, 1], x[:, 2])


def objective(problem: ccp.ConeProblem, g: np.ndarray) -> float:
    return float(np.vdot(g, 0.5 * problem.product(g) + problem.r))


# -- scaled problem -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("given", ["blocks", "matrix"])
def test_the_scaled_problem_is_the_same_problem(given):
    known, graph = heap(mass_ratio=100.0)
    problem = from_matrix(known) if given == "matrix" else from_graph(known, graph)
    scaled = ScaledProblem(problem)
    rng = np.random.default_rng(0)
    x = rng.normal(size=(40, 3))
    g = scaled.impulse(x)
    N = known.N
    square = scaled.unit**2
    assert square * scaled.dots((x, scaled.product(x)))[0] == pytest.approx(g.ravel() @ N @ g.ravel())
    assert square * scaled.dots((x, scaled.b))[0] == pytest.approx(np.vdot(g, known.r))
    assert np.allclose(margin(x, scaled.cones.mu) > 0, margin(g, known.mu) > 0)
    shrink = scaled.shrink.ravel()
    dense = shrink[:, None] * N * shrink
    assert np.allclose(dense @ x.ravel(), scaled.product(x).ravel())
    blocks = [dense[i : i + 3, i : i + 3] for i in range(0, 120, 3)]
    assert np.allclose([[block[0, 0], block[1, 1] + block[2, 2]] for block in blocks], [1.0, 2.0])
    assert np.allclose(scaled.block_steps()[:, 0], [1 / np.linalg.eigvalsh(block)[-1] for block in blocks])
    largest = np.linalg.eigvalsh(dense)[-1]
    assert 0.8 * largest <= scaled.largest_curvature(50) <= largest * (1 + 1e-12)
    there, zero = scaled.gradient(x), np.zeros_like(x)
    assert scaled.curvature(x, there, zero, scaled.b) == pytest.approx(x.ravel() @ dense @ x.ravel() / np.vdot(x, x))
    assert scaled.curvature(x, there, x, there) == np.inf
    y = scaled.gradient(scaled.start(g))
    start = scaled.impulse(scaled.start(g))
    expected = problem.natural_residual(start, problem.product(start) + problem.r)
    assert scaled.errors(scaled.start(g), y).natural == pytest.approx(expected)
    now, last, new = (scaled.iterate(scaled.project(z)) for z in rng.normal(size=(3, 40, 3)))
    y = np.empty_like(now.x)
    assert np.allclose(scaled.look(now, y), scaled.gradient(now.x))
    z = now.x + 0.7 * (now.x - last.x)
    scaled.rigid_gradient(now, last, 0.7, y)
    curvature, length, uphill = scaled.step(now, last, 0.7, y, 0.3, new)
    assert np.allclose(new.x, project(z - 0.3 * scaled.gradient(z), scaled.cones.mu))
    assert curvature == pytest.approx(np.vdot(new.x - z, scaled.product(new.x - z)))
    assert length == pytest.approx(np.vdot(new.x - z, new.x - z))
    assert uphill == pytest.approx(np.vdot(scaled.gradient(z), new.x - now.x))


def test_the_curvature_of_a_tiny_step_is_no_rounding():
    """N of rank 30 of 60 has no negative curvature, though images far from zero differ by their rounding along tiny
    steps in its null space."""
    rng = np.random.default_rng(0)
    root, _ = np.linalg.qr(rng.normal(size=(60, 30)))
    scaled = ScaledProblem(ccp.ConeProblem(SELF, rng.normal(size=(20, 3)), np.full(20, 0.5), N=root @ root.T))
    weights = scaled.size.ravel()  # x = S g: A x = 0 where N g = 0
    last = scaled.iterate(np.tile([1.0, 0.1, 0.1], (20, 1)))  # inside of all cones
    for _ in range(20):
        free = rng.normal(size=60)
        tiny = 1e-13 * (weights * (free - root @ (root.T @ free))).reshape(-1, 3)
        new = last.copy()
        curvature, square, _ = scaled.step(last, last, 0.0, tiny, 1.0, new)
        assert square > 0
        assert curvature >= -1e-9 * square


# -- faces --------------------------------------------------------------------------------------------------


def test_faces_of_projected_points():
    mu = np.array([0.5, 0.5, 0.5, 0.0, 0.0])
    x = project(np.array([[1.0, 0.1, 0], [1.0, 3, 4], [-1.0, 0.1, 0.1], [1.0, 2, 0], [-1.0, 0, 0]]), mu)
    face = Face(x, mu)
    assert face.inside.tolist() == [True, False, False, False, False]
    assert face.sliding.tolist() == [False, True, False, True, False]
    v = np.random.default_rng(0).normal(size=(5, 3))
    part = face.part(v)
    assert np.array_equal(part[0], v[0])
    assert np.allclose(part[1], x[1] * (x[1] @ v[1]) / (x[1] @ x[1]))
    assert np.array_equal(part[[2, 4]], np.zeros((2, 3)))
    assert np.allclose(part[3], [v[3, 0], 0, 0])
    assert np.allclose(face.part(part), part)  # a projection
    assert face.same(Face(1.1 * x, mu))
    assert not face.same(Face(x[::-1].copy(), mu))


def test_the_reach_in_a_face_ends_at_its_boundary():
    rng = np.random.default_rng(1)
    mu = rng.uniform(0.1, 1.0, 60)
    x = project(rng.normal(size=(60, 3)) + [0.5, 0, 0], mu)
    face = Face(x, mu)
    assert min(face.inside.sum(), face.sliding.sum(), (~face.inside & ~face.sliding).sum()) > 5
    p = face.part(rng.normal(size=(60, 3)))
    reach = face.reach(x, p)
    assert 0 < reach < np.inf
    assert margin(x + reach * (1 - 1e-9) * p, mu).min() >= -1e-12
    assert margin(x + reach * (1 + 1e-6) * p, mu).min() < -1e-12 or (x + reach * (1 + 1e-6) * p)[:, 0].min() < 0


def test_the_line_search_takes_the_whole_step_where_it_may():
    assert projected_steps.sufficient(-1.0, 1.0, 0.0) == (1.0, -0.5)
    assert projected_steps.sufficient(-1.0, 3.0, 1.0) == (1.0, 0.5)  # a rise that is allowed
    fraction, change = projected_steps.sufficient(-1.0, 4.0, 0.0)
    assert fraction == 0.25  # the minimiser on the segment
    assert change == -0.125
    assert projected_steps.sufficient(-1.0, 1e3, 0.0)[0] >= 1e-4
    assert projected_steps.sufficient(0.0, 0.0, 0.0) == (1.0, 0.0)


# -- colours and sweeps -------------------------------------------------------------------------------------


def colours(known) -> np.ndarray:
    blocks = sp.csr_matrix(known.N).tobsr((3, 3))
    halo, columns = find_halo(SELF, len(known.mu), blocks.indices)
    return gauss_seidel.colours(halo, blocks.indptr, columns)[: len(known.mu)]


@pytest.mark.parametrize("hub", [False, True])
def test_neighbours_have_different_colours(hub):
    known, _ = heap(contacts=80, bodies=30, hub=hub)
    colour = colours(known)
    coupled = np.abs(known.N).reshape(80, 3, 80, 3).max(axis=(1, 3)) > 0
    same = colour[:, None] == colour[None, :]
    assert np.array_equal(coupled & same, np.eye(80, dtype=bool))
    assert colour.min() == 0
    assert colour.max() <= coupled.sum(1).max() - 1  # no more than a greedy colouring may need
    # a colour is the smallest that is free
    for k in range(colour.max()):
        later = colour > k
        assert (coupled[later][:, colour == k]).any(axis=1).all()


def test_a_sweep_is_gauss_seidel_contact_by_contact():
    known, graph = heap(2, mu=np.arange(40) % 4 * 0.3)
    scaled = ScaledProblem(from_graph(known, graph))
    colour = colours(known)
    sweep = gauss_seidel.Sweep(scaled, 1.3)
    x = scaled.start(np.abs(known.r))
    swept = sweep(x)
    expected = x.copy()
    for c in np.argsort(colour, kind="stable"):
        y = scaled.gradient(expected)[c]
        step = 1.3 * scaled.block_steps()[c, 0]
        expected[c] = project((expected[c] - step * y)[None], scaled.cones.mu[c : c + 1])[0]
    assert np.allclose(swept, expected, rtol=0, atol=1e-13 * np.abs(expected).max())
    assert not np.allclose(swept, x)


@pytest.mark.parametrize("method", ["jacobi", "gauss_seidel"])
def test_every_iteration_descends(method, monkeypatch):
    """From a start that is far off, on a singular N with a body of many contacts."""
    known, graph = heap(1, hub=True, mass_ratio=100.0)
    problem = from_graph(known, graph)
    values = []
    goes_on = Progress.goes_on

    def watched(self, x, gradient=None):
        values.append(objective(problem, self.problem.impulse(x)))
        return goes_on(self, x, gradient)

    monkeypatch.setattr(Progress, "goes_on", watched)
    ccp.solve(
        problem, project(100 * np.abs(known.r), known.mu), method, Limits(1e-12, 40, fallback=False), law=ccp.RELAXATION
    )
    assert len(values) == 41
    assert np.all(np.diff(values) < 0)


# -- how runs end -------------------------------------------------------------------------------------------


@EVERY
def test_an_accuracy_that_cannot_be_reached_ends_with_a_reason(method):
    known, graph = heap(bodies=60, contacts=10)
    problem = from_graph(known, graph)
    options = ccp.SOLVERS[method].options(patience=150)
    result = ccp.solve(problem, None, method, Limits(1e-30, fallback=False), options, law=ccp.RELAXATION)
    if not result.converged:  # a residual of exactly zero is no stagnation
        assert "no progress" in result.reason
    assert result.iterations < ccp.SOLVERS[method].iterations
    # a method that compares objectives sees no difference below the root of the machine precision
    assert ccp.measure(problem, result.impulse).natural_residual < 1e-8


@EVERY
@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_a_matrix_with_a_nan_does_not_converge(method):
    known, _ = heap(contacts=6, bodies=4)
    problem = from_matrix(known)
    problem.operator.local.data[1, 0, 2] = np.nan  # a problem with a NaN is refused; this one gets it afterwards
    result = ccp.solve(problem, type=method, limits=Limits(1e-6), law=ccp.RELAXATION)
    assert not result.converged
    assert "not a number" in result.reason
    assert result.iterations <= 30


@pytest.mark.parametrize("size", [1.0, 1e25, 1e-25])
def test_apgd_begins_in_single_precision_and_ends_in_double(size, monkeypatch):
    """Numbers that single precision does not hold, or whose squares it does not, cost nothing but its iterations."""
    known, graph = heap(4, bodies=60)
    problem = ccp.ConeProblem(SELF, size * known.r, known.mu, G=graph.part(SELF))
    stages = []
    descend = apgd._descend

    def watched(progress, *arguments):
        stages.append(progress.problem.precision)
        return descend(progress, *arguments)

    monkeypatch.setattr(apgd, "_descend", watched)
    ccp.solve(problem, type="apgd", limits=Limits(1e-12), law=ccp.RELAXATION)
    assert stages == [np.float64]  # few contacts stay in the cache
    monkeypatch.setattr(apgd, "CACHED", 0)
    stages.clear()
    result = ccp.solve(problem, type="apgd", limits=Limits(1e-12), law=ccp.RELAXATION)
    assert stages == [np.float32, np.float64]
    assert result.converged
    assert result.impulse.dtype == np.float64
    assert ccp.measure(problem, result.impulse).natural_residual <= 1.01e-12
    y = problem.product(result.impulse) / size
    assert y == pytest.approx(problem.product(known.g), rel=1e-6, abs=1e-8)


# -- several ranks ------------------------------------------------------------------------------------------


def problems_of(comm):
    """By name; some ranks have no contact in "uneven", and one in "few"."""
    last = comm.size - 1
    known, graph = heap(1, mu=np.arange(40) % 4 * 0.3)
    few, few_graph = heap(1, contacts=2, bodies=2)
    return {
        "even": from_graph(known, graph, comm),
        "matrix": from_matrix(known, comm),
        "uneven": from_graph(known, graph, comm, [0] * last + [40], [12] * comm.size),
        "few": from_graph(few, few_graph, comm),
    }


@pytest.mark.parallel(2, 3)
@EVERY
def test_iterates_do_not_depend_on_the_ranks(method, double):
    """Also where a rank has no contact. After 15 iterations rounding has not grown yet."""
    comm, limits = MPI.COMM_WORLD, Limits(1e-13, 15, fallback=False)
    alone = problems_of(SELF)
    for name, problem in problems_of(comm).items():
        result = ccp.solve(problem, type=method, limits=limits, law=ccp.RELAXATION)
        said = (result.converged, result.reason, result.iterations, result.history)
        assert comm.allgather(said) == [said] * comm.size
        impulse = np.concatenate(comm.allgather(result.impulse))
        expected = ccp.solve(alone["few" if name == "few" else "even"], type=method, limits=limits, law=ccp.RELAXATION)
        assert abs(result.iterations - expected.iterations) <= (name == "few")
        assert np.allclose(impulse, expected.impulse, rtol=0, atol=1e-9)
        problem.destroy()
