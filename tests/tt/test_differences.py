"""Fast transforms near matrices of differences, against dense ones."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pctt.tt import differences as of

SHAPES = st.lists(st.integers(1, 6), min_size=1, max_size=3).map(tuple)


def basis(n: int, kind: str) -> np.ndarray:
    """Rows: the orthonormal cosines or sines of the second kind."""
    k, i = np.arange(n)[:, None], np.arange(n) + 0.5
    Q = np.cos(np.pi * k * i / n) if kind == "cosine" else np.sin(np.pi * (k + 1) * i / n)
    return Q / np.linalg.norm(Q, axis=1)[:, None]


def dense(differences: np.ndarray) -> np.ndarray:
    x = np.array(np.unravel_index(np.arange(differences.size), differences.shape))
    return differences[tuple(abs(x[:, :, None] - x[:, None, :]))]


@given(SHAPES, st.sampled_from(of.KINDS), st.integers(0, 9))
def test_eigenvalues_and_inverse_are_those_of_the_nearest_matrix(shape: tuple[int, ...], kind: str, seed: int) -> None:
    rng = np.random.default_rng(seed)
    a = rng.standard_normal(shape)
    a.flat[0] += 10 * np.abs(a).sum()  # diagonally dominant, so positive definite
    A, Q = dense(a), np.ones((1, 1))
    for n in shape:
        Q = np.kron(Q, basis(n, kind))
    values = np.diag(Q @ A @ Q.T)
    np.testing.assert_allclose(of.eigenvalues(a, kind).ravel(), values, rtol=1e-10)
    v = rng.standard_normal(len(A))
    transform = of.FastTransform(a, float(kind == "cosine"))
    assert transform.positive
    np.testing.assert_allclose(transform.solve(v), Q.T @ ((Q @ v) / values), atol=1e-10)
    both = 0.75 * of.FastTransform(a, 1.0).solve(v) + 0.25 * of.FastTransform(a, 0.0).solve(v)
    np.testing.assert_allclose(of.FastTransform(a, 0.75).solve(v), both)
    np.testing.assert_allclose(of.product(a)(v), A @ v, atol=1e-9 * a.flat[0])


def test_the_best_share_is_chosen() -> None:
    i = np.arange(48)
    squares = i[:, None] ** 2 + i**2
    smooth = np.exp(-np.sqrt(squares) / 10)
    smooth[0, 0] += 0.01
    assert of.best(smooth)[0] == 1
    t = 2 - 2 * np.cos(2 * np.pi * np.arange(512) / 512)
    fractional = np.fft.irfft2((t[:, None] + t[:257]) ** 0.7)[:48, :48]
    assert of.best(fractional)[0] == 0


@pytest.mark.parametrize("a", [[1.0, 2.0, 0.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0]])
def test_a_matrix_that_is_not_positive_has_none(a: list[float]) -> None:
    assert of.best(np.array(a)) is None
