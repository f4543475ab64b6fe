"""Threshold incomplete Cholesky factors of a symmetric positive definite matrix by blocks of 3 x 3, in compiled loops.

The matrix A of one rank is scaled by the Cholesky factors of its diagonal blocks, T = D^-1 A D^-T. Then

    T + shift I = L L' + what was dropped:    a block of L below the diagonal whose Frobenius norm is below ``tau``.

The shift makes up for what is dropped: without it a pivot may become negative.

L takes eight bits a number. Its entries are at most the root of 1 + shift, so these bits round them by 0.004, which is
little beside ``tau``; the factorisation goes on from the rounded numbers, so that L L' has no further error. Products
are in double precision: the preconditioner is linear to rounding, as BiCGStab wants it.

Rows are taken three at a time in the order of elimination: three unknowns of a contact, half of those of a body, or any
three neighbours. So a matrix may have blocks of any size, and there is one set of loops.

Source: Ajiz and Jennings (1984) and Jones and Plassmann (1995) for incomplete Cholesky factors by threshold, columns
from the left; Manteuffel (1980) for the shift.
"""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from petsc4py import PETSc

from dem.compiled import inlined, loop

Array = NDArray[np.float64]

MOST = 20.0  #: blocks of L at most, as a multiple of those of A
DONE, FULL, BAD_PIVOT, BAD_BLOCK = range(4)  # ends of a factorisation


class Blocks(NamedTuple):
    """A symmetric matrix by blocks: its pattern (CSR), the ``order`` (n,) in which its block rows are eliminated, their
    ``number`` in it, and ``rows`` (n, 3), the three rows of the matrix in each block of this order. The last block may
    have less: its rows from ``size`` on are none."""

    indptr: np.ndarray
    indices: np.ndarray
    order: np.ndarray
    number: np.ndarray
    rows: np.ndarray
    size: int

    @classmethod
    def from_blocks(cls, indptr: np.ndarray, indices: np.ndarray, order: np.ndarray) -> Blocks:
        """For a pattern of blocks of 3 x 3, and their order."""
        number = np.empty(len(order), np.int64)
        number[order] = np.arange(len(order))
        rows = np.add.outer(3 * order, np.arange(3)).astype(np.uint32)
        return cls(indptr, indices, order, number, rows, 3 * len(order))

    @classmethod
    def from_rows(cls, pattern: sp.csr_matrix, order: np.ndarray) -> tuple[Blocks, np.ndarray]:
        """For a pattern of single entries, and the order of its rows; and the place in the pattern's data, one after
        the last for zero, of each number in the blocks (nb, 3, 3), which are transposed."""
        size, count = len(order), -(-len(order) // 3)
        place = sp.csr_matrix((np.arange(1.0, pattern.nnz + 1), pattern.indices, pattern.indptr), shape=(size, size))
        padded = sp.csr_matrix(place[order][:, order])
        padded.resize((3 * count, 3 * count))
        blocks = padded.tobsr((3, 3))
        source = np.ascontiguousarray(blocks.data.transpose(0, 2, 1), np.int64) - 1
        rows = np.zeros(3 * count, np.uint32)
        rows[:size] = order
        return cls(blocks.indptr, blocks.indices, *(np.arange(count),) * 2, rows.reshape(count, 3), size), source


class Factor(NamedTuple):
    """L by columns: where they start (n + 1,), the block rows ``below`` the diagonal (m,) and their blocks ``L``
    (m, 3, 4) with a column in each row, in units of ``unit``; the inverses of the diagonal blocks of L and those of D
    (n, 6), by rows of their lower triangles."""

    blocks_of: Blocks
    starts: np.ndarray
    below: np.ndarray
    L: np.ndarray
    unit: float
    pivots: NDArray[np.float32]
    scale: NDArray[np.floating]
    work: Array
    shift: float

    @property
    def fill(self) -> float:
        """Blocks of L below the diagonal, as a multiple of those of A."""
        own = (len(self.blocks_of.indices) - len(self.pivots)) // 2
        return len(self.below) / max(own, 1)

    @property
    def flops(self) -> int:
        """Operations of an application."""
        return 36 * len(self.below) + 60 * len(self.pivots)

    def solve(self, b: Array, out: Array) -> None:
        """out = (D L L' D')^-1 b."""
        of = self.blocks_of
        L = self.starts, self.below, self.L, self.unit
        _solve(L, self.pivots, self.scale, of.rows, of.size, self.work, b, out)


def factorised(of: Blocks, blocks: Array, tau: float, shift: float) -> Factor | int:
    """The factor of a matrix whose blocks (nb, 3, 3) are transposed; or why there is none: FULL, BAD_PIVOT, or
    BAD_BLOCK if a block on the diagonal is not positive definite."""
    n = len(of.number)
    scale, pivots, starts = np.empty((n, 6)), np.empty((n, 6), np.float32), np.zeros(n + 1, np.int64)
    if not _scales(of.indptr, of.indices, blocks, of.number, of.size, scale):
        return BAD_BLOCK
    unit = np.sqrt(1.0 + shift) / 127.0  # the squares in a row of L sum to no more than 1 + shift
    matrix, order = (of.indptr, of.indices, blocks), (of.number, of.order)
    given = matrix, order, scale, np.float32(tau**2), np.float32(shift), unit
    room, ended = 2 * len(of.indices) + n, FULL
    while ended == FULL and room <= MOST * len(of.indices) + n:
        below, L = np.empty(room, np.uint32), np.empty((room, 3, 4), np.int8)
        ended = _factorise(*given, starts, pivots, (below, L))
        room *= 3
    if ended != DONE:
        return ended
    kept = slice(starts[-1])
    single, least = np.finfo(np.float32), scale[:, [0, 2, 5]].min(initial=1.0)
    if single.tiny < least and np.abs(scale).max(initial=1.0) < single.max:  # else they become zero or infinite
        scale = scale.astype(np.float32)
    return Factor(of, starts, below[kept].copy(), L[kept].copy(), unit, pivots, scale, np.zeros((n, 4)), shift)


@cache
def compile_loops() -> None:
    """Compile the loops, or load them, for the arrays that PETSc gives: seconds that belong to no matrix."""
    index = np.arange(2, dtype=PETSc.IntType)
    made = factorised(Blocks.from_blocks(index, index[:1], np.zeros(1, np.int64)), np.eye(3)[None], 0.0, 0.0)
    b = np.ones(3)
    b.flags.writeable = False  # as PETSc's arrays to read are, which is another type to the compiler
    if isinstance(made, Factor):
        made.solve(b, np.empty(3))


@inlined
def _inverse(a, b, c, d, e, f, least, last):
    """The inverse of the Cholesky factor of a block, both by rows of the lower triangle; and whether the second pivot
    is above ``least`` and the third one above ``last``."""
    p = np.sqrt(a)
    b, d = b / p, d / p
    q = c - b * b
    good = a > 0.0 and q > least
    q = np.sqrt(q)
    e = (e - d * b) / q
    r = f - d * d - e * e
    good = good and r > last
    r = np.sqrt(r)
    return 1.0 / p, -b / (p * q), 1.0 / q, (e * b / q - d) / (p * r), -e / (q * r), 1.0 / r, good


@loop
def _scales(indptr, indices, blocks, number, size, scale):
    """D^-1; whether all diagonal blocks are positive definite."""
    for k in range(len(number)):
        j, found = number[k], False
        for p in range(indptr[k], indptr[k + 1]):
            if indices[p] == k:
                B, found = blocks[p], True
                c = B[1, 1] if 3 * j + 1 < size else 1.0
                f = B[2, 2] if 3 * j + 2 < size else 1.0
                u, v, w, x, y, z, good = _inverse(B[0, 0], B[0, 1], c, B[0, 2], B[1, 2], f, 1e-15 * c, 1e-15 * f)
                scale[j, 0], scale[j, 1], scale[j, 2], scale[j, 3], scale[j, 4], scale[j, 5] = u, v, w, x, y, z
                found = good
        if not found:
            return False
    return True


@loop
def _factorise(matrix, orders, scale, tau2, shift, unit, starts, pivots, factor):
    """The rows and blocks of L by columns, if there is room. Each column is that of T less the products of columns
    before it that have a block in its row; these are linked in lists."""
    (indptr, indices, blocks), (number, order), (rows, L) = matrix, orders, factor
    n, m = len(order), 0
    found, w, place = np.empty(n, np.int32), np.empty((n, 3, 4), np.float32), np.full(n, -1, np.int32)
    sorted_rows, slot = np.empty(n + 1, np.int32), np.empty(n + 1, np.int32)  # of those that are kept
    first, following, at = np.full(n, -1, np.int32), np.full(n, -1, np.int32), np.zeros(n, np.int64)
    zero, one, most = np.float32(0.0), np.float32(1.0), np.float32(127.0)
    least, unit, per_unit = np.float32(0.1) * shift, np.float32(unit), np.float32(1.0 / unit)
    for j in range(n):
        # the column of T below the diagonal
        own, count = order[j], 0
        g, h, i, k, l, r = scale[j, 0], scale[j, 1], scale[j, 2], scale[j, 3], scale[j, 4], scale[j, 5]  # noqa: E741
        for p in range(indptr[own], indptr[own + 1]):
            row = number[indices[p]]
            if row > j:
                found[count], place[row] = row, count
                d, e, f = scale[row, 0], scale[row, 1], scale[row, 2]
                t, u, v = scale[row, 3], scale[row, 4], scale[row, 5]
                a, b, c = blocks[p, 0, 0], blocks[p, 1, 0], blocks[p, 2, 0]
                x, y, z = a * g, b * g, c * g
                w[count, 0, 0], w[count, 0, 1], w[count, 0, 2] = d * x, e * x + f * y, t * x + u * y + v * z
                x, y, z = blocks[p, 0, 1], blocks[p, 1, 1], blocks[p, 2, 1]
                o, q, s = a * h + x * i, b * h + y * i, c * h + z * i
                w[count, 1, 0], w[count, 1, 1], w[count, 1, 2] = d * o, e * o + f * q, t * o + u * q + v * s
                o = a * k + x * l + blocks[p, 0, 2] * r
                q = b * k + y * l + blocks[p, 1, 2] * r
                s = c * k + z * l + blocks[p, 2, 2] * r
                w[count, 2, 0], w[count, 2, 1], w[count, 2, 2] = d * o, e * o + f * q, t * o + u * q + v * s
                w[count, 0, 3] = w[count, 1, 3] = w[count, 2, 3] = zero
                count += 1
        # less the products of earlier columns; the diagonal block by rows of its lower triangle
        a = c = f = one + shift
        b = d = e = zero
        k = first[j]
        while k >= 0:
            p, end = at[k], starts[k + 1]
            q0, q1, q2 = unit * L[p, 0, 0], unit * L[p, 0, 1], unit * L[p, 0, 2]
            q3, q4, q5 = unit * L[p, 1, 0], unit * L[p, 1, 1], unit * L[p, 1, 2]
            q6, q7, q8 = unit * L[p, 2, 0], unit * L[p, 2, 1], unit * L[p, 2, 2]
            a -= q0 * q0 + q3 * q3 + q6 * q6
            b -= q1 * q0 + q4 * q3 + q7 * q6
            c -= q1 * q1 + q4 * q4 + q7 * q7
            d -= q2 * q0 + q5 * q3 + q8 * q6
            e -= q2 * q1 + q5 * q4 + q8 * q7
            f -= q2 * q2 + q5 * q5 + q8 * q8
            q0, q1, q2, q3, q4, q5 = unit * q0, unit * q1, unit * q2, unit * q3, unit * q4, unit * q5
            q6, q7, q8 = unit * q6, unit * q7, unit * q8
            for o in range(p + 1, end):
                i = rows[o]
                s = place[i]
                if s < 0:
                    s = count
                    found[s], place[i], count = i, s, count + 1
                    for u in range(3):
                        for v in range(4):
                            w[s, u, v] = zero
                # w[s] -= L[o] q', each four numbers at once
                k0, k1, k2, k3 = L[o, 0, 0], L[o, 0, 1], L[o, 0, 2], L[o, 0, 3]
                l0, l1, l2, l3 = L[o, 1, 0], L[o, 1, 1], L[o, 1, 2], L[o, 1, 3]
                m0, m1, m2, m3 = L[o, 2, 0], L[o, 2, 1], L[o, 2, 2], L[o, 2, 3]
                r0, r1 = w[s, 0, 0] - (k0 * q0 + l0 * q3 + m0 * q6), w[s, 0, 1] - (k1 * q0 + l1 * q3 + m1 * q6)
                r2, r3 = w[s, 0, 2] - (k2 * q0 + l2 * q3 + m2 * q6), w[s, 0, 3] - (k3 * q0 + l3 * q3 + m3 * q6)
                s0, s1 = w[s, 1, 0] - (k0 * q1 + l0 * q4 + m0 * q7), w[s, 1, 1] - (k1 * q1 + l1 * q4 + m1 * q7)
                s2, s3 = w[s, 1, 2] - (k2 * q1 + l2 * q4 + m2 * q7), w[s, 1, 3] - (k3 * q1 + l3 * q4 + m3 * q7)
                t0, t1 = w[s, 2, 0] - (k0 * q2 + l0 * q5 + m0 * q8), w[s, 2, 1] - (k1 * q2 + l1 * q5 + m1 * q8)
                t2, t3 = w[s, 2, 2] - (k2 * q2 + l2 * q5 + m2 * q8), w[s, 2, 3] - (k3 * q2 + l3 * q5 + m3 * q8)
                w[s, 0, 0], w[s, 0, 1], w[s, 0, 2], w[s, 0, 3] = r0, r1, r2, r3
                w[s, 1, 0], w[s, 1, 1], w[s, 1, 2], w[s, 1, 3] = s0, s1, s2, s3
                w[s, 2, 0], w[s, 2, 1], w[s, 2, 2], w[s, 2, 3] = t0, t1, t2, t3
            last, k, p = k, following[k], p + 1
            at[last] = p
            if p < end:
                following[last], first[rows[p]] = first[rows[p]], last
        g, h, i, k, l, r, good = _inverse(a, b, c, d, e, f, least, least)  # noqa: E741
        if not (good and a > least):
            return BAD_PIVOT
        pivots[j, 0], pivots[j, 1], pivots[j, 2], pivots[j, 3], pivots[j, 4], pivots[j, 5] = g, h, i, k, l, r
        g, h, i = np.float32(g), np.float32(h), np.float32(i)
        k, l, r = np.float32(k), np.float32(l), np.float32(r)  # noqa: E741
        # times the inverse of the block's factor; what is small is dropped
        kept = 0
        for s in range(count):
            size = zero
            for p in range(3):
                x, y, z = w[s, 0, p], w[s, 1, p], w[s, 2, p]
                u, v, t = x * g, x * h + y * i, x * k + y * l + z * r
                w[s, 0, p], w[s, 1, p], w[s, 2, p] = u, v, t
                size += u * u + v * v + t * t
            row = found[s]
            place[row], slot[kept], sorted_rows[kept] = -1, s, row  # and no branch, which would be guessed wrongly
            kept += size >= tau2
        if m + kept > len(rows):
            return FULL
        # in order, as lists begin with the next row; an entry that is too large makes a later pivot negative
        for s in range(kept):
            row, p, q = sorted_rows[s], m, slot[s]
            for o in range(kept):
                p += sorted_rows[o] < row
            rows[p] = row
            for u in range(3):
                for v in range(4):
                    L[p, u, v] = np.int8(min(max(np.rint(w[q, u, v] * per_unit), -most), most))
        m += kept
        starts[j + 1], at[j] = m, starts[j]
        if kept > 0:
            row = rows[starts[j]]
            following[j], first[row] = first[row], j
    return DONE


@loop
def _solve(factor, pivots, scale, rows, size, x, b, out):
    """Unsigned places: they need no test for negative ones."""
    starts, below, L, unit = factor
    n, t = len(pivots), np.empty((3, 4))
    x[:] = 0.0
    for j in range(n):
        u = b[rows[j, 0]]
        v = b[rows[j, 1]] if 3 * j + 1 < size else 0.0
        w = b[rows[j, 2]] if 3 * j + 2 < size else 0.0
        a, c = x[j, 0] + scale[j, 0] * u, x[j, 1] + scale[j, 1] * u + scale[j, 2] * v
        d = x[j, 2] + scale[j, 3] * u + scale[j, 4] * v + scale[j, 5] * w
        u, v = pivots[j, 0] * a, pivots[j, 1] * a + pivots[j, 2] * c
        w = pivots[j, 3] * a + pivots[j, 4] * c + pivots[j, 5] * d
        x[j, 0], x[j, 1], x[j, 2] = u, v, w
        u, v, w = u * unit, v * unit, w * unit
        for p in range(np.uint64(starts[j]), np.uint64(starts[j + 1])):
            i = np.uint64(below[p])
            e = x[i, 0] - (L[p, 0, 0] * u + L[p, 1, 0] * v + L[p, 2, 0] * w)
            f = x[i, 1] - (L[p, 0, 1] * u + L[p, 1, 1] * v + L[p, 2, 1] * w)
            g = x[i, 2] - (L[p, 0, 2] * u + L[p, 1, 2] * v + L[p, 2, 2] * w)
            h = x[i, 3] - (L[p, 0, 3] * u + L[p, 1, 3] * v + L[p, 2, 3] * w)
            x[i, 0], x[i, 1], x[i, 2], x[i, 3] = e, f, g, h
    for j in range(n - 1, -1, -1):
        a0, a1, a2, a3, b0, b1, b2, b3, c0, c1, c2, c3 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        for p in range(np.uint64(starts[j]), np.uint64(starts[j + 1])):
            i = np.uint64(below[p])
            e, f, g, h = x[i, 0], x[i, 1], x[i, 2], x[i, 3]
            a0, a1, a2, a3 = a0 + L[p, 0, 0] * e, a1 + L[p, 0, 1] * f, a2 + L[p, 0, 2] * g, a3 + L[p, 0, 3] * h
            b0, b1, b2, b3 = b0 + L[p, 1, 0] * e, b1 + L[p, 1, 1] * f, b2 + L[p, 1, 2] * g, b3 + L[p, 1, 3] * h
            c0, c1, c2, c3 = c0 + L[p, 2, 0] * e, c1 + L[p, 2, 1] * f, c2 + L[p, 2, 2] * g, c3 + L[p, 2, 3] * h
        # four numbers at once up to here, if they are put side by side
        t[0, 0], t[0, 1], t[0, 2], t[0, 3] = a0, a1, a2, a3
        t[1, 0], t[1, 1], t[1, 2], t[1, 3] = b0, b1, b2, b3
        t[2, 0], t[2, 1], t[2, 2], t[2, 3] = c0, c1, c2, c3
        a = x[j, 0] - unit * (t[0, 0] + t[0, 1] + t[0, 2])
        c = x[j, 1] - unit * (t[1, 0] + t[1, 1] + t[1, 2])
        d = x[j, 2] - unit * (t[2, 0] + t[2, 1] + t[2, 2])
        u = pivots[j, 0] * a + pivots[j, 1] * c + pivots[j, 3] * d
        v, w = pivots[j, 2] * c + pivots[j, 4] * d, pivots[j, 5] * d
        x[j, 0], x[j, 1], x[j, 2] = u, v, w
        out[rows[j, 0]] = scale[j, 0] * u + scale[j, 1] * v + scale[j, 3] * w
        if 3 * j + 1 < size:
            out[rows[j, 1]] = scale[j, 2] * v + scale[j, 4] * w
        if 3 * j + 2 < size:
            out[rows[j, 2]] = scale[j, 5] * w
