"""Trains in files: a Mat that multiplies with a train, kept between runs (HDF5).

    /                attributes: format, version, checksum, order, origin, shift, scale, error, residual (NaN: none),
                     symmetric, eps, max_rank, grid (n_1, n_2, ...), block
    /cores/0 ...     the cores (r, m, n, r')
    /rows            the row of the Mat at each point of the grid; missing if the rows are in the order of the points

The checksum is the SHA-256 of all other attributes and datasets. Row numbers are those of the Mat that was saved.
"""

from __future__ import annotations

import hashlib
import io
import os
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from dem.exchange import on_first
from pctt.disk import whole
from pctt.mat.grid_train import GridTrain
from pctt.mat.tensor_train import Options, TensorTrain, compressed, mat_of
from pctt.tt.quantise import GridDigits
from pctt.tt.train import Train

FORMAT, VERSION = "pctt train", 1


def save(mat: PETSc.Mat, path: str | os.PathLike[str]) -> None:
    """Write the train of a Mat of `from_entries`, `inverse` or `load` to an HDF5 file. Collective.

    The file is whole at any moment: an old one stays until the new one is complete. The function of the entries is not
    saved. ValueError on all ranks for another Mat, and OSError if the file cannot be written.
    """
    matrix = compressed(mat)
    if matrix is None:
        raise ValueError(f"pctt.mat.save: a Mat of type {mat.getType()}; allowed is a Mat of pctt.mat.TensorTrain")
    context: TensorTrain = mat.getPythonContext()
    values: dict[str, Any] = {
        "format": FORMAT, "version": VERSION, "order": matrix.order, "origin": matrix.origin, "shift": matrix.shift,
        "scale": matrix.scale, "error": matrix.error, "symmetric": matrix.symmetric, "eps": context.options.eps,
        "residual": np.nan if matrix.residual is None else matrix.residual, "max_rank": context.options.max_rank,
        "grid": matrix.digits.shape, "block": matrix.digits.block,
    }  # fmt: skip
    arrays = {f"cores/{k}": core for k, core in enumerate(matrix.train.cores)}
    if matrix.rows is not None:
        arrays["rows"] = matrix.rows
    values = {name: _plain(value) for name, value in values.items()}
    on_first(matrix.comm, lambda: _write(Path(path), values, arrays))


def load(path: str | os.PathLike[str], comm: MPI.Comm | PETSc.Comm | None = None) -> PETSc.Mat:
    """The Mat that `save` wrote, on any number of ranks. Collective.

    Its entries are those of the train. OSError on all ranks if the file cannot be read, and ValueError if it is damaged
    or no file of `save`.
    """
    given = PETSc.COMM_WORLD if comm is None else comm
    mpi = given.tompi4py() if isinstance(given, PETSc.Comm) else given
    values, train, rows = on_first(mpi, lambda: _read(Path(path)))
    digits = GridDigits(values["grid"], values["block"])
    points = digits.rows // digits.block
    counts = points // mpi.size + (np.arange(mpi.size) < points % mpi.size)  # as PETSc does it
    matrix = GridTrain(
        mpi, counts * digits.block, digits, rows, values["order"], train, values["shift"], values["scale"],
        values["error"], values["symmetric"], values["origin"],
        residual=None if np.isnan(values["residual"]) else values["residual"],
    )  # fmt: skip
    return mat_of(matrix, Options(values["eps"], values["max_rank"]))


def _write(path: Path, values: dict[str, Any], arrays: dict[str, np.ndarray]) -> None:
    memory = io.BytesIO()  # because HDF5 does not recover from a full disk
    with h5py.File(memory, "w") as file:
        file.attrs.update({**values, "checksum": _checksum(values, arrays)})
        for name, array in arrays.items():
            file[name] = array
    with whole(path) as temporary:
        temporary.write_bytes(memory.getvalue())


def _read(path: Path) -> tuple[dict[str, Any], Train, np.ndarray | None]:
    """The attributes as Python numbers, the train and the rows; only on one rank."""
    data = path.read_bytes()
    values: dict[str, Any] = {}
    arrays: dict[str, np.ndarray] = {}
    why = ""
    try:
        with h5py.File(io.BytesIO(data), "r") as file:
            values = {name: _plain(value) for name, value in file.attrs.items()}
            arrays = {f"cores/{k}": file[f"cores/{k}"][()] for k in range(len(file.get("cores", ())))}
            arrays |= {"rows": file["rows"][()]} if "rows" in file else {}
    except Exception as error:  # h5py raises many kinds
        why = " ".join(f"damaged, or no HDF5 file ({error})".split())
    checksum = values.pop("checksum", None)
    if not why and values.get("format") != FORMAT:
        why = "no file of pctt.mat.save"
    elif not why and values.get("version") != VERSION:
        why = f"version {values.get('version')} of the format; allowed is {VERSION}"
    elif not why and checksum != _checksum(values, arrays):
        why = "damaged: the checksum differs"
    if why:
        raise ValueError(f"{path}: {why}")
    rows = arrays.pop("rows", None)
    return values, Train(arrays.values()), rows


def _plain(value: Any) -> Any:
    """A Python number, text or tuple for the value of an attribute."""
    value = value.tolist() if isinstance(value, (np.ndarray, np.generic)) else value
    return tuple(value) if isinstance(value, list) else value


def _checksum(values: dict[str, Any], arrays: dict[str, np.ndarray]) -> str:
    digest = hashlib.sha256()
    for name in sorted(values):
        value = values[name]
        digest.update(f"{name} {float(value).hex() if isinstance(value, float) else value!r};".encode())
    for name in sorted(arrays):
        array = np.ascontiguousarray(arrays[name])
        digest.update(f"{name} {array.dtype.str} {array.shape};".encode())
        digest.update(array.tobytes())
    return digest.hexdigest()
