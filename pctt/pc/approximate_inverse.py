"""The inverse of a compressed matrix as a train.

The matrix is I + T where it was scaled to a diagonal of identities, T its compressed off-diagonal part; else T.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pctt.tt.als import Compression
from pctt.tt.cross import Cross
from pctt.tt.inverse import invert, invert_near_identity, lowest, residual
from pctt.tt.root import inverse_root
from pctt.tt.train import Train, identity


@dataclass(frozen=True)
class ApproximateInverse:
    """The trains of an inverse: X, or I + Z with ``identity``, or Z Z' with ``squared``.

    residual : of the inverse of the train of the matrix
    of : the compression that was inverted
    cap : of the ranks
    """

    train: Train
    residual: float
    of: Compression | Cross
    cap: int
    identity: bool = False
    squared: bool = False


def invert_by_als(
    of: Compression | Cross, cap: int, scaled: bool, start: Train | None, rng: np.random.Generator
) -> tuple[ApproximateInverse, bool]:
    """X or I + Z by alternating minimisation, from a start if there is one, and whether no direction was found in
    which it is negative."""
    if not scaled:
        found = invert(of.train, cap, start, rng=rng)
        return ApproximateInverse(found.train, found.residual, of, cap), lowest(found.train) > 0
    found = invert_near_identity(of.train, cap, start, rng=rng)
    assert found.correction is not None
    inverse = ApproximateInverse(found.correction, found.residual, of, cap, identity=True)
    return inverse, lowest(found.train) > 0


def invert_by_root(of: Compression | Cross, cap: int, scaled: bool) -> tuple[ApproximateInverse, bool]:
    """Z Z', Z near the inverse square root: always positive."""
    S = identity(of.train.rows) + of.train if scaled else of.train
    Z, _ = inverse_root(S, cap)
    return ApproximateInverse(Z, residual(S, Z @ Z.T), of, cap, squared=True), True
