"""Compression of a sparse matrix into a train by alternating least squares (ALS).

With orthonormal left and right interfaces the best core between them is the matrix contracted with both. A
pass over the cores, forward or backward, computes a new orthonormal interface per bond from the core that is
best there. The right interfaces of the start are random, or those of a train (that of a similar matrix, say
of the last Newton step). All contractions are those of `SparseHierarchy`: one product with all nonzeros per
pass and one for the start, the rest is small.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pctt.tt.quantise import slots_of
from pctt.tt.sparse import SparseHierarchy, on_one_rank
from pctt.tt.train import Array, Train, full_ranks, matrix_train, zeros

FIRST_RANK = 16  # a larger cap is approached by doubling
LARGE, PART = 1 << 15, 8  # slots from which one node of the last bond in PART is enough for a start
LEAF_CHUNK = 1 << 21  # entries of leaves that are compared at a time


@dataclass(frozen=True)
class Compression:
    """A train of a sparse matrix A.

    error : ||A - T||_F / ||A||_F, measured
    passes : forward passes over all nonzeros
    """

    train: Train
    error: float
    passes: int


def compress(
    matrix: SparseHierarchy,
    max_rank: int = 10,
    eps: float = 1e-2,
    start: Train | None = None,
    sweeps: int | None = None,
    rng: np.random.Generator | None = None,
) -> Compression:
    """Train of ranks at most `max_rank`, within eps where the rank allows.

    Parameters
    ----------
    start : warm start; its ranks are filled up with random directions
    sweeps : there and back after the first pass, per rank that is tried; by default 0 from a start, 1 from
        scratch. From scratch the start for a matrix of more than LARGE slots comes from a part of it.

    >>> i = np.arange(63)
    >>> A = SparseHierarchy(np.r_[i, i + 1], np.r_[i + 1, i], [4, 4, 4])
    >>> A.set_values(np.ones(126))
    >>> compress(A, eps=1e-12).train.ranks
    (1, 3, 3, 1)
    """
    rng = np.random.default_rng(0) if rng is None else rng
    norm = matrix.norm()
    if norm == 0 or len(matrix.modes) == 1:
        return _exact(matrix)
    full = max(full_ranks([m * m for m in matrix.modes]))
    rank = min(max_rank, FIRST_RANK if start is None else max(FIRST_RANK, *start.ranks))
    cores = [] if start is None else start.astype(matrix.dtype).flat()
    if start is None and slots_of(matrix.slot_modes) > LARGE:
        cores = _passes(matrix.thinned(PART), [], rank, 1, rng)
    sweeps = (0 if cores else 1) if sweeps is None else sweeps
    passes = 0
    while True:
        cores = _passes(matrix, cores, rank, sweeps, rng)
        passes += 1 + sweeps
        error = matrix.agree(max(0.0, 1 - float(np.vdot(cores[-1], cores[-1])) / norm**2) ** 0.5)
        if error <= eps or rank >= min(max_rank, full):
            break
        rank = min(2 * rank, max_rank)
    train = matrix_train(cores, matrix.modes)
    slack = (eps**2 - error**2) ** 0.5 if error < eps else eps
    rounded = matrix.agree(train.round(0.99 * slack))
    if rounded.ranks == train.ranks and error**2 > _certain(train):
        return Compression(train, error, passes)
    return Compression(rounded, relative_error(matrix, rounded), passes)


def _passes(
    matrix: SparseHierarchy, cores: list[Array], rank: int, sweeps: int, rng: np.random.Generator
) -> list[Array]:
    """Cores of the given rank after a forward pass and so many sweeps, from old cores, if any."""
    cores, x = forward(matrix, _spreads(matrix, _right_orthonormal(_widen(matrix, cores, rank, rng))))
    for _ in range(sweeps):
        cores, x = forward(matrix, backward(matrix, x, cores[-1]))
    return cores


def forward(matrix: SparseHierarchy, spreads: list[Array]) -> tuple[list[Array], list[Array]]:
    """From the first core to the last, given the matrix contracted with the right interfaces.

    Returns the new flat cores, left-orthogonal but for the last, and their left interfaces.
    """
    x, cores = [matrix.root()], []
    for k, spread in enumerate(spreads):
        rank = spread.shape[1] // matrix.slot_modes[k] ** 2
        core = matrix.middle(x[k], spread, rank)
        cores.append(np.linalg.qr(core.reshape(-1, rank))[0].reshape(*core.shape[:2], -1))
        x.append(matrix.down(k, x[k], cores[k]))
    return [*cores, matrix.leaf_core(x[-1])], x


def backward(matrix: SparseHierarchy, x: list[Array], last: Array) -> list[Array]:
    """From the last core to the first, given left interfaces and the best last core for them.

    Returns the matrix contracted with the new right interfaces.
    """
    right = _orthonormal_rows(last)
    V = matrix.leaf_up(right)
    spreads = [matrix.spread(len(x) - 2, V)]
    for k in range(len(x) - 2, 0, -1):
        right = _orthonormal_rows(matrix.middle(x[k], spreads[0], V.shape[1]))
        V = matrix.up(spreads[0], right)
        spreads.insert(0, matrix.spread(k - 1, V))
    return spreads


def _spreads(matrix: SparseHierarchy, cores: list[Array]) -> list[Array]:
    """The matrix contracted with the right interfaces of all but the first core."""
    V = matrix.leaf_up(cores[-1])
    spreads = [matrix.spread(len(cores) - 2, V)]
    for k in range(len(cores) - 2, 0, -1):
        V = matrix.up(spreads[0], cores[k])
        spreads.insert(0, matrix.spread(k - 1, V))
    return spreads


def relative_error(matrix: SparseHierarchy, train: Train) -> float:
    """||A - T||_F / ||A||_F over all entries, zeros included.

    From ||A||^2 - 2 <A, T> + ||T||^2, which rounding makes worthless below the root of the machine precision:
    there it is summed entry by entry over the hierarchy on a single rank; on several ranks the
    value is raised to what rounding leaves certain.
    """
    norm = matrix.norm()
    if norm == 0:
        return train.norm()
    square = 1 - 2 * matrix.inner(train.flat()) / norm**2 + (train.norm() / norm) ** 2
    certain = _certain(train)
    if square > certain or matrix.reduce is not on_one_rank:
        return float(max(square, certain) ** 0.5)
    return _sum_of_errors(matrix, train) ** 0.5 / norm


def _certain(train: Train) -> float:
    """The least square of a relative error that a difference of squares gives with two or three digits."""
    return 1e3 * float(np.finfo(train.dtype).eps)


def _sum_of_errors(matrix: SparseHierarchy, train: Train) -> float:
    """Sum of (A - T)^2 over all entries, without cancellation: those below listed pairs one by one, the rest, where
    A is zero, as squares of the train's left interface (the right one is orthonormal)."""
    cores = train.right_orthogonal().flat()
    x, total = matrix.root(), 0.0
    for k, core in enumerate(cores[:-1]):
        children = (x @ core.reshape(len(core), -1)).reshape(-1, core.shape[-1])
        x = children[matrix.places[k]]
        children[matrix.places[k]] = 0
        total += float(np.vdot(children, children))
    last = matrix.leaf_row(cores[-1])
    step = max(1, LEAF_CHUNK // last.shape[1])
    for start in range(0, len(x), step):
        part = slice(start, start + step)
        difference: Array = x[part] @ last - matrix.leaf_rows(part)
        total += float(np.vdot(difference, difference))
    return total


def _exact(matrix: SparseHierarchy) -> Compression:
    """Of a matrix that is zero or has a single mode."""
    if len(matrix.modes) > 1:
        return Compression(zeros(matrix.modes, matrix.modes, matrix.dtype), 0.0, 0)
    return Compression(matrix_train([matrix.leaf_core(matrix.root())], matrix.modes), 0.0, 0)


def _widen(matrix: SparseHierarchy, cores: list[Array], rank: int, rng: np.random.Generator) -> list[Array]:
    """Random cores of the given rank where the modes allow it, with old cores, if any, in their first rows."""
    squares = [m * m for m in matrix.modes]
    ranks = [1, *np.minimum(rank, full_ranks(squares)), 1]
    wide = []
    for k in range(len(squares)):
        core = rng.standard_normal((ranks[k], squares[k], ranks[k + 1])).astype(matrix.dtype)
        if cores:
            a, b = min(ranks[k], cores[k].shape[0]), min(ranks[k + 1], cores[k].shape[2])
            core[:a, :, b:] = 0
            core[:a, :, :b] = cores[k][:a, :, :b]
        wide.append(core)
    return wide


def _right_orthonormal(cores: list[Array]) -> list[Array]:
    """Cores whose right interfaces are orthonormal and span those of the given ones; the first is left out."""
    cores = list(cores)
    for k in range(len(cores) - 1, 0, -1):
        Q, R = np.linalg.qr(cores[k].reshape(len(cores[k]), -1).T)
        cores[k] = np.ascontiguousarray(Q.T).reshape(-1, *cores[k].shape[1:])
        cores[k - 1] = cores[k - 1] @ R.T
    return cores


def _orthonormal_rows(core: Array) -> Array:
    """A core (r, n, r') with orthonormal rows, seen as (r, n r'), that span those of the given one."""
    Q = np.linalg.qr(core.reshape(len(core), -1).T)[0]
    return np.ascontiguousarray(Q.T).reshape(-1, *core.shape[1:])
