"""Compression of a sparse matrix into a train by alternating least squares (ALS).

With orthonormal left and right interfaces, the best core between them is the matrix contracted with both. A pass over
the cores, forward or backward, computes the best core at each bond and from it a new orthonormal interface. At the
start the right interfaces are random, or those of another train, for example the train of the last Newton step. All
contractions are methods of `SparseHierarchy`. Each pass needs one product with all nonzeros, and the start needs one;
the rest is small.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pctt.tt.projection import columns, rows
from pctt.tt.quantise import slots_of
from pctt.tt.sparse import SparseHierarchy, on_one_rank
from pctt.tt.train import Array, Train, full_ranks, matrix_train, zeros

FIRST_RANK = 16  # ranks begin here and are doubled up to a larger cap
LARGE, PART = 1 << 15, 8  # with more slots than LARGE, the start uses one in PART nodes of the last bond
LEAF_CHUNK = 1 << 21  # number of entries of leaves that are compared at a time


@dataclass(frozen=True)
class Compression:
    """A train of a sparse matrix A.

    error : ||A - T||_F / ||A||_F, measured
    passes : number of forward passes over all nonzeros
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
    """A train with ranks at most `max_rank`, with an error below eps if the rank allows it.

    Parameters
    ----------
    start : a train for a warm start; random directions fill up its ranks
    sweeps : number of sweeps, backward and forward, after the first pass, for each rank that is tried. The default is
        0 with a start and 1 without. Without a start, a matrix with more than LARGE slots gets one from a part of it.

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
    """Cores of the given rank after a forward pass and ``sweeps`` sweeps; they begin with the old cores, if any."""
    cores, x = forward(matrix, _spreads(matrix, Train(_widen(matrix, cores, rank, rng)).right_orthogonal().flat()))
    for _ in range(sweeps):
        cores, x = forward(matrix, backward(matrix, x, cores[-1]))
    return cores


def forward(matrix: SparseHierarchy, spreads: list[Array]) -> tuple[list[Array], list[Array]]:
    """A pass from the first core to the last; ``spreads`` is the matrix contracted with the right interfaces.

    Returns the new flat cores and their left interfaces. All cores except the last are left-orthogonal.
    """
    x, cores = [matrix.root()], []
    for k, spread in enumerate(spreads):
        rank = spread.shape[1] // matrix.slot_modes[k] ** 2
        core = matrix.middle(x[k], spread, rank)
        cores.append(columns(core))
        x.append(matrix.down(k, x[k], cores[k]))
    return [*cores, matrix.leaf_core(x[-1])], x


def backward(matrix: SparseHierarchy, x: list[Array], last: Array) -> list[Array]:
    """A pass from the last core to the first, from left interfaces and the best last core for them.

    Returns the matrix contracted with the new right interfaces.
    """
    right = rows(last)
    V = matrix.leaf_up(right)
    spreads = [matrix.spread(len(x) - 2, V)]
    for k in range(len(x) - 2, 0, -1):
        right = rows(matrix.middle(x[k], spreads[0], V.shape[1]))
        V = matrix.up(spreads[0], right)
        spreads.insert(0, matrix.spread(k - 1, V))
    return spreads


def _spreads(matrix: SparseHierarchy, cores: list[Array]) -> list[Array]:
    """The matrix contracted with the right interfaces of all cores except the first."""
    V = matrix.leaf_up(cores[-1])
    spreads = [matrix.spread(len(cores) - 2, V)]
    for k in range(len(cores) - 2, 0, -1):
        V = matrix.up(spreads[0], cores[k])
        spreads.insert(0, matrix.spread(k - 1, V))
    return spreads


def relative_error(matrix: SparseHierarchy, train: Train) -> float:
    """||A - T||_F / ||A||_F over all entries, including zeros.

    It is computed from ||A||^2 - 2 <A, T> + ||T||^2. Below the root of the machine precision rounding makes this
    worthless. Then a single rank sums the errors entry by entry over the hierarchy; with several ranks the result is
    the smallest value that is certain in spite of rounding.
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
    """The smallest square of a relative error for which a difference of squares has two or three correct digits."""
    return 1e3 * float(np.finfo(train.dtype).eps)


def _sum_of_errors(matrix: SparseHierarchy, train: Train) -> float:
    """Sum of (A - T)^2 over all entries, without cancellation.

    Entries below listed pairs are summed one by one. At the other entries A is zero, and their sum is the squared norm
    of the train's left interface, because the right interface is orthonormal.
    """
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
    """The exact train of a matrix that is zero or has a single mode."""
    if len(matrix.modes) > 1:
        return Compression(zeros(matrix.modes, matrix.modes, matrix.dtype), 0.0, 0)
    return Compression(matrix_train([matrix.leaf_core(matrix.root())], matrix.modes), 0.0, 0)


def _widen(matrix: SparseHierarchy, cores: list[Array], rank: int, rng: np.random.Generator) -> list[Array]:
    """Random cores with the given rank, as far as the modes allow it; their first rows have the old cores, if any."""
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
