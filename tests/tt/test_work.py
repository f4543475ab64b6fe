"""Limits of set-ups."""

from __future__ import annotations

import numpy as np
import pytest

from pctt import tt
from pctt.tt.inverse import invert_near_identity
from pctt.tt.work import TooMuchWorkError, Work


def smooth(i: np.ndarray, j: np.ndarray) -> np.ndarray:
    return (i == j) + 0.5 * np.exp(-(((i - j) / 40.0) ** 2))


def test_a_limit_ends_compression_and_inversion_at_the_same_place() -> None:
    digits = tt.GridDigits((256,))

    def both(work: Work) -> None:
        T = tt.compress_cross(tt.EntryMatrix(smooth, digits), 40, 1e-6, work=work).train.symmetric_part(1e-8)
        invert_near_identity(T, 40, eps=1e-6, work=work)

    free = [Work(), Work()]
    for work in free:
        found = tt.compress_cross(tt.EntryMatrix(smooth, digits), 40, 1e-6, work=work)
    assert free[0].spent == free[1].spent > 200 * found.evaluations * 0.99
    T = found.train.symmetric_part(1e-8)
    before = free[0].spent
    whole = invert_near_identity(T, 40, eps=1e-6, work=free[0])
    assert whole.residual <= 1e-6
    for limit, phase in ((0.5 * before, "the compression"), (0.5 * (before + free[0].spent), "the inversion")):
        work = Work(limit)
        with pytest.raises(TooMuchWorkError, match=phase):
            both(work)
        assert work.spent < 2 * free[0].spent
