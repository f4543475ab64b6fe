"""A block on a plane sticks, slides and stops as Coulomb says, apart from the lift of the plain CCP."""

from __future__ import annotations

import numpy as np
import pytest
from drive import HALF, SOLVERS, G, block, make_steps, on_incline, steps

MU = 0.3


@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("share", [0.0, 0.5, 0.99])
def test_below_the_friction_angle_a_block_stays_where_it_is(solver, share):
    slope = np.arctan(share * MU)
    world, dt = block(on_incline(slope, MU)), 0.01
    last = make_steps(world, 40, dt, solver)
    np.testing.assert_allclose(world.grains.position[0], [0, 0, HALF[2]], atol=1e-8)
    np.testing.assert_allclose(world.grains.velocity[0], 0.0, atol=1e-7)
    held = world.grains.mass[0] * G * dt * np.array([np.sin(slope), 0.0, -np.cos(slope)])
    np.testing.assert_allclose(last.impulse_on_b().sum(axis=0), held, atol=1e-6)


@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize(("slope", "friction"), [(0.3, 0.3), (0.5, 0.3), (0.5, 0.1), (0.4, 0.0)])
def test_a_block_that_slides_steadily_is_exactly_implicit_euler(solver, slope, friction):
    """Started with the lift of a sliding block, it has v_k = v_0 + a dt k from the first step."""
    acceleration = G * (np.sin(slope) - friction * np.cos(slope))
    start, dt, count = 0.5, 0.01, 30
    world = block(
        on_incline(slope, friction),
        lift=dt * friction * start,
        velocity=(start, 0.0, friction * acceleration * dt),
    )
    for _ in steps(world, count, dt, solver):
        k = world.step
        speed = start + acceleration * dt * k
        position = start * dt * k + acceleration * dt**2 * k * (k + 1) / 2
        velocity = [speed, 0, friction * acceleration * dt, 0, 0, 0]
        np.testing.assert_allclose(world.grains.velocity[0], velocity, atol=1e-6)
        lift = dt * friction * speed
        np.testing.assert_allclose(world.grains.position[0], [position, 0, HALF[2] + lift], atol=1e-7)


@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("flush", [False, True])
def test_a_sliding_block_comes_to_rest_after_its_braking_distance(solver, flush):
    """v0^2 / (2 mu g), short by dt v0 / 2, also from a flush start, where the plain CCP makes it hop."""
    start, errors = 1.0, []
    distance = start**2 / (2 * MU * G)
    for dt in (0.02, 0.01):
        lift, sink = (0.0, 0.0) if flush else (dt * MU * start, -(MU**2) * G * dt)
        world = block(on_incline(0.0, MU), lift, velocity=(start, 0.0, sink))
        make_steps(world, round(0.5 / dt), dt, solver)
        np.testing.assert_allclose(world.grains.velocity[0], 0.0, atol=1e-7)
        np.testing.assert_allclose(world.grains.position[0, 1:], [0.0, HALF[2]], atol=1e-7)
        errors.append(distance - world.grains.position[0, 0])
        assert errors[-1] == pytest.approx(dt * start / 2, rel=0.02)
    assert errors[0] / errors[1] == pytest.approx(2.0, rel=0.02)
