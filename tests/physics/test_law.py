"""Bodies that begin to slide stay down with Coulomb's law, whatever the time step; with its relaxation they fly."""

from __future__ import annotations

import numpy as np
import pytest
from drive import G, on_incline, steps
from mpi4py import MPI

from dem.model.world import World
from dem.motion import Rotation
from dem.scene import Scene
from dem.shapes import Box
from dem.start import new_world
from pctt import ccp


def sliding_box(friction: float = 0.5, speed: float = 2.0) -> World:
    """A cube of half extent .1 m flush on a floor."""
    scene = on_incline(0.0, friction)
    scene.add_boxes([0.0, 0.0, 0.1], (0.1, 0.1, 0.1), 1000.0, velocity=(speed, 0.0, 0.0))
    return new_world(scene, MPI.COMM_SELF)


@pytest.mark.parametrize(("solver", "dt"), [("apgd", 0.01), ("apgd", 0.0025), ("conic", 0.02), ("auto", 0.02)])
def test_a_box_thrown_flush_on_the_floor_slides_as_coulomb_says(solver, dt):
    """v = 2 - mu g t, on the floor: .5285 m/s after .3 s."""
    world, lift = sliding_box(), 0.0
    for _ in steps(world, round(0.3 / dt), dt, solver, tol=1e-8, law=ccp.COULOMB):
        lift = max(lift, world.grains.position[0, 2] - 0.1)
    assert world.grains.velocity[0, 0] == pytest.approx(2.0 - 0.5 * G * 0.3, abs=1e-5)
    assert world.grains.velocity[0, 0] == pytest.approx(0.5285, abs=1e-5)
    assert abs(lift) < 1e-6


@pytest.mark.parametrize("solver", ccp.SOLVERS)
def test_the_law_holds_with_every_solver_at_every_tolerance(solver):
    """The box, and a sphere that is put on a turning table: heights of at most a hundredth of the tolerance [m]."""
    for tol in (1e-4, 1e-8):
        for world in (sliding_box(), table(2 * np.pi)):
            for _ in steps(world, 3, 0.01, solver, tol=tol, law=ccp.COULOMB):
                assert abs(world.grains.position[0, 2] - 0.1) < max(1e-2 * tol, 1e-14)


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
    for law in ccp.LAWS:
        world, lift = table(2 * np.pi), 0.0
        for _ in steps(world, 8, 0.01, solver, tol=1e-8, law=law):
            lift = max(lift, abs(world.grains.position[0, 2] - 0.1))
        lifts.append(lift)
    assert lifts[0] < 2e-6
    assert lifts[1] > 5e-3
