"""run/study compare_mujoco: what MuJoCo gets, and what is made of its answer."""

from __future__ import annotations

import compare_mujoco
import numpy as np
import pytest
from compare_liggghts import Start

from pctt.scenes import Mixer


def test_without_mujoco_the_study_says_what_to_install(monkeypatch, capsys):
    monkeypatch.setattr("sys.argv", ["compare_mujoco", "1"])
    monkeypatch.setattr(compare_mujoco, "mujoco", None)
    with pytest.raises(SystemExit) as end:
        compare_mujoco.main()
    assert end.value.code == 1
    assert "pip install mujoco" in capsys.readouterr().err


@pytest.mark.skipif(compare_mujoco.mujoco is None, reason="there is no MuJoCo: pip install mujoco")
def test_spheres_lie_on_the_floor_of_mujoco_with_their_weight(monkeypatch):
    corners = np.array([[x, y, 0.1] for x in (-0.26, 0.26) for y in (-0.26, 0.26)])
    start = Start(Mixer(n=1), corners, np.zeros((4, 6)), 0.0, 0.14375)
    monkeypatch.setattr(compare_mujoco, "start_of", lambda n, seed: start)
    course = compare_mujoco.theirs(1, 0, 0.11, 1e-8)
    assert course.floor[course.time > 0.05].mean() == pytest.approx(start.weight, rel=0.01)
    np.testing.assert_allclose(course.samples[-1][1], corners, atol=1e-3)
    np.testing.assert_allclose(course.torque, 0.0, atol=1e-9 * start.weight)
