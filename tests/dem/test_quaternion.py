from __future__ import annotations

import numpy as np
import pytest
from cases import random_quaternions
from scipy.spatial.transform import Rotation

from dem import quaternion
from dem.geometry.vectors import shares

RNG = np.random.default_rng(1)


def as_scipy(q):
    return Rotation.from_quat(q[..., [1, 2, 3, 0]])


def test_rotate_and_matrix_agree_with_scipy():
    q, v = random_quaternions(RNG, 50), RNG.normal(size=(50, 3))
    np.testing.assert_allclose(quaternion.matrix(q), as_scipy(q).as_matrix(), atol=1e-14)
    np.testing.assert_allclose(quaternion.rotate(q, v), as_scipy(q).apply(v), atol=1e-14)


def test_products_and_inverses_agree_with_scipy():
    p, q = random_quaternions(RNG, 20), random_quaternions(RNG, 20)
    both = (as_scipy(p) * as_scipy(q)).as_matrix()
    np.testing.assert_allclose(quaternion.matrix(quaternion.multiply(p, q)), both, atol=1e-14)
    np.testing.assert_allclose(quaternion.matrix(quaternion.conjugate(q)), as_scipy(q).inv().as_matrix(), atol=1e-14)


@pytest.mark.parametrize("size", [0.0, 1e-300, 1e-9, 0.1, 3.0])
def test_rotation_vectors_and_matrices_of_quaternions_are_the_given_ones(size):
    start, v = random_quaternions(RNG, 2), size * np.array([[0.6, 0.0, 0.8], [0.0, 1.0, 0.0]])
    q = quaternion.exponential(v)
    np.testing.assert_allclose(np.linalg.norm(q, axis=1), 1.0, rtol=1e-15)
    np.testing.assert_allclose(quaternion.rotation_vector(start, quaternion.multiply(q, start)), v, atol=1e-14)
    assert abs(quaternion.from_matrix(quaternion.matrix(q)[0]) @ q[0]) == pytest.approx(1.0, abs=1e-14)


def test_integration_turns_about_the_world_axis_by_the_right_angle():
    q = random_quaternions(RNG, 1)
    turned = q
    for _ in range(100):
        turned = quaternion.integrate(turned, np.array([[0.0, 0.0, 2.0]]), 0.01)
    expected = as_scipy(quaternion.exponential(np.array([[0.0, 0.0, 2.0]]))) * as_scipy(q)
    np.testing.assert_allclose(quaternion.matrix(turned), expected.as_matrix(), atol=1e-13)


@pytest.mark.parametrize("angle", [0.0, 1e-300, 1e-7, 1e-5, 0.01, 0.0999, 0.1001, 0.5, 3.0])
def test_shares_of_a_turn_keep_their_figures(angle):
    """1 - cos(a) alone would have lost half of them at 1e-5."""
    sine, versed = shares((0.6 * angle, 0.0, 0.8 * angle))
    half = np.sinc(0.5 * angle / np.pi)
    np.testing.assert_allclose([sine, versed], [np.sinc(angle / np.pi), 0.5 * half**2], rtol=1e-13)
