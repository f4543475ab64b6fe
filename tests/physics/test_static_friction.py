"""Static friction above that of sliding: closed forms of blocks and balls."""

import numpy as np
import pytest
from mpi4py import MPI

import pctt
from dem.motion import Glide
from dem.scene import Scene
from dem.shapes import Plane, Sphere

G, R = 9.81, 0.1
HALF = np.array([2.0, 1.0, 0.05]) * R  # flat: its four contacts bear the same
MASS = 8.0 * HALF.prod() * 1000.0
SLIDES, STICKS = 0.25, 0.45
EXACT = {"dt": 0.005, "tol": 1e-8, "closing_work": np.inf}


def plane(slope=0.0, **more):
    """A plane with this slope, down which x leads."""
    scene = Scene(SLIDES, np.array([slope, 0.0, -1.0]) * G / np.hypot(1.0, slope), static_friction=STICKS, **more)
    scene.add_body("plane", [Plane((0, 0, 1))])
    return scene


def block(slope=0.0, speed=0.0, **more):
    scene = plane(slope, **more)
    scene.add_boxes([0, 0, HALF[2]], HALF, 1000.0, velocity=(speed, 0, 0))
    return scene


def acceleration(slope, friction):
    return G * (slope - friction) / np.hypot(1.0, slope)


@pytest.mark.parametrize("part", [0.98, 1.02])
def test_a_block_begins_to_slide_at_the_static_angle(part):
    slope = part * STICKS
    with pctt.Simulation(block(slope, stiffness=np.inf), **EXACT) as sim:
        sim.run(steps=20)
        begun = sim.velocities[0, 0]
        sim.run(steps=40)
        rate = (sim.velocities[0, 0] - begun) / 0.2
    assert rate == pytest.approx(acceleration(slope, SLIDES) if part > 1.0 else 0.0, rel=1e-3, abs=1e-6)


@pytest.mark.parametrize("stiffness", [np.inf, None])
def test_a_force_that_grows_moves_a_block_when_it_exceeds_static_friction(stiffness):
    scene, weight, end = block(stiffness=stiffness), MASS * G, 0.2
    scene.add_load("pull", [0], force=lambda time, table: (STICKS * weight * time / end, 0, 0))
    with pctt.Simulation(scene, **{**EXACT, "dt": 0.002}) as sim:
        sim.run(until=0.98 * end)
        assert abs(sim.velocities[0, 0]) < 1e-3
        sim.run(until=end + 0.1)
        exact = G * (STICKS * (0.1 + 0.5 * 0.1**2 / end) - SLIDES * 0.1)
        assert sim.velocities[0, 0] == pytest.approx(exact, rel=0.06)


def test_a_block_that_slides_goes_on_between_the_angles_and_stops_below():
    for slope in (0.3, 0.4):
        with pctt.Simulation(block(slope, 0.1), **EXACT) as sim:
            sim.run(steps=40)
            assert sim.velocities[0, 0] == pytest.approx(0.1 + 0.2 * acceleration(slope, SLIDES), rel=1e-3)
    slope, speed = 0.15, 0.3
    slows = -acceleration(slope, SLIDES)
    with pctt.Simulation(block(slope, speed), **EXACT) as sim:
        sim.run(until=1.2 * speed / slows)
        assert abs(sim.velocities[0, 0]) < 1e-6
        assert sim.positions[0, 0] == pytest.approx(0.5 * speed**2 / slows, rel=0.03)


def ball_on(slope):
    scene = plane(slope)
    scene.add_spheres([0, 0, R], R, 1000.0)
    return scene


def test_a_ball_rolls_as_far_as_static_friction_holds_it():
    for part in (0.95, 1.1):
        slope = part * 3.5 * STICKS
        with pctt.Simulation(ball_on(slope), **EXACT) as sim:
            sim.run(steps=40)
            first = sim.velocities[0, 0]
            sim.run(steps=40)
            rate = (sim.velocities[0, 0] - first) / 0.2
        exact = 5 / 7 * acceleration(slope, 0.0) if part < 1.0 else acceleration(slope, SLIDES)
        assert rate == pytest.approx(exact, rel=1e-3)


@pytest.mark.slow
def test_a_block_at_a_spring_sticks_and_slips():
    k, speed, dt = 100.0 * MASS, 0.05, 0.002
    high, low = STICKS * MASS * G / k, SLIDES * MASS * G / k
    scene = block()
    scene.add_body("hand", [Sphere(0.001)], Glide((speed, 0, 0)), position=(1.0, 0, HALF[2]))
    scene.add_spring("string", 0, "hand", stiffness=k, length=1.0 - 0.9 * high)
    forces, places = [], []
    with pctt.Simulation(scene, **{**EXACT, "dt": dt}) as sim:
        def note(sim):
            forces.append(np.linalg.norm(sim.spring_force("string")))
            places.append(sim.positions[0, 0])

        sim.run(until=2.6, call=note)
    rate = np.sqrt(k / MASS)
    swing = (high - low) * rate
    slipping = (2 * np.pi - 2 * np.arctan(swing / speed)) / rate
    leap = speed * slipping + 2 * (high - low)  # the block goes with the hand, and the string gives back
    at = np.diff(places) > 1e-6
    ends = np.flatnonzero(np.diff(at.astype(int)))
    leaps = np.diff(np.array(places)[ends + 1])[::2]
    assert len(leaps) >= 2
    most = low + np.hypot(high - low, speed / rate)
    assert max(forces) == pytest.approx(k * most, rel=0.01)
    np.testing.assert_allclose(leaps, leap, rtol=0.02)


@pytest.mark.parallel(2)
def test_ranks_and_restarts_agree(tmp_path):
    def blocks():
        scene, x = plane(0.35), np.arange(12.0)
        speed = np.stack([0.2 * (x % 3 == 0), 0 * x, 0 * x], axis=1)
        scene.add_boxes(np.stack([x, 0 * x, 0 * x + HALF[2]], axis=1), HALF, 1000.0, velocity=speed)
        return scene

    given = {**EXACT, "solver": "apgd"}
    with pctt.Simulation(blocks(), comm=MPI.COMM_WORLD, **given) as sim:
        sim.run(steps=5)
        sim.save(tmp_path / "middle.h5")
        sim.run(steps=8)
        place = sim.positions
    assert ((place[:, 0] - np.arange(12)) > 1e-3).sum() == 4
    with pctt.Simulation.load(tmp_path / "middle.h5", blocks(), comm=MPI.COMM_WORLD, **given) as again:
        again.run(steps=8)
        np.testing.assert_array_equal(again.positions, place)
    with pctt.Simulation(blocks(), comm=MPI.COMM_SELF, **given) as alone:
        alone.run(steps=13)
        np.testing.assert_allclose(alone.positions, place, atol=1e-9)


def test_a_static_coefficient_below_that_of_sliding_is_refused():
    with pytest.raises(ValueError, match="static_friction must be 0, or at least the friction of 0.5, got 0.3"):
        Scene(0.5, static_friction=0.3)
