"""The ends of the colour bar."""

from __future__ import annotations

import numpy as np
import pytest

from pctt.render import COLOURS, _range


def test_outliers_do_not_leave_the_others_in_one_colour():
    speeds = np.append(np.linspace(0.0, 1.9, 1000), 500.0)
    assert _range("speed", [speeds]) == (0.0, 2.0)


@pytest.mark.parametrize(("colour", "ends"), [("size", (0.1, 0.4)), ("material", (-0.5, 0.9)), ("id", (0.0, 1.0))])
def test_sizes_reach_from_the_least_to_the_greatest(colour, ends):
    assert _range(colour, [np.array([0.1, 0.2]), np.array([0.4])]) == ends


@pytest.mark.parametrize("colour", COLOURS)
def test_what_is_alike_has_a_bar_all_the_same(colour):
    low, high = _range(colour, [np.full(5, 0.2)])
    assert low < high
