"""Tensor trains of vectors (tensors) and matrices.

A train represents the entries of a tensor with modes n_1, ..., n_d as products of small matrices,

    T(i_1, ..., i_d) = G_1(i_1) G_2(i_2) ... G_d(i_d),      G_k(i_k) of shape (r_{k-1}, r_k),  r_0 = r_d = 1

(Oseledets, "Tensor-train decomposition", SIAM J. Sci. Comput. 33, 2011). The train of a matrix has the entries A(i, j)
with i = (i_1, ..., i_d) and j = (j_1, ..., j_d). Its k-th core has the pair (i_k, j_k). Linear indices and
multi-indices are related as in numpy's C order: the first mode is slowest.

>>> x, y, z = np.ogrid[0:1:4j, 0:1:5j, 0:1:6j]
>>> train = decompose(np.sin(x + y + z), eps=1e-12)
>>> train.ranks
(1, 2, 2, 1)
>>> bool(abs(train.full() - np.sin(x + y + z)).max() < 1e-13)
True
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from math import prod
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

Array = NDArray[Any]


class Train:
    """A tensor train: its cores, and arithmetic with trains.

    cores : each is (r_{k-1}, n_k, r_k) for a tensor, and (r_{k-1}, m_k, n_k, r_k) for a matrix with row modes m_k and
        column modes n_k. They are not copied, and no method writes to them.

    >>> T = identity([2, 3, 4])
    >>> T
    Train of shape (24, 24), ranks 1-1-1-1, 29 numbers
    >>> (T + T).ranks, (T + T).round().ranks
    ((1, 2, 2, 1), (1, 1, 1, 1))
    >>> (2 * T @ T).norm() == 2 * 24**0.5
    True
    """

    __array_priority__ = 100  # so that numpy scalars leave `scalar * train` to the train

    def __init__(self, cores: Iterable[Array]) -> None:
        self.cores = tuple(cores)
        kind = {core.ndim for core in self.cores}
        if kind != {3} and kind != {4}:
            raise ValueError("a train needs cores that are all (r, n, r') or all (r, m, n, r')")
        ends = [1] + [core.shape[-1] for core in self.cores]
        if [core.shape[0] for core in self.cores] + [1] != ends:
            raise ValueError(f"ranks of neighbouring cores differ: {[core.shape for core in self.cores]}")

    # What it is

    def __len__(self) -> int:
        return len(self.cores)

    @property
    def is_matrix(self) -> bool:
        return self.cores[0].ndim == 4

    @property
    def modes(self) -> tuple[tuple[int, ...], ...]:
        """(n_k,) for every core of a tensor, (m_k, n_k) for a matrix."""
        return tuple(core.shape[1:-1] for core in self.cores)

    @property
    def rows(self) -> tuple[int, ...]:
        """Row modes m_k of a matrix, modes n_k of a tensor."""
        return tuple(core.shape[1] for core in self.cores)

    @property
    def columns(self) -> tuple[int, ...]:
        """Column modes n_k of a matrix."""
        return tuple(core.shape[2] for core in self._matrix().cores)

    @property
    def ranks(self) -> tuple[int, ...]:
        """r_0, ..., r_d."""
        return (1, *(core.shape[-1] for core in self.cores))

    @property
    def dtype(self) -> Any:
        return np.result_type(*self.cores)

    @property
    def shape(self) -> tuple[int, ...]:
        """The shape of `full()`: (n_1, ..., n_d) for a tensor, (prod m_k, prod n_k) for a matrix."""
        return (prod(self.rows), prod(self.columns)) if self.is_matrix else self.rows

    @property
    def storage(self) -> int:
        """How many numbers the cores have."""
        return sum(core.size for core in self.cores)

    def __repr__(self) -> str:
        return f"Train of shape {self.shape}, ranks {'-'.join(map(str, self.ranks))}, {self.storage} numbers"

    # Entries

    def full(self) -> Array:
        """The dense tensor or matrix."""
        out = np.ones((1, 1), self.dtype)
        for core in self.flat():
            out = np.tensordot(out, core, 1).reshape(-1, core.shape[-1])
        if not self.is_matrix:
            return out.reshape(self.rows)
        d = len(self)
        pairs = out.reshape(sum(self.modes, ()))
        return pairs.transpose(*range(0, 2 * d, 2), *range(1, 2 * d, 2)).reshape(self.shape)

    def entries(self, i: ArrayLike, j: ArrayLike | None = None) -> Array:
        """Entries at linear indices i; for a matrix at rows i and columns j (integer arrays of one shape).

        >>> identity([2, 3]).entries([0, 1, 5], [0, 2, 5])
        array([1., 0., 1.])
        """
        i = np.asarray(i)
        digits = np.stack(np.unravel_index(i.ravel(), self.rows))
        if self.is_matrix:
            if j is None:
                raise ValueError("entries of a matrix need rows and columns")
            column_digits = np.stack(np.unravel_index(np.asarray(j).ravel(), self.columns))
            digits = digits * np.array(self.columns)[:, None] + column_digits
        return self.at(digits).reshape(i.shape)

    def at(self, digits: Array) -> Array:
        """Entries at multi-indices (d, p) of the flat cores: i_k for a tensor, i_k n_k + j_k for a matrix."""
        tables = [np.ascontiguousarray(core.transpose(1, 0, 2)) for core in self.flat()]
        out = np.empty(digits.shape[1], self.dtype)
        chunk = 1 << 15  # rows of cores stay in the cache
        for start in range(0, len(out), chunk):
            part = slice(start, start + chunk)
            x = tables[0][digits[0, part]]
            for table, digit in zip(tables[1:], digits[1:]):
                x = x @ table[digit[part]]
            out[part] = x[:, 0, 0]
        return out

    # Arithmetic

    def __add__(self, other: Train) -> Train:
        """Sum; its ranks are the sums of the ranks."""
        if self.modes != other.modes:
            raise ValueError(f"trains of different modes: {self.modes} and {other.modes}")
        last = len(self) - 1
        cores = []
        for k, (a, b) in enumerate(zip(self.cores, other.cores)):
            left, right = len(a) * (k > 0), a.shape[-1] * (k < last)
            core = np.zeros((left + len(b), *a.shape[1:-1], right + b.shape[-1]))
            core[: len(a), ..., : a.shape[-1]] = a
            core[left:, ..., right:] += b
            cores.append(core)
        return Train(cores)

    def __mul__(self, factor: float) -> Train:
        """Product with a number."""
        return Train([factor * self.cores[0], *self.cores[1:]])

    __rmul__ = __mul__

    def __neg__(self) -> Train:
        return self * -1

    def __sub__(self, other: Train) -> Train:
        return self + -other

    def __matmul__(self, other: Train) -> Train:
        """Product of a matrix with a matrix or a vector; its ranks are the products of the ranks."""
        if self.columns != other.rows:
            raise ValueError(f"column modes {self.columns} do not fit row modes {other.rows}")
        cores = []
        for a, b in zip(self.cores, other.cores):
            core = np.tensordot(a, b, (2, 1))  # (r, m, r', s, [n], s')
            order = (0, 3, 1, 4, 2, 5) if other.is_matrix else (0, 3, 1, 2, 4)
            rank, mode, rank_ = (a.shape[0] * b.shape[0], (a.shape[1], *b.shape[2:-1]), a.shape[-1] * b.shape[-1])
            cores.append(core.transpose(order).reshape(rank, *mode, rank_))
        return Train(cores)

    @property
    def T(self) -> Train:
        """Transpose of a matrix."""
        return Train([core.transpose(0, 2, 1, 3) for core in self._matrix().cores])

    def symmetric_part(self, eps: float) -> Train:
        """(T + T') / 2 of a square matrix, rounded to eps. It approximates a symmetric matrix at least as well as T."""
        return (0.5 * (self + self.T)).round(eps)

    def astype(self, dtype: DTypeLike) -> Train:
        return Train([core.astype(dtype) for core in self.cores])

    def inner(self, other: Train) -> float:
        """Sum of the products of the entries; trace(A' B) for matrices."""
        gram = np.ones((1, 1))
        for a, b in zip(self.flat(), other.flat()):
            gram = np.tensordot(a, np.tensordot(gram, b, 1), ((0, 1), (0, 1)))
        return float(gram[0, 0])

    def norm(self) -> float:
        """Frobenius norm, from orthogonal cores, so that the norm of a difference is as accurate as its terms."""
        return float(np.linalg.norm(self.left_orthogonal().cores[-1]))

    # Orthogonal cores and rounding

    def left_orthogonal(self) -> Train:
        """The same train; all cores except the last, as matrices (r n, r'), have orthonormal columns."""
        cores = self.flat()
        for k in range(len(cores) - 1):
            a, n, b = cores[k].shape
            Q, R = np.linalg.qr(cores[k].reshape(a * n, b))
            cores[k] = Q.reshape(a, n, -1)
            cores[k + 1] = np.tensordot(R, cores[k + 1], 1)
        return self._like(cores)

    def right_orthogonal(self) -> Train:
        """The same train; all cores except the first, as matrices (r, n r'), have orthonormal rows."""
        cores = self.flat()
        for k in range(len(cores) - 1, 0, -1):
            a, n, b = cores[k].shape
            Q, R = np.linalg.qr(cores[k].reshape(a, n * b).T)
            cores[k] = Q.T.reshape(-1, n, b)
            cores[k - 1] = np.tensordot(cores[k - 1], R.T, 1)
        return self._like(cores)

    def round(self, eps: float = 1e-14, max_rank: int | None = None) -> Train:
        """A train with the least ranks, at most `max_rank`, within eps times the norm (quasi-optimal).

        The cores of the result are left-orthogonal.
        """
        cores = self.right_orthogonal().flat()
        delta = eps * float(np.linalg.norm(cores[0])) / max(1, len(cores) - 1) ** 0.5
        for k in range(len(cores) - 1):
            a, n, b = cores[k].shape
            U, V = low_rank(cores[k].reshape(a * n, b), delta, max_rank)
            cores[k] = U.reshape(a, n, -1)
            cores[k + 1] = np.tensordot(V, cores[k + 1], 1)
        return self._like(cores)

    # Helpers

    def flat(self) -> list[Array]:
        """Cores (r, n, r') with one mode each; a matrix has (m_k, n_k) as one mode."""
        return [core.reshape(core.shape[0], -1, core.shape[-1]) for core in self.cores]

    def _like(self, cores: Iterable[Array]) -> Train:
        """A train with the modes of this one and with these cores (r, n, r')."""
        return Train(core.reshape(core.shape[0], *mode, core.shape[-1]) for core, mode in zip(cores, self.modes))

    def _matrix(self) -> Train:
        if not self.is_matrix:
            raise ValueError("this is a train of a vector, not of a matrix")
        return self


def decompose(
    tensor: ArrayLike, eps: float = 1e-12, max_rank: int | None = None, modes: Sequence[int] | None = None
) -> Train:
    """Return a train of a dense tensor with an error of at most eps times its norm: Algorithm 1 of the paper (TT-SVD).

    modes : the tensor is reshaped to these modes first (this quantises a vector).

    >>> decompose(np.arange(64.0), modes=[4, 4, 4]).ranks
    (1, 2, 2, 1)
    """
    tensor = np.asarray(tensor, float)
    shape = tensor.shape if modes is None else tuple(modes)
    delta = eps * float(np.linalg.norm(tensor)) / max(1, len(shape) - 1) ** 0.5
    rest = tensor.reshape(1, -1)
    cores = []
    for n in shape[:-1]:
        U, rest = low_rank(rest.reshape(rest.shape[0] * n, -1), delta, max_rank)
        cores.append(U.reshape(U.shape[0] // n, n, U.shape[1]))
    cores.append(rest.reshape(-1, shape[-1], 1))
    return Train(cores)


def decompose_matrix(
    matrix: ArrayLike, rows: Sequence[int], columns: Sequence[int] | None = None, eps: float = 1e-12,
    max_rank: int | None = None,
) -> Train:  # fmt: skip
    """Return a train of a dense matrix (prod rows, prod columns) with an error of at most eps times its norm.

    >>> decompose_matrix(np.diag(np.ones(15), 1), [2, 2, 4]).ranks
    (1, 2, 2, 1)
    """
    columns = rows if columns is None else columns
    d = len(rows)
    tensor = np.asarray(matrix, float).reshape(*rows, *columns)
    tensor = tensor.transpose(sum(((k, d + k) for k in range(d)), ()))
    pairs = [m * n for m, n in zip(rows, columns)]
    train = decompose(tensor, eps, max_rank, pairs)
    return matrix_train(train.cores, rows, columns)


def matrix_train(cores: Iterable[Array], rows: Sequence[int], columns: Sequence[int] | None = None) -> Train:
    """Return a matrix from cores (r, m n, r') that have pairs of indices as one mode."""
    columns = rows if columns is None else columns
    return Train(core.reshape(core.shape[0], m, n, core.shape[-1]) for core, m, n in zip(cores, rows, columns))


def identity(modes: Sequence[int]) -> Train:
    """Return the identity matrix, of rank 1."""
    return Train([np.eye(n)[None, :, :, None] for n in modes])


def zeros(rows: Sequence[int], columns: Sequence[int] | None = None) -> Train:
    """Return the zero vector, or with ``columns`` the zero matrix, of rank 1."""
    return Train([np.zeros((1, *mode, 1)) for mode in _mode_shapes(rows, columns)])


def random(
    rows: Sequence[int], rank: int | Sequence[int], columns: Sequence[int] | None = None,
    rng: np.random.Generator | None = None,
) -> Train:  # fmt: skip
    """Return a train with normally distributed cores, whose entries have the variance 1. No rank exceeds what the modes
    allow.

    rank : the rank of all bonds, or the ranks r_1, ..., r_{d-1}.

    >>> random([2, 4, 4, 2], 5).ranks
    (1, 2, 5, 2, 1)
    """
    rng = np.random.default_rng(0) if rng is None else rng
    shapes = _mode_shapes(rows, columns)
    asked = [rank] * (len(shapes) - 1) if isinstance(rank, int) else list(rank)
    ranks = [1, *np.minimum(asked, full_ranks([prod(shape) for shape in shapes])), 1]
    return Train(
        rng.standard_normal((ranks[k], *shape, ranks[k + 1])) / ranks[k] ** 0.5
        for k, shape in enumerate(shapes)
    )


def full_ranks(modes: Sequence[int]) -> list[int]:
    """The greatest ranks r_1, ..., r_{d-1} that a tensor with these modes can have.

    >>> full_ranks([2, 4, 4, 2])
    [2, 8, 2]
    """
    sizes = [float(n) for n in modes]
    left, right = np.cumprod(sizes)[:-1], np.cumprod(sizes[::-1])[-2::-1]
    return [int(n) for n in np.minimum(np.minimum(left, right), 2**31)]


def low_rank(matrix: Array, delta: float, max_rank: int | None = None) -> tuple[Array, Array]:
    """U and V with ||matrix - U V|| <= delta, if `max_rank` allows it. U has orthonormal columns (at least one)."""
    U, s, V = np.linalg.svd(matrix, full_matrices=False)
    tail = np.sqrt(np.cumsum(s[::-1].astype(float) ** 2))[::-1]  # tail[r] = ||s[r:]||
    floor = np.finfo(matrix.dtype).eps * (tail[0] if len(tail) else 0.0)
    rank = max(1, int(np.count_nonzero(tail > max(delta, floor))))
    rank = rank if max_rank is None else min(rank, max_rank)
    return U[:, :rank], s[:rank, None] * V[:rank]


def _mode_shapes(rows: Sequence[int], columns: Sequence[int] | None) -> list[tuple[int, ...]]:
    return [(n,) for n in rows] if columns is None else list(zip(rows, columns))
