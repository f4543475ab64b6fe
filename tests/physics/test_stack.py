"""Five spheres on top of each other."""

from __future__ import annotations

import numpy as np
import pytest
from drive import RADIUS, SOLVERS, G, steps
from mpi4py import MPI

from dem.scene import Scene
from dem.shapes import Plane
from dem.start import new_world


@pytest.mark.parametrize("solver", SOLVERS)
def test_a_stack_stands_and_each_contact_carries_what_is_above(solver):
    height = RADIUS * (1 + 2 * np.arange(5))
    start = np.stack([0 * height, 0 * height, height], axis=1)
    scene = Scene(0.3)
    scene.add_body("floor", [Plane((0, 0, 1))])
    scene.add_spheres(start, RADIUS, 2500.0)
    world = new_world(scene, MPI.COMM_SELF)
    dt, count = 0.01, 150
    weight = world.grains.mass[0] * G
    for step in steps(world, count, dt, solver):
        assert len(step.contacts) == 5
        from_top = np.argsort(-step.contacts.point[:, 2])
        normal = step.impulse[from_top, 0]
        np.testing.assert_allclose(normal, weight * dt * np.arange(1, 6), rtol=1e-6)
        np.testing.assert_allclose(step.impulse[:, 1:], 0.0, atol=1e-8 * weight * dt)
    order = np.argsort(world.grains.id)
    np.testing.assert_allclose(world.grains.position[order], start, atol=1e-6)
    np.testing.assert_allclose(world.grains.velocity, 0.0, atol=1e-7)
    np.testing.assert_allclose(world.grains.quaternion, np.tile([1.0, 0, 0, 0], (5, 1)), atol=1e-9)
    force = step.force_on("floor")
    np.testing.assert_allclose(force, [0, 0, -5 * weight, 0, 0, 0], rtol=1e-6)
