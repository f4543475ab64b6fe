"""Factors of matrices of 6 x 6 blocks by fronts, in single or double precision, as a preconditioner: L L' of
symmetric ones, L U of others.

The bodies are ordered by nested dissection: of each part the bodies in the middle, by place, have the fewest that keep
its two ends apart; these separate it in two halves; and so on. The bodies of a separator, or of a part that is not cut
further, make a *front*: a dense matrix of their columns and of the rows that these touch, which LAPACK factorises. So
nearly all work is that of dense matrices, and single precision is twice as fast and takes half of the memory. As a
preconditioner it is enough for all but the last systems of an interior point method, if the matrix is scaled first so
that its diagonal blocks are the identity. Of a matrix that is not symmetric the entries above the diagonal are kept as
those below it of its transpose, and rows are swapped within a front only.

On several ranks the first cuts part the bodies among them. Each rank factorises the fronts of its part; those of the
first separators, to which all parts add, all ranks factorise alike. A rank keeps its own fronts and these.

Source: Duff and Reid (1983), multifrontal method; George (1973), nested dissection; Menger (1927), Dinic (1970), the
fewest bodies as the maximum flow.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, TypeVar

import numpy as np
import scipy.sparse as sp
from mpi4py import MPI
from petsc4py import PETSc
from scipy.linalg import blas, lapack
from scipy.sparse import csgraph

from dem.compiled import inlined, loop
from dem.exchange import exchange, offsets, on_any, on_first
from pctt.blocks import Array
from pctt.body_matrix import Part
from pctt.petsc import Context

LEAF = 16  # bodies of a part that is not cut further; 40 take as long
DENSE = 100  # neighbours of a body that is ordered last: such bodies touch both halves of nearly every cut
SHIFT = 1.0  # added to the scaled diagonal, in units of rounding; a tenth breaks down, ten times take more iterations
ONE = np.float32(1.0)
Out = TypeVar("Out")
LEVELS = 30  # of cuts at most
HUBS = 1 << 61  # the name of their front, behind all others
BAND = 0.15  # part of the bodies on each side of the middle from which a separator is chosen; 0.1 and 0.2 do too
FAR = 1000  # bodies there that count as much as one beyond


class Front(NamedTuple):
    """The rows ``own`` of a front and those that its columns touch (``rest``), in Fortran order: L of both; or L and U
    in one ``diagonal``, L ``below``, U' of the rest (``beside``), and the rows of its own as they were ``swapped``."""

    own: slice
    rest: np.ndarray
    diagonal: np.ndarray
    below: np.ndarray
    beside: np.ndarray | None = None
    swapped: np.ndarray | None = None


class Dissection(NamedTuple):
    """The bodies (n,) in the order of nested dissection, those without neighbours first; where each front begins in it,
    with n at the end; and the rank that has it, -1: all ranks."""

    order: np.ndarray
    first: np.ndarray
    rank: np.ndarray

    def fits(self, row: np.ndarray, column: np.ndarray) -> bool:
        """Whether it can be the order of a matrix with entries of these bodies: its first bodies have no neighbours
        there, and no entry joins the parts of two ranks."""
        front, rank = (of_place[self.places] for of_place in (self.front_of(np.arange(len(self.order))), self.ranks))
        separate = (row != column) & (np.minimum(front[row], front[column]) < 0)
        one, other = rank[row], rank[column]
        return not (separate | ((one >= 0) & (other >= 0) & (one != other))).any()

    def front_of(self, places: np.ndarray) -> np.ndarray:
        """The fronts to which these places in the order belong; -1: none."""
        return np.searchsorted(self.first, places, "right") - 1

    @property
    def places(self) -> np.ndarray:
        """The places (n,) of the bodies in the order."""
        places = np.empty(len(self.order), np.int64)
        places[self.order] = np.arange(len(self.order))
        return places

    @property
    def ranks(self) -> np.ndarray:
        """The ranks (n,) of the places in the order, -1: all."""
        return np.append(self.rank, -1)[self.front_of(np.arange(len(self.order)))]


#: Where each column of an ordered matrix begins, its rows below the diagonal, and their blocks.
Columns = tuple[np.ndarray, np.ndarray, np.ndarray]

#: Of a front: what earlier ones leave in the columns of some bodies (in the lower triangle), and these.
Updates = dict[int, list[tuple[np.ndarray, np.ndarray]]]


class MultifrontalFactors:
    """L L' of a matrix, scaled to the identity in its diagonal blocks and a little shifted, or L U of one that is not
    ``symmetric``; collective. LinAlgError or MemoryError on all ranks if such a block of any is not positive definite,
    or one has no room.

    part : the rows of this rank's bodies
    points : (n, 1 to 3) places of these bodies, in any unit; None on all ranks where they are not known
    given : the dissection of another matrix of nearly the same pattern; without, or where it does not fit, there is an
        own one, ``dissection``
    own, shared : the fronts that this rank has, and those that all have
    """

    def __init__(
        self, comm: MPI.Comm, part: Part, points: Array | None, precision: type[np.floating] = np.float32,
        given: Dissection | None = None, symmetric: bool = True,
    ):  # fmt: skip
        indptr, column, blocks = part
        starts = offsets(comm, len(indptr) - 1)
        here, count = np.arange(starts[comm.rank], starts[comm.rank + 1]), int(starts[-1])
        row = np.repeat(here, np.diff(indptr))
        if given is None or on_any(comm, not given.fits(row, column))[0]:
            given = _dissection(comm, points, row, column, count)
        self.dissection, self._comm, self._precision = given, comm, precision
        left, right = _on_all(comm, lambda: _roots(blocks[row == column], symmetric))
        new, rank = given.places, given.ranks
        self._here, self._left, self._right = new[here], left.astype(precision), right.astype(precision)
        self._of_all, self._kept = rank < 0, (rank == comm.rank) | ((rank < 0) & (comm.rank == 0))
        left, right = (np.concatenate(comm.allgather(roots)) for roots in (left, right))

        def scaled(which: np.ndarray) -> np.ndarray:
            return (left[row[which]] @ blocks[which] @ right[column[which]].transpose(0, 2, 1)).astype(precision)

        i, j = new[row], new[column]
        sides = [_columns(comm, given, i[i > j], j[i > j], scaled(i > j))]
        if not symmetric:
            sides.append(_columns(comm, given, j[i < j], i[i < j], scaled(i < j).transpose(0, 2, 1)))
        own, shared = np.flatnonzero(given.rank == comm.rank), np.flatnonzero(given.rank < 0)
        updates: Updates = {}
        self.own = _on_all(comm, lambda: _factorised(own, given.first, sides, updates))
        every = _of_all_ranks(comm, updates, np.dtype(precision))
        self.shared = _on_all(comm, lambda: _factorised(shared, given.first, sides, every))

    def solve(self, b: Array) -> Array:
        """About A^-1 b, for this rank's b (6 n,) in double precision; collective."""
        x = np.zeros((len(self._kept), 6), self._precision)
        x[self._here] = (self._left @ b.reshape(-1, 6, 1).astype(self._precision))[:, :, 0]
        x = self._summed(x)
        x[~self._kept] = 0
        self._forwards(self.own, x.ravel())
        x[self._of_all] = self._summed(x[self._of_all])
        self._forwards(self.shared, x.ravel())
        self._backwards(self.shared, x.ravel())
        self._backwards(self.own, x.ravel())
        x[~self._kept] = 0
        x = self._summed(x)
        return (x[self._here, None] @ self._right).astype(float).ravel()

    def _summed(self, x: np.ndarray) -> np.ndarray:
        """The sum over the ranks."""
        if self._comm.size > 1:
            self._comm.Allreduce(MPI.IN_PLACE, x)
        return x

    def _forwards(self, fronts: list[Front], x: np.ndarray) -> None:
        trsv = blas.get_blas_funcs("trsv", dtype=self._precision)
        for own, rest, diagonal, below, _, swapped in fronts:
            if swapped is None:
                x[own] = trsv(diagonal, x[own], lower=1)
            else:
                x[own] = trsv(diagonal, x[own][swapped], lower=1, diag=1)
            x[rest] -= below @ x[own]

    def _backwards(self, fronts: list[Front], x: np.ndarray) -> None:
        trsv = blas.get_blas_funcs("trsv", dtype=self._precision)
        for own, rest, diagonal, below, beside, _ in reversed(fronts):
            if beside is None:
                x[own] = trsv(diagonal, x[own] - below.T @ x[rest], lower=1, trans=1)
            else:
                x[own] = trsv(diagonal, x[own] - beside.T @ x[rest])


def _roots(diagonal: Array, symmetric: bool) -> tuple[Array, Array]:
    """Of diagonal blocks D (n, 6, 6) the R and S with R D S' = 1, equal ones if D is symmetric; else S is diagonal."""
    if symmetric:
        root = np.linalg.inv(np.linalg.cholesky(diagonal))
        return root, root
    size = np.abs(np.diagonal(diagonal, axis1=1, axis2=2))
    right = np.eye(6) / np.sqrt(np.maximum(size, np.finfo(float).tiny))[:, :, None]
    return np.linalg.inv(diagonal @ right), right


def _on_all(comm: MPI.Comm, work: Callable[[], Out]) -> Out:
    """What some work gives; if it fails on any rank, an error on all: no rank waits for one that has left."""
    done, error = None, None
    try:
        done = work()
    except (np.linalg.LinAlgError, MemoryError) as raised:
        error = raised
    if on_any(comm, error is not None)[0]:
        raise error or np.linalg.LinAlgError("factors failed on another rank")
    return done  # type: ignore[return-value]


def _columns(
    comm: MPI.Comm, found: Dissection, row: np.ndarray, column: np.ndarray, blocks: np.ndarray
) -> Columns:
    """The columns of this rank's fronts and of those of all, from the entries that the ranks have."""
    rank = found.rank[found.front_of(column)]
    lower, shared = {"row": row, "column": column, "blocks": blocks}, rank < 0
    parts = comm.allgather({name: values[shared] for name, values in lower.items()})
    parts.append(exchange(comm, {name: values[~shared] for name, values in lower.items()}, rank[~shared]))
    row, column, blocks = (np.concatenate([part[name] for part in parts]) for name in lower)
    order = np.lexsort((row, column))
    return np.searchsorted(column[order], np.arange(len(found.order) + 1)), row[order], blocks[order]


def _factorised(which: np.ndarray, first: np.ndarray, sides: list[Columns], updates: Updates) -> list[Front]:
    """Some fronts, ascending, of the ordered matrix, from its columns and, if it is not symmetric, those of its
    transpose; ``first`` says where each front begins, and the number of bodies. What they leave to others is added to
    the ``updates``."""
    fronts: list[Front] = []
    factorise: Callable[..., tuple[tuple, np.ndarray]] = _cholesky if len(sides) == 1 else _lu
    kind, place = sides[0][2].dtype, np.zeros(len(sides[0][0]), np.int64)
    for k in which.tolist():
        begin, end, added = first[k], first[k + 1], updates.pop(k, [])
        touched = [rows[starts[begin] : starts[end]] for starts, rows, _ in sides]
        bodies = np.unique(np.concatenate([*touched, *(bodies for bodies, _ in added)]))
        bodies = bodies[np.searchsorted(bodies, end) :]
        own, rest = 6 * (end - begin), 6 * len(bodies)
        diagonal, update = (np.zeros((size, size), kind, "F") for size in (own, rest))
        parts = [np.zeros((rest, own), kind, "F") for _ in sides]
        place[begin:end], place[bodies] = np.arange(end - begin), np.arange(len(bodies))
        diagonal[np.arange(own), np.arange(own)] = ONE
        for side, (columns, part) in enumerate(zip(sides, parts)):
            to = (diagonal.T, part, update.T) if side else (diagonal, part, update)
            add_columns(*columns, begin, end, place, to[:2])
            for others, values in added:
                add_update(values.T if side else values, others, end, place, to, side)
        front, update = factorise(diagonal, *parts, update)
        if rest:
            updates.setdefault(int(np.searchsorted(first, bodies[0], "right")) - 1, []).append((bodies, update))
        entries = (6 * bodies[:, None] + np.arange(6)).ravel()
        fronts.append(Front(slice(6 * begin, 6 * end), entries, *front))
    return fronts


def _of_all_ranks(comm: MPI.Comm, updates: Updates, kind: np.dtype) -> Updates:
    """The updates that the ranks leave to the fronts of all, on all ranks."""
    if comm.size == 1:
        return updates
    every: Updates = {}
    known = [(k, bodies) for k, added in updates.items() for bodies, _ in added]
    own = iter([values for added in updates.values() for _, values in added])
    for rank, names in enumerate(comm.allgather(known)):
        for k, bodies in names:
            size = 6 * len(bodies)
            values = next(own) if rank == comm.rank else np.empty((size, size), kind, "F")
            comm.Bcast(values.T, root=rank)
            every.setdefault(k, []).append((bodies, values))
    return every


def _cholesky(matrix: np.ndarray, below: np.ndarray, update: np.ndarray) -> tuple[tuple, np.ndarray]:
    """L of a front (lower triangle) with a little more on its diagonal: where rounding has made it indefinite, ten
    times more than before; and the update less what it takes."""
    shift, wrong, L, where = SHIFT * np.finfo(matrix.dtype).eps, 1, matrix, np.arange(len(matrix))
    potrf = lapack.get_lapack_funcs("potrf", dtype=matrix.dtype)
    trsm, syrk = blas.get_blas_funcs(("trsm", "syrk"), dtype=matrix.dtype)
    while wrong and shift < 1.0:
        matrix[where, where] += matrix.dtype.type(shift)
        L, wrong = potrf(matrix, lower=1, clean=0)
        shift *= 10.0
    if len(below):
        below = trsm(1.0, L, below, side=1, lower=1, trans_a=1, overwrite_b=1)
        update = syrk(-1.0, below, beta=1.0, c=update, lower=1, overwrite_c=1)
    return (L, below), update


def _lu(matrix: np.ndarray, below: np.ndarray, beside: np.ndarray, update: np.ndarray) -> tuple[tuple, np.ndarray]:
    """L U of a front, and the update less what it takes."""
    getrf = lapack.get_lapack_funcs("getrf", dtype=matrix.dtype)
    trsm, gemm = blas.get_blas_funcs(("trsm", "gemm"), dtype=matrix.dtype)
    both, pivots, _ = getrf(matrix, overwrite_a=1)
    where, swapped = np.flatnonzero(np.diagonal(both) == 0), np.arange(len(both))
    both[where, where] = np.finfo(matrix.dtype).eps  # singular
    for i, pivot in enumerate(pivots.tolist()):
        swapped[i], swapped[pivot] = swapped[pivot], swapped[i]
    if len(below):
        below = trsm(1.0, both, below, side=1, overwrite_b=1)
        beside = np.asfortranarray(beside[:, swapped])
        beside = trsm(1.0, both, beside, side=1, lower=1, trans_a=1, diag=1, overwrite_b=1)
        update = gemm(-1.0, below, beside, beta=1.0, c=update, trans_b=1, overwrite_c=1)
    return (both, below, beside, swapped), update


@inlined
def _add(block, to, r, c):
    for b in range(6):
        for a in range(6):
            to[r + a, c + b] += block[a, b]


@loop
def add_columns(starts, rows, blocks, begin, end, place, front):
    """Add the columns begin to end of the matrix to the diagonal of a front and what is below."""
    diagonal, below = front
    for j in range(begin, end):
        c = 6 * place[j]
        for p in range(starts[j], starts[j + 1]):
            r = 6 * place[rows[p]]
            if rows[p] < end:
                _add(blocks[p], diagonal, r, c)
            else:
                _add(blocks[p], below, r, c)


@loop
def add_update(values, bodies, end, place, front, first):
    """Add what an earlier front leaves in the lower triangle of its ``bodies``, from the ``first`` diagonal on, to a
    front: to its diagonal, what is below, and its own update."""
    diagonal, below, update = front
    for q in range(len(bodies)):
        c = 6 * place[bodies[q]]
        for p in range(q + first, len(bodies)):
            r, block = 6 * place[bodies[p]], values[6 * p : 6 * p + 6, 6 * q : 6 * q + 6]
            if bodies[p] < end:
                _add(block, diagonal, r, c)
            elif bodies[q] < end:
                _add(block, below, r, c)
            else:
                _add(block, update, r, c)


# -- the order of the bodies ------------------------------------------------------------------------------------


def _dissection(
    comm: MPI.Comm, points: Array | None, row: np.ndarray, column: np.ndarray, count: int
) -> Dissection:
    """That of the bodies of all ranks, found by the first from the entries of each."""
    low, high = np.minimum(row, column), np.maximum(row, column)
    known = np.zeros((0, 1)) if points is None else points
    parts = comm.gather((known, np.unique(np.stack([low, high])[:, low < high], axis=1))) or []

    def find() -> Dissection:
        places = np.concatenate([part[0] for part in parts])
        one, other = np.unique(np.concatenate([part[1] for part in parts], axis=1), axis=1)
        return dissected(places_in(count, one, other) if points is None else places, one, other, comm.size)

    return on_first(comm, find)


def dissected(points: Array, row: np.ndarray, column: np.ndarray, ranks: int = 1) -> Dissection:
    """The `Dissection` of bodies at points (n, 1 to 3); ``row`` and ``column``: the pairs of bodies, each once."""
    count = len(points)
    name, group = np.zeros((2, count), np.int64)  # of a front: a digit for each level, 0 and 1 the halves, 2 between
    neighbours = np.bincount(row, minlength=count) + np.bincount(column, minlength=count)
    active = (neighbours > 0) & (neighbours <= DENSE)
    name[neighbours > DENSE], name[neighbours == 0] = HUBS, -1
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
    first = np.flatnonzero(np.diff(name[order], prepend=-1, append=-1))
    return Dissection(order, first, _ranks(name[order][first[:-1]], ranks))


def _ranks(name: np.ndarray, ranks: int) -> np.ndarray:
    """Which rank has the fronts of these names, -1: all. The first cuts make 2^k parts, about as many for each rank;
    what separates parts of several ranks is of all."""
    levels = (ranks - 1).bit_length()
    part, parts = np.zeros((2, len(name)), np.int64)
    parts += 1 << levels
    for level in range(levels):
        digit = name >> 2 * (LEVELS - 1 - level) & 3
        inside = (digit < 2) & (parts == 1 << (levels - level))
        parts = np.where(inside, parts // 2, parts)
        part += np.where(inside, digit * parts, 0)
    one, other = (part * ranks) >> levels, ((part + parts - 1) * ranks) >> levels
    return np.where((one == other) & (name < HUBS), one, -1)


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


def places_in(count: int, row: np.ndarray, column: np.ndarray) -> Array:
    """Places (count, 1) for bodies whose points are not known: their numbers in a breadth-first order of the pairs."""
    graph = sp.csr_matrix((np.ones(len(row), np.int8), (row, column)), shape=(count, count))
    places = np.empty((count, 1))
    places[csgraph.reverse_cuthill_mckee((graph + graph.T).tocsr(), symmetric_mode=True), 0] = np.arange(count)
    return places


class MultifrontalPC(Context):
    """The PC of the `MultifrontalFactors` that ``make`` makes; the one who makes the PC sets it, for each matrix."""

    without = PETSc.PC.Type.NONE
    make: Callable[[], MultifrontalFactors]
    fronts: MultifrontalFactors | None = None

    def setUp(self, pc: PETSc.PC) -> None:
        self.fronts = None  # first, as it may fill the memory
        self.fronts = self.make()

    def apply(self, pc: PETSc.PC, x: PETSc.Vec, y: PETSc.Vec) -> None:
        assert self.fronts is not None
        y.array_w[:] = self.fronts.solve(x.array_r)

    def reset(self, pc: PETSc.PC) -> None:
        self.fronts = None
