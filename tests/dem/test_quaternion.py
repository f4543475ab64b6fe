from __future__ import annotations

import numpy as np
import pytest
from cases import random_quaternions
from scipy.spatial.transform import Rotation

from dem import quaternion

RNG = np.random.default_rng(1)


def as_scipy(q):
    return Rotation.from_quat(q[..., [1, 2, 3, 0]])


def test_rotate_and_matrix_agree_with_scipy():
    q, v = random_quaternions(RNG, 50), RNG.normal(size=(50, 3))
    np.testing.assert_allclose(quaternion.matrix(q), as_scipy(q).as_matrix(), atol=1e-14)
    np.testing.assert_allclose(quaternion.rotate(q, v), as_scipy(q).apply(v), atol=1e-14)


def test_product_applies_the_second_factor_first():
    p, q, v = random_quaternions(RNG, 20), random_quaternions(RNG, 20), RNG.normal(size=(20, 3))
    both = quaternion.rotate(quaternion.multiply(p, q), v)
    np.testing.assert_allclose(both, quaternion.rotate(p, quaternion.rotate(q, v)), atol=1e-14)


def test_conjugate_is_the_inverse():
    q = random_quaternions(RNG, 20)
    one = quaternion.multiply(quaternion.conjugate(q), q)
    np.testing.assert_allclose(one, np.tile([1.0, 0, 0, 0], (20, 1)), atol=1e-15)


@pytest.mark.parametrize("size", [0.0, 1e-300, 1e-9, 0.1, 3.0, 100.0])
def test_exponential_of_any_length(size):
    v = size * np.array([[0.6, 0.0, 0.8], [0.0, 1.0, 0.0]])
    q = quaternion.exponential(v)
    np.testing.assert_allclose(np.linalg.norm(q, axis=1), 1.0, rtol=1e-15)
    np.testing.assert_allclose(quaternion.matrix(q), Rotation.from_rotvec(v).as_matrix(), atol=1e-13)


def test_from_matrix_inverts_matrix():
    for q in [*random_quaternions(RNG, 20), np.array([1.0, 0, 0, 0]), np.array([0, 0, 1.0, 0])]:
        back = quaternion.from_matrix(quaternion.matrix(q))
        np.testing.assert_allclose(np.abs(back @ q), 1.0, atol=1e-14)


def test_integration_turns_about_the_world_axis_by_the_right_angle():
    q = random_quaternions(RNG, 1)
    turned = q
    for _ in range(100):
        turned = quaternion.integrate(turned, np.array([[0.0, 0.0, 2.0]]), 0.01)
    expected = as_scipy(quaternion.exponential(np.array([[0.0, 0.0, 2.0]]))) * as_scipy(q)
    np.testing.assert_allclose(quaternion.matrix(turned), expected.as_matrix(), atol=1e-13)


def test_norm_stays_one_over_ten_thousand_steps():
    q = random_quaternions(RNG, 3)
    for _ in range(10_000):
        q = quaternion.integrate(q, 30.0 * RNG.normal(size=(3, 3)), 0.025)
    np.testing.assert_allclose(np.linalg.norm(q, axis=1), 1.0, rtol=4e-16)
