"""Broad phase: pairs of bounding spheres that come close."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from dem.arrays import Floats, Ints


def close_pairs(position: Floats, radius: Floats, reach: float) -> Ints:
    """Rows (m, 2), the lower first, of all pairs of spheres that come within `reach` [m], and some more.

    position (n, 3), radius (n,). Spheres are sorted into classes of radii within a factor of two, with one
    tree each, so that a few large ones do not widen the search among many small ones.
    """
    level = np.frexp(radius)[1]
    classes = []
    for size in np.unique(level):
        rows = np.flatnonzero(level == size)
        tree = cKDTree(position[rows], compact_nodes=False, balanced_tree=False)
        classes.append((rows, tree, float(radius[rows].max())))
    pairs = [np.zeros((0, 2), np.int64)]
    for k, (rows, tree, largest) in enumerate(classes):
        pairs.append(rows[tree.query_pairs(2 * largest + reach, output_type="ndarray")])
        for other_rows, other, other_largest in classes[k + 1 :]:
            near = tree.sparse_distance_matrix(other, largest + other_largest + reach, output_type="ndarray")
            pairs.append(np.stack([rows[near["i"]], other_rows[near["j"]]], axis=1))
    return np.sort(np.concatenate(pairs), axis=1)
