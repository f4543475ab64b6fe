"""A matrix given by a function of its indices, for `compress_cross`. No cost here is linear in the size of the matrix.

Norms and errors are sums over random pairs of points. The column is near the row on all scales: their coordinates
differ by up to 2^s - 1 with a random s. The probability of a pair is known, so the weighted sum has the right
expectation. The samples meet the diagonal and the steep part of a singular kernel as often as the rest.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from pctt.tt.quantise import GridDigits
from pctt.tt.sparse import Agreement, on_one_rank
from pctt.tt.train import Array

Function = Callable[[Array, Array], Array]


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
        self, entries: Function, digits: GridDigits, order: Array | None = None, agree: Agreement = on_one_rank
    ) -> None:
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
