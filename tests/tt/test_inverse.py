"""Inverses against dense ones."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse as sp
from hypothesis import given, settings
from hypothesis import strategies as st
from matrices import laplacian, positive

from pctt import tt
from pctt.tt import inverse


def exact(dense: np.ndarray, modes: tuple[int, ...]) -> tt.Train:
    return tt.decompose_matrix(dense, modes, eps=1e-13)


@given(seed=st.integers(0, 2**32 - 1), b=st.sampled_from([1, 3]), modes=st.sampled_from([(3, 4), (2, 2, 3), (12,)]))
@settings(max_examples=12)
def test_full_rank_inverse_is_exact(seed: int, b: int, modes: tuple[int, ...]) -> None:
    dense = positive(np.random.default_rng(seed), 12, b).dense()
    S = exact(dense, tt.scalar_modes(modes, b))
    found = tt.invert(S, 10**6, sweeps=12, eps=1e-9)
    assert found.residual < 1e-8
    assert found.repaired == 0
    np.testing.assert_allclose(found.train.full(), np.linalg.inv(dense), atol=1e-7)


@given(seed=st.integers(0, 2**32 - 1), rank=st.integers(1, 12))
@settings(max_examples=12)
def test_residual_and_symmetry(seed: int, rank: int) -> None:
    dense = positive(np.random.default_rng(seed), 36, 2).dense()
    S = exact(dense, (3, 4, 6))
    one = np.eye(len(dense))
    for found, B in ((tt.invert(S, rank), one), (tt.invert_near_identity(S - tt.identity(S.rows), rank), dense - one)):
        X = found.train.full()
        error = np.linalg.norm(one - dense @ X)
        assert max(found.train.ranks) <= rank
        estimated = max(S.ranks) * max(found.train.ranks) > inverse.HIGH
        assert found.residual == pytest.approx(error / np.linalg.norm(B), rel=0.5 if estimated else 1e-6, abs=1e-10)
        assert error < 0.3 * len(X) ** 0.5  # that of the identity at most
        np.testing.assert_allclose(X, X.T, atol=1e-8)
        assert np.linalg.eigvalsh(X)[0] > 0


def laplacian_and_one(n: int, dimensions: int) -> np.ndarray:
    line = laplacian(n)
    A = line
    for _ in range(dimensions - 1):
        A = sp.kronsum(line, A)
    return A.toarray() + np.eye(n**dimensions) / n


@pytest.mark.parametrize(("n", "dimensions", "eps"), [(16, 2, 1e-2), (16, 2, 1e-4), (8, 3, 1e-3)])
def test_ranks_grow_until_the_residual_is_small_enough(n: int, dimensions: int, eps: float) -> None:
    dense = laplacian_and_one(n, dimensions)
    S = exact(dense, (2,) * round(np.log2(len(dense))))
    found = tt.invert(S, 60, sweeps=20, eps=eps)
    assert found.residual <= eps
    widest = max(found.train.ranks)
    assert widest < 60
    inverse = np.linalg.inv(dense)
    trains = (tt.decompose_matrix(inverse, S.rows, max_rank=rank) for rank in range(widest, 1, -1))
    best = next(train for train in trains if train.storage <= found.train.storage)
    assert found.residual <= tt.residual(S, best)  # as many numbers, the same rank in all bonds


def test_warm_start_of_a_near_matrix() -> None:
    rng = np.random.default_rng(0)
    dense = positive(rng, 64, 3).dense()
    S = exact(dense, (4, 4, 12))
    first = tt.invert(S, 8, sweeps=4)
    near = exact(dense + np.diag(0.02 * rng.random(len(dense))), S.rows)
    cold, warm = tt.invert(near, 8, sweeps=1), tt.invert(near, 8, start=first.train)
    assert warm.residual <= 1.05 * cold.residual
    wider = tt.invert(S, 12, start=first.train)
    assert wider.residual < first.residual


def test_rank_one_near_identity_is_the_identity() -> None:
    T = tt.random([3, 4], 2, [3, 4])
    found = tt.invert_near_identity(T, 1)
    np.testing.assert_array_equal(found.train.full(), np.eye(12))
    assert found.applied.norm() == 0


def test_indefinite_matrices_are_reported() -> None:
    dense = np.diag(np.r_[np.ones(60), -np.ones(4)])
    found = tt.invert(exact(dense, (4, 4, 4)), 4)
    assert found.repaired > 0
    assert np.isfinite(found.train.full()).all()
    with pytest.raises(ValueError, match="square"):
        tt.invert(tt.random([2, 3], 2, [3, 2]))


@given(seed=st.integers(0, 2**32 - 1))
@settings(max_examples=12)
def test_lowest_eigenvalue_is_bounded_from_above(seed: int) -> None:
    X = tt.random([3, 4, 5], 3, [3, 4, 5], np.random.default_rng(seed))
    X = X + X.T
    least = np.linalg.eigvalsh(X.full())[0]
    bound = tt.lowest(X)
    assert bound >= least - 1e-9 * X.norm()
    assert bound < 0 < -least
    assert bound == pytest.approx(least, rel=0.05)


def test_lowest_finds_what_vectors_of_rank_two_do_not_see() -> None:
    """A negative direction of rank 8 among positive ones: an inverse that is a little wrong."""
    v = tt.random((2,) * 8, 8, rng=np.random.default_rng(0)).full().ravel()
    v /= np.linalg.norm(v)
    dense = np.linalg.inv(laplacian_and_one(16, 2))
    X = exact(dense - 1.5 * (v @ dense @ v) * np.outer(v, v), (2,) * 8)
    least = np.linalg.eigvalsh(X.full())[0]
    assert least < 0
    assert tt.lowest(X) == pytest.approx(least, rel=0.1)


def test_residual_of_high_ranks_is_estimated(monkeypatch: pytest.MonkeyPatch) -> None:
    S = exact(positive(np.random.default_rng(4), 64, 3).dense(), (4, 4, 12))
    X = tt.invert(S, 4).train
    measured = tt.residual(S, X)
    monkeypatch.setattr(inverse, "HIGH", 0)
    assert tt.residual(S, X) == pytest.approx(measured, rel=0.5)
