"""Bodies that tumble freely through many steps."""

from __future__ import annotations

import numpy as np
import pytest

from dem import quaternion
from dem.free_motion import free_spin


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
        w, _ = free_spin(q, w, moments, dt, np.zeros((20, 3)))
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
        after, _ = free_spin(upright, spin[None], moments, 0.01, np.zeros((1, 3)))
        np.testing.assert_allclose(after[0], spin, rtol=1e-14)


@pytest.mark.parametrize("turn", [1e6, 1e12])
def test_bodies_that_turn_a_million_radians_in_a_step_keep_their_spin(turn):
    """Newton's matrix is singular to rounding there, and of some exactly."""
    rng = np.random.default_rng(5)
    q = quaternion.normalized(rng.normal(size=(5000, 4)))
    spin = rng.normal(size=(5000, 3)) * turn / 0.01
    moments = rng.uniform(0.5, 1.0, (5000, 3))
    after, middle = free_spin(q, spin, moments, 0.01, np.zeros_like(spin))
    np.testing.assert_allclose(after, spin, rtol=1e-14)
    assert np.isnan(middle).any(axis=1).mean() > 0.9  # nothing to be put right at the end of the step
