"""Bodies that come further than the contact distance within a step are stopped at the surface, not beneath it."""

from __future__ import annotations

import numpy as np
import pytest
from drive import HALF, RADIUS, G, sphere, steps
from mpi4py import MPI

import pctt
from dem import quaternion
from dem.motion import Glide, Rotation
from dem.scene import Scene
from dem.shapes import Box, Capsule, Plane
from dem.start import new_world
from pctt.scenes.mixer import Mixer

EXACT = {"tol": 1e-10, "closing_work": np.inf, "solver": "apgd"}
DT, DELTA = 0.025, 0.01  #: at 4 m/s a body moves ten times the contact distance in a step


def worst_overlap(world, count, tol=1e-10):
    """The deepest overlap at the start of the second step and later [m]."""
    gaps = [step.contacts.gap.min(initial=0.0) for step in steps(world, count, DT, tol=tol, delta=DELTA)]
    return -min(gaps[1:])


def floor(friction=0.3):
    scene = Scene(friction)
    scene.add_body("floor", [Plane((0, 0, 1))])
    return scene


@pytest.mark.parametrize("speed", [0.5, 4.0, 40.0])
@pytest.mark.parametrize("lift", [0.011, 0.05, 0.09])
def test_a_fast_sphere_stops_on_the_floor(speed, lift):
    world = sphere(floor(), lift, velocity=(0.0, 0.0, -speed))
    assert worst_overlap(world, 12) < 1e-6
    assert world.grains.position[0, 2] == pytest.approx(RADIUS, abs=1e-6)


def test_a_tumbling_box_stops_on_the_floor():
    scene = floor()
    scene.add_boxes([0, 0, 0.4], HALF, 1000.0, velocity=(1.0, 0.0, -6.0), angular_velocity=(5.0, 20.0, 3.0))
    assert worst_overlap(new_world(scene, MPI.COMM_SELF), 6, tol=1e-6) < 0.1 * min(HALF)


def test_spheres_that_pass_each_other_are_left_alone():
    scene = Scene(0.0, gravity=(0, 0, 0))  # with friction, they are kept apart by dt mu |u_t|
    scene.add_spheres([[-1.0, 0, 0], [0.0, 2.2 * RADIUS, 0]], RADIUS, 1000.0, velocity=[[2.0, 0, 0], [0, 0, 0]])
    world = new_world(scene, MPI.COMM_SELF)
    for _ in steps(world, 40, DT, delta=DELTA):
        pass
    order = np.argsort(world.grains.id)
    np.testing.assert_allclose(world.grains.velocity[order, :3], [[2.0, 0, 0], [0, 0, 0]], atol=1e-12)


@pytest.mark.parametrize("motion", [Glide((2.0, 0, 0)), Rotation((0, 0, -2.0), (0.0, 1.0, 0.0))], ids=["glide", "turn"])
def test_a_fast_tool_does_not_run_into_spheres_at_rest(motion):
    """Both tools move the point of contact by 5 cm a step; the gap is 4 cm."""
    scene = Scene(0.0, gravity=(0, 0, 0))
    scene.add_body("tool", [Box((0.02, 0.3, 0.3))], motion)
    scene.add_spheres([0.06 + RADIUS, 0, 0], RADIUS, 1000.0)
    world = new_world(scene, MPI.COMM_SELF)
    assert worst_overlap(world, 6) < 2e-3  # a turning face is straightened over the step


def test_spheres_poured_onto_a_turning_paddle_do_not_overlap():
    world = new_world(Mixer(n=1).build(), MPI.COMM_SELF)
    assert worst_overlap(world, 20, tol=1e-4) < 0.01 * RADIUS


@pytest.mark.parametrize("angle", [0.02, 0.05, 0.1])
def test_a_capsule_that_spins_over_another_stops_on_it(angle):
    """Capsules that cross in the middle, at a small angle. The upper one spins about the line between the centres and
    sinks until it touches the lower one: the spin takes the ends aside, and the distance of the cores is the height."""
    half_length, gap, dt = 3 * RADIUS, 0.05 * RADIUS, 0.01
    speed, spin = 0.2 * RADIUS / dt, RADIUS / 3 / half_length / dt
    scene = Scene(0.0, gravity=(0, 0, 0))
    lying = quaternion.exponential(np.array([0.0, np.pi / 2, 0.0]))
    scene.add_body("below", [Capsule(RADIUS, half_length, quaternion=tuple(lying))])
    turn = quaternion.multiply(quaternion.exponential(np.array([0.0, 0.0, angle])), lying)
    motion = {"velocity": (0, 0, -speed), "angular_velocity": (0, 0, spin)}
    scene.add_capsules([0, 0, 2 * RADIUS + gap], RADIUS, half_length, 1000.0, quaternions=turn, **motion)
    world = new_world(scene, MPI.COMM_SELF)
    for _ in steps(world, 1, dt, delta=0.1 * RADIUS):
        pass
    assert world.grains.position[0, 2] == pytest.approx(2 * RADIUS, abs=1e-6)
    np.testing.assert_allclose(world.grains.velocity[0], [0, 0, -gap / dt, 0, 0, spin], atol=1e-4)


@pytest.mark.parametrize("dt", [0.002, 0.02])
def test_a_sphere_lands_without_overlap_and_without_bounce(dt):
    scene = Scene(friction=0.3, stiffness=np.inf)
    scene.add_body("floor", [Plane((0, 0, 1))])
    scene.add_spheres([[0, 0, RADIUS + 0.4]], RADIUS, 2500.0)
    with pctt.Simulation(scene, dt=dt, **EXACT) as sim:
        weight = sim.local.mass[0] * G
        heights, speeds, impulse = [], [], 0.0
        while sim.time < 0.6:
            sim.step()
            heights.append(sim.positions[0, 2])
            speeds.append(sim.velocities[0, 2])
            impulse -= dt * sim.body("floor").force[2]
    assert min(heights) > RADIUS - 1e-9
    assert min(speeds) == pytest.approx(-np.sqrt(2 * G * 0.4), abs=1.5 * G * dt)
    assert max(speeds) < 1e-6
    assert (heights[-1], speeds[-1]) == pytest.approx((RADIUS, 0.0), abs=1e-6)
    assert impulse == pytest.approx(weight * sim.time, rel=1e-9)  # all momentum of the fall


@pytest.mark.parallel(1, 2)
def test_a_plate_moves_a_row_and_keeps_out_of_it(ranks):
    """10 cm a step, a radius: every sphere gets the speed of the plate, one after the other, and none overlaps."""
    scene = Scene(friction=0.3, gravity=(0, 0, 0), stiffness=np.inf)
    scene.add_body("plate", [Box((0.02, 0.5, 0.5))], Glide((5.0, 0, 0)), position=(-0.05, 0, 0))
    scene.add_spheres([[0.1 + 0.22 * k, 0, 0] for k in range(6)], 0.1, 2500.0)
    found = []
    for comm in (MPI.COMM_WORLD, MPI.COMM_SELF):
        with pctt.Simulation(scene, dt=0.02, comm=comm, **EXACT) as sim:
            for _ in range(8):
                sim.step()
                assert np.diff(sim.positions[:, 0]).min() > 0.2 - 1e-4
                assert sim.positions[0, 0] - sim.body("plate").position[0] > 0.12 - 1e-4
            np.testing.assert_allclose(sim.velocities[:, 0], 5.0, rtol=1e-6)
            found.append(sim.positions)
    np.testing.assert_allclose(found[0], found[1], atol=1e-6)
