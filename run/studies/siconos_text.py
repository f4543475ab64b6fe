"""Cone problems in the text files of Siconos (``.dat``), as `frictionContact_printInFile` and
`globalFrictionContact_printInFile` of its numerics write them.

All of a file is words between blanks and line ends. First come the dimension, 3, and the number of contacts nc. A local
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
from pathlib import Path

import numpy as np
import scipy.sparse as sp

from pctt.ccp.cone import Array
from pctt.ccp.fclib import FileFormatError


def read(path: Path) -> tuple[dict[str, sp.csr_matrix], dict[str, Array]]:
    """Matrices and vectors of a file by FCLIB's names: W; q, mu of a local problem, M, H; f, w, mu of a global one.

    Raises FileFormatError, which names the line, where the file cannot be read as one.
    """
    words = Words(path.read_bytes())
    dimension, contacts = words.count("the dimension"), words.count("the number of contacts")
    if dimension != 3:
        kind = {2: "contacts in the plane", 5: "rolling friction"}.get(dimension, "unknown")
        raise words.wrong(0, f"dimension {dimension} ({kind}); allowed is 3, contacts in space with sliding friction")
    first = matrix(words, "W or M")
    rows, global_form = 3 * contacts, _begins_matrix(words, first.shape[0], 3 * contacts)
    if global_form:
        matrices = {"M": first, "H": matrix(words, "H")}
        vectors = {"f": words.numbers(first.shape[0], "q"), "w": words.numbers(rows, "b")}
    elif first.shape == (rows, rows):
        matrices, vectors = {"W": first}, {"q": words.numbers(rows, "q")}
    else:
        allowed = f"W {rows, rows}, or M and then H {first.shape[0], rows}"
        raise words.wrong(words.taken, f"a matrix {first.shape} alone, for {contacts} contacts; allowed is {allowed}")
    vectors["mu"] = words.numbers(contacts, "mu")
    words.end()
    return matrices, vectors


def _begins_matrix(words: Words, rows: int, columns: int) -> bool:
    """Whether H (rows, columns) is next. After W it would be q and mu, which may be whole numbers too."""
    q_and_mu = rows == columns and words.left <= rows + rows // 3 + 1
    return not q_and_mu and words.words[words.taken + 1 : words.taken + 3] == [b"%d" % rows, b"%d" % columns]


class Words:
    """The words of a file, taken one after the other."""

    def __init__(self, text: bytes):
        self.text, self.words, self.taken = text, text.split(), 0

    @property
    def left(self) -> int:
        """How many have not been taken yet."""
        return len(self.words) - self.taken

    def take(self, count: int, what: str) -> list[bytes]:
        """The next ``count`` words; FileFormatError where there are fewer."""
        found = self.words[self.taken : self.taken + count]
        if len(found) < count:
            raise self.wrong(len(self.words), f"it ends too early, after {len(found)} of {count} words of {what}")
        self.taken += count
        return found

    def count(self, what: str) -> int:
        """The next word as a whole number >= 0."""
        number = int(self.numbers(1, what, whole=True)[0])
        if number < 0:
            raise self.wrong(self.taken - 1, f"{number} for {what}; allowed is a number >= 0")
        return number

    def numbers(self, count: int, what: str, whole: bool = False) -> Array:
        """The next ``count`` words as finite numbers (count,); ``whole``: as whole ones, int64."""
        begin = self.taken
        self.take(count, what)
        return self.parsed(np.arange(begin, self.taken), what, whole)

    def parsed(self, index: np.ndarray, what: str, whole: bool = False) -> Array:
        """The words at these places as numbers of the same shape."""
        words = [self.words[i] for i in index.ravel()]
        numbers = _as_numbers(words, whole)
        if numbers is None:
            bad = next(i for i in index.ravel() if _as_numbers([self.words[i]], whole) is None)
            raise self.wrong(bad, f"{self.shown(bad)} in {what}; allowed is a {'whole' if whole else 'finite'} number")
        return numbers.reshape(index.shape)

    def end(self) -> None:
        """FileFormatError where more than the one number is left that many files end with."""
        if self.left > 1 or self.words[self.taken :] not in ([], [b"0"], [b"1"]):
            more = f" and {self.left - 1} words more" if self.left > 1 else ""
            found = f"{self.shown(self.taken)}{more} after the friction coefficients"
            raise self.wrong(self.taken, f"{found}; allowed is 0 or 1, or nothing")

    def wrong(self, index: int, what: str) -> FileFormatError:
        """The error that names the line of a word, the last line where there is no such word."""
        lines = self.text.splitlines()
        ends = np.cumsum([len(line.split()) for line in lines])
        line = 1 + int(np.searchsorted(ends, index, side="right"))
        return FileFormatError(f"line {max(1, min(line, len(lines)))}: {what}")

    def shown(self, index: int) -> str:
        return repr(self.words[index][:40].decode("utf-8", "replace"))


def _as_numbers(words: list[bytes], whole: bool) -> np.ndarray | None:
    """Words as finite numbers; None where one of them is none."""
    try:
        numbers = np.array(words, dtype=bytes).astype(np.int64 if whole else np.float64)
    except (ValueError, OverflowError):
        return None
    return numbers if np.isfinite(numbers).all() else None


def matrix(words: Words, name: str) -> sp.csr_matrix:
    """The matrix that comes next."""
    begin = words.taken
    storage, rows, columns = (words.count(f"the {what} of {name}") for what in ("storage", "rows", "columns"))
    readers = {0: _dense, 1: _blocks, 2: _sparse}
    if storage not in readers:
        allowed = "0 (dense), 1 (sparse blocks) and 2 (sparse)"
        raise words.wrong(begin, f"storage {storage} of {name}; allowed are {allowed}")
    row, column, values, shape = readers[storage](words, name, (rows, columns))
    if shape != (rows, columns):
        raise words.wrong(begin, f"{name} has the size {(rows, columns)}, then {shape}")
    outside = (row < 0) | (row >= rows) | (column < 0) | (column >= columns)
    if outside.any():
        raise words.wrong(begin, f"{name} {shape} has {outside.sum()} entries outside its rows and columns")
    return sp.coo_matrix((values, (row, column)), shape=shape).tocsr()


_Entries = tuple[np.ndarray, np.ndarray, Array, tuple[int, int]]  # rows, columns, values; and the shape


def _dense(words: Words, name: str, shape: tuple[int, int]) -> _Entries:
    rows, columns = words.count(f"the rows of {name}"), words.count(f"the columns of {name}")
    values = words.numbers(rows * columns, name)
    k = np.flatnonzero(values)
    return k % max(rows, 1), k // max(rows, 1), values[k], (rows, columns)


def _blocks(words: Words, name: str, shape: tuple[int, int]) -> _Entries:
    blocks = words.count(f"the number of blocks of {name}")
    if blocks == 0:  # nothing more is written then
        return np.zeros(0, int), np.zeros(0, int), np.zeros(0), shape
    counts = [words.count(f"the {part} of {name}") for part in ("block rows", "block columns")]
    row_ends, column_ends = (
        words.numbers(count, f"the ends of the {part} of {name}", whole=True)
        for count, part in zip(counts, ("block rows", "block columns"))
    )
    row_begins, column_begins = (np.concatenate([[0], ends]) for ends in (row_ends, column_ends))
    if (row_begins[-1], column_begins[-1]) != shape:
        blocks_shape = int(row_begins[-1]), int(column_begins[-1])
        raise words.wrong(words.taken - 1, f"{name} has the size {shape}, its blocks {blocks_shape}")
    lengths = [words.count(f"the lengths of the indices of {name}") for _ in range(2)]
    if lengths != [counts[0] + 1, blocks]:
        needed = f"allowed are {counts[0] + 1} and {blocks}, for {counts[0]} block rows and {blocks} blocks"
        raise words.wrong(words.taken - 1, f"{name} has indices of lengths {lengths[0]} and {lengths[1]}; {needed}")
    pointers = words.numbers(lengths[0], f"the beginnings of the block rows of {name}", whole=True)
    block_column = words.numbers(blocks, f"the block columns of {name}", whole=True)
    good = pointers[0] == 0 and pointers[-1] == blocks and (np.diff(pointers) >= 0).all()
    good = good and (np.diff(row_begins) > 0).all() and (np.diff(column_begins) > 0).all()
    if not (good and block_column.min() >= 0 and block_column.max() < counts[1]):
        raise words.wrong(words.taken - 1, f"the rows, columns and numbers of the blocks of {name} do not fit together")
    block_row = np.repeat(np.arange(counts[0]), np.diff(pointers))
    height, width = np.diff(row_begins)[block_row], np.diff(column_begins)[block_column]
    if height.astype(float) @ width > words.left:
        raise words.wrong(len(words.words), f"it ends too early, within the blocks of {name}")
    sizes = height * width
    begin = words.taken + np.concatenate([[0], np.cumsum(1 + sizes)])  # of each block's number, and the end
    words.take(int(begin[-1]) - words.taken, f"the blocks of {name}")
    number = words.parsed(begin[:-1], f"the numbers of the blocks of {name}", whole=True)
    if (number != np.arange(blocks)).any():
        off = int(np.flatnonzero(number != np.arange(blocks))[0])
        raise words.wrong(int(begin[off]), f"block {number[off]} of {name}; allowed is block {off} here")
    within = np.arange(sizes.sum()) - np.repeat(np.cumsum(sizes) - sizes, sizes)
    of = np.repeat(np.arange(blocks), sizes)
    values = words.parsed(begin[of] + 1 + within, name)
    row = row_begins[block_row[of]] + within % height[of]
    column = column_begins[block_column[of]] + within // height[of]
    return row, column, values, shape


def _sparse(words: Words, name: str, shape: tuple[int, int]) -> _Entries:
    """As CSparse prints it: ``i j : value`` for each of the triplets, or after ``col j : locations a to b`` the
    column's entries, ``i : value``."""
    origin = words.count(f"the kind of {name}")
    begin = words.taken
    kinds = {1: rb"triplet: (\d+)-by-(\d+), nzmax: \d+ nnz: (\d+)$", 2: rb"(\d+)-by-(\d+), nzmax: \d+ nnz: (\d+),$"}
    if origin not in kinds:
        raise words.wrong(begin - 1, f"kind {origin} of {name}; allowed are 1 (triplets) and 2 (compressed columns)")
    ends = [k for k in range(begin, min(begin + 40, len(words.words))) if words.words[k - 1] == b"nnz:"]
    head = b" ".join(words.words[begin : ends[0] + 1]) if ends else b""
    found = re.search(kinds[origin], head)
    if found is None:
        form = "'triplet: ROWS-by-COLUMNS, ..." if origin == 1 else "'ROWS-by-COLUMNS, ..."
        raise words.wrong(begin, f"the head that CSparse prints of {name} is missing: {form} nnz: ENTRIES'")
    words.taken = ends[0] + 1
    rows, columns, entries = (int(number) for number in found.groups())
    if origin == 1:
        begin = words.taken
        words.take(4 * entries, name)
        table = begin + np.arange(4 * entries).reshape(-1, 4)
        row, column = (words.parsed(table[:, k], f"the places of {name}", whole=True) for k in (0, 1))
        return row, column, words.parsed(table[:, 3], name), (rows, columns)
    words.take(2, f"the norm of {name}")
    begin = words.taken
    lines = np.array(words.take(7 * columns + 3 * entries, name), dtype=bytes)
    heads = np.flatnonzero(lines == b"col")
    count, odd = np.divmod(np.diff(np.append(heads, len(lines))) - 7, 3)
    if len(heads) != columns or heads[:1].any() or odd.any():
        allowed = f"{columns}, with 'i : value' for each entry"
        raise words.wrong(begin, f"{len(heads)} columns in {name}; allowed is {allowed}")
    is_entry = np.ones(len(lines), dtype=bool)
    is_entry[heads[:, None] + np.arange(7)] = False
    table = begin + np.flatnonzero(is_entry).reshape(-1, 3)
    row = words.parsed(table[:, 0], f"the rows of {name}", whole=True)
    return row, np.repeat(np.arange(columns), count), words.parsed(table[:, 2], name), (rows, columns)
