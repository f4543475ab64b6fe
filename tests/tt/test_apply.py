"""Products with full vectors against dense ones, whole and by ranks."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pctt import tt

MODES = st.lists(st.integers(1, 5), min_size=1, max_size=6)


DTYPES = st.sampled_from([np.float32, np.float64])


@given(MODES, st.integers(1, 7), st.integers(0, 2**32 - 1), st.floats(0.3, 1), DTYPES)
def test_product_is_the_dense_one(modes: list[int], rank: int, seed: int, part: float, dtype: type) -> None:
    rng = np.random.default_rng(seed)
    T = tt.random(modes, rank, modes, rng)
    n = max(1, int(part * T.shape[0]))
    x = rng.standard_normal(n)
    T = tt.Train([core.astype(dtype) for core in T.cores])
    apply, dense = tt.Apply(T, n), T.full()[:n, :n]
    tolerance = 1e3 * np.finfo(dtype).eps * np.linalg.norm(dense) * np.linalg.norm(x)
    np.testing.assert_allclose(apply(x), dense @ x, atol=tolerance)
    apply.set_train(2 * T)
    np.testing.assert_allclose(apply(x), 2 * dense @ x, atol=2 * tolerance)


@given(MODES, st.integers(1, 4), st.integers(0, 2**32 - 1))
def test_rows_of_ranks_make_the_product(modes: list[int], ranks: int, seed: int) -> None:
    """Slabs not aligned to modes, some of them empty."""
    rng = np.random.default_rng(seed)
    T = tt.random(modes, 3, modes, rng)
    n = T.shape[0]
    bounds = [0, *np.sort(rng.integers(0, n + 1, ranks - 1)), n]
    x = rng.standard_normal(n)
    parts = [tt.Apply(T, n, (int(start), int(stop)))(x) for start, stop in zip(bounds, bounds[1:])]
    np.testing.assert_allclose(np.concatenate(parts), T.full() @ x, atol=1e-9 * T.norm() * np.linalg.norm(x))


@pytest.mark.parametrize("modes", [(2,) * 12, (16, 4, 4, 16), (64, 64), (1024,), (3, 5, 7, 11)])
def test_merged_modes(modes: tuple[int, ...]) -> None:
    T = tt.random(modes, 4, modes)
    x = np.random.default_rng(0).standard_normal(T.shape[0])
    expected = (T @ tt.decompose(x, 0.0, modes=modes)).full().ravel()
    np.testing.assert_allclose(tt.Apply(T)(x), expected, atol=1e-9 * np.linalg.norm(expected))


def test_nothing_is_allocated_in_the_loop() -> None:
    T = tt.random((32, 4, 4, 48), 8, (32, 4, 4, 48))
    apply = tt.Apply(T)
    apply.x[:] = 1.0
    apply.product()
    tracemalloc.start()
    apply.product()
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 0.2 * apply.x.nbytes
