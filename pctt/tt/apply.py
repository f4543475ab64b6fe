"""Fast product of a matrix train with full vectors.

The vector is contracted with one core after the other, beginning with the first mode. The first core turns the vector,
as a matrix x (m_1, n / m_1), into z (i_1, b, rest). For every i_1 the other cores act on a block (b, rest) that stays
in the cache. Each does this as a batch of small matrix products

    z (i_1 ... i_{k-1}; b_{k-1} j_k; rest)  ->  (i_1 ... i_{k-1} i_k; b_k; rest),

without a transposition. A core of mode m between the ranks r and r' costs 2 n r m r' operations. If the rank between
two cores is large, one core for both modes costs less. So cores are merged such that the sum of the costs is least
(`cheapest_groups`). Single precision takes half the seconds.

With several processes each owns a range of rows and computes only these: its share of the boxes i_1. It needs all of x,
because every box of a train couples with every other box. The caller of `product` gathers x.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import prod

import numpy as np

from pctt.tt.quantise import leading, merge, slots_of
from pctt.tt.train import Array, Train


class Apply:
    """The product y = T x, or its rows `start` to `stop - 1`, for vectors of n <= size entries (padded with zeros).

    train : square matrix train; `set_train` takes another train with the same modes
    n : length of the vectors
    rows : the range (start, stop) of rows that this rank owns, by default all rows

    flops : floating-point operations of a product

    >>> from pctt.tt.train import random
    >>> T = random([3, 2, 4], 5, [3, 2, 4])
    >>> x = np.arange(22.0)
    >>> bool(np.allclose(Apply(T, 22)(x), T.full()[:22, :22] @ x))
    True
    """

    def __init__(self, train: Train, n: int | None = None, rows: tuple[int, int] | None = None) -> None:
        size = slots_of(train.columns)
        self.n = size if n is None else n
        self.rows = (0, self.n) if rows is None else rows
        self.dtype = train.dtype
        self.x = np.zeros(size, self.dtype)
        self.set_train(train)

    def set_train(self, train: Train) -> None:
        """Take another train with the same modes."""
        train = merge(train, cheapest_groups(train.rows, train.ranks))
        first, *middle, last = [core.astype(self.dtype) for core in train.cores] + [
            np.ones((1, 1, 1, 1), self.dtype) for _ in range(2 - len(train))
        ]
        self._first = np.ascontiguousarray(first[0].transpose(0, 2, 1))  # (i, b, j)
        self._middle = [
            np.ascontiguousarray(core.transpose(1, 3, 0, 2)).reshape(core.shape[1] * core.shape[3], -1)
            for core in middle
        ]  # (i b', b j)
        self._last = np.ascontiguousarray(last[..., 0].transpose(0, 2, 1)).reshape(-1, last.shape[1])  # (b j, i)
        self._allocate(train.rows[1:] or (1,))

    def _allocate(self, modes: Sequence[int]) -> None:
        """Allocate work arrays for boxes of the given modes, and views of them in the shapes of every step."""
        boxes, rank, _ = self._first.shape
        box = slots_of(modes)
        start, stop = self.rows
        self._boxes = range(start // box, max(start // box, -(-stop // box)))
        self._y = np.empty(len(self._boxes) * box, self.dtype)
        at_a_time = 1 << 22  # bytes of the first intermediate result
        chunk = max(1, min(len(self._boxes), at_a_time // (rank * box * self.dtype.itemsize)))
        z = np.empty((chunk, rank, box), self.dtype)
        ranks = [rank] + [len(W) // m for W, m in zip(self._middle, modes)]
        work = [np.empty(box * max(ranks), self.dtype) for _ in range(2)]

        self._x_boxes = self.x.reshape(boxes, box)
        self._z = z.reshape(chunk * rank, box)
        shapes = [
            (slots_of(modes[:k]), r * m, slots_of(modes[k + 1 :])) for k, (r, m) in enumerate(zip(ranks, modes))
        ]  # shapes of the inputs of the cores
        self._inputs = [part.reshape(shapes[0] if self._middle else shapes[0][:2]) for part in z]
        self._steps: list[tuple[Array, Array, Array]] = []  # (matrix, its product, the product as input of the next)
        for k, W in enumerate(self._middle):
            count, _, rest = shapes[k]
            flat = work[k % 2][: count * len(W) * rest]
            following = shapes[k + 1] if k + 1 < len(self._middle) else shapes[k + 1][:2]
            self._steps.append((W, flat.reshape(count, len(W), rest), flat.reshape(following)))
        self._outputs = list(self._y.reshape(len(self._boxes), box // modes[-1], modes[-1]))
        per_box = rank * len(self.x) + sum(product.size * matrix.shape[1] for matrix, product, _ in self._steps)
        self.flops = 2 * len(self._boxes) * (per_box + box * len(self._last))

    def __call__(self, x: Array) -> Array:
        """This rank's rows of T x, from the whole x."""
        self.x[: self.n] = x
        return self.product().astype(np.result_type(x), copy=True)

    def product(self) -> Array:
        """This rank's rows of T x; the caller has put the whole x into `self.x[:n]`. Valid until the next call."""
        chunk = len(self._inputs)
        for first in range(0, len(self._boxes), chunk):
            count = min(chunk, len(self._boxes) - first)
            W = self._first[self._boxes[first] :][:count].reshape(count * self._first.shape[1], -1)
            np.matmul(W, self._x_boxes, out=self._z[: len(W)])
            for z, y in zip(self._inputs, self._outputs[first : first + count]):
                for matrix, product, following in self._steps:
                    np.matmul(matrix, z, out=product)
                    z = following
                np.matmul(z, self._last, out=y)
        start = self.rows[0] - self._boxes.start * self._x_boxes.shape[1]
        return self._y[start : start + self.rows[1] - self.rows[0]]


def cheapest_groups(modes: Sequence[int], ranks: Sequence[int]) -> list[int]:
    """The numbers of neighbouring cores to merge into one for the least work per number of a vector.

    The train has these modes and ranks (r_0, ..., r_d). A core of mode m takes r m r' multiplications, and the time of
    64 to write and read each of the r' numbers that it hands to the next core. The first core has at least 32 rows, the
    boxes that the processes share, if the modes allow it, and no merged core has more than 256.

    >>> cheapest_groups([2] * 12, [1, 4, 8, 8, 8, 4, 4, 4, 8, 8, 8, 4, 1])
    [6, 6]
    >>> cheapest_groups([2] * 18, [1, 4, *[16] * 15, 4, 1])
    [6, 2, 2, 2, 6]
    """
    d = len(modes)
    best: list[tuple[float, list[int]]] = [(0.0, [])] * (d + 1)  # work and groups of the cores from k on
    for k in range(d - 1, -1, -1):
        stops = list(range(k + 1, k + 1 + leading(modes[k:], 256)))
        if k == 0:
            stops = [stop for stop in stops if prod(modes[:stop]) >= 32] or stops[-1:]
        best[k] = min(
            (ranks[stop] * (ranks[k] * prod(modes[k:stop]) + 64) + best[stop][0], [stop - k, *best[stop][1]])
            for stop in stops
        )
    return best[0][1]
