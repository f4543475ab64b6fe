"""Trains against dense linear algebra."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pctt import tt
from pctt.tt.train import Train, full_ranks

MODES = st.lists(st.integers(1, 5), min_size=1, max_size=5)
SEEDS = st.integers(0, 2**32 - 1)


@st.composite
def pairs_of_trains(draw: st.DrawFn, matrix: bool) -> tuple[Train, Train]:
    """Two trains of the same odd modes, of ranks from 1 to more than the modes allow."""
    rows = draw(MODES)
    columns = draw(st.lists(st.integers(1, 4), min_size=len(rows), max_size=len(rows))) if matrix else None
    rng = np.random.default_rng(draw(SEEDS))
    ranks = draw(st.tuples(st.integers(1, 9), st.integers(1, 4)))
    first, second = (tt.random(rows, rank, columns, rng) for rank in ranks)
    return first, second


TOLERANCE = 1e3 * float(np.finfo(float).eps)


def assert_close(train: Train, dense: np.ndarray, scale: float | None = None) -> None:
    scale = max(float(np.linalg.norm(dense)), 1e-30) if scale is None else scale
    assert train.shape == dense.shape
    assert np.linalg.norm(train.full() - dense) <= TOLERANCE * scale


@given(st.one_of(pairs_of_trains(False), pairs_of_trains(True)), SEEDS)
def test_arithmetic(pair: tuple[Train, Train], seed: int) -> None:
    a, b = pair
    A, B = a.full(), b.full()
    scale = float(np.linalg.norm(A) + np.linalg.norm(B))
    assert_close(a + b, A + B, scale)
    assert_close(a - b, A - B, scale)
    assert_close(2.5 * a, 2.5 * A)
    assert_close(-a, -A)
    assert abs(a.inner(b) - np.vdot(A, B)) <= TOLERANCE * np.linalg.norm(A) * np.linalg.norm(B)
    assert a.norm() == pytest.approx(np.linalg.norm(A), rel=TOLERANCE)
    assert (a - a).norm() <= TOLERANCE * np.linalg.norm(A)
    if not a.is_matrix:
        found = a.entries(np.arange(A.size).reshape(A.shape))
    else:
        found = a.entries(*np.indices(A.shape))
        assert_close(a.T, A.T)
        assert_close(a.T @ b, A.T @ B, float(np.linalg.norm(A) * np.linalg.norm(B)))
        x = tt.random(a.columns, 3, rng=np.random.default_rng(seed))
        tolerance = TOLERANCE * np.linalg.norm(A) * x.norm()
        np.testing.assert_allclose((a @ x).full().ravel(), A @ x.full().ravel(), rtol=0, atol=tolerance)
    np.testing.assert_allclose(found, A, rtol=0, atol=TOLERANCE * abs(A).max())


@given(pairs_of_trains(matrix=True), st.sampled_from([0.5, 0.1, 1e-2, 1e-4]), st.one_of(st.none(), st.integers(1, 4)))
def test_rounding_keeps_its_bound_and_the_ranks(pair: tuple[Train, Train], eps: float, cap: int | None) -> None:
    a = pair[0] + 0.01 * pair[1]
    rounded, A = a.round(eps, cap), a.full()
    if cap is None:
        assert np.linalg.norm(rounded.full() - A) <= (eps + TOLERANCE) * np.linalg.norm(A)
    else:
        assert max(rounded.ranks) <= cap
    assert all(r <= s for r, s in zip(rounded.ranks, a.ranks))
    limits = full_ranks([m * n for m, n in a.modes])
    assert all(r <= s for r, s in zip(a.round().ranks[1:-1], limits))
    assert_close(a.round(0.0), A)


@given(pairs_of_trains(matrix=False))
def test_orthogonal_interfaces(pair: tuple[Train, Train]) -> None:
    a = pair[0]
    left, right = a.left_orthogonal(), a.right_orthogonal()
    assert_close(left, a.full())
    assert_close(right, a.full())
    for core in left.flat()[:-1]:
        Q = core.reshape(-1, core.shape[2])
        np.testing.assert_allclose(Q.T @ Q, np.eye(core.shape[2]), atol=TOLERANCE)
    for core in right.flat()[1:]:
        Q = core.reshape(len(core), -1)
        np.testing.assert_allclose(Q @ Q.T, np.eye(len(core)), atol=TOLERANCE)


@given(MODES, SEEDS, st.sampled_from([1e-1, 1e-3, 0.0]))
def test_decomposition_of_any_tensor_keeps_its_bound(modes: list[int], seed: int, eps: float) -> None:
    dense = np.random.default_rng(seed).standard_normal(modes)
    train = tt.decompose(dense, eps)
    assert train.rows == tuple(modes)
    assert np.linalg.norm(train.full() - dense) <= (eps + TOLERANCE) * np.linalg.norm(dense)
    assert all(r <= limit for r, limit in zip(train.ranks[1:-1], full_ranks(modes)))


@given(pairs_of_trains(matrix=True))
def test_decomposition_finds_the_ranks_of_a_train(pair: tuple[Train, Train]) -> None:
    a = pair[0]
    found = tt.decompose_matrix(a.full(), a.rows, a.columns, eps=1e-9)
    assert_close(found, a.full(), float(np.linalg.norm(a.full()) * 1e5))
    assert all(r <= s for r, s in zip(found.ranks, a.ranks))


def test_quantised_functions() -> None:
    """Known ranks of quantised vectors: exponential 1, sine 2, polynomial of degree p p + 1 (Khoromskij 2011)."""
    x = np.linspace(0, 1, 2**10)
    for values, rank in ((np.exp(3 * x), 1), (np.sin(40 * x), 2), (x**3 - x, 4)):
        assert max(tt.decompose(values, 1e-10, modes=[2] * 10).ranks) == rank


@pytest.mark.parametrize(
    "mistake",
    [
        lambda: Train([np.zeros((1, 2, 2)), np.zeros((3, 2, 1))]),
        lambda: Train([np.zeros((1, 2, 2)), np.zeros((2, 2, 2, 1))]),
        lambda: tt.identity([2, 3]) + tt.identity([3, 2]),
        lambda: tt.identity([2, 3]) @ tt.zeros([3, 2]),
        lambda: tt.zeros([3, 2]).T,
        lambda: tt.identity([3, 2]).entries([0]),
    ],
)
def test_mistakes_are_told(mistake: object) -> None:
    with pytest.raises(ValueError, match="train|modes|matrix|ranks|rows"):
        mistake()  # type: ignore[operator]
