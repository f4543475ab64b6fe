"""A matrix given by a function of its indices, for `compress_cross`. No cost here is linear in the size of the matrix.

Norms and errors are sums over random pairs of points. The column is near the row on all scales: their coordinates
differ by up to 2^s - 1 with a random s. The probability of a pair is known, so the weighted sum has the right
expectation. The samples meet the diagonal and the steep part of a singular kernel as often as the rest.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from pctt.tt.grid import GridDigits
from pctt.tt.sparse import Agreement, on_one_rank
from pctt.tt.train import Array

Function = Callable[[Array, Array], Array]
NORM_SAMPLES = 4096


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

    dtype = np.dtype(float)

    def __init__(
        self, entries: Function, digits: GridDigits, order: Array | None = None, agree: Agreement = on_one_rank
    ) -> None:
        self.entries, self.digits, self.order, self.agree = entries, digits, order, agree
        self.modes = digits.modes
        keys, weights = self.validation(NORM_SAMPLES, np.random.default_rng(1))
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
        return self._pairs(count, rng)[0]

    def validation(self, count: int, rng: np.random.Generator) -> tuple[Array, Array]:
        """Keys of 2 count pairs, and weights: the weighted sum of squares over them estimates that over all pairs."""
        return self._pairs(2 * count, rng)

    def _pairs(self, count: int, rng: np.random.Generator) -> tuple[Array, Array]:
        sizes = [*self.digits.shape, self.digits.block]
        rows, columns = [], []
        weight = np.full(count, float(self.digits.rows) / count)
        inside = np.ones(count, bool)
        joint = rng.random(count) < 0.5  # one scale for all axes, otherwise one for each axis
        common = rng.random(count)
        for n in sizes:
            scales = int(np.ceil(np.log2(n))) + 1  # for the last scale 2^s - 1 >= n - 1
            own = rng.random(count)
            reach = (1 << (np.where(joint, common, own) * scales).astype(np.int64)) - 1
            row = rng.integers(0, n, count)
            column = row + rng.integers(-reach, reach + 1)
            inside &= (column >= 0) & (column < n)
            rows.append(row)
            columns.append(column)
        offset = np.abs(np.subtract(rows, columns))
        weight /= self._chance(offset, sizes)
        return self.digits.key(np.array(rows)[:, inside], np.array(columns)[:, inside]), weight[inside]

    def _chance(self, offset: Array, sizes: list[int]) -> Array:
        """The probability of offsets (D + 1, p), given the row.

        It is half of a product over the axes, plus half of an average over a common scale.
        """
        apart = np.ones(offset.shape[1])
        edges = {0.0, 1.0}
        for n, off in zip(sizes, offset):
            scales = int(np.ceil(np.log2(n))) + 1
            reach = (1 << np.arange(scales)) - 1
            table = np.cumsum((1.0 / (2 * reach + 1))[::-1])[::-1] / scales
            apart *= table[np.searchsorted(reach, off)]
            edges |= {s / scales for s in range(scales)}
        together = np.zeros(offset.shape[1])
        cuts = np.array(sorted(edges))
        for low, high in zip(cuts[:-1], cuts[1:]):
            part = np.full(offset.shape[1], high - low)
            for n, off in zip(sizes, offset):
                scales = int(np.ceil(np.log2(n))) + 1
                far = (1 << int(0.5 * (low + high) * scales)) - 1
                part *= np.where(off <= far, 1.0 / (2 * far + 1), 0.0)
            together += part
        return 0.5 * (apart + together)
