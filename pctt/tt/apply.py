"""Fast product of a matrix train with full vectors.

The vector is contracted with one core after the other, the first mode first. Seen as x (m_1, n / m_1), the
first core turns it into z (i_1, b, rest); for every i_1 the remaining cores act on a block (b, rest) that
stays in the cache, each as a batch of small matrix products

    z (i_1 ... i_{k-1}; b_{k-1} j_k; rest)  ->  (i_1 ... i_{k-1} i_k; b_k; rest),

in which nothing is transposed. Two work arrays are reused. A core of mode m between ranks r and r' costs 2 n r m r'
operations, nearly all of them in large matrix products. Where ranks bulge between two cores, one core for both modes
costs less: cores are merged so that the sum is least (`cheapest_groups`). Single precision takes half the seconds.

On several ranks each owns a range of rows and computes only these: its share of the boxes i_1, wholly local.
It needs all of x, because every box of a train couples with every other; n numbers gathered once are the
least that any exchange costs (reducing the z of each rank's own columns would send r n). Who calls `product` has
gathered it.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import prod

import numpy as np

from pctt.tt.quantise import leading, merge, slots_of
from pctt.tt.train import Array, Train

WORK = 1 << 22  # bytes of the first intermediate that are made at a time
FIRST, MOST = 32, 256  # rows of the first core, at least, and of any that is merged, at most
WORD = 64  # multiplications in the seconds that a number takes to be written and read again


class Apply:
    """Product y = T x, or the rows `start` to `stop` of it, for vectors of n <= size entries (padded with zeros).

    train : square matrix train; `set_train` takes another one of the same modes
    n : length of the vectors
    rows : the rows (start, stop) that this rank owns, by default all

    >>> from pctt.tt.train import random
    >>> T = random([3, 2, 4], 5, [3, 2, 4])
    >>> x = np.arange(22.0)
    >>> bool(np.allclose(Apply(T, 22)(x), T.full()[:22, :22] @ x))
    True
    """

    def __init__(
        self,
        train: Train,
        n: int | None = None,
        rows: tuple[int, int] | None = None,
    ) -> None:
        size = slots_of(train.columns)
        self.n = size if n is None else n
        self.rows = (0, self.n) if rows is None else rows
        self.dtype = train.dtype
        self.x = np.zeros(size, self.dtype)
        self.set_train(train)

    def set_train(self, train: Train) -> None:
        """Another train of the same modes."""
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
        """Work arrays, and views of them in the shapes of every step, for boxes of the given modes."""
        boxes, rank, _ = self._first.shape
        box = slots_of(modes)
        start, stop = self.rows
        self._boxes = range(start // box, max(start // box, -(-stop // box)))
        self._y = np.empty(len(self._boxes) * box, self.dtype)
        chunk = max(1, min(len(self._boxes), WORK // (rank * box * self.dtype.itemsize)))
        z = np.empty((chunk, rank, box), self.dtype)
        ranks = [rank] + [len(W) // m for W, m in zip(self._middle, modes)]
        work = [np.empty(box * max(ranks), self.dtype) for _ in range(2)]

        self._x_boxes = self.x.reshape(boxes, box)
        self._z = z.reshape(chunk * rank, box)
        shapes = [
            (slots_of(modes[:k]), r * m, slots_of(modes[k + 1 :])) for k, (r, m) in enumerate(zip(ranks, modes))
        ]  # what a core is applied to
        self._inputs = [part.reshape(shapes[0] if self._middle else shapes[0][:2]) for part in z]
        self._steps: list[tuple[Array, Array, Array]] = []  # (matrix, its product, the same seen by the next)
        for k, W in enumerate(self._middle):
            count, _, rest = shapes[k]
            flat = work[k % 2][: count * len(W) * rest]
            following = shapes[k + 1] if k + 1 < len(self._middle) else shapes[k + 1][:2]
            self._steps.append((W, flat.reshape(count, len(W), rest), flat.reshape(following)))
        self._outputs = list(self._y.reshape(len(self._boxes), box // modes[-1], modes[-1]))

    def __call__(self, x: Array, out: Array | None = None) -> Array:
        """My rows of T x, for the whole x."""
        self.x[: self.n] = x
        y = self.product()
        if out is None:
            return y.astype(np.result_type(x), copy=True)
        out[:] = y
        return out

    def product(self) -> Array:
        """My rows of T x for the whole x that the caller has put into `self.x[:n]`; valid until the next call."""
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
    """How many neighbouring cores of a train of these modes and ranks (r_0, ..., r_d) to merge into one, for the least
    work per number of a vector: a core of mode m takes r m r' multiplications, and WORD for each of the r' numbers that
    it hands on. The first core has at least FIRST rows where the modes allow it: boxes, which ranks share.

    >>> cheapest_groups([2] * 12, [1, 4, 8, 8, 8, 4, 4, 4, 8, 8, 8, 4, 1])
    [6, 6]
    >>> cheapest_groups([2] * 18, [1, 4, *[16] * 15, 4, 1])
    [6, 2, 2, 2, 6]
    """
    d = len(modes)
    best: list[tuple[float, list[int]]] = [(0.0, [])] * (d + 1)  # of the cores from k on
    for k in range(d - 1, -1, -1):
        stops = list(range(k + 1, k + 1 + leading(modes[k:], MOST)))
        if k == 0:
            stops = [stop for stop in stops if prod(modes[:stop]) >= FIRST] or stops[-1:]
        best[k] = min(
            (ranks[stop] * (ranks[k] * prod(modes[k:stop]) + WORD) + best[stop][0], [stop - k, *best[stop][1]])
            for stop in stops
        )
    return best[0][1]
