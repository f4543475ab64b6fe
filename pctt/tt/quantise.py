"""Modes: the division of the index of a long vector, or of a point of a grid, into digits; merging of modes.

A vector has n *slots*, blocks of `block` unknowns each (a contact, a node, a body). Its modes m_1, ..., m_d satisfy
m_1 m_2 ... m_d >= n. The last mode is the leaf, a run of neighbouring slots that no bond separates. The scalar modes of
a train are the slot modes, with the leaf multiplied by the block size. Slots keep their order.

On a grid a coordinate 0 <= c_a < n_a is written in digits. Their bases are small primes with a product p_a >= n_a, so
there is little padding. The modes are the digits of one axis after the other, so the slots of the train are the points
of a grid of shape (p_1, ..., p_D), in the order of a numpy array.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import prod

import numpy as np

from pctt.tt.train import Array, Train

MIDDLE = 4  # the modes between the first and the last


def choose_modes(n: int, leaf: int = 16) -> tuple[int, ...]:
    """Return slot modes [first, MIDDLE, ..., MIDDLE, last] for n slots.

    The first mode is at most 64. The last is the number between `leaf` and 5/4 `leaf` with the least padding. A
    small number of slots gets one or two modes. The application of a train of rank r with these modes costs about
    2 n r (first + r MIDDLE levels + last) operations; for this reason the ends are not larger.

    >>> choose_modes(134_547)
    (31, 4, 4, 4, 4, 17)
    >>> choose_modes(1000), choose_modes(20)
    ((50, 20), (20,))
    """
    if n < 1:
        raise ValueError(f"there is no train of {n} slots")
    if n <= 2 * leaf:
        return (n,)
    levels = 0
    while n > 64 * MIDDLE**levels * leaf:
        levels += 1
    ends = range(leaf, leaf + leaf // 4 + 1)
    return min(((-(-n // (last * MIDDLE**levels)), *[MIDDLE] * levels, last) for last in ends), key=slots_of)


def slots_of(modes: Sequence[int]) -> int:
    """Return the number of slots (or scalars) that modes hold: their product."""
    return prod(map(int, modes))


def scalar_modes(modes: Sequence[int], block: int) -> tuple[int, ...]:
    """Return modes of the unknowns; the leaf has `block` unknowns per slot.

    >>> scalar_modes([2, 4, 16], 3)
    (2, 4, 48)
    """
    return (*modes[:-1], modes[-1] * block)


def group_modes(modes: Sequence[int], ends: int) -> list[int]:
    """Numbers of neighbouring modes to merge, so that products are at most `ends` at both ends and MIDDLE between.

    >>> group_modes([2] * 16, 64)
    [6, 2, 2, 6]
    """
    modes = list(modes)
    head = leading(modes, ends)
    tail = leading(modes[:head - 1 if head else None:-1], ends) if head < len(modes) else 0
    groups, k = [head], head
    while k < len(modes) - tail:
        groups.append(leading(modes[k : len(modes) - tail], MIDDLE))
        k += groups[-1]
    return groups + ([tail] if tail else [])


def leading(modes: Sequence[int], limit: int) -> int:
    """The number of leading modes whose product is at most `limit`; at least one."""
    count, size = 1, modes[0]
    while count < len(modes) and size * modes[count] <= limit:
        size *= modes[count]
        count += 1
    return count


def merge(train: Train, groups: Sequence[int]) -> Train:
    """Return the same train with merged neighbouring modes: groups[k] cores become core k.

    >>> from pctt.tt.train import identity
    >>> merge(identity([2, 3, 4, 5]), [2, 1, 1]).rows
    (6, 4, 5)
    """
    if sum(groups) != len(train) or min(groups) < 1:
        raise ValueError(f"groups {list(groups)} do not divide a train of {len(train)} cores")
    cores, start = [], 0
    for count in groups:
        core = train.cores[start]
        for other in train.cores[start + 1 : start + count]:
            core = _join(core, other)
        cores.append(core)
        start += count
    return Train(cores)


def _join(a: Array, b: Array) -> Array:
    """The core of two merged modes."""
    core = np.tensordot(a, b, 1)
    if a.ndim == 3:
        return core.reshape(a.shape[0], -1, b.shape[-1])
    core = core.transpose(0, 1, 3, 2, 4, 5)
    return core.reshape(a.shape[0], a.shape[1] * b.shape[1], a.shape[2] * b.shape[2], b.shape[-1])


class GridDigits:
    """The digits of a grid of shape (n_1, ..., n_D). Its points are numbered like the entries of a numpy array.

    block : unknowns per point, the fastest digit of a row

    modes : modes of the train, the same for rows and columns
    padded : shape of the grid that the digits fill; its rows, numbered in the same way, are the slots of the train
    size : number of slots

    >>> GridDigits((8, 6)).modes
    (2, 2, 2, 3, 2)
    """

    def __init__(self, shape: Sequence[int], block: int = 1) -> None:
        self.shape, self.block = tuple(int(n) for n in shape), int(block)
        if min((*self.shape, self.block)) < 1:
            raise ValueError(f"a grid of shape {self.shape} with blocks of {self.block}; allowed are numbers >= 1")
        axes = [bases(n) for n in self.shape]
        self.padded = tuple(prod(digits) for digits in axes)
        self.modes = scalar_modes([base for digits in axes for base in digits] or [1], self.block)
        self.size = slots_of(self.modes)
        if self.size >= 2**31:
            raise ValueError(f"too many points for a train: a grid of shape {self.shape}")
        # for each mode, the contribution of a pair of digits to row * size + column
        widths = np.cumprod([1, *self.modes[::-1]], dtype=np.int64)[-2::-1]
        digits = [np.arange(m) * width for m, width in zip(self.modes, widths)]
        self._pairs = [np.add.outer(digit * self.size, digit).ravel() for digit in digits]
        self._squares = widths**2

    @property
    def rows(self) -> int:
        """Number of rows of the matrix, without padded rows."""
        return prod(self.shape) * self.block

    @property
    def places(self) -> Array:
        """(rows,) the slot of each row."""
        return np.arange(self.size).reshape(*self.padded, self.block)[tuple(map(slice, self.shape))].ravel()

    def key(self, row: Array, column: Array) -> Array:
        """Keys of pairs of points with coordinates (D + 1, ...); the last coordinate is the unknown in the block."""
        row, column = (np.ravel_multi_index(tuple(x), (*self.padded, self.block)) for x in (row, column))
        return pair_keys(row, column, self.modes)

    def pair(self, keys: Array) -> Array:
        """row * size + column of the slots with these `pair_keys`.

        If keys share no digit, the pair of their sum is the sum of their pairs.
        """
        pair = np.zeros(keys.shape, np.int64)
        for table, square in zip(self._pairs, self._squares):
            digit, keys = np.divmod(keys, square)
            pair += table[digit]
        return pair

    def within(self, slots: Array) -> tuple[Array, Array]:
        """The rows of the matrix at slots, and a mask of those that exist; the other numbers mean nothing."""
        inside = np.ones(slots.shape, bool)
        if self.padded == self.shape:
            return slots, inside
        *coordinates, inner = np.unravel_index(slots, (*self.padded, self.block))
        row = np.zeros(slots.shape, np.int64)
        for c, n in zip(coordinates, self.shape):
            inside &= c < n
            row = row * n + c
        return row * self.block + inner, inside


def pair_keys(rows: Array | int, columns: Array | int, modes: Sequence[int]) -> Array:
    """One number for each pair of slots, with the digits i_k m_k + j_k of base m_k^2; the first is most significant.

    >>> pair_keys(np.array([0, 5]), 3, [2, 4])
    array([ 3, 39])
    """
    if float(slots_of(modes)) ** 2 >= 2.0**63:
        raise ValueError(f"too many slots for one key of 64 bits: modes {list(modes)}")
    key = np.zeros(1, np.int64)
    i, j = (np.unravel_index(np.asarray(x), modes) for x in (rows, columns))
    for m, row, column in zip(modes, i, j):
        key = key * (m * m) + row * m + column
    return key


def bases(n: int) -> list[int]:
    """Bases of the digits of 0, ..., n - 1: primes up to 7, largest first, with the least product that is at least n.

    >>> bases(64), bases(100), bases(97), bases(1)
    ([2, 2, 2, 2, 2, 2], [5, 5, 2, 2], [7, 7, 2], [])
    """
    while True:
        rest = n
        found: list[int] = []
        for p in (2, 3, 5, 7):
            while rest % p == 0:
                rest //= p
                found.insert(0, p)
        if rest == 1:
            return found
        n += 1
