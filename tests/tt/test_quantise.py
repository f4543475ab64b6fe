"""Modes, digits, merged modes."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from pctt import tt


@given(st.integers(1, 10**7))
def test_chosen_modes_pad_little(n: int) -> None:
    modes = tt.choose_modes(n)
    slots = tt.slots_of(modes)
    assert slots >= n
    assert slots <= 1.07 * n + (20 if n < 1000 else 0)
    assert all(m <= 64 for m in modes)


@given(st.data(), st.lists(st.integers(1, 4), min_size=1, max_size=5), st.booleans())
def test_merged_modes_leave_the_matrix_alone(data: st.DataObject, modes: list[int], matrix: bool) -> None:
    train = tt.random(modes, 3, modes[::-1] if matrix else None)
    groups: list[int] = []
    while sum(groups) < len(modes):
        groups.append(data.draw(st.integers(1, len(modes) - sum(groups))))
    merged = tt.merge(train, groups)
    assert len(merged) == len(groups)
    np.testing.assert_allclose(merged.full().ravel(), train.full().ravel(), atol=1e-12)
