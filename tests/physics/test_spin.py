"""A box that tumbles freely through ten thousand steps."""

from __future__ import annotations

import numpy as np
from drive import G
from mpi4py import MPI

from dem.free_motion import free_velocity
from dem.scene import Scene
from dem.start import new_world
from dem.stepper import advance


def test_quaternions_stay_unit_quaternions_over_ten_thousand_steps():
    rng = np.random.default_rng(2)
    scene = Scene(0.3)
    place = np.stack([np.arange(4.0), np.zeros(4), np.zeros(4)], axis=1)
    spin = 6.0 * rng.normal(size=(4, 3))
    turns = rng.normal(size=(4, 4))
    scene.add_boxes(place, (0.2, 0.1, 0.05), 1000.0, quaternions=turns, angular_velocity=spin)
    world = new_world(scene, MPI.COMM_SELF)
    dt, worst = 1e-3, 0.0
    for _ in range(10_000):
        advance(world, free_velocity(world.grains, world.gravity, dt), dt)
        worst = max(worst, np.abs(np.linalg.norm(world.grains.quaternion, axis=1) - 1.0).max())
    assert worst < 4 * np.finfo(float).eps
    assert world.step == 10_000
    k = world.step
    np.testing.assert_allclose(world.grains.position[:, 2], -G * dt**2 * k * (k + 1) / 2, rtol=1e-10)
    assert np.isfinite(world.grains.velocity).all()
