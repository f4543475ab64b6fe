"""HDF5 files whose rows are spread over the ranks, written whole or not at all."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext, suppress
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from mpi4py import MPI

from pctt.disk import make_hdf5, temporary_name, whole
from pctt.options import OptionError


class FileError(RuntimeError):
    """A file that cannot be read or written; raised on all ranks alike, or by the first rank only, `one_rank`."""

    def __init__(self, text: str, one_rank: bool = False):
        super().__init__(text)
        self.one_rank = one_rank


def refuse_serial(comm: MPI.Comm) -> None:
    """OptionError if h5py cannot write from all ranks."""
    if comm.size > 1 and not h5py.get_config().mpi:
        raise OptionError(f"mpiexec -n {comm.size}: this h5py was built without MPI; allowed is 1 rank")


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
    with replaced(path) if comm.rank == 0 else nullcontext():
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
    comm.Barrier()


def raise_together(what: str, failure: str | None, comm: MPI.Comm) -> None:
    """FileError on all ranks if one has a failure: ``what`` it is, and the words of the first; collective."""
    failures = [text for text in comm.allgather(failure) if text is not None]
    if failures:
        raise FileError(f"{what} ({failures[0]})")


@contextmanager
def replaced(path: Path) -> Iterator[Path]:
    """A temporary name for a file that takes the place of ``path``, as of `whole`; FileError if it cannot; one rank."""
    with told(path), whole(path) as temporary:
        yield temporary


@contextmanager
def told(path: Path) -> Iterator[None]:
    """FileError for an OSError of the block, which writes ``path``; one rank."""
    try:
        yield
    except OSError as error:
        raise FileError(f"{path}: cannot write ({error.strerror or error})", one_rank=True) from error


def write_text(path: Path, text: str) -> None:
    """Replace a text file at one stroke; one rank."""
    with replaced(path) as temporary:
        temporary.write_text(text)


@contextmanager
def readable(path: Path, comm: MPI.Comm) -> Iterator[h5py.File]:
    """A file open for reading on every rank; FileError on all ranks if it is no complete HDF5 file."""
    file, failure = None, None
    try:
        file = h5py.File(path, "r")
    except OSError as error:
        failure = str(error)
    try:
        raise_together(f"{path}: no readable HDF5 file", failure, comm)
        yield file
    finally:
        if file is not None:
            file.close()
