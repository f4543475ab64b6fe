"""A count of operations with a limit, so that a set-up ends at the same place in every run."""

from __future__ import annotations

from math import inf, prod

from pctt.tt.apply import cheapest_groups
from pctt.tt.quantise import merge
from pctt.tt.train import Array, Train

# An operation takes about a nanosecond of one core. The factors below are fits to measured seconds (EPYC, 2026).
CALL = 2e4  # a step in Python on small arrays
ENTRY = 200.0  # an entry of a matrix, from a function of the user
MULTIPLY = 0.05  # a multiplication and an addition within a product of matrices
FACTOR = 0.7  # the same in a singular value decomposition


class TooMuchWorkError(Exception):
    """The limit of the operations is reached; the message says where."""


class Work:
    """Operations that were spent; `spend` raises TooMuchWorkError beyond the limit.

    All ranks must spend the same if the work is collective.
    """

    def __init__(self, limit: float = inf) -> None:
        self.limit, self.spent = limit, 0.0

    def spend(self, operations: float, phase: str) -> None:
        self.spent += operations
        if self.spent > self.limit:
            raise TooMuchWorkError(phase)


def apply_operations(train: Train) -> float:
    """Of a product with a vector."""
    groups = merge(train, cheapest_groups(train.rows, train.ranks))
    each = sum(core.shape[0] * core.shape[1] * core.shape[3] for core in groups.cores)
    return CALL + MULTIPLY * prod(train.rows) * each


def local_operations(left: Array, S: Array, right: Array, x: Array) -> float:
    """Of `pctt.tt.projection.local_product`."""
    a, R, b = left.shape
    _, i, j, R_ = S.shape
    c, _, d = right.shape
    n = x.shape[2]
    return CALL + MULTIPLY * n * (a * R * b * j * d + a * d * R * j * i * R_ + a * i * R_ * d * c)


def svd_operations(rows: int, columns: int) -> float:
    """Of a thin singular value decomposition."""
    return CALL + FACTOR * rows * columns * min(rows, columns)


def inner_operations(S: Train, X: Train, high: int) -> float:
    """Of ||B - S X||; with a product of the ranks above `high` it is an estimate from few products."""
    ranks = [min(s * x, high) for s, x in zip(S.ranks, X.ranks)]
    squares = [m * m for m in S.rows]
    return CALL + MULTIPLY * sum(3 * a * n * b * max(a, b) for a, n, b in zip(ranks, squares, ranks[1:]))
