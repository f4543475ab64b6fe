"""Contact geometry against analytic values and dense sampling."""

from __future__ import annotations

import numpy as np
import pytest

from dem import quaternion
from dem.bodies import PLANE, SPHERE
from dem.contact.narrow import (
    CORNERS,
    Boxes,
    Capsules,
    Planes,
    Spheres,
    Touch,
    closest_on_lines,
    sphere_box,
    sphere_capsule,
    sphere_sphere,
)
from dem.contact.polyhedra import Polyhedra, hulls_of, polyhedra_planes
from dem.contact.spheres import touch_spheres

RNG = np.random.default_rng(2)
UNIT = np.eye(3)[None]


def check_consistency(touch, center, radius):
    """The normal is a unit vector, and the point lies half the gap outside the sphere along it."""
    np.testing.assert_allclose(np.linalg.norm(touch.normal, axis=1), 1.0, rtol=1e-12)
    expected = center + (radius + touch.gap / 2)[:, None] * touch.normal
    np.testing.assert_allclose(touch.point, expected, atol=1e-12)


def test_spheres():
    x, y = np.zeros((3, 3)), np.array([[3.0, 4, 0], [0, 0, 1], [0, 0, 0]])  # the last are concentric
    touch = sphere_sphere(Spheres(x, np.array([2.0, 1.0, 1.0])), Spheres(y, np.array([2.0, 0.5, 1.0])))
    np.testing.assert_allclose(touch.gap, [1.0, -0.5, -2.0])
    np.testing.assert_allclose(touch.normal, [[0.6, 0.8, 0], [0, 0, 1], [0, 0, 1]])
    np.testing.assert_allclose(touch.point, [[1.5, 2.0, 0], [0, 0, 0.75], [0, 0, 0]])


def test_sphere_above_and_below_a_tilted_plane():
    outward, origin = np.array([0.6, 0.0, 0.8]), np.array([1.0, 2.0, 3.0])
    center = origin + np.outer([1.5, -4.0], outward) + np.array([0.8, 5.0, -0.6])
    places, turn = np.array([*center, origin]), np.tile([1.0, 0, 0, 0], (3, 1))
    size, kind = np.array([[1.0, 0, 0], [1.0, 0, 0], outward]), np.array([SPHERE, SPHERE, PLANE])
    rows = np.array([[0, 2], [1, 2], [2, 0]])
    pair, *found, others = touch_spheres(kind, places, turn, size, *rows.T, np.ones(3))
    np.testing.assert_array_equal(pair, [0, 1, 2])
    assert len(others) == 0
    np.testing.assert_allclose(found[1][2], -found[1][0])  # the half space first: the other way
    touch = Touch(*found).take(slice(2))
    np.testing.assert_allclose(touch.gap, [0.5, -5.0])
    np.testing.assert_allclose(touch.normal, -np.tile(outward, (2, 1)))
    check_consistency(touch, center, np.ones(2))


@pytest.mark.parametrize(
    ("center", "outward", "distance"),
    [
        ((0, 0, 5), (0, 0, 1), 2.0),  # face
        ((0.9, -1.9, -3.5), (0, 0, -1), 0.5),  # face, near a corner of it
        ((4, 6, 0), (0.6, 0.8, 0), 5.0),  # edge
        ((2, 4, 5), (1 / 3, 2 / 3, 2 / 3), 3.0),  # corner
        ((0.5, 0, 0), (1, 0, 0), -0.5),  # inside
        ((0, -1.9, 2.8), (0, -1, 0), -0.1),  # inside, near an edge
        ((1, 0, 0), (1, 0, 0), 0.0),  # on the surface
        ((1 + 1e-15, 0, 0), (1, 0, 0), 0.0),  # on the surface but for rounding
    ],
)
def test_sphere_on_faces_edges_corners_and_inside_a_box(center, outward, distance):
    center, radius = np.array([center], dtype=float), np.array([0.25])
    touch = sphere_box(Spheres(center, radius), Boxes(np.zeros((1, 3)), UNIT, np.array([[1.0, 2.0, 3.0]])))
    np.testing.assert_allclose(touch.gap, distance - 0.25, atol=1e-14)
    np.testing.assert_allclose(touch.normal, -np.array([outward]), atol=1e-14)
    check_consistency(touch, center, radius)


def test_corners_of_a_box_on_a_plane():
    turn = quaternion.matrix(quaternion.exponential(np.array([[0.0, np.pi / 4, 0.0]])))
    center, half = np.array([[0.0, 0, 1.5]]), np.array([[1.0, 2.0, 1.0]])
    plane = Planes(np.array([[0.0, 0, 1]]), np.zeros((1, 3)))
    body = Polyhedra(center, turn, half, np.zeros(1, int), hulls_of(()))
    feature, touch = polyhedra_planes(body, plane, np.array([9.0]))[1:]
    tip = center + (half * CORNERS) @ turn[0].T
    np.testing.assert_array_equal(feature, np.arange(8))
    np.testing.assert_allclose(touch.gap, tip[:, 2], atol=1e-14)
    np.testing.assert_allclose(np.sort(touch.gap)[:2], 1.5 - np.sqrt(2.0))
    np.testing.assert_allclose(touch.point, tip * [1, 1, 0.5], atol=1e-14)
    np.testing.assert_allclose(touch.normal, np.tile([0.0, 0, -1], (8, 1)))


def test_sphere_beside_beyond_and_on_the_core_of_a_capsule():
    center = np.array([[0.0, 0.5, 0.3], [0, 0.6, -1.8], [0, 0, 0.4], [0.0, 0.0, 1.0]])
    up, none = np.tile([0.0, 0.0, 1.0], (4, 1)), np.zeros((4, 3))
    touch = sphere_capsule(
        Spheres(center, np.full(4, 0.1)), Capsules(none, up, np.full(4, 1.0), np.full(4, 0.25))
    )
    np.testing.assert_allclose(touch.gap, [0.15, 0.65, -0.35, -0.35])
    np.testing.assert_allclose(touch.normal[:2], [[0, -1, 0], [0, -0.6, 0.8]], atol=1e-15)
    np.testing.assert_allclose(touch.normal[2:, 2], 0.0)
    check_consistency(touch, center, np.full(4, 0.1))


def test_closest_points_of_lines():
    count = 50
    axis, other_axis = (v / np.linalg.norm(v, axis=1)[:, None] for v in RNG.normal(size=(2, count, 3)))
    point, other = RNG.normal(size=(2, count, 3))
    s, t = closest_on_lines(point, axis, other, other_axis)
    between = other + t[:, None] * other_axis - point - s[:, None] * axis
    np.testing.assert_allclose(np.einsum("ij,ij->i", between, axis), 0.0, atol=1e-9)
    np.testing.assert_allclose(np.einsum("ij,ij->i", between, other_axis), 0.0, atol=1e-9)
