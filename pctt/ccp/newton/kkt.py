"""The Newton matrix of a method with constraints and multipliers, and what their elimination makes of it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pctt.arrays import Array


class KKT(NamedTuple):
    """What k constraints f < 0 per contact and their multipliers add to N in the Newton matrix of the perturbed
    conditions of optimality (paper, section 2.4),

        [N + M  B] [dg  ]   [r_g  ]
        [  C    E] [dlam] = [r_lam],    B = df', C = -lam df, E = -f.

    M : (nc, 3, 3) sum lam_i hess f_i, the paper's M-hat, and what else is to be added to N
    df : (nc, k, 3) gradients
    f, lam : (nc, k) values below and multipliers above zero
    """

    M: Array
    df: Array
    f: Array
    lam: Array

    def schur(self) -> Array:
        """M - B E^-1 C (nc, 3, 3), symmetric: with N the paper's S."""
        return self.M + np.einsum("ck,cki,ckj->cij", self.lam / -self.f, self.df, self.df)

    def reduced(self, r_g: Array, r_lam: Array) -> Array:
        """r_g - B E^-1 r_lam (nc, 3), the right-hand side of S dg."""
        return r_g + np.einsum("ck,cki->ci", r_lam / self.f, self.df)

    def multipliers(self, dg: Array, r_lam: Array) -> Array:
        """E^-1 (r_lam - C dg) (nc, k)."""
        return -(r_lam + self.lam * np.einsum("cki,ci->ck", self.df, dg)) / self.f
