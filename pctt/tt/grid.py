"""Digits of the points of a grid: the order of the points in a train.

A coordinate 0 <= c_a < n_a is written in digits. Their bases are small primes with a product p_a >= n_a, so there is
little padding. The modes of a train are the digits of one axis after the other. Row numbers, places in the train and
keys of pairs of points are all sums of one number per axis, and small tables have these numbers.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import prod

import numpy as np

from pctt.tt.quantise import scalar_modes, slots_of
from pctt.tt.train import Array

PRIMES = (2, 3, 5, 7)  # bases of digits


class GridDigits:
    """The digits of a grid of shape (n_1, ..., n_D). Its points are numbered like the entries of a numpy array.

    block : unknowns per point, the fastest digit of a row

    modes : modes of the train, the same for rows and columns
    places : (n_1 ... n_D block,) place of each row among the `slots_of(modes)` rows of the train

    >>> GridDigits((8, 6)).modes
    (2, 2, 2, 3, 2)
    """

    def __init__(self, shape: Sequence[int], block: int = 1) -> None:
        self.shape, self.block = tuple(int(n) for n in shape), int(block)
        if min((*self.shape, self.block)) < 1:
            raise ValueError(f"a grid of shape {self.shape} with blocks of {self.block}; allowed are numbers >= 1")
        axes = [bases(n) for n in self.shape]
        modes = [base for digits in axes for base in digits] or [1]
        self.modes = scalar_modes(modes, self.block)
        self._tables(axes)

    def _tables(self, axes: list[list[int]]) -> None:
        """Make the tables. For each axis they have the contribution of its coordinate to a place in the train and to
        the two halves of a key. For each mode they have the contribution of a pair of digits to the pair of padded
        rows."""
        self.padded = tuple(prod(digits) for digits in axes)
        self.size = slots_of(self.modes)
        if self.size >= 2**31:
            raise ValueError(f"too many points for a train: a grid of shape {self.shape}")
        width = [int(w) for w in np.cumprod([1, *self.modes[::-1]])[-2::-1]]  # weight of a digit in a place
        square = [w * w for w in width]  # weight of a pair of digits in a key
        stride = np.cumprod([1, *self.padded[::-1]])[-2::-1] * self.block
        self.place, self.row_key, self.column_key = ([np.zeros(p, np.int64) for p in self.padded] for _ in range(3))
        row_of = [np.zeros(m, np.int64) for m in self.modes]
        k = 0
        for a, bases_of_axis in enumerate(axes):
            for level, base in enumerate(bases_of_axis):
                weight = prod(bases_of_axis[level + 1 :])
                below = self.modes[k] // base  # in the last mode the block, otherwise 1
                digit = np.arange(self.padded[a]) // weight % base * below
                self.place[a] += digit * width[k]
                self.row_key[a] += digit * self.modes[k] * square[k]
                self.column_key[a] += digit * square[k]
                row_of[k] += np.arange(self.modes[k]) // below * (weight * int(stride[a]))
                k += 1
        row_of[-1] += np.arange(self.modes[-1]) % self.block
        self._pairs = [(row[:, None] * self.size + row).ravel() for row in row_of]
        self._square = square

    @property
    def rows(self) -> int:
        """Number of rows of the matrix, without padded rows."""
        return prod(self.shape) * self.block

    @property
    def places(self) -> Array:
        out = np.zeros(1, np.int64)
        for table, n in zip(self.place, self.shape):
            out = np.add.outer(out, table[:n]).ravel()
        return np.add.outer(out, np.arange(self.block)).ravel()

    def key(self, row: Array, column: Array) -> Array:
        """Keys of pairs of points with coordinates (D + 1, ...); the last coordinate is the unknown in the block."""
        out = row[-1] * self.modes[-1] + column[-1]
        for a in range(len(self.shape)):
            out = out + self.row_key[a][row[a]] + self.column_key[a][column[a]]
        return out

    def pair(self, keys: Array) -> Array:
        """Pairs row * size + column, of padded rows and columns, for keys with the digits i_k m_k + j_k of base m_k^2.

        If keys share no digit, the pair of their sum is the sum of their pairs.
        """
        pair = np.zeros(keys.shape, np.int64)
        for table, square in zip(self._pairs, self._square):
            digit, keys = np.divmod(keys, square)
            pair += table[digit]
        return pair

    def within(self, padded: Array) -> tuple[Array, Array]:
        """The rows of the matrix for padded rows, and a mask of those that exist; the other numbers mean nothing."""
        if self.padded == self.shape:
            return padded, np.ones(padded.shape, bool)
        *coordinates, inner = np.unravel_index(padded, (*self.padded, self.block))
        inside = np.ones(padded.shape, bool)
        row = np.zeros(padded.shape, np.int64)
        for c, n in zip(coordinates, self.shape):
            inside &= c < n
            row = row * n + c
        return row * self.block + inner, inside


def bases(n: int) -> list[int]:
    """Bases of the digits of 0, ..., n - 1: primes up to 7, largest first, with the least product that is at least n.

    >>> bases(64), bases(100), bases(97), bases(1)
    ([2, 2, 2, 2, 2, 2], [5, 5, 2, 2], [7, 7, 2], [])
    """
    while True:
        rest = n
        found: list[int] = []
        for p in PRIMES:
            while rest % p == 0:
                rest //= p
                found.insert(0, p)
        if rest == 1:
            return found
        n += 1
