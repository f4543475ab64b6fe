from __future__ import annotations

import json

import numpy as np
import pytest
from mpi4py import MPI

from dem import quaternion
from dem.model.changes import changes, restore
from dem.motion import Fixed, Glide, Guided, Oscillation, Path, Rotation, checked_pose, refuse_ignored, velocity_between
from dem.scene import Scene
from dem.shapes import Box
from dem.start import new_world

PLACE, TURN = np.array([1.0, 2.0, 3.0]), quaternion.normalized(np.array([1.0, 0.5, 0.0, 0.2]))
MOTIONS = [Fixed(), Rotation((0.1, 0.0, 1.0), (2.0, 0.0, 0.0)), Oscillation((1.0, 2.0, 0.0), 0.3, 4.0, 0.7)]
MOTIONS += [Oscillation((1.0, 2.0, 0.0), 0.3, 4.0, 0.7, start=1.4), Glide((1.0, -2.0, 0.5), start=0.3, end=1.4)]
MOTIONS += [Rotation((0.1, 0.0, 1.0), start=1.4), Rotation((0.1, 0.0, 1.0), end=1.4)]
MOTIONS += [Oscillation((1, 0, 0), 1, 1, end=1.4)]
MOTIONS += [Path((0.5, 1.4, 2.0), ((1, 1, 1), (2, 0, 1), (2, 0, 3)))]


def mean_velocity(motion, time, dt, *pose):
    """Velocity (6,) from a time to dt later of a body with the given pose at time zero."""
    return velocity_between(checked_pose(motion, time, *pose), checked_pose(motion, time + dt, *pose), dt)


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
    np.testing.assert_allclose(quaternion.integrate(turn[None], velocity[None, 3:], dt)[0], end_turn, atol=1e-14)


def test_rotation_and_oscillation_rest_before_and_after():
    upright = np.array([1.0, 0.0, 0.0, 0.0])
    turning = Rotation((0, 0, np.pi), start=1.0, end=1.5)
    swinging = Oscillation((1, 0, 0), 0.3, 2.0, start=1.0, end=1.5)
    for time, quarter, gone in ((0.0, 0, 0.0), (0.9, 0, 0.0), (1.25, 0.5, 0.3 * np.sin(np.pi / 4)), (7.0, 1, 0.3)):
        place, turn = turning.pose(time, PLACE, upright)
        expected = quaternion.exponential(np.array([0, 0, quarter * np.pi / 2]))
        np.testing.assert_allclose(turn, expected, atol=1e-15)
        np.testing.assert_allclose(place, quaternion.rotate(expected, PLACE), atol=1e-15)
        np.testing.assert_allclose(swinging.pose(time, PLACE, TURN)[0] - PLACE, [gone, 0, 0], atol=1e-15)
    assert not mean_velocity(turning, 0.5, 0.25, PLACE, TURN).any()  # nothing is dragged before it turns
    np.testing.assert_allclose(mean_velocity(turning, 1.1, 0.25, 0 * PLACE, TURN), [0, 0, 0, 0, 0, np.pi], atol=1e-14)
    np.testing.assert_allclose(mean_velocity(turning, 0.9, 0.2, 0 * PLACE, TURN)[5], np.pi / 2, atol=1e-14)


class Rocking:
    def pose(self, time, position, orientation):
        turn = quaternion.exponential(np.array([self.angle(time), 0, 0]))
        return position, quaternion.multiply(turn, orientation)

    def angle(self, time):
        return 0.3 * np.sin(time)


def test_a_motion_of_ones_own_is_a_pose_alone():
    refuse_ignored(Rocking())
    turning = mean_velocity(Rocking(), 0.4, 1e-4, PLACE, TURN)[3:]
    np.testing.assert_allclose(turning, [0.3 * np.cos(0.4), 0, 0], atol=1e-4)


class Belt(Rocking):
    def angular_velocity(self):
        return np.array([0, 7.0, 0])


class Shaken(Guided):
    def pose(self, time, position, orientation):
        return position, orientation


class Pushed(Glide):
    @property
    def force(self):
        return np.zeros(3)


class Used(Glide):
    def force(self, time):
        return time

    def pose(self, time, position, orientation):
        return position + self.force(time), orientation


def test_a_motion_that_defines_what_nothing_asks_for_is_refused():
    """Such definitions were ignored in silence."""
    refuse_ignored(Used((1, 0, 0)))
    for motion in MOTIONS:
        refuse_ignored(motion)
    for motion, name in ((Belt(), "angular_velocity"), (Shaken((0, 0, 1)), "pose"), (Pushed((0, 0, 1)), "force")):
        with pytest.raises(ValueError, match=f"the motion {type(motion).__name__} defines {name}, which nothing asks"):
            refuse_ignored(motion)


@pytest.mark.parametrize(
    ("pose", "words"),
    [
        ((np.full(3, np.nan), TURN), "position of the pose of Own at 0.4 s: NaN"),
        ((PLACE[:2], TURN), "position of the pose of Own at 0.4 s must be 3 numbers"),
        ((PLACE, np.zeros(4)), "quaternion of the pose of Own at 0.4 s: zero quaternion"),
        ((PLACE, PLACE), "quaternion of the pose of Own at 0.4 s must be 4 numbers"),
    ],
)
def test_what_is_no_pose_is_refused(pose, words):
    class Own:
        def pose(self, time, position, orientation):
            return pose

    with pytest.raises(ValueError, match=words):
        mean_velocity(Own(), 0.4, 0.1, PLACE, TURN)


def test_a_motion_may_give_lists_and_work_in_the_arrays_that_it_gets():
    class Own:
        def pose(self, time, position, orientation):
            position += [0, 0, 0.5 * time]
            return list(position), [2.0, 0, 0, 0]

    place, turn = PLACE.copy(), TURN.copy()
    np.testing.assert_allclose(mean_velocity(Own(), 2.0, 0.1, place, turn), [0, 0, 0.5, 0, 0, 0], atol=1e-14)
    np.testing.assert_array_equal([*place, *turn], [*PLACE, *TURN])
    np.testing.assert_array_equal(checked_pose(Own(), 2.0, place, turn)[1], [1, 0, 0, 0])


def test_a_path_goes_straight_from_place_to_place():
    motion = Path((1, 2, 4), ((1, 1, 1), (1, 3, 1), (2, 3, 1)))
    for time, gone in ((0.0, (0, 0, 0)), (1.5, (0, 1, 0)), (3.0, (0.5, 2, 0)), (9.0, (1, 2, 0))):
        np.testing.assert_allclose(motion.pose(time, PLACE, TURN)[0] - PLACE, gone, atol=1e-15)
    np.testing.assert_allclose(mean_velocity(motion, 2.0, 0.5, PLACE, TURN), [0.5, 0, 0, 0, 0, 0], atol=1e-14)


def test_a_path_from_a_file(tmp_path):
    file = tmp_path / "path.csv"
    file.write_text("# t, x, y, z\n0, 0, 0, 0\n\n1.5  0 1 0  # up\n")
    assert Path.read(file) == Path((0, 1.5), ((0, 0, 0), (0, 1, 0)))
    file.write_bytes("\ufeff0,0,0,0\r\n1.5,0,1,0\r\n".encode())  # as spreadsheets write it
    assert Path.read(file) == Path((0, 1.5), ((0, 0, 0), (0, 1, 0)))
    with pytest.raises(ValueError, match=r"none.csv: cannot be read \(No such file or directory\)"):
        Path.read(tmp_path / "none.csv")
    for text, words in (
        ("0 0 0 0\n1 2 3\n", "line 2: '1 2 3': not a time and three coordinates, as 0.5"),
        ("0 0 0 x\n", "line 1: '0 0 0 x': not a time"),
        ("0 0 0 nan\n", "line 1: .*: not a time"),
        ("t,x,y,z\n0,0,0,0", "line 1: 't,x,y,z': .*; names begin with #"),
        ("0 0 0 0\n0 1 1 1\n", "must ascend from zero or later, got 0, 0"),
        ("# nothing\n", "must ascend from zero or later, got none"),
    ):
        file.write_text(text)
        with pytest.raises(ValueError, match=words) as error:
            Path.read(file)
        assert str(file) in str(error.value)


# -- motions as text ----------------------------------------------------------------------------------------


def tools():
    scene = Scene(friction=0.3)
    scene.add_spheres([[0, 0, 3.0]], 0.1, 1000.0)
    scene.add_body("tool", [Box((0.1, 0.1, 0.1))], Glide((1, 0, 0)), position=(1, 2, 3))
    scene.add_body("lid", [Box((0.1, 0.1, 0.1))], Guided((0, 0, 1)), density=1000.0, position=(4, 0, 0))
    return new_world(scene, MPI.COMM_SELF)


GOOD = {"motion": "Rotation", "values": {"velocity": [0, 0, 2.0], "end": float("inf")}}
GOOD |= {"position": [1, 2, 4], "quaternion": [0.0, 1.0, 0.0, 0.0], "surface": [0.5, 0, 0]}


def test_a_motion_from_text_is_that_of_the_body():
    world = tools()
    restore(world, json.dumps({"body": {"tool": GOOD}}))
    (tool, lid), again = world.large_bodies, tools()
    assert tool.motion == Rotation((0, 0, 2.0))
    assert (tool.position.tolist(), tool.quaternion.tolist()) == ([1, 2, 4], [0, 1, 0, 0])
    assert tool.surface == (0.5, 0.0, 0.0)
    assert lid.motion == Guided((0, 0, 1))
    restore(again, changes(world))
    assert again.large_bodies[0].motion == tool.motion


STRANGE = {
    "a class that is no motion": {"motion": "FilePath", "values": {}},
    "a function": {"motion": "checked_pose", "values": {}},
    "a base class": {"motion": "Driven", "values": {}},
    "a module": {"motion": "quaternion", "values": {}},
    "no name": {"motion": ["Rotation"]},
    "a parameter that it has not": {"values": {"velocity": [0, 0, 1], "torque": 1.0}},
    "text for a vector": {"values": {"velocity": "fast"}},
    "a vector of four": {"values": {"velocity": [1, 2, 3, 4]}},
    "forces that would begin to move it": {"motion": "Dynamic", "values": {}},
    "a guide that would begin": {"motion": "Guided", "values": {"direction": [1, 0, 0]}},
    "no position": {"position": [1, 2]},
    "a position that is no number": {"position": [1, 2, float("nan")]},
    "a quaternion of norm two": {"quaternion": [2, 0, 0, 0]},
    "a surface that is no vector": {"surface": [1]},
}


@pytest.mark.parametrize("what", STRANGE)
def test_what_is_no_motion_is_refused(what):
    world = tools()
    with pytest.raises((TypeError, ValueError)):
        restore(world, json.dumps({"body": {"tool": {**GOOD, **STRANGE[what]}}}))
    assert world.large_bodies[0].motion == Glide((1, 0, 0))


def test_another_guide_is_refused():
    other = {**GOOD, "motion": "Guided", "values": {"direction": [1, 0, 0]}}
    with pytest.raises(ValueError, match="'lid' cannot change its motion"):
        restore(tools(), json.dumps({"body": {"lid": other}}))
