"""Boxes on boxes against analytic cases, optimisation and convex hulls."""

from __future__ import annotations

import numpy as np
import pytest
from convex import SIGNS, distance, outside, signed_distance
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from dem import quaternion
from dem.contact.polyhedra import FLUSH, Polyhedra, hulls_of, polyhedra_polyhedra
from dem.contact.simplex import ROUND, SNAP

DELTA = 0.1
BOXES = hulls_of(())

#: Features: corners of the first box, corners of the second, and from here on edges.
CORNER_OF_SECOND, EDGES = 8, 16


def turned(*rotations):
    """The frame that comes of rotations about fixed axes, one after the other."""
    frame = np.eye(3)
    for rotation in rotations:
        frame = quaternion.matrix(quaternion.exponential(np.array(rotation, float))) @ frame
    return frame


def box(half, center=(0.0, 0.0, 0.0), frame=None):
    return np.array(center, float), np.eye(3) if frame is None else frame, np.array(half, float), 0.0


def touch(one, other, delta=DELTA):
    """The contacts of two boxes: features, points, normals, gaps, ordered by gap and place."""
    sides = (Polyhedra(*(c[None] for c in side[:3]), np.zeros(1, int), BOXES) for side in (one, other))
    found = polyhedra_polyhedra(*sides, np.array([delta]))
    order = np.lexsort((*np.round(found.touch.point, 9).T, np.round(found.touch.gap, 9)))
    return (found.feature[order], *(values[order] for values in found.touch))


def rows(points):
    """Points in an order that rounding does not change."""
    return points[np.lexsort(np.round(points, 9).T)]


@pytest.mark.parametrize("gap", [0.05, 0.0, -0.02])
def test_a_small_box_on_a_large_one_stands_on_four_corners(gap):
    feature, point, normal, gaps = touch(box((1, 1, 0.5)), box((0.3, 0.2, 0.4), (0.1, 0.2, 0.9 + gap)))
    assert (feature >= CORNER_OF_SECOND).all()
    assert (feature < EDGES).all()
    np.testing.assert_allclose(gaps, gap, atol=1e-15)
    np.testing.assert_array_equal(normal, np.tile([0, 0, 1.0], (4, 1)))
    expected = [[x, y, 0.5 + gap / 2] for y in (0.0, 0.4) for x in (-0.2, 0.4)]
    np.testing.assert_allclose(rows(point), expected, atol=1e-15)


@pytest.mark.parametrize("noise", [0.0, 1e-12, 1e-7, 1e-4])
def test_equal_boxes_on_top_of_each_other_touch_at_four_corners_with_lasting_names(noise):
    half, rng = (0.3, 0.2, 0.1), np.random.default_rng(1)
    names = []
    for _ in range(10):
        frame = turned(noise * rng.uniform(-1, 1, 3))
        feature, point, _, gaps = touch(box(half), box(half, np.array([0, 0, 0.2]) + noise * rng.normal(size=3), frame))
        np.testing.assert_allclose(gaps, 0.0, atol=5 * noise + 1e-15)
        corners = [[x, y, 0.1] for y in (-0.2, 0.2) for x in (-0.3, 0.3)]
        assert len(point) == 4
        apart = np.linalg.norm(point[:, None] - np.array(corners), axis=2)
        np.testing.assert_allclose(apart.min(axis=1), 0.0, atol=5 * noise + 1e-15)
        assert len(set(apart.argmin(axis=1))) == 4
        names.append(sorted(feature))
    if noise < 1e-4:
        assert names == [names[0]] * 10


def test_squares_turned_by_45_degrees_share_an_octagon():
    feature, point, _, gaps = touch(box((1, 1, 1)), box((1, 1, 1), (0, 0, 2.01), turned((0, 0, np.pi / 4))))
    assert len(set(feature)) == 8
    assert (feature >= EDGES).all()
    np.testing.assert_allclose(gaps, 0.01, atol=1e-15)
    octagon = [sorted(pair) for pair in np.abs(point[:, :2])]
    np.testing.assert_allclose(octagon, np.tile([np.sqrt(2) - 1, 1.0], (8, 1)), atol=1e-14)


def test_an_edge_on_a_face_is_two_points():
    frame, reach = turned((0, np.pi / 4, 0)), 0.5 * np.sqrt(2)
    feature, point, normal, gaps = touch(box((2, 2, 1)), box((0.5, 0.7, 0.5), (0.3, 0, 1.02 + reach), frame))
    assert len(set(feature)) == 2
    np.testing.assert_allclose(gaps, 0.02, atol=1e-14)
    np.testing.assert_allclose(rows(point), [[0.3, -0.7, 1.01], [0.3, 0.7, 1.01]], atol=1e-14)
    np.testing.assert_allclose(normal, [[0, 0, 1]] * 2, atol=1e-15)


@pytest.mark.parametrize("gap", [0.03, 1e-12, 1e-16, 0.0, -1e-16, -0.01])
def test_crossed_edges_touch_in_one_point(gap):
    """Two roofs, one on its head and turned by a right angle: ridge on ridge."""
    reach = np.sqrt(2)
    below = box((1, 1, 1), (0, 0, -reach), turned((np.pi / 4, 0, 0)))
    above = box((1, 1, 1), (0.3, 0.2, reach + gap), turned((0, np.pi / 4, 0)))
    (feature,), point, normal, gaps = touch(below, above)
    assert feature >= EDGES
    np.testing.assert_allclose(gaps, gap, atol=1e-12)
    np.testing.assert_allclose(point, [[0.3, 0, gap / 2]], atol=1e-12)
    np.testing.assert_allclose(normal, [[0, 0, 1]], atol=1e-12)


def test_boxes_out_of_reach_and_no_boxes():
    assert len(touch(box((1, 1, 1)), box((1, 1, 1), (0, 0, 2.11)))[3]) == 0
    assert len(touch(box((1, 1, 1)), box((1, 1, 1), (0, 0, 2.1 - 1e-12)))[3]) == 4
    none = Polyhedra(np.zeros((0, 3)), np.zeros((0, 3, 3)), np.zeros((0, 3)), np.zeros(0, int), BOXES)
    found = polyhedra_polyhedra(none, none, np.zeros(0))
    assert len(found.pair) == len(found.touch.gap) == 0


unit = st.floats(-1.0, 1.0)
vectors = st.tuples(unit, unit, unit).map(np.array)
sizes = st.tuples(*[st.floats(0.2, 1.0)] * 3).map(np.array)


@st.composite
def close_boxes(draw):
    """Two boxes in any position, the second often nearly parallel to the first, about as close as DELTA."""
    one = box(draw(sizes), draw(vectors), turned(3.0 * draw(vectors)))
    frame = turned(3.0 * draw(vectors))
    if draw(st.booleans()):
        tilt, twist = 10.0 ** draw(st.floats(-9, 0)), np.pi * draw(unit)
        frame = turned(tilt * draw(vectors)) @ one[1] @ turned((twist, 0, 0))
    half, way = draw(sizes), draw(vectors)
    assume(np.linalg.norm(way) > 0.1)
    way /= np.linalg.norm(way)
    far = np.linalg.norm(one[2]) + np.linalg.norm(half)
    for _ in range(30):  # conservative advancement until they touch
        apart = distance(one, box(half, one[0] + far * way, frame))
        far -= apart
        if apart < 1e-7:
            break
    return one, box(half, one[0] + (far + 1.5 * DELTA * draw(unit)) * way, frame)


@settings(max_examples=50, deadline=None, derandomize=True)
@given(close_boxes())
def test_the_least_gap_is_the_signed_distance_and_points_lie_between_the_surfaces(boxes):
    one, other = boxes
    gap = signed_distance(one, other)
    feature, point, normal, gaps = touch(one, other)
    size = min(one[2].min(), other[2].min())
    tolerance = FLUSH * DELTA + 2 * SNAP * size
    assert len(gaps) <= 8
    if gap > DELTA + 1e-7:
        assert len(gaps) == 0
    elif len(gaps) == 0:
        assert gap > DELTA - tolerance
    else:
        assert abs(gaps[0] - gap) <= tolerance + 1e-7
        if gap > 0:
            assert gaps[0] >= gap - 1e-6
        assert gaps[-1] <= DELTA
        assert len(set(feature)) == len(feature)
        np.testing.assert_allclose(np.linalg.norm(normal, axis=1), 1.0, rtol=1e-12)
        for body, side in ((one, -0.5), (other, 0.5)):
            assert outside(body, point + side * gaps[:, None] * normal).max() <= (3 * SNAP + 2 * ROUND) * size


@settings(max_examples=25, deadline=None, derandomize=True)
@given(close_boxes(), vectors, vectors)
def test_contacts_depend_neither_on_the_order_of_the_boxes_nor_on_the_frame(boxes, rotation, shift):
    one, other = boxes
    # Not at a threshold, where rounding decides.
    least = [touch(one, other, delta)[3] for delta in (DELTA * (1 - 1e-6), DELTA, DELTA * (1 + 1e-6))]
    assume(len({len(gaps) for gaps in least}) == 1)
    _, point, normal, gaps = touch(one, other)
    turn = turned(3.0 * rotation)
    moved = [box(b[2], turn @ b[0] + shift, turn @ b[1]) for b in (one, other)]
    for found, frame, place, sign in (
        (touch(other, one), np.eye(3), np.zeros(3), -1.0),
        (touch(*moved), turn, shift, 1.0),
    ):
        assert len(found[1]) == len(point)
        if len(point):
            back = (found[1] - place) @ frame
            nearest = np.linalg.norm(point[:, None] - back, axis=2).argmin(axis=1)
            assert len(set(nearest)) == len(point)
            np.testing.assert_allclose(back[nearest], point, atol=1e-6)
            np.testing.assert_allclose(sign * found[2][nearest] @ frame, normal, atol=1e-4)
            np.testing.assert_allclose(found[3][nearest], gaps, atol=1e-6)


def leaning(angle, gap, higher=0.0, turn=None):
    """Two cards that lean on each other, edge along edge, the second one `higher`, in a frame of any orientation."""
    half, turn = np.array((0.1, 0.6, 1.0)), np.eye(3) if turn is None else turn
    tips = [turned((0, side * angle, 0)) @ (side * half[0], 0.0, half[2]) for side in (1.0, -1.0)]
    shift = np.array((gap, 0.0, higher))
    return [
        box(half, turn @ (place - tip), turn @ turned((0, side * angle, 0)))
        for tip, side, place in zip(tips, (1.0, -1.0), (np.zeros(3), shift))
    ]


@pytest.mark.parametrize("gap", [1e-3, 1e-8, 0.0, -1e-8, -1e-3])
@pytest.mark.parametrize("angle", [0.2, 0.35, 0.6])
def test_the_normal_of_edges_along_edges_is_the_mean_of_those_of_their_faces(angle, gap):
    for seed in range(4):
        turn = turned(3.0 * np.random.default_rng(seed).normal(size=3)) if seed else np.eye(3)
        _, point, normal, _ = touch(*leaning(angle, gap, turn=turn))
        assert len(point) == 2
        np.testing.assert_allclose(normal @ turn, [[1, 0, 0]] * 2, atol=1e-9)
        np.testing.assert_allclose(rows(point @ turn), [[gap / 2, -0.6, 0], [gap / 2, 0.6, 0]], atol=1e-9)


@pytest.mark.parametrize("gap", [1e-3, 0.0, -1e-3])
def test_the_normal_of_corners_on_corners_is_along_their_diagonal(gap):
    for turn in (np.eye(3), turned((1.0, 2.0, -0.5))):
        way = turn @ np.ones(3)
        one, other = box((1, 1, 1), frame=turn), box((0.5, 0.5, 0.5), (1.5 + gap / 3**0.5) * way, turn)
        _, point, normal, _ = touch(one, other)
        np.testing.assert_allclose(normal, [way / 3**0.5], atol=1e-9)
        np.testing.assert_allclose(point, [way * (1 + 0.5 * gap / 3**0.5)], atol=1e-9)


@pytest.mark.parametrize("gap", [1e-3, 0.0, -1e-3])
def test_normals_and_gaps_turn_steadily_from_the_face_of_one_to_that_of_the_other(gap):
    """One edge passes over the other: the normal is that of a face, then turns over some hundredths of the half
    thickness, and is that of the other face."""
    angle, normals, gaps = 0.35, [], []
    for higher in np.linspace(-0.01, 0.01, 401):  # the half thickness is 0.1
        _, _, normal, least = touch(*leaning(angle, gap, higher))
        normals.append(normal[0])
        gaps.append(least[0])
        assert np.ptp(normal, axis=0).max() < 1e-9
    tilt = np.arctan2(np.array(normals)[:, 2], np.array(normals)[:, 0])
    np.testing.assert_allclose(tilt[[0, 200, -1]], [-angle, 0.0, angle], atol=1e-9)
    assert np.diff(tilt).min() > -1e-9
    assert np.diff(tilt).max() < 0.05
    assert np.abs(np.diff(gaps)).max() < 6e-5  # of steps of 5e-5


@pytest.mark.parametrize("lower", [0.02, 0.0, -0.004])
def test_a_corner_over_a_face_has_the_normal_of_the_face(lower):
    """Also beside its border, and a box that stands on the border with half of its face."""
    frame = turned((0, 0, 0.3), (0.5, 0.4, 0))
    low = (SIGNS @ frame.T)[:, 2].argmin()
    corner = frame @ SIGNS[low]
    for beside in (0.5, 0.05):
        over = box((1, 1, 1), np.array((1 - beside, 0.2, 1.0 + lower)) - corner, frame)
        _, point, normal, gaps = touch(box((1, 1, 1)), over)
        np.testing.assert_array_equal(normal[0], [0, 0, 1])
        np.testing.assert_allclose(point[0], [1 - beside, 0.2, 1 + lower / 2], atol=1e-12)
        np.testing.assert_allclose(gaps[0], lower, atol=1e-12)
    _, _, normal, gaps = touch(box((1, 1, 1)), box((1, 1, 1), (1.0, 0, 2.0 + lower)))
    np.testing.assert_array_equal(normal, [[0, 0, 1]] * 4)
    np.testing.assert_allclose(gaps, lower, atol=1e-14)
