"""A sphere on a plane: rolling, slipping, and the change from one to the other."""

from __future__ import annotations

import numpy as np
import pytest
from drive import RADIUS, SOLVERS, G, make_steps, on_incline, sphere, steps


def slip(world):
    """Velocity (2,) of the lowest point of the sphere in the plane."""
    velocity = world.grains.velocity[0]
    return velocity[:2] + RADIUS * np.array([-velocity[4], velocity[3]])


@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("share", [0.3, 0.99])
def test_a_sphere_rolls_up_to_three_and_a_half_times_the_friction_angle(solver, share):
    mu, dt, count = 0.2, 0.01, 30
    slope = np.arctan(share * 3.5 * mu)
    world = sphere(on_incline(slope, mu))
    mass = world.grains.mass[0]
    for step in steps(world, count, dt, solver):
        k, acceleration = world.step, 5 / 7 * G * np.sin(slope)
        np.testing.assert_allclose(slip(world), 0.0, atol=1e-6)
        assert world.grains.velocity[0, 0] == pytest.approx(acceleration * dt * k, abs=1e-6)
        assert world.grains.position[0, 0] == pytest.approx(acceleration * dt**2 * k * (k + 1) / 2, abs=1e-7)
        held = mass * G * dt * np.array([2 / 7 * np.sin(slope), 0.0, -np.cos(slope)])
        np.testing.assert_allclose(step.impulse_on_b().sum(axis=0), held, atol=1e-6)
    assert step.friction_used() == pytest.approx(share * mu, rel=1e-4)


@pytest.mark.parametrize("solver", SOLVERS)
def test_a_sliding_sphere_ends_up_rolling(solver):
    """v = 5/7 v0 from t = 2 v0 / (7 mu g) on, after 12 v0^2 / (49 mu g); time and place to first order in dt."""
    mu, start, time = 0.3, 1.0, 0.2
    instant, way = 2 * start / (7 * mu * G), 12 * start**2 / (49 * mu * G)
    far = way + 5 / 7 * start * (time - instant)
    errors = []
    for dt in (0.01, 0.005):
        world = sphere(on_incline(0.0, mu), dt * mu * start, velocity=(start, 0.0, -3.5 * mu**2 * G * dt))
        rolls_from = None
        for _ in steps(world, round(time / dt), dt, solver):
            if rolls_from is None and abs(slip(world)[0]) < 1e-6:
                rolls_from, there = world.time, world.grains.position[0, 0]
        assert rolls_from is not None
        assert abs(rolls_from - instant) < 2 * dt
        assert abs(there - way) < 2 * dt * start
        np.testing.assert_allclose(slip(world), 0.0, atol=1e-6)
        assert world.grains.velocity[0, 0] == pytest.approx(5 / 7 * start, abs=1e-6)
        errors.append(world.grains.position[0, 0] - far)
    assert abs(errors[1]) < 2e-3
    assert errors[0] / errors[1] == pytest.approx(2.0, rel=0.15)


@pytest.mark.parametrize("solver", SOLVERS)
def test_friction_does_not_act_on_spin_about_the_normal(solver):
    world = sphere(on_incline(0.0, 0.5), spin=(0.0, 0.0, 3.0))
    make_steps(world, 10, 0.01, solver)
    np.testing.assert_allclose(world.grains.velocity[0], [0, 0, 0, 0, 0, 3.0], atol=1e-7)
