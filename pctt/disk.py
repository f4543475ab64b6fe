"""Files that are whole at any moment: for a reader, with several writers, after SIGKILL and on a full disk; and HDF5
files whose rows are spread over the ranks, with a checksum each."""

from __future__ import annotations

import fcntl
import io
import os
import platform
import shutil
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
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
#: How the folders of writers begin, which hold their files until these are whole; they end with .tmp.
WRITER = ".pctt-"
DAY = 86400.0  #: [s] after which the folder of a writer that cannot be asked is taken to be left over
TRIES = 100  #: to open a file on all ranks while others replace it


class FileError(RuntimeError):
    """A file that cannot be read or written; raised on all ranks alike."""


@contextmanager
def naming(path: Path) -> Iterator[None]:
    """FileError for an OSError of the block, which writes ``path``."""
    try:
        yield
    except OSError as error:
        raise FileError(f"{path}: cannot write ({error.strerror or error})") from error


@contextmanager
def whole(path: Path) -> Iterator[Path]:
    """A temporary name for a file. When the block ends, the file is flushed to the disk and replaces ``path``.

    FileError if the block or the disk raises OSError, or if ``path`` is a device, a pipe or a folder: no file may take
    its place. After an error of any kind the old file is as it was, and the temporary file is removed. The name is this
    writer's alone: of several that write ``path`` at a time, the last one to end replaces the files of the others.
    """
    with naming(path):
        if path.exists() and not path.is_file():
            raise OSError("it is no regular file")
        with _own_folder(path.parent) as own:
            yield (temporary := own / "file")
            flush(temporary)
            os.replace(temporary, path)


@contextmanager
def _own_folder(folder: Path) -> Iterator[Path]:
    """A new hidden folder in a folder, for one writer, who has its lock; removed at the end.

    A folder, as HDF5 has a lock of its own on a file. What killed writers have left is removed before."""
    _sweep(folder)
    while True:
        own = Path(tempfile.mkdtemp(".tmp", f"{WRITER}{platform.node()}-", folder))
        lock = Lock(own)
        if lock.take() and own.is_dir():
            break
        lock.release()  # another process has swept it away before it was locked
    try:
        yield own
    finally:
        shutil.rmtree(own, ignore_errors=True)
        lock.release()


_swept: set[Path] = set()


def _sweep(folder: Path) -> None:
    """Remove the folders of killed writers; once in each process, as many files may be there."""
    if folder.resolve() in _swept:
        return
    for own in folder.glob(f"{WRITER}*.tmp"):
        lock, near = Lock(own), own.name.startswith(f"{WRITER}{platform.node()}-")
        if lock.take() and (near and lock.works or _age(own) > DAY):  # some file systems have locks for one machine
            shutil.rmtree(own, ignore_errors=True)
        lock.release()
    _swept.add(folder.resolve())


def _age(folder: Path) -> float:
    """Time since a folder or a file in it was changed [s]; 0 if it is removed meanwhile."""
    try:
        return time.time() - max(path.stat().st_mtime for path in (folder, *folder.iterdir()))
    except OSError:
        return 0.0


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
    without locks every process has it, and it does not ``works``."""

    def __init__(self, path: Path):
        self._path, self._file, self.works = path, -1, True

    def take(self) -> bool:
        """Whether this process has the lock from now on; makes the file if there is none."""
        try:
            self._file = os.open(self._path, os.O_RDONLY if self._path.is_dir() else os.O_RDWR | os.O_CREAT, 0o666)
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            self.release()
            return False
        except OSError:
            self.works = False
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
    return exchange.on_first(comm, naming(path)(call))


class _Bytes(io.FileIO):
    """A file whose ``error``, the first one, is kept from HDF5: with one that cannot be written this is lost, and what
    cannot be read it takes for read."""

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
        left = memoryview(data).cast("B")
        while left and (count := self._tried(super().readinto, left, instead=0)):
            left = left[count:]
        return len(data) - len(left)


@contextmanager
def hdf5(path: Path) -> Iterator[h5py.File]:
    """A new HDF5 file that this rank alone writes. OSError if it cannot be written, where HDF5 itself would end the
    program with a segmentation fault."""
    with _Bytes(path, "w+") as data, _as_hdf5(data, "w") as file:
        yield file


@contextmanager
def _as_hdf5(data: _Bytes, mode: str) -> Iterator[h5py.File]:
    """The HDF5 file in an open file, whose first OSError is raised."""
    try:
        with h5py.File(data, mode) as file:
            yield file
    except (OSError, RuntimeError) as error:  # h5py raises both
        raise data.error or error from None
    if data.error:
        raise data.error


# -- rows of all ranks ---------------------------------------------------------------------------------------


def checksum(file: Any, size: int, comm: MPI.Comm) -> int:
    """The checksum of the first ``size`` bytes of an open file, of which each rank reads a part; collective."""
    ends = [size * rank // comm.size for rank in (comm.rank, comm.rank + 1)]
    total = _together(f"{file.name}: cannot be read", comm, lambda: _of_range(file, *ends))
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


def read(path: Path, comm: MPI.Comm, take: Callable[[h5py.File], Found], sealed: bool = True) -> Found:
    """What ``take(file)`` takes of an HDF5 file on every rank, without calls of MPI; collective.

    FileError on all ranks if a rank cannot read it, if the file is not as it was written, if it leads to other files,
    or if it has no checksum, unless it need not be ``sealed``. All is read from one file, also if another one replaces
    it meanwhile."""
    what = f"{path}: damaged, or no such file of this program"

    def look() -> tuple[int, bytes]:
        size = data.seek(0, os.SEEK_END) - 16
        data.seek(max(size, 0))
        return size, data.read()

    def call() -> Found:
        with _as_hdf5(data, "r") as file:
            refuse_links(file)
            return take(file)

    with ExitStack() as held:
        for _ in range(TRIES):  # until all ranks have the same file: two differ in their checksums
            held.close()
            data = _together(what, comm, lambda: held.enter_context(_Bytes(path)))
            size, seal = seen = _together(what, comm, look)
            if not exchange.on_any(comm, seen != comm.bcast(seen))[0]:
                break
        else:
            raise FileError(f"{what} (others replace it all the time)")
        if not seal.startswith(SEAL):
            if sealed:
                raise FileError(f"{what} (it has no checksum)")
        elif checksum(data, size, comm) != int.from_bytes(seal[8:], "little"):
            raise FileError(f"{what} (it does not agree with its checksum)")
        return _together(what, comm, call)


def refuse_links(file: h5py.File) -> None:
    """ValueError for a file that takes data from others, which it names: by external or soft links, external storage or
    virtual data sets. Nobody who reads a file of strangers is to read his own files by it."""

    def look(name: bytes, link: Any) -> str | None:
        """What is wrong, which ends the visit; an error would be lost in HDF5."""
        text = name.decode(errors="replace")
        if link.type != h5py.h5l.TYPE_HARD:
            return f"{text} is a link"
        try:
            found = h5py.h5o.open(file.id, name)
        except (KeyError, OSError, RuntimeError, ValueError):
            return f"{text} is damaged"
        if isinstance(found, h5py.h5d.DatasetID):
            plan = found.get_create_plist()
            if plan.get_external_count() or plan.get_layout() == h5py.h5d.VIRTUAL:
                return f"{text} has its numbers in other files"
        return None

    if wrong := file.id.links.visit(look, info=True):
        raise ValueError(f"{wrong}; allowed are data of the file itself")


def same_rows(file: h5py.Group, names: Iterable[str], count: int | None = None) -> int:
    """The number of rows that data sets have in common, ``count`` if that is given. ValueError for one with others."""
    like = "" if count is None else f"there are {count}"
    for name in names:
        shape = file[name].shape
        if count is None and shape:
            count, like = shape[0], f"{name} has {shape[0]}"
        if shape[:1] != (count,):
            raise ValueError(f"{name} has {shape[0] if shape else 'no'} rows, but {like}")
    return count or 0


def _together(what: str, comm: MPI.Comm, call: Callable[[], Found]) -> Found:
    """What the call returns on this rank; FileError on all ranks if it fails on one: ``what``, and why; collective."""
    own = (KeyError, OSError, RuntimeError, TypeError, ValueError)
    return exchange.agreed(
        comm, call, own, lambda error: (FileError, f"{what} ({getattr(error, 'strerror', None) or error})")
    )
