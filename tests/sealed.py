"""Files of the program that somebody has edited, and that have their checksum all the same."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import h5py
import numpy as np

from pctt import disk


@contextmanager
def edited(path: Path | str) -> Iterator[h5py.File]:
    """The HDF5 file, to be changed by one rank; it is sealed at the end."""
    with h5py.File(path, "a") as file:
        yield file
    data = Path(path).read_bytes()
    total = int(disk.summed(np.frombuffer(data, np.uint8), 0)[0])
    Path(path).write_bytes(data + disk.SEAL + total.to_bytes(8, "little"))
