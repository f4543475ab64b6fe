"""Cholesky factors of matrices of 6 x 6 blocks by fronts, in single or double precision, as a preconditioner.

The bodies are ordered by nested dissection: of each part the bodies in the middle, by place, have the fewest that keep
its two ends apart; these separate it in two halves; and so on. The bodies of a separator, or of a part that is not cut
further, make a *front*: a dense matrix of their columns and of the rows that these touch, which LAPACK factorises. So
nearly all work is that of dense matrices, and single precision is twice as fast and takes half of the memory. As a
preconditioner it is enough for all but the last systems of an interior point method, if the matrix is scaled first so
that its diagonal blocks are the identity.

Source: Duff and Reid (1983), multifrontal method; George (1973), nested dissection; Menger (1927), Dinic (1970), the
fewest bodies as the maximum flow.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import scipy.sparse as sp
from petsc4py import PETSc
from scipy.linalg import blas, lapack
from scipy.sparse import csgraph

from dem.compiled import inlined, loop
from pctt.blocks import Array
from pctt.body_matrix import Part
from pctt.petsc import Context

LEAF = 16  # bodies of a part that is not cut further; 40 take as long
HUB = 100  # neighbours of a body that is ordered last: such bodies touch both halves of nearly every cut
SHIFT = 1.0  # added to the scaled diagonal, in units of rounding; a tenth breaks down, ten times take more iterations
ONE = np.float32(1.0)
LEVELS = 30  # of cuts at most
BAND = 0.15  # part of the bodies on each side of the middle from which a separator is chosen; 0.1 and 0.2 do too
FAR = 1000  # bodies there that count as much as one beyond


class Front(NamedTuple):
    """The rows ``own`` of a front and those that its columns touch (``rest``), with L of both in Fortran order."""

    own: slice
    rest: np.ndarray
    diagonal: np.ndarray
    below: np.ndarray


class Dissection(NamedTuple):
    """The bodies (n,) in the order of nested dissection, those without neighbours first, and where each front begins in
    it, with n at the end."""

    order: np.ndarray
    first: np.ndarray

    def fits(self, part: Part) -> bool:
        """Whether it can be the order of this matrix: then its first bodies have no neighbours."""
        return bool((np.diff(part.indptr)[self.order[: self.first[0]]] == 1).all()) if len(self.first) else True


class Fronts:
    """L L' of a matrix, scaled to the identity in its diagonal blocks and a little shifted.

    points : (n, 1 to 3) places of the bodies, in any unit
    given : the dissection of another matrix of nearly the same pattern; without, or where it does not fit, there is an
        own one, ``dissection``
    numbers : that factor and fronts hold, for the tests of memory
    """

    def __init__(
        self, part: Part, points: Array, precision: type[np.floating] = np.float32, given: Dissection | None = None
    ):
        indptr, column, blocks = part
        count = len(indptr) - 1
        row = np.repeat(np.arange(count), np.diff(indptr))
        upper = row < column
        found = given if given is not None and given.fits(part) else dissected(points, row[upper], column[upper])
        self.dissection, (self.order, first) = found, found
        root = np.linalg.inv(np.linalg.cholesky(blocks[row == column]))
        self._precision, self._root = precision, root[self.order].astype(precision)
        new = np.empty(count, np.int64)
        new[self.order] = np.arange(count)
        below = np.flatnonzero(new[row] > new[column])
        below = below[np.lexsort((new[row[below]], new[column[below]]))]
        scaled = root[row[below]] @ blocks[below] @ root[column[below]].transpose(0, 2, 1)
        starts = np.searchsorted(new[column[below]], np.arange(count + 1))
        self.fronts = _factorised(first, starts, new[row[below]], scaled.astype(precision))

    @property
    def numbers(self) -> int:
        return sum(front.diagonal.size + front.below.size for front in self.fronts)

    def solve(self, b: Array) -> Array:
        """About A^-1 b, for b (6 n,) in double precision."""
        scaled = b.reshape(-1, 6, 1)[self.order].astype(self._precision)
        x = (self._root @ scaled).ravel()
        trsv = blas.get_blas_funcs("trsv", dtype=self._precision)
        for own, rest, diagonal, below in self.fronts:
            x[own] = trsv(diagonal, x[own], lower=1)
            x[rest] -= below @ x[own]
        for own, rest, diagonal, below in reversed(self.fronts):
            x[own] = trsv(diagonal, x[own] - below.T @ x[rest], lower=1, trans=1)
        out = np.empty((len(self.order), 6))
        out[self.order] = (x.reshape(-1, 1, 6) @ self._root)[:, 0]
        return out.ravel()


def _factorised(first: np.ndarray, starts: np.ndarray, rows: np.ndarray, blocks: np.ndarray) -> list[Front]:
    """The fronts of the ordered matrix, whose columns below the diagonal have the ``rows`` and ``blocks`` from
    ``starts`` on; ``first`` says where each front begins, and the number of bodies."""
    fronts: list[Front] = []
    trsm, syrk = blas.get_blas_funcs(("trsm", "syrk"), dtype=blocks.dtype)
    updates: list[list[tuple[np.ndarray, np.ndarray]]] = [[] for _ in first[1:]]
    place = np.zeros(len(starts), np.int64)
    for k, (begin, end) in enumerate(zip(first, first[1:])):
        touched = [rows[starts[begin] : starts[end]], *(bodies for bodies, _ in updates[k])]
        bodies = np.unique(np.concatenate(touched))
        bodies = bodies[np.searchsorted(bodies, end) :]
        own, rest = 6 * (end - begin), 6 * len(bodies)
        shapes = (own, own), (rest, own), (rest, rest)
        diagonal, below, update = (np.zeros(shape, blocks.dtype, "F") for shape in shapes)
        place[begin:end], place[bodies] = np.arange(end - begin), np.arange(len(bodies))
        add_columns(starts, rows, blocks, begin, end, place, diagonal, below)
        for others, values in updates[k]:
            add_update(values, others, end, place, diagonal, below, update)
        updates[k] = []
        diagonal = _cholesky(diagonal)
        if rest:
            below = trsm(1.0, diagonal, below, side=1, lower=1, trans_a=1, overwrite_b=1)
            update = syrk(-1.0, below, beta=1.0, c=update, lower=1, overwrite_c=1)
            updates[np.searchsorted(first, bodies[0], "right") - 1].append((bodies, update))
        entries = (6 * bodies[:, None] + np.arange(6)).ravel()
        fronts.append(Front(slice(6 * begin, 6 * end), entries, diagonal, below))
    return fronts


def _cholesky(matrix: np.ndarray) -> np.ndarray:
    """L of a matrix (lower triangle) with a little more on its diagonal: where rounding has made it indefinite, ten
    times more than before."""
    shift, wrong, L, where = SHIFT * np.finfo(matrix.dtype).eps, 1, matrix, np.arange(len(matrix))
    potrf = lapack.get_lapack_funcs("potrf", dtype=matrix.dtype)
    while wrong and shift < 1.0:
        matrix[where, where] += matrix.dtype.type(shift)
        L, wrong = potrf(matrix, lower=1, clean=0)
        shift *= 10.0
    return L


@inlined
def _add(block, to, r, c):
    for b in range(6):
        for a in range(6):
            to[r + a, c + b] += block[a, b]


@loop
def add_columns(starts, rows, blocks, begin, end, place, diagonal, below):
    """Add the columns begin to end of the matrix to a front."""
    for j in range(begin, end):
        c = 6 * place[j]
        for a in range(6):
            diagonal[c + a, c + a] += ONE
        for p in range(starts[j], starts[j + 1]):
            r = 6 * place[rows[p]]
            if rows[p] < end:
                _add(blocks[p], diagonal, r, c)
            else:
                _add(blocks[p], below, r, c)


@loop
def add_update(values, bodies, end, place, diagonal, below, update):
    """Add what an earlier front leaves in the lower triangle of its ``bodies`` to a front."""
    for q in range(len(bodies)):
        c = 6 * place[bodies[q]]
        for p in range(q, len(bodies)):
            r, block = 6 * place[bodies[p]], values[6 * p : 6 * p + 6, 6 * q : 6 * q + 6]
            if bodies[p] < end:
                _add(block, diagonal, r, c)
            elif bodies[q] < end:
                _add(block, below, r, c)
            else:
                _add(block, update, r, c)


# -- the order of the bodies ------------------------------------------------------------------------------------


def dissected(points: Array, row: np.ndarray, column: np.ndarray) -> Dissection:
    """The `Dissection` of bodies at points (n, 1 to 3); ``row`` and ``column``: the pairs of bodies, each once."""
    count = len(points)
    name, group = np.zeros((2, count), np.int64)  # of a front: a digit for each level, 0 and 1 the halves, 2 between
    neighbours = np.bincount(row, minlength=count) + np.bincount(column, minlength=count)
    active = (neighbours > 0) & (neighbours <= HUB)
    name[neighbours > HUB], name[neighbours == 0] = 1 << 61, -1
    for level in range(LEVELS):
        _, part, sizes = np.unique(group[active], return_inverse=True, return_counts=True)
        active[active] = sizes[part] > LEAF
        if not active.any():
            break
        place = _places(points, group, active)
        inside = active[row] & active[column] & (group[row] == group[column])
        between, high = separated(place, row[inside], column[inside])
        name[active] |= np.where(between, 2, high)[active] << 2 * (LEVELS - 1 - level)
        group = 2 * group + high
        active &= ~between
    order = np.argsort(name, kind="stable")
    return Dissection(order, np.flatnonzero(np.diff(name[order], prepend=-1, append=-1)))


def _places(points: Array, group: np.ndarray, active: np.ndarray) -> Array:
    """The places (n,) of the active bodies in their group along its longest axis, by order: from 0 to 1. -1 for
    others."""
    bodies = np.flatnonzero(active)
    bodies = bodies[np.argsort(group[bodies], kind="stable")]
    _, start, part, sizes = np.unique(group[bodies], return_index=True, return_inverse=True, return_counts=True)
    here = points[bodies]
    length = np.maximum.reduceat(here, start) - np.minimum.reduceat(here, start)
    along = here[np.arange(len(here)), length.argmax(axis=1)[part]]
    order = np.lexsort((along, part))
    places = np.full(len(points), -1.0)
    places[bodies[order]] = (np.arange(len(order)) - start[part] + 0.5) / sizes[part]
    return places


def separated(place: Array, row: np.ndarray, column: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Masks (n,) of the bodies between two halves, and of the upper half (0 or 1), for bodies at places from 0 to 1,
    or -1: not among them. Of the ``row`` and ``column`` pairs none is in both halves.

    The fewest bodies within BAND of the middle that keep the others apart, those beyond taken only where it must be. By
    Menger's theorem they are where a flow from the lower end to the upper one is at its maximum, if no more goes
    through a body than it counts."""
    count, bodies = len(place), np.flatnonzero(place >= 0.0)
    low, high = bodies[place[bodies] < 0.5 - BAND], bodies[place[bodies] > 0.5 + BAND]
    size, source, sink = np.ones(count, np.int32), 2 * count, 2 * count + 1  # a body is 2 i -> 2 i + 1
    size[low] = size[high] = FAR
    much = np.full(2 * len(row) + len(low) + len(high), FAR**2, np.int32)
    start = np.concatenate([2 * bodies, 2 * row + 1, 2 * column + 1, np.full(len(low), source), 2 * high + 1])
    end = np.concatenate([2 * bodies + 1, 2 * column, 2 * row, 2 * low, np.full(len(high), sink)])
    room = sp.csr_matrix((np.concatenate([size[bodies], much]), (start, end)), shape=(2 * count + 2,) * 2)
    found = csgraph.maximum_flow(room, source, sink)
    rest = room - (found.flow if hasattr(found, "flow") else found.residual)  # as it was named before scipy 1.9
    rest.data = np.maximum(rest.data, 0)
    rest.eliminate_zeros()
    reached = np.zeros(2 * count + 2, bool)
    reached[csgraph.breadth_first_order(rest, source, return_predecessors=False)] = True
    entered, left = reached[0:-2:2], reached[1:-2:2]
    return entered & ~left, (~left & (place >= 0.0)).astype(np.int64)


def places_in(part: Part) -> Array:
    """Places (n, 1) for bodies whose points are not known: their numbers in a breadth-first order."""
    count = len(part.indptr) - 1
    graph = sp.csr_matrix((np.ones(len(part.indices), np.int8), part.indices, part.indptr), shape=(count, count))
    places = np.empty((count, 1))
    places[csgraph.reverse_cuthill_mckee(graph, symmetric_mode=True), 0] = np.arange(count)
    return places


class FrontPC(Context):
    """The PC of the `Fronts` that ``make`` makes; the one who makes the PC sets it, for each matrix."""

    without = PETSc.PC.Type.NONE
    make: Callable[[], Fronts]
    fronts: Fronts | None = None

    def setUp(self, pc: PETSc.PC) -> None:
        self.fronts = None  # first, as it may fill the memory
        self.fronts = self.make()

    def apply(self, pc: PETSc.PC, x: PETSc.Vec, y: PETSc.Vec) -> None:
        assert self.fronts is not None
        y.array_w[:] = self.fronts.solve(x.array_r)

    def reset(self, pc: PETSc.PC) -> None:
        self.fronts = None
