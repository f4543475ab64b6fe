"""Bodies that tumble freely through many steps."""

from __future__ import annotations

import numpy as np
import pytest
from drive import G
from mpi4py import MPI

from dem import quaternion
from dem.free_motion import free_spin, free_velocity
from dem.scene import Scene
from dem.start import new_world
from dem.step import advance


def test_quaternions_stay_unit_quaternions_over_two_thousand_steps():
    rng = np.random.default_rng(2)
    scene = Scene(0.3)
    place = np.stack([np.arange(4.0), np.zeros(4), np.zeros(4)], axis=1)
    spin = 6.0 * rng.normal(size=(4, 3))
    turns = rng.normal(size=(4, 4))
    scene.add_boxes(place, (0.2, 0.1, 0.05), 1000.0, quaternions=turns, angular_velocity=spin)
    world = new_world(scene, MPI.COMM_SELF)
    dt, worst = 1e-3, 0.0
    for _ in range(2_000):
        advance(world, free_velocity(world.grains, world.gravity, dt), dt)
        worst = max(worst, np.abs(np.linalg.norm(world.grains.quaternion, axis=1) - 1.0).max())
    assert worst < 4 * np.finfo(float).eps
    assert world.step == 2_000
    k = world.step
    np.testing.assert_allclose(world.grains.position[:, 2], -G * dt**2 * k * (k + 1) / 2, rtol=1e-10)
    assert np.isfinite(world.grains.velocity).all()


@pytest.mark.parametrize("turn", [0.02, 0.2, 0.8])
def test_a_free_body_keeps_its_angular_momentum_and_its_energy(turn):
    """It turns by `turn` radians in a step, for 1,000 steps, also about the axis of the middle moment."""
    dt, rng = 0.01, np.random.default_rng(4)
    moments = np.array([[1.0, 3.6, 4.3], [1.0, 1.0, 0.02], [0.5, 0.5, 1.0], [1.0, 0.9, 0.15]]).repeat(5, axis=0)
    q = quaternion.normalized(rng.normal(size=(20, 4)))
    spin = rng.normal(size=(20, 3))
    spin[0] = [0.001, 1.0, 0.001]
    spin *= turn / dt / quaternion.length(spin)[:, None]
    w = quaternion.rotate(q, spin)
    energies, momenta = [], []
    for _ in range(1000):
        w = free_spin(q, w, moments, dt)
        spin = quaternion.rotate(quaternion.conjugate(q), w)
        momenta.append(quaternion.rotate(quaternion.integrate(q, w, dt / 2), moments * spin))
        q = quaternion.integrate(q, w, dt)
        energies.append((moments * spin**2).sum(axis=1))
    change = np.linalg.norm(np.array(momenta) - momenta[0], axis=2) / np.linalg.norm(momenta[0], axis=1)
    assert change.max() < (1e-9 if turn < 0.5 else 1e-5)
    assert np.abs(np.array(energies) / energies[0] - 1.0).max() < 0.1 * turn**2


def test_a_spin_about_a_principal_axis_stays_and_so_does_one_that_no_step_resolves():
    upright, moments = np.array([[1.0, 0.0, 0.0, 0.0]]), np.array([[1.0, 2.0, 2.5]])
    for spin in (*np.eye(3), 500.0 * np.array([1.0, 2.0, 3.0]), np.array([1e200, 0.0, 1.0])):
        np.testing.assert_allclose(free_spin(upright, spin[None], moments, 0.01)[0], spin, rtol=1e-14)


@pytest.mark.parametrize("turn", [1e6, 1e12])
def test_bodies_that_turn_a_million_radians_in_a_step_keep_their_spin(turn):
    """Newton's matrix is singular to rounding there, and of some exactly."""
    rng = np.random.default_rng(5)
    q = quaternion.normalized(rng.normal(size=(5000, 4)))
    spin = rng.normal(size=(5000, 3)) * turn / 0.01
    moments = rng.uniform(0.5, 1.0, (5000, 3))
    np.testing.assert_allclose(free_spin(q, spin, moments, 0.01), spin, rtol=1e-14)
