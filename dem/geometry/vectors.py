"""Vectors of three numbers in compiled loops, as tuples."""

from __future__ import annotations

import numpy as np

from dem.compiled import inlined


@inlined
def plus(a, share, b):
    """a + share b."""
    return a[0] + share * b[0], a[1] + share * b[1], a[2] + share * b[2]


@inlined
def dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@inlined
def cross(a, b):
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@inlined
def turned(v, r, sine, versed):
    """v + sine r x v + versed r x (r x v): the vector v, turned by the rotation vector r with its `shares`, or by the
    quaternion (w, r) with 2 w and 2; with -sine the other way."""
    once = cross(r, v)
    return plus(plus(v, sine, once), versed, cross(r, once))


@inlined
def shares(r):
    """sin(a) / a and (1 - cos(a)) / a^2 of the angle a of a rotation vector."""
    square = dot(r, r)
    if square < 0.01:  # to rounding, and 1 - cos(a) keeps its figures
        sine = 1.0 - square * (1 / 6 - square * (1 / 120 - square * (1 / 5040 - square * (1 / 362880))))
        versed = 0.5 - square * (1 / 24 - square * (1 / 720 - square * (1 / 40320 - square * (1 / 3628800))))
    else:
        angle = np.sqrt(square)
        sine, versed = np.sin(angle) / angle, (1.0 - np.cos(angle)) / square
    return sine, versed
