"""Files that are whole at any moment: for a reader, after SIGKILL and on a full disk; and HDF5 files whose rows are
spread over the ranks, with a checksum each."""

from __future__ import annotations

import fcntl
import io
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any, TypeVar

import h5py
import numpy as np
from mpi4py import MPI

from dem import exchange

Found = TypeVar("Found")

#: The last bytes of a file of `write_rows` are this word and its checksum. HDF5 does not see them.
SEAL = b"pctt sum"
CHUNK = 2**23  #: bytes of which a checksum is found at a time


class FileError(RuntimeError):
    """A file that cannot be read or written; raised on all ranks alike."""


@contextmanager
def told(path: Path) -> Iterator[None]:
    """FileError for an OSError of the block, which writes ``path``."""
    try:
        yield
    except OSError as error:
        raise FileError(f"{path}: cannot write ({error.strerror or error})") from error


@contextmanager
def whole(path: Path) -> Iterator[Path]:
    """A temporary name for a file. When the block ends, the file is flushed to the disk and replaces ``path``.

    FileError if the block or the disk raises OSError, or if ``path`` is a device, a pipe or a folder: no file may take
    its place. After an error of any kind the old file is as it was, and the temporary file is removed.
    """
    temporary = path.with_name(f".{path.name}.tmp")
    try:
        with told(path):
            if path.exists() and not path.is_file():
                raise OSError("it is no regular file")
            yield temporary
            flush(temporary)
            os.replace(temporary, path)
    finally:
        with suppress(OSError):
            temporary.unlink()


def write_text(path: Path, text: str) -> None:
    """Replace a text file at one stroke; FileError if that fails."""
    with whole(path) as temporary:
        temporary.write_text(text)


def append(path: Path, line: str) -> None:
    """Add a line to a text file. If the disk has no room, OSError is raised and no part of the line stays. A killed
    program leaves the line; a machine that stops may lose those since the last `flush`."""
    with open(path, "ab", buffering=0) as file:
        length, rest = file.seek(0, os.SEEK_END), f"{line}\n".encode()
        try:
            while rest:
                rest = rest[file.write(rest) :]
        except OSError:
            file.truncate(length)
            raise


def flush(path: Path) -> None:
    """Wait until what was written to a file is on the disk."""
    with open(path, "rb") as file:
        os.fsync(file.fileno())


def lines(path: Path) -> Iterator[str]:
    """The whole lines of a text file to which `append` writes; none if there is no such file, as a device is none.

    A last line without its end is left out: a program is writing it, or was writing it when the machine stopped.
    """
    if path.is_file():
        with open(path) as file:
            for line in file:
                if line.endswith("\n"):
                    yield line[:-1]


class Lock:
    """The lock of a folder or a file. One process has it at a time, until it releases it or ends. On a file system
    without locks every process has it."""

    def __init__(self, path: Path):
        self._path, self._file = path, -1

    def take(self) -> bool:
        """Whether this process has the lock from now on; makes the file if there is none."""
        try:
            self._file = os.open(self._path, os.O_RDONLY if self._path.is_dir() else os.O_RDWR | os.O_CREAT, 0o666)
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            self.release()
            return False
        except OSError:
            pass
        return True

    def release(self) -> None:
        """Let others have the lock."""
        if self._file >= 0:
            os.close(self._file)
        self._file = -1

    def __del__(self) -> None:
        self.release()


def on_first(comm: MPI.Comm, path: Path, call: Callable[[], Found]) -> Found:
    """What the call, which writes ``path``, returns on the first rank; collective. FileError on all ranks if it raises
    one, or an OSError."""
    return exchange.on_first(comm, told(path)(call))


class _Bytes(io.FileIO):
    """A file whose ``error``, the first one, is kept from HDF5: with one that cannot be written this is lost."""

    error: OSError | None = None

    def _tried(self, call: Callable[..., Found], *arguments: Any, instead: Found) -> Found:
        try:
            return call(*arguments)
        except OSError as error:
            self.error = self.error or error
            return instead

    def write(self, data: Any) -> int:
        left = memoryview(data)
        while left and not self.error:
            left = left[self._tried(super().write, left, instead=0) or 0 :]
        return len(data)

    def truncate(self, size: int | None = None) -> int:
        return self._tried(super().truncate, size, instead=size or 0)

    def readinto(self, data: Any) -> int:
        return self._tried(super().readinto, data, instead=0) or 0


@contextmanager
def hdf5(path: Path) -> Iterator[h5py.File]:
    """A new HDF5 file that this rank alone writes. OSError if it cannot be written, where HDF5 itself would end the
    program with a segmentation fault."""
    with _Bytes(path, "w+") as data:
        try:
            with h5py.File(data, "w") as file:
                yield file
        except (OSError, RuntimeError) as error:  # h5py raises both
            raise data.error or error from None
        if data.error:
            raise data.error


# -- rows of all ranks ---------------------------------------------------------------------------------------


def checksum(path: Path, size: int, comm: MPI.Comm) -> int:
    """The checksum of the first ``size`` bytes of a file, of which each rank reads a part; collective."""
    ends = [size * rank // comm.size for rank in (comm.rank, comm.rank + 1)]
    with open(path, "rb") as file:
        total = _of_range(file, *ends)
    comm.Allreduce(MPI.IN_PLACE, total)
    return int(total[0])


def _of_range(file: Any, start: int, end: int) -> np.ndarray:
    """What the bytes of a file from ``start`` on and before ``end`` add to its checksum, read part by part."""
    total = np.zeros(1, np.uint64)
    file.seek(start)
    while start < end and (data := file.read(min(end - start, CHUNK))):
        total += summed(np.frombuffer(data, np.uint8), start)
        start += len(data)
    return total


def summed(data: np.ndarray, start: int) -> np.ndarray:
    """What bytes (n,) that are in a file from the place ``start`` on add to its checksum (1,), modulo 2^64.

    That is the sum of (2 i + 1) u_i over the numbers u_i of eight bytes. The factors are odd, so that one flipped bit
    always changes the sum. Each byte adds its own part: so the ranks that write a file know its sum without reading
    it."""
    total = np.zeros(1, np.uint64)
    for first in range(0, len(data), CHUNK):
        part, (word, lead) = data[first : first + CHUNK], divmod(start + first, 8)
        padded = np.zeros(-(-(lead + len(part)) // 8) * 8, np.uint8)
        padded[lead : lead + len(part)] = part
        words = padded.view("<u8")
        total += np.dot(words, np.arange(2 * word + 1, 2 * (word + len(words)) + 1, 2, dtype=np.uint64))
    return total


def texts(words: Sequence[str]) -> np.ndarray:
    """Words (n,) in UTF-8, for a data set."""
    encoded = [word.encode() for word in words]
    width = max(map(len, encoded), default=1) or 1
    return np.array(encoded, dtype=h5py.string_dtype("utf-8", width))


def write_rows(
    path: Path, comm: MPI.Comm, rows: Mapping[str, np.ndarray], shared: Mapping[str, Any],
    attributes: Mapping[str, Mapping[str, Any]],
) -> None:  # fmt: skip
    """Write an HDF5 file with its checksum; collective. Data sets of ``rows`` are concatenated over the ranks, those
    that are ``shared`` and the attributes of groups ("/": the file) are the same on each.

    Raises FileError on all ranks if the file cannot be written; an earlier file under ``path`` then stays as it is. The
    first rank makes the file, and then every rank writes its rows into their places, without HDF5, and waits until they
    are on the disk: all do so at once. So this needs no parallel HDF5, some releases of which wait for ever if one rank
    finds the disk full.
    """
    ends = np.empty((comm.size, len(rows)), np.int64)
    comm.Allgather(np.array([len(local) for local in rows.values()], np.int64), ends)
    ends = np.cumsum(ends, axis=0)
    tables = [(name, (int(end), *rows[name].shape[1:]), rows[name].dtype) for name, end in zip(rows, ends[-1])]
    mine = [np.ascontiguousarray(local).reshape(-1).view(np.uint8) for local in rows.values()]

    def lay_out() -> tuple[Path, list[int | None], int, np.ndarray]:
        """The temporary file, the places of the rows, its size, and the checksum of all that is no row."""
        temporary = first.enter_context(whole(path))
        with hdf5(temporary) as file:
            places = [_room(file, *table) for table in tables]
            for name, value in shared.items():
                file[name] = np.asarray(value)
            for name, values in attributes.items():
                file.require_group(name).attrs.update(values)
        sizes = [int(np.prod(shape)) * dtype.itemsize for _, shape, dtype in tables]
        spans = sorted((place, place + size) for place, size in zip(places, sizes) if place is not None)
        end = max([os.path.getsize(temporary), *(last for _, last in spans)])
        with open(temporary, "rb") as data:
            between = zip([0, *(last for _, last in spans)], [*(place for place, _ in spans), end])
            rest = sum((_of_range(data, *gap) for gap in between), np.zeros(1, np.uint64))
        return temporary, places, int(end), rest

    def fill() -> None:
        with open(temporary, "r+b") as file:
            for place, data in written:
                file.seek(place)
                file.write(data.data)
            if comm.rank == 0:
                file.seek(size)
                file.write(SEAL + int(total[0]).to_bytes(8, "little"))
            file.flush()
            os.fsync(file.fileno())

    with ExitStack() as first:  # what the first rank has open
        temporary, places, size, total = on_first(comm, path, lay_out)
        before = [local[:1].nbytes * (int(end) - len(local)) for local, end in zip(rows.values(), ends[comm.rank])]
        written = [(place + start, data) for place, start, data in zip(places, before, mine) if place is not None]
        here = sum((summed(data, place) for place, data in written), np.zeros(1, np.uint64))
        comm.Allreduce(MPI.IN_PLACE, here)
        total = total + here
        _together(f"{path}: cannot write", comm, fill)
        on_first(comm, path, first.close)


def _room(file: h5py.File, name: str, shape: tuple[int, ...], dtype: np.dtype) -> int | None:
    """Make a data set whose numbers come later; where they begin in the file, None if there are none."""
    plan = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    plan.set_layout(h5py.h5d.CONTIGUOUS)
    plan.set_alloc_time(h5py.h5d.ALLOC_TIME_EARLY)
    plan.set_fill_time(h5py.h5d.FILL_TIME_NEVER)
    return file.create_dataset(name, shape, dtype, dcpl=plan).id.get_offset()


def read(path: Path, comm: MPI.Comm, take: Callable[[h5py.File, bool], Found]) -> Found:
    """What ``take(file, sealed)`` takes of an HDF5 file on every rank, without calls of MPI; collective.

    FileError on all ranks if a rank cannot read it, or if the file is not as it was written. A file that is not
    ``sealed`` has no checksum, as those of earlier versions and of others."""
    what = f"{path}: damaged, or no such file of this program"

    def look() -> tuple[int, bytes]:
        with open(path, "rb") as file:
            size = file.seek(0, os.SEEK_END) - 16
            file.seek(max(size, 0))
            return size, file.read()

    def call() -> Found:
        with h5py.File(path, "r") as file:
            return take(file, sealed)

    size, seal = comm.bcast(_together(what, comm, look))
    sealed = seal.startswith(SEAL)
    if sealed and checksum(path, size, comm) != int.from_bytes(seal[8:], "little"):
        raise FileError(f"{what} (it does not agree with its checksum)")
    return _together(what, comm, call)


def _together(what: str, comm: MPI.Comm, call: Callable[[], Found]) -> Found:
    """What the call returns on this rank; FileError on all ranks if it fails on one: ``what``, and why; collective."""
    failure = None
    try:
        found = call()
    except (KeyError, OSError, RuntimeError, TypeError, ValueError) as error:
        failure = getattr(error, "strerror", None) or str(error)
    if exchange.on_any(comm, failure is not None)[0]:
        failures = [text for text in comm.allgather(failure) if text is not None]
        raise FileError(f"{what} ({failures[0]})")
    return found
