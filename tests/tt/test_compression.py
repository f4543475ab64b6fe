"""Compression of sparse matrices: exact where the rank is known, with the error that it reports."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import scipy.sparse as sp
from hypothesis import given, settings
from hypothesis import strategies as st
from matrices import laplacian, of_sparse, positive, scattered
from mpi4py import MPI

from pctt import tt

BOTH = pytest.mark.parametrize("compress", [tt.compress, tt.compress_cross])


def kronecker_sum(*terms: sp.spmatrix) -> sp.spmatrix:
    out = terms[0]
    for term in terms[1:]:
        out = sp.kronsum(term, out)
    return out


KNOWN = {  # matrix, modes, greatest rank (Kazeev & Khoromskij 2012: binary Laplacians have 3 in one dimension)
    "laplacian, binary": (laplacian(256), (2,) * 8, 3),
    "laplacian, mixed": (laplacian(4096), tt.choose_modes(4096), 3),
    "laplacian, large": (laplacian(2**16), tt.choose_modes(2**16), 3),
    "laplacian, padded": (laplacian(5000), tt.choose_modes(5000), 5),
    "shift": (sp.diags([np.ones(255)], [1], shape=(256, 256)), (4, 4, 4, 4), 2),
    "banded Toeplitz": (sp.diags([1.0, -4, 6, -4, 1], [-2, -1, 0, 1, 2], shape=(512, 512)), (8, 8, 8), 3),
    "laplacian, two dimensions": (kronecker_sum(laplacian(32), laplacian(32)), (2,) * 10, 4),
    "laplacian, three dimensions": (kronecker_sum(*[laplacian(16)] * 3), (16, 16, 16), 2),
}


@BOTH
@pytest.mark.parametrize("name", KNOWN)
def test_known_ranks(name: str, compress: Callable[..., Any]) -> None:
    matrix, modes, rank = KNOWN[name]
    triplets = of_sparse(matrix)
    found = compress(triplets.hierarchy(modes), max_rank=8, eps=1e-10)
    assert found.error < 1e-6
    assert max(found.train.ranks) <= rank
    n = triplets.slots
    if n <= 1024:
        np.testing.assert_allclose(found.train.full()[:n, :n], matrix.toarray(), atol=1e-8)


@BOTH
@given(seed=st.integers(0, 2**32 - 1), b=st.sampled_from([1, 3]), cap=st.integers(1, 12), number=st.integers(0, 60))
def test_reported_error_is_the_error(compress: Callable[..., Any], seed: int, b: int, cap: int, number: int) -> None:
    triplets = scattered(np.random.default_rng(seed), 40, number, b)
    A, dense = triplets.hierarchy((3, 4, 5)), triplets.dense(60)
    found = compress(A, cap, eps=1e-3)
    error = np.linalg.norm(found.train.full() - dense) / max(np.linalg.norm(dense), 1e-300)
    assert max(found.train.ranks) <= cap
    assert found.error == pytest.approx(error, rel=1e-4, abs=6e-7)
    if compress is tt.compress:
        assert error <= 1 + 1e-12  # a projection


@given(seed=st.integers(0, 2**32 - 1), eps=st.sampled_from([0.3, 1e-2, 1e-6]))
@settings(max_examples=15)
def test_tolerance_is_met_where_the_rank_allows(seed: int, eps: float) -> None:
    triplets = scattered(np.random.default_rng(seed), 40, 150, 2)
    found = tt.compress(triplets.hierarchy((4, 10)), 100, eps)
    assert np.linalg.norm(found.train.full() - triplets.dense()) <= eps * np.linalg.norm(triplets.dense()) * 1.001
    optimal = tt.decompose_matrix(triplets.dense(), found.train.rows, eps=eps)
    assert max(found.train.ranks) <= 1.3 * max(optimal.ranks) + 2


def test_warm_start_is_no_worse() -> None:
    triplets = scattered(np.random.default_rng(0), 300, 2000, 3)
    A = triplets.hierarchy(tt.choose_modes(300, leaf=8))
    first = tt.compress(A, 6, 1e-2)
    again = tt.compress(A, 6, 1e-2, start=first.train)
    assert again.error <= first.error * (1 + 1e-12)
    wider = tt.compress(A, 9, 1e-2, start=first.train)
    assert wider.error < first.error
    crossed = tt.compress_cross(A, 6, 1e-2)
    warm = tt.compress_cross(A, 6, 1e-2, start=crossed, sweeps=1)
    assert warm.error <= 1.1 * crossed.error


def test_cross_is_sublinear_and_survives_nearly_empty_matrices() -> None:
    looked = []
    for n in (2**12, 2**18):
        found = tt.compress_cross(of_sparse(laplacian(n)).hierarchy(tt.choose_modes(n)), 8, 1e-10)
        assert found.error < 1e-6
        looked.append(found.evaluations)
    assert looked[1] < 4 * looked[0]
    single = of_sparse(sp.csr_matrix(([2.0], ([1234], [77])), shape=(4096, 4096)))
    found = tt.compress_cross(single.hierarchy(tt.choose_modes(4096)), 5, 1e-10)
    assert found.error < 1e-6
    assert found.train.entries([1234], [77])[0] == pytest.approx(2.0)
    nothing = scattered(np.random.default_rng(0), 100, 0, 3).hierarchy((10, 10))
    for compress in (tt.compress, tt.compress_cross):
        found = compress(nothing)
        assert found.error == 0
        assert found.train.norm() == 0


@pytest.mark.parallel(2, 3)
@BOTH
def test_split_rows_give_the_same_train(compress: Callable[..., Any]) -> None:
    triplets, comm = positive(np.random.default_rng(1), 100, 2), MPI.COMM_WORLD
    modes = tt.choose_modes(100, leaf=6)
    alone = compress(triplets.hierarchy(modes), 6, 1e-2)
    found = compress(triplets.part(modes, [37, 80]), 6, 1e-2)
    assert found.train.ranks == alone.train.ranks
    assert (found.train - alone.train).norm() < 1e-8 * alone.train.norm()
    assert found.error == pytest.approx(alone.error, rel=1e-6)
    assert len(set(comm.allgather(found.error))) == 1
