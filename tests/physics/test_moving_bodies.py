"""Grains on and in front of bodies whose motion is prescribed."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
from drive import RADIUS, SOLVERS, G, make_steps, steps
from mpi4py import MPI

import pctt
from dem import quaternion
from dem.motion import Oscillation, Path, Rotation
from dem.scene import Scene
from dem.shapes import Box, Plane
from dem.start import new_world
from dem.start.time_step import needs, recommended

HALF = (0.04, 0.03, 0.02)  #: of the block that rides on the turntable


def turntable(speed, friction):
    scene = Scene(friction)
    scene.add_body("table", [Plane((0, 0, 1))], Rotation((0, 0, speed)))
    return scene


def riding_block(speed, friction, radius):
    scene = turntable(speed, friction)
    velocity = (0, speed * radius, 0)
    scene.add_boxes([radius, 0, HALF[2]], HALF, 1000.0, velocity=velocity, angular_velocity=(0, 0, speed))
    return new_world(scene, MPI.COMM_SELF)


@pytest.mark.parametrize("solver", SOLVERS)
def test_a_turntable_carries_a_block_while_friction_can_hold_it(solver):
    """Without slip it stays where it is on the table."""
    speed, radius, friction, dt, count = 3.0, 0.3, 0.5, 0.005, 25
    assert speed**2 * radius < friction * G
    world = riding_block(speed, friction, radius)
    used = 0.0
    for step in steps(world, count, dt, solver):
        used = step.friction_used()
        x, y, z = world.grains.position[0]
        assert x + 1j * y == pytest.approx(radius * np.exp(1j * speed * world.time), abs=5e-7)
        assert z == pytest.approx(HALF[2], abs=1e-7)
        np.testing.assert_allclose(world.grains.velocity[0, 3:], [0, 0, speed], atol=1e-5)
    assert used == pytest.approx(speed**2 * radius / G, rel=0.02)
    turn = quaternion.exponential(world.time * np.array([0, 0, speed]))
    np.testing.assert_allclose(world.grains.quaternion[0], turn, atol=1e-6)


def test_a_sphere_on_a_turntable_circles_at_two_sevenths_of_its_speed():
    """A rolling ball has dv/dt = 2/7 w x v (Weltner 1979): put on the table at r, it circles with 3.5 r."""
    speed, radius, time = 2.0, 0.5, 0.6
    way = radius * np.array([1.0, 0.0])
    around = way - 3.5 * way
    angle = 2 / 7 * speed * time
    expected = around + 3.5 * radius * np.array([np.cos(angle), np.sin(angle)])
    errors = []
    for dt in (0.02, 0.01):
        scene = turntable(speed, 0.5)
        motion = {"velocity": (0, speed * radius, 0), "angular_velocity": (0, 0, speed)}
        scene.add_spheres([radius, 0, RADIUS], RADIUS, 1000.0, **motion)
        world = new_world(scene, MPI.COMM_SELF)
        for _ in steps(world, round(time / dt), dt):
            assert world.grains.position[0, 2] == pytest.approx(RADIUS, abs=1e-8)
        errors.append(np.linalg.norm(world.grains.position[0, :2] - expected))
    assert errors[1] < 1e-4 * radius
    assert errors[0] / errors[1] == pytest.approx(4.0, rel=0.05)


@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("friction", [0.0, 0.4])
def test_a_paddle_gives_a_sphere_its_velocity(solver, friction):
    """A turning paddle hits a sphere at rest, which it does not touch before: the point of contact takes the normal
    velocity of the face, which has the direction of the end of the step."""
    speed, arm, dt = 2.0, 0.4, 0.01
    scene = Scene(friction, gravity=(0, 0, 0))
    scene.add_body("paddle", [Box((0.6, 0.02, 0.2))], Rotation((0, 0, speed)))
    scene.add_spheres([arm, 0.021 + RADIUS, 0], RADIUS, 1000.0)
    world = new_world(scene, MPI.COMM_SELF)
    step = make_steps(world, 1, dt, solver)
    assert len(step.contacts) == 1
    turn = speed * dt
    along, out = np.array([np.cos(turn), np.sin(turn), 0]), np.array([-np.sin(turn), np.cos(turn), 0])
    start = np.array([arm, 0.021 + RADIUS, 0])
    arm, gap = along @ start, out @ start - 0.02 - RADIUS  # at the end
    np.testing.assert_allclose(step.contacts.normal[0], -out, atol=1e-12)
    start -= (RADIUS + gap + turn * arm) * out  # the place of contact on the paddle, which then goes with it
    sliding = along @ (start - quaternion.rotate(quaternion.exponential(np.array([0, 0, turn])), start)) / dt
    mass, normal_speed = world.grains.mass[0], -gap / dt
    if sliding / 3.5 <= friction * normal_speed:
        p_n, p_t = mass * normal_speed, mass * sliding / 3.5
    else:
        p_n = mass * (normal_speed + friction * sliding) / (1 + 3.5 * friction**2)
        p_t = friction * p_n
    np.testing.assert_allclose(world.grains.velocity[0, :3], (p_n * out - p_t * along) / mass, atol=1e-7)
    spin = -RADIUS * p_t / (0.4 * mass * RADIUS**2)
    np.testing.assert_allclose(world.grains.velocity[0, 3:], [0, 0, spin], atol=1e-6)
    force = step.force_on("paddle")
    np.testing.assert_allclose(force[:3] * dt, p_t * along - p_n * out, atol=1e-6 * p_n)
    assert force[5] * dt == pytest.approx(-p_n * arm - p_t * 0.02, rel=1e-6)


@pytest.mark.parametrize("solver", SOLVERS)
def test_an_oscillating_wall_pushes_a_sphere_and_lets_it_go_at_its_greatest_speed(solver):
    """The sphere has the mean velocity of the wall over each step, to rounding, while the wall speeds up."""
    dt = 0.01
    motion = Oscillation((1, 0, 0), 0.1, 0.8, phase=-np.pi / 2)  # starts at rest
    scene = Scene(0.3, gravity=(0, 0, 0))
    scene.add_body("wall", [Plane((1, 0, 0))], motion)
    scene.add_spheres([RADIUS, 0.2, 0.1], RADIUS, 1000.0)
    world = new_world(scene, MPI.COMM_SELF)
    origin, upright = np.zeros(3), np.array([1.0, 0, 0, 0])
    wall = np.diff([motion.pose(k * dt, origin, upright)[0][0] for k in range(41)]) / dt
    for k, _ in enumerate(steps(world, 40, dt, solver)):
        fastest = max(wall[: k + 1])
        np.testing.assert_allclose(world.grains.velocity[0], [fastest, 0, 0, 0, 0, 0], atol=1e-7)
    assert fastest == pytest.approx(2 * np.pi * 0.1 / 0.8, rel=2e-3)
    assert world.large.position[0, 0] + RADIUS < world.grains.position[0, 0] - 0.03


def shaken(amplitude, frequency, radius):
    """A sphere on a plate that shakes upwards and downwards, with the speed of the plate."""
    scene, turning = Scene(0.3), 2 * np.pi * frequency
    scene.add_body("plate", [Plane((0, 0, 1))], Oscillation((0, 0, 1), amplitude, 1 / frequency))
    scene.add_spheres([0, 0, radius], radius, 1000.0, velocity=(0, 0, amplitude * turning))
    return scene, turning


@pytest.mark.parametrize(("radius", "frequency"), [(0.1, 20.0), (0.005, 50.0)])
def test_the_default_step_resolves_a_plate_that_shakes(radius, frequency):
    """The force on it swings by the mass times its acceleration; with steps for the speeds alone by 4 to 14 % less."""
    amplitude = 0.5 * G / (2 * np.pi * frequency) ** 2
    scene, turning = shaken(amplitude, frequency, radius)
    assert recommended(scene) == pytest.approx(0.2 / turning, rel=0.1)
    force = []
    with pctt.Simulation(scene, comm=MPI.COMM_SELF) as sim:
        sim.run(until=1 / frequency)
        sim.run(until=4 / frequency, call=lambda sim: force.append(sim.body("plate").force[2]))
        mass = scene.row(0).mass[0]
    assert np.std(force) * np.sqrt(2) == pytest.approx(0.5 * mass * G, rel=0.035)


def test_what_does_not_swing_or_leaves_asks_for_no_smaller_step():
    rests, _ = shaken(0.0, 20.0, 0.1)
    leaves, _ = shaken(0.0002, 20.0, 0.1)
    leaves.leaving = {"plate"}
    for scene in (rests, leaves):
        assert not any("swing" in what for what in needs(scene))


class Shaking:
    """As `Oscillation`, of a user's own; to and fro along z, or about x if it `turns`."""

    def __init__(self, amplitude, turning, turns=False):
        self.amplitude, self.turning, self.turns = amplitude, turning, turns

    def pose(self, time, position, orientation):
        swing = self.amplitude * np.sin(self.turning * time)
        if self.turns:
            return position, quaternion.multiply(quaternion.exponential(np.array([swing, 0, 0])), orientation)
        return position + np.array([0, 0, swing]), orientation


def moved_by(motion):
    scene = Scene(0.3)
    scene.add_body("plate", [Box((0.1, 0.2, 0.01))], motion, position=(0, 0, -0.01))
    scene.add_spheres([0, 0, 0.02], 0.02, 1000.0)
    return scene


def path(amplitude, turning, seconds=1.0):
    times = np.arange(0, seconds, 0.05 * 2 * np.pi / turning)
    return Path(times, [(0, 0, amplitude * np.sin(turning * time)) for time in times])


@pytest.mark.parametrize("motion", [path(0.002, 300.0), Shaking(0.002, 300.0), Shaking(0.01, 300.0, turns=True)])
def test_the_default_step_resolves_what_swings_by_whatever_motion(motion):
    """Only `Oscillation` was known to swing."""
    assert recommended(moved_by(motion)) == pytest.approx(0.2 / 300.0, rel=0.1)


def test_what_starts_stops_and_rests_is_no_swing():
    class Late:
        def pose(self, time, position, orientation):
            return position + np.array([0, 0, -0.1 * max(time - 1.0, 0.0)]), orientation

    class Short:
        def pose(self, time, position, orientation):
            if time > 0.1:
                raise ValueError("no data")
            return position + np.array([-0.5 * time, 0, 0]), orientation

    stops = Path([0.0, 0.5, 0.6, 1.0, 1.001, 2.0], [(x, 0, 0) for x in (0, 0, 0.1, 0.1, 0.1001, 0.1001)])
    for motion in (Late(), Short(), stops, Shaking(0.0, 300.0)):
        assert not any("swing" in what and dt < 0.004 for what, dt in needs(moved_by(motion)).items())


def test_a_motion_of_ones_own_is_as_fast_as_it_is():
    class Turning:
        def pose(self, time, position, orientation):
            return position, quaternion.multiply(quaternion.exponential(np.array([0, 0, 20.0 * time])), orientation)

    expected = recommended(moved_by(Rotation((0, 0, 20.0))))
    assert recommended(moved_by(Turning())) == pytest.approx(expected, rel=0.03)


@pytest.mark.parametrize("change", [{"period": 0.02}, {"motion": path(0.002, 300.0, 3.0)}])
def test_a_tool_that_a_run_lets_swing_too_fast_is_told(change):
    with pctt.Simulation(moved_by(Oscillation((0, 0, 1), 0.0005, 0.2)), comm=MPI.COMM_SELF) as sim:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            sim.run(until=0.3)
        sim.change("body plate", **change)
        with pytest.warns(UserWarning, match="plate swings with about [23].* take at most 0.000"):
            sim.run(until=0.6)


def test_half_a_turn_in_a_step_is_told():
    """200 rad/s are no turn in pi / 100 s: the grain would see a tool at rest."""
    with pytest.warns(UserWarning, match="plate turns by 6.28 rad in a step; take less than 0.016 s"):
        pctt.Simulation(moved_by(Rotation((0, 0, 200.0))), dt=np.pi / 100.0, comm=MPI.COMM_SELF)
    with warnings.catch_warnings():
        warnings.filterwarnings("error", message=".*rad in a step")
        pctt.Simulation(moved_by(Rotation((0, 0, 200.0))), dt=0.015, comm=MPI.COMM_SELF)
