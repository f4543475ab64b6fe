"""Boxes on boxes, capsules, and free large bodies at rest, sliding and rolling."""

from __future__ import annotations

import numpy as np
import pytest
from drive import SOLVERS, G, by_id, make_steps, on_incline, steps
from mpi4py import MPI

from dem import quaternion
from dem.motion import Dynamic
from dem.scene import Scene
from dem.shapes import Box, Plane
from dem.start import new_world

DT = 0.01


def world_of(scene):
    return new_world(scene, MPI.COMM_SELF)


def load_on_floor(step):
    """Normal and total impulse that the floor carries."""
    return step.force_on("floor")[:3] * DT


@pytest.mark.parametrize("twist", [0.0, np.pi / 4])
def test_three_boxes_on_top_of_each_other_stay_at_rest(twist):
    """Equal boxes, each turned against the one below: four corners, or up to eight crossings of edges."""
    half, height = (0.2, 0.15, 0.05), 0.05 * np.array([1, 3, 5])
    start = np.stack([[0, 0.01, -0.02], [0, 0.02, 0.0], height], axis=1)
    turns = quaternion.exponential(twist * np.array([[0, 0, 0], [0, 0, 1.0], [0, 0, 2.0]]))
    scene = on_incline(0.0, 0.3)
    scene.add_boxes(start, half, 1000.0, quaternions=turns)
    world = world_of(scene)
    weight = world.grains.mass[0] * G * DT
    known: set[int] = set()
    for step in steps(world, 40, DT, tol=1e-9):
        on_floor = step.impulse[step.contacts.b == 3, 0].sum()
        assert on_floor == pytest.approx(3 * weight, rel=1e-5)
        known = known or set(step.contacts.key)
        assert set(step.contacts.key) == known
    end = by_id(world)
    np.testing.assert_allclose(end["position"], start, atol=1e-6)
    np.testing.assert_allclose(end["quaternion"], turns, atol=1e-6)
    np.testing.assert_allclose(end["velocity"], 0.0, atol=1e-6)
    np.testing.assert_allclose(load_on_floor(step), [0, 0, -3 * weight], atol=1e-5 * weight)


@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("share", [0.9, 1.2])
def test_a_box_on_a_box_holds_below_the_friction_angle_and_slides_above(solver, share):
    friction = 0.3
    slope = np.arctan(share * friction)
    scene = on_incline(slope, 1.0)
    scene.add_boxes([[0, 0, 0.05]], (0.5, 0.3, 0.05), 2000.0, material="base")
    scene.add_boxes([[-0.2, 0, 0.15]], (0.1, 0.1, 0.05), 1000.0, material="top")
    scene.set_pair("base", "top", friction=friction)
    world = world_of(scene)
    count = 15
    step = make_steps(world, count, DT, solver)
    end = by_id(world)
    np.testing.assert_allclose(end["position"][0], [0, 0, 0.05], atol=1e-6)
    if share < 1.0:
        np.testing.assert_allclose(end["position"][1], [-0.2, 0, 0.15], atol=1e-6)
        assert len(step.contacts) == 8
    else:
        # From rest the plain cone lags by mu^2 steps: v = a dt (k - mu^2), but for terms that die away.
        speed = G * (np.sin(slope) - friction * np.cos(slope)) * DT * (count - friction**2)
        assert end["velocity"][1, 0] == pytest.approx(speed, rel=1e-3)
        np.testing.assert_allclose(end["velocity"][1, 3:], 0.0, atol=1e-5)


@pytest.mark.parametrize("solver", SOLVERS)
def test_a_capsule_rolls_down_an_incline_at_the_acceleration_of_its_inertia(solver):
    """a = g sin / (1 + I / (m r^2)) across the axis; the step is implicit in the velocity and exact in it."""
    slope, count, radius = 0.1, 15, 0.1
    scene = on_incline(slope, 0.5)
    turn = quaternion.exponential(np.array([np.pi / 2, 0.0, 0.0]))
    scene.add_capsules([[0, 0, radius]], radius, 0.3, 1000.0, quaternions=turn)
    world = world_of(scene)
    share = world.grains.inertia[0, 2] / (world.grains.mass[0] * radius**2)
    assert 0.4 < share < 0.5  # between a ball and a cylinder
    for step in steps(world, count, DT, solver):
        assert len(step.contacts) == 2
        speed = G * np.sin(slope) / (1 + share) * DT * world.step
        np.testing.assert_allclose(world.grains.velocity[0], [speed, 0, 0, 0, speed / radius, 0], atol=2e-5)
    np.testing.assert_allclose(step.impulse[:, 0], world.grains.mass[0] * G * np.cos(slope) * DT / 2, rtol=1e-4)


@pytest.mark.parallel(1, 3)
def test_a_free_press_rests_on_grains_and_on_another_large_body():
    scene = Scene(0.3)
    scene.add_spheres([[x, y, 0.1] for x in (-0.3, 0.3) for y in (-0.3, 0.3)], 0.1, 1000.0)
    scene.add_body("floor", [Plane((0, 0, 1))])
    scene.add_body("block", [Box((0.1, 0.1, 0.1))], Dynamic(), density=1000.0, position=(0, 0, 0.1))
    scene.add_body("press", [Box((0.5, 0.5, 0.05))], Dynamic(), density=2000.0, position=(0, 0, 0.25))
    world = new_world(scene, MPI.COMM_WORLD)
    step = make_steps(world, 5, 0.01)
    weight = G * (world.comm.allreduce(float(world.grains.mass.sum())) + world.large.mass[1:].sum())
    np.testing.assert_allclose(step.force_on("floor")[2], -weight, rtol=1e-5)
    np.testing.assert_allclose(step.force_on("press")[2], G * world.large.mass[2], rtol=1e-5)
    np.testing.assert_allclose(world.large.position[1:], [[0, 0, 0.1], [0, 0, 0.25]], atol=1e-6)
    assert world.comm.allreduce(len(step.contacts)) == 16
