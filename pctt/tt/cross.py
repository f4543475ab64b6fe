"""Cross approximation of a sparse matrix: a train from some of its entries, looked up one by one.

A train of rank r is determined by the entries on crosses: for every bond a few *prefixes* (i_1 j_1, ..., i_k
j_k) and *suffixes* (i_{k+1} j_{k+1}, ..., i_d j_d). A sweep evaluates, core after core, the matrix at prefix
x digit x suffix, finds its dominant column space, and keeps as the next prefixes the rows on which that space
is best conditioned (maximal volume); the sweep back does the same with suffixes. The cost of a sweep is of
the order d r^2 m^2 entries, independent of the number of nonzeros (Oseledets & Tyrtyshnikov, Linear Algebra
Appl. 432, 2010; Savostyanov & Oseledets, 2011).

Random crosses of a sparse matrix are zero nearly everywhere, so the first pivots are stored nonzeros, and the
enrichment of every sweep (the role of the residual in AMEn) are those among a sample of stored nonzeros where
the train is worst.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy import linalg

from pctt.tt.als import relative_error
from pctt.tt.entries import EntryMatrix
from pctt.tt.sparse import SparseHierarchy
from pctt.tt.train import Array, Train, low_rank, matrix_train, zeros

SAMPLES = 1024  # stored entries, and as many others, on which a train is validated
EXTRA = 32  # of the stored entries where the train is worst: what enriches the next sweep, at most
TIGHTER = 0.1  # what the accuracy of the single cores is multiplied by where a sweep has missed eps
WORTH = 0.9  # a sweep that leaves more than this of the error was idle


@dataclass(frozen=True)
class Cross:
    """A train from crosses.

    error : ||A - T||_F / ||A||_F, measured, or estimated from validation entries
    sweeps, evaluations : there and back over the cores; entries of the matrix that were looked up
    prefixes, suffixes : index sets of bonds 0, ..., d, the start for a similar matrix
    """

    train: Train
    error: float
    sweeps: int
    evaluations: int
    prefixes: list[Array]
    suffixes: list[Array]


def compress_cross(
    matrix: SparseHierarchy | EntryMatrix,
    max_rank: int = 10,
    eps: float = 1e-2,
    start: Cross | None = None,
    sweeps: int = 10,
    measure: bool = True,
    rng: np.random.Generator | None = None,
) -> Cross:
    """Train of ranks at most `max_rank` from entries of the matrix, within about eps if the rank allows.

    Parameters
    ----------
    start : the result for a similar matrix, whose index sets are the first ones
    sweeps : the most; the estimated error ends them when it is below eps or falls by less than a tenth
        in two sweeps running
    measure : measure the error of a sparse matrix at last, at a cost linear in the nonzeros; without, and of a matrix
        that is a function, it is estimated from fresh samples, and all is sublinear
    rng : must give the same numbers on all ranks

    >>> i = np.arange(63)
    >>> A = SparseHierarchy(np.r_[i, i + 1], np.r_[i + 1, i], [4, 4, 4])
    >>> A.set_values(np.ones(126))
    >>> compress_cross(A, eps=1e-10).train.ranks
    (1, 3, 3, 1)
    """
    rng = np.random.default_rng(0) if rng is None else rng
    entries = _Entries(matrix, rng)
    if entries.norm == 0:
        nothing = [np.zeros(1, np.int64)] * len(entries.width)
        return Cross(zeros(matrix.modes, matrix.modes, matrix.dtype), 0.0, 0, 0, nothing, nothing)
    validation = entries.validation()
    most = min(max_rank, EXTRA)
    extra = entries.stored(most)
    prefixes, suffixes = (start.prefixes, start.suffixes) if start else entries.split(extra)
    best: Cross | None = None
    idle, inner = 0, eps
    for count in range(1, sweeps + 1):
        suffixes = _backward(entries, prefixes, extra, max_rank, inner)
        cores, prefixes = _forward(entries, suffixes, extra, max_rank, inner)
        train = matrix.agree(matrix_train(cores, matrix.modes).round(0.3 * eps))
        error = matrix.agree(entries.error(train, *validation))
        idle = 0 if best is None or error < WORTH * best.error else idle + 1
        if best is None or error < best.error:
            best = Cross(train, error, count, entries.evaluations, prefixes, suffixes)
        if error <= eps or idle == 2:
            break
        inner *= TIGHTER
        extra = matrix.agree(entries.worst(train, most))
    assert best is not None, "there is at least one sweep"
    if isinstance(matrix, SparseHierarchy) and measure:
        return replace(best, error=relative_error(matrix, best.train))
    return replace(best, error=matrix.agree(entries.error(best.train, *entries.validation())))


class _Entries:
    """Entries of the matrix by one key: the digits i_k m_k + j_k of base m_k^2, the first mode most significant.

    A prefix of length k and a suffix are the keys of their own digits: key = prefix * width[k] + suffix.
    """

    def __init__(self, matrix: SparseHierarchy | EntryMatrix, rng: np.random.Generator) -> None:
        self.matrix = matrix
        self.rng = rng
        self.squares = [m * m for m in matrix.modes]
        self.width = [1]
        for square in self.squares[::-1]:
            self.width.insert(0, self.width[0] * square)
        self.norm = matrix.norm()
        self.evaluations = 0

    def at(self, keys: Array) -> Array:
        """The entries at keys of any shape."""
        self.evaluations += keys.size
        return self.matrix.lookup(keys)

    def block(self, k: int, prefixes: Array, suffixes: Array) -> Array:
        """Entries (prefixes, m_k^2, suffixes) around digit k."""
        self.evaluations += len(prefixes) * self.squares[k] * len(suffixes)
        digits = np.arange(self.squares[k]) * self.width[k + 1]
        return self.matrix.crosses(prefixes * self.width[k], digits, suffixes)

    def split(self, keys: Array) -> tuple[list[Array], list[Array]]:
        """The distinct prefixes and suffixes of keys for every bond."""
        return [np.unique(keys // w) for w in self.width], [np.unique(keys % w) for w in self.width]

    def stored(self, count: int) -> Array:
        """Keys of up to `count` stored entries, in random rows."""
        return self.matrix.sample(count, self.rng)

    def validation(self) -> tuple[Array, Array]:
        """Fresh keys, and weights with which a sum of squares over them estimates that over all entries."""
        return self.matrix.validation(SAMPLES, self.rng)

    def of_train(self, train: Train, keys: Array) -> Array:
        digits = np.stack([keys // w % square for w, square in zip(self.width[1:], self.squares)])
        return train.at(digits)

    def error(self, train: Train, keys: Array, weights: Array) -> float:
        """Estimate of the relative error."""
        square = (self.at(keys) - self.of_train(train, keys)) ** 2
        return float(weights @ square) ** 0.5 / self.norm

    def worst(self, train: Train, count: int) -> Array:
        """Keys of the stored entries, out of a sample, where the train is worst."""
        keys = self.rng.permutation(np.unique(self.stored(SAMPLES)))  # equal errors are spread over the matrix
        error = np.abs(self.at(keys) - self.of_train(train, keys))
        return keys[np.argsort(-error, kind="stable")[:count]]


def _forward(
    entries: _Entries, suffixes: list[Array], extra: Array, max_rank: int, eps: float
) -> tuple[list[Array], list[Array]]:
    """From the first core to the last: interpolating cores and new prefixes."""
    d = len(entries.squares)
    prefixes = [np.zeros(1, np.int64)]
    cores = []
    for k in range(d - 1):
        columns = np.union1d(suffixes[k + 1], extra % entries.width[k + 1])
        C = entries.block(k, prefixes[k], columns)
        U, pivots = entries.matrix.agree(_dominant(C.reshape(-1, len(columns)), max_rank, eps / d))
        cores.append(U.reshape(len(prefixes[k]), -1, len(pivots)))
        prefixes.append(prefixes[k][pivots // entries.squares[k]] * entries.squares[k] + pivots % entries.squares[k])
    cores.append(entries.block(d - 1, prefixes[-1], np.zeros(1, np.int64)))
    return cores, prefixes


def _backward(
    entries: _Entries, prefixes: list[Array], extra: Array, max_rank: int, eps: float
) -> list[Array]:
    """From the last core to the first: new suffixes."""
    d = len(entries.squares)
    suffixes = [np.zeros(1, np.int64)]
    for k in range(d - 1, 0, -1):
        rows = np.union1d(prefixes[k], extra // entries.width[k])
        C = entries.block(k, rows, suffixes[0])
        pivots = entries.matrix.agree(_dominant(C.reshape(len(rows), -1).T, max_rank, eps / d)[1])
        digits, old = pivots // len(suffixes[0]), pivots % len(suffixes[0])
        suffixes.insert(0, digits * entries.width[k + 1] + suffixes[0][old])
    return [np.zeros(1, np.int64), *suffixes]


def _dominant(C: Array, max_rank: int, eps: float) -> tuple[Array, Array]:
    """U (n, r) and rows with U[rows] = I that interpolate the dominant columns of C (n, m) well; r >= 1."""
    Q = low_rank(C, eps * float(np.linalg.norm(C)), max_rank)[0]
    rows = linalg.qr(Q.T, mode="r", pivoting=True, check_finite=False)[1][: Q.shape[1]].astype(np.int64)
    for _ in range(100):  # towards maximal volume, one exchange of rows at a time
        U = linalg.solve(Q[rows].T, Q.T, check_finite=False).T
        worst = int(np.abs(U).argmax())
        if abs(U.flat[worst]) <= 1.1:
            break
        rows[worst % U.shape[1]] = worst // U.shape[1]
    return U, rows
