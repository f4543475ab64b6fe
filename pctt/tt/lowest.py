"""A search for the least eigenvalue of a symmetric train, to test whether the train is positive."""

from __future__ import annotations

import numpy as np
from scipy import linalg

from pctt.tt.projection import Projection, columns, rows
from pctt.tt.train import Array, Train, random


def lowest(X: Train, rank: int | None = None, sweeps: int = 4) -> float:
    """An upper bound of the least eigenvalue of a symmetric X.

    It is the least v'Xv / v'v that an alternating search over trains v of the given rank finds. The default rank is 8,
    or 4 with modes above 8, which cost more. A negative value proves that X is not positive definite.

    >>> from pctt.tt.train import identity
    >>> round(lowest(identity([4, 4, 4])), 12)
    1.0
    """
    rank = (8 if max(X.rows) <= 8 else 4) if rank is None else rank
    v = list(random(X.rows, rank, [1] * len(X), dtype=X.dtype).right_orthogonal().cores)
    galerkin = Projection.around(X, None, v, v)
    value = np.inf

    def lowest_core(k: int) -> Array:
        nonlocal value
        w, y = linalg.eigh(galerkin.matrix(k), subset_by_index=[0, 0], check_finite=False)
        value = float(w[0])
        return y.reshape(len(galerkin.left[k]), -1, 1, len(galerkin.right[k]))

    for _ in range(sweeps):
        before = value
        for k in range(len(v) - 1):
            v[k] = columns(lowest_core(k))
            galerkin.step_right(k, v[k], v[k])
        for k in range(len(v) - 1, 0, -1):
            v[k] = rows(lowest_core(k))
            galerkin.step_left(k, v[k], v[k])
        lowest_core(0)
        if value < 0 or abs(value - before) <= 1e-3 * abs(value):
            break
    return value
