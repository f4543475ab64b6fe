"""Coulomb's law by the fixed-point iteration: worked examples, published problems, ranks."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from mpi4py import MPI
from problems import SELF, from_graph, heap, matrix
from several_ranks import alone

from pctt import ccp
from pctt.ccp import Limits, Status, fclib
from pctt.ccp.cones.lorentz import determinant
from pctt.ccp.coulomb import fixed_point
from pctt.ccp.interior import conic

SHARED = Path(__file__).resolve().parents[3] / "shared" / "fclib"
SOLVERS = pytest.mark.parametrize("solver", ["apgd", "conic", "pdip", "auto"])


def solve(problem, solver="apgd", tol=1e-8, guess=None):
    return ccp.solve(problem, guess, solver, Limits(tol), law=ccp.COULOMB)


def by_cone_problems(problem, tol=1e-8, guess=None, **options):
    """A sequence of cone problems, solved by APGD."""
    guess = np.zeros_like(problem.r) if guess is None else guess

    def convex(problem, guess, limits):
        return ccp.solve(problem, guess, "apgd", limits, law=ccp.RELAXATION)

    return fixed_point(convex, problem, guess, Limits(tol), **options)


def newton_steps(problem, tol=1e-8, guess=None):
    """The Newton steps of `conic` alone."""
    newton = ccp.newton_for(problem.comm, "conic")
    guess = np.zeros_like(problem.r) if guess is None else guess
    try:
        return conic.solve(problem, guess, Limits(tol, 60), conic.Conic(), newton, coulomb=True)
    finally:
        newton.destroy()


@SOLVERS
@pytest.mark.parametrize("mu", [0.2, 0.5, 1.5])
def test_one_contact_worked_out_by_hand(solver, mu):
    """A unit mass falls with speed 1 on a floor and slides with speed s. N = 1, r = (-1, s, 0): it stops if s <= mu,
    else g = (1, -mu, 0) and it keeps s - mu, without leaving the floor."""
    for s, expected in ((0.5 * mu, [1.0, -0.5 * mu, 0.0]), (3.0, [1.0, -mu, 0.0])):
        problem = ccp.ConeProblem(SELF, np.array([[-1.0, s, 0.0]]), np.array([mu]), N=matrix(SELF, np.eye(3)))
        result = solve(problem, solver)
        assert result.converged, result.reason
        assert result.impulse == pytest.approx(np.array([expected]), abs=1e-6)
        y = problem.product(result.impulse) + problem.r
        assert abs(y[0, 0]) < 1e-6
        figures = ccp.measure(problem, result.impulse)
        assert figures.coulomb_residual <= 1.01e-8
        assert figures.coulomb_residual == pytest.approx(result.residual, rel=1e-3, abs=1e-12)


def sliding_heap(mu: float, seed: int = 0, comm=SELF):
    known, graph = heap(seed, contacts=40, bodies=30, mu=mu)
    return from_graph(known, graph, comm)


@SOLVERS
def test_contacts_obey_coulombs_law(solver):
    """In its own words: no contact is open and pressed, none sticks outside and none slides inside its cone, and
    friction is against the sliding."""
    problem = sliding_heap(0.3)
    result = solve(problem, solver, 1e-8 if solver == "apgd" else 1e-6)
    assert result.converged, result.reason
    own_way = ccp.SOLVERS[solver].has_law
    assert result.law == ("coulomb" if own_way else "coulomb by cone problems")
    assert own_way or len(result.history) == result.cone_problems > 2
    g, y = result.impulse, problem.product(result.impulse) + problem.r
    slack = 1e-4
    sliding, used = np.hypot(*y.T[1:]), np.hypot(*g.T[1:])
    assert (np.minimum(g[:, 0], y[:, 0]) >= -slack).all()
    assert (np.minimum(g[:, 0], np.abs(y[:, 0])) <= slack).all()
    slides = (sliding > 1e-2) & (g[:, 0] > 1e-2)
    assert slides.sum() >= 5
    assert used[slides] == pytest.approx(0.3 * g[slides, 0], abs=slack)
    assert g[slides, 1:] == pytest.approx(-used[slides, None] * y[slides, 1:] / sliding[slides, None], abs=slack)
    assert (sliding[used < 0.3 * g[:, 0] - 1e-2] < slack).all()
    plain = ccp.measure(problem, ccp.solve(problem, type="apgd", limits=Limits(1e-8), law=ccp.RELAXATION).impulse)
    assert plain.coulomb_residual > 1e-3  # what the relaxation costs
    assert ccp.measure(problem, g).natural_residual > 1e-3


@pytest.mark.parametrize("mu", [0.8, 1.5])
def test_one_run_finds_it_at_high_friction(mu):
    """Where the opening follows the sliding in every iteration, momentum has to be bounded: the bound is found."""
    for seed in range(3):
        result = solve(sliding_heap(mu, seed), tol=1e-6)
        assert result.converged, result.reason
        assert (result.law, result.cone_problems) == ("coulomb", 1)
        assert result.iterations < 2500


def test_the_newton_steps_of_conic_end_fast():
    """The derivative of De Saxce's term is that: the last five steps take two digits off the residual."""
    result = newton_steps(sliding_heap(0.3, seed=1), tol=1e-9)
    assert result.converged, result.reason
    assert result.iterations < 20
    assert result.history[-1] < 1e-2 * result.history[-6]


def test_de_saxces_term_is_exact():
    """Velocities (y_n, y_t), y_n > 0, and points inside the cone are one to one, up to its boundary."""
    y = np.random.default_rng(1).normal(size=(50, 3))
    y[:, 0] = 10.0 ** np.linspace(-12, 1, 50)
    z = conic.with_de_saxce(y)
    assert (determinant(z) > 0).all()
    np.testing.assert_allclose(z[:, 0] - y[:, 0], np.hypot(y[:, 1], y[:, 2]), rtol=1e-12)
    np.testing.assert_allclose(conic.without_de_saxce(z), y, rtol=1e-9, atol=1e-15)


def test_contacts_that_do_not_slide_have_no_direction():
    z = np.array([[1e3, 0.0, 0.0], [1.0, 3.0, -4.0]])
    with np.errstate(all="raise"):
        np.testing.assert_allclose(conic.sliding_directions(z), [[0, 0, 0], [0, 0.6, -0.8]])


def test_acceleration_and_a_warm_start_save_cone_problems():
    problem = sliding_heap(0.8)
    plain, fast = (by_cone_problems(problem, tol=1e-4, depth=depth) for depth in (0, 5))
    assert fast.converged
    assert fast.cone_problems < plain.cone_problems
    again = by_cone_problems(problem, tol=1e-4, guess=fast.impulse)
    assert again.cone_problems <= 2


def test_giving_up_is_said():
    problem = sliding_heap(0.8)
    r = problem.r.copy()
    result = by_cone_problems(problem, tol=1e-9, most=3)
    assert not result.converged
    assert (result.cone_problems, len(result.history)) == (3, 3)
    assert result.reason == f"Coulomb's law not met: residual {min(result.history):.1e} at best in 3 cone problems"
    assert np.array_equal(problem.r, r)  # put back
    assert ccp.measure(problem, result.impulse).coulomb_residual == pytest.approx(min(result.history), rel=1e-3)


def test_without_friction_or_sliding_it_is_the_cone_problem():
    problem = sliding_heap(0.0)
    result = solve(problem, tol=1e-8)
    figures = ccp.measure(problem, result.impulse)
    assert figures.coulomb_residual == figures.natural_residual <= 1.01e-8
    empty = ccp.ConeProblem(SELF, np.zeros((0, 3)), np.zeros(0), N=matrix(SELF, np.zeros((0, 0))))
    assert solve(empty).reason == "no contacts"
    opening = ccp.ConeProblem(SELF, np.array([[0.1, 5.0, 0.0]]), np.array([1.0]), N=matrix(SELF, np.eye(3)))
    assert np.array_equal(solve(opening).impulse, np.zeros((1, 3)))  # the cone problem would hold it back


@pytest.mark.skipif(not SHARED.is_dir(), reason="published problems are not here")
@pytest.mark.parametrize(
    ("name", "tol"),
    [("Box_Stacks-i0122-82-5", 1e-8), ("LMGC_100_PR_PerioBox-i00361-60-03000", 1e-6), ("Spheres-i099-356-679", 1e-6)],
)
def test_published_problems(name, tol):
    problem = fclib.read(SHARED / f"{name}.hdf5", SELF)
    result = solve(problem, "apgd", tol)
    assert result.converged, result.reason
    assert result.law == "coulomb"
    figures = ccp.measure(problem, result.impulse)
    assert figures.coulomb_residual <= 1.01 * tol
    if name.startswith("Spheres"):  # Siconos 4.4, nonsmooth Gauss-Seidel to 1e-6
        assert figures.velocity_norm == pytest.approx(2.63896, rel=1e-4)
        assert figures.objective == pytest.approx(-207.9015, rel=1e-5)


@pytest.mark.parametrize(("growth", "forgets"), [(1.5, False), (5.0, True)])
def test_what_was_learnt_is_forgotten_when_the_residual_grows(growth, forgets):
    """A mass that slides with speed 3, with impulses and so residuals as we like: then the next opening is that of the
    relaxed iteration without a memory."""
    mu, r = 0.5, np.array([[-1.0, 3.0, 0.0]])
    problem = ccp.ConeProblem(SELF, r.copy(), np.array([mu]), N=matrix(SELF, np.eye(3)))
    openings, answers = [], [1 + error for error in (0.1, 0.02, 0.02 * growth, 0.0)]

    def convex(relaxed, guess, limits):
        openings.append(relaxed.r[0, 0] - r[0, 0])
        assert np.array_equal(problem.r, r)
        g = answers[len(openings) - 1] * np.array([[1.0, -mu, 0.0]])
        return ccp.Result(g, Status.CONVERGED, "", 0.0, 1, 0, 0, [0.0])

    result = fixed_point(convex, problem, np.zeros((1, 3)), Limits(1e-6))
    assert result.converged
    assert result.history[2] == pytest.approx(growth * result.history[1], rel=0.1)
    sliding = 3.0 - mu * answers[2]
    relaxed = openings[2] + (mu * sliding - openings[2]) / (1 + mu**2)
    assert (openings[3] == pytest.approx(relaxed, rel=1e-12)) == forgets


def figures_of(comm, solver):
    problem = sliding_heap(0.3, comm=comm)
    result = solve(problem, solver, 1e-7)
    figures = ccp.measure(problem, result.impulse)
    assert result.converged
    assert comm.allgather((figures, result.history)) == [(figures, result.history)] * comm.size
    return figures.velocity_norm, figures.objective


@pytest.mark.parallel(2)
def test_the_answer_does_not_depend_on_the_ranks():
    expected = alone(lambda comm: figures_of(comm, "apgd"))
    for solver in ("apgd", "conic"):
        np.testing.assert_allclose(figures_of(MPI.COMM_WORLD, solver), expected, rtol=1e-5)
