"""The grid to which the rows of a Mat belong, and the order of the rows in a train.

    grid      ``grid`` = (n_1, n_2, ...), the shape of a vector as an array (row i at numpy.unravel_index(i, grid)), or
              the DMDA of the Mat: one axis after the other
    morton    along a space-filling curve through the points ``coordinates``
    natural   the given order of the rows

`pctt.mat.entries.given` says where a user gives grid and coordinates.
"""

from __future__ import annotations

import numbers
from math import prod
from typing import Any

import numpy as np
from petsc4py import PETSc

from pctt.mat.entries import given
from pctt.morton import morton_codes
from pctt.tt.grid import GridDigits
from pctt.tt.train import Array


def grid_of(P: PETSc.Mat) -> tuple[tuple[int, ...], Array | None] | None:
    """The shape of the grid of P's block rows, and the block row at each point of the grid; collective.

    The second is None if the block rows are in the order of the points. The result is None if there is no grid.
    ValueError on all ranks if the grid does not fit.
    """
    count = P.getSize()[0] // P.getBlockSize()
    comm = P.comm.tompi4py()
    grid = given(P, "grid")
    words = comm.allgather(None if grid is None else repr(grid))
    if any(word != words[0] for word in words):
        raise ValueError(f"the attribute grid of the Mat differs between ranks: {', '.join(map(str, words))}")
    if grid is not None:
        shape = whole_numbers(grid)
        if shape is None or prod(shape) != count:
            raise ValueError(
                f"the attribute grid of the Mat is {grid!r}; allowed are whole numbers whose product is the number of "
                f"block rows, {count}"
            )
        return shape, None
    dm = P.getDM()
    if not dm.handle or dm.getType() != PETSc.DM.Type.DA or dm.getDof() != P.getBlockSize():
        return None
    shape = tuple(dm.getSizes())[::-1]  # the first coordinate is the fastest
    if comm.size == 1:
        return shape, None
    return shape, _natural_order(dm, P.getBlockSize())


def whole_numbers(grid: Any) -> tuple[int, ...] | None:
    """The shape of a grid; None if it is not a sequence of whole numbers >= 1."""
    try:
        shape = tuple(int(n) for n in grid if isinstance(n, numbers.Integral))
        return shape if len(shape) == len(tuple(grid)) > 0 and min(shape) >= 1 else None
    except TypeError:
        return None


def _natural_order(dm: PETSc.DM, block: int) -> Array:
    """Block row of each point of a distributed DMDA in the natural order, on all ranks."""
    own, natural = dm.createGlobalVec(), dm.createNaturalVec()
    first, last = own.getOwnershipRange()
    own.array_w[:] = np.arange(first, last)
    dm.globalToNatural(own, natural)
    parts = dm.comm.tompi4py().allgather(natural.array_r[::block].copy())
    for vec in (own, natural):
        vec.destroy()
    return (np.concatenate(parts) / block).round().astype(np.int64)


def digits_of(P: PETSc.Mat, order: str, name: str) -> tuple[GridDigits, Array | None, str]:
    """The digits of P's rows, the row at each point (None if rows are in the order of points), and the chosen order.

    order : auto, grid, morton or natural; auto takes the first of the others for which P has the data
    name : name of the option, for the ValueError if P lacks the data
    """
    block = P.getBlockSize()
    grid = grid_of(P) if order in ("auto", "grid") else None
    if grid is not None:
        shape, rows = grid
        return GridDigits(shape, block=block), _scalar(rows, block), "grid"
    count = P.getSize()[0] // block
    points = given(P, "coordinates")  # it was checked: all ranks have it or none
    if points is not None and order in ("auto", "morton"):
        parts = P.comm.tompi4py().allgather(np.asarray(points, dtype=float).reshape(-1, np.shape(points)[-1]))
        codes = morton_codes(np.concatenate(parts))
        return GridDigits((count,), block=block), _scalar(np.argsort(codes, kind="stable"), block), "morton"
    if order in ("auto", "natural"):
        return GridDigits((count,), block=block), None, "natural"
    lacks = {"grid": "grid (its shape), or a DMDA", "morton": "coordinates", "rcm": "entries that are stored"}
    raise ValueError(f"{name} {order}: the Mat has no {lacks[order]}; allowed without is auto or natural")


def _scalar(rows: Array | None, block: int) -> Array | None:
    if rows is None or block == 1:
        return rows
    return np.add.outer(rows * block, np.arange(block)).ravel()
