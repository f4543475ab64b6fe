"""A block on a plane sticks, slides and stops as Coulomb says, apart from the lift of the plain CCP."""

from __future__ import annotations

import numpy as np
import pytest
from drive import HALF, SOLVERS, G, block, make_steps, on_incline, steps
from mpi4py import MPI

from dem.scene import Scene
from dem.shapes import Plane
from pctt.simulation import Simulation

MU = 0.3


@pytest.mark.parametrize(("share", "solver"), [(0.0, "apgd"), (0.5, "apgd"), (0.99, "apgd"), (0.99, "pdip")])
def test_below_the_friction_angle_a_block_stays_where_it_is(solver, share):
    slope = np.arctan(share * MU)
    world, dt = block(on_incline(slope, MU)), 0.01
    last = make_steps(world, 20, dt, solver)
    np.testing.assert_allclose(world.grains.position[0], [0, 0, HALF[2]], atol=1e-8)
    np.testing.assert_allclose(world.grains.velocity[0], 0.0, atol=1e-7)
    held = world.grains.mass[0] * G * dt * np.array([np.sin(slope), 0.0, -np.cos(slope)])
    np.testing.assert_allclose(last.impulse_on_b().sum(axis=0), held, atol=1e-6)


@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize(("slope", "friction"), [(0.3, 0.3), (0.5, 0.3), (0.5, 0.1), (0.4, 0.0)])
def test_a_block_that_slides_steadily_is_exactly_implicit_euler(solver, slope, friction):
    """Started with the lift of a sliding block, it has v_k = v_0 + a dt k from the first step."""
    acceleration = G * (np.sin(slope) - friction * np.cos(slope))
    start, dt, count = 0.5, 0.01, 10
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


@pytest.mark.parametrize("flush", [False, True])
def test_a_sliding_block_comes_to_rest_after_its_braking_distance(flush):
    """v0^2 / (2 mu g), short by dt v0 / 2, also from a flush start, where the plain CCP makes it hop."""
    start, errors = 1.0, []
    distance = start**2 / (2 * MU * G)
    for dt in (0.02, 0.01):
        lift, sink = (0.0, 0.0) if flush else (dt * MU * start, -(MU**2) * G * dt)
        world = block(on_incline(0.0, MU), lift, velocity=(start, 0.0, sink))
        make_steps(world, round(0.4 / dt), dt)
        np.testing.assert_allclose(world.grains.velocity[0], 0.0, atol=1e-7)
        np.testing.assert_allclose(world.grains.position[0, 1:], [0.0, HALF[2]], atol=1e-7)
        errors.append(distance - world.grains.position[0, 0])
        assert errors[-1] == pytest.approx(dt * start / 2, rel=0.02)
    assert errors[0] / errors[1] == pytest.approx(2.0, rel=0.02)


def test_a_block_slides_when_its_friction_is_made_less_and_a_checkpoint_keeps_it(tmp_path):
    """mu = 0.5 holds it at 20 degrees; with 0.1 it goes down with g (sin - mu cos)."""
    tilt = np.radians(20)
    scene = Scene(0.9, gravity=9.81 * np.array([np.sin(tilt), 0, -np.cos(tilt)]))
    scene.set_pair("stone, wet", "steel", friction=0.5)
    scene.add_body("floor", [Plane((0, 0, 1))], material="steel")
    scene.add_boxes([0, 0, 0.1], (0.2, 0.2, 0.1), 1000.0, material="stone, wet")
    sim = Simulation(scene, dt=0.01, tol=1e-8, comm=MPI.COMM_SELF)
    sim.run(steps=20)
    assert abs(sim.velocities[0, 0]) < 1e-6
    sim.change("pair steel, stone, wet", friction=0.1)
    sim.run(steps=10)
    sim.save(tmp_path / "slides.h5")
    with Simulation.load(tmp_path / "slides.h5", scene, dt=0.01, tol=1e-8, comm=MPI.COMM_SELF) as again:
        again.run(steps=10)
        assert again.velocities[0, 0] == pytest.approx(0.2 * 9.81 * (np.sin(tilt) - 0.1 * np.cos(tilt)), rel=1e-5)


def test_light_bodies_on_and_beside_a_heavy_one_that_slides_are_not_thrown_up():
    """The tolerance is relative to all impulses, of which those of a body of a millionth of the mass are no part."""
    slope, half = np.pi / 4, 0.01
    scene = Scene(0.2, gravity=(G * np.sin(slope), 0, -G * np.cos(slope)))
    scene.add_body("slope", [Plane((0, 0, 1))])
    scene.add_boxes([0, 3, 0.5], (0.5, 0.5, 0.5), 8000.0)
    scene.add_boxes([[0, 3, 1 + half], [0, 0, half]], (half, half, half), 1000.0)
    scene.add_spheres([0, -1, half], half, 1000.0)
    with Simulation(scene, dt=0.003) as sim:
        start = sim.positions
        for _ in range(60):
            sim.step()
            assert (sim.positions - start)[1:, 2] == pytest.approx(np.zeros(3), abs=0.02 * half)
        speed = G * (np.sin(slope) - 0.2 * np.cos(slope)) * sim.time
        assert sim.velocities[:, 0] == pytest.approx(np.full(4, speed), rel=2e-2)
