"""HDF5 files whose rows are spread over the ranks, written whole or not at all."""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from mpi4py import MPI

from pctt.options import OptionError


class FileError(RuntimeError):
    """A file that cannot be read or written; raised on all ranks alike, or by the first rank `alone`."""

    def __init__(self, text: str, alone: bool = False):
        super().__init__(text)
        self.alone = alone


def refuse_serial(comm: MPI.Comm) -> None:
    """OptionError if h5py cannot write from all ranks."""
    if comm.size > 1 and not h5py.get_config().mpi:
        raise OptionError(f"mpiexec -n {comm.size}: this h5py was built without MPI; allowed is 1 rank")


class RowWriter:
    """Datasets of an open file: ``rows`` are concatenated over the ranks, ``whole`` is the same on each."""

    def __init__(self, file: h5py.File, comm: MPI.Comm):
        self._file, self._comm = file, comm

    def rows(self, name: str, local: np.ndarray) -> None:
        """Collective: a dataset of the rows of all ranks, in their order."""
        local = np.ascontiguousarray(local)
        ends = np.cumsum(self._comm.allgather(len(local)))
        data = self._file.create_dataset(name, (int(ends[-1]), *local.shape[1:]), local.dtype)
        if len(local):
            end = int(ends[self._comm.rank])
            data[end - len(local) : end] = local

    def whole(self, name: str, array: Any) -> None:
        """Collective: a dataset of the array that every rank holds."""
        array = np.asarray(array)
        data = self._file.create_dataset(name, array.shape, array.dtype)
        if self._comm.rank == 0:
            data[...] = array

    def attributes(self, name: str, values: Mapping[str, Any]) -> None:
        """Collective: attributes of a group ('/' the file), which is made if it is not there."""
        self._file.require_group(name).attrs.update(values)


@contextmanager
def written(path: Path, comm: MPI.Comm) -> Iterator[RowWriter]:
    """A file for all ranks, under a temporary name until it is complete; collective.

    Raises FileError on all ranks if it cannot be written; what stood under ``path`` is then untouched. Where one of
    several ranks fails in the middle (a full disk), all are ended, after a word of that rank.
    """
    temporary = path.with_name(f".{path.name}.tmp")
    parallel = {"driver": "mpio", "comm": comm} if comm.size > 1 else {}
    file, failure = None, None
    try:
        file = h5py.File(temporary, "w", **parallel)
    except OSError as error:
        failure = str(error)
    _raise_together(path, temporary, failure, comm)
    assert file is not None
    try:
        yield RowWriter(file, comm)
        file.close()
        if comm.rank == 0:
            _flush_to_disk(temporary)
    except OSError as error:
        failure = str(error)
        if comm.size > 1:  # the other ranks may be within a call that waits for this one
            sys.stderr.write(f"pctt.run: {path}: cannot write ({failure})\n")
            sys.stderr.flush()
            comm.Abort(2)
        with contextlib.suppress(OSError):
            file.close()
    _raise_together(path, temporary, failure, comm)
    if comm.rank == 0:
        os.replace(temporary, path)
    comm.Barrier()


def _raise_together(path: Path, temporary: Path, failure: str | None, comm: MPI.Comm) -> None:
    """FileError on all ranks if one failed."""
    failures = [text for text in comm.allgather(failure) if text]
    if failures:
        if comm.rank == 0:
            temporary.unlink(missing_ok=True)
        raise FileError(f"{path}: cannot write ({failures[0]})")


def write_text(path: Path, text: str) -> None:
    """Replace a text file at one stroke; one rank."""
    temporary = path.with_name(f".{path.name}.tmp")
    try:
        temporary.write_text(text)
        _flush_to_disk(temporary)
        os.replace(temporary, path)
    except OSError as error:
        raise FileError(f"{path}: cannot write ({error.strerror})", alone=True) from error


def _flush_to_disk(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


@contextmanager
def readable(path: Path, comm: MPI.Comm) -> Iterator[h5py.File]:
    """A file open for reading on every rank; FileError on all ranks if it is no complete HDF5 file."""
    file, failure = None, None
    try:
        file = h5py.File(path, "r")
    except OSError as error:
        failure = str(error)
    failures = [text for text in comm.allgather(failure) if text]
    try:
        if failures:
            raise FileError(f"{path}: no readable HDF5 file ({failures[0]})")
        yield file
    finally:
        if file is not None:
            file.close()
