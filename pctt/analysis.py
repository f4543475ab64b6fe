"""Measures of a run from its files: the functions of `dem.measures` on recorded steps, and fields for ParaView.

    from dem import measures
    from pctt import analysis
    from pctt.folder import Folder

    folder = Folder("results")
    print(measures.stress(analysis.sample(folder, folder.steps[-1]), measures.Block((0, 0, 0), (1, 1, 0.5))))
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import h5py
import numpy as np
from mpi4py import MPI

from dem import measures
from dem.arrays import Floats
from dem.checks import short
from dem.measures import Fields, Sample
from dem.measures.images import nearest_image
from dem.mesh import Mesh
from pctt.disk import hdf5, whole
from pctt.folder import Folder


def sample(folder: Folder, step: int) -> Sample:
    """Return all grains and contacts of a recorded step. FileError if there is no such step, or if its file is damaged.

    Older records have no centres at the start of the step: those of the end, less dt times the velocities, stand for
    them, without what impacts and turning motions have moved."""
    if not isinstance(folder, Folder):
        raise ValueError(f"folder {folder!r}: allowed is a pctt.folder.Folder, such as Folder('results')")
    folder.require_frames()
    frame = folder.frame(step)
    table, grains = frame.table, slice(frame.table.grains)
    contacts = frame.contacts
    stretch = 1.0 + contacts.dt * frame.rate
    start = (frame.position - contacts.dt * frame.velocity[:, :3]) / stretch if frame.start is None else frame.start
    center = start[contacts.bodies]
    if contacts.moved is not None:
        center[:, 1] += contacts.moved
    row, side = np.nonzero(contacts.bodies < table.grains)  # points and grains were put into the cell each by itself
    point = contacts.point[row]
    lattice = (frame.lattice - contacts.dt * frame.drift / stretch[:, None]) / stretch
    center[row, side] = point + nearest_image(center[row, side] - point, lattice)
    return Sample(
        comm=MPI.COMM_SELF,
        count=table.grains,
        id=np.arange(table.grains),
        position=frame.position[grains],
        velocity=frame.velocity[grains],
        mass=table.mass[grains],
        shape=table.shape[grains],
        size=table.size[grains],
        material=table.material[grains],
        materials=tuple(folder.materials),
        bodies=contacts.bodies,
        center=center,
        point=contacts.point,
        normal=contacts.normal,
        gap=contacts.gap,
        force=contacts.force,
        moment=contacts.moment,
        lattice=frame.lattice,
        drift=frame.drift,
    )


def fields(folder: Folder, step: int, *given: Any, **more: Any) -> Fields:
    """Return coarse-grained fields of a recorded step; the other arguments are those of `dem.measures.fields`."""
    return measures.fields(sample(folder, step), *given, **more)


def triangle_forces(folder: Folder, step: int, name: str) -> Floats:
    """Return forces (triangles, 3) [N] on the triangles of the large body of this name, which is one mesh, as
    `dem.measures.triangle_forces`. ValueError for another body."""
    found, names = sample(folder, step), [body["name"] for body in folder.large]
    if name not in names:
        raise ValueError(f"no large body {name!r}; there are: {', '.join(names) or 'none'}")
    number = found.count + names.index(name)
    shapes = folder.large[names.index(name)]["shapes"]
    if [shape["kind"] for shape in shapes] != ["Mesh"]:
        raise ValueError(f"triangle_forces: the body {name!r} is not one mesh")
    mesh = Mesh(**{key: value for key, value in shapes[0].items() if key != "kind"})
    frame = folder.frame(step)
    return measures.triangle_forces(found, number, mesh, frame.position[number], frame.quaternion[number])


def write_fields(path: str | Path, fields: Fields) -> None:
    """Write fields as image data of VTKHDF with a value per cell, for ParaView 5.11 or newer. FileError if the file
    cannot be written. One rank writes."""
    if not isinstance(fields, Fields):
        raise ValueError(f"fields {short(fields)}: allowed are those of dem.measures.fields")
    path, shape = Path(path), np.array(fields.density.shape)
    columns = {name: value for name, value in fields._asdict().items() if name not in ("low", "spacing")}
    with whole(path) as temporary, hdf5(temporary) as file:
        root = file.create_group("VTKHDF")
        root.attrs["Version"] = np.array([1, 0])
        root.attrs.create("Type", b"ImageData", dtype=h5py.string_dtype("ascii", len("ImageData")))
        root.attrs["WholeExtent"] = np.stack([np.zeros(3, np.int64), shape], axis=1).ravel()
        root.attrs["Origin"], root.attrs["Spacing"] = fields.low, fields.spacing
        root.attrs["Direction"] = np.eye(3).ravel()
        cells = root.create_group("CellData")
        for name, value in columns.items():  # x is the fastest, and the components of a cell are together
            table = value.reshape(*shape, -1).transpose(2, 1, 0, 3)
            cells[name] = table[..., 0] if value.ndim == 3 else table
