"""Files that are whole at any moment: for a reader, after SIGKILL and on a full disk."""

from __future__ import annotations

import errno
import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import h5py

#: Bytes for HDF5 beside the numbers: per file, and per data set or attribute. HDF5 was seen to use a quarter of them.
PER_FILE, PER_ITEM = 16384, 2048

#: The files of a run in its folder.
RUN_FILES = ("state.h5", "records.csv", "steps.jsonl", "analysis.csv", "summary.json", "checkpoint.h5")


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
            if error.errno not in (errno.EINVAL, errno.EOPNOTSUPP):  # the file system cannot reserve
                raise
