"""The checksum of files that several ranks write; files with several writers, with killed ones, and with links."""

from __future__ import annotations

import errno
import os
import platform
import signal
import subprocess
import sys

import h5py
import numpy as np
import pytest
from mpi4py import MPI

from pctt import disk
from pctt.disk import FileError


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
    found = disk.read(tmp_path / "file.h5", comm, lambda file: {n: file[n][()] for n in rows})
    for name, local in rows.items():
        np.testing.assert_array_equal(found[name], np.concatenate(comm.allgather(local)))


# -- several writers, and readers meanwhile ------------------------------------------------------------------


def save(path, value):
    disk.write_rows(path, MPI.COMM_SELF, {"row": np.full(1000, value)}, {}, {})


def row(file):
    return file["row"][()]


def test_the_last_of_several_writers_to_end_has_the_file(tmp_path):
    path = tmp_path / "both"
    with disk.whole(path) as one:
        one.write_text("one, the later")
        with disk.whole(path) as two:
            two.write_text("two")
            assert one != two
        assert path.read_text() == "two"
    assert path.read_text() == "one, the later"
    assert [file.name for file in tmp_path.iterdir()] == ["both"]


def test_a_writer_that_fails_spares_the_other(tmp_path):
    path = tmp_path / "both"
    with disk.whole(path) as one:
        one.write_text("one")
        with pytest.raises(FileError, match="both: cannot write"), disk.whole(path):
            raise OSError("no room")
    assert path.read_text() == "one"


def test_a_file_that_is_replaced_while_it_is_read_is_read_as_it_was(tmp_path):
    save(tmp_path / "file.h5", 1.0)

    def take(file):
        save(tmp_path / "file.h5", 2.0)
        return row(file)

    assert (disk.read(tmp_path / "file.h5", MPI.COMM_SELF, take) == 1.0).all()
    assert (disk.read(tmp_path / "file.h5", MPI.COMM_SELF, row) == 2.0).all()


@pytest.mark.parallel(2, 3)
def test_all_ranks_read_one_file_while_others_replace_it(tmp_path, monkeypatch):
    """The last rank opens the file before it is replaced, the others after that."""
    comm, path, opened = MPI.COMM_WORLD, tmp_path / "file.h5", []
    last = comm.rank == comm.size - 1
    if comm.rank == 0:
        save(path, 1.0)
    comm.Barrier()

    class Late(disk._Bytes):
        def __init__(self, name, mode="r"):
            reads = mode == "r"
            if reads and not last and len(opened) < 2:
                comm.Barrier()
            super().__init__(name, mode)
            opened.extend([name] * reads)
            if reads and last and len(opened) < 3:
                save(path, 1.0 + len(opened))  # 2, then 3
                comm.Barrier()

    with monkeypatch.context() as patch:
        patch.setattr(disk, "_Bytes", Late)
        found = disk.read(path, comm, row)
    assert (found == 3.0).all()
    assert len(opened) == 3


class Reader(disk._Bytes):
    """A file whose end cannot be read, once HDF5 reads it."""

    def readinto(self, data):
        if self.tell() + len(data) > 4000:
            self.error = OSError("Input/output error")
            return 0
        return super().readinto(data)


def test_rows_that_cannot_be_read_are_an_error(tmp_path, monkeypatch):
    save(tmp_path / "file.h5", 1.0)
    monkeypatch.setattr(disk, "_Bytes", Reader)
    with pytest.raises(FileError, match=r"file\.h5: .*\(Input/output error\)"):
        disk.read(tmp_path / "file.h5", MPI.COMM_SELF, row)


KILLED = """
import os, signal, sys
from pathlib import Path
from pctt import disk
with disk.whole(Path(sys.argv[1])) as file:
    file.write_text("half")
    os.kill(os.getpid(), signal.SIGKILL)
"""


def test_what_a_killed_writer_has_left_is_removed_and_what_others_write_stays(tmp_path, monkeypatch):
    path, ours = tmp_path / "file", f"{disk.WRITER}{platform.node()}"
    names = {"near": f"{ours}-x.tmp", "far": f"{disk.WRITER}far-x.tmp", "old": f"{disk.WRITER}far-y.tmp"}
    names |= {"busy": f"{disk.WRITER}far-z.tmp"}
    for name in names.values():
        (tmp_path / name).mkdir()
        (tmp_path / name / "file").write_text("half")
    for name in (names["old"], names["busy"]):
        for aged in (tmp_path / name / "file", tmp_path / name):
            os.utime(aged, (1e9, 1e9))
    lock = disk.Lock(tmp_path / names["busy"])
    assert lock.take()
    with disk.whole(path) as file:
        file.write_text("whole")
        died = subprocess.run([sys.executable, "-c", KILLED, str(path)], check=False)
        assert died.returncode == -signal.SIGKILL
        left = {each.name for each in tmp_path.iterdir()}
        assert left & {*names.values()} == {names["far"], names["busy"]}
        assert len(left) == 4  # this writer's and the killed one's
    monkeypatch.setattr(disk, "_swept", set())  # as in a new process
    disk.write_text(path, "again")
    assert {each.name for each in tmp_path.iterdir()} == {"file", names["far"], names["busy"]}
    lock.release()


def test_without_locks_nothing_new_is_taken_to_be_left_over(tmp_path, monkeypatch):
    def none(*_):
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr(disk.fcntl, "flock", none)
    new = tmp_path / f"{disk.WRITER}{platform.node()}-x.tmp"
    new.mkdir()
    disk.write_text(tmp_path / "file", "text")
    assert {each.name for each in tmp_path.iterdir()} == {"file", new.name}


@pytest.mark.parallel(1, 2)
def test_a_file_with_a_link_to_another_is_refused(tmp_path):
    comm = MPI.COMM_WORLD
    if comm.rank == 0:
        with h5py.File(tmp_path / "file.h5", "w") as file:
            file["row"] = h5py.ExternalLink("other.h5", "row")
    comm.Barrier()
    with pytest.raises(FileError, match=r"file\.h5: .*row is a link"):
        disk.read(tmp_path / "file.h5", comm, len, sealed=False)
