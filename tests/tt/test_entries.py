"""Functions of indices: their digits, their norms and errors from samples, their trains."""

from __future__ import annotations

from math import prod

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pctt import tt
from pctt.tt.cross import _dominant

GRIDS = st.lists(st.integers(1, 7), min_size=1, max_size=3).map(tuple)


def dense(matrix: tt.EntryMatrix) -> np.ndarray:
    """All entries, padding included, in the order of the train."""
    modes, d = matrix.modes, len(matrix.modes)
    size = prod(modes)
    pairs = matrix.lookup(np.arange(size**2)).reshape(sum(((m, m) for m in modes), ()))
    return pairs.transpose(*range(0, 2 * d, 2), *range(1, 2 * d, 2)).reshape(size, size)


@given(GRIDS, st.sampled_from([1, 3]), st.booleans())
def test_entries_have_their_places(shape: tuple[int, ...], block: int, permuted: bool) -> None:
    digits = tt.GridDigits(shape, block)
    n = prod(shape) * block
    rng = np.random.default_rng(0)
    A = rng.random((n, n))
    order = rng.permutation(n) if permuted else None
    matrix = tt.EntryMatrix(lambda i, j: A[i, j], digits, order)
    T, places = dense(matrix), digits.places
    rows = np.arange(n) if order is None else order
    found = matrix.shift * np.eye(n) + T[np.ix_(places, places)] / matrix.scale
    np.testing.assert_allclose(found, A[np.ix_(rows, rows)], atol=1e-14)
    T[np.ix_(places, places)] = 0
    assert not T.any()  # padding stands for rows of the identity


def test_a_grid_of_too_many_points_is_refused() -> None:
    for shape in ((2**16, 2**15), (2**32, 2**32)):  # the second product is zero in 64 bits
        with pytest.raises(ValueError, match="too many points"):
            tt.GridDigits(shape)


def gauss(n: int, dimensions: int, width: float = 0.1):
    """I + 100 h^d exp(-r^2 / 2 w^2) on a grid of the unit cube."""

    def entries(i: np.ndarray, j: np.ndarray) -> np.ndarray:
        shape = (n,) * dimensions
        apart = np.subtract(np.unravel_index(i, shape), np.unravel_index(j, shape)) / n
        return (i == j) + 100 / n**dimensions * np.exp(-(apart**2).sum(axis=0) / (2 * width**2))

    return entries


@pytest.mark.parametrize("block", [1, 2])
def test_norms_and_errors_are_estimated_from_samples(block: int) -> None:
    shape = (12, 5)
    n = prod(shape) * block
    i = np.arange(n)
    A = 1.0 / (1 + abs(i[:, None] - i)) ** 2 + np.diag(i % 3.0)
    matrix = tt.EntryMatrix(lambda i, j: A[i, j], tt.GridDigits(shape, block=block))
    T = dense(matrix)
    assert matrix.norm() == pytest.approx(np.linalg.norm(T), rel=0.1)
    found = tt.compress_cross(matrix, 6, 1e-6)
    assert found.error == pytest.approx(np.linalg.norm(found.train.full() - T) / np.linalg.norm(T), rel=0.5)


def test_a_sine_of_a_sum_is_of_rank_two() -> None:
    """sin(x + y + z), x, y and z the digits of row - column, through a matrix (Oseledets 2011, section 4)."""
    matrix = tt.EntryMatrix(lambda i, j: np.sin((i - j) / 7.0), tt.GridDigits((4, 5, 7)))
    found = tt.compress_cross(matrix, 8, 1e-12)
    assert max(found.train.ranks) == 2
    assert found.error < 1e-12
    np.testing.assert_allclose(found.train.full(), dense(matrix), atol=1e-12)


@pytest.mark.parametrize("eps", [1e-2, 1e-4, 1e-8])
def test_cross_reaches_what_is_asked_for(eps: float) -> None:
    n = 24
    matrix = tt.EntryMatrix(gauss(n, 2), tt.GridDigits((n, n)))
    found = tt.compress_cross(matrix, 60, eps)
    T = dense(matrix)
    assert np.linalg.norm(found.train.full() - T) <= 2 * eps * np.linalg.norm(T)
    best = tt.decompose_matrix(T, matrix.modes, eps=eps)
    assert max(found.train.ranks) <= 1.2 * max(best.ranks) + 1


def test_the_cost_does_not_grow_with_the_grid() -> None:
    looked = []
    for n in (64, 4096):
        matrix = tt.EntryMatrix(gauss(n, 2), tt.GridDigits((n, n)))
        found = tt.compress_cross(matrix, 60, 1e-4)
        assert found.error < 1e-4
        looked.append(found.evaluations)
    assert looked[1] < 6 * looked[0]


def test_the_rows_of_a_cross_are_nearly_of_maximal_volume() -> None:
    """No row is more than 1.1 times any of them: Kahan's matrix, where pivoted orthogonalisation chooses badly."""
    n, c = 30, 0.3
    upper = np.diag((1 - c**2) ** (0.5 * np.arange(n))) @ (np.eye(n) - c * np.triu(np.ones((n, n)), 1))
    C = np.concatenate([upper.T, np.random.default_rng(0).standard_normal((60, n)) @ upper])
    for rank in (5, 10, 30):
        U, rows = _dominant(C, rank, 0.0)
        np.testing.assert_allclose(U[rows], np.eye(rank), atol=1e-8)
        assert np.abs(U).max() <= 1.1
