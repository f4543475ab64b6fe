"""Cone problems in the text files of Siconos (``.dat``), as `frictionContact_printInFile` and
`globalFrictionContact_printInFile` of its numerics write them.

All of a file is words between blanks and line ends. First come the dimension, 3, and the number of contacts nc. (A
problem in the plane has the dimension 2 and 2 nc for 3 nc; it becomes one in space, `pctt.ccp.fclib.in_space`.) A local
problem (FrictionContactProblem) goes on with W (3 nc, 3 nc), q (3 nc) and mu (nc) of u = W r + q; a global one
(GlobalFrictionContactProblem) with M (n, n), H (n, 3 nc), q (n), b (3 nc) and mu (nc) of M v = H r + q, u = H'v + b.
Per contact the order is normal, t1, t2. With f = q and w = b these are FCLIB's forms, signs included. Many files end
with one more number, 0 or 1, which says nothing of the problem.

A matrix is its storage, rows and columns, and then

- 0, dense: rows and columns again, the values by columns;
- 1, sparse blocks: the number of blocks, block rows, block columns, the last row of each block row and the last column
  of each block column (counted from 1), the lengths of the two arrays that follow, where the block rows begin
  (from 0, one more than there are rows) and the block columns of the blocks; then each block: its number, its values by
  columns;
- 2, sparse: 1 for triplets, 2 for compressed columns, and what CSparse prints of the matrix, with six digits.

Source: numerics/src/FrictionContact and numerics/src/tools (NumericsMatrix, SparseBlockMatrix, CSparseMatrix) of
https://github.com/siconos/siconos.
"""

from __future__ import annotations

import re
from functools import partial
from pathlib import Path

import numpy as np
import scipy.sparse as sp

from pctt.arrays import Array
from pctt.ccp.fclib import FileFormatError, in_space


def read(path: Path) -> tuple[dict[str, sp.csr_matrix], dict[str, Array]]:
    """Matrices and vectors of a file by FCLIB's names: W; q, mu of a local problem, M, H; f, w, mu of a global one.

    Raises FileFormatError where the file cannot be read as one.
    """
    words = Words(path.read_bytes())
    dimension, contacts = words.count("the dimension"), words.count("the number of contacts")
    if dimension not in (2, 3):
        kind = {5: "rolling friction"}.get(dimension, "unknown")
        raise FileFormatError(f"dimension {dimension} ({kind}); allowed are 2 and 3, contacts with sliding friction")
    first = matrix(words, "W or M")
    rows, size = dimension * contacts, first.shape[0]
    # after W come q and mu, which may be whole numbers too
    q_and_mu = size == rows and words.left <= rows + contacts + 1
    if not q_and_mu and words.words[words.taken + 1 : words.taken + 3] == [b"%d" % size, b"%d" % rows]:
        matrices = {"M": first, "H": matrix(words, "H")}
        vectors = {"f": words.numbers(size, "q"), "w": words.numbers(rows, "b")}
    elif first.shape == (rows, rows):
        matrices, vectors = {"W": first}, {"q": words.numbers(rows, "q")}
    else:
        allowed = f"W {rows, rows}, or M and then H {size, rows}"
        raise FileFormatError(f"a matrix {first.shape} alone, for {contacts} contacts; allowed is {allowed}")
    vectors["mu"] = words.numbers(contacts, "mu")
    if words.words[words.taken :] not in ([], [b"0"], [b"1"]):
        raise FileFormatError(f"{words.left} words after the friction coefficients; allowed is 0 or 1, or nothing")
    spatial = partial(in_space, dimension=dimension, contacts=contacts)
    if "M" in matrices:
        return {**matrices, "H": spatial(matrices["H"].T).T.tocsr()}, {**vectors, "w": spatial(vectors["w"])}
    return {"W": spatial(spatial(matrices["W"]).T).T.tocsr()}, {**vectors, "q": spatial(vectors["q"])}


class Words:
    """The words of a file, taken one after the other."""

    def __init__(self, text: bytes):
        self.words, self.taken = text.split(), 0

    @property
    def left(self) -> int:
        """How many have not been taken yet."""
        return len(self.words) - self.taken

    def take(self, count: int, what: str) -> np.ndarray:
        """The next ``count`` words; FileFormatError where there are fewer."""
        if count > self.left:
            raise FileFormatError(f"it ends too early, after {self.left} of {count} words of {what}")
        self.taken += count
        return np.array(self.words[self.taken - count : self.taken], dtype=bytes)

    def numbers(self, count: int, what: str, whole: bool = False) -> Array:
        """The next ``count`` words as finite numbers (count,); ``whole``: as whole ones, int64."""
        return parsed(self.take(count, what), what, whole)

    def count(self, what: str) -> int:
        """The next word as a whole number >= 0."""
        number = int(self.numbers(1, what, whole=True)[0])
        if number < 0:
            raise FileFormatError(f"{number} for {what}; allowed is a number >= 0")
        return number


def parsed(words: np.ndarray, what: str, whole: bool = False) -> Array:
    """Words as finite numbers; FileFormatError where one of them is none."""
    try:
        numbers = words.astype(np.int64 if whole else np.float64)
    except (ValueError, OverflowError) as error:
        raise FileFormatError(f"{what}: {error}") from None
    if not np.isfinite(numbers).all():
        raise FileFormatError(f"{what}: allowed are finite numbers")
    return numbers


def matrix(words: Words, name: str) -> sp.csr_matrix:
    """The matrix that comes next."""
    storage, rows, columns = (words.count(f"the {what} of {name}") for what in ("storage", "rows", "columns"))
    readers = {0: _dense, 1: _blocks, 2: _sparse}
    if storage not in readers:
        raise FileFormatError(f"storage {storage} of {name}; allowed are 0 (dense), 1 (sparse blocks) and 2 (sparse)")
    row, column, values = readers[storage](words, name, (rows, columns))
    if ((row < 0) | (row >= rows) | (column < 0) | (column >= columns)).any():
        raise FileFormatError(f"{name} {rows, columns} has entries outside its rows and columns")
    return sp.coo_matrix((values, (row, column)), shape=(rows, columns)).tocsr()


_Entries = tuple[np.ndarray, np.ndarray, Array]  # rows, columns, values


def _same_shape(name: str, shape: tuple[int, ...], found: tuple[int, ...]) -> None:
    if found != shape:
        raise FileFormatError(f"{name} has the size {shape}, then {found}")


def _dense(words: Words, name: str, shape: tuple[int, int]) -> _Entries:
    _same_shape(name, shape, (words.count(f"the rows of {name}"), words.count(f"the columns of {name}")))
    values = words.numbers(shape[0] * shape[1], name)
    k = np.flatnonzero(values)
    return k % max(shape[0], 1), k // max(shape[0], 1), values[k]


def _blocks(words: Words, name: str, shape: tuple[int, int]) -> _Entries:
    blocks = words.count(f"the number of blocks of {name}")
    if blocks == 0:  # nothing more is written then
        return np.zeros(0, int), np.zeros(0, int), np.zeros(0)
    counts = [words.count(f"the block rows and columns of {name}") for _ in range(2)]
    ends = [words.numbers(count, f"the ends of the blocks of {name}", whole=True) for count in counts]
    _same_shape(name, shape, tuple(int(end[-1]) for end in ends))
    lengths = [words.count(f"the lengths of the indices of {name}") for _ in range(2)]
    _same_shape(f"the indices of {name}", (counts[0] + 1, blocks), tuple(lengths))
    pointers, of_column = (words.numbers(n, f"the indices of the blocks of {name}", whole=True) for n in lengths)
    steps = np.diff(pointers)
    sizes = [np.diff(end, prepend=0) for end in ends]
    good = pointers[0] == 0 and pointers[-1] == blocks and (steps >= 0).all() and min(s.min() for s in sizes) > 0
    if not (good and of_column.min() >= 0 and of_column.max() < counts[1]):
        raise FileFormatError(f"the rows, columns and numbers of the blocks of {name} do not fit together")
    rows, columns, values = [], [], []
    for k, (i, j) in enumerate(zip(np.repeat(np.arange(counts[0]), steps), of_column)):
        number = words.count(f"the numbers of the blocks of {name}")
        if number != k:
            raise FileFormatError(f"block {number} of {name}; allowed is block {k} here")
        height, width = sizes[0][i], sizes[1][j]
        values.append(words.numbers(height * width, name))
        within = np.arange(height * width)
        rows.append(ends[0][i] - height + within % height)
        columns.append(ends[1][j] - width + within // height)
    return np.concatenate(rows), np.concatenate(columns), np.concatenate(values)


def _sparse(words: Words, name: str, shape: tuple[int, int]) -> _Entries:
    """As CSparse prints it: ``i j : value`` for each of the triplets, or after ``col j : locations a to b`` the
    column's entries, ``i : value``."""
    triplets = words.count(f"the kind of {name}") == 1
    head = b" ".join(words.words[words.taken : words.taken + 40])
    found = re.match(rb".*?(\d+)-by-(\d+), nzmax: \d+ nnz: (\d+)" + (b" " if triplets else b", "), head + b" ")
    if found is None or (b"triplet:" in found[0]) != triplets:
        raise FileFormatError(f"the head that CSparse prints of {name} is missing: ROWS-by-COLUMNS, ... nnz: ENTRIES")
    words.taken += len(found[0].split())
    rows, columns, entries = (int(number) for number in found.groups())
    _same_shape(name, shape, (rows, columns))
    if triplets:
        table = words.take(4 * entries, name).reshape(-1, 4)
        row, column = (parsed(table[:, k], f"the places of {name}", whole=True) for k in (0, 1))
        return row, column, parsed(table[:, 3], name)
    words.take(2, f"the norm of {name}")
    lines = words.take(7 * columns + 3 * entries, name)
    heads = np.flatnonzero(lines == b"col")
    count, odd = np.divmod(np.diff(np.append(heads, len(lines))) - 7, 3)
    if len(heads) != columns or heads[:1].any() or odd.any():
        raise FileFormatError(f"{len(heads)} columns in {name}; allowed is {columns}, with 'i : value' for each entry")
    is_entry = np.ones(len(lines), dtype=bool)
    is_entry[heads[:, None] + np.arange(7)] = False
    table = lines[is_entry].reshape(-1, 3)
    row = parsed(table[:, 0], f"the rows of {name}", whole=True)
    return row, np.repeat(np.arange(columns), count), parsed(table[:, 2], name)
