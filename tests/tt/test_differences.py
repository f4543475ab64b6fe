"""Fast transforms near matrices of differences, against dense ones."""

from __future__ import annotations

from math import inf

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pctt.tt import differences as of
from pctt.tt.conjugate import ConjugateGradients, iterations, race

SHAPES = st.lists(st.integers(1, 6), min_size=1, max_size=3).map(tuple).filter(lambda shape: np.prod(shape) <= 36)


def basis(n: int, kind: str) -> np.ndarray:
    """Rows: the orthonormal cosines or sines of the second kind."""
    k, i = np.arange(n)[:, None], np.arange(n) + 0.5
    Q = np.cos(np.pi * k * i / n) if kind == "cosine" else np.sin(np.pi * (k + 1) * i / n)
    return Q / np.linalg.norm(Q, axis=1)[:, None]


def dense(a: of.Differences) -> np.ndarray:
    x = np.array(np.unravel_index(np.arange(np.prod(a.shape)), a.shape))
    apart = x[:, :, None] - x[:, None, :]
    values = a.values[tuple(abs(apart) if a.even else apart)]
    return values.transpose(0, 2, 1, 3).reshape(2 * [values.shape[0] * a.block])


def some(shape: tuple[int, ...], block: int, even: bool, seed: int) -> of.Differences:
    """Random, symmetric, and diagonally dominant, so positive definite."""
    rng = np.random.default_rng(seed)
    a = of.Differences(shape, rng.standard_normal((*(shape if even else [2 * n - 1 for n in shape]), block, block)))
    values = 0.5 * (a.values + a.transposed.values)
    values[(0,) * len(shape)] += 4 ** len(shape) * np.abs(values).sum() * np.eye(block)
    return of.Differences(shape, values)


@given(SHAPES, st.sampled_from(["cosine", "sine"]), st.integers(1, 3), st.booleans(), st.integers(0, 9))
def test_eigenvalues_and_inverse_are_those_of_the_nearest_matrix(
    shape: tuple[int, ...], kind: str, block: int, even: bool, seed: int
) -> None:
    a = some(shape, block, even, seed)
    A, Q = dense(a), np.ones((1, 1))
    for n in shape:
        Q = np.kron(Q, basis(n, kind))
    Q = np.kron(Q, np.eye(block))
    nearest = Q @ A @ Q.T * np.kron(np.eye(len(A) // block), np.ones((block, block)))
    k = np.arange(len(A) // block)
    blocks = nearest.reshape(len(k), block, len(k), block)[k, :, k]
    np.testing.assert_allclose(of.eigenvalues(a, kind)[0].reshape(blocks.shape), blocks, atol=1e-10 * A[0, 0])
    v = np.random.default_rng(seed).standard_normal((2, len(A)))
    inverse = of.FastInverse(a, ((kind, 1.0),))
    assert inverse.positive
    np.testing.assert_allclose(inverse.solve(v), v @ Q.T @ np.linalg.inv(nearest) @ Q, atol=1e-9 / A[0, 0])
    both = 0.75 * of.FastInverse(a, (("cosine", 1.0),)).solve(v) + 0.25 * of.FastInverse(a, (("sine", 1.0),)).solve(v)
    np.testing.assert_allclose(of.FastInverse(a, (("cosine", 0.75), ("sine", 0.25))).solve(v), both)
    np.testing.assert_allclose(a.times(v), v @ A.T, atol=1e-9 * A[0, 0])


@given(SHAPES, st.integers(1, 3), st.booleans(), st.integers(0, 9))
def test_circulants_are_the_nearest_and_a_part_of_a_wider_inverse(
    shape: tuple[int, ...], block: int, even: bool, seed: int
) -> None:
    a = some(shape, block, even, seed)
    A, v = dense(a), np.random.default_rng(seed).standard_normal((2, np.prod(shape) * block))
    x = np.array(np.unravel_index(np.arange(np.prod(shape)), shape))
    apart = np.ravel_multi_index((x[:, :, None] - x[:, None, :]) % np.array(shape)[:, None, None], shape)
    blocks = A.reshape(len(apart), block, len(apart), block).transpose(0, 2, 1, 3).copy()
    for s in range(len(apart)):  # the mean over all pairs whose difference is the same up to the period
        blocks[apart == s] = blocks[apart == s].mean(axis=0)
    C = blocks.transpose(0, 2, 1, 3).reshape(A.shape)
    np.testing.assert_allclose(of.FastInverse(a, of.CIRCULANT).solve(v), v @ np.linalg.inv(C), atol=1e-9 / A[0, 0])
    wide = of.Differences(shape, a.wide())
    m = wide.values.shape[:-2]
    padded = np.zeros((2, *m, block))
    padded[(..., *map(slice, shape), slice(None))] = v.reshape(2, *shape, block)
    y = np.array(np.unravel_index(np.arange(np.prod(m)), m))
    W = wide.values[tuple((y[:, :, None] - y[:, None, :]) % np.array(m)[:, None, None])]
    W = W.transpose(0, 2, 1, 3).reshape(2 * [len(y[0]) * block])
    values, vectors = np.linalg.eigh(W)
    values = np.maximum(values, np.linalg.eigvalsh(C)[0])  # it need not be positive
    left = (padded.reshape(2, -1) @ (vectors / values) @ vectors.T).reshape(padded.shape)
    left = left[(..., *map(slice, shape), slice(None))]
    found = of.FastInverse(a, (("embedding", 1.0),)).solve(v)
    np.testing.assert_allclose(found, left.reshape(v.shape), atol=1e-9 / A[0, 0])


def offsets(*shape: int) -> np.ndarray:
    """All differences of a grid (D, 2 n_1 - 1, ...)."""
    return np.array(np.meshgrid(*[np.concatenate([np.arange(n), np.arange(1 - n, 0)]) for n in shape], indexing="ij"))


def kernel(values: np.ndarray, nugget: float) -> of.Differences:
    shape = tuple((m + 1) // 2 for m in values.shape)
    values = values.copy()
    values[(0,) * len(shape)] += nugget
    return of.Differences(shape, values[..., None, None]).compact()


def count(a: of.Differences, kind: of.Kind) -> int:
    """Iterations to 1e-8."""
    inverse, b = of.FastInverse(a, kind), np.random.default_rng(1).standard_normal(np.prod(a.shape) * a.block)
    run = ConjugateGradients(a.times, b, inverse.solve)
    while run.norms[-1] > 1e-8 * run.norms[0] and len(run.norms) < 1000:
        run.step()
    return len(run.norms) - 1


x, y = offsets(96, 80)
turned = np.hypot((0.8 * x + 0.6 * y) / 9, (0.8 * y - 0.6 * x) / 2)
KERNELS = {
    "exponential": np.exp(-np.hypot(x, y) / 10), "turned": np.exp(-turned), "turned Gauss": np.exp(-(turned**2)),
    "waves": np.cos(0.5 * x) * np.cos(0.5 * y), "season": np.exp(-abs(x) / 8 - 2 * np.sin(np.pi * y / 8) ** 2),
    "periodic": np.exp(-np.minimum(abs(x), 96 - abs(x)) / 5 - np.minimum(abs(y), 80 - abs(y)) / 9),
    "moving": np.exp(-np.hypot((x - 0.8 * y) / 6, y / 12)),
}  # fmt: skip


@pytest.mark.parametrize("name", KERNELS)
def test_the_choice_and_its_trials_cost_no_more_than_nothing_and_a_circulant(name) -> None:
    """Where each product with A and each application of a preconditioner counts as one."""
    a = kernel(KERNELS[name], 0.02)
    found = of.choose(a)
    chosen, alone, circulant = (count(a, kind) for kind in (found.kind, of.NOTHING, of.CIRCULANT))
    assert chosen <= 1.3 * min(alone, circulant)
    assert found.cost_estimate.spent + chosen * (2 if found.kind else 1) <= 1.3 * min(alone, 2 * circulant) + 1
    if name == "exponential":
        assert chosen <= 0.4 * circulant


@given(SHAPES, st.integers(1, 2), st.booleans(), st.integers(0, 9))
def test_means_over_cells_are_those_of_the_matrix(shape, block, even, seed) -> None:
    a = some(shape, block, even, seed)
    widths = [1 + seed % n for n in shape]
    counts = [n // width for n, width in zip(shape, widths)]
    P = np.ones((1, 1))
    for n, number, width in zip(shape, counts, widths):
        P = np.kron(P, np.kron(np.eye(number), np.ones(width) / width**0.5) @ np.eye(number * width, n))
    P = np.kron(P, np.eye(block))
    np.testing.assert_allclose(dense(a.means_of(counts, widths)), P @ dense(a) @ P.T, atol=1e-10 * dense(a)[0, 0])


@pytest.mark.parametrize("strength", [1000.0, 2500.0])
def test_parts_of_an_equation_of_the_second_kind_do_not_show_all_of_it(strength) -> None:
    """Of I + h^3 K: a part of few points is near I, and conjugate gradients alone would seem good enough."""
    n = 30
    r = np.sqrt((offsets(n, n, n) ** 2).sum(axis=0)) / n
    near = np.where(r > 0, 1 / np.maximum(r, 1 / n), 2.38 * n)
    a = kernel(strength / (4 * np.pi) / n**3 * np.exp(-10 * r) * near, 1.0)
    kind = of.choose(a).kind
    assert count(a, kind) <= 1.3 * min(count(a, of.NOTHING), count(a, of.CIRCULANT))


def test_the_best_share_is_chosen() -> None:
    t = 2 - 2 * np.cos(2 * np.pi * np.arange(512) / 512)
    fractional = np.fft.irfft2((t[:, None] + t[:257]) ** 0.7)[:160, :160]
    a = of.Differences.of_even(fractional)
    kinds = of.COSINE, of.SINE, of.CIRCULANT, *of.MEANS, of.EMBEDDING
    assert count(a, of.choose(a).kind) <= 1.25 * min(count(a, kind) for kind in kinds)


@pytest.mark.parametrize(("n", "power"), [(44, 0.65), (48, 0.65), (52, 0.65), (57, 0.8)])
def test_a_small_laplacian_has_a_sine_transform(n: int, power: float) -> None:
    t = 2 - 2 * np.cos(2 * np.pi * np.arange(512) / 512)
    a = of.Differences.of_even(np.fft.irfft2((t[:, None] + t[:257]) ** power)[:n, :n])
    assert count(a, of.choose(a).kind) <= 0.6 * count(a, of.CIRCULANT)


def test_parts_show_a_function_of_one_coordinate() -> None:
    """The others are not periodic axes that have to stay whole: parts would be half of the points, or lines."""
    season = np.exp(-2 * np.sin(np.pi * np.arange(13) / 7.3) ** 2)
    values = np.broadcast_to(season[:, None, None], (13, 16, 18)).copy()
    values[0, 0, 0] += 0.3
    a = of.Differences.of_even(values)
    for part in of.parts(a):
        assert min(part.shape) > 2
        assert np.prod(part.shape) <= 0.1 * values.size
    found = of.choose(a).kind
    assert count(a, found) <= 1.5 * min(count(a, of.NOTHING), count(a, of.CIRCULANT))  # 18 and 24: rounding decides


SEASONS = {  # shape, period along the last axis, and correlation lengths along both
    "nearly of the grid": ((24, 122), 30.4, (8, inf)), "not of the grid": ((24, 130), 29.53, (8, inf)),
    "damped": ((24, 122), 30.4, (8, 90)), "longer than the grid": ((30, 90), 95.0, (5, inf)),
    "short": ((40, 140), 7.02, (8, inf)),
}  # fmt: skip


@pytest.mark.parametrize("name", SEASONS)
def test_lines_show_a_period(name) -> None:
    """Which neither a few neighbouring points do nor means over cells."""
    shape, period, lengths = SEASONS[name]
    x, t = offsets(*shape)
    season = np.exp(-2 * np.sin(np.pi * t / period) ** 2)
    a = kernel(np.exp(-abs(x) / lengths[0] - abs(t) / lengths[1]) * season, 0.05)
    assert count(a, of.choose(a).kind) <= 1.3 * min(count(a, of.NOTHING), count(a, of.CIRCULANT))


def test_distances_are_those_of_the_nearest_matrices() -> None:
    rng = np.random.default_rng(5)
    a = of.Differences((4, 5), rng.standard_normal((7, 9, 2, 2)))
    A = dense(a)
    for transform in ("cosine", "sine"):
        Q = np.kron(np.kron(basis(4, transform), basis(5, transform)), np.eye(2))
        blocks = (Q @ A @ Q.T).reshape(20, 2, 20, 2)
        blocks[range(20), :, range(20)] = 0.0
        assert a.distance(transform) == pytest.approx(np.linalg.norm(blocks) / np.linalg.norm(A))
    near = np.take(np.take(a.circulant(), np.r_[:4, -3:0], 0), np.r_[:5, -4:0], 1)
    apart = np.linalg.norm(A - dense(of.Differences((4, 5), near)))
    assert a.distance("circulant") == pytest.approx(apart / np.linalg.norm(A))


def test_eigenvalues_foresee_what_none_takes() -> None:
    for a in (kernel(KERNELS["exponential"], 0.02), kernel(KERNELS["periodic"], 0.02)):
        assert of.foreseen(a) == pytest.approx(count(a, of.NOTHING), rel=0.15)
    a = kernel(np.exp(-((offsets(1200)[0] / 12) ** 2)), 1e-3)
    assert max(count(part, of.NOTHING) for part in of.parts(a)) <= 30  # few eigenvalues of a part are large
    assert count(a, of.choose(a).kind) <= 0.2 * count(a, of.NOTHING)


def test_determinants_are_those_of_the_nearest_matrices() -> None:
    for shape, block in (((4, 5), 2), ((5, 4), 1), ((3, 1), 2)):
        a = some(shape, block, False, 5)
        size = np.prod(shape) * block
        for transform in ("cosine", "sine", "circulant"):
            inverse = of.FastInverse(a, ((transform, 1.0),)).solve(np.eye(size))
            found = of.log_determinant(a, transform)
            assert found == pytest.approx(-np.linalg.slogdet(inverse)[1] / size)


@pytest.mark.parametrize("a", [[1.0, 2.0, 0.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0]])
def test_a_matrix_that_is_not_positive_has_none(a: list[float]) -> None:
    assert of.choose(of.Differences.of_even(np.array(a))) is None


def test_a_race_is_won_by_the_cheapest_and_never_by_one_that_has_not_arrived() -> None:
    A, b = np.diag(np.linspace(1, 100, 60)), np.ones(60)
    exact, nothing = (lambda r: r / np.diag(A)), None
    spoilt = lambda r: np.linspace(1, 1e4, 60) * r  # noqa: E731

    def runs(*solves, each=0.0):
        return [ConjugateGradients(lambda x: A @ x, b, solve, each) for solve in solves]

    first, second, third = race(runs(nothing, exact, spoilt), 2.0, 50.0)
    assert second <= 2.0
    assert min(first, third) > 10.0
    dear = runs(nothing, exact)
    dear[1].each = 1000.0
    assert race(dear, 2.0, 500.0)[0] < race(dear, 2.0, 2000.0)[1]
    negative = runs(lambda r: -r, nothing)
    assert race(negative, 2.0, 100.0)[0] == np.inf


def test_iterations_are_extrapolated_from_digits() -> None:
    assert iterations([1.0, 1e-2, 1e-4], 8) == 4
    assert iterations([1.0, 1.0], 8) == np.inf
