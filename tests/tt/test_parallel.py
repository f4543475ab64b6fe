"""On several ranks: compression, inverse and product as a program would make them."""

from __future__ import annotations

import numpy as np
import pytest
from matrices import positive
from mpi4py import MPI

from pctt import tt


def figures(comm: MPI.Comm, compress) -> list[float]:
    def add(x):
        out = np.empty_like(x)
        comm.Allreduce(np.ascontiguousarray(x), out)
        return out

    slots, b = 200, 3
    triplets = positive(np.random.default_rng(0), slots, b)
    modes = tt.choose_modes(slots, leaf=8)
    bounds = np.linspace(0, slots, comm.size + 1).astype(int)
    first, last = bounds[comm.rank], bounds[comm.rank + 1]
    mine = (triplets.rows >= first) & (triplets.rows < last)
    A = triplets.hierarchy(modes, mine, reduce=add)
    found = compress(A, 8, 1e-2)
    X = tt.invert(tt.identity(A.modes) + found.train, 8).train
    x = np.random.default_rng(1).standard_normal(slots * b)
    rows = first * b, last * b
    y = tt.Apply(X, slots * b, rows)(x)
    y = np.concatenate(comm.allgather(y))
    return [found.error, np.linalg.norm(y), y @ x]


@pytest.mark.parallel(3)
@pytest.mark.parametrize("compress", [tt.compress, tt.compress_cross])
def test_the_same_on_any_number_of_ranks(compress) -> None:
    assert figures(MPI.COMM_WORLD, compress) == pytest.approx(figures(MPI.COMM_SELF, compress), rel=1e-6)
