from __future__ import annotations

import numpy as np
import pytest

from dem import quaternion
from dem.motion import Fixed, Glide, Oscillation, Rotation, mean_velocity

PLACE, TURN = np.array([1.0, 2.0, 3.0]), quaternion.normalized(np.array([1.0, 0.5, 0.0, 0.2]))
MOTIONS = [Fixed(), Rotation((0.1, 0.0, 1.0), (2.0, 0.0, 0.0)), Oscillation((1.0, 2.0, 0.0), 0.3, 4.0, 0.7)]
MOTIONS += [Oscillation((1.0, 2.0, 0.0), 0.3, 4.0, 0.7, start=1.4), Glide((1.0, -2.0, 0.5), start=0.3, end=1.4)]


@pytest.mark.parametrize("motion", MOTIONS)
def test_the_pose_at_time_zero_is_the_given_one(motion):
    position, turn = motion.pose(0.0, PLACE, TURN)
    np.testing.assert_allclose(position, PLACE, atol=1e-15)
    np.testing.assert_allclose(turn, TURN, atol=1e-15)


@pytest.mark.parametrize("motion", MOTIONS)
def test_mean_velocity_takes_the_body_exactly_to_the_next_pose(motion):
    time, dt = 1.3, 0.25
    start, turn = motion.pose(time, PLACE, TURN)
    end, end_turn = motion.pose(time + dt, PLACE, TURN)
    velocity = mean_velocity(motion, time, dt, PLACE, TURN)
    np.testing.assert_allclose(start + dt * velocity[:3], end, atol=1e-14)
    np.testing.assert_allclose(quaternion.integrate(turn, velocity[3:], dt), end_turn, atol=1e-14)


def test_rotation_is_a_circle_about_its_axis():
    motion = Rotation((0.0, 0.0, np.pi / 2), (1.0, 0.0, 0.0))
    position, turn = motion.pose(1.0, np.array([2.0, 0.0, 5.0]), np.array([1.0, 0, 0, 0]))
    np.testing.assert_allclose(position, [1.0, 1.0, 5.0], atol=1e-15)
    np.testing.assert_allclose(quaternion.rotate(turn, np.array([1.0, 0, 0])), [0, 1.0, 0], atol=1e-15)


def test_oscillation_is_periodic_with_its_amplitude():
    motion = Oscillation((0.0, 2.0, 0.0), 0.3, 4.0)
    np.testing.assert_allclose(motion.pose(1.0, PLACE, TURN)[0] - PLACE, [0, 0.3, 0], atol=1e-15)
    np.testing.assert_allclose(motion.pose(4.0, PLACE, TURN)[0], PLACE, atol=1e-15)


def test_motions_with_a_start_rest_until_then():
    later, at_once = (Oscillation((0, 1, 0), 0.3, 4.0, 0.7, start) for start in (2.5, 0.0))
    np.testing.assert_array_equal(later.pose(2.5, PLACE, TURN)[0], PLACE)
    np.testing.assert_allclose(later.pose(3.1, PLACE, TURN)[0], at_once.pose(0.6, PLACE, TURN)[0], atol=1e-14)


def test_a_glide_rests_before_and_after():
    motion = Glide((1.0, 0.0, -2.0), start=0.5, end=1.5)
    for time, gone in ((0.2, 0.0), (0.75, 0.25), (1.5, 1.0), (9.0, 1.0)):
        np.testing.assert_allclose(motion.pose(time, PLACE, TURN)[0] - PLACE, [gone, 0, -2 * gone], atol=1e-15)


def test_bad_motions_are_refused():
    with pytest.raises(ValueError, match="cannot end"):
        Glide((1, 0, 0), start=2.0, end=1.0)
    with pytest.raises(ValueError, match="period"):
        Oscillation((1, 0, 0), 0.1, 0.0)
    with pytest.raises(ValueError, match="zero vector"):
        Oscillation((0, 0, 0), 0.1, 1.0)
    with pytest.raises(ValueError, match="angular velocity: NaN"):
        Rotation((0, 0, np.nan))
