"""Broad phase: pairs of bounding spheres that come close."""

from __future__ import annotations

from collections.abc import Iterator
from types import ModuleType

import numpy as np
from scipy.spatial import cKDTree

from dem.arrays import Floats, Ints
from dem.loops import loops


def close_pairs(position: Floats, radius: Floats) -> Ints:
    """Rows (m, 2), the lower first, of all pairs of spheres that touch or overlap, and some more.

    position (n, 3), radius (n,). Spheres are sorted into classes of radii within a factor of two, with one
    tree or grid each, so that a few large ones do not widen the search among many small ones.
    """
    level = np.frexp(radius)[1]
    classes = [np.flatnonzero(level == size) for size in np.unique(level)]
    if compiled := loops():
        pairs = _pairs_in_cells(compiled, np.ascontiguousarray(position), radius, classes)
    else:
        pairs = _pairs_of_trees(position, radius, classes)
    return np.concatenate([np.zeros((0, 2), np.int64), *pairs])


def _pairs_in_cells(compiled: ModuleType, position: Floats, radius: Floats, classes: list[Ints]) -> Iterator[Ints]:
    for k, rows in enumerate(classes):
        for others in classes[k:]:
            few, many = sorted((rows, others), key=len)
            yield compiled.pairs_in_cells(position, radius, few, many, others is rows)


def _pairs_of_trees(position: Floats, radius: Floats, classes: list[Ints]) -> Iterator[Ints]:
    trees = [cKDTree(position[rows], compact_nodes=False, balanced_tree=False) for rows in classes]
    largest = [float(radius[rows].max()) for rows in classes]
    for k, rows in enumerate(classes):
        yield np.sort(rows[trees[k].query_pairs(2 * largest[k], output_type="ndarray")], axis=1)
        for n in range(k + 1, len(classes)):
            near = trees[k].sparse_distance_matrix(trees[n], largest[k] + largest[n], output_type="ndarray")
            yield np.sort(np.stack([rows[near["i"]], classes[n][near["j"]]], axis=1), axis=1)
