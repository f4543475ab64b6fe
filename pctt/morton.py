"""Numbers of points along a Morton curve: points that are near in space have near numbers."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

_BITS = 21  # per axis: three axes fill a signed 64-bit integer


@dataclass(frozen=True)
class Frame:
    """The cube whose grid gives the numbers of points."""

    low: np.ndarray
    extent: float

    @classmethod
    def of(cls, points: np.ndarray) -> Frame:
        """The bounding cube of points (n, d)."""
        if len(points) == 0:
            return cls(np.zeros(1), 1.0)
        points = np.asarray(points, dtype=float).reshape(len(points), -1)
        low = points.min(axis=0)
        return cls(low, max(float((points.max(axis=0) - low).max()), float(np.finfo(float).tiny)))


def morton_codes(points: np.ndarray, frame: Frame | None = None) -> np.ndarray:
    """Morton codes (n,) of points (n, up to 3): the interleaved bits of their coordinates on a grid over a cube.

    By default it is the bounding cube of the points.

    >>> morton_codes(np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [1.0, 1.0]])).argsort()
    array([0, 1, 2, 3])
    """
    codes = np.zeros(len(points), np.int64)
    frame = Frame.of(points) if frame is None else frame
    place = np.clip((points - frame.low) / frame.extent, 0.0, 1.0)
    grid = (place * (2**_BITS - 1)).astype(np.int64)
    for bit in range(_BITS):
        for axis in range(grid.shape[1]):
            codes |= ((grid[:, axis] >> bit) & 1) << (3 * bit + axis)
    return codes
