"""One true run on several ranks: compression, inverse and product as a program would make them."""

from __future__ import annotations

from typing import Callable

import pytest

PROGRAM = """
import numpy as np
from matrices import positive
from mpi4py import MPI
from pctt import tt

comm = MPI.COMM_WORLD

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
for compress in (tt.compress, tt.compress_cross):
    A = triplets.hierarchy(modes, mine, reduce=add)
    found = compress(A, 8, 1e-2)
    X = tt.invert(tt.identity(A.modes) + found.train, 8).train
    x = np.random.default_rng(1).standard_normal(slots * b)
    rows = first * b, last * b
    y = tt.Apply(X, slots * b, rows, reduce=add)(x[slice(*rows)])
    y = np.concatenate(comm.allgather(y))
    if comm.rank == 0:
        print(f"{found.error:.9e} {np.linalg.norm(y):.9e} {y @ x:.9e}")
"""


@pytest.mark.mpi
def test_the_same_on_any_number_of_ranks(mpirun: Callable[..., str]) -> None:
    one, three = ([float(word) for word in mpirun(PROGRAM, ranks).split()] for ranks in (1, 3))
    assert three == pytest.approx(one, rel=1e-6)
    assert len(one) == 6
