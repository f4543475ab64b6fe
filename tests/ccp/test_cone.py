"""The friction cone: projections against their definition, steps against bisection."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize

from pctt.ccp.accuracy import _nearest_in_cone
from pctt.ccp.cone import margin, project, step_to_boundary, step_to_zero

FRICTION = [0.0, 1e-9, 0.01, 0.3, 1.0, 7.0, 1e5]
PROJECTIONS = [project, _nearest_in_cone]

unhurried = settings(deadline=None)  # a busy machine is no failure

numbers = st.floats(-1e3, 1e3).map(lambda x: 0.0 if abs(x) < 1e-100 else x)
points = st.tuples(numbers, numbers, numbers).map(lambda x: np.array([x]))
frictions = st.one_of(st.sampled_from(FRICTION), st.floats(1e-6, 100.0)).map(lambda mu: np.array([mu]))


def random_points(count: int = 300, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=(count, 3))


def random_inside(rng: np.random.Generator, mu: np.ndarray, depth: float = 1.0) -> np.ndarray:
    """Points inside the cones: ``depth`` 1 anywhere, small close to the surface."""
    x = np.empty((len(mu), 3))
    angle = rng.uniform(0, 2 * np.pi, len(mu))
    x[:, 0] = rng.uniform(0.1, 3.0, len(mu))
    radius = mu * x[:, 0] * (1 - depth * rng.uniform(0.01, 1.0, len(mu)))
    x[:, 1], x[:, 2] = radius * np.cos(angle), radius * np.sin(angle)
    return x


# -- projection ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("projection", PROJECTIONS)
@unhurried
@given(x=points, mu=frictions)
def test_projection_satisfies_its_optimality_conditions(projection, x, mu):
    """p is the nearest point of a convex cone K to x: p in K, p - x in the dual cone, p.(p - x) = 0."""
    p = projection(x, mu)
    normal = p - x
    size = max(np.abs(x).max(), 1e-30)
    steep = 1 + mu[0]
    assert margin(p, mu)[0] >= -1e-13 * size * steep
    assert p[0, 0] >= 0
    assert normal[0, 0] - mu[0] * np.hypot(normal[0, 1], normal[0, 2]) >= -1e-13 * size * steep
    assert abs((p * normal).sum()) <= 1e-13 * size**2 * steep


@pytest.mark.parametrize("projection", PROJECTIONS)
@pytest.mark.parametrize("mu", [0.0, 0.2, 1.0, 4.0])
def test_projection_is_the_nearest_point_that_a_minimisation_finds(projection, mu):
    for x in random_points(8):
        on_axis = np.array([1.0, 0.0, 0.0])
        found = minimize(
            lambda p, x=x: ((p - x) ** 2).sum(),
            on_axis,
            method="SLSQP",
            constraints=[
                {"type": "ineq", "fun": lambda p: mu**2 * p[0] ** 2 - p[1] ** 2 - p[2] ** 2},
                {"type": "ineq", "fun": lambda p: p[0]},
            ]
            if mu > 0
            else [{"type": "ineq", "fun": lambda p: p[0]}, {"type": "eq", "fun": lambda p: p[1:]}],
            options={"ftol": 1e-14, "maxiter": 500},
        )
        p = projection(x[None], np.array([mu]))[0]
        assert np.linalg.norm(p - x) <= np.linalg.norm(found.x - x) + 1e-6
        if np.linalg.norm(p) > 1e-3:  # at the apex the squared constraint has no gradient, and SLSQP stalls
            assert np.allclose(p, found.x, atol=1e-4)


@unhurried
@given(x=points, mu=frictions)
def test_projecting_twice_changes_nothing(x, mu):
    once = project(x, mu)
    assert np.allclose(project(once, mu), once, rtol=1e-13, atol=1e-13 * np.abs(x).max() * mu[0] + 1e-300)


@unhurried
@given(x=points, mu=st.floats(1e-3, 1e3).map(lambda mu: np.array([mu])))
def test_moreau_decomposition(x, mu):
    """x = P_K(x) - P_K*(-x), and the dual cone mu |y_t| <= y_n is the cone of friction 1 / mu."""
    inside, outside = project(x, mu), project(-x, 1 / mu)
    assert np.allclose(inside - outside, x, rtol=0, atol=1e-12 * max(np.abs(x).max(), 1e-300))
    assert abs((inside * outside).sum()) <= 1e-11 * (x * x).sum()


@unhurried
@given(x=points, y=points, mu=frictions)
def test_projection_brings_no_two_points_further_apart(x, y, mu):
    before, after = np.linalg.norm(x - y), np.linalg.norm(project(x, mu) - project(y, mu))
    assert after <= before * (1 + 1e-12) + 1e-12 * max(np.abs(x).max(), np.abs(y).max())


def test_points_inside_come_back_bit_for_bit():
    rng = np.random.default_rng(1)
    mu = rng.uniform(0.0, 2.0, 100)
    x = random_inside(rng, mu)
    assert np.array_equal(project(x, mu), x)


@pytest.mark.parametrize("projection", PROJECTIONS)
def test_the_polar_cone_goes_to_zero_exactly(projection):
    """Also without friction and without any tangential part, where -mu g_n is a negative zero."""
    rng = np.random.default_rng(2)
    mu = rng.uniform(0.05, 2.0, 200)
    mu[:20] = 0.0
    polar = random_inside(rng, 1 / np.maximum(mu, 1e-3)) * [-1.0, 1.0, 1.0]
    polar[:10, 1:] = 0.0
    assert np.array_equal(projection(polar, mu), np.zeros_like(polar))
    assert np.array_equal(projection(np.zeros((2, 3)), np.array([0.0, 0.5])), np.zeros((2, 3)))


@pytest.mark.parametrize("projection", PROJECTIONS)
def test_known_projections(projection):
    x = np.array([[1, 0, 2], [0, 3, 4], [-1, 0, 3], [2, 5, 0], [1, 0, 0], [1e-3, 2, 0.0]])
    mu = np.array([1, 1, 1, 0, 0.5, 1e6])
    # on the surface at 45 degrees: the mean of normal and tangential part; a cone that is nearly a half space
    expected = [[1.5, 0, 1.5], [2.5, 1.5, 2], [1, 0, 1], [2, 0, 0], [1, 0, 0], [1e-3, 2, 0]]
    assert np.allclose(projection(x, mu), expected, atol=1e-11)


@pytest.mark.parametrize("mu", FRICTION)
def test_surface_points_stay(mu):
    angle = np.linspace(0, 6, 50)
    x = np.stack([np.ones(50), mu * np.cos(angle), mu * np.sin(angle)], axis=1)
    assert np.allclose(project(x, np.full(50, mu)), x, rtol=1e-14, atol=1e-14 * mu)


@unhurried
@given(x=points, mu=frictions)
def test_the_two_projections_agree(x, mu):
    """That of the solvers and that of the accuracy figures are written independently."""
    assert np.allclose(project(x, mu), _nearest_in_cone(x, mu), rtol=0, atol=1e-12 * np.abs(x).max())


def test_margin_is_positive_inside_only():
    x = np.array([[1.0, 0.0, 0.2], [1.0, 0.3, 0.4], [1.0, 3.0, 4.0]])
    assert np.allclose(margin(x, np.full(3, 0.5)), [0.3, 0.0, -4.5])


# -- steps --------------------------------------------------------------------------------------------------


def bisected_step(x: np.ndarray, dx: np.ndarray, mu: float, far: float) -> float:
    """Where x + a dx leaves the cone, by bisection on [0, far]; inf if far is inside: the cone is convex."""

    def inside(a: float) -> bool:
        p = x + a * dx
        return p[0] >= 0 and np.hypot(p[1], p[2]) <= mu * p[0]

    if inside(far):
        return np.inf
    low, high = 0.0, far
    for _ in range(200):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if inside(middle) else (low, middle)
    return low


@pytest.mark.parametrize("mu", [1e-3, 0.3, 1.0, 20.0])
@pytest.mark.parametrize("depth", [1.0, 1e-3])
def test_step_to_boundary_is_where_bisection_finds_it(mu, depth):
    rng = np.random.default_rng(3)
    friction = np.full(200, mu)
    x = random_inside(rng, friction, depth)
    dx = rng.normal(size=x.shape) * [1.0, mu, mu]
    dx[:20] = -x[:20]  # to the apex, straight
    dx[20:40, 1:] = 0.0
    unlimited = 0
    for i in range(len(x)):
        expected = bisected_step(x[i], dx[i], mu, 1e9)
        found = step_to_boundary(x[i : i + 1], dx[i : i + 1], friction[:1])
        if np.isinf(expected):
            assert found > 1e8
            unlimited += 1
        else:
            assert found == pytest.approx(expected, rel=1e-9 if i >= 20 else 1e-4)  # a double root
    assert 0 < unlimited < len(x)


def test_a_step_across_the_cone_from_its_surface_ends_at_the_other_side():
    """The first root is the start itself: the second counts, also where the start is a rounding away."""
    mu = np.array([0.5])
    across = np.array([[0.0, -1.0, 0.0]])
    for gap in (0.0, 1e-17, 1e-14, 1e-10):
        assert step_to_boundary(np.array([[1.0, 0.5 - gap, 0.0]]), across, mu) == pytest.approx(1.0)
    assert step_to_boundary(np.array([[1.0, 0.5, 0.0]]), -across, mu) == 0.0


def test_steps_along_the_surface():
    mu = np.array([0.5])
    x = np.array([[1.0, 0.1, 0.2]])
    along = np.array([[1.0, 0.5 * np.cos(1.1), 0.5 * np.sin(1.1)]])
    assert step_to_boundary(x, along, mu) > 1e10
    assert step_to_boundary(np.array([[1.0, 0.0, 0.0]]), -along, mu) == pytest.approx(0.5)
    surface = np.array([[1.0, 0.5, 0.0]])
    assert step_to_boundary(surface, -surface, mu) == pytest.approx(1.0)


def test_without_friction_the_apex_alone_limits_a_step():
    x = np.array([[2.0, 0.0, 0.0]])
    assert step_to_boundary(x, np.array([[-4.0, 1.0, 0.0]]), np.zeros(1)) == 0.5
    assert step_to_boundary(x, np.array([[4.0, 1.0, 0.0]]), np.zeros(1)) == np.inf


def test_the_nearest_contact_limits_the_step_of_all():
    rng = np.random.default_rng(4)
    mu = rng.uniform(0.1, 1.0, 50)
    x, dx = random_inside(rng, mu), rng.normal(size=(50, 3))
    one_by_one = [step_to_boundary(x[i : i + 1], dx[i : i + 1], mu[i : i + 1]) for i in range(50)]
    assert step_to_boundary(x, dx, mu) == min(one_by_one) < np.inf


def test_a_rank_without_contacts_limits_nothing():
    assert step_to_boundary(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0)) == np.inf
    assert step_to_zero(np.zeros(0), np.zeros(0)) == np.inf


def test_step_to_zero():
    x = np.array([1.0, 2.0, 3.0])
    assert step_to_zero(x, np.array([1.0, 0.0, 5.0])) == np.inf
    assert step_to_zero(x, np.array([-0.5, -4.0, 1.0])) == 0.5
