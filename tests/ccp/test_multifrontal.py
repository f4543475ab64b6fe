"""Factors by fronts against dense algebra, and the order of nested dissection."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse as sp
from mpi4py import MPI
from scipy.sparse import csgraph
from scipy.spatial import cKDTree

from pctt.body_matrix import Part
from pctt.ccp.newton import multifrontal
from pctt.ccp.newton.multifrontal import MultifrontalFactors, dissected, separated

SELF = MPI.COMM_SELF


def stiff(count: int = 300, hub: bool = False, seed: int = 0) -> tuple[Part, np.ndarray]:
    """K = I + G'HG of bodies at random places with springs between neighbours, of stiffness 1 to 1e4; bodies far from
    all others; with a hub that a third of the bodies touch."""
    rng = np.random.default_rng(seed)
    points = rng.random((count, 3))
    points[-5:] += 10.0 * np.arange(1, 6)[:, None]
    pairs = cKDTree(points).query_pairs(1.2 * count ** (-1 / 3), output_type="ndarray")
    if hub:
        touching = rng.choice(np.arange(1, count), count // 3, replace=False)
        pairs = np.unique(np.concatenate([pairs, np.stack([0 * touching, np.sort(touching)], 1)]), axis=0)
    blocks = np.stack([rng.standard_normal((len(pairs), 3, 6)) for _ in range(2)], axis=1)
    blocks *= 10 ** rng.uniform(0, 2, (len(pairs), 1, 1, 1))
    G = sp.bsr_matrix((blocks.reshape(-1, 3, 6), pairs.ravel(), 2 * np.arange(len(pairs) + 1)))
    G.resize(3 * len(pairs), 6 * count)
    K = (sp.eye(6 * count) + G.T @ G).tobsr((6, 6))
    K.sort_indices()
    return Part(K.indptr, K.indices, K.data), points


def rows_of(part: Part, comm: MPI.Comm) -> tuple[Part, slice]:
    """Those of this rank, and its bodies; the first rank has none where there are three."""
    count, none = len(part.indptr) - 1, int(comm.size > 2)
    begin, end = (count * max(rank - none, 0) // (comm.size - none) for rank in (comm.rank, comm.rank + 1))
    a, b = part.indptr[[begin, end]]
    return Part(part.indptr[begin : end + 1] - a, part.indices[a:b], part.blocks[a:b]), slice(begin, end)


def skewed(part: Part) -> Part:
    """The same with blocks that are not symmetric, of which some are there in one half only."""
    rng, row = np.random.default_rng(3), np.repeat(np.arange(len(part.indptr) - 1), np.diff(part.indptr))
    kept = (row <= part.indices) | (rng.random(len(row)) > 0.1)
    blocks = part.blocks * rng.uniform(0.7, 1.3, part.blocks.shape)
    return Part(np.r_[0, np.cumsum(np.bincount(row[kept]))], part.indices[kept], blocks[kept])


def dense(part: Part) -> np.ndarray:
    return sp.bsr_matrix((part.blocks, part.indices, part.indptr)).toarray()


@pytest.mark.parallel(1, 2, 3, 4)
@pytest.mark.parametrize(("precision", "accuracy"), [(np.float32, 3e-2), (np.float64, 1e-10)])
@pytest.mark.parametrize("hub", [False, True])
@pytest.mark.parametrize("known", [False, True])
@pytest.mark.parametrize("symmetric", [True, False])
def test_the_factors_solve(precision, accuracy, hub, known, symmetric):
    """Also where places are not known, with a body that touches hundreds, with bodies that touch none, and with a rank
    that has no bodies."""
    comm, (part, points) = MPI.COMM_WORLD, stiff(hub=hub)
    if not symmetric:
        part = skewed(part)
    rows, here = rows_of(part, comm)
    factors = MultifrontalFactors(comm, rows, points[here] if known else None, precision, symmetric=symmetric)
    x = np.random.default_rng(1).standard_normal((len(points), 6))
    found = factors.solve((dense(part) @ x.ravel()).reshape(-1, 6)[here].ravel())
    assert np.linalg.norm(found - x[here].ravel()) <= accuracy * np.linalg.norm(x)
    own = comm.allgather(sum(front.below.size for front in factors.own))
    assert len(factors.own) + len(factors.shared) > 10 / comm.size
    assert comm.size == 1 or 0 < max(own) < 0.8 * sum(own)


def test_a_matrix_that_rounding_has_made_indefinite_gets_a_larger_diagonal():
    part, points = stiff()
    blocks = part.blocks.copy()
    row = np.repeat(np.arange(len(points)), np.diff(part.indptr))
    blocks[row == part.indices] *= 1 - 1e-4
    factors = MultifrontalFactors(SELF, part._replace(blocks=blocks), points)
    assert np.isfinite(factors.solve(np.ones(6 * len(points)))).all()


@pytest.mark.parallel(1, 2)
def test_where_one_rank_fails_all_know():
    comm, (part, points) = MPI.COMM_WORLD, stiff()
    rows, here = rows_of(part, comm)
    row = np.repeat(np.arange(here.start, here.stop), np.diff(rows.indptr))
    rows.blocks[(row == rows.indices) & (row == len(points) - 1)] *= -1.0  # of the last rank
    with pytest.raises(np.linalg.LinAlgError):
        MultifrontalFactors(comm, rows, points[here])


def test_nothing_to_factorise():
    empty = Part(np.zeros(1, int), np.zeros(0, int), np.zeros((0, 6, 6)))
    assert MultifrontalFactors(SELF, empty, np.zeros((0, 3))).solve(np.zeros(0)).shape == (0,)
    alone = Part(np.arange(3), np.arange(2), np.tile(2 * np.eye(6), (2, 1, 1)))
    np.testing.assert_allclose(MultifrontalFactors(SELF, alone, np.zeros((2, 3))).solve(np.ones(12)), 0.5, rtol=1e-6)


def test_separators_separate():
    """What is in two halves of a cut touches only through fronts that come later: in a grid the first front touches no
    more than its neighbourhood, and the last front is as large as a cross-section at most."""
    side = 9
    points = np.stack(np.meshgrid(*[np.arange(float(side))] * 3, indexing="ij"), -1).reshape(-1, 3)
    pairs = cKDTree(points).query_pairs(1.1, output_type="ndarray")
    order, first, _ = dissected(points, *pairs.T)
    assert np.array_equal(np.sort(order), np.arange(side**3))
    sizes = np.diff(first)
    assert first[0] == 0
    assert first[-1] == side**3
    assert sizes[-1] <= side**2
    front = np.empty(side**3, int)
    front[order] = np.repeat(np.arange(len(sizes)), sizes)
    leaves = sizes[front[pairs]].max(axis=1) <= multifrontal.LEAF
    assert np.count_nonzero(front[pairs[:, 0]] == front[pairs[:, 1]]) > 0
    assert leaves.any()


def test_a_separator_is_the_smallest_of_the_middle():
    rng = np.random.default_rng(0)
    subsets = ((np.arange(1 << 8)[:, None] >> np.arange(8)) & 1).astype(bool)
    for _ in range(6):
        place = (np.arange(12) + 0.5) / 12
        middle = np.flatnonzero(np.abs(place - 0.5) <= multifrontal.BAND)
        low, high = np.arange(middle[0]), np.arange(middle[-1] + 1, 12)
        pairs = np.sort(rng.integers(0, 12, (20, 2)), axis=1)
        ends = np.isin(pairs[:, 0], low) & np.isin(pairs[:, 1], high)  # no body of the middle keeps these apart
        pairs = np.unique(pairs[(pairs[:, 0] < pairs[:, 1]) & ~ends], axis=0)
        between, upper = separated(place, *pairs.T)
        one, two = pairs.T
        assert not ((upper[one] != upper[two]) & ~between[one] & ~between[two]).any()
        assert not upper[low].any()
        assert upper[high].all()
        least = 12
        for chosen in subsets[:, : len(middle)]:
            kept = np.ones(12, bool)
            kept[middle] = ~chosen
            there = kept[one] & kept[two]
            graph = sp.csr_matrix((np.ones(there.sum()), (one[there], two[there])), shape=(12, 12))
            part = csgraph.connected_components(graph, directed=False)[1]
            if not np.isin(part[low], part[high]).any():
                least = min(least, chosen.sum())
        assert between.sum() == least


def test_a_separator_takes_a_body_of_an_end_where_two_ends_touch():
    place = (np.arange(12) + 0.5) / 12
    between, upper = separated(place, np.array([0, 1, 5]), np.array([11, 2, 6]))
    assert between[0] != between[11]
    assert not ((upper[0] != upper[11]) & ~between[0] & ~between[11])


@pytest.mark.parallel(2, 3)
def test_a_dissection_of_weaker_ties_does_not_join_the_parts_of_two_ranks():
    """Without every third pair the first cuts have smaller separators, which do not part the whole matrix."""
    comm, (part, points) = MPI.COMM_WORLD, stiff()
    row = np.repeat(np.arange(len(points)), np.diff(part.indptr))
    kept = (row == part.indices) | ((row + part.indices) % 3 > 0)
    less = Part(np.r_[0, np.cumsum(np.bincount(row[kept]))], part.indices[kept], part.blocks[kept])
    (few, here), (every, _) = rows_of(less, comm), rows_of(part, comm)
    given = MultifrontalFactors(comm, few, points[here]).dissection
    assert given.fits(row[kept], less.indices)
    assert not given.fits(row, part.indices)
    factors = MultifrontalFactors(comm, every, points[here], np.float64, given)
    assert factors.dissection is not given
    x = np.random.default_rng(1).standard_normal((len(points), 6))
    found = factors.solve((dense(part) @ x.ravel()).reshape(-1, 6)[here].ravel())
    np.testing.assert_allclose(found, x[here].ravel(), atol=1e-8)


@pytest.mark.parametrize("fits", [True, False])
def test_a_dissection_serves_the_next_matrix_too(fits):
    """Unless bodies have neighbours that had none: these have no front."""
    part, points = stiff()
    row = np.repeat(np.arange(len(points)), np.diff(part.indptr))
    near = (row == part.indices) | ((row < 200) & (part.indices < 200) if fits else (row < 100) & (part.indices < 100))
    less = Part(np.r_[0, np.cumsum(np.bincount(row[near]))], part.indices[near], part.blocks[near])
    first, other = (part, less) if fits else (less, part)
    given = MultifrontalFactors(SELF, first, points).dissection
    assert given.fits(np.repeat(np.arange(len(points)), np.diff(other.indptr)), other.indices) == fits
    factors = MultifrontalFactors(SELF, other, points, np.float64, given)
    assert (factors.dissection is given) == fits
    x = np.random.default_rng(1).standard_normal(6 * len(points))
    np.testing.assert_allclose(factors.solve(dense(other) @ x), x, atol=1e-8)
