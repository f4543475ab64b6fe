from __future__ import annotations

import numpy as np
import pytest
from mpi4py import MPI

from dem.exchange import exchange


@pytest.mark.parallel(1, 2, 3, 4)
def test_rows_arrive_in_the_order_of_ranks():
    comm = MPI.COMM_WORLD

    def rows(rank):
        rng = np.random.default_rng(rank)
        count = 0 if rank == 1 else int(rng.integers(5, 40))
        columns = {
            "number": 1000 * rank + np.arange(count),
            "matrix": rng.normal(size=(count, 2, 3)),
            "flag": rng.random(count) > 0.5,
            "short": rng.integers(0, 9, count).astype(np.int32),
        }
        return columns, rng.integers(0, comm.size, count)

    columns, destination = rows(comm.rank)
    out = exchange(comm, columns, destination)
    sent = [rows(rank) for rank in range(comm.size)]
    for name in columns:
        expected = np.concatenate([theirs[name][where == comm.rank] for theirs, where in sent])
        assert out[name].dtype == expected.dtype
        np.testing.assert_array_equal(out[name], expected)
        out[name][:] = 0  # writable
    nothing = exchange(comm, {"x": np.zeros((0, 4))}, np.zeros(0, np.int64))
    assert nothing["x"].shape == (0, 4)
