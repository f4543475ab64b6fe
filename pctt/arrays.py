"""Arrays of numbers, and products of rows of three."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dem.compiled import loop

Array = NDArray[np.float64]
TINY = float(np.finfo(float).tiny)  #: the least positive number with all digits


@loop
def all_from(x: Array, least: float) -> bool:
    """Whether all numbers (n,) are finite, and not below the least."""
    wrong = 0
    for k in range(len(x)):
        wrong += not (np.isfinite(x[k]) and x[k] >= least)
    return wrong == 0


def tangential(x: Array) -> Array:
    """|(g_1, g_2)| (nc,). (Five times as fast as np.hypot; no impulse is near the ends of the range of numbers.)"""
    t = x[:, 1] * x[:, 1]
    t += x[:, 2] * x[:, 2]
    return np.sqrt(t, out=t)


def dot(x: Array, y: Array) -> Array:
    """Inner products of rows (nc,). (Six times as fast as a sum along rows of three.)"""
    out: Array = x[:, 0] * y[:, 0]
    out += x[:, 1] * y[:, 1]
    out += x[:, 2] * y[:, 2]
    return out
