"""run/study compare_liggghts: what LIGGGHTS gets, and what is made of its answer."""

from __future__ import annotations

import math
import shutil

import compare_liggghts
import numpy as np
import pytest

from pctt.scenes import Mixer


def start(position, angle=0.0):
    """Spheres in the mixer n = 1: walls at .375 m, the paddle .375 x .0375 x .1875 m on the axis."""
    return compare_liggghts.Start(Mixer(n=1), np.array(position), np.zeros((len(position), 6)), angle, 0.14375)


@pytest.fixture
def corners():
    return start([[x, y, 0.1] for x in (-0.26, 0.26) for y in (-0.26, 0.26)])


def test_overlaps_are_those_of_spheres_walls_and_the_paddle_where_it_has_turned_to(corners):
    apart = corners.position

    def moved(place):
        return compare_liggghts.overlap(corners, np.vstack([apart[1:], place]), 0.75)

    assert compare_liggghts.overlap(corners, apart, 0.75) == pytest.approx(0.0, abs=1e-12)
    assert moved([-0.26, -0.26, 0.09]) == pytest.approx(0.1)  # the floor
    assert moved([-0.28, -0.26, 0.1]) == pytest.approx(0.05)  # a wall
    assert moved([0.26, 0.08, 0.1]) == pytest.approx(0.2)  # a sphere
    turned = math.pi / 3 * 0.75  # 45 degrees
    across = np.array([math.sin(turned), -math.cos(turned), 0.0])
    assert moved(np.array([0, 0, 0.15]) + (0.01875 + 0.09) * across) == pytest.approx(0.1)


def test_the_limit_is_the_mean_of_two_estimates_with_the_error_that_they_show():
    rows = [{"code": "LIGGGHTS", "stiffness": k, "torque": t, "torque_error": 0.5} for k, t in ((1e7, 50), (1e8, 104))]
    own = {"code": "pctt", "tol": 3e-4, "torque_error": 0.5}
    rows += [own | {"dt": dt, "torque": t} for dt, t in ((0.01, 200), (0.0025, 100))]
    rows += [own | {"dt": 0.001, "stiffness": 1e7, "torque": 96.0}, own | {"torque": 70.0}]
    value, error = compare_liggghts.limit_of(rows)  # of 104 and 100
    assert value == pytest.approx(102.0)
    assert error == pytest.approx(2.0)
    assert compare_liggghts.limit_of(rows[:2]) == (104, 0.5)


def test_without_liggghts_the_study_says_what_to_install(monkeypatch, capsys):
    monkeypatch.setattr("sys.argv", ["compare_liggghts", "1"])
    monkeypatch.setenv("PATH", "")
    with pytest.raises(SystemExit) as end:
        compare_liggghts.main()
    assert end.value.code == 1
    assert "apt-get install liggghts" in capsys.readouterr().err


@pytest.mark.skipif(not shutil.which("liggghts"), reason="there is no program liggghts on the path")
def test_spheres_lie_on_the_floor_of_liggghts_with_their_weight(corners):
    course = compare_liggghts.theirs(corners, 1e7, 0.11)
    assert course.floor[course.time > 0.05].mean() == pytest.approx(corners.weight, rel=0.01)
    assert len(course.samples) == 4
    np.testing.assert_allclose(course.samples[-1][1], corners.position, atol=1e-4)
    np.testing.assert_array_equal(course.torque, 0.0)
