"""Capsules on planes, capsules and boxes, against analytic cases and optimisation; their mass."""

from __future__ import annotations

import numpy as np
import pytest
from convex import distance, outside
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from dem import quaternion
from dem.bodies import CAPSULE
from dem.contact.narrow import DISTINCT, Boxes, Capsules, Planes, capsule_box, capsule_capsule, capsule_plane
from dem.shapes import Capsule, Sphere, mass_properties, moved, solid

DELTA = 0.1


def turned(rotation):
    return quaternion.matrix(quaternion.exponential(np.array(rotation, float)))


def body(center, frame, half, radius=0.0):
    """A capsule or a box for `convex`."""
    return np.array(center, float), np.array(frame, float), np.array(half, float), radius


def capsule(center, axis, half_length, radius):
    """A capsule; its frame has the axis as third column."""
    z = np.array(axis, float) / np.linalg.norm(axis)
    x = np.linalg.svd(z[None])[2][1]
    return body(center, np.stack([x, np.cross(z, x), z], axis=1), (0, 0, half_length), radius)


def arguments(one):
    center, frame, half, radius = one
    if radius == 0.0:
        return Boxes(center[None], frame[None], half[None])
    return Capsules(center[None], frame[None, :, 2], half[None, 2], np.array([radius]))


def touch(one, other, delta=DELTA):
    """The contacts of a capsule and a capsule or box: features, points, normals, gaps, ordered by place."""
    function = capsule_box if other[3] == 0.0 else capsule_capsule
    found = function(arguments(one), arguments(other), np.array([delta]))
    order = np.lexsort(np.round(found.touch.point, 9).T)
    return (found.feature[order], *(values[order] for values in found.touch))


def test_a_capsule_on_a_plane_touches_with_both_ends_or_one():
    ground = Planes(np.array([[0.0, 0, 1]]), np.zeros((1, 3)))
    lying = capsule_plane(arguments(capsule((1, 2, 0.28), (1, 0, 0), 0.5, 0.25)), ground, np.array([DELTA]))
    np.testing.assert_array_equal(lying.feature, [0, 1])
    np.testing.assert_allclose(lying.touch.gap, 0.03)
    np.testing.assert_allclose(lying.touch.point, [[0.5, 2, 0.015], [1.5, 2, 0.015]])
    np.testing.assert_array_equal(lying.touch.normal, [[0, 0, -1]] * 2)
    leaning = capsule_plane(arguments(capsule((0, 0, 0.55), (0.6, 0, 0.8), 0.5, 0.25)), ground, np.array([DELTA]))
    np.testing.assert_allclose(leaning.touch.gap, [-0.1])


@pytest.mark.parametrize("gap", [0.05, -0.05])
def test_parallel_capsules_touch_at_the_ends_of_the_common_stretch(gap):
    one, other = capsule((0, 0, 0), (1, 0, 0), 1, 0.3), capsule((0.8, 0, 0.5 + gap), (-1, 0, 0), 0.5, 0.2)
    feature, point, normal, gaps = touch(one, other)
    np.testing.assert_array_equal(feature, [3, 1])
    np.testing.assert_allclose(gaps, gap, atol=1e-15)
    np.testing.assert_allclose(point, [[x, 0, 0.3 + gap / 2] for x in (0.3, 1)], atol=1e-15)
    np.testing.assert_allclose(normal, [[0, 0, 1]] * 2, atol=1e-15)


@pytest.mark.parametrize("gap", [0.05, -0.05])
def test_crossed_capsules_and_capsules_end_to_end_touch_in_one_point(gap):
    one = capsule((0, 0, 0), (1, 0, 0), 1, 0.3)
    (feature,), point, normal, gaps = touch(one, capsule((0.4, 0.5, 0.5 + gap), (0, 1, 0), 1, 0.2))
    assert feature == 4
    np.testing.assert_allclose(point, [[0.4, 0, 0.3 + gap / 2]], atol=1e-15)
    np.testing.assert_allclose(normal, [[0, 0, 1]], atol=1e-15)
    np.testing.assert_allclose(gaps, gap, atol=1e-15)
    _, point, normal, gaps = touch(one, capsule((2 + gap, 0, 0), (1, 0, 0), 0.5, 0.2))
    np.testing.assert_allclose(point, [[1.3 + gap / 2, 0, 0]], atol=1e-15)
    np.testing.assert_allclose(normal, [[1, 0, 0]], atol=1e-15)
    np.testing.assert_allclose(gaps, gap, atol=1e-15)


def test_capsules_that_cross_at_a_small_angle_touch_at_the_crossing_and_at_all_ends():
    one, other = capsule((0, 0, 0), (1, 0, 0), 1, 0.3), capsule((0, 0, 0.65), (np.cos(0.2), np.sin(0.2), 0), 1, 0.3)
    feature, point, normal, gaps = touch(one, other)
    assert sorted(feature) == [0, 1, 2, 3, 4]
    side = np.sin(0.2)  # how far an end is beside the other core
    np.testing.assert_allclose(gaps[feature == 4], 0.05)
    np.testing.assert_allclose(gaps[feature < 4], np.hypot(0.65, side) - 0.6)
    np.testing.assert_allclose(normal[feature == 4], [[0, 0, 1]], atol=1e-12)
    np.testing.assert_allclose(np.abs(normal[feature < 4, 2]), 0.65 / np.hypot(0.65, side))


def test_a_capsule_that_leans_on_the_edge_of_a_box_also_touches_over_the_face():
    """Its core passes the edge x = 1, z = 0.2 at the distance r + gap, and leans by 0.05 to the face."""
    slab, radius, gap = body((0, 0, 0), np.eye(3), (1, 1, 0.2)), 0.3, 0.02
    lean = np.array([np.cos(0.05), 0, -np.sin(0.05)])
    center = np.array([1, 0, 0.2]) + (radius + gap) * np.array([np.sin(0.05), 0, np.cos(0.05)])
    feature, point, normal, gaps = touch(capsule(center, lean, 0.5, radius), slab)
    np.testing.assert_array_equal(np.sort(feature), [0, 1, 2])
    np.testing.assert_allclose(gaps[feature == 2], gap)
    height = (radius + gap) / np.cos(0.05) - radius  # over the edge
    np.testing.assert_allclose(gaps[feature == 1], height, atol=1e-6)
    np.testing.assert_allclose(normal[feature < 2], [[0, 0, -1]] * 2, atol=1e-15)
    at_end = center[2] + 0.5 * np.sin(0.05) - 0.2 - radius
    np.testing.assert_allclose(gaps[feature == 0], at_end, atol=1e-12)


@pytest.mark.parametrize("gap", [0.05, 0.0, -0.05])
@pytest.mark.parametrize(("x", "stretch"), [(0.0, (-0.5, 0.5)), (0.9, (0.4, 1.0)), (-1.3, (-1.0, -0.8))])
def test_a_capsule_on_a_face_touches_at_the_ends_of_the_stretch_over_it(gap, x, stretch):
    slab = body((0, 0, 0), np.eye(3), (1, 1, 0.2))
    feature, point, normal, gaps = touch(capsule((x, 0.3, 0.5 + gap), (1, 0, 0), 0.5, 0.3), slab)
    np.testing.assert_array_equal(feature, [0, 1])
    np.testing.assert_allclose(gaps, gap, atol=1e-15)
    np.testing.assert_allclose(point, [[at, 0.3, 0.2 + gap / 2] for at in stretch], atol=1e-6)
    np.testing.assert_allclose(normal, [[0, 0, -1]] * 2, atol=1e-15)


def test_a_core_inside_a_box_is_pushed_out_the_shortest_way():
    slab = body((0, 0, 0), np.eye(3), (2, 2, 0.5))
    _, point, normal, gaps = touch(capsule((0, 0, 0.3), (1, 0, 0), 0.5, 0.1), slab)
    np.testing.assert_allclose(gaps, [-0.3] * 2)
    np.testing.assert_allclose(normal, [[0, 0, -1]] * 2)
    np.testing.assert_allclose(point, [[x, 0, 0.35] for x in (-0.5, 0.5)])


unit = st.floats(-1.0, 1.0)
vectors = st.tuples(unit, unit, unit).map(np.array)
lengths = st.floats(0.2, 1.0)


@st.composite
def close_pairs(draw):
    """A capsule and a capsule or a box in any position, often nearly parallel, with gaps from -DELTA to 1.5 DELTA."""
    other = body(draw(vectors), turned(3.0 * draw(vectors)), draw(st.tuples(lengths, lengths, lengths)))
    if draw(st.booleans()):
        other = body(other[0], other[1], (0, 0, draw(lengths)), draw(lengths))
    tilt = turned(draw(vectors) * (10.0 ** draw(st.floats(-9, 0)) if draw(st.booleans()) else 3.0))
    length, radius = draw(lengths), draw(lengths)
    way, shift = draw(vectors), draw(unit) * other[1][:, 2]
    assume(np.linalg.norm(way) > 0.1)
    way /= np.linalg.norm(way)

    def at(far):
        return body(other[0] + shift + far * way, tilt @ other[1], (0, 0, length), radius)

    far = np.linalg.norm(other[2]) + length + other[3] + radius + 2.0
    gap = DELTA * draw(st.floats(-1.0, 1.5))
    for _ in range(50):  # conservative advancement
        apart = distance(at(far), other) - other[3] - radius - gap
        far -= apart
        if apart < 1e-9:
            break
    return at(far), other


@settings(max_examples=60, deadline=None, derandomize=True)
@given(close_pairs())
def test_the_least_gap_is_the_distance_and_points_lie_between_the_surfaces(pair):
    one, other = pair
    gap = distance(one, other) - one[3] - other[3]
    feature, point, normal, gaps = touch(one, other)
    if gap > DELTA + 1e-7:
        assert len(gaps) == 0
    elif len(gaps) == 0:
        assert gap > DELTA - DISTINCT - 1e-5
    else:
        assert -1e-6 <= gaps.min() - gap <= DISTINCT + 1e-5
        assert gaps.max() <= DELTA
        assert len(set(feature)) == len(feature)
        np.testing.assert_allclose(np.linalg.norm(normal, axis=1), 1.0, rtol=1e-12)
        assert outside(one, point - 0.5 * gaps[:, None] * normal).max() <= 1e-5
        assert outside(other, point + 0.5 * gaps[:, None] * normal).max() <= 1e-5


@settings(max_examples=25, deadline=None, derandomize=True)
@given(close_pairs())
def test_contacts_of_capsules_do_not_depend_on_their_order(pair):
    one, other = pair
    assume(other[3] > 0.0)
    _, point, normal, gaps = touch(one, other)
    _, other_point, other_normal, other_gaps = touch(other, one)
    assert len(point) == len(other_point)
    if len(point):
        nearest = np.linalg.norm(point[:, None] - other_point, axis=2).argmin(axis=1)
        np.testing.assert_allclose(other_point[nearest], point, atol=1e-5)
        np.testing.assert_allclose(-other_normal[nearest], normal, atol=1e-5)
        np.testing.assert_allclose(other_gaps[nearest], gaps, atol=1e-7)


def test_mass_and_moments_by_sampling():
    rng, radius, half = np.random.default_rng(4), 0.3, 0.5
    mass, moments = solid(CAPSULE, np.array([[radius, half, 0.0]]), np.array([1000.0]))
    points = rng.uniform(-1, 1, (400_000, 3)) * [radius, radius, half + radius]
    beyond = np.maximum(np.abs(points[:, 2]) - half, 0.0)
    inside = points[points[:, 0] ** 2 + points[:, 1] ** 2 + beyond**2 <= radius**2]
    volume = 8 * radius**2 * (half + radius)
    assert mass[0] == pytest.approx(1000.0 * volume * len(inside) / len(points), rel=0.01)
    squares = (inside**2).mean(axis=0)
    np.testing.assert_allclose(moments[0], mass[0] * (squares.sum() - squares), rtol=0.01)
    short = solid(CAPSULE, np.array([[radius, 1e-9, 0.0]]), np.array([1000.0]))
    np.testing.assert_allclose(short[1][0], mass_properties([Sphere(radius)], 1000.0)[2].diagonal(), rtol=1e-6)


def test_capsules_as_parts_of_bodies():
    turn = quaternion.exponential(np.array([0.0, np.pi / 2, 0.0]))
    part = Capsule(0.2, 0.5, (1, 0, 0), tuple(turn))
    mass, center, tensor = mass_properties([part], 100.0)
    np.testing.assert_allclose(center, [1, 0, 0])
    assert tensor[0, 0] < tensor[1, 1] == pytest.approx(tensor[2, 2])
    back = moved(part, np.array([1.0, 0, 0]), turn)
    np.testing.assert_allclose(back.center, 0.0, atol=1e-15)
    np.testing.assert_allclose(back.quaternion, [1, 0, 0, 0], atol=1e-15)
