"""The inverse of a compressed matrix as a train.

If the matrix was scaled, its diagonal blocks are identities; then it is I + T, where the train T is the compressed
off-diagonal part. Otherwise it is T.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pctt.tt.als import Compression
from pctt.tt.cross import Cross
from pctt.tt.inverse import invert, invert_near_identity
from pctt.tt.train import Train


@dataclass(frozen=True)
class ApproximateInverse:
    """The train of an inverse: X, or Z with X = I + Z if ``identity``.

    residual : residual of the inverse for the train of the matrix, see `pctt.tt.Inverse`
    of : the compression that was inverted
    cap : largest allowed rank
    repaired : number of local systems that were found not to be positive
    """

    train: Train
    residual: float
    of: Compression | Cross
    cap: int
    identity: bool = False
    repaired: int = 0


def approximate_inverse(
    of: Compression | Cross,
    cap: int,
    eps: float,
    near_identity: bool,
    start: Train | None = None,
    rng: np.random.Generator | None = None,
) -> ApproximateInverse:
    """X or I + Z, from a start if there is one. It is symmetric, but it may be indefinite."""
    if not near_identity:
        found = invert(of.train, cap, start, eps=eps, rng=rng)
        return ApproximateInverse(found.train, found.residual, of, cap, False, found.repaired)
    found = invert_near_identity(of.train, cap, start, eps=eps, rng=rng)
    assert found.correction is not None
    return ApproximateInverse(found.correction, found.residual, of, cap, True, found.repaired)
