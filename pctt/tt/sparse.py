"""A sparse matrix as a hierarchy of block pairs, and its contractions with the cores of a train.

The pair (i, j) of a nonzero block has digits (i_1, j_1), ..., (i_d, j_d) in the modes of the train. The distinct
prefixes of length k are the *nodes of bond k*: the pairs of coarse boxes between which the matrix has an entry (the
nonempty nodes of the product tree of the paper, section 3.2). A compression needs only products over these lists:

    down     x_{k+1}(node) = x_k(parent) G(digit)           rows of the left interface, level by level
    up       V_k(node) = sum over children  V_{k+1} G(digit)'  the matrix contracted with the right interface
    middle   sum over nodes  x_k(node)' V_{k+1}(child)         the matrix contracted with both: a new core

Their cost is linear in the number of nodes; for the leaf it is linear in the number of nonzeros. Each is a sum over
nonzeros. If several processes have the entries of their own rows, the function `reduce` adds the small results of
`middle` and `leaf_core` over the processes. Nothing else is exchanged, and all processes have the same cores.

`compress` makes a train by alternating least squares (ALS). With orthonormal left and right interfaces, the best core
between them is the matrix contracted with both. A pass over the cores, forward or backward, computes the best core at
each bond and from it a new orthonormal interface. At the start the right interfaces are random, or those of another
train, for example the train of the last Newton step. Each pass needs one product with all nonzeros, and so does the
start; the rest is small.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import sparse

from pctt.tt.projection import columns, rows
from pctt.tt.quantise import pair_keys, scalar_modes, slots_of
from pctt.tt.train import Array, Train, full_ranks, matrix_train, zeros

Reduction = Callable[[Array], Array]
Agreement = Callable[[Any], Any]


def on_one_rank(x: Any) -> Any:
    """The reduction and the agreement for a single rank."""
    return x


class SparseHierarchy:
    """The nonzero blocks of a sparse matrix, sorted into the hierarchy of the modes of a train.

    Parameters
    ----------
    rows, columns : (nb,) slots of the blocks; a pair of slots may occur several times, its blocks are added
    modes : slot modes m_1, ..., m_d, the same for rows and columns
    block : size of a block
    reduce : adds an array over the ranks (see the module)
    agree : gives all ranks the first rank's value; it is used for decisions and sizes that depend on rounding, which
        may differ between processors

    The lists are built once per pattern. `set_values` takes new blocks (nb, block, block) in the order of `rows` and
    `columns`.

    >>> i = np.arange(7)
    >>> A = SparseHierarchy(i, i + 1, [2, 4])
    >>> A.set_values(np.ones(7))
    >>> A.nodes, A.modes, round(A.norm() ** 2, 12)
    ([1, 3], (2, 4), 7.0)
    """

    def __init__(
        self, rows: Array, columns: Array, modes: Sequence[int], block: int = 1, reduce: Reduction = on_one_rank,
        agree: Agreement = on_one_rank,
    ) -> None:  # fmt: skip
        self.slot_modes = tuple(int(m) for m in modes)
        self.modes = scalar_modes(self.slot_modes, block)
        self.block = int(block)
        self.reduce, self.agree = reduce, agree
        slots = np.arange(1 + max(np.max(rows, initial=0), np.max(columns, initial=0)))
        keys = pair_keys(slots, 0, self.slot_modes)[rows] + pair_keys(0, slots, self.slot_modes)[columns]
        self._order = np.argsort(keys, kind="stable")
        keys = keys[self._order]
        new = _starts(keys)
        self._starts = None if len(new) == len(keys) else new  # where runs of blocks that are added start
        self.keys = keys[new]
        self._rows = np.asarray(rows)[self._order[new]]
        self._by_row: tuple[Array, Array, Array] | None = None
        self._index_bonds(self._index_leaf())
        self._set_leaf(np.zeros(len(self._leaf_columns)))

    def _index_leaf(self) -> Array:
        """Make the row pointers and columns of the leaf matrix, and return the keys of its rows. It has a row per node
        of the last bond, with the entries of the leaf of this node, and a column per pair of digits of the last core.
        """
        m, b = self.slot_modes[-1], self.block
        starts = _starts(self.keys // m**2)
        wide = np.int64 if len(self.keys) * b * b >= 2**31 else np.int32
        digit: Array = self.keys % m**2
        first = (digit // m * self.modes[-1] + digit % m) * b  # column of the first entry of each block
        place = np.add.outer(np.arange(b) * self.modes[-1], np.arange(b)).astype(wide)
        self._leaf_columns = np.add.outer(first.astype(wide), place).ravel()
        self._leaf_pointers = (np.append(starts, len(self.keys)) * b * b).astype(wide)
        return self.keys[starts] // m**2

    def _index_bonds(self, keys: Array) -> None:
        """Make, for each bond, the places parent * m^2 + digit of its nodes among all children of their parents."""
        self.nodes = [len(keys)]
        self.places: list[Array] = []
        for m in self.slot_modes[-2::-1]:
            parents = keys // (m * m)
            starts = _starts(parents)
            parent = np.repeat(np.arange(len(starts)), np.diff(starts, append=len(keys)))
            self.places.insert(0, parent * (m * m) + keys % (m * m))
            keys = parents[starts]
            self.nodes.insert(0, len(keys))
        self.nodes[0] = 1  # the root exists even without entries

    def set_values(self, values: Array) -> None:
        """Take new blocks (nb, block, block), in the order in which their slots were given."""
        values = np.asarray(values, float).reshape(len(self._order), self.block**2)[self._order]
        if self._starts is not None:
            values = np.add.reduceat(values, self._starts, axis=0)
        self._set_leaf(values.ravel())

    def _set_leaf(self, data: Array) -> None:
        shape = (self.nodes[-1], self.modes[-1] ** 2)
        pointers = self._leaf_pointers if len(data) else np.zeros(shape[0] + 1, np.int32)
        self._leaf = sparse.csr_matrix((data, self._leaf_columns, pointers), shape=shape)
        self._leaf_transposed = self._leaf.T

    @property
    def values(self) -> Array:
        """The distinct blocks (number, block, block), in the order of `keys`."""
        return self._leaf.data.reshape(-1, self.block, self.block)

    @property
    def size(self) -> int:
        """Number of scalar rows, with padding."""
        return slots_of(self.modes)

    def lookup(self, keys: Array) -> Array:
        """Entries at scalar keys. The digits of these are i_k m_k + j_k of base m_k^2, the first most significant.

        An entry that is not stored is zero. The result is summed over the ranks.
        """
        m, q, b = self.modes[-1], self.slot_modes[-1], self.block
        node, leaf = np.divmod(keys, m * m)
        (i, s), (j, t) = (np.divmod(index, b) for index in np.divmod(leaf, m))
        wanted = node * (q * q) + i * q + j
        out = np.zeros(keys.shape)
        if len(self.keys):
            place = np.minimum(np.searchsorted(self.keys, wanted), len(self.keys) - 1)
            found = self.keys[place] == wanted
            out[found] = self.values[place[found], s[found], t[found]]
        return self.reduce(out)

    def crosses(self, prefixes: Array, digits: Array, suffixes: Array) -> Array:
        """Entries (p, m, s) at the sums of keys."""
        return self.lookup(prefixes[:, None, None] + digits[:, None] + suffixes)

    def sample(self, count: int, rng: np.random.Generator) -> Array:
        """Scalar keys of `count` stored entries, the same on all ranks if `rng` is; empty without stored entries.

        Half of them are in random rows, half near the first or last row of a random box of a random bond. In a row the
        method takes a random entry, the leftmost or the rightmost, because the entries that join coarse boxes may be
        few but are important. A row belongs to one rank, and only this rank contributes the key.
        """
        by_row, sorted_rows, rows_of_all = self._rows_sorted()
        if len(rows_of_all) == 0:
            return np.zeros(0, np.int64)
        rows = rows_of_all[rng.integers(0, len(rows_of_all), count)]
        edges = rows[::2]
        length = np.array([slots_of(self.slot_modes[k:]) for k in range(1, len(self.slot_modes) + 1)])
        box = length[rng.integers(0, len(length), len(edges))]
        edges += np.where(rng.random(len(edges)) < 0.5, -edges % box - 1, -(edges % box))
        rows = rows_of_all[np.minimum(np.searchsorted(rows_of_all, rows), len(rows_of_all) - 1)]
        which, place = rng.uniform(-0.5, 1.5, count), rng.integers(0, self.block, (2, count))
        start, stop = np.searchsorted(sorted_rows, rows), np.searchsorted(sorted_rows, rows, "right")
        mine = stop > start
        column = np.clip(np.floor(which * (stop - start)).astype(np.int64), 0, stop - start - 1)
        found = np.zeros(count, np.int64)
        found[mine] = self._scalar_key(self.keys[by_row[(start + column)[mine]]], *place[:, mine])
        return self.reduce(found)

    def validation(self, count: int, rng: np.random.Generator) -> tuple[Array, Array]:
        """Keys of `count` stored entries and of as many others, and weights: the weighted sum of squares over them
        estimates the sum over all entries."""
        stored = self.sample(count, rng)
        size = float(self.size) ** 2
        others = rng.integers(0, slots_of(self.modes) ** 2, count)
        values = self.lookup(stored)
        seen = max(float(values @ values), float(np.finfo(float).tiny))
        weights = np.repeat([self.norm() ** 2 / seen, size / count], [len(stored), count])
        return np.concatenate((stored, others)), weights

    def _scalar_key(self, key: Array, s: Array, t: Array) -> Array:
        """Scalar keys of the entries (s, t) of the blocks with these keys."""
        q, b, m = self.slot_modes[-1], self.block, self.modes[-1]
        node, leaf = np.divmod(key, q * q)
        i, j = np.divmod(leaf, q)
        return node * (m * m) + (i * b + s) * m + j * b + t

    def _rows_sorted(self) -> tuple[Array, Array, Array]:
        """Places of this rank's blocks sorted by row slot, these row slots, and the row slots of all ranks' blocks."""
        if self._by_row is None:
            order = np.argsort(self._rows, kind="stable")
            holds = np.zeros(slots_of(self.slot_modes), np.int64)
            holds[self._rows] = 1
            self._by_row = order, self._rows[order], np.flatnonzero(self.reduce(holds))
        return self._by_row

    def norm(self) -> float:
        """Frobenius norm of the matrix (of all ranks)."""
        values = self._leaf.data
        return float(self.reduce(np.array([values @ values], float))[0]) ** 0.5

    # Contractions; cores are flat, (r, m^2, r')

    def down(self, k: int, x: Array, core: Array) -> Array:
        """The left interface (nodes[k+1], r') of bond k+1, from that of bond k, x (nodes[k], r), and core k."""
        r, m2, r_ = core.shape
        return (x @ core.reshape(r, m2 * r_)).reshape(-1, r_).take(self.places[k], axis=0)

    def spread(self, k: int, V: Array) -> Array:
        """V (nodes[k+1], r) as an array (nodes[k], m^2 r), which has a place for every child of a node of bond k."""
        r = V.shape[1]
        out = np.zeros((self.nodes[k] * self.slot_modes[k] ** 2, r))
        out[self.places[k]] = V
        return out.reshape(self.nodes[k], self.slot_modes[k] ** 2 * r)

    def up(self, spread: Array, core: Array) -> Array:
        """The matrix contracted with the right interface and one more core: (nodes[k], r) from `spread`."""
        return spread @ core.reshape(len(core), -1).T

    def middle(self, k: int, x: Array, spread: Array) -> Array:
        """The matrix contracted with both interfaces of core k: (r, m^2, r'), summed over the ranks."""
        return self.reduce(x.T @ spread).reshape(x.shape[1], self.slot_modes[k] ** 2, -1)

    def leaf_core(self, x: Array) -> Array:
        """The matrix contracted with the last left interface x: the last core (r, m^2, 1), summed over ranks."""
        return self.reduce(np.ascontiguousarray((self._leaf_transposed @ x).T))[:, :, None]

    def leaf_up(self, core: Array) -> Array:
        """The matrix contracted with the last core (r, m^2, 1): (nodes of the last bond, r)."""
        return self._leaf @ np.ascontiguousarray(core[:, :, 0].T)

    def inner(self, cores: Sequence[Array]) -> float:
        """Sum of products of the entries with those of a train."""
        x = np.ones((1, 1))
        for k, core in enumerate(cores[:-1]):
            x = self.down(k, x, core)
        return float(np.vdot(self.leaf_core(x), cores[-1]))


def _starts(keys: Array) -> Array:
    """The indices where runs of equal sorted keys start."""
    if len(keys) == 0:
        return np.zeros(0, np.int64)
    return np.flatnonzero(np.concatenate(([True], keys[1:] != keys[:-1])))


#: The smallest relative error for which a difference of squares has two or three correct digits.
CERTAIN = 5e-7


@dataclass(frozen=True)
class Compression:
    """A train of a sparse matrix A.

    error : ||A - T||_F / ||A||_F, measured; see `relative_error`
    passes : number of forward passes over all nonzeros
    """

    train: Train
    error: float
    passes: int


def compress(
    matrix: SparseHierarchy, max_rank: int = 10, eps: float = 1e-2, start: Train | None = None,
    sweeps: int | None = None, rng: np.random.Generator | None = None,
) -> Compression:  # fmt: skip
    """Return a train with ranks at most `max_rank`, with an error below eps if the rank allows it.

    Parameters
    ----------
    start : a train for a warm start; random directions fill up its ranks
    sweeps : number of sweeps, backward and forward, after the first pass; by default 0 with a start and 1 without

    >>> i = np.arange(63)
    >>> A = SparseHierarchy(np.r_[i, i + 1], np.r_[i + 1, i], [4, 4, 4])
    >>> A.set_values(np.ones(126))
    >>> compress(A, eps=1e-12).train.ranks
    (1, 3, 3, 1)
    """
    rng = np.random.default_rng(0) if rng is None else rng
    norm = matrix.norm()
    if len(matrix.modes) == 1:
        return Compression(matrix_train([matrix.leaf_core(np.ones((1, 1)))], matrix.modes), 0.0, 0)
    if norm == 0:
        return Compression(zeros(matrix.modes, matrix.modes), 0.0, 0)
    cores = [] if start is None else start.flat()
    sweeps = (0 if cores else 1) if sweeps is None else sweeps
    wide = Train(_widen(matrix, cores, max_rank, rng)).right_orthogonal().cores
    cores, x = forward(matrix, backward(matrix, wide[-1], lambda k, _: wide[k]))
    for _ in range(sweeps):

        def best(k: int, spread: Array, x: list[Array] = x) -> Array:
            return rows(matrix.middle(k, x[k], spread))

        cores, x = forward(matrix, backward(matrix, rows(cores[-1]), best))
    error = matrix.agree(max(0.0, 1 - float(np.vdot(cores[-1], cores[-1])) / norm**2) ** 0.5)
    train = matrix_train(cores, matrix.modes)
    slack = (eps**2 - error**2) ** 0.5 if error < eps else eps
    rounded = matrix.agree(train.round(0.99 * slack))
    if rounded.ranks == train.ranks:
        return Compression(train, max(error, CERTAIN), 1 + sweeps)
    return Compression(rounded, relative_error(matrix, rounded), 1 + sweeps)


def forward(matrix: SparseHierarchy, spreads: list[Array]) -> tuple[list[Array], list[Array]]:
    """A pass from the first core to the last; ``spreads`` is the matrix contracted with the right interfaces.

    Returns the new flat cores and their left interfaces. All cores except the last are left-orthogonal.
    """
    x, cores = [np.ones((1, 1))], []
    for k, spread in enumerate(spreads):
        cores.append(columns(matrix.middle(k, x[k], spread)))
        x.append(matrix.down(k, x[k], cores[k]))
    return [*cores, matrix.leaf_core(x[-1])], x


def backward(matrix: SparseHierarchy, last: Array, core_of: Callable[[int, Array], Array]) -> list[Array]:
    """The matrix contracted with the right interfaces of all cores except the first, from the last core to the first.

    core_of : gives core k from the matrix contracted with the cores after it
    """
    V = matrix.leaf_up(last)
    spreads: list[Array] = []
    for k in range(len(matrix.modes) - 2, -1, -1):
        spreads.insert(0, matrix.spread(k, V))
        if k > 0:
            V = matrix.up(spreads[0], core_of(k, spreads[0]))
    return spreads


def relative_error(matrix: SparseHierarchy, train: Train) -> float:
    """Return ||A - T||_F / ||A||_F over all entries, including zeros.

    It is computed from ||A||^2 - 2 <A, T> + ||T||^2. Rounding makes this worthless below the root of the machine
    precision; so the result is at least CERTAIN.
    """
    norm = matrix.norm()
    if norm == 0:
        return train.norm()
    square = 1 - 2 * matrix.inner(train.flat()) / norm**2 + (train.norm() / norm) ** 2
    return float(max(square, CERTAIN**2) ** 0.5)


def _widen(matrix: SparseHierarchy, cores: list[Array], rank: int, rng: np.random.Generator) -> list[Array]:
    """Random cores with the given rank, as far as the modes allow it; their first rows have the old cores, if any."""
    squares = [m * m for m in matrix.modes]
    ranks = [1, *np.minimum(rank, full_ranks(squares)), 1]
    wide = []
    for k in range(len(squares)):
        core = rng.standard_normal((ranks[k], squares[k], ranks[k + 1]))
        if cores:
            a, b = min(ranks[k], cores[k].shape[0]), min(ranks[k + 1], cores[k].shape[2])
            core[:a, :, b:] = 0
            core[:a, :, :b] = cores[k][:a, :, :b]
        wide.append(core)
    return wide
