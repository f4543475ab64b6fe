"""Slots for the block rows of a sequence of matrices: the tree of the paper's evolving hierarchies.

A slot is a place in the order along which a train is quantised. With a grid it is the place of a point. Otherwise each
rank has a contiguous range of slots, in boxes of equal size along a Morton curve. If the block rows have names (the
Mat's attribute ``key``), a few slots stay empty. So the rows of the next matrix can take and leave places: a row that
stays near its box keeps its slot, and a new row gets the nearest empty slot. Then the cores of the last train are a
start for the next train.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from petsc4py import PETSc

from dem.morton import Frame, morton_codes
from pctt.mat.order import Places
from pctt.pc.ordering import block_order, grid_slots

SPARE = 0.06  # part of the slots that is empty at first
NEAR = 1  # a row moves only if it is more than this number of boxes from its box
REACH = 12  # the search for an empty slot goes this number of boxes far
FAR = 0.02  # part of the rows that may go further away


class Slots:
    """The slots of this rank's block rows.

    Attributes
    ----------
    place : (n,) slot of each block row of the present matrix, counted from ``first``
    first, size : first slot of this rank (0 with a grid), number of slots of all ranks
    capacity : number of slots of this rank; with a grid, of all ranks
    modes : slot modes of a grid; empty without a grid
    moved, entered, left : numbers of rows that got another slot, were new, or were gone at the last `follow`
    """

    def __init__(self, P: PETSc.Mat, places: Places, box: int, order: str = "auto"):
        """Put the rows in the order of a grid, or evenly along the curve; collective. ``box`` slots make a box."""
        count = P.getLocalSize()[0] // P.getBlockSize()
        keys, points = P.getAttr("key"), places.points
        self.box = box
        self.modes: tuple[int, ...] = ()
        self.moved = self.entered = self.left = 0
        self.evolving = False
        grid = grid_slots(P, places, order)
        if grid is not None:
            self.place, self.size, self.modes = grid
            self.first, self.capacity = 0, self.size
            return
        rows = np.argsort(block_order(P, places, order), kind="stable")
        spare = -(-int(np.ceil(count * (1 + SPARE))) // box) * box
        self.evolving = keys is not None and points is not None and order in ("auto", "morton")
        self.capacity = spare if self.evolving else count
        capacities = P.comm.tompi4py().allgather(self.capacity)
        self.first, self.size = sum(capacities[: P.comm.rank]), sum(capacities)
        self.place = np.empty(count, np.int64)
        self.place[rows] = np.arange(count) * self.capacity // max(count, 1)
        if self.evolving:
            assert points is not None
            self._frame = Frame.of(points)
            codes = morton_codes(points, self._frame)[rows]
            boxes = np.arange(self.capacity // box) * box
            first = np.searchsorted(self.place[rows], boxes)  # the first row at or after the start of each box
            self._starts = np.append(codes, np.iinfo(np.int64).max)[first]
            self._remember(keys)

    def _remember(self, keys: np.ndarray) -> None:
        by_key = np.argsort(keys)
        self._keys, self._key_places = np.asarray(keys)[by_key], self.place[by_key]

    @property
    def slots(self) -> np.ndarray:
        """(n,) slot of each block row of the present matrix, among those of all ranks."""
        return self.first + self.place

    def follow(self, P: PETSc.Mat, places: Places, agree: Callable[[bool], bool]) -> bool:
        """Take the rows of another matrix.

        If they do not fit or few rows would keep their slots, return False and change nothing. ``agree`` tells whether
        all ranks say yes.
        """
        keys, points = P.getAttr("key"), places.points
        place = None
        if self.evolving and keys is not None and points is not None:
            place = self._follow(np.asarray(keys), np.asarray(points, dtype=float))
        if not agree(place is not None):
            return False
        assert place is not None
        self.place = place
        self._remember(keys)
        return True

    def _follow(self, keys: np.ndarray, points: np.ndarray) -> np.ndarray | None:
        if len(keys) > self.capacity:
            return None
        at = np.minimum(np.searchsorted(self._keys, keys), max(len(self._keys) - 1, 0))
        known = self._keys[at] == keys if len(self._keys) else np.zeros(len(keys), bool)
        home = np.searchsorted(self._starts, morton_codes(points, self._frame), side="right") - 1
        home = np.clip(home, 0, len(self._starts) - 1)
        place = np.full(len(keys), -1)
        place[known] = self._key_places[at[known]]
        stays = known & (np.abs(place // self.box - home) <= NEAR)
        place[~stays] = -1
        self.moved = int((known & ~stays).sum())
        self.entered, self.left = int((~known).sum()), len(self._keys) - int(known.sum())
        if stays.sum() < 0.5 * len(keys):
            return None
        free = np.ones(self.capacity, bool)
        free[place[stays]] = False
        if free.sum() != self.capacity - stays.sum():  # two rows have the same name
            return None
        for distance in range(REACH + 1):
            for side in (1, -1) if distance else (1,):
                _settle(place, home + side * distance, free, self.box)
        far = np.flatnonzero(place < 0)
        if len(far) > FAR * len(keys):
            return None
        far = far[np.argsort(home[far], kind="stable")]
        place[far] = _nearest_in_order(home[far] * self.box, np.flatnonzero(free))
        return place


def _nearest_in_order(wanted: np.ndarray, empty: np.ndarray) -> np.ndarray:
    """A different slot of ``empty`` for each slot of ``wanted`` (n,), at or after it if possible; both ascend."""
    turn = np.arange(len(wanted))
    at = np.maximum.accumulate(np.searchsorted(empty, wanted) - turn) + turn
    return empty[np.minimum(at, len(empty) - len(wanted) + turn)]


def _settle(place: np.ndarray, target: np.ndarray, free: np.ndarray, box: int) -> None:
    """Give rows without a place (-1) empty slots of their target boxes, until these are full."""
    waiting = np.flatnonzero((place < 0) & (target >= 0) & (target < len(free) // box))
    if len(waiting) == 0:
        return
    waiting = waiting[np.argsort(target[waiting], kind="stable")]
    wanted = target[waiting]
    turn = np.arange(len(wanted)) - np.searchsorted(wanted, wanted)  # how many rows before wait for the same box
    empty = np.flatnonzero(free)
    start = np.searchsorted(empty, wanted * box)
    room = np.searchsorted(empty, (wanted + 1) * box) - start
    served = turn < room
    slots = empty[(start + turn)[served]]
    place[waiting[served]] = slots
    free[slots] = False
