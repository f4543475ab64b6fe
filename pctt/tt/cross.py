"""Cross approximation of a matrix: a train from some of its entries.

The entries on crosses determine a train of rank r. Every bond has a few *prefixes* (i_1 j_1, ..., i_k j_k) and
*suffixes* (i_{k+1} j_{k+1}, ..., i_d j_d), which give the crosses. A sweep goes from core to core. It evaluates the
matrix at prefix x digit x suffix and finds its dominant column space. The rows on which this space is best conditioned
(maximal volume) become the next prefixes. The sweep back does the same with suffixes. A sweep needs of the order of
d r^2 m^2 entries, independent of the number of nonzeros (Oseledets & Tyrtyshnikov, Linear Algebra Appl. 432, 2010;
Savostyanov & Oseledets, 2011).

Random crosses of a sparse matrix are zero nearly everywhere. So the first pivots are stored nonzeros. Every sweep adds
those nonzeros of a sample where the train is worst; they have the role of the residual in AMEn.

A matrix given by a function of its indices is an `EntryMatrix`, and no cost is linear in its size. Its norms and errors
are sums over random pairs of points. The column is near the row on all scales: their coordinates differ by up to
2^s - 1 with a random s. The probability of a pair is known, so the weighted sum has the right expectation. The samples
meet the diagonal and the steep part of a singular kernel as often as the rest.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy import linalg

from pctt.tt.quantise import GridDigits
from pctt.tt.sparse import Agreement, SparseHierarchy, on_one_rank, relative_error
from pctt.tt.train import Array, Train, low_rank, matrix_train, zeros
from pctt.tt.work import ENTRY, Work, svd_operations

SAMPLES = 1024  # a train is validated on this number of stored entries and on as many others
CROSS = "the compression"  # the phase for `Work`


@dataclass(frozen=True)
class Cross:
    """A train from crosses.

    error : ||A - T||_F / ||A||_F, measured, or estimated from validation entries
    sweeps, evaluations : numbers of sweeps there and back over the cores, and of evaluated entries of the matrix
    prefixes, suffixes : index sets of bonds 0, ..., d, a start for a similar matrix
    """

    train: Train
    error: float
    sweeps: int
    evaluations: int
    prefixes: list[Array]
    suffixes: list[Array]


def compress_cross(
    matrix: SparseHierarchy | EntryMatrix, max_rank: int = 10, eps: float = 1e-2, start: Cross | None = None,
    sweeps: int = 10, rng: np.random.Generator | None = None, work: Work | None = None,
) -> Cross:  # fmt: skip
    """Return a train with ranks at most `max_rank` from entries of the matrix. Its error is about eps if the rank
    allows it.

    The final error of a sparse matrix is measured, at a cost linear in the nonzeros; that of a matrix given by a
    function is estimated from fresh samples. All other costs are sublinear.

    Parameters
    ----------
    start : the result for a similar matrix; its index sets are the first ones
    sweeps : largest number of sweeps. They end earlier if the estimated error is below eps, or if it falls by less than
        a tenth in two consecutive sweeps.
    rng : must give the same numbers on all ranks
    work : counts entries and factorisations; raises TooMuchWorkError on all ranks at its limit

    >>> A = SparseHierarchy(np.arange(64), np.arange(64)[::-1], [4, 4, 4])
    >>> A.set_values(np.ones(64))
    >>> compress_cross(A, eps=1e-10).train.ranks
    (1, 1, 1, 1)
    """
    rng = np.random.default_rng(0) if rng is None else rng
    entries = _Entries(matrix, rng, Work() if work is None else work)
    if entries.norm == 0:
        nothing = [np.zeros(1, np.int64)] * len(entries.width)
        return Cross(zeros(matrix.modes, matrix.modes), 0.0, 0, 0, nothing, nothing)
    validation = matrix.validation(SAMPLES, rng)
    most = min(max_rank, 32)  # stored entries, those where the train is worst, that enrich the next sweep
    extra = matrix.sample(most, rng)
    prefixes, suffixes = (start.prefixes, start.suffixes) if start else entries.split(extra)
    best: Cross | None = None
    idle, inner = 0, eps
    for count in range(1, sweeps + 1):
        suffixes = _backward(entries, prefixes, extra, max_rank, inner)
        cores, prefixes = _forward(entries, suffixes, extra, max_rank, inner)
        train = matrix.agree(matrix_train(cores, matrix.modes).round(0.3 * eps))
        error = matrix.agree(entries.error(train, *validation))
        idle = 0 if best is None or error < 0.9 * best.error else idle + 1
        if best is None or error < best.error:
            best = Cross(train, error, count, entries.evaluations, prefixes, suffixes)
        if error <= eps or idle == 2:
            break
        inner *= 0.1  # the tolerance of the single cores
        extra = matrix.agree(entries.worst(train, most))
    assert best is not None, "there is at least one sweep"
    if isinstance(matrix, SparseHierarchy):
        return replace(best, error=relative_error(matrix, best.train))
    return replace(best, error=matrix.agree(entries.error(best.train, *matrix.validation(SAMPLES, rng))))


class _Entries:
    """Entries of the matrix by one key. Its digits are i_k m_k + j_k of base m_k^2, the first mode most significant.

    A prefix of length k and a suffix are keys of their own digits: key = prefix * width[k] + suffix.
    """

    def __init__(self, matrix: SparseHierarchy | EntryMatrix, rng: np.random.Generator, work: Work) -> None:
        self.matrix, self.rng, self.work = matrix, rng, work
        self.squares = [m * m for m in matrix.modes]
        self.width = [1]
        for square in self.squares[::-1]:
            self.width.insert(0, self.width[0] * square)
        self.norm = matrix.norm()
        self.evaluations = 0

    def at(self, keys: Array) -> Array:
        """The entries at keys of any shape."""
        self._count(keys.size)
        return self.matrix.lookup(keys)

    def _count(self, evaluations: int) -> None:
        self.evaluations += evaluations
        self.work.spend(ENTRY * evaluations, CROSS)

    def spend_on_pivots(self, rows: int, columns: int) -> None:
        self.work.spend(5 * svd_operations(rows, columns), CROSS)  # as measured

    def block(self, k: int, prefixes: Array, suffixes: Array) -> Array:
        """Entries (prefixes, m_k^2, suffixes) around digit k."""
        self._count(len(prefixes) * self.squares[k] * len(suffixes))
        digits = np.arange(self.squares[k]) * self.width[k + 1]
        return self.matrix.crosses(prefixes * self.width[k], digits, suffixes)

    def split(self, keys: Array) -> tuple[list[Array], list[Array]]:
        """The distinct prefixes and suffixes of keys for every bond."""
        return [np.unique(keys // w) for w in self.width], [np.unique(keys % w) for w in self.width]

    def of_train(self, train: Train, keys: Array) -> Array:
        return train.at(np.stack(np.unravel_index(keys, self.squares)))

    def error(self, train: Train, keys: Array, weights: Array) -> float:
        """The estimated relative error."""
        square = (self.at(keys) - self.of_train(train, keys)) ** 2
        return float(weights @ square) ** 0.5 / self.norm

    def worst(self, train: Train, count: int) -> Array:
        """Keys of those stored entries in a sample where the train is worst."""
        keys = np.unique(self.matrix.sample(SAMPLES, self.rng))
        keys = self.rng.permutation(keys)  # spreads equal errors over the matrix
        error = np.abs(self.at(keys) - self.of_train(train, keys))
        return keys[np.argsort(-error, kind="stable")[:count]]


def _forward(
    entries: _Entries, suffixes: list[Array], extra: Array, max_rank: int, eps: float
) -> tuple[list[Array], list[Array]]:
    """The sweep from the first core to the last: it returns interpolating cores and new prefixes."""
    d = len(entries.squares)
    prefixes = [np.zeros(1, np.int64)]
    cores = []
    for k in range(d - 1):
        columns = np.union1d(suffixes[k + 1], extra % entries.width[k + 1])
        C = entries.block(k, prefixes[k], columns)
        entries.spend_on_pivots(C.size // len(columns), len(columns))
        U, pivots = entries.matrix.agree(_dominant(C.reshape(-1, len(columns)), max_rank, eps / d))
        cores.append(U.reshape(len(prefixes[k]), -1, len(pivots)))
        prefixes.append(prefixes[k][pivots // entries.squares[k]] * entries.squares[k] + pivots % entries.squares[k])
    cores.append(entries.block(d - 1, prefixes[-1], np.zeros(1, np.int64)))
    return cores, prefixes


def _backward(
    entries: _Entries, prefixes: list[Array], extra: Array, max_rank: int, eps: float
) -> list[Array]:
    """The sweep from the last core to the first: it returns new suffixes."""
    d = len(entries.squares)
    suffixes = [np.zeros(1, np.int64)]
    for k in range(d - 1, 0, -1):
        rows = np.union1d(prefixes[k], extra // entries.width[k])
        C = entries.block(k, rows, suffixes[0])
        entries.spend_on_pivots(C.size // len(rows), len(rows))
        pivots = entries.matrix.agree(_dominant(C.reshape(len(rows), -1).T, max_rank, eps / d)[1])
        digits, old = pivots // len(suffixes[0]), pivots % len(suffixes[0])
        suffixes.insert(0, digits * entries.width[k + 1] + suffixes[0][old])
    return [np.zeros(1, np.int64), *suffixes]


def _dominant(C: Array, max_rank: int, eps: float) -> tuple[Array, Array]:
    """U (n, r) and rows with U[rows] = I, which interpolate the dominant columns of C (n, m) well; r >= 1."""
    Q = low_rank(C, eps * float(np.linalg.norm(C)), max_rank)[0]
    rows = linalg.qr(Q.T, mode="r", pivoting=True, check_finite=False)[1][: Q.shape[1]].astype(np.int64)
    for _ in range(100):  # towards maximal volume, one exchange of rows at a time
        U = linalg.solve(Q[rows].T, Q.T, check_finite=False).T
        worst = int(np.abs(U).argmax())
        if abs(U.flat[worst]) <= 1.1:
            break
        rows[worst % U.shape[1]] = worst // U.shape[1]
    return U, rows


class EntryMatrix:
    """T = (A - c I) / c for the matrix A(i, j) = entries(i, j) of the points of a grid; c is the mean of A's diagonal.

    If the mean is not positive, T = A. Padded rows are rows of c I. Errors are relative to T, because the norm of the
    identity grows with the number of points and would hide them.

    entries : takes rows and columns, integers (p,), and returns numbers (p,)
    digits : the digits of the grid
    order : (rows,) the row at each point of the grid, if rows are not in the order of the points
    agree : as in `SparseHierarchy`

    shift, scale : c and 1 / c
    """

    def __init__(
        self, entries: Callable[[Array, Array], Array], digits: GridDigits, order: Array | None = None,
        agree: Agreement = on_one_rank,
    ) -> None:  # fmt: skip
        self.entries, self.digits, self.order, self.agree = entries, digits, order, agree
        self.modes = digits.modes
        keys, weights = self.validation(4096, np.random.default_rng(1))
        row, column = np.divmod(digits.pair(keys), digits.size)
        self.shift, self.scale = 0.0, 1.0
        values = self.lookup(keys)
        mean = self.agree(float(values[row == column].mean()))
        if mean > 0:
            self.shift, self.scale = mean, 1 / mean
        self._norm = self.agree(float(weights @ self.lookup(keys) ** 2) ** 0.5)

    def norm(self) -> float:
        """The estimated Frobenius norm."""
        return self._norm

    def lookup(self, keys: Array) -> Array:
        """Entries at keys of any shape."""
        return self._at(self.digits.pair(keys))

    def crosses(self, prefixes: Array, digits: Array, suffixes: Array) -> Array:
        """Entries (p, m, s) at the sums of keys that share no digit."""
        pair = self.digits.pair
        return self._at(pair(prefixes)[:, None, None] + pair(digits)[:, None] + pair(suffixes))

    def _at(self, pairs: Array) -> Array:
        digits = self.digits
        row, column = np.divmod(pairs.ravel(), digits.size)
        out = np.zeros(row.shape)
        (i, there), (j, also) = digits.within(row), digits.within(column)
        inside = slice(None) if digits.padded == digits.shape else np.flatnonzero(there & also)
        i, j = i[inside], j[inside]
        if self.order is not None:
            i, j = self.order[i], self.order[j]
        out[inside] = self.scale * (self.entries(i, j) - np.where(i == j, self.shift, 0.0))
        return out.reshape(pairs.shape)

    def sample(self, count: int, rng: np.random.Generator) -> Array:
        """Keys of pairs of points, near on all scales."""
        return self._pairs(4 * count + 64, rng)[0][:count]  # some pairs leave the grid

    def validation(self, count: int, rng: np.random.Generator) -> tuple[Array, Array]:
        """Keys of 2 count pairs, and weights: the weighted sum of squares over them estimates that over all pairs."""
        return self._pairs(2 * count, rng)

    def _pairs(self, count: int, rng: np.random.Generator) -> tuple[Array, Array]:
        """Keys and weights of pairs of points. Half of them have one scale for all axes, the others one per axis."""
        sizes = np.array([*self.digits.shape, self.digits.block])[:, None]
        scales = int(np.ceil(np.log2(sizes.max()))) + 1  # for the last scale 2^s - 1 >= n - 1
        reaches = np.minimum(1 << np.arange(scales), sizes) - 1  # (D + 1, scales)
        scale = rng.integers(0, scales, (len(sizes), count))
        scale[:, ::2] = scale[0, ::2]
        reach = np.take_along_axis(reaches, scale, 1)
        row = rng.integers(0, sizes, (len(sizes), count))
        column = row + rng.integers(-reach, reach + 1)
        inside = ((column >= 0) & (column < sizes)).all(axis=0)
        row, column = row[:, inside], column[:, inside]
        # the probability of an offset, given the row, for each axis, pair and scale
        chance = (np.abs(row - column)[..., None] <= reaches[:, None]) / (2.0 * reaches[:, None] + 1)
        chance = 0.5 * (chance.mean(axis=2).prod(axis=0) + chance.prod(axis=0).mean(axis=1))
        return self.digits.key(row, column), self.digits.rows / (count * chance)
