"""Numbers of points along a Morton (Z-order) curve: points that are near in space have near numbers."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

BITS = 21  # per axis: three axes fill a signed 64-bit integer

#: Shifts and masks that spread the bits of a number to every third place, halving the stride of what is moved.
_SPREAD = (
    (32, 0x1F00000000FFFF), (16, 0x1F0000FF0000FF), (8, 0x100F00F00F00F00F), (4, 0x10C30C30C30C30C3),
    (2, 0x1249249249249249),
)  # fmt: skip


@dataclass(frozen=True)
class Frame:
    """The cube whose grid gives the numbers of points: its lower corner, and the length of its edges."""

    low: np.ndarray
    extent: float

    @classmethod
    def bounding(cls, points: np.ndarray) -> Frame:
        """The bounding cube of points (n, d)."""
        if len(points) == 0:
            return cls(np.zeros(1), 1.0)
        points = np.asarray(points, dtype=float).reshape(len(points), -1)
        return cls.between(points.min(axis=0), points.max(axis=0))

    @classmethod
    def between(cls, low: np.ndarray, high: np.ndarray) -> Frame:
        """A cube about the box between two corners: a flat box must not get flat cells."""
        return cls(low, max(float((high - low).max()), float(np.finfo(float).tiny)))


def morton_codes(points: np.ndarray, frame: Frame | None = None) -> np.ndarray:
    """Morton codes (n,) of points (n, up to 3): the interleaved bits of their coordinates on a grid over a cube.

    By default it is the bounding cube of the points.

    >>> morton_codes(np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [1.0, 1.0]])).argsort()
    array([0, 1, 2, 3])
    """
    frame, last = frame or Frame.bounding(points), 2**BITS - 1
    grid = np.clip(np.floor((points - frame.low) / (frame.extent / last)), 0, last).astype(np.int64)
    for shift, mask in _SPREAD:
        grid = (grid | (grid << shift)) & mask
    return np.bitwise_or.reduce(grid << np.arange(grid.shape[1]), axis=1)
