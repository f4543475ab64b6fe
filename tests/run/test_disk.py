"""The checksum of files that several ranks write."""

from __future__ import annotations

import numpy as np
import pytest
from mpi4py import MPI

from pctt import disk


def words(data):
    """The sum of (2 i + 1) u_i over the numbers of eight bytes, modulo 2^64."""
    padded = data + bytes(-len(data) % 8)
    numbers = (int.from_bytes(padded[k : k + 8], "little") for k in range(0, len(padded), 8))
    return sum((2 * i + 1) * number for i, number in enumerate(numbers)) % 2**64


@pytest.mark.parametrize("chunk", [5, 64])
def test_parts_of_a_file_have_its_checksum_together(monkeypatch, tmp_path, chunk):
    monkeypatch.setattr(disk, "CHUNK", chunk)
    data = np.random.default_rng(1).integers(0, 256, 203, dtype=np.uint8)
    cuts = [0, 3, 3, 40, 41, 203]
    parts = sum(disk.summed(data[a:b], a) for a, b in zip(cuts, cuts[1:]))
    assert int(parts[0]) == words(data.tobytes())
    (tmp_path / "file").write_bytes(data.tobytes())
    with open(tmp_path / "file", "rb") as file:
        assert disk.checksum(file, 203, MPI.COMM_SELF) == words(data.tobytes())


@pytest.mark.parallel(1, 3)
def test_rows_of_any_size_are_written_with_their_checksum(tmp_path):
    comm = MPI.COMM_WORLD
    count = 0 if comm.rank == 1 else 5 + comm.rank
    rng = np.random.default_rng(comm.rank)
    rows = {
        "short": rng.integers(0, 9, (count, 3)).astype(np.int16),
        "key": rng.normal(size=count) + 1j,
        "flag": rng.random(count) > 0.5,
        "none": np.zeros((0, 2)),
    }
    disk.write_rows(tmp_path / "file.h5", comm, rows, {"shared": np.arange(3)}, {"/": {"about": "it"}})
    found, sealed = disk.read(tmp_path / "file.h5", comm, lambda file, sealed: ({n: file[n][()] for n in rows}, sealed))
    assert sealed
    for name, local in rows.items():
        np.testing.assert_array_equal(found[name], np.concatenate(comm.allgather(local)))
