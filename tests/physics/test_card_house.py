"""Two cards that lean on each other: the friction that statics asks for."""

from __future__ import annotations

import numpy as np
import pytest

import pctt
from dem import quaternion
from dem.scene import Scene
from dem.shapes import Plane

HALF = np.array((2e-3, 0.03, 0.05))


def sunk(angle, friction, yaw):
    """By how much of their height two cards of angles from the vertical sink in a fifth of a second."""
    scene = Scene(friction)
    scene.add_body("floor", [Plane((0, 0, 1))])
    sine, cosine = np.sin(angle), np.cos(angle)
    place = np.array((-HALF[2] * sine - HALF[0] * cosine, 0, HALF[2] * cosine + HALF[0] * sine)) + (-1e-6, 0, 1e-6)
    about = quaternion.exponential(np.array((0.0, 0.0, yaw)))
    for side in (1, -1):
        lean = quaternion.multiply(about, quaternion.exponential(np.array((0.0, side * angle, 0.0))))
        scene.add_boxes(quaternion.rotate(about, place * (side, 1, 1)), HALF, 1000.0, quaternions=lean)
    sim = pctt.Simulation(scene)
    sim.run(until=0.2)
    return 1.0 - sim.positions[:, 2].min() / place[2]


@pytest.mark.parametrize(("angle", "yaw"), [
    pytest.param(15, 0.0, marks=pytest.mark.slow), (22, 0.7), pytest.param(30, -2.0, marks=pytest.mark.slow),
])  # fmt: skip
def test_cards_stand_with_a_tenth_more_friction_than_statics_asks_for_and_fall_with_a_tenth_less(angle, yaw):
    """Feet and ridge are on the inner faces; by symmetry the force at the ridge is level. The moment of a card about
    its foot: H 2 L cos(a) = W (L sin(a) - t cos(a)), and friction has to give H of W."""
    angle = np.radians(angle)
    needed = 0.5 * (np.tan(angle) - HALF[0] / HALF[2])
    assert sunk(angle, 1.1 * needed, yaw) < 2e-3
    assert sunk(angle, 0.9 * needed, yaw) > 1e-2
