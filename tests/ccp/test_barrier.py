"""The smooth form of the cone constraint against finite differences, and the barrier blocks made of it."""

from __future__ import annotations

import numpy as np
import pytest

from pctt.ccp.interior.pdip import PDIP, Direction, Linearised, PerspectiveConstraint, Point, _next_damping


def inside(count: int = 60, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Friction coefficients, every fifth of them zero, and points inside their cones."""
    rng = np.random.default_rng(seed)
    mu = rng.uniform(0.05, 3.0, count)
    mu[::5] = 0.0
    g = np.empty((count, 3))
    g[:, 0] = rng.uniform(0.3, 2.0, count)
    angle, radius = rng.uniform(0, 2 * np.pi, count), 0.95 * rng.random(count) * mu * g[:, 0]
    g[:, 1], g[:, 2] = radius * np.cos(angle), radius * np.sin(angle)
    return g, mu


def derivative(function, g: np.ndarray, step: float = 1e-5) -> np.ndarray:
    """Central differences of a function of the rows of g, its last axis the component of g."""
    columns = []
    for k in range(3):
        e = np.zeros(3)
        e[k] = step
        columns.append((function(g + e) - function(g - e)) / (2 * step))
    return np.stack(columns, axis=-1)


def test_gradient_and_hessian_are_the_derivatives():
    g, mu = inside()
    cone = PerspectiveConstraint(mu)
    assert np.allclose(cone.gradient(g), derivative(cone.value, g), rtol=1e-6, atol=1e-7)
    assert np.allclose(cone.hessian(g), derivative(cone.gradient, g), rtol=1e-6, atol=1e-7)


def test_second_order_terms_are_what_a_step_leaves():
    """Of complementarity lambda f, and of the part of lambda grad f in which lambda and the gradient both change."""
    g, mu = inside()
    cone, rng = PerspectiveConstraint(mu), np.random.default_rng(3)
    lam, d = rng.uniform(0.5, 2.0, len(g)), Direction(0.1 * rng.normal(size=g.shape), rng.normal(size=len(g)))
    at, rest = Point(g, np.zeros_like(g), lam), (None, 0.0, np.zeros_like(g), 0.0, None)
    linear = Linearised(None, at, rest[0], cone.value(g), cone.gradient(g), cone.hessian(g), *rest[1:])
    for reach in (1.0, 0.5):
        curved, missed = linear.second_order(d, reach)
        t = 1e-3  # second differences along the direction
        values = [(lam + s * d.dlam) * cone.value(g + s * d.dg) for s in (-t, 0.0, t)]
        assert np.allclose(missed, reach * (values[0] - 2 * values[1] + values[2]) / (2 * t * t), rtol=1e-4, atol=1e-6)
        turned = (cone.gradient(g + t * d.dg) - cone.gradient(g - t * d.dg)) / (2 * t)
        assert np.allclose(curved, reach * d.dlam[:, None] * turned, rtol=1e-4, atol=1e-6)


def test_value_is_negative_inside_zero_on_the_surface_positive_outside():
    g, mu = inside()
    cone = PerspectiveConstraint(mu)
    assert (cone.value(g) < 0).all()
    rough = mu > 0
    angle = np.random.default_rng(1).uniform(0, 6, len(mu))
    rim = np.stack([g[:, 0], *(mu * g[:, 0] * [np.cos(angle), np.sin(angle)])], axis=1)
    assert np.allclose(cone.value(rim)[rough], 0, atol=1e-14)
    assert (cone.value(rim * [1, 1.1, 1.1])[rough] > 0).all()
    assert (cone.value(-g)[~rough] > 0).all()


def test_values_are_those_of_the_formulas():
    g, mu = np.array([[2.0, 0.3, -0.4], [2.0, 0.0, 0.0]]), np.array([0.5, 0.0])
    assert np.allclose(PerspectiveConstraint(mu).value(g), [0.5 * (0.125 - 0.5), -2.0])


def test_perspective_is_convex_and_of_degree_one():
    g, mu = inside()
    cone = PerspectiveConstraint(mu)
    assert np.allclose(cone.value(7 * g), 7 * cone.value(g))
    assert np.allclose((cone.gradient(g) * g).sum(1), cone.value(g))
    assert np.linalg.eigvalsh(cone.hessian(g)).min() > -1e-12
    # its gradient stays away from zero towards the apex
    assert np.allclose(cone.gradient(1e-9 * g), cone.gradient(g))


@pytest.mark.parametrize("towards_surface", [0.0, 1 - 1e-4])
def test_barrier_blocks_are_symmetric_and_positive_definite_inside(towards_surface):
    g, mu = inside()
    radius = np.maximum(np.hypot(g[:, 1], g[:, 2]), 1e-300)
    g[:, 1:] *= (1 + towards_surface * (0.9999 * mu * g[:, 0] / radius - 1))[:, None]
    cone = PerspectiveConstraint(mu)
    f, df = cone.value(g), cone.gradient(g)
    lam = np.random.default_rng(2).uniform(0.1, 2.0, len(mu))
    blocks = cone.kkt(f, df, cone.hessian(g), lam, 0.0).schur()
    assert np.allclose(blocks, blocks.transpose(0, 2, 1))
    assert np.linalg.eigvalsh(blocks).min() > 0
    rough = mu > 0
    outer = df[:, :, None] * df[:, None, :]
    expected = lam[:, None, None] * cone.hessian(g) + (lam / -f)[:, None, None] * outer
    assert np.allclose(blocks[rough], expected[rough])
    # without friction: lambda / g_n in the normal direction, and none of the tangential ones can move
    assert np.allclose(blocks[~rough, 0, 0], (lam / g[:, 0])[~rough])
    assert (blocks[~rough][:, [1, 2], [1, 2]] >= 1e11 * blocks[~rough, 0, 0][:, None]).all()
    assert (blocks[~rough][:, 0, 1:] == 0).all()


def test_after_short_steps_near_the_solution_the_proximal_term_stays_until_steps_are_long():
    options, near = PDIP(), 1e-4
    factors = [0.0]
    for step in (0.1, 0.1, 0.5, 0.9, 0.9):
        factors.append(_next_damping(factors[-1], step, near, options))
    assert 0.0 < factors[1] <= factors[2] == factors[3] > factors[4] > factors[5]
    assert _next_damping(factors[1], 0.1, 1e-2, options) == 0.0  # impulses may have to grow
