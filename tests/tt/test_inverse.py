"""Inverses against dense ones."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from matrices import laplacian, positive

from pctt import tt
from pctt.tt import inverse


def exact(dense: np.ndarray, modes: tuple[int, ...]) -> tt.Train:
    return tt.decompose_matrix(dense, modes, eps=1e-13)


@given(seed=st.integers(0, 2**32 - 1), b=st.sampled_from([1, 3]), modes=st.sampled_from([(3, 4), (2, 2, 3), (12,)]))
@settings(max_examples=20)
def test_full_rank_inverse_is_exact(seed: int, b: int, modes: tuple[int, ...]) -> None:
    dense = positive(np.random.default_rng(seed), 12, b).dense()
    S = exact(dense, tt.scalar_modes(modes, b))
    found = tt.invert(S, 10**6, sweeps=6)
    assert found.residual < 1e-8
    assert found.repaired == 0
    np.testing.assert_allclose(found.train.full(), np.linalg.inv(dense), atol=1e-7)
    assert found.energy[-1] == pytest.approx(-np.trace(np.linalg.inv(dense)) / (2 * len(dense)))


@given(seed=st.integers(0, 2**32 - 1), rank=st.integers(1, 12))
@settings(max_examples=20)
def test_residual_symmetry_and_energy(seed: int, rank: int) -> None:
    dense = positive(np.random.default_rng(seed), 36, 2).dense()
    S = exact(dense, (3, 4, 6))
    for found in (tt.invert(S, rank), tt.invert_near_identity(S - tt.identity(S.rows), rank)):
        X = found.train.full()
        error = np.linalg.norm(np.eye(len(X)) - dense @ X) / len(X) ** 0.5
        assert max(found.train.ranks) <= rank
        assert found.residual == pytest.approx(error, rel=1e-6, abs=1e-10)
        assert error < 0.3  # that of the identity at most
        np.testing.assert_allclose(X, X.T, atol=1e-10)
        assert all(later <= earlier + 1e-12 for earlier, later in zip(found.energy, found.energy[1:]))
        assert np.linalg.eigvalsh(X)[0] > 0


def test_laplacian_like_inverse_has_low_rank() -> None:
    """The inverse of a tridiagonal matrix is semiseparable: its trains have rank at most 5."""
    for shift in (1.0, 1e-2):
        S = exact(laplacian(256).toarray() + shift * np.eye(256), (4, 4, 4, 4))
        found = tt.invert(S, 6, sweeps=20, eps=1e-14)
        assert found.residual < 1e-3
        assert max(found.train.ranks) <= 6


def test_warm_start_of_a_near_matrix() -> None:
    rng = np.random.default_rng(0)
    dense = positive(rng, 64, 3).dense()
    S = exact(dense, (4, 4, 12))
    first = tt.invert(S, 8, sweeps=4)
    near = exact(dense + np.diag(0.02 * rng.random(len(dense))), S.rows)
    cold, warm = tt.invert(near, 8, sweeps=1), tt.invert(near, 8, start=first.train)
    assert warm.energy[-1] <= cold.energy[-1]
    assert warm.residual <= 1.05 * cold.residual
    wider = tt.invert(S, 12, start=first.train)
    assert wider.residual < first.residual


def test_rank_one_near_identity_is_the_identity() -> None:
    T = tt.random([3, 4], 2, [3, 4])
    found = tt.invert_near_identity(T, 1)
    np.testing.assert_array_equal(found.train.full(), np.eye(12))
    assert found.correction is not None
    assert found.correction.norm() == 0


def test_inverse_of_single_precision() -> None:
    dense = positive(np.random.default_rng(0), 24, 2).dense()
    found = tt.invert(exact(dense, (4, 12)).astype(np.float32), 144, sweeps=4)
    assert found.train.dtype == np.float32
    np.testing.assert_allclose(found.train.full(), np.linalg.inv(dense), atol=1e-3)


def test_indefinite_matrices_are_reported() -> None:
    dense = np.diag(np.r_[np.ones(60), -np.ones(4)])
    found = tt.invert(exact(dense, (4, 4, 4)), 4)
    assert found.repaired > 0
    assert np.isfinite(found.train.full()).all()
    with pytest.raises(ValueError, match="square"):
        tt.invert(tt.random([2, 3], 2, [3, 2]))


@given(seed=st.integers(0, 2**32 - 1), rank=st.integers(1, 4))
@settings(max_examples=20)
def test_lowest_eigenvalue_is_bounded_from_above(seed: int, rank: int) -> None:
    X = tt.random([3, 4, 5], 3, [3, 4, 5], np.random.default_rng(seed))
    X = X + X.T
    least = np.linalg.eigvalsh(X.full())[0]
    bound = tt.lowest(X, rank, sweeps=4)
    assert bound >= least - 1e-9 * X.norm()
    assert bound < 0 < -least
    assert tt.lowest(X, 15, sweeps=4) == pytest.approx(least, rel=0.05)


@pytest.mark.parametrize("rank", [2, 6, 40])
def test_inverse_root_is_positive_and_good(rank: int) -> None:
    for dense, modes in (
        (positive(np.random.default_rng(0), 36, 2).dense(), (3, 4, 6)),
        (laplacian(64).toarray() + 0.1 * np.eye(64), (4, 4, 4)),
    ):
        Z, error = tt.inverse_root(exact(dense, modes), rank)
        M = Z.full() @ Z.full().T
        assert max(Z.ranks) <= rank
        assert np.linalg.eigvalsh(M)[0] > 0
        w = np.linalg.eigvals(dense @ M).real
        condition = np.linalg.cond(dense)
        assert w.max() / w.min() < (condition if rank == 2 else 0.5 * condition**0.5 + 1)
        if rank == 40:
            assert error < 1e-3
            assert np.linalg.norm(np.eye(len(M)) - dense @ M) < 1e-2 * len(M) ** 0.5


def test_iterating_on_local_systems_is_as_good_as_factorising_them(monkeypatch: pytest.MonkeyPatch) -> None:
    S = exact(positive(np.random.default_rng(3), 64, 3).dense(), (4, 4, 12))
    direct = tt.invert(S, 12, sweeps=4)
    monkeypatch.setattr(inverse, "_large", lambda *sizes: True)
    iterated = tt.invert(S, 12, sweeps=4)
    assert iterated.repaired == 0
    assert iterated.residual <= 1.05 * direct.residual
    assert iterated.energy[-1] == pytest.approx(direct.energy[-1], rel=1e-3)


def test_iterating_tells_of_a_matrix_that_is_not_positive(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(inverse, "_large", lambda *sizes: True)
    dense = positive(np.random.default_rng(3), 16, 1).dense() - 1.2 * np.eye(16)
    assert tt.invert(exact(dense, (4, 4)), 8).repaired > 0


def test_residual_of_high_ranks_is_estimated(monkeypatch: pytest.MonkeyPatch) -> None:
    S = exact(positive(np.random.default_rng(4), 64, 3).dense(), (4, 4, 12))
    X = tt.invert(S, 4).train
    measured = tt.residual(S, X)
    monkeypatch.setattr(inverse, "HIGH", 0)
    assert tt.residual(S, X) == pytest.approx(measured, rel=0.1)
