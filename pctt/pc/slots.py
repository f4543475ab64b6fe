"""Slots for the block rows of a sequence of matrices: the tree of the paper's evolving hierarchies.

A slot is a place in the order along which a train is quantised. With a grid it is the place of a point. Otherwise each
rank has a contiguous range of slots, in boxes of equal size along a Morton curve. If the block rows have names (the
Mat's attribute ``key``), a few slots stay empty. So the rows of the next matrix can take and leave places: a row that
stays near its box keeps its slot, and a new row gets an empty slot nearby. Then the cores of the last train are a start
for the next train.

An empty slot stands for a row of the identity. Block scaling uses L_i L_i' = P_ii, where L_i^-T is the Cholesky factor
of P_ii^-1. The matrix becomes I + T with T_ij = L_i^-1 P_ij L_j^-T. Only T, which has no diagonal, is compressed. So
the identity stays exact, and a train of rank zero is block Jacobi.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
from mpi4py import MPI
from petsc4py import PETSc

from dem.exchange import on_all
from dem.geometry.morton import Frame, morton_codes
from pctt.blocks import inverse_diagonal_blocks
from pctt.mat.grid_train import TrainProduct
from pctt.mat.order import Places, chosen_order
from pctt.tt.quantise import GridDigits, choose_modes, group_modes, slots_of
from pctt.tt.train import Array

CSR = tuple[Array, Array, Array]  # row pointers, columns, values of this rank's rows


class Slots:
    """The slots of this rank's block rows.

    Attributes
    ----------
    place : (n,) slot of each block row of the present matrix, counted from ``first``
    first, size : first slot of this rank (0 with a grid), number of slots of all ranks
    capacity : number of slots of this rank; with a grid, of all ranks
    modes : slot modes of a grid; empty without a grid
    """

    def __init__(self, P: PETSc.Mat, places: Places, box: int, order: str = "auto"):
        """Put the rows in the order of a grid, or evenly along the curve; collective. ``box`` slots make a box.

        order : as in `chosen_order`; ValueError on all ranks if it lacks what it needs
        """
        count = P.getLocalSize()[0] // P.getBlockSize()
        keys, points = P.getAttr("key"), places.points
        self.box = box
        self.modes: tuple[int, ...] = ()
        order = chosen_order(order, places, "-pc_tt_order", stored=True, keyed=keys is not None)
        self.evolving = keys is not None and order == "morton"
        if order == "grid":
            self._take_grid(P, places)
            return
        rows = _local_order(P, points, order)
        spare = -(-int(np.ceil(1.06 * count)) // box) * box
        self.capacity = spare if self.evolving else count
        capacities = P.comm.tompi4py().allgather(self.capacity)
        self.first = sum(capacities[: P.comm.rank])
        self.size = slots_of(choose_modes(max(sum(capacities), 1), box))  # with the padding of a train
        self.place = np.empty(count, np.int64)
        self.place[rows] = np.arange(count) * self.capacity // max(count, 1)
        if self.evolving:
            assert points is not None
            self._frame = Frame.bounding(points)
            codes = morton_codes(points, self._frame)[rows]
            boxes = np.arange(self.capacity // box) * box
            first = np.searchsorted(self.place[rows], boxes)  # the first row at or after the start of each box
            self._starts = np.append(codes, np.iinfo(np.int64).max)[first]
            self._remember(keys)

    def _take_grid(self, P: PETSc.Mat, places: Places) -> None:
        """The modes have at most 16 slots at both ends."""
        assert places.grid is not None
        digits = GridDigits(places.grid)
        slots = digits.places
        if places.row_at is not None:
            slots = np.empty_like(slots)
            slots[places.row_at] = digits.places
        groups = np.cumsum([0, *group_modes(digits.modes, 16)])
        self.modes = tuple(int(np.prod(digits.modes[a:b])) for a, b in zip(groups[:-1], groups[1:]))
        first, last = (row // P.getBlockSize() for row in P.getOwnershipRange())
        self.place, self.first, self.size = slots[first:last], 0, digits.size
        self.capacity = self.size

    def _remember(self, keys: Array) -> None:
        by_key = np.argsort(keys)
        self._keys, self._key_places = np.asarray(keys)[by_key], self.place[by_key]

    @property
    def slots(self) -> Array:
        """(n,) slot of each block row of the present matrix, among those of all ranks."""
        return self.first + self.place

    def follow(self, P: PETSc.Mat, places: Places) -> bool:
        """Take the rows of another matrix; collective.

        If they do not fit or few rows would keep their slots, return False and change nothing.
        """
        keys, points = P.getAttr("key"), places.points
        place = None
        if self.evolving and keys is not None and points is not None:
            place = self._follow(np.asarray(keys), np.asarray(points, dtype=float))
        if not on_all(P.comm.tompi4py(), place is not None):
            return False
        assert place is not None
        self.place = place
        self._remember(keys)
        return True

    def _follow(self, keys: Array, points: Array) -> Array | None:
        """The new places: a known row stays within one box of its box; of the others 2 % may go beyond 12 boxes."""
        if len(keys) > self.capacity:
            return None
        at = np.minimum(np.searchsorted(self._keys, keys), max(len(self._keys) - 1, 0))
        known = self._keys[at] == keys if len(self._keys) else np.zeros(len(keys), bool)
        home = np.searchsorted(self._starts, morton_codes(points, self._frame), side="right") - 1
        home = np.clip(home, 0, len(self._starts) - 1)
        place = np.full(len(keys), -1)
        place[known] = self._key_places[at[known]]
        stays = known & (np.abs(place // self.box - home) <= 1)
        free = np.ones(self.capacity, bool)
        free[place[stays]] = False
        if 2 * stays.sum() < len(keys) or free.sum() != self.capacity - stays.sum():  # two rows have the same name
            return None
        others = np.flatnonzero(~stays)
        others = others[np.argsort(home[others], kind="stable")]
        wanted = home[others] * self.box
        place[others] = _nearest_in_order(wanted, np.flatnonzero(free))
        far = np.abs(place[others] - wanted) > 13 * self.box
        return None if far.sum() > 0.02 * len(keys) else place


def _local_order(P: PETSc.Mat, points: Array | None, order: str) -> Array:
    """The block rows of this rank, a permutation of 0 ... n-1: along a curve, by reverse Cuthill-McKee, or as given."""
    bs = P.getBlockSize()
    count = P.getLocalSize()[0] // bs
    if order == "natural" or count == 0:
        return np.arange(count)
    if order == "morton":
        assert points is not None
        return np.argsort(morton_codes(points), kind="stable")
    given, _ = P.getDiagonalBlock().getOrdering(PETSc.Mat.OrderingType.RCM)
    rows = given.getIndices().astype(np.int64)
    # an order of scalar rows: a block takes the place of its first row
    return rows if len(rows) == count else rows[rows % bs == 0] // bs


def _nearest_in_order(wanted: Array, empty: Array) -> Array:
    """A different slot of ``empty`` for each slot of ``wanted`` (n,), at or after it if possible; both ascend."""
    turn = np.arange(len(wanted))
    at = np.maximum.accumulate(np.searchsorted(empty, wanted) - turn) + turn
    return empty[np.minimum(at, len(empty) - len(wanted) + turn)]


class SlottedMatrix:
    """Local block rows of a Mat P, their slots, and their scaling.

    ``scale`` reads the diagonal blocks of P. ``list_blocks``, called once per pattern, and ``load`` read all blocks.
    Both take the rows of P in CSR format (``P.getValuesCSR()``).

    Attributes
    ----------
    size : number of slots of all ranks
    modes : slot modes of a grid; empty without a grid
    places : (rows,) slot of each block row of all ranks
    rows, columns : (nb,) slots of the local off-diagonal blocks
    root : (n, bs, bs) R_i = L_i^-1 of each local block row; identities without scaling
    """

    def __init__(self, P: PETSc.Mat, slots: Slots, comm: MPI.Comm, scaled: bool):
        self.comm, self.block, self.scaled = comm, P.getBlockSize(), scaled
        self.size, self.modes, self._slots = slots.size, slots.modes, slots.slots
        self._counts = np.array(comm.allgather(len(self._slots)))
        self.places = self._gathered(self._slots)
        self.root = np.tile(np.eye(self.block), (len(self._slots), 1, 1))
        self._csr: tuple[Array, ...] | None = None  # the pattern that is listed

    def lists(self, csr: CSR) -> bool:
        """Whether `list_blocks` has seen this pattern; collective. A Mat may get another one with as many nonzeros."""
        same = self._csr is not None and all(map(np.array_equal, self._csr, csr[:2]))
        return on_all(self.comm, same)

    def list_blocks(self, csr: CSR) -> None:
        """Find the blocks of P: ``rows`` and ``columns``."""
        self._csr = csr[:2]
        indptr, indices, values = csr
        numbers = np.arange(1, len(values) + 1, dtype=np.int32)  # of P's values
        scalar = sp.csr_matrix((numbers, indices, indptr), shape=(len(indptr) - 1, self.block * len(self.places)))
        pattern = scalar.tobsr((self.block, self.block))
        self._order = pattern.data - 1  # index of each entry of the blocks in P's values, -1 if P does not store it
        self._row = np.repeat(np.arange(len(self._slots)), np.diff(pattern.indptr))
        self._column = pattern.indices
        own = int(self._counts[: self.comm.rank].sum())  # the first block row of this rank
        empty = np.zeros(0, np.int64)
        if self.scaled:
            kept = np.flatnonzero(self._column != own + self._row)
            self._order, self._row, self._column = self._order[kept], self._row[kept], self._column[kept]
        else:  # empty slots hold a multiple of the identity; each rank has a share of them
            empty = np.setdiff1d(np.arange(self.size), self.places)
            empty = np.array_split(empty, self.comm.size)[self.comm.rank]
        self._empty = len(empty)
        self.rows = np.append(self._slots[self._row], empty)
        self.columns = np.append(self.places[self._column], empty)

    def scale(self, P: PETSc.Mat) -> bool:
        """Compute the roots of the present diagonal blocks of P; False if one of them is not positive definite."""
        good = True
        try:
            if self.scaled:
                self.root = np.linalg.cholesky(inverse_diagonal_blocks(P)).transpose(0, 2, 1)
        except np.linalg.LinAlgError:
            good = False
        return on_all(self.comm, good)

    def load(self, P: PETSc.Mat, csr: CSR) -> Array:
        """The present blocks (nb, bs, bs) of P at ``rows`` and ``columns``, with scaling multiplied by the roots of
        ``scale``."""
        blocks = np.append(csr[2], 0.0)[self._order]
        if self.scaled:
            return self.root[self._row] @ blocks @ self._gathered(self.root)[self._column].transpose(0, 2, 1)
        typical = P.getDiagonal().sum() / P.getSize()[0]
        return np.concatenate([blocks, np.tile(typical * np.eye(self.block), (self._empty, 1, 1))])

    def _gathered(self, local: Array) -> Array:
        """Rows (n, ...) of all ranks, in the order of the global block rows."""
        if self.comm.size == 1:
            return local
        width = int(np.prod(local.shape[1:]))
        out = np.empty((int(self._counts.sum()), *local.shape[1:]), local.dtype)
        self.comm.Allgatherv(np.ascontiguousarray(local), [out, self._counts * width])
        return out

    def scaled_vector(self, x: Array) -> Array:
        """This rank's part (n bs,) of L^-1 x."""
        return np.matmul(self.root, x.reshape(-1, self.block, 1)).ravel()

    def unscaled(self, z: Array) -> Array:
        """This rank's part (n bs,) of L^-T z."""
        return np.matmul(self.root.transpose(0, 2, 1), z.reshape(-1, self.block, 1)).ravel()

    def images(self, v: Array) -> Array:
        """This rank's part (n bs,) of L' v: a null vector of the scaled matrix for one of P."""
        return np.linalg.solve(self.root.transpose(0, 2, 1), v.reshape(-1, self.block, 1)).ravel()

    def spread(self, v: Array) -> Array:
        """All of a vector (size bs,) in the order of the slots, from this rank's part."""
        out = np.zeros((self.size, self.block))
        out[self.places] = self._gathered(v.reshape(-1, self.block))
        return out.ravel()

    def product(self) -> TrainProduct:
        """The product with a train of the slots, with rows in the order of the Mat."""
        slots = np.add.outer(self.places * self.block, np.arange(self.block)).ravel()
        return TrainProduct(self.comm, self._counts * self.block, slots, self.size * self.block)
