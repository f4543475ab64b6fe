from __future__ import annotations

import numpy as np
import pytest
from mpi4py import MPI

from dem.exchange import agreed, exchange, reduced, refuse


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


@pytest.mark.parallel(1, 2, 3)
def test_sums_and_greatest_numbers_by_one_reduction():
    comm = MPI.COMM_WORLD
    ranks = np.arange(comm.size)
    sums, most = reduced(comm, [comm.rank, 0.5], [-comm.rank, 7 if comm.rank == 0 else 2])
    assert (sums, most) == ([ranks.sum(), 0.5 * comm.size], [0.0, 7.0])
    assert reduced(comm, (), np.array([comm.rank])) == ([], [comm.size - 1])
    sums, _ = reduced(comm, np.full(2000, 1.0 + comm.rank), ())
    assert sums == [float((1 + ranks).sum())] * 2000


@pytest.mark.parallel(1, 3)
def test_an_error_of_some_ranks_is_one_of_all():
    comm = MPI.COMM_WORLD
    assert agreed(comm, lambda: comm.rank) == comm.rank

    def work():
        if comm.rank != 1:
            raise KeyError("mine")

    where = "" if comm.size == 1 else r" \(on ranks 0, 2 of 3\)"
    with pytest.raises(ValueError, match=f"^read: 'mine'{where}$"):
        agreed(comm, work, (KeyError,), lambda error: (ValueError, f"read: {error}"))
    refuse(comm, "")
    if comm.size > 1:
        with pytest.raises(ValueError, match=r"^2 is odd \(on rank 1 of 3\); another failure on rank 2$"):
            refuse(comm, f"{2 * comm.rank} is odd" if comm.rank else "")
