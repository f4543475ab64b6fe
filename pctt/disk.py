"""Files that are whole at any moment, also for a reader, after SIGKILL and on a full disk."""

from __future__ import annotations

import errno
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import h5py

#: What HDF5 takes beside the numbers, for the file and for each data set or attribute [bytes]; it used a quarter of it.
PER_FILE, PER_ITEM = 16384, 2048


def temporary_name(path: Path) -> Path:
    """The name under which a file is written until it is complete."""
    return path.with_name(f".{path.name}.tmp")


@contextmanager
def whole(path: Path) -> Iterator[Path]:
    """A temporary name for a file that takes the place of ``path`` when the block ends, once it is on the disk.

    If the block raises, or the disk, what stood under ``path`` is untouched and no temporary file stays.
    """
    temporary = temporary_name(path)
    try:
        yield temporary
        _flush(temporary)
        os.replace(temporary, path)
    finally:
        with suppress(OSError):
            temporary.unlink()


def append(path: Path, line: str) -> None:
    """Add a line to a text file. Of a line for which the disk has no room nothing stays, and OSError is raised."""
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
    """The whole lines of a text file to which lines are appended; none if there is no such file. A last one without
    its end is still being written, or was when the machine stopped."""
    if path.exists():
        with open(path) as file:
            for line in file:
                if line.endswith("\n"):
                    yield line[:-1]


def make_hdf5(path: Path, numbers: int, items: int) -> None:
    """Make an HDF5 file without contents, on a disk with room for so many bytes of numbers in so many data sets and
    attributes, which stays taken until the file, opened with "r+", is closed.

    Raises OSError where there is no such room, also because of a quota or a limit of the process. HDF5 itself does not
    come back from a full disk when it closes a file: with 1.10 several ranks wait for each other for ever, and one rank
    crashes at its end.
    """
    size = numbers + PER_FILE + items * PER_ITEM
    _take_room(path, size)  # before HDF5 writes its first bytes
    h5py.File(path, "w").close()  # which gives the room back
    _take_room(path, size)


def _take_room(path: Path, size: int) -> None:
    if not hasattr(os, "posix_fallocate"):  # macOS
        return
    with open(path, "ab") as file:
        try:
            os.posix_fallocate(file.fileno(), 0, size)
        except OSError as error:
            if error.errno not in (errno.EINVAL, errno.EOPNOTSUPP):  # the file system does not know
                raise


def _flush(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
