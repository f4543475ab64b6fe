"""A heap of spheres in a box around a paddle: what the walls carry, and the balance of momentum."""

from __future__ import annotations

import numpy as np
import pytest
from drive import G, momentum, steps
from mpi4py import MPI

from dem.motion import Rotation
from dem.scene import Scene
from dem.shapes import Box, Plane
from dem.start import new_world

DT = 0.01
LOOSE = 1e-3  #: the balances hold for any impulses, solved well or not


def heap(layers, motion):
    """3 x 3 x layers spheres above a floor with walls and a paddle, the first body, in the middle."""
    scene = Scene(0.3)
    places = np.stack(np.meshgrid(np.arange(3), np.arange(3), np.arange(layers), indexing="ij"), axis=-1)
    jitter = np.random.default_rng(3).uniform(-0.01, 0.01, (9 * layers, 3))
    scene.add_spheres(0.23 * places.reshape(-1, 3) + [0.13, 0.13, 0.25] + jitter, 0.1, 2500.0)
    width = 0.72
    walls = [Plane((1, 0, 0)), Plane((-1, 0, 0), (width, 0, 0))]
    walls += [Plane((0, 1, 0)), Plane((0, -1, 0), (0, width, 0))]
    scene.add_body("paddle", [Box((0.1, 0.03, 0.05))], motion, position=(width / 2, width / 2, 0.07))
    scene.add_body("floor", [Plane((0, 0, 1))], position=(0.1, 0.2, 0.0))
    scene.add_body("walls", walls)
    return new_world(scene, MPI.COMM_SELF)


@pytest.mark.parametrize(("solver", "tol"), [("apgd", LOOSE), ("pdip", LOOSE), ("apgd", 0.5)])
def test_every_step_keeps_the_balance_of_linear_and_angular_momentum(solver, tol):
    """What grains gain and large bodies take is what gravity gives, to rounding, however badly solved. Forces act where
    bodies are at the end of the step, which they have not turned about yet at its start."""
    world = heap(2, Rotation((0, 0, 2.0), (0.36, 0.36, 0)))
    weight = world.grains.mass * np.array([[0.0], [0.0], [-G]])
    largest = 0.0
    run = steps(world, 40, DT, solver, tol, delta=0.02, recovery_speed=0.5)
    for _ in range(40):
        before, place, reference = momentum(world), world.grains.position, world.large.position.copy()
        step = next(run)
        taken = np.array([step.force_on(body.name) for body in world.large_bodies]) * DT
        taken[:, 3:] += np.cross(reference, taken[:, :3])
        given = np.concatenate([weight.sum(axis=1), np.cross(place, weight.T).sum(axis=0)]) * DT
        given[3:] -= np.cross(step.contacts.moved, step.impulse_on_b()).sum(axis=0)
        scale = np.abs(step.impulse).sum() + np.abs(before).max()
        np.testing.assert_allclose(momentum(world) - before + taken.sum(axis=0), given, atol=1e-13 * scale)
        largest = max(largest, step.impulse[:, 0].sum())
    assert largest > np.abs(weight).sum() * DT  # there was something to balance
