"""Orders of the block rows of a matrix in which points that are near in space have near numbers."""

from __future__ import annotations

import numpy as np
from petsc4py import PETSc

from dem.morton import morton_codes
from pctt.mat.order import LACKS, Places
from pctt.tt.grid import GridDigits
from pctt.tt.quantise import group_modes

ENDS = 16  # largest number of slots in the first and in the last mode of a grid


def block_order(P: PETSc.Mat, places: Places, order: str = "auto") -> np.ndarray:
    """Places (n,) of the local block rows of P among those of this rank, a permutation of 0 ... n-1.

    morton : along a Morton curve through the points of ``places``
    rcm : reverse Cuthill-McKee order of this rank's part
    natural : the given order
    auto : morton if there are points, else rcm

    ValueError if morton is asked for and there are no points.
    """
    bs = P.getBlockSize()
    count = P.getLocalSize()[0] // bs
    if order == "morton" and places.points is None:
        raise ValueError(f"-pc_tt_order morton: {LACKS[order]}; allowed without is auto, rcm or natural")
    if order == "natural" or count == 0:
        return np.arange(count)
    if places.points is not None and order != "rcm":
        rows = np.argsort(morton_codes(places.points), kind="stable")
    else:
        given, _ = P.getDiagonalBlock().getOrdering(PETSc.Mat.OrderingType.RCM)
        rows = given.getIndices().astype(np.int64)
        if len(rows) != count:  # the order is of scalar rows; a block takes the place of its first row
            rows = rows[rows % bs == 0] // bs
    place = np.empty(count, np.int64)
    place[rows] = np.arange(count)
    return place


def grid_slots(P: PETSc.Mat, places: Places, order: str) -> tuple[np.ndarray, int, tuple[int, ...]] | None:
    """The slot of each local block row, the number of slots of all ranks, and the slot modes, in the order of a grid.

    None if P has no grid, or if ``order`` does not ask for it. ValueError on all ranks if ``order`` asks for a grid and
    P has none.
    """
    if order not in ("auto", "grid") or (order == "auto" and P.getAttr("key") is not None):
        return None
    if places.grid is None:
        if order == "auto":
            return None
        raise ValueError(f"-pc_tt_order grid: {LACKS[order]}; allowed without is auto, morton, rcm or natural")
    digits = GridDigits(places.grid)
    slots = digits.places
    if places.row_at is not None:
        slots = np.empty_like(slots)
        slots[places.row_at] = digits.places
    first, last = (row // P.getBlockSize() for row in P.getOwnershipRange())
    groups = np.cumsum([0, *group_modes(digits.modes, ENDS)])
    modes = tuple(int(np.prod(digits.modes[a:b])) for a, b in zip(groups[:-1], groups[1:]))
    return slots[first:last], digits.size, modes
