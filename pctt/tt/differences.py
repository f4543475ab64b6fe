"""Fast transforms as preconditioners of matrices whose entries depend on differences.

A(x, y) = a(x - y) for the points of a grid (a Toeplitz matrix on each axis); a(s) is a number, or a block of b x b
numbers if a point has b unknowns. Of all matrices that a transform Q diagonalises (up to blocks), the nearest one to A
in Frobenius' norm has the eigenvalues diag(Q A Q'). They are Rayleigh quotients of A, so this matrix is positive
definite if A is. For a cosine or a sine transform the quotients of all basis vectors of an axis are transforms of the
weighted differences: with v_k(i) v_k(j) = (cos t (i - j) +- cos t (i + j + 1)) / n, t = pi k / n, and the sum of the
second cosines over all pairs of difference s, which is -sin(t s) / sin(t),

    lambda_k = 1/n sum_s a(s) ((n - |s|) cos t s  -+  sin t |s| / sin t).

(R. Chan, T. Chan & Wong, 1999; for circulants T. Chan, SIAM J. Sci. Stat. Comput. 9, 1988.) A cosine transform reflects
at the boundary of the grid, where a circulant continues at the opposite side; a sine transform reflects with the other
sign. So errors at the boundary have opposite signs, and a mean of both inverses is often nearer to that of A. Both see
only the mean of a over the signs of the coordinates. If A differs much from it (rotated anisotropy), circulants are
better, and so is a part of the inverse of the circulant on a grid twice as wide that has A as a part.

Each of these matrices C makes the trace of C^-1 A as large as that of I. So the bound of Kaporin (Numer. Linear Algebra
Appl. 1, 1994), by which conjugate gradients take fewer iterations the smaller trace^N / det is, depends on det C alone:
of the transforms, the one with the smallest determinant is the best. Whether another preconditioner or none is better
still, solutions on small parts of the grid show (`choose`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import product as signs_of
from math import inf, prod

import numpy as np
from scipy import fft

from pctt.tt.conjugate import ConjugateGradients, CostEstimate, at_least, race
from pctt.tt.train import Array

FLOOR = 1e-13  # smaller eigenvalues, relative to the largest, count as rounding
SHARE, LEAST, MOST = 1 / 40, 24, 4096  # of the points, of which a part has so many at least, and at most
PART = 0.25  # of the cost of a solution, that trials may cost
SLACK = 1.3  # a preconditioner that costs so many times more than another one on a part is not tried further there
OUT = 2.0  # one that costs so many times more on all parts so far is not tried on others
DEAR = 1000.0  # products that a trial may cost
BINS = 4000  # numbers that stand for the eigenvalues of a matrix
UNTRIED = [1.0, 0.5]  # norms that stand for those of a trial

#: What is tried: the transforms of which the mean of the inverses is taken, and their shares.
Kind = tuple[tuple[str, float], ...]
NOTHING: Kind = ()
BLOCK_DIAGONAL: Kind = (("block diagonal", 1.0),)
CIRCULANT: Kind = (("circulant", 1.0),)
COSINE: Kind = (("cosine", 1.0),)
SINE: Kind = (("sine", 1.0),)
MEANS: tuple[Kind, ...] = ((("cosine", 0.5), ("sine", 0.5)), (("cosine", 0.75), ("sine", 0.25)))
EMBEDDING: Kind = (("embedding", 1.0),)
#: The cost of an application; that of a product with A is 1.
COSTS = {"block diagonal": 0.0, "circulant": 0.25, "cosine": 0.25, "sine": 0.25, "embedding": 1.0}
WORDS = {
    "block diagonal": "block Jacobi", "circulant": "circulant", "cosine": "cosine transform",
    "sine": "sine transform", "embedding": "circulant embedding",
}  # fmt: skip


@dataclass(frozen=True, eq=False)
class Differences:
    """The function a(s) of a matrix with b unknowns a point.

    shape : (n_1, ..., n_D) of the grid
    values : (n_1, ..., n_D, b, b), if all signs of coordinates give the same a; otherwise
        (2 n_1 - 1, ..., 2 n_D - 1, b, b), negative differences from the end

    >>> a = Differences.of_even(0.5 ** np.arange(4.0))
    >>> a.times(np.array([1.0, 0, 0, 0])).round(6)
    array([1.   , 0.5  , 0.25 , 0.125])
    """

    shape: tuple[int, ...]
    values: Array

    @classmethod
    def of_even(cls, values: Array) -> Differences:
        """For numbers a(s) (n_1, ..., n_D), which are the same for all signs of coordinates of s."""
        return cls(values.shape, values[..., None, None])

    @property
    def block(self) -> int:
        return self.values.shape[-1]

    @property
    def even(self) -> bool:
        return self.values.shape[:-2] == self.shape

    @property
    def transposed(self) -> Differences:
        """Those of the transposed matrix, a(-s)'."""
        opposite = self.values if self.even else self.values[np.ix_(*[-np.arange(m) for m in self.values.shape[:-2]])]
        return Differences(self.shape, np.swapaxes(opposite, -1, -2))

    @property
    def symmetric(self) -> bool:
        """Whether the matrix is, up to rounding."""
        return self._is_near(self.transposed.values)

    def _is_near(self, values: Array) -> bool:
        return bool(np.abs(values - self.values).max() <= 1e-12 * np.abs(self.values).max())

    def compact(self) -> Differences:
        """The same, with the values of all signs in one if they are equal up to rounding."""
        folded = Differences(self.shape, self.values[tuple(map(slice, self.shape))])
        signed = [np.concatenate([np.arange(n), np.arange(1 - n, 0)]) for n in self.shape]
        return folded if not self.even and self._is_near(folded.at(signed)) else self

    def at(self, offsets: Sequence[Array]) -> Array:
        """a at all combinations of these differences along the axes."""
        return self.values[np.ix_(*[np.abs(s) if self.even else s for s in offsets])]

    def part(self, counts: Sequence[int]) -> Differences:
        """Those of so many neighbouring points along each axis."""
        return Differences(tuple(counts), self.at([self._signed(count) for count in counts]))

    def means_of(self, counts: Sequence[int], widths: Sequence[int]) -> Differences:
        """Those of P A P', where the orthonormal rows of P are the means over cells of so many points, times a root.

        counts, widths : along each axis, of cells and of points of a cell

        >>> Differences.of_even(np.array([2.0, 1.0, 0.0, 0.0])).means_of([2], [2]).values.ravel()
        array([3. , 0.5])
        """
        values = self.values
        for axis, (count, width) in enumerate(zip(counts, widths)):
            first = width * self._signed(count)
            offsets = [np.abs(first + t) if self.even else first + t for t in range(1 - width, width)]
            weights = 1 - np.abs(np.arange(1 - width, width)) / width
            values = np.sum([w * np.take(values, s, axis) for w, s in zip(weights, offsets)], axis=0)
        return Differences(tuple(counts), values)

    def _signed(self, count: int) -> Array:
        """The differences of so many points on an axis, in the order of `values`."""
        s = np.arange(count)
        return s if self.even else np.concatenate([s, s[1:] - count])

    def _along(self, axis: int, values: Array) -> tuple[Array, Array, Array]:
        """a(s) and a(s - n) for s = 0, ..., n - 1 along an axis, which comes first, and s / n of the same dimension.

        a(-n) is any number.
        """
        n = self.shape[axis]
        values = np.moveaxis(values, axis, 0)
        opposite = np.minimum(n - np.arange(n), n - 1) if self.even else np.arange(n) - n
        return values[:n], values[opposite], (np.arange(n) / n).reshape(-1, *[1] * (values.ndim - 1))

    def circulant(self) -> Array:
        """The differences (n_1, ..., n_D, b, b) of the nearest circulant."""
        values = self.values
        for axis in range(len(self.shape)):
            here, opposite, part = self._along(axis, values)
            values = np.moveaxis((1 - part) * here + part * opposite, 0, axis)
        return values

    def is_circulant(self) -> bool:
        """Whether a(s) is a(s - n) along each axis, to rounding of the largest a(s), s not 0."""
        sizes = np.abs(self.values)
        sizes[(0,) * len(self.shape)] = 0.0
        rounding = 1e-12 * (sizes.max() or 1.0)
        pairs = (self._along(axis, self.values) for axis in range(len(self.shape)))
        return all(np.abs(here - opposite)[1:].max(initial=0.0) <= rounding for here, opposite, _ in pairs)

    def distance(self, transform: str) -> float:
        """Of A from the nearest matrix that a "cosine", a "sine" or a "circulant" diagonalises, over the size of A, in
        Frobenius' norm. That matrix is a projection of A, so the squares of both distances add up."""
        squares = self.values**2
        for n in self.shape:
            s = np.abs(self._signed(n))
            squares = np.tensordot((n - s) * (1 + (self.even & (s > 0))), squares, 1)
        if transform == "circulant":
            near = prod(self.shape) * (self.circulant() ** 2).sum()
        else:
            near = (eigenvalues(self, transform)[0] ** 2).sum()
        return float(max(1 - near / squares.sum(), 0.0) ** 0.5)

    def means(self) -> Array:
        """The means (n_1, ..., n_D, b, b) over the signs of the coordinates."""
        values = self.values
        if not self.even:
            for axis, n in enumerate(self.shape):
                s = np.arange(n)
                values = np.moveaxis(values, axis, 0)
                values = np.moveaxis(0.5 * (values[s] + values[-s]), 0, axis)
        return values

    def wide(self) -> Array:
        """The differences (m_1, ..., m_D, b, b) of a circulant on a wider grid that has A as a part."""
        widths = _widths(self.shape)
        offsets = []
        for n, m in zip(self.shape, widths):
            s = np.arange(m)
            offsets.append(np.where(s < n, s, np.where(s > m - n, s - m, 0)))
        values = self.at(offsets)
        for axis, (n, m) in enumerate(zip(self.shape, widths)):
            np.moveaxis(values, axis, 0)[n : m - n + 1] = 0.0
        return values

    @property
    def times(self) -> Callable[[Array], Array]:
        """The product with A by FFT, for vectors (n_1 ... n_D b,) or several of them (k, n_1 ... n_D b)."""
        spectrum = fft.rfftn(self.wide(), axes=range(len(self.shape)))
        if self.even and self.block == 1:
            spectrum = spectrum.real.copy()
        return lambda x: _transformed("embedding", self.shape, spectrum, x)


def _widths(shape: tuple[int, ...]) -> list[int]:
    return [fft.next_fast_len(2 * n - 1, real=True) for n in shape]


def _transformed(kind: str, shape: tuple[int, ...], factor: Array, x: Array) -> Array:
    """Q' F Q x for vectors x (..., n_1 ... n_D b); F has the blocks ``factor``, and Q is the transform of this kind."""
    block, axes = factor.shape[-1], range(-len(shape) - 1, -1)
    y = x.reshape(*x.shape[:-1], *shape, block)
    if kind == "cosine":
        y = fft.idctn(_multiplied(factor, fft.dctn(y, axes=axes)), axes=axes, overwrite_x=True)
    elif kind == "sine":
        y = fft.idstn(_multiplied(factor, fft.dstn(y, axes=axes)), axes=axes, overwrite_x=True)
    elif kind == "block diagonal":
        y = _multiplied(factor, y)
    else:
        sizes = list(shape) if kind == "circulant" else _widths(shape)
        y = fft.irfftn(_multiplied(factor, fft.rfftn(y, sizes, axes=axes)), sizes, axes=axes, overwrite_x=True)
        y = y[(..., *map(slice, shape), slice(None))]
    return y.reshape(x.shape)


def _multiplied(factor: Array, y: Array) -> Array:
    if factor.shape[-1] == 1:
        return factor[..., 0] * y
    return np.einsum("...ij,...j->...i", factor, y)


class FastInverse:
    """A mean of the inverses of the nearest matrices to A that fast transforms diagonalise.

    a : the matrix A
    kind : of the mean, one of CANDIDATES

    positive : whether all eigenvalues are positive; if not, neither is A
    name : in words

    >>> a = Differences.of_even(0.3 ** np.arange(6.0))
    >>> x = FastInverse(a, (("cosine", 1.0),)).solve(a.times(np.ones(6)))
    >>> bool(abs(x - 1).max() < 0.25)
    True
    """

    def __init__(self, a: Differences, kind: Kind) -> None:
        self.kind, self.shape, self.block, self.positive = kind, a.shape, a.block, True
        self.each = sum(COSTS[transform] for transform, _ in kind)
        self.name = " and ".join(WORDS[transform] for transform, _ in kind) or "no preconditioner"
        if len(kind) == 2:
            self.name = "cosine and sine transform"
        self._factors: list[tuple[str, Array]] = []
        for transform, share in kind:
            values, least = eigenvalues(a, transform)
            inverse, positive = _inverse(values, least)
            self.positive &= positive
            self._factors.append((transform, share * inverse))

    def solve(self, x: Array) -> Array:
        """The product of the mean of the inverses with x (..., n_1 ... n_D b)."""
        if not self._factors:
            return x.copy()
        (kind, factor), *more = self._factors
        out = _transformed(kind, self.shape, factor, x)
        for kind, factor in more:
            out += _transformed(kind, self.shape, factor, x)
        return out


def eigenvalues(a: Differences, transform: str) -> tuple[Array, float | None]:
    """The blocks (..., b, b) of Q A Q' on its diagonal, and a bound below which they count as this bound, or None.

    A circulant on a wider grid need not be positive if A is. Its bound is the least eigenvalue of the nearest
    circulant.
    """
    axes = range(len(a.shape))
    if transform == "block diagonal":
        return a.values[(slice(1),) * len(a.shape)], None
    if transform in ("cosine", "sine"):
        values = a.means()
        for axis in axes:
            values = np.moveaxis(_along_last(np.moveaxis(values, axis, -1), transform), -1, axis)
        return values, None
    values = fft.rfftn(a.circulant(), axes=axes)
    bound = None
    if transform == "embedding":
        bound = float(np.linalg.eigvalsh(values).min()) if a.block > 1 else float(values.real.min())
        values = fft.rfftn(a.wide(), axes=axes)
    return (values.real if a.block == 1 else values), bound


def spectrum(a: Differences, transform: str) -> tuple[Array, Array]:
    """The eigenvalues of the nearest matrix to A that a "cosine", a "sine" or a "circulant" diagonalises, and how often
    they occur."""
    values, _ = eigenvalues(a, transform)
    values = values[..., 0] if a.block == 1 else np.linalg.eigvalsh(values)
    n, often = a.shape[-1], np.ones(values.shape)
    if transform == "circulant":  # a half of them
        often[..., (np.arange(n // 2 + 1) % (n / 2) > 0), :] = 2.0
    return np.maximum(values, FLOOR * abs(values).max() or 1.0).ravel(), often.ravel()


def log_determinant(a: Differences, transform: str) -> float:
    """Of the nearest matrix to A that a "cosine", a "sine" or a "circulant" diagonalises, per unknown."""
    values, often = spectrum(a, transform)
    return float(often @ np.log(values) / often.sum())


def foreseen(a: Differences) -> float:
    """Iterations of conjugate gradients without a preconditioner, for the eigenvalues of the most promising transform.

    A itself may take fewer, if the transform smears its spectrum.
    """
    values, often = spectrum(a, promising(a)[0][0])
    logs = np.log(values)
    width = (logs.max() - logs.min()) / BINS or 1.0
    bins = ((logs - logs.min()) / width).astype(int)
    count, total = np.bincount(bins, often), np.bincount(bins, often * values)
    found, count = total[count > 0] / count[count > 0], count[count > 0]
    return race([ConjugateGradients(lambda x: found * x, count**0.5)], 1.0, DEAR)[0]


def _along_last(a: Array, kind: str) -> Array:
    n = a.shape[-1]
    weighted = np.zeros((*a.shape[:-1], n + 1))
    weighted[..., :n] = a * ((n - np.arange(n)) / n)
    even = fft.dct(weighted, 1)  # sum over all s of the weighted a(s) cos(pi k s / n), k = 0, ..., n
    odd = np.zeros_like(even)
    if n > 1:  # sum of a(s) sin(pi k |s| / n)
        odd[..., 1:n] = fft.dst(a[..., 1:], 1) / (n * np.sin(np.pi * np.arange(1, n) / n))
    return (even - odd)[..., :n] if kind == "cosine" else (even + odd)[..., 1:]


def _inverse(values: Array, bound: float | None) -> tuple[Array, bool]:
    """The inverses of Hermitian blocks (..., b, b), and whether all are positive. Less than a bound counts as it."""
    if values.shape[-1] == 1:
        vectors, values = None, values[..., 0]
    else:
        values, vectors = np.linalg.eigh(values)
    largest = float(values.max())
    positive = largest > 0 and (bound is not None or values.min() > -FLOOR * largest)
    values = np.maximum(values, max(bound or 0.0, FLOOR * abs(largest)) or 1.0)
    if vectors is None:
        return 1 / values[..., None], bool(positive)
    return (vectors / values[..., None, :]) @ np.conj(np.swapaxes(vectors, -1, -2)), bool(positive)


# -- the choice ----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Choice:
    """The preconditioner with which a solution costs least, and what trials on parts of the grid have shown."""

    kind: Kind
    cost_estimate: CostEstimate


def lines(a: Differences, width: int) -> list[Differences]:
    """Matrices of bundles of lines along each axis, which are so wide in the other axes. They show periods of a."""
    cells = [min(width, n) for n in a.shape]
    return [a.part([*cells[:axis], n, *cells[axis + 1 :]]) for axis, n in enumerate(a.shape)]


def parts(a: Differences) -> list[Differences]:
    """Matrices of a share of the points that have their eigenvalues between those of A: of neighbouring points, and of
    the means of cells of points (times the root of their number).

    The first shows how a behaves near zero, the second how it does far from it, on the whole grid. A small grid is no
    smaller part.
    """
    shape, size = a.shape, prod(a.shape)
    points = min(max(size * SHARE, LEAST), MOST)
    if size <= points:
        return [a]
    sides, left, axes = list(shape), points, len(shape)
    for k in sorted(range(len(shape)), key=lambda k: shape[k]):
        sides[k] = max(1, min(shape[k], round(left ** (1 / axes))))
        left, axes = max(1.0, left / sides[k]), axes - 1
    widths = []
    for n, side in zip(shape, sides):
        most = n // side  # a divisor shows all of the grid
        widths.append(next((k for k in range(most, most // 2, -1) if n % k == 0), most))
    return [a.part(sides), a.means_of([n // width for n, width in zip(shape, widths)], widths)]


def promising(a: Differences) -> Kind:
    """The transform with the smallest determinant."""
    return min((COSINE, CIRCULANT, SINE), key=lambda kind: log_determinant(a, kind[0][0]))


def candidates(a: Differences) -> list[Kind]:
    """What may be the best preconditioner, none among them: the most promising transform first.

    The determinant weighs small eigenvalues, Frobenius' norm large ones, so the best by either is among them. A cosine
    and a sine transform see only the means of a over the signs of coordinates. If a is not even, circulants are too.
    """
    best = promising(a)
    nearest = min((COSINE, CIRCULANT, SINE), key=lambda kind: a.distance(kind[0][0]))
    means, signs = MEANS if best != CIRCULANT else (), () if a.even else (CIRCULANT, EMBEDDING)
    return list(dict.fromkeys([best, NOTHING, *signs, nearest, *means, *[BLOCK_DIAGONAL] * (a.block > 1)]))


def choose(a: Differences) -> Choice | None:
    """The preconditioner with which conjugate gradients cost least; None if A is not positive definite.

    It is found on small parts of the grid: on lines, on lines that are twice as wide, and on parts with all axes. What
    costs OUT times as much as another is not tried further. Beside none and circulants as many are tried as cost PART
    of a solution, which costs as much as on the hardest part at least; on the last parts two are. The smallest sum over
    all parts wins, so the harder parts count more; that of none grows as is foreseen. If a grid is too small for
    trials, the most promising one is taken.
    """
    if a.is_circulant():  # which a part of the grid does not show
        exact = FastInverse(a, CIRCULANT)
        return Choice(CIRCULANT, CostEstimate(exact.each, [1.0, 0.0], [1.0, 0.0])) if exact.positive else None
    kinds, size, trials, scores = candidates(a), prod(a.shape), list[_Trial](), dict[Kind, float]()
    for pieces, least in ((lines(a, 1), 0), (lines(a, 2), 0), (parts(a), 2)):
        kinds = [kind for kind in kinds if not scores or scores[kind] <= OUT * scores[kinds[0]]]
        solution = max((trial.costs[kinds[0]] for trial in trials), default=inf)
        share = sum(prod(part.shape) for part in pieces) / size
        most = max(least, int((PART - _spent(trials, size) / solution) / share))
        if share > PART or min(most, len(kinds)) < 2:
            continue
        kinds = kinds[:most] + [kind for kind in kinds[most:] if kind in (NOTHING, CIRCULANT)]
        for part in pieces:
            trial = _Trial.run_with(part, kinds)
            if trial is None:
                return None
            trials.append(trial)
        scores = {kind: sum(trial.costs[kind] for trial in trials) for kind in kinds}
        kinds = sorted(kinds, key=lambda kind: scores[kind])
    if trials and kinds[0] == NOTHING:  # parts need not show how many eigenvalues are large
        scores[NOTHING] *= max(1.0, foreseen(a) / sum(foreseen(trial.a) for trial in trials))
        kinds = sorted(kinds, key=lambda kind: scores[kind])
    found = kinds[0]
    if not trials:
        inverse = FastInverse(a, found)
        return Choice(found, CostEstimate(inverse.each, UNTRIED, [1.0])) if inverse.positive else None
    hard = max(trials, key=lambda trial: trial.costs[found]).runs[found]
    alone = max((trial.runs[NOTHING].norms for trial in trials if NOTHING in trial.runs), key=at_least)
    return Choice(found, CostEstimate(hard.each, hard.norms, alone, _spent(trials, size)))


def _spent(trials: Sequence[_Trial], size: int) -> float:
    """By trials, in products with the whole matrix of so many points."""
    return sum(trial.spent for trial in trials) / size


class _Trial:
    """Solutions with a matrix by conjugate gradients with preconditioners, with a random right side.

    costs : of solutions, in products
    spent : by the trial, in products times points
    """

    def __init__(self, a: Differences, inverses: dict[Kind, FastInverse]) -> None:
        times, self.a, points = a.times, a, prod(a.shape)
        b = np.random.default_rng(0).standard_normal(points * a.block)
        solves = {kind: inverse.solve if kind else None for kind, inverse in inverses.items()}
        self.runs = {kind: ConjugateGradients(times, b, solves[kind], inverses[kind].each) for kind in inverses}
        self.costs = dict(zip(self.runs, race(list(self.runs.values()), SLACK, DEAR)))

    @classmethod
    def run_with(cls, a: Differences, kinds: Sequence[Kind]) -> _Trial | None:
        """None if A is not positive definite."""
        inverses = {kind: FastInverse(a, kind) for kind in kinds}
        if not all(inverse.positive for inverse in inverses.values()):
            return None
        trial = cls(a, inverses)
        return trial if min(trial.costs.values()) < inf else None

    @property
    def spent(self) -> float:
        return prod(self.a.shape) * sum(run.cost for run in self.runs.values())


# -- the differences of entries ------------------------------------------------------------------------------


def depend_on_differences(
    entries: Callable[[Array, Array], Array], shape: tuple[int, ...], block: int, order: Array | None,
    rng: np.random.Generator, pairs: int = 512,
) -> bool | None:  # fmt: skip
    """Whether entries at random pairs are those at pairs of the same difference elsewhere.

    None: they are not. True: they also keep their values if coordinates of the difference change their signs.
    The offsets of the pairs are of all sizes, so that steep kernels show. `order` has the row of each unknown of each
    point; None: they are in this order.
    """
    places = []
    signs = rng.choice([-1, 1], (len(shape), pairs))
    joint = rng.random(pairs)
    for n, sign in zip(shape, signs):
        reach = np.minimum((n ** np.where(rng.random(pairs) < 0.5, joint, rng.random(pairs))).astype(int) - 1, n - 1)
        offset = rng.integers(0, reach + 1)
        here, there = rng.integers(0, n - offset, (2, pairs))
        places.append([here, here + offset, there, there + offset])
        places[-1] += [np.where(sign > 0, there, there + offset), np.where(sign > 0, there + offset, there)]
    unknown = rng.integers(0, block, (2, pairs))
    points = [np.ravel_multi_index(axis, shape) * block + unknown[k % 2] for k, axis in enumerate(zip(*places))]
    i, j, moved_i, moved_j, turned_i, turned_j = points if order is None else [order[p] for p in points]
    here, moved, turned = entries(i, j), entries(moved_i, moved_j), entries(turned_i, turned_j)
    if not _alike(here, moved):
        return None
    return _alike(here, turned)


def _alike(a: Array, b: Array) -> bool:
    """Whether a and b are equal up to 1e-6, and up to 1e-12 of the largest of all."""
    largest = np.maximum(np.abs(a), np.abs(b))
    return bool((np.abs(a - b) <= 1e-6 * largest + 1e-12 * largest.max(initial=0.0)).all())


def differences_of(
    entries: Callable[[Array, Array], Array], shape: tuple[int, ...], block: int, order: Array | None, even: bool
) -> Differences:
    """The differences of a symmetric matrix whose entries depend on nothing else; arguments as before."""
    size, chunk = prod(shape), max(1, (1 << 20) // block**2)  # entries that are evaluated at a time
    values = np.zeros((*(shape if even else [2 * n - 1 for n in shape]), block, block))
    turns = [(1,) * len(shape)] if even else [(1, *signs) for signs in signs_of((1, -1), repeat=len(shape) - 1)]
    p, q = np.indices((block, block)).reshape(2, -1)
    for first in range(0, size, chunk):
        distance = np.unravel_index(np.arange(first, min(first + chunk, size)), shape)
        for signs in turns:
            ends = [
                np.ravel_multi_index(tuple(x if s == side else 0 * x for x, s in zip(distance, signs)), shape) * block
                for side in (1, -1)
            ]
            i, j = np.add.outer(ends[0], p).ravel(), np.add.outer(ends[1], q).ravel()
            found = entries(i, j) if order is None else entries(order[i], order[j])
            found = found.reshape(-1, block, block)
            values[tuple(s * x for x, s in zip(distance, signs))] = found
            if not even:
                values[tuple(-s * x for x, s in zip(distance, signs))] = np.swapaxes(found, -1, -2)
    return Differences(shape, values)
