"""Names of the array types of this package, arrays given by a rule, and where values are among those of an array."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any, Union

import numpy as np
from numpy.typing import NDArray

from dem.compiled import inlined, loop

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]

#: Keys of contacts: two whole numbers below 2^53 as one complex number, of which numpy finds, sorts and compares pairs.
Keys = NDArray[np.complex128]


class Rule:
    """An array (count, ...) whose rows are made when they are asked for, as ``rule[a:b]``, and not kept.

    >>> squares = Rule(1000, lambda first, end: np.arange(float(first), float(end)) ** 2)
    >>> squares[3:6]
    array([ 9., 16., 25.])
    """

    CHUNK = 2**17  #: rows that are made at a time where all are needed one after another

    def __init__(self, count: int, make: Callable[[int, int], Floats]):
        """``make(a, b)`` gives the rows from a on and before b. A row must not depend on which others are asked for."""
        self._count, self._make = count, make

    def __len__(self) -> int:
        return self._count

    def __getitem__(self, index: Any) -> Floats:
        """The rows of a slice; whatever else an array allows takes the whole one."""
        if isinstance(index, slice) and index.step is None:
            first, end, _ = index.indices(self._count)
            return self._make(first, max(first, end))
        return self[:][index]

    def __array__(self, dtype: Any = None, copy: Any = None) -> np.ndarray:
        return np.asarray(self[:], dtype)

    def chunks(self) -> Iterator[tuple[int, Floats]]:
        """The first rows of parts that follow each other, and the parts."""
        for first in range(0, self._count, self.CHUNK):
            yield first, self[first : first + self.CHUNK]


def frozen(array: np.ndarray) -> np.ndarray:
    """The array, which nobody can write to from now on."""
    array.flags.writeable = False
    return array


class Tabular:
    """A table whose fields are arrays (n,) or (n, parts): ``dict(table)`` has a column (n,) for each part, and so has
    ``pandas.DataFrame(dict(table))``."""

    def __repr__(self) -> str:
        return f"<{type(self).__name__}: {len(next(iter(self.flat().values())))} rows of {', '.join(self.keys())}>"

    def keys(self) -> list[str]:
        """The names of the columns."""
        return list(self.flat())

    def __getitem__(self, name: str) -> np.ndarray:
        return self.flat()[name]

    def flat(self) -> dict[str, np.ndarray]:
        """The columns (n,) by name; parts of vectors have x, y, z behind the name, others a number."""
        found = {}
        for name, array in vars(self).items():
            for k, column in enumerate(array.T if array.ndim == 2 else [array]):
                end = "" if array.ndim == 1 else f"_{'xyz'[k]}" if array.shape[1] == 3 else f"_{k}"
                found[name + end] = column
        return found


#: Anything that a user may pass where numbers are expected.
ArrayLike = Union[float, Sequence[float], Sequence[Sequence[float]], Floats, Rule]

#: The lower and the upper corner of a box [m].
Corners = tuple[tuple[float, float, float], tuple[float, float, float]]


@inlined
def mixed(key):
    """A hash of 64 bits of a key, of which the first bits are the best."""
    one = np.uint64(key.real) * np.uint64(0x9E3779B97F4A7C15)
    return ((one ^ (one >> np.uint64(32))) + np.uint64(key.imag)) * np.uint64(0xD1B54A32D192ED03)


@loop
def places(keys: Keys, asked: Keys) -> Ints:
    """Where the keys `asked` (m,) are among others (n,), -1 for those that are not there; both are distinct ones.

    Most are where they are to be if both have the same order but for a few that came or went: each is sought behind the
    last one found, the further the more were sought in vain. What is left of both meets in a hash table with open
    addresses: a third of the time of sorting."""
    out, taken = np.empty(len(asked), np.int64), np.zeros(len(keys), np.bool_)
    out[:] = -1
    start, ahead, left, rest = 0, 4, 2 * len(keys), len(keys)
    for n in range(len(asked)):
        end = min(start + min(ahead, left), len(keys))
        k = start
        while k < end and keys[k] != asked[n]:
            k += 1
        if k < end:
            out[n], taken[k], start, ahead, rest = k, True, k + 1, 4, rest - 1
        else:
            left, ahead = left - (end - start), 2 * ahead
    bits = 4
    while (1 << bits) < 2 * rest:
        bits += 1
    table, shift, last = np.empty(1 << bits, np.int64), np.uint64(64 - bits), (1 << bits) - 1
    table[:] = -1
    for n in range(len(keys)):
        if not taken[n]:
            slot = np.int64(mixed(keys[n]) >> shift)
            while table[slot] >= 0:
                slot = (slot + 1) & last
            table[slot] = n
    for n in range(len(asked)):
        if out[n] < 0:
            slot = np.int64(mixed(asked[n]) >> shift)
            while table[slot] >= 0 and keys[table[slot]] != asked[n]:
                slot = (slot + 1) & last
            out[n] = table[slot]
    return out
