"""Contractions of a sparse matrix with trains against dense sums."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from matrices import scattered

from pctt import tt
from pctt.tt.sparse import SparseHierarchy

MODES = st.lists(st.integers(1, 4), min_size=1, max_size=4).map(tuple)
SEEDS = st.integers(0, 2**32 - 1)
BLOCKS = st.sampled_from([1, 2, 3])


def left_interfaces(A: SparseHierarchy, cores: list[np.ndarray]) -> list[np.ndarray]:
    x = [np.ones((1, 1))]
    for k, core in enumerate(cores[:-1]):
        x.append(A.down(k, x[k], core))
    return x


def best_cores(A: SparseHierarchy, cores: list[np.ndarray]) -> list[np.ndarray]:
    """The matrix contracted with all cores but one, for each of them."""
    x, d = left_interfaces(A, cores), len(cores)
    out = [A.leaf_core(x[-1])]
    V = A.leaf_up(cores[-1])
    for k in range(d - 2, -1, -1):
        spread = A.spread(k, V)
        out.insert(0, A.middle(k, x[k], spread))
        V = A.up(spread, cores[k])
    return out


def dense_best_cores(dense: np.ndarray, train: tt.Train) -> list[np.ndarray]:
    """The same from the derivative of <A, T> with respect to every entry of a core."""
    out = []
    for k, core in enumerate(train.cores):
        gradient = np.empty(core.size)
        for e in range(core.size):
            unit = np.zeros(core.size)
            unit[e] = 1
            cores = [*train.cores[:k], unit.reshape(core.shape), *train.cores[k + 1 :]]
            gradient[e] = np.vdot(dense, tt.Train(cores).full())
        out.append(gradient.reshape(core.shape[0], -1, core.shape[-1]))
    return out


@given(MODES, BLOCKS, st.integers(0, 40), SEEDS)
def test_inner_product_norm_and_entries(modes: tuple[int, ...], b: int, number: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    triplets = scattered(rng, tt.slots_of(modes), number, b)
    A, dense = triplets.hierarchy(modes), triplets.dense()
    T = tt.random(A.modes, 3, A.modes, rng)
    tolerance = 1e3 * np.finfo(float).eps * (1 + np.linalg.norm(dense))
    assert A.size == len(dense)
    assert A.norm() == pytest.approx(np.linalg.norm(dense), abs=tolerance)
    assert A.inner(T.flat()) == pytest.approx(np.vdot(dense, T.full()), abs=tolerance * T.norm())
    i, j = np.indices(dense.shape)
    keys = np.zeros(i.shape, np.int64)
    digits = zip(A.modes, np.unravel_index(i, A.modes), np.unravel_index(j, A.modes))
    for m, row, column in digits:
        keys = keys * m * m + row * m + column
    np.testing.assert_allclose(A.lookup(keys), dense, atol=tolerance)


@given(st.lists(st.integers(1, 3), min_size=2, max_size=3).map(tuple), BLOCKS, st.integers(0, 30), SEEDS)
def test_contractions(modes: tuple[int, ...], b: int, number: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    triplets = scattered(rng, tt.slots_of(modes), number, b)
    A = triplets.hierarchy(modes)
    T = tt.random(A.modes, 2, A.modes, rng)
    for core, expected in zip(best_cores(A, T.flat()), dense_best_cores(triplets.dense(), T)):
        np.testing.assert_allclose(core, expected, atol=1e-10)


@pytest.mark.parallel(2, 3)
@pytest.mark.parametrize("b", [1, 2, 3])
def test_contractions_of_split_rows_add_up(b: int) -> None:
    """Rows dealt to several ranks, some of which may have none: every rank has the same small cores."""
    for seed in range(12):
        rng = np.random.default_rng(seed)
        triplets = scattered(rng, 24, 5 * seed, b)
        T = tt.random((2, 3, 4 * b), 3, (2, 3, 4 * b), rng)
        whole, part = triplets.hierarchy((2, 3, 4)), triplets.part((2, 3, 4), np.sort(rng.integers(0, 25, 2)))
        found = []
        for A in (whole, part):
            sample = A.sample(20, np.random.default_rng(1))
            found.append([*best_cores(A, T.flat()), A.norm(), A.inner(T.flat()), sample, A.lookup(sample)])
        for value, one in zip(*found):
            np.testing.assert_allclose(value, one, atol=1e-9)


@given(SEEDS)
def test_new_values_on_an_old_pattern(seed: int) -> None:
    rng = np.random.default_rng(seed)
    first = scattered(rng, 30, 50, 3)
    A = first.hierarchy((5, 6))
    second = first._replace(blocks=rng.standard_normal(first.blocks.shape))
    A.set_values(second.blocks)
    assert A.norm() == pytest.approx(np.linalg.norm(second.dense()))
    sample = A.sample(40, rng)
    assert len(sample)
    assert np.all(A.lookup(sample) != 0)


def test_too_many_slots() -> None:
    with pytest.raises(ValueError, match="64 bits"):
        SparseHierarchy(np.zeros(1, int), np.zeros(1, int), [2] * 32)
