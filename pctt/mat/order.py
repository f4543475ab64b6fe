"""What is known of the places of a Mat's rows, and the order of the rows in a train.

    grid      the attribute ``grid`` = (n_1, n_2, ...), the shape of a vector as an array (row i at
              numpy.unravel_index(i, grid)), a DMDA, or points that fill a grid: one axis after the other
    morton    along a space-filling curve through points (`Places.points`)
    rcm       reverse Cuthill-McKee, of a matrix with stored entries
    natural   the given order of the rows

`pctt.mat.entries.given` says where a user gives grid and coordinates.
"""

from __future__ import annotations

import numbers
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from math import prod
from typing import Any

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from dem.exchange import on_all
from dem.geometry.morton import morton_codes
from pctt.mat.entries import given
from pctt.tt.quantise import GridDigits
from pctt.tt.train import Array

LACKS = {
    "grid": "the Mat has no grid (its shape), or a DMDA",
    "morton": "the Mat has no coordinates",
    "rcm": "the Mat has no entries that are stored",
}
FILLED = 0.25  # part of a grid that points fill, so that products with it are worth an FFT


@dataclass(frozen=True)
class Places:
    """Where the block rows of a Mat are; the same sources on all ranks.

    grid : shape of the grid of the block rows, or None
    row_at : block row at each point of the grid, on all ranks; None if the block rows are in the order of the points
    points : (n, d) points of this rank's block rows, or None
    source : where the grid, or else the points, come from, in words
    around : shape of the smallest grid with all points, which need not fill it; None if they are scattered
    """

    grid: tuple[int, ...] | None = None
    row_at: Array | None = None
    points: Array | None = None
    source: str = "nothing"
    around: tuple[int, ...] | None = None

    def lattice(self, count: int) -> tuple[int, ...] | None:
        """The shape of a grid of two axes at least of which `count` points fill FILLED; None if there is none."""
        if self.around is None or sum(n > 1 for n in self.around) < 2 or count < FILLED * prod(self.around):
            return None
        return self.around


def places_of(P: PETSc.Mat, dms: Sequence[PETSc.DM] = (), coordinates: Array | None = None) -> Places:
    """All that is known of the places of P's block rows; collective.

    dms : DMs that may describe the rows, beside that of P
    coordinates : points of this rank's block rows from elsewhere (``PCSetCoordinates``); the attribute ``coordinates``
        of P goes before

    ValueError on all ranks if an attribute of P does not fit P.
    """
    comm = P.comm.tompi4py()
    fitting = [dm for dm in (P.getDM(), *dms) if dm.handle and _fits(dm, P, comm)]
    shape, row_at, source = _given_grid(P, comm), None, "the attribute grid"
    grids = [dm for dm in fitting if dm.getType() == PETSc.DM.Type.DA and dm.getDof() == P.getBlockSize()]
    if shape is None and grids:
        shape, source = tuple(grids[0].getSizes())[::-1], "a DMDA"  # the first coordinate is the fastest
        if comm.size > 1:
            first = np.arange(0, P.getSize()[0], P.getBlockSize(), dtype=PETSc.IntType)  # of each point
            row_at = grids[0].getAO().app2petsc(first).astype(np.int64) // P.getBlockSize()
    points, whence = given(P, "coordinates"), "the attribute coordinates"
    check_points(points, P, "coordinates of the Mat")
    if points is not None:
        points = np.asarray(points, dtype=float)
    elif on_all(comm, coordinates is not None):
        points, whence = coordinates, "PCSetCoordinates"
        check_points(points, P, "PCSetCoordinates: points")
    else:
        points, whence = _other_points(fitting, P, comm)
    around = shape
    if shape is None and points is not None:
        around, rows = _grid_of_points(points, comm)
        source = f"the grid of {whence}"
        if rows is not None:
            shape, row_at = around, None if np.array_equal(rows, np.arange(len(rows))) else rows
    return Places(shape, row_at, points, source if shape is not None else whence, around)


def check_points(points: object, P: PETSc.Mat, name: str) -> None:
    """ValueError on all ranks if points are wrong; collective.

    Allowed are finite numbers, a row per local block row. Points may also be None on all ranks.
    """
    count = P.getLocalSize()[0] // P.getBlockSize()
    wrong, width = "", 0
    if points is not None:
        try:
            array = np.asarray(points, dtype=float)
        except (TypeError, ValueError):
            wrong = "are no numbers"
        else:
            if array.shape not in {(count, d) for d in (1, 2, 3)}:
                wrong = f"have the shape {array.shape}"
            elif not np.isfinite(array).all():
                wrong = "have a NaN or infinity"
            else:
                width = array.shape[1]
    found = P.comm.tompi4py().allgather((width, wrong, count))
    for rank, (width, wrong, count) in enumerate(found):
        if wrong or width != found[0][0]:
            other = f"have {width} columns, on rank 0 {found[0][0]}," if width and found[0][0] else "are missing"
            raise ValueError(
                f"{name} {wrong or other} on rank {rank}; allowed are finite numbers of shape "
                f"({count}, 1), ({count}, 2) or ({count}, 3), a row per local block row"
            )


def _given_grid(P: PETSc.Mat, comm: MPI.Comm) -> tuple[int, ...] | None:
    grid = given(P, "grid")
    words = comm.allgather(None if grid is None else repr(grid))
    if any(word != words[0] for word in words):
        raise ValueError(f"the attribute grid of the Mat differs between ranks: {', '.join(map(str, words))}")
    if grid is None:
        return None
    count = P.getSize()[0] // P.getBlockSize()
    shape = whole_numbers(grid)
    if shape is None or prod(shape) != count:
        raise ValueError(
            f"the attribute grid of the Mat is {grid!r}; allowed are whole numbers whose product is the number of "
            f"block rows, {count}"
        )
    return shape


def _fits(dm: PETSc.DM, P: PETSc.Mat, comm: MPI.Comm) -> bool:
    """Whether a DM has points, and its global vectors the rows of P."""
    if dm.getType() != PETSc.DM.Type.DA and not dm.getCoordinates().handle:
        return False
    vec = dm.createGlobalVec()
    same = vec.getLocalSize() == P.getLocalSize()[0] and vec.getSize() == P.getSize()[0]
    vec.destroy()
    return on_all(comm, same)


def whole_numbers(grid: Any) -> tuple[int, ...] | None:
    """The shape of a grid; None if it is not a sequence of whole numbers >= 1."""
    try:
        shape = tuple(int(n) for n in grid if isinstance(n, numbers.Integral))
        return shape if len(shape) == len(tuple(grid)) > 0 and min(shape) >= 1 else None
    except TypeError:
        return None


def _other_points(dms: Sequence[PETSc.DM], P: PETSc.Mat, comm: MPI.Comm) -> tuple[Array | None, str]:
    """Points from the coordinates of a DM, or from a near null space; None if there are none."""
    count = P.getLocalSize()[0] // P.getBlockSize()
    for dm in dms:
        coordinates = dm.getCoordinates()
        if not coordinates.handle:
            continue
        width = dm.getCoordinateDim()
        if on_all(comm, coordinates.getLocalSize() == width * count):
            return coordinates.array_r.reshape(count, width).copy(), "the coordinates of a DM"
    points = _points_of_modes(P, comm)
    return points, "nothing" if points is None else "a near null space"


def _points_of_modes(P: PETSc.Mat, comm: MPI.Comm) -> Array | None:
    """Points from the near null space of P, up to an affine map; None if it is the same in all block rows.

    The rigid motions of a block row at x are affine functions of x. So the entries of all modes in a block row are an
    affine image of x, and their principal components are coordinates.
    """
    near = P.getNearNullSpace()
    vectors = near.getVecs() if near.handle else []
    if not vectors:
        return None
    block = P.getBlockSize()
    values = np.concatenate([v.array_r.reshape(-1, block) for v in vectors], axis=1)
    count = comm.allreduce(len(values))
    total = float(comm.allreduce(np.vdot(values, values)))
    values = values - comm.allreduce(values.sum(axis=0)) / count
    gram = comm.allreduce(values.T @ values)
    square, direction = comm.bcast(np.linalg.eigh(gram))  # signs may differ between processors
    kept = np.flatnonzero(square > 1e-10 * total)[-3:]  # the rest is rounding
    if len(kept) == 0:
        return None
    return values @ (direction[:, kept] / np.sqrt(square[kept] / count))


def _grid_of_points(points: Array, comm: MPI.Comm) -> tuple[tuple[int, ...] | None, Array | None]:
    """The shape of the smallest grid with the points (n, d) of all ranks, None if they are scattered; and the row at
    each point, None if they do not fill it."""
    count = comm.allreduce(len(points))
    ticks = []
    for axis in points.T:
        low = comm.allreduce(axis.min(initial=np.inf), op=MPI.MIN)
        extent = comm.allreduce(axis.max(initial=-np.inf), op=MPI.MAX) - low
        tick = np.round(1e9 * (axis - low) / (extent or 1.0)).astype(np.int64)  # equal ones are equal coordinates
        own = np.unique(tick)
        if comm.allreduce(len(own), op=MPI.MAX) > max(1, count // 2) and points.shape[1] > 1:
            return None, None  # scattered; their numbers need not be gathered
        all_ticks = np.unique(np.concatenate(comm.allgather(own)))
        ticks.append((all_ticks, np.searchsorted(all_ticks, tick)))
    shape = tuple(len(found) for found, _ in ticks)
    if prod(shape) != count:
        return shape, None
    places = np.zeros(len(points), np.int64)
    for n, (_, index) in zip(shape, ticks):
        places = places * n + index
    order = np.concatenate(comm.allgather(places))
    rows = np.argsort(order, kind="stable")
    if not np.array_equal(order[rows], np.arange(count)):
        return shape, None  # two rows at one point
    return shape, rows


def chosen_order(order: str, places: Places, name: str, stored: bool = False, keyed: bool = False) -> str:
    """grid, morton, rcm or natural; auto is the first of them for which there is what it needs.

    name : name of the option, for the ValueError if there is not what an order needs
    stored : whether the Mat has stored entries
    keyed : whether block rows have names, which come and go, so that there is no grid
    """
    known = {
        "grid": places.grid is not None and not (keyed and order == "auto"), "morton": places.points is not None,
        "rcm": stored, "natural": True,
    }  # fmt: skip
    if order == "auto":
        return next(one for one, there in known.items() if there)
    if not known[order]:
        allowed = ", ".join(["auto", *(one for one, there in known.items() if there)])
        raise ValueError(f"{name} {order}: {LACKS[order]}; allowed without are {allowed}")
    return order


@dataclass(frozen=True, eq=False)
class Layout:
    """The rows of a Mat on the ranks and in a train; the same on all ranks.

    counts : number of rows of each rank
    digits : of the grid of the points
    rows : the row at each point, or None if the rows are in the order of the points
    order : its name
    """

    comm: MPI.Comm
    counts: Array
    digits: GridDigits
    rows: Array | None
    order: str

    @cached_property
    def slots(self) -> Array:
        """The slot of each row in the train."""
        if self.rows is None:
            return self.digits.places
        slots = np.empty(self.digits.rows, np.int64)
        slots[self.rows] = self.digits.places
        return slots

    def agrees(self, other: Layout) -> bool:
        """Whether trains of both layouts can be added."""
        return (
            np.array_equal(self.counts, other.counts) and self.digits.modes == other.digits.modes
            and np.array_equal(self.slots, other.slots)
        )  # fmt: skip


def layout_of(P: PETSc.Mat, order: str = "auto", name: str = "order", places: Places | None = None) -> Layout:
    """The layout of the train of P. Collective; ValueError on all ranks for a bad grid.

    order, name : as in `chosen_order`, without rcm
    places : as `places_of` finds them
    """
    block, comm = P.getBlockSize(), P.comm.tompi4py()
    places = places or places_of(P)
    order = chosen_order(order, places, name)
    rows, shape = places.row_at, places.grid
    if order != "grid" or shape is None:
        rows, shape = None, (P.getSize()[0] // block,)
    if order == "morton":
        rows = np.argsort(morton_codes(np.concatenate(comm.allgather(places.points))), kind="stable")
    if rows is not None and block > 1:
        rows = np.add.outer(rows * block, np.arange(block)).ravel()
    return Layout(comm, np.array(comm.allgather(P.getLocalSize()[0])), GridDigits(shape, block), rows, order)
