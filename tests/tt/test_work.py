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
    spent: list[float] = []

    def both(work: Work) -> tt.Inverse:
        found = tt.compress_cross(tt.EntryMatrix(smooth, tt.GridDigits((256,))), 40, 1e-6, work=work)
        spent.append(work.spent)
        assert work.spent > 200 * found.evaluations * 0.99
        inverse = invert_near_identity(found.train.symmetric_part(1e-8), 40, eps=1e-6, work=work)
        spent.append(work.spent)
        return inverse

    assert both(Work()).residual <= 1e-6
    both(Work())
    compression, whole, *again = spent
    assert again == [compression, whole]
    inversion = whole - compression
    for limit, phase in ((0.5 * compression, "the compression"), (compression + 0.02 * inversion, "the inversion")):
        work = Work(limit)
        with pytest.raises(TooMuchWorkError, match=phase):
            both(work)
        assert work.spent < 2 * whole
    work = Work(compression + 0.12 * inversion)  # the result of the last whole sweep
    found = both(work)
    assert "the inversion, at rank" in found.stopped
    assert 1e-6 < found.residual < 0.5
    assert work.spent < whole
