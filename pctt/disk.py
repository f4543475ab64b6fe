"""Files that are whole at any moment: for a reader, after SIGKILL and on a full disk; and HDF5 files whose rows are
spread over the ranks, with a checksum each."""

from __future__ import annotations

import errno
import fcntl
import os
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext, suppress
from pathlib import Path
from typing import Any, TypeVar

import h5py
import numpy as np
from mpi4py import MPI

from pctt.options import OptionError

Found = TypeVar("Found")

#: Bytes for HDF5 beside the numbers: per file, and per data set or attribute. HDF5 was seen to use a quarter of them.
PER_FILE, PER_ITEM = 16384, 2048

#: The last bytes of a file of `written` are this word and its checksum. HDF5 does not see them.
SEAL = b"pctt sum"


class FileError(RuntimeError):
    """A file that cannot be read or written; raised on all ranks alike, or by the first rank only, `one_rank`."""

    def __init__(self, text: str, one_rank: bool = False):
        super().__init__(text)
        self.one_rank = one_rank


def temporary_name(path: Path) -> Path:
    """The name under which a file is written until it is complete."""
    return path.with_name(f".{path.name}.tmp")


@contextmanager
def whole(path: Path) -> Iterator[Path]:
    """A temporary name for a file. When the block ends, the file is flushed to the disk and replaces ``path``.

    If the block or the disk raises an error, the old file stays as it was, and the temporary file is removed.
    """
    temporary = temporary_name(path)
    try:
        yield temporary
        with open(temporary, "rb") as file:
            os.fsync(file.fileno())
        os.replace(temporary, path)
    finally:
        with suppress(OSError):
            temporary.unlink()


@contextmanager
def told(path: Path) -> Iterator[None]:
    """FileError for an OSError of the block, which writes ``path``; one rank."""
    try:
        yield
    except OSError as error:
        raise FileError(f"{path}: cannot write ({error.strerror or error})", one_rank=True) from error


def write_text(path: Path, text: str) -> None:
    """Replace a text file at one stroke; FileError if that fails; one rank."""
    with told(path), whole(path) as temporary:
        temporary.write_text(text)


def append(path: Path, line: str) -> None:
    """Add a line to a text file. If the disk has no room, OSError is raised and no part of the line stays."""
    with open(path, "ab", buffering=0) as file:
        length, rest = file.seek(0, os.SEEK_END), f"{line}\n".encode()
        try:
            while rest:
                rest = rest[file.write(rest) :]
            os.fsync(file.fileno())
        except OSError:
            file.truncate(length)
            raise


def lines(path: Path) -> Iterator[str]:
    """The whole lines of a text file to which `append` writes; none if the file does not exist.

    A last line without its end is left out: a program is writing it, or was writing it when the machine stopped.
    """
    if path.exists():
        with open(path) as file:
            for line in file:
                if line.endswith("\n"):
                    yield line[:-1]


class Lock:
    """The lock of a folder, or of a file that is made for it. One process has it at a time, until it releases it or
    ends. On a file system without locks every process has it."""

    def __init__(self, path: Path):
        self._path, self._file = path, -1

    def take(self) -> bool:
        """Whether this process has the lock from now on."""
        try:
            self._file = os.open(self._path, os.O_RDONLY if self._path.is_dir() else os.O_RDWR | os.O_CREAT, 0o666)
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if self._path.exists() and os.path.samestat(os.fstat(self._file), os.stat(self._path)):
                return True
        except BlockingIOError:
            pass
        except OSError:
            return True
        self._close()  # another process has it, or has removed the file
        return False

    def release(self) -> None:
        """Let others have the lock that this process has, and remove the file that was made for it."""
        if self._file >= 0 and self._path.is_file():
            with suppress(OSError):
                self._path.unlink()
        self._close()

    def __del__(self) -> None:
        self._close()

    def _close(self) -> None:
        if self._file >= 0:
            os.close(self._file)
        self._file = -1


def make_hdf5(path: Path, numbers: int, items: int) -> None:
    """Make an empty HDF5 file and reserve room on the disk for ``numbers`` bytes in ``items`` data sets and attributes.

    The room stays reserved until the file, opened with "r+", is closed. Raises OSError if there is not enough room,
    also because of a quota or a limit of the process. This is done first because HDF5 does not recover if the disk is
    full when it closes a file: with 1.10 several ranks wait for each other for ever, and one rank crashes at its end.
    """
    size = numbers + PER_FILE + items * PER_ITEM
    _take_room(path, size)  # before HDF5 writes its first bytes
    h5py.File(path, "w").close()  # this gives the room back
    _take_room(path, size)


def _take_room(path: Path, size: int) -> None:
    if not hasattr(os, "posix_fallocate"):  # macOS
        return
    with open(path, "ab") as file:
        try:
            os.posix_fallocate(file.fileno(), 0, size)
        except OSError as error:
            if error.errno not in (errno.EINVAL, errno.EOPNOTSUPP, errno.EBADF):  # the file system cannot reserve
                raise


# -- rows of all ranks ---------------------------------------------------------------------------------------


def refuse_serial(comm: MPI.Comm) -> None:
    """OptionError if h5py cannot write from all ranks."""
    if comm.size > 1 and not h5py.get_config().mpi:
        raise OptionError(f"mpiexec -n {comm.size}: this h5py was built without MPI; allowed is 1 rank")


def checksum(path: Path, size: int, comm: MPI.Comm) -> int:
    """The checksum modulo 2^64 of the first ``size`` bytes of a file, of which each rank reads a part; collective.

    It is the sum of (2 i + 1) u_i over the numbers u_i of eight bytes. The factors are odd, so that one flipped bit
    always changes the sum."""
    count, chunk, total = -(-size // 8), 1 << 20, np.zeros(1, np.uint64)
    first, last = count * comm.rank // comm.size, count * (comm.rank + 1) // comm.size
    with open(path, "rb") as file:
        file.seek(8 * first)
        for start in range(first, last, chunk):
            data = file.read(min(8 * min(start + chunk, last), size) - 8 * start)
            words = np.frombuffer(data + bytes(-len(data) % 8), "<u8")
            total += np.dot(words, np.arange(2 * start + 1, 2 * (start + len(words)) + 1, 2, dtype=np.uint64))
    return int(comm.allreduce(total)[0])


class RowWriter:
    """The contents of a file: datasets and attributes. Datasets of ``rows`` are concatenated over the ranks, those of
    ``whole`` are the same on each. Arrays must not change until the file is written."""

    def __init__(self) -> None:
        self._rows: dict[str, np.ndarray] = {}
        self._whole: dict[str, np.ndarray] = {}
        self._attributes: list[tuple[str, Mapping[str, Any]]] = []

    def rows(self, name: str, local: np.ndarray) -> None:
        """A dataset of the rows of all ranks, in their order."""
        self._rows[name] = np.ascontiguousarray(local)

    def whole(self, name: str, array: Any) -> None:
        """A dataset of the array that every rank holds."""
        self._whole[name] = np.asarray(array)

    def texts(self, name: str, texts: Sequence[str]) -> None:
        """A dataset of texts (n,), in UTF-8, the same on every rank."""
        encoded = [text.encode() for text in texts]
        width = max(map(len, encoded), default=1) or 1
        self._whole[name] = np.array(encoded, dtype=h5py.string_dtype("utf-8", width))

    def attributes(self, name: str, values: Mapping[str, Any]) -> None:
        """Attributes of a group ('/' the file), which is made if it is not there."""
        self._attributes.append((name, values))

    def size(self, comm: MPI.Comm) -> tuple[int, int]:
        """Bytes of all numbers and texts, and how many datasets and attributes they are; collective."""
        own = comm.allreduce(sum(array.nbytes for array in self._rows.values()))
        shared = [np.asarray(value) for _, values in self._attributes for value in values.values()]
        shared += self._whole.values()
        return own + sum(array.nbytes for array in shared), len(self._rows) + len(shared)

    def write(self, file: h5py.File, comm: MPI.Comm) -> None:
        """Put all of it into an open file; collective."""
        for name, local in self._rows.items():
            ends = np.cumsum(comm.allgather(len(local)))
            data = file.create_dataset(name, (int(ends[-1]), *local.shape[1:]), local.dtype)
            if len(local):
                end = int(ends[comm.rank])
                data[end - len(local) : end] = local
        for name, array in self._whole.items():
            data = file.create_dataset(name, array.shape, array.dtype)
            if comm.rank == 0:
                data[...] = array
        for name, values in self._attributes:
            file.require_group(name).attrs.update(values)


@contextmanager
def written(path: Path, comm: MPI.Comm) -> Iterator[RowWriter]:
    """A file for all ranks, written under a temporary name when the block ends; collective.

    Raises FileError on all ranks if the file cannot be written; an earlier file under ``path`` then stays as it is. If
    one of several ranks fails while all are writing, it prints a message and ends them all.
    """
    contents = RowWriter()
    yield contents
    numbers, items = contents.size(comm)
    with told(path) if comm.rank == 0 else nullcontext(), whole(path) if comm.rank == 0 else nullcontext():
        failure, file = None, None
        if comm.rank == 0:
            try:
                make_hdf5(temporary_name(path), numbers, items)
            except OSError as error:
                failure = error.strerror or str(error)
        raise_together(f"{path}: cannot write", failure, comm)
        parallel = {"driver": "mpio", "comm": comm} if comm.size > 1 else {}
        try:
            file = h5py.File(temporary_name(path), "r+", **parallel)
        except OSError as error:
            failure = str(error)
        raise_together(f"{path}: cannot write", failure, comm)
        assert file is not None
        try:
            contents.write(file, comm)
            file.close()
        except (OSError, RuntimeError) as error:  # h5py raises both
            failure = str(error)
            if comm.size > 1:  # the other ranks may be within a call that waits for this one
                sys.stderr.write(f"pctt.run: {path}: cannot write ({failure})\n")
                sys.stderr.flush()
                comm.Abort(2)
            with suppress(OSError, RuntimeError):
                file.close()
        raise_together(f"{path}: cannot write", failure, comm)
        size = comm.bcast(os.path.getsize(temporary_name(path)) if comm.rank == 0 else 0)
        total = checksum(temporary_name(path), size, comm)
        if comm.rank == 0:
            with open(temporary_name(path), "ab") as end:
                end.write(SEAL + total.to_bytes(8, "little"))
    comm.Barrier()


def read(path: Path, comm: MPI.Comm, take: Callable[[h5py.File, bool], Found]) -> Found:
    """What ``take(file, sealed)`` takes of an HDF5 file on every rank, without calls of MPI; collective.

    FileError on all ranks if a rank cannot read it, or if the file is not as it was `written`. A file that is not
    ``sealed`` has no checksum, as those of earlier versions and of others."""
    what, failure, found = f"{path}: damaged, or no such file of this program", None, None
    body, seal = 0, b""
    try:
        body = os.path.getsize(path) - 16
        with open(path, "rb") as raw:
            raw.seek(max(body, 0))
            seal = raw.read()
    except OSError as error:
        failure = error.strerror
    raise_together(what, failure, comm)
    body, seal = comm.bcast((body, seal))
    sealed = seal.startswith(SEAL)
    if sealed and checksum(path, body, comm) != int.from_bytes(seal[8:], "little"):
        raise FileError(f"{what} (it does not agree with its checksum)")
    try:
        with h5py.File(path, "r") as file:
            found = take(file, sealed)
    except (KeyError, OSError, RuntimeError, TypeError, ValueError) as error:
        failure = f"it has no {error}" if isinstance(error, KeyError) else str(error)
    raise_together(what, failure, comm)
    return found  # type: ignore[return-value]


def raise_together(what: str, failure: str | None, comm: MPI.Comm) -> None:
    """FileError on all ranks if one has a failure: ``what`` it is, and the words of the first; collective."""
    failures = [text for text in comm.allgather(failure) if text is not None]
    if failures:
        raise FileError(f"{what} ({failures[0]})")
