"""Broad phase: pairs of bounding spheres that come close."""

from __future__ import annotations

import numpy as np

from dem.arrays import Floats, Ints
from dem.compiled import loop


def close_pairs(position: Floats, radius: Floats) -> Ints:
    """Rows (m, 2), the lower first, of all pairs of spheres that touch or overlap, and some more.

    position (n, 3), radius (n,). Spheres are sorted into classes of radii within a factor of two, with one
    grid each, so that a few large ones do not widen the search among many small ones.
    """
    level = np.frexp(radius / radius.min(initial=np.inf))[1]  # alike ones are in one class
    classes = [np.flatnonzero(level == size) for size in np.unique(level)]
    pairs = [np.zeros((0, 2), np.int64)]
    for k, rows in enumerate(classes):
        for others in classes[k:]:
            fewer, more = sorted((rows, others), key=len)
            pairs.append(pairs_in_cells(position, radius, fewer, more, others is rows))
    return np.concatenate(pairs)


@loop
def pairs_in_cells(center: Floats, radius: Floats, first: Ints, second: Ints, alike: bool) -> Ints:
    """Pairs (m, 2), the lower row first, of a sphere of the rows `first` and one of the rows `second` that touch, to
    rounding.

    first, second: the same rows if `alike`, else without common ones. Those of `second` are sorted into cubic cells, so
    wide that a pair is at most one cell apart. Cells share a cube of buckets, so that a sphere far away costs nothing;
    four buckets a side are enough to tell neighbours apart.
    """
    largest = 0.0
    for row in second:
        largest = max(largest, radius[row])
    width = largest
    for row in first:
        width = max(width, (radius[row] + largest) * (1.0 + 1e-6))
    per = 1.0 / width
    side = 4
    while side * side * side < len(second):
        side *= 2
    last = side - 1
    bucket, start = np.empty(len(second), np.int64), np.zeros(side * side * side + 1, np.int64)
    for k in range(len(second)):
        x, y, z = center[second[k], 0] * per, center[second[k], 1] * per, center[second[k], 2] * per
        bucket[k] = ((int(np.floor(x)) & last) * side + (int(np.floor(y)) & last)) * side + (int(np.floor(z)) & last)
        start[bucket[k] + 1] += 1
    for k in range(len(start) - 1):
        start[k + 1] += start[k]
    member, place, free = np.empty(len(second), np.int64), np.empty((len(second), 4)), start[:-1].copy()
    for k in range(len(second)):
        to = free[bucket[k]]
        free[bucket[k]] += 1
        member[to], place[to, 3] = second[k], radius[second[k]]
        place[to, 0], place[to, 1], place[to, 2] = center[second[k], 0], center[second[k], 1], center[second[k], 2]

    # Alike, the rows are taken in the order of their cells, each with those behind it: every pair comes once.
    rows, cells = member if alike else first, (largest, per, side, start, place, member)
    pairs, found, done = np.empty((8 * len(first) + 8, 2), np.int64), np.int64(0), np.int64(0)
    while True:
        done, found = _pairs_of_rows((center, radius), rows, done, alike, cells, pairs, found)
        if done == len(rows):
            return pairs[:found].copy()
        more = np.empty((len(pairs) + max(len(pairs), len(second)), 2), np.int64)
        more[:found] = pairs[:found]
        pairs = more


@loop
def _pairs_of_rows(spheres, rows, done, alike, cells, pairs, found):
    """Add to the first pairs those of the rows that are not done, as long as there is room; new numbers of rows done
    and pairs found. A loop that makes the room itself takes twice the time."""
    (center, radius), (largest, per, side, start, place, member) = spheres, cells
    last = side - 1
    for n in range(done, len(rows)):
        i, behind, before = rows[n], n + 1 if alike else 0, found
        a, b, c, r = center[i, 0], center[i, 1], center[i, 2], radius[i]
        out = (r + largest) * (1.0 + 1e-9)
        bottom, top = int(np.floor((c - out) * per)), int(np.floor((c + out) * per))
        for x in range(int(np.floor((a - out) * per)), int(np.floor((a + out) * per)) + 1):
            for y in range(int(np.floor((b - out) * per)), int(np.floor((b + out) * per)) + 1):
                column, z = ((x & last) * side + (y & last)) * side, bottom
                while z <= top:  # cells whose buckets follow each other at once
                    until = min(z | last, top)
                    begin, end = max(start[column + (z & last)], behind), start[column + (until & last) + 1]
                    z = until + 1
                    if found + end - begin > len(pairs):
                        return n, before
                    for k in range(begin, end):
                        u, v, w = place[k, 0] - a, place[k, 1] - b, place[k, 2] - c
                        most = (r + place[k, 3]) * (1.0 + 1e-12)
                        if u * u + v * v + w * w <= most * most:
                            pairs[found, 0], pairs[found, 1] = min(i, member[k]), max(i, member[k])
                            found += 1
    return len(rows), found
