"""A sphere on a plane: rolling, slipping, and the change from one to the other; a capsule over joints."""

from __future__ import annotations

import numpy as np
import pytest
from drive import RADIUS, SOLVERS, G, make_steps, on_incline, sphere, steps

import pctt
from dem import quaternion
from dem.mesh import Mesh
from dem.motion import Dynamic
from dem.scene import Scene
from dem.shapes import Box, Plane


def slip(world):
    """Velocity (2,) of the lowest point of the sphere in the plane."""
    velocity = world.grains.velocity[0]
    return velocity[:2] + RADIUS * np.array([-velocity[4], velocity[3]])


@pytest.mark.parametrize(("share", "solver"), [(0.3, "apgd"), (0.99, "apgd"), (0.99, "pdip")])
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


def test_a_sliding_sphere_ends_up_rolling():
    """v = 5/7 v0 from t = 2 v0 / (7 mu g) on, after 12 v0^2 / (49 mu g); time and place to first order in dt."""
    mu, start, time = 0.3, 1.0, 0.2
    instant, way = 2 * start / (7 * mu * G), 12 * start**2 / (49 * mu * G)
    far = way + 5 / 7 * start * (time - instant)
    errors = []
    for dt in (0.01, 0.005):
        world = sphere(on_incline(0.0, mu), dt * mu * start, velocity=(start, 0.0, -3.5 * mu**2 * G * dt))
        rolls_from = None
        for _ in steps(world, round(time / dt), dt):
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


@pytest.mark.parametrize("floor", ["tiles", "meshes"])
def test_a_capsule_rolls_over_joints_as_over_a_plane(floor):
    """Flush tiles, and meshes that abut, askew too: its spin about its axis does not move its surface."""
    scene, radius, width, yaw = Scene(0.4), 0.05, 0.037, 0.0 if floor == "tiles" else 0.3
    for n in range(-4, 12):
        if floor == "tiles":
            scene.add_body(f"{n}", [Box((width / 2, 1.0, 0.05), center=(width * (n + 0.5), 0, -0.05))])
        else:
            corners = [(width * (n + i), j, 0) for i, j in ((0, -1), (1, -1), (1, 1), (0, 1))]
            scene.add_body(f"{n}", [Mesh(corners, [(0, 1, 2), (0, 2, 3)])])
    way = np.array((np.cos(yaw), np.sin(yaw), 0))
    about = quaternion.exponential(np.array((0, 0, yaw)))
    turn = quaternion.multiply(about, quaternion.exponential(np.array((np.pi / 2, 0, 0))))
    spin = np.cross((0, 0, 1), way) / radius
    scene.add_capsules(
        (0.013, 0, radius), radius, 0.1, 2500.0, quaternions=turn, velocity=way, angular_velocity=spin
    )
    sim = pctt.Simulation(scene)
    energy = sim.kinetic_energy
    sim.run(until=0.2)
    assert sim.kinetic_energy == pytest.approx(energy, rel=3e-4)
    np.testing.assert_allclose(sim.velocities[0, :3], way, atol=3e-4)


@pytest.mark.parametrize(("sides", "within"), [(32, 0.02), (64, 0.07)])
def test_a_wheel_with_many_sides_loses_what_a_polygon_loses(sides, within):
    """Each side leaves (I + m R^2 cos(2 pi / n)) / (I + m R^2) of its spin. It goes over 0.3 and 0.6 sides in
    a step of the default."""
    radius, half, speed, scene = 0.05, 0.1, 0.5, Scene(0.5)
    lying = quaternion.exponential(np.array((-np.pi / 2, 0, 0)))
    wheel = Mesh.revolved([(0, -half), (radius, -half), (radius, half), (0, half)], sides)
    height = -quaternion.rotate(lying, wheel.vertices)[:, 2].min()
    pose = {"position": (0, 0, height + 1e-9), "quaternion": lying}
    scene.add_body("floor", [Plane((0, 0, 1))])
    motion = {"velocity": (speed, 0, 0), "angular_velocity": (0, speed / radius, 0)}
    across = (3 * radius**2 + 4 * half**2) / 12
    moments = [across, across, radius**2 / 2]  # of a kilogram
    scene.add_body("wheel", [wheel], Dynamic(), mass=1.0, inertia=moments, **pose, **motion)
    sim = pctt.Simulation(scene)
    sim.run(until=0.05)
    energy, angle = sim.kinetic_energy, []
    sim.run(until=0.6, call=lambda sim: angle.append(sim.settings.dt * sim.body("wheel").velocity[4]))
    side = 2 * np.pi / sides
    kept = ((0.5 + np.cos(side)) / 1.5) ** (2 * sum(angle) / side)
    assert sim.kinetic_energy / energy == pytest.approx(kept, abs=within)
