"""The figures of a solution against examples worked out by hand."""

from __future__ import annotations

import numpy as np
import pytest
from problems import SELF, from_graph, heap, matrix

from pctt import ccp


def problem(diagonal, r, mu) -> ccp.ConeProblem:
    return ccp.ConeProblem(SELF, np.array(r, float), np.array(mu, float), N=matrix(SELF, np.diag(diagonal)))


def test_a_sticking_contact_worked_out_by_hand():
    """N = diag(2, 4, 6), of mean 4; y = N g + r = (0, 2, 0); g - y / 4 = (1, -0.25, 0) is inside the cone."""
    figures = ccp.measure(problem([2, 4, 6], [[-2, 1, 0]], [0.5]), np.array([[1, 0.25, 0]]))
    norm = np.sqrt(1 + 0.25**2)
    assert figures.natural_residual == pytest.approx(0.5 / norm)
    assert figures.objective == pytest.approx(0.5 * (2 + 4 * 0.25**2) + (-2 + 0.25))
    assert figures.cone_violation == 0.0
    assert figures.dual_violation == pytest.approx(1.0)
    assert figures.complementarity == pytest.approx(0.5)
    assert figures.impulse_norm == pytest.approx(norm)
    assert figures.velocity_norm == pytest.approx(2.0)


def test_impulses_may_be_flat_and_have_one_shape_else():
    known = problem(np.ones(6), [[-2, 1, 0], [-1, 0, 0]], [0.5, 0.5])
    impulses = np.arange(6.0)
    assert ccp.measure(known, impulses) == ccp.measure(known, impulses.reshape(2, 3))
    by_limits = [ccp.solve(known, impulses, limits=each) for each in ({"tol": 1e-6}, ccp.Limits(1e-6))]
    np.testing.assert_array_equal(*(result.impulse for result in by_limits))
    for wrong in (impulses[:3], impulses.reshape(3, 2)):
        with pytest.raises(ValueError, match=r"impulses of shape .*; allowed is \(2, 3\)"):
            ccp.measure(known, wrong)
    with pytest.raises(ValueError, match="impulses of no numbers"):
        ccp.measure(known, "none")


def test_two_contacts_worked_out_by_hand():
    """N = 1, y = g + r. First contact: g - y = -r = (1, 0, 3), projected at mu = 1 on (2, 0, 2). Second,
    without friction: -r = (-1, 4, 0), projected on the origin."""
    figures = ccp.measure(
        problem(np.ones(6), [[-1, 0, -3], [1, -4, 0]], [1, 0]), np.array([[2, 0, 3], [0.5, 0.3, 0.4]])
    )
    norm = np.sqrt(13 + 0.5)
    assert figures.natural_residual == pytest.approx(np.sqrt(1 + 0.5) / norm)
    assert figures.objective == pytest.approx(0.5 * 13.5 + (-2 - 9) + (0.5 - 1.2))
    assert figures.cone_violation == pytest.approx(1.0)  # 3 - 2; the second is out by 0.5
    assert figures.dual_violation == 0.0  # y = (1, 0, 0) and (1.5, -3.7, 0.4)
    assert figures.closing_work == 0.0
    assert figures.opening_work == pytest.approx(2.0 / (0.5 * 13.5))
    assert figures.complementarity == pytest.approx(2.0)  # of the first; that of the second is -0.2
    assert figures.velocity_norm == pytest.approx(np.sqrt(1 + 1.5**2 + 3.7**2 + 0.4**2))


def residuals(problem: ccp.ConeProblem, g: np.ndarray) -> list[float]:
    """Of the judge and of the solvers, for Coulomb's law and for its relaxation."""
    y, figures = problem.product(g) + problem.r, ccp.measure(problem, g)
    judged = [figures.coulomb_residual, figures.natural_residual]
    return judged + [problem.natural_residual(g, y, coulomb) for coulomb in (True, False)]


@pytest.mark.parametrize("rolls", [False, True])
def test_what_slides_without_pressure_needs_no_impulse(rolls):
    """y_n = 0 and y_t any: up to rounding zero is the nearest point, so the residuals are zero. But a velocity of 1e-13
    against the normal counts, as it is more than rounding."""
    rng = np.random.default_rng(4)
    slip = rng.normal(size=(200, 2))
    mu = rng.uniform(0.1, 2.0, 200)
    r = np.column_stack([np.zeros(200), slip])
    if rolls:
        turning, more = rng.normal(size=(200, 3)), rng.uniform(0.1, 2.0, (2, 200))
        blocks = np.tile(np.eye(3, 6), (400, 1, 1))
        G = ccp.BlockRows(np.arange(401), np.arange(400), blocks, 400)
        rows = np.concatenate([r, turning])

        def made(r: np.ndarray) -> ccp.ConeProblem:
            return ccp.ConeProblem(SELF, np.concatenate([r, turning]), cones=ccp.RollingCones(mu, *more), G=G)

        dual = mu * np.hypot(*slip.T) + more[0] * np.hypot(*turning[:, 1:].T) + more[1] * np.abs(turning[:, 0])
    else:
        rows, dual = r, mu * np.hypot(*slip.T)

        def made(r: np.ndarray) -> ccp.ConeProblem:
            return problem(np.ones(600), r, mu)

    nothing = np.zeros_like(rows)
    assert residuals(made(r), nothing)[::2] == [0.0, 0.0]
    assert residuals(made(r + np.outer(dual, [1, 0, 0])), nothing)[1::2] == [0.0, 0.0]
    size = np.linalg.norm(rows)
    closing = made(r - [1e-13 * size, 0, 0])
    assert closing.natural_residual(nothing, closing.r, coulomb=True) == np.inf
    assert ccp.measure(closing, nothing).coulomb_residual > 1e100


def test_impulses_that_are_no_numbers_have_no_small_figures():
    three = problem(2 * np.ones(9), np.zeros((3, 3)), [0.5, 0.5, 0])
    g = np.full((3, 3), np.nan)
    figures = ccp.measure(three, g)
    assert figures.closing_work == figures.opening_work == figures.closing_speed == np.inf
    assert three.errors(g, three.product(g)) == (np.inf, np.inf, np.inf)


def test_the_closing_work_of_three_contacts_worked_out_by_hand():
    """N = 2, so 1/2 g'Ng = 1 + 4 + 9; y_n = 2 g_n + r_n = -0.5, 0.3 and -0.2."""
    three = problem(2 * np.ones(9), [[-2.5, 0, 0], [-3.7, 0, 0], [-6.2, 0, 0]], [0.5, 0.5, 0])
    g = np.array([[1.0, 0, 0], [2.0, 0, 0], [3.0, 0, 0]])
    figures = ccp.measure(three, g)
    assert figures.closing_work == pytest.approx((1 * 0.5 + 3 * 0.2) / 14)
    assert figures.closing_speed == three.errors(g, three.product(g) + three.r).speed == pytest.approx(0.5)


def column(count: int, stopped: int = -1) -> tuple[ccp.ConeProblem, np.ndarray]:
    """A column of contacts, of which the first closes and one is with the ground, and its normal impulses: N_n is
    tridiagonal, and its modes are much softer than a contact alone."""
    N = np.eye(3 * count)
    normal = np.arange(0, 3 * count, 3)
    N[np.ix_(normal, normal)] = 2 * np.eye(count) - np.eye(count, k=1) - np.eye(count, k=-1)
    N[normal[stopped], normal[stopped]] = 1.0
    r = np.zeros((count, 3))
    r[0, 0] = -1.0
    exact = np.linalg.solve(N[np.ix_(normal, normal)], -r[:, 0])
    return ccp.ConeProblem(SELF, r, np.full(count, 0.3), N=matrix(SELF, N)), exact


def test_the_closing_work_shows_what_the_natural_residual_hides():
    """Of a column that is hit at its head. At a natural residual of 1e-4 the objective still lacks more than a
    thousandth."""
    problem, exact = column(200)
    least = 0.5 * problem.r[:, 0] @ exact
    for tol in (1e-2, 1e-3, 1e-4, 1e-5):
        limits = ccp.Limits(tol, closing_work=np.inf)
        figures = ccp.measure(problem, ccp.solve(problem, type="apgd", limits=limits, law=ccp.RELAXATION).impulse)
        assert figures.natural_residual <= tol
        assert (figures.objective - least) / abs(least) < 10 * figures.closing_work
        assert figures.closing_work > tol or tol == 1e-2


@pytest.mark.parametrize("solver", ["apgd", "conic", "pdip", "auto", "gauss_seidel"])
@pytest.mark.parametrize("mass", [1e4, 1e5, 1e6])
@pytest.mark.parametrize("law", ccp.LAWS)
def test_a_heavy_body_among_light_ones_comes_to_rest(solver, mass, law):
    """Point masses that strike the ground: each contact alone has the impulse mass times speed. The natural residual
    is relative to the heavy one, and in units of the light ones."""
    masses = np.append(np.ones(50), mass)
    struck = problem(np.repeat(1.0 / masses, 3), np.tile([-1.0, 0.0, 0.0], (51, 1)), np.full(51, 0.5))
    result = ccp.solve(struck, type=solver, law=law)
    assert result.converged, result.reason
    assert result.impulse[-1] == pytest.approx([mass, 0, 0], rel=0.05, abs=0.05 * mass)
    assert ccp.measure(struck, result.impulse).opening_work <= 0.05


@pytest.mark.parametrize("solver", ["apgd", "conic", "pdip", "auto"])
@pytest.mark.parametrize("law", ccp.LAWS)
def test_a_solver_goes_on_until_no_contact_closes_by_much(solver, law):
    """A column that comes to rest on the ground."""
    problem, exact = column(30, stopped=0)
    off, work = [], []
    for limit in (np.inf, 0.05):
        limits = ccp.Limits(5e-3, closing_work=limit)
        result = ccp.solve(problem, type=solver, limits=limits, law=law)
        assert result.converged, result.reason
        work.append(ccp.measure(problem, result.impulse).closing_work)
        off.append(np.abs(result.impulse[:, 0] - exact).max())
    assert work[0] > 0.05 >= work[1]
    assert off[1] < 0.1 * exact.max() < off[0]


@pytest.mark.parametrize("solver", ["apgd", "conic", "auto", "gauss_seidel"])
@pytest.mark.parametrize("law", ccp.LAWS)
def test_one_contact_of_many_does_not_close(solver, law):
    """A light body meets the ground beside heavy ones, whose impulses are known. Next to these its own is nothing, so
    that neither the natural residual nor the closing work sees that it is missing; its closing speed does."""
    masses = np.append(np.full(50, 1e4), 1.0)
    struck = problem(np.repeat(1.0 / masses, 3), np.tile([-1.0, 0.0, 0.0], (51, 1)), np.full(51, 0.5))
    guess = np.outer(np.append(masses[:-1], 0.0), [1.0, 0.0, 0.0])
    found = []
    for speed in (np.inf, 0.1):
        result = ccp.solve(struck, guess, solver, ccp.Limits(1e-3, closing_speed=speed), law=law)
        assert result.converged, result.reason
        found.append(ccp.measure(struck, result.impulse).closing_speed)
    assert found[1] <= 0.1
    if solver != "conic":  # which leaves the guess
        assert found[0] == 1.0


@pytest.mark.parametrize(
    ("limits", "words"),
    [
        (ccp.Limits(1e-2, closing_work=1e-30), "closing or opening work "),
        (ccp.Limits(1e-2, closing_work=np.inf, closing_speed=1e-30), "closing speed "),
    ],
)
def test_a_residual_far_below_the_tolerance_is_enough(limits, words):
    """Whatever the closing work is: where bodies are squeezed it may stay large."""
    problem, _ = column(200)
    result = ccp.solve(problem, type="apgd", limits=limits, law=ccp.RELAXATION)
    assert result.status is ccp.Status.SQUEEZED
    assert result.reason.startswith("squeezed: " + words)
    assert not result.converged
    assert result.asked is None  # no other method would do better
    assert 1e-7 < ccp.measure(problem, result.impulse).natural_residual <= 1.01e-5


def test_the_measure_agrees_with_the_stop_test_of_the_solvers():
    """They share no code."""
    known, graph = heap(seed=5, mu=np.arange(40) % 3 * 0.4)
    each = from_graph(known, graph)
    rng = np.random.default_rng(0)
    for size in (1e-6, 1e-2, 1.0, 100.0):
        g = known.g + size * rng.normal(size=known.g.shape)
        y = each.product(g) + each.r
        assert ccp.measure(each, g).natural_residual == pytest.approx(each.natural_residual(g, y), rel=1e-9)


def test_a_problem_without_contacts():
    figures = ccp.measure(problem([], np.zeros((0, 3)), []), np.zeros((0, 3)))
    assert figures == ccp.Accuracy(*[0.0] * 11)
