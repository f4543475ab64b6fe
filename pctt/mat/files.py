"""Trains in files: a Mat that multiplies with a train, kept between runs (HDF5).

    /                attributes: format, order, origin, shift, scale, error, residual (NaN: none), symmetric, eps,
                     max_rank, grid (n_1, n_2, ...), block
    /cores/0 ...     the cores (r, m, n, r')
    /rows            the row of the Mat at each point of the grid; missing if the rows are in the order of the points

Such a file ends with a checksum, as those of runs do (`pctt.disk`). Row numbers are those of the Mat that was saved.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from dem.exchange import on_first
from pctt.blocks import refuse_unready
from pctt.disk import read, write_rows
from pctt.mat.grid_train import GridTrain
from pctt.mat.order import Layout
from pctt.mat.tensor_train import Options, TensorTrain, compressed, mat_of
from pctt.tt.quantise import GridDigits
from pctt.tt.train import Train

FORMAT = "pctt train 2"


def save(mat: PETSc.Mat, path: str | os.PathLike[str]) -> None:
    """Write the train of a Mat of `from_entries`, `inverse` or `load` to an HDF5 file. Collective.

    The file is whole at any moment: an old one stays until the new one is complete. The function of the entries is not
    saved. ValueError on all ranks for another Mat, and FileError if the file cannot be written.
    """
    refuse_unready("pctt.mat.save", mat)
    matrix = compressed(mat)
    if matrix is None:
        raise ValueError(f"pctt.mat.save: a Mat of type {mat.getType()}; allowed is a Mat of pctt.mat.TensorTrain")
    context: TensorTrain = mat.getPythonContext()
    layout = matrix.layout
    values: dict[str, Any] = {
        "format": FORMAT, "order": layout.order, "origin": matrix.origin, "shift": matrix.shift,
        "scale": matrix.scale, "error": matrix.error, "symmetric": matrix.symmetric, "eps": context.options.eps,
        "residual": np.nan if matrix.residual is None else matrix.residual, "max_rank": context.options.max_rank,
        "grid": layout.digits.shape, "block": layout.digits.block,
    }  # fmt: skip
    arrays = {f"cores/{k}": core for k, core in enumerate(matrix.train.cores)}
    if layout.rows is not None:
        arrays["rows"] = layout.rows
    on_first(layout.comm, lambda: write_rows(Path(path), MPI.COMM_SELF, {}, arrays, {"/": values}))


def load(path: str | os.PathLike[str], comm: MPI.Comm | PETSc.Comm | None = None) -> PETSc.Mat:
    """Return the Mat that `save` wrote, on any number of ranks. Collective.

    Its entries are those of the train. FileError on all ranks if the file cannot be read, is damaged, or is none of
    `save`.
    """
    given = PETSc.COMM_WORLD if comm is None else comm
    mpi = given.tompi4py() if isinstance(given, PETSc.Comm) else given
    values, train, rows = on_first(mpi, lambda: read(Path(path), MPI.COMM_SELF, _taken))
    digits = GridDigits(values["grid"], values["block"])
    points = digits.rows // digits.block
    counts = points // mpi.size + (np.arange(mpi.size) < points % mpi.size)  # as PETSc does it
    layout = Layout(mpi, counts * digits.block, digits, rows, values["order"])
    matrix = GridTrain(
        layout, train, values["shift"], values["scale"], values["error"], values["symmetric"], values["origin"],
        residual=None if np.isnan(values["residual"]) else values["residual"],
    )  # fmt: skip
    return mat_of(matrix, Options(values["eps"], values["max_rank"]))


def _taken(file: h5py.File) -> tuple[dict[str, Any], Train, np.ndarray | None]:
    """The attributes as Python numbers, the train and the rows."""
    values = {name: _plain(value) for name, value in file.attrs.items()}
    if values.get("format") != FORMAT:
        raise ValueError(f"it is not marked '{FORMAT}'")
    train = Train([file[f"cores/{k}"][()] for k in range(len(file["cores"]))])
    rows, digits = file["rows"][()] if "rows" in file else None, GridDigits(values["grid"], values["block"])
    if not train.rows == train.columns == tuple(digits.modes):
        raise ValueError(f"cores of modes {train.modes} are not those of the grid {values['grid']}")
    if rows is not None and not np.array_equal(np.sort(rows), np.arange(digits.rows)):
        raise ValueError(f"rows are not one for each point of the grid {values['grid']}")
    return values, train, rows


def _plain(value: Any) -> Any:
    """A Python number, text or tuple for the value of an attribute."""
    value = value.tolist() if isinstance(value, (np.ndarray, np.generic)) else value
    return tuple(value) if isinstance(value, list) else value
