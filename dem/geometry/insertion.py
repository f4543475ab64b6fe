"""Where there is room for spheres among others: one after another, each at the first of its places that is free."""

from __future__ import annotations

import numpy as np

from dem.arrays import Bools, Floats, Ints
from dem.compiled import loop


def inserted(
    place: Floats, free: Bools, radius: Floats, center: Floats, others: Floats, period: Floats | None = None
) -> Ints:
    """Which of its places (n, tries) each of n spheres takes, -1 for the first that finds none and all after it.

    place (n, tries, 3), of which those that are `free` (n, tries) come into question; radius (n,); spheres that are
    there already have centres (m, 3) and radii `others` (m,). `period` (3,), inf: none [m].
    """
    n, m = len(place), len(others)
    if n == 0:
        return np.zeros(0, np.int64)
    every = np.concatenate([place.reshape(-1, 3), center])
    low, high = every.min(axis=0), every.max(axis=0)
    period = np.full(3, np.inf) if period is None else period
    periodic = np.isfinite(period)
    low, wide = np.where(periodic, 0.0, low), np.where(periodic, period, np.maximum(high - low, 1e-300))
    width = 2.0 * max(radius.max(), others.max(initial=0.0)) * (1.0 + 1e-9)
    cells = np.clip(np.floor(wide / width), 1, 128).astype(np.int64)
    spheres = np.concatenate([center, np.zeros((n, 3))]), np.concatenate([others, radius])
    taken: Ints = _insert(place, free, spheres, m, (low, wide, cells, period))
    return taken


@loop
def _insert(place, free, spheres, known, grid):
    (center, radius), cells, n = spheres, grid[2], len(place)
    first = np.full(cells[0] * cells[1] * cells[2], -1, np.int64)
    following, taken, at = np.full(known + n, -1, np.int64), np.full(n, -1, np.int64), np.zeros(3, np.int64)
    for k in range(known):
        cell = _cell(center[k], grid, at)
        following[k] = first[cell]
        first[cell] = k
    for k in range(n):
        for t in range(place.shape[1]):
            if free[k, t] and _fits(place[k, t], radius[known + k], spheres, (first, following), grid, at):
                taken[k] = t
                center[known + k] = place[k, t]
                cell = _cell(place[k, t], grid, at)
                following[known + k] = first[cell]
                first[cell] = known + k
                break
        if taken[k] < 0:
            break
    return taken


@loop
def _cell(point, grid, at):
    """The number of the cell of a point, and its numbers `at` (3,) per axis."""
    low, wide, cells, period = grid
    for k in range(3):
        c = int(np.floor((point[k] - low[k]) / wide[k] * cells[k]))
        at[k] = c % cells[k] if np.isfinite(period[k]) else min(max(c, 0), cells[k] - 1)
    return (at[0] * cells[1] + at[1]) * cells[2] + at[2]


@loop
def _fits(point, radius, spheres, chains, grid, at):
    """Whether a sphere at a point touches none of those in the cells about it: the first of each cell, and the one that
    follows each."""
    (center, radii), (first, following), (_, _, cells, period) = spheres, chains, grid
    _cell(point, grid, at)
    a, b, c = at[0], at[1], at[2]
    for x in range(a - 1, a + 2):
        for y in range(b - 1, b + 2):
            for z in range(c - 1, c + 2):
                i, j, h = x, y, z
                if np.isfinite(period[0]):
                    i = x % cells[0]
                elif x < 0 or x >= cells[0]:
                    continue
                if np.isfinite(period[1]):
                    j = y % cells[1]
                elif y < 0 or y >= cells[1]:
                    continue
                if np.isfinite(period[2]):
                    h = z % cells[2]
                elif z < 0 or z >= cells[2]:
                    continue
                k = first[(i * cells[1] + j) * cells[2] + h]
                while k >= 0:
                    square, reach = 0.0, (radius + radii[k]) * (1.0 + 1e-12)
                    for s in range(3):
                        d = point[s] - center[k, s]
                        if np.isfinite(period[s]):
                            d -= period[s] * np.floor(d / period[s] + 0.5)
                        square += d * d
                    if square < reach * reach:
                        return False
                    k = following[k]
    return True
