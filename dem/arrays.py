"""Names of the array types of this package, and where values are among those of an array."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Union

import numpy as np
from numpy.typing import NDArray

from dem.compiled import loop

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]

#: Anything that a user may pass where numbers are expected.
ArrayLike = Union[float, Sequence[float], Sequence[Sequence[float]], Floats]

#: The lower and the upper corner of a box [m].
Corners = tuple[tuple[float, float, float], tuple[float, float, float]]


@loop
def places(keys: Ints, asked: Ints) -> Ints:
    """Where the keys `asked` (m,) are among distinct ones (n,), -1 for those that are not there. A hash table with open
    addresses: a third of the time of sorting."""
    bits = 4
    while (1 << bits) < 2 * len(keys):
        bits += 1
    table, shift, last = np.full(1 << bits, -1, np.int32), np.uint64(64 - bits), (1 << bits) - 1
    for n in range(len(keys)):
        # Fibonacci hashing: the low bits of keys are mostly zero
        slot = np.int64((np.uint64(keys[n]) * np.uint64(0x9E3779B97F4A7C15)) >> shift)
        while table[slot] >= 0:
            slot = (slot + 1) & last
        table[slot] = n
    out = np.empty(len(asked), np.int64)
    for n in range(len(asked)):
        slot = np.int64((np.uint64(asked[n]) * np.uint64(0x9E3779B97F4A7C15)) >> shift)
        while table[slot] >= 0 and keys[table[slot]] != asked[n]:
            slot = (slot + 1) & last
        out[n] = table[slot]
    return out
