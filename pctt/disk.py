"""Disk space, taken before it is written to."""

from __future__ import annotations

import errno
import os
from pathlib import Path

#: What HDF5 takes beside the numbers, for the file and for each data set or attribute [bytes]; it used a quarter of it.
PER_FILE, PER_ITEM = 16384, 2048


def reserve(path: Path, numbers: int, items: int) -> None:
    """Make a file with room for an HDF5 file of so many bytes of numbers in so many data sets and attributes.

    Raises OSError where there is no such room, also because of a quota or a limit of the process, and leaves no file.
    HDF5 itself does not come back from a full disk when it closes a file: with 1.10 several ranks wait for each other
    for ever, and one rank crashes at its end.
    """
    if not hasattr(os, "posix_fallocate"):  # macOS
        return
    try:
        with open(path, "wb") as file:
            os.posix_fallocate(file.fileno(), 0, numbers + PER_FILE + items * PER_ITEM)
    except OSError as error:
        if error.errno not in (errno.EINVAL, errno.EOPNOTSUPP):  # the file system does not know
            path.unlink(missing_ok=True)
            raise
