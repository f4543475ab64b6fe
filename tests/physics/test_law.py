"""Bodies that begin to slide stay down with Coulomb's law, whatever the time step; with its relaxation they fly."""

from __future__ import annotations

import numpy as np
import pytest
from drive import G, on_incline, steps
from mpi4py import MPI

from dem.motion import Rotation
from dem.scene import Scene
from dem.shapes import Box
from dem.start import new_world
from dem.world import World
from pctt import ccp

LAW = ccp.Coulomb()


def sliding_box(friction: float = 0.5, speed: float = 2.0) -> World:
    """A cube of half extent .1 m flush on a floor."""
    scene = on_incline(0.0, friction)
    scene.add_boxes([0.0, 0.0, 0.1], (0.1, 0.1, 0.1), 1000.0, velocity=(speed, 0.0, 0.0))
    return new_world(scene, MPI.COMM_SELF)


@pytest.mark.parametrize(("solver", "dt"), [("apgd", 0.01), ("apgd", 0.0025), ("conic", 0.02), ("auto", 0.02)])
def test_a_box_thrown_flush_on_the_floor_slides_as_coulomb_says(solver, dt):
    """v = 2 - mu g t, on the floor: .5285 m/s after .3 s."""
    world, lift = sliding_box(), 0.0
    for _ in steps(world, round(0.3 / dt), dt, solver, tol=1e-8, coulomb=LAW):
        lift = max(lift, world.grains.position[0, 2] - 0.1)
    assert world.grains.velocity[0, 0] == pytest.approx(2.0 - 0.5 * G * 0.3, abs=1e-5)
    assert world.grains.velocity[0, 0] == pytest.approx(0.5285, abs=1e-5)
    assert abs(lift) < 1e-6


def test_its_relaxation_throws_it_up():
    world, lift = sliding_box(), 0.0
    for _ in steps(world, 30, 0.01, "apgd"):
        lift = max(lift, world.grains.position[0, 2] - 0.1)
    assert 0.03 < lift < 0.04


def table(turning: float, spin: float = 0.0, speed: float = 0.0) -> World:
    """A sphere of .1 m on a table that turns about the z axis, .5 m from it."""
    scene = Scene(friction=0.5)
    scene.add_body("table", [Box((2, 2, 0.1))], Rotation((0, 0, turning)), position=(0, 0, -0.1))
    scene.add_spheres([0.5, 0, 0.1], 0.1, 1000.0, velocity=(0, speed, 0), angular_velocity=(spin, 0, 0))
    return new_world(scene, MPI.COMM_SELF)


@pytest.mark.parametrize("solver", ["apgd", "conic"])
def test_a_sphere_on_a_turning_table_stays_on_it(solver):
    lifts = []
    for law in (LAW, None):
        world, lift = table(2 * np.pi), 0.0
        for _ in steps(world, 8, 0.01, solver, tol=1e-8, coulomb=law):
            lift = max(lift, abs(world.grains.position[0, 2] - 0.1))
        lifts.append(lift)
    assert lifts[0] < 2e-6
    assert lifts[1] > 5e-3


def test_a_sphere_rolls_in_a_circle_on_a_turning_table():
    """Rolling without slip on a table that turns at W a solid sphere goes round at 2 W / 7 (Earnshaw 1844)."""
    turning, dt, time = 2.0, 0.005, 0.5
    speed = 0.2  # of the centre; with the spin about x the lowest point goes as fast as the table, 1 m/s
    world = table(turning, spin=(turning * 0.5 - speed) / 0.1, speed=speed)
    start = world.grains.velocity[0, :2].copy()
    for _ in steps(world, round(time / dt), dt, "apgd", tol=1e-9, coulomb=LAW):
        pass
    angle = 2.0 / 7.0 * turning * time
    turned = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]) @ start
    np.testing.assert_allclose(world.grains.velocity[0, :2], turned, atol=0.02 * speed)
