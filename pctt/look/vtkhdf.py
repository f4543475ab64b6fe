"""A series of polygonal data in one VTKHDF file, the format of ParaView since 5.12 (see "VTK File Formats")."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from vtkmodules.util.numpy_support import vtk_to_numpy

VERSION = (2, 0)
TOPOLOGIES = {"Vertices": "GetVerts", "Lines": "GetLines", "Polygons": "GetPolys", "Strips": "GetStrips"}


def write(path: Path, times: Sequence[float], data: Iterable[Any]) -> None:
    """Write vtkPolyData at each of the times [s]. OSError if the file cannot be written."""
    with h5py.File(path, "w") as file:
        root = file.create_group("VTKHDF")
        root.attrs["Version"] = VERSION
        root.attrs.create("Type", b"PolyData", dtype=h5py.string_dtype("ascii", len("PolyData")))
        steps = root.create_group("Steps")
        steps.attrs["NSteps"] = len(times)
        steps["Values"] = np.asarray(times, dtype=float)
        steps["PartOffsets"] = np.arange(len(times))
        steps["NumberOfParts"] = np.ones(len(times), np.int64)
        for one in data:
            _append_step(root, steps, one)


def _append_step(root: h5py.Group, steps: h5py.Group, data: Any) -> None:
    """Append the data of a step to those of the earlier steps, and the offsets where they begin to ``steps``."""
    points = data.GetPoints()
    places = vtk_to_numpy(points.GetData()) if points else np.zeros((0, 3))
    _append(steps, "PointOffsets", [_append(root, "Points", places)])
    _append(root, "NumberOfPoints", [len(places)])
    cells, connectivity = [], []
    for name, get in TOPOLOGIES.items():
        array, group = getattr(data, get)(), root.require_group(name)
        count = array.GetNumberOfCells()
        ends = vtk_to_numpy(array.GetOffsetsArray()) if count else np.zeros(1)
        joined = vtk_to_numpy(array.GetConnectivityArray()) if count else np.zeros(0)
        before = _append(group, "NumberOfCells", [count])
        cells.append(_append(group, "Offsets", ends.astype(np.int64)) - before)  # a part has one offset more than cells
        connectivity.append(_append(group, "Connectivity", joined.astype(np.int64)))
        _append(group, "NumberOfConnectivityIds", [len(joined)])
    _append(steps, "CellOffsets", [cells])
    _append(steps, "ConnectivityIdOffsets", [connectivity])
    for kind, arrays in (("PointData", data.GetPointData()), ("CellData", data.GetCellData())):
        here, offsets = root.require_group(kind), steps.require_group(f"{kind}Offsets")
        for k in range(arrays.GetNumberOfArrays()):
            name = arrays.GetArrayName(k)
            _append(offsets, name, [_append(here, name, vtk_to_numpy(arrays.GetArray(k)))])


def _append(group: h5py.Group, name: str, rows: Any) -> int:
    """Append rows to a dataset and return the number of rows before; make the dataset if it does not exist."""
    rows = np.asarray(rows)
    if name not in group:
        group.create_dataset(name, (0, *rows.shape[1:]), rows.dtype, maxshape=(None, *rows.shape[1:]), chunks=True)
    dataset = group[name]
    before = len(dataset)
    dataset.resize(before + len(rows), axis=0)
    dataset[before:] = rows
    return before
