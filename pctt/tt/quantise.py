"""Modes of a long vector: the division of its index into digits, the padding, and the merging of neighbouring modes.

A vector has n *slots*, blocks of `block` unknowns each (a contact, a node, a body). Its modes m_1, ..., m_d satisfy
m_1 m_2 ... m_d >= n. The last mode is the leaf, a run of neighbouring slots that no bond separates. The scalar modes of
a train are the slot modes, with the leaf multiplied by the block size. Slots keep their order.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import prod

import numpy as np

from pctt.tt.train import Array, Train

FIRST, MIDDLE = 64, 4  # the largest first mode, and the modes between the first and the last


def choose_modes(n: int, leaf: int = 16) -> tuple[int, ...]:
    """Slot modes [first, MIDDLE, ..., MIDDLE, last] for n slots.

    The first mode is at most FIRST. The last is the number between `leaf` and 5/4 `leaf` with the least padding. A
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
    while n > FIRST * MIDDLE**levels * leaf:
        levels += 1
    best: tuple[int, ...] = ()
    for last in range(leaf, leaf + leaf // 4 + 1):
        below = last * MIDDLE**levels
        candidate = (-(-n // below), *[MIDDLE] * levels, last)
        if not best or slots_of(candidate) < slots_of(best):
            best = candidate
    return best


def slots_of(modes: Sequence[int]) -> int:
    """The number of slots (or scalars) that modes hold: their product."""
    return prod(map(int, modes))


def scalar_modes(modes: Sequence[int], block: int) -> tuple[int, ...]:
    """Modes of the unknowns; the leaf has `block` unknowns per slot.

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
    """The same train with merged neighbouring modes: groups[k] cores become core k.

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
