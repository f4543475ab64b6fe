"""Factors of the Newton systems of few contacts on one rank, in compiled loops: a KSP takes longer to begin than they
take to solve.

The matrix S = N + H of the contacts has 3 x 3 blocks, where contacts share a body. Contacts with the fewest neighbours
are eliminated first (minimum degree), by blocks. Where those that are left all touch most of each other, LAPACK
factorises the dense rest. Many problems of some hundred contacts have no such rest of more than a few contacts.

Source: Tinney and Walker (1967), Rose (1970) for the order.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy.sparse as sp
from scipy.linalg import lapack

from dem.compiled import inlined, loop
from pctt.arrays import Array

FULL = 0.5  # part of all pairs of the rest that share a body, from which it is dense
LEAST = 40  # contacts of a rest: fewer are eliminated by blocks as fast as by LAPACK
ROUNDS = 10  # of refinement


class Order(NamedTuple):
    """An order of elimination of ``head`` contacts, and the dense rest of them.

    number : (nc,) of the contacts in this order
    starts, rows : of each column of the head, the later contacts that its contact touches, in order
    target : of each pair of these, the block that the elimination changes: those on the diagonal of the head, those of
        its columns, those of the rest row by row
    """

    head: int
    number: np.ndarray
    starts: np.ndarray
    rows: np.ndarray
    target: np.ndarray

    @property
    def rest(self) -> int:
        """Contacts in the rest."""
        return len(self.number) - self.head

    def columns(self) -> tuple[int, np.ndarray, np.ndarray, np.ndarray]:
        """What loops take of it: all but ``target``."""
        return self.head, self.number, self.starts, self.rows


def ordered(indptr: np.ndarray, indices: np.ndarray, most_pairs: int, most_rest: int) -> Order | None:
    """The order for a symmetric pattern of blocks (nc, nc) in CSR; None if the elimination has more than ``most_pairs``
    pairs, or the rest more than ``most_rest`` contacts."""
    head, *arrays = _ordered(indptr, indices, FULL, LEAST, most_pairs)
    order = Order(head, *arrays)
    return order if head >= 0 and order.rest <= most_rest else None


class Factors:
    """Of S = N + H, for N in block rows (3 nc, 3 nc) and blocks H (nc, 3, 3), of which ``diagonal`` (nc, 3, 3) are the
    sums with those of N. A symmetric matrix is as its lower triangle says."""

    def __init__(self, N: sp.bsr_matrix, order: Order, diagonal: Array, symmetric: bool):
        self.N, self.order, self.diagonal = N, order, diagonal
        #: lower blocks, and the transposes of the upper ones; the diagonal is in the first
        self._lower = np.zeros((order.head + len(order.rows) + order.rest**2, 3, 3))
        self._upper = self._lower if symmetric else np.zeros(self._lower.shape)
        _place((N.indptr, N.indices, N.data, diagonal), order.columns(), self._lower, self._upper)
        _eliminate(order.head, order.starts, order.target, self._lower, self._upper, symmetric)
        if order.rest:
            self._factorise_rest(symmetric)

    def _factorise_rest(self, symmetric: bool) -> None:
        size, first = 3 * self.order.rest, self.order.head + len(self.order.rows)
        rest = np.empty((size, size))
        _dense(self._lower[first:], self._upper[first:], rest)
        self._solve, self._side, wrong = lapack.dpotrs, {"lower": 0}, 1
        if symmetric:
            *self._of_rest, wrong = lapack.dpotrf(rest.T, lower=0)
        if wrong:
            self._solve, self._side = lapack.dgetrs, {"trans": 1}
            *self._of_rest, wrong = lapack.dgetrf(rest.T)

    def solve(self, b: Array, wanted: float) -> tuple[Array, int]:
        """x (nc, 3) with |b - S x| at most ``wanted``, refined where it must be, and the solves that this took; 0 if it
        was not reached."""
        x, left, change, order = np.zeros(b.shape), b.copy(), np.empty(b.shape), self.order
        given = order.columns(), self._lower
        S = self.N.indptr, self.N.indices, self.N.data, self.diagonal
        for count in range(1, ROUNDS + 1):
            _forward(*given, left, change)
            if order.rest:
                of_rest = change[order.head :].reshape(-1)
                of_rest[:] = self._solve(*self._of_rest, of_rest, **self._side)[0]
            if _backward(*given, self._upper, S, b, change, x, left) <= wanted**2:
                return x, count
        return x, 0


@loop
def _ordered(indptr, indices, full, least, most):
    count, pairs = len(indptr) - 1, 0
    place = np.empty((count, count), np.int64)  # -1: not neighbours; 0: they are; else 1 + the place of the block
    number, order, degree = np.empty(count, np.int64), np.empty(count, np.int64), np.zeros(count, np.int64)
    place[:], number[:] = -1, -1
    for i in range(count):
        for p in range(indptr[i], indptr[i + 1]):
            j = indices[p]
            if j != i and place[i, j] < 0:
                place[i, j] = place[j, i] = 0
                degree[i] += 1
                degree[j] += 1
    starts, rows, near = np.zeros(count + 1, np.int64), np.empty(4 * count, np.int64), np.empty(count, np.int64)
    head = 0
    while head < count:
        best, edges = -1, 0
        for i in range(count):
            if number[i] < 0:
                edges += degree[i]
                if best < 0 or degree[i] < degree[best]:
                    best = i
        left = count - head
        if left >= least and edges >= full * left * (left - 1):
            break
        found, begin = 0, starts[head]
        for j in range(count):
            if number[j] < 0 and place[best, j] >= 0:
                near[found] = j
                found += 1
        pairs += found * (found + 1) // 2
        if pairs > most:
            return -1, number, starts, rows, near
        while begin + found > len(rows):
            more = np.empty(2 * len(rows), np.int64)
            more[: len(rows)] = rows
            rows = more
        for a in range(found):
            i = near[a]
            degree[i] -= 1
            rows[begin + a] = i
            for b in range(a):
                j = near[b]
                if place[i, j] < 0:
                    place[i, j] = place[j, i] = 0
                    degree[i] += 1
                    degree[j] += 1
        number[best], order[head] = head, best
        head += 1
        starts[head] = begin + found
    last = head
    for i in range(count):
        if number[i] < 0:
            number[i], order[last] = last, i
            last += 1
    target, rest, p = np.empty(pairs, np.int64), count - head, 0
    for k in range(head):
        column = rows[starts[k] : starts[k + 1]]
        for a in range(len(column)):
            row, b = number[column[a]], a
            while b > 0 and column[b - 1] > row:  # columns are short, and numba's sort takes a second to compile
                column[b] = column[b - 1]
                b -= 1
            column[b] = row
        for a in range(len(column)):
            place[order[column[a]], order[k]] = 1 + starts[k] + a
    for k in range(head):
        for a in range(starts[k], starts[k + 1]):
            for b in range(starts[k], a + 1):
                i, j = rows[a], rows[b]
                if j >= head:
                    target[p] = head + starts[head] + (i - head) * rest + j - head
                elif i == j:
                    target[p] = i
                else:
                    target[p] = head + place[order[i], order[j]] - 1
                p += 1
    return head, number, starts[: head + 1], rows[: starts[head]], target


@loop
def _place(S, order, lower, upper):
    """Put the blocks of S where the factors have them."""
    (indptr, indices, blocks, diagonal), (head, number, starts, rows) = S, order
    rest = len(number) - head
    for c in range(len(number)):
        i = number[c]
        at = i if i < head else head + starts[head] + (i - head) * (rest + 1)
        _copy(diagonal, c, lower, at, False)
        _copy(diagonal, c, upper, at, True)
        for p in range(indptr[c], indptr[c + 1]):
            j = number[indices[p]]
            if j == i:
                continue
            high, low = max(i, j), min(i, j)
            if low >= head:
                at = head + starts[head] + (high - head) * rest + low - head
            else:
                at = starts[low]
                while rows[at] < high:  # columns are short
                    at += 1
                at += head
            if i == high:
                _copy(blocks, p, lower, at, False)
            else:
                _copy(blocks, p, upper, at, True)


@inlined
def _copy(blocks, k, to, at, transposed):
    for r in range(3):
        for c in range(3):
            to[at, r, c] = blocks[k, c, r] if transposed else blocks[k, r, c]


@inlined
def _factorise(A, k):
    """Of the block k, L D U with units on the diagonals of L and U, where 1 / D is in their place. (With the inverse of
    the block in its place, late in an interior point method no digit of a solution would be right.)"""
    a, b, c, d, e, f = A[k, 0, 0], A[k, 0, 1], A[k, 0, 2], A[k, 1, 0], A[k, 1, 1], A[k, 1, 2]
    low, last = d / a, A[k, 2, 0] / a
    e, f, g, h = e - low * b, f - low * c, A[k, 2, 1] - last * b, A[k, 2, 2] - last * c
    A[k, 0, 0], A[k, 0, 1], A[k, 0, 2] = 1.0 / a, b / a, c / a
    A[k, 1, 0], A[k, 1, 1], A[k, 1, 2] = low, 1.0 / e, f / e
    A[k, 2, 0], A[k, 2, 1], A[k, 2, 2] = last, g / e, 1.0 / (h - g / e * f)


@loop
def _eliminate(head, starts, target, lower, upper, symmetric):
    """Eliminate the head: L D U of its diagonal blocks in their place, and A U^-1 and (L^-1 A)' of those beside."""
    most = 0
    for k in range(head):
        most = max(most, starts[k + 1] - starts[k])
    M, p = np.empty((most, 3, 3)), 0
    for k in range(head):
        _factorise(lower, k)
        L, D = (lower[k, 1, 0], lower[k, 2, 0], lower[k, 2, 1]), (lower[k, 0, 0], lower[k, 1, 1], lower[k, 2, 2])
        U, first = (lower[k, 0, 1], lower[k, 0, 2], lower[k, 1, 2]), head + starts[k]
        for a in range(first, head + starts[k + 1]):
            for r in range(3):
                lower[a, r, 1] -= lower[a, r, 0] * U[0]
                lower[a, r, 2] -= lower[a, r, 0] * U[1] + lower[a, r, 1] * U[2]
                if not symmetric:
                    upper[a, r, 1] -= upper[a, r, 0] * L[0]
                    upper[a, r, 2] -= upper[a, r, 0] * L[1] + upper[a, r, 1] * L[2]
                for c in range(3):
                    M[a - first, r, c] = lower[a, r, c] * D[c]
            for b in range(first, a + 1):
                t = target[p]
                p += 1
                for r in range(3):
                    for c in range(3):
                        lower[t, r, c] -= (
                            M[a - first, r, 0] * upper[b, c, 0] + M[a - first, r, 1] * upper[b, c, 1]
                            + M[a - first, r, 2] * upper[b, c, 2]
                        )  # fmt: skip
                if not symmetric:
                    for r in range(3):
                        for c in range(3):
                            upper[t, r, c] -= (
                                M[b - first, c, 0] * upper[a, r, 0] + M[b - first, c, 1] * upper[a, r, 1]
                                + M[b - first, c, 2] * upper[a, r, 2]
                            )  # fmt: skip


@loop
def _dense(lower, upper, out):
    """The rest as a matrix, from its blocks."""
    rest = len(out) // 3
    for i in range(rest):
        for j in range(i + 1):
            for r in range(3):
                for c in range(3):
                    out[3 * i + r, 3 * j + c] = lower[i * rest + j, r, c]
                    if i != j:
                        out[3 * j + c, 3 * i + r] = upper[i * rest + j, r, c]


@loop
def _forward(order, lower, left, x):
    """What the elimination makes of ``left``: x in its order."""
    head, number, starts, rows = order
    for c in range(len(x)):
        i = number[c]
        x[i, 0], x[i, 1], x[i, 2] = left[c, 0], left[c, 1], left[c, 2]
    for k in range(head):
        u = x[k, 0]
        v = x[k, 1] - lower[k, 1, 0] * u
        w = (x[k, 2] - lower[k, 2, 0] * u - lower[k, 2, 1] * v) * lower[k, 2, 2]
        u, v = u * lower[k, 0, 0], v * lower[k, 1, 1]
        x[k, 0], x[k, 1], x[k, 2] = u, v, w
        for p in range(starts[k], starts[k + 1]):
            i, a = rows[p], head + p
            for r in range(3):
                x[i, r] -= lower[a, r, 0] * u + lower[a, r, 1] * v + lower[a, r, 2] * w


@loop
def _backward(order, lower, upper, S, b, change, x, left):
    """Solve for the head, and add the ``change`` to x; what is ``left`` = b - S x, and its square."""
    (head, number, starts, rows), (indptr, indices, blocks, diagonal) = order, S
    for k in range(head - 1, -1, -1):
        u, v, w = 0.0, 0.0, 0.0
        for p in range(starts[k], starts[k + 1]):
            i, a = rows[p], head + p
            u += upper[a, 0, 0] * change[i, 0] + upper[a, 1, 0] * change[i, 1] + upper[a, 2, 0] * change[i, 2]
            v += upper[a, 0, 1] * change[i, 0] + upper[a, 1, 1] * change[i, 1] + upper[a, 2, 1] * change[i, 2]
            w += upper[a, 0, 2] * change[i, 0] + upper[a, 1, 2] * change[i, 1] + upper[a, 2, 2] * change[i, 2]
        w = change[k, 2] - w * lower[k, 2, 2]
        v = change[k, 1] - v * lower[k, 1, 1] - lower[k, 1, 2] * w
        change[k, 0] -= u * lower[k, 0, 0] + lower[k, 0, 1] * v + lower[k, 0, 2] * w
        change[k, 1], change[k, 2] = v, w
    for c in range(len(x)):
        i = number[c]
        x[c, 0], x[c, 1], x[c, 2] = x[c, 0] + change[i, 0], x[c, 1] + change[i, 1], x[c, 2] + change[i, 2]
    size = 0.0
    for c in range(len(x)):
        for r in range(3):
            left[c, r] = b[c, r] - (
                diagonal[c, r, 0] * x[c, 0] + diagonal[c, r, 1] * x[c, 1] + diagonal[c, r, 2] * x[c, 2]
            )
        for p in range(indptr[c], indptr[c + 1]):
            j = indices[p]
            if j != c:
                for r in range(3):
                    left[c, r] -= blocks[p, r, 0] * x[j, 0] + blocks[p, r, 1] * x[j, 1] + blocks[p, r, 2] * x[j, 2]
        for r in range(3):
            size += left[c, r] * left[c, r]
    return size
