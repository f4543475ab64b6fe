"""The additional terms of Coulomb's law in an iteration of `conic`: the derivative of the opening.

The velocity of a contact has the opening mu |y_t| added to its normal part. Newton's method takes its derivative along:
with u = y_t / |y_t|,

    dz = T (G dv + C dg) + r_z,    T = 1 + e_n u',

which adds a term of rank one per contact to the elimination of ds, and makes the Newton systems unsymmetric. (Openings
that lag behind converge by a fifth per cone problem, each solved exactly.)
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pctt.ccp.cone import TINY, Array, dot, tangential, times
from pctt.ccp.interior.lorentz import determinant


def opened(y: Array) -> Array:
    """(y_n + |y_t|, y_t) of scaled velocities y (nc, 3): inside the cones if y_n > 0."""
    z = y.copy()
    z[:, 0] += tangential(y)
    return z


def closed(z: Array) -> Array:
    """The y (nc, 3) of which z is `opened`."""
    y = z.copy()
    y[:, 0] = determinant(z) / (z[:, 0] + tangential(z))
    return y


def sliding_directions(z: Array) -> Array:
    """The directions (nc, 3) in which contacts with scaled velocities z slide; zero without sliding."""
    u = z.copy()
    u[:, 0] = 0.0
    return u / np.maximum(tangential(z), TINY)[:, None]


class Slip(NamedTuple):
    """The rank-one terms of all contacts.

    In the scaled variables ds = X (c - r_z - T G dv) with X^-1 = W^-2 + e T, e the compliance. With Y^-1 = W^-2 + e
    this is X = (1 - e p u'/ d) Y and X T = Y + p (u - e Y u)' / d, where p = Y e_n, d = 1 + e u'p.
    """

    u: Array  #: (nc, 3) direction in which a contact slides
    p: Array  #: (nc, 3)
    less: Array  #: (nc, 1) e / d
    blocks: Array  #: (nc, 3, 3) X T - Y

    @classmethod
    def of(cls, inverse: Array, u: Array, scale: Array, compliance: Array) -> Slip:
        """``inverse`` is Y in the unscaled variables, (nc, 3, 3); ``compliance`` (nc, 1) is e."""
        p = scale[:, :1] * inverse[:, :, 0]
        d = 1.0 + compliance * dot(u, p)[:, None]
        q = (u - compliance * times(inverse, u)) / d
        return cls(u, p, compliance / d, p[:, :, None] * q[:, None, :])

    def reduce(self, uncoupled: Array) -> None:
        """Y c becomes X c, in place."""
        uncoupled -= self.p * (self.less * dot(self.u, uncoupled)[:, None])

    def change(self, dy: Array) -> Array:
        """T dy (nc, 3), the change of z to first order."""
        dz = dy.copy()
        dz[:, 0] += dot(self.u, dy)
        return dz
