"""Orders of the block rows of a matrix in which points that are near in space have near numbers."""

from __future__ import annotations

import numpy as np
from petsc4py import PETSc

from pctt.mat.order import grid_of
from pctt.morton import morton_codes
from pctt.tt.grid import GridDigits
from pctt.tt.quantise import group_modes

ENDS = 16  # largest number of slots in the first and in the last mode of a grid


def block_order(P: PETSc.Mat, order: str = "auto") -> np.ndarray:
    """Places (n,) of the local block rows of P among those of this rank, a permutation of 0 ... n-1.

    morton : along a Morton curve through the points in the Mat's attribute ``coordinates``, an array (n, 3), (n, 2) or
        (n, 1) with a row per local block row (``P.setAttr("coordinates", points)``)
    rcm : reverse Cuthill-McKee order of this rank's part
    natural : the given order
    auto : morton if there are points, else rcm

    ValueError if morton is asked for and there are no points.
    """
    bs = P.getBlockSize()
    count = P.getLocalSize()[0] // bs
    points = P.getAttr("coordinates")  # on all ranks or on none
    if order == "morton" and points is None:
        raise ValueError("-pc_tt_order morton: the Mat has no coordinates; allowed without is auto, rcm or natural")
    if order == "natural" or count == 0:
        return np.arange(count)
    if points is not None and order != "rcm":
        codes = morton_codes(np.asarray(points, dtype=float).reshape(count, -1))
        rows = np.argsort(codes, kind="stable")
    else:
        given, _ = P.getDiagonalBlock().getOrdering(PETSc.Mat.OrderingType.RCM)
        rows = given.getIndices().astype(np.int64)
        if len(rows) != count:  # the order is of scalar rows; a block takes the place of its first row
            rows = rows[rows % bs == 0] // bs
    place = np.empty(count, np.int64)
    place[rows] = np.arange(count)
    return place


def grid_slots(P: PETSc.Mat, order: str) -> tuple[np.ndarray, int, tuple[int, ...]] | None:
    """The slot of each local block row among those of this rank, the number of slots, and the slot modes, in the order
    of a grid. None if P has no grid, or if ``order`` does not ask for it. Collective.

    ValueError on all ranks if the grid does not fit. The same if ``order`` asks for a grid and P has none, or if the
    points of the grid are distributed over the ranks in another order.
    """
    if order not in ("auto", "grid") or (order == "auto" and P.getAttr("key") is not None):
        return None
    grid = grid_of(P)
    if grid is None or grid[1] is not None:
        if order == "auto":
            return None
        lacks = "grid (its shape), or a DMDA" if grid is None else "rows in the order of its grid"
        raise ValueError(f"-pc_tt_order grid: the Mat has no {lacks}; allowed without is auto, morton, rcm or natural")
    digits = GridDigits(grid[0])
    first, last = (row // P.getBlockSize() for row in P.getOwnershipRange())
    places = np.append(digits.places, digits.size)
    start, end = (int(places[row]) if row else 0 for row in (first, last))
    groups = np.cumsum([0, *group_modes(digits.modes, ENDS)])
    modes = tuple(int(np.prod(digits.modes[a:b])) for a, b in zip(groups[:-1], groups[1:]))
    return places[first:last] - start, end - start, modes
