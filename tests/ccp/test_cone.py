"""The friction cone: projections against their definition, steps against bisection."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pctt.ccp import FrictionCones, RollingCones
from pctt.ccp.accuracy import _nearest_in_cone
from pctt.ccp.cones.friction import project, step_to_boundary, step_to_zero


def margin(x, mu):
    """How far inside the cone a point is along the tangents."""
    return mu * x[:, 0] - np.hypot(x[:, 1], x[:, 2])


FRICTION = [0.0, 1e-9, 0.01, 0.3, 1.0, 7.0, 1e5]


def judged(x, mu):
    """The projection that judges the solvers."""
    return np.array([_nearest_in_cone(*row, slope) for row, slope in zip(x, mu)])


PROJECTIONS = [project, judged]

unhurried = settings(deadline=None, max_examples=60)  # a busy machine is no failure

numbers = st.floats(-1e3, 1e3).map(lambda x: 0.0 if abs(x) < 1e-100 else x)
points = st.tuples(numbers, numbers, numbers).map(lambda x: np.array([x]))
frictions = st.one_of(st.sampled_from(FRICTION), st.floats(1e-6, 100.0)).map(lambda mu: np.array([mu]))


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


def test_distances_from_cones():
    x = np.array([[1.0, 0.0, 0.2], [1.0, 0.3, 0.4], [1.0, 3.0, 4.0], [-2.0, 0.0, 0.0]])
    found = FrictionCones(np.full(4, 0.5)).distance(x)
    assert np.allclose(found, [0.0, 0.0, 4.5 / np.sqrt(1.25), 2.0])
    turned = np.concatenate([x * [1, 0, 0], x[:, [1, 0, 2]] * [1, 0, 1]])  # the same numbers, as rolls
    rolls = RollingCones(np.full(4, 0.3), np.full(4, 0.5), np.zeros(4))
    spin = np.abs(turned[4:, 0])
    turned[4:, 0], turned[4:, 1] = 0.0, spin
    assert np.allclose(rolls.distance(turned), found)


def test_a_step_in_cones_of_discs_ends_where_the_first_disc_does():
    """The general rule, by Lorentz cones, beside that of friction alone."""
    rng = np.random.default_rng(0)
    mu, rho, sigma = rng.uniform(0.1, 1.0, (3, 50))
    for c in range(50):
        friction, rolling = mu[c : c + 1], RollingCones(mu[c : c + 1], rho[c : c + 1], sigma[c : c + 1])
        x, dx = np.array([[1.0, 0, 0], [0, 0, 0]]), rng.normal(size=(2, 3))
        parts = [(x[:1], dx[:1], friction), (x[:1], np.c_[dx[:1, :1], dx[1:, 1:]], rho[c : c + 1])]
        parts.append((x[:1], np.array([[dx[0, 0], dx[1, 0], 0.0]]), sigma[c : c + 1]))
        expected = min(step_to_boundary(*part) for part in parts)
        assert rolling.step_length(x, dx) == pytest.approx(expected, rel=1e-9)
        assert FrictionCones(friction).step_length(*parts[0][:2]) == step_to_boundary(*parts[0])


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
    friction = np.full(80, mu)
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
