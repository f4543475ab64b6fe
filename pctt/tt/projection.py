"""Equations S x = B between the interfaces of trains; alternating methods solve them core after core."""

from __future__ import annotations

import numpy as np
from scipy import linalg

from pctt.tt.train import Array, Train, random


class Projection:
    """y' S x and y' B, contracted over the cores before and after the present core k.

    y and x are trains of matrices; S does not act on their columns.

    left[k], right[k] : y' S x over the cores before and after k, (c, R, a) and (c', R', a')
    left_B[k], right_B[k] : y' B over the same cores, (c, R) and (c', R')
    """

    def __init__(self, S: Train, B: Train | None, length: int) -> None:
        self.S = S.cores
        self.B = None if B is None else B.cores
        one, one_B = np.ones((1, 1, 1)), np.ones((1, 1))
        self.left, self.right = [one] * (length + 1), [one] * length
        self.left_B, self.right_B = [one_B] * (length + 1), [one_B] * length

    @classmethod
    def around(cls, S: Train, B: Train | None, y: list[Array], x: list[Array]) -> Projection:
        """A projection for the first core: everything right of it is contracted."""
        new = cls(S, B, len(x))
        for k in range(len(x) - 1, 0, -1):
            new.step(k, -1, y[k], x[k])
        return new

    def step(self, k: int, direction: int, y: Array, x: Array) -> None:
        """Contract core k too: into the left interface (``direction`` 1) or into the right one (-1)."""
        if direction > 0:
            T = np.tensordot(self.left[k], x, (2, 0))  # (c, R, i', j, b)
            T = np.tensordot(self.S[k], T, ((0, 2), (1, 2)))  # (i, R', c, j, b)
            self.left[k + 1] = np.tensordot(y, T, ((0, 1, 2), (2, 0, 3)))
        else:
            T = np.tensordot(x, self.right[k], (3, 2))  # (a, i', j, c, R)
            T = np.tensordot(self.S[k], T, ((2, 3), (1, 4)))  # (R, i, a, j, c)
            self.right[k - 1] = np.tensordot(y, T, ((1, 2, 3), (1, 3, 4)))
        if self.B is not None and direction > 0:
            self.left_B[k + 1] = np.tensordot(y, np.tensordot(self.left_B[k], self.B[k], 1), ((0, 1, 2), (0, 1, 2)))
        elif self.B is not None:
            T = np.tensordot(self.B[k], self.right_B[k], (3, 1))  # (R, i, j, c)
            self.right_B[k - 1] = np.tensordot(y, T, ((1, 2, 3), (1, 2, 3)))

    def matrix(self, k: int) -> Array:
        """M = P' S P (a m b, a m b), symmetric, for y = x; P are the interfaces around core k."""
        S, left, right = self.S[k], self.left[k], self.right[k]
        T = np.tensordot(np.tensordot(left, S, (1, 0)), right, (4, 1))  # (a, a', i, i', b, b')
        n = left.shape[0] * S.shape[1] * right.shape[0]
        M = T.transpose(0, 2, 4, 1, 3, 5).reshape(n, n)
        return 0.5 * (M + M.T)

    def times(self, k: int, x: Array) -> Array:
        """M x for x (a, m, n, b), without forming M."""
        return local_product(self.left[k], self.S[k], self.right[k], x)

    def diagonal(self, k: int) -> Array:
        """Diagonal of M, (a, m, 1, b)."""
        left = np.diagonal(self.left[k], axis1=0, axis2=2)  # (R, a)
        middle = np.diagonal(self.S[k], axis1=1, axis2=2)  # (R, R', m)
        right = np.diagonal(self.right[k], axis1=0, axis2=2)  # (R', b)
        T = np.tensordot(np.tensordot(left, middle, (0, 0)), right, (1, 0))  # (a, m, b)
        return T[:, :, None, :]

    def right_side(self, k: int) -> Array:
        """P' B (a, m, n, b)."""
        return self._of_B(k, self.left_B[k], self.right_B[k])

    def rest(self, k: int, x: Array) -> Array:
        """P' (B - S x) between the interfaces of this projection, for the core x."""
        return self.right_side(k) - self.times(k, x)

    def rest_left(self, other: Projection, k: int, x: Array) -> Array:
        """The same with the interfaces of this projection on the left and those of another one on the right."""
        return self._of_B(k, self.left_B[k], other.right_B[k]) - local_product(
            self.left[k], self.S[k], other.right[k], x
        )

    def _of_B(self, k: int, left: Array, right: Array) -> Array:
        assert self.B is not None
        return np.tensordot(np.tensordot(left, self.B[k], 1), right, (3, 1))


def local_product(left: Array, S: Array, right: Array, x: Array) -> Array:
    """The product of left (a, R, a'), S (R, i, j, R') and right (b, R', b') with x (a', j, n, b')."""
    T = np.tensordot(left, x, 1)  # (a, R, j, n, b')
    T = np.tensordot(T, S, ((1, 2), (0, 2)))  # (a, n, b', i, R')
    return np.tensordot(T, right, ((2, 4), (2, 1))).transpose(0, 2, 1, 3)  # (a, i, n, b)


def columns(x: Array) -> Array:
    """A core (a, ..., b) with orthonormal columns that span those of the given core."""
    return np.linalg.qr(x.reshape(-1, x.shape[-1]))[0].reshape(*x.shape[:-1], -1)


def rows(x: Array) -> Array:
    """A core (a, ..., b) with orthonormal rows that span those of the given core."""
    Q = np.linalg.qr(x.reshape(len(x), -1).T)[0]
    return np.ascontiguousarray(Q.T).reshape(-1, *x.shape[1:])


def lowest(X: Train) -> float:
    """Return an upper bound of the least eigenvalue of a symmetric X; a negative value proves that X is not positive
    definite.

    It is the least v'Xv / v'v that an alternating search over trains v finds. Their rank is 8, or 4 with modes above
    8, which cost more.

    >>> from pctt.tt.train import identity
    >>> round(lowest(identity([4, 4, 4])), 12)
    1.0
    """
    rank = 8 if max(X.rows) <= 8 else 4
    v = list(random(X.rows, rank, [1] * len(X)).right_orthogonal().cores)
    galerkin = Projection.around(X, None, v, v)
    value = np.inf

    def lowest_core(k: int) -> Array:
        nonlocal value
        w, y = linalg.eigh(galerkin.matrix(k), subset_by_index=[0, 0], check_finite=False)
        value = float(w[0])
        return y.reshape(len(galerkin.left[k]), -1, 1, len(galerkin.right[k]))

    for _ in range(4):
        before = value
        for k in range(len(v) - 1):
            v[k] = columns(lowest_core(k))
            galerkin.step(k, 1, v[k], v[k])
        for k in range(len(v) - 1, 0, -1):
            v[k] = rows(lowest_core(k))
            galerkin.step(k, -1, v[k], v[k])
        lowest_core(0)
        if value < 0 or abs(value - before) <= 1e-3 * abs(value):
            break
    return value
