"""``python -m pctt.export DIR``: the recorded steps of a run as time series for ParaView, or as one HDF5 file.

The program writes DIR/paraview/bodies.pvd, contacts.pvd and large.pvd. Each is a list of .vtp files, one per step. Any
number of ranks share the steps. Every ParaView and VTK of the last fifteen years reads these formats. With
``-format vtkhdf`` the first rank writes bodies.vtkhdf, contacts.vtkhdf and large.vtkhdf instead, for ParaView 5.12 or
newer. Each of these files has all steps.

With ``-single FILE.h5`` the first rank writes one HDF5 file instead. It has the data that state.h5 links to, in the
same groups.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from mpi4py import MPI

from pctt.disk import make_hdf5
from pctt.folder import RUN_FILES, Folder, FolderError, Frame
from pctt.look.program import add_steps, chosen, made_folder, parser, run, whole

SERIES = ("bodies", "contacts", "large")
FORMATS = ("vtp", "vtkhdf")


def arguments() -> argparse.Namespace:
    line = parser("export", "the recorded steps of a run as time series for ParaView (.pvd of .vtp files)")
    add_steps(line)
    line.add_argument("-format", choices=FORMATS, default="vtp", help="a .vtp file per step, or one .vtkhdf for all")
    target = line.add_mutually_exclusive_group()
    target.add_argument("-output", metavar="DIR", help="folder to write to; without: paraview/ in the output folder")
    target.add_argument("-single", metavar="FILE.h5", help="write one HDF5 file like state.h5 instead, with all data")
    return line.parse_args()


def main(comm: MPI.Comm) -> None:
    given = arguments()
    folder = Folder(given.folder)
    folder.require_frames()
    steps = chosen(folder.steps, given)
    if given.single:
        if comm.rank == 0:
            write_single(Path(given.single), folder, steps)
            print(f"{len(steps)} steps: {given.single}")
        return
    target = made_folder(Path(given.output) if given.output else folder.path / "paraview")

    from vtkmodules.vtkCommonCore import vtkLogger

    from pctt.look import surfaces  # imported here, because it needs vtk and -help does not

    vtkLogger.SetStderrVerbosity(vtkLogger.VERBOSITY_OFF)  # write_vtp reports errors
    box = surfaces.bounds(folder, [folder.frame(step) for step in {steps[0], steps[-1]}])
    if given.format == "vtkhdf":
        if comm.rank == 0:
            write_vtkhdf(target, folder, steps, box)
        return
    times = {}
    for step in steps[comm.rank :: comm.size]:
        frame = folder.frame(step)
        times[step] = frame.time
        for name in SERIES:
            write_vtp(target / f"{name}_{step:06d}.vtp", series(name, folder, frame, box), frame.time)
    shared = comm.gather(times)
    if comm.rank == 0:
        together = {step: time for part in shared or [] for step, time in part.items()}
        for name in SERIES:
            write_pvd(target / f"{name}.pvd", {f"{name}_{step:06d}.vtp": together[step] for step in steps})
        print(f"{len(steps)} steps: {target}/" + ", ".join(f"{name}.pvd" for name in SERIES))
    comm.Barrier()  # all files exist when any rank returns


def series(name: str, folder: Folder, frame: Frame, box: np.ndarray) -> Any:
    """One step of the series ``name``, one of SERIES, as vtkPolyData."""
    if name == "large":
        return large(folder, frame, box)
    return bodies(folder, frame) if name == "bodies" else contacts(folder, frame)


def write_vtkhdf(target: Path, folder: Folder, steps: list[int], box: np.ndarray) -> None:
    """Write one file per series; FolderError if a file cannot be written."""
    from pctt.look import vtkhdf

    times = [folder.frame(step).time for step in steps]
    for name in SERIES:
        with whole(target / f"{name}.vtkhdf") as temporary:
            frames = map(folder.frame, steps)
            vtkhdf.write(temporary, times, (series(name, folder, frame, box) for frame in frames))
    print(f"{len(steps)} steps: {target}/" + ", ".join(f"{name}.vtkhdf" for name in SERIES))


def write_single(path: Path, folder: Folder, steps: list[int]) -> None:
    """Write one HDF5 file with the data of these steps to which state.h5 links.

    FolderError if a file cannot be read or written, or belongs to the run.
    """
    frames = folder.bodies_path.parent.resolve()
    if path.resolve().parent == frames or path.resolve() in [(folder.path / name).resolve() for name in RUN_FILES]:
        raise FolderError(f"-single {path}: is a file of the run; allowed is another name")
    groups = {"bodies": folder.bodies_path, **{f"steps/{step:06d}": folder.frame_path(step) for step in steps}}
    with whole(path) as temporary:
        make_hdf5(temporary, sum(source.stat().st_size for source in groups.values()), items=0)
        with h5py.File(temporary, "r+") as file:
            with _part(folder.path / "state.h5") as links:
                file.attrs.update({name: value for name, value in links.attrs.items() if name != "links"})
            for name, source in groups.items():
                with _part(source) as part:
                    file.copy(part["/"], name)


@contextmanager
def _part(path: Path) -> Iterator[h5py.File]:
    """A file of a run, open for copying; FolderError if it cannot be copied."""
    try:
        with h5py.File(path, "r") as file:
            yield file
    except (OSError, RuntimeError) as error:
        raise FolderError(f"{path}: cannot be copied ({error})") from None


def bodies(folder: Folder, frame: Frame) -> Any:
    """The grains as points, with the data for glyphs.

    Scale a unit sphere or box by the vector `extent` and turn it by `quaternion`: the result is the grain. `radius` is
    the radius of the sphere that encloses the grain.
    """
    from pctt.look import surfaces

    grains = slice(folder.grains)
    data = surfaces.polydata(frame.position[grains], "verts")
    columns = {
        "id": np.arange(folder.grains),
        "radius": folder.radius,
        "extent": surfaces.extent(folder),
        "quaternion": frame.quaternion[grains],
        "velocity": frame.velocity[grains, :3],
        "angular_velocity": frame.velocity[grains, 3:],
        "speed": frame.speed[grains],
        "force": frame.load()[grains],
        "mass": folder.mass[grains],
        "material": folder.material[grains],
        "shape": folder.shape[grains],
    }
    surfaces.add_arrays(data.GetPointData(), columns)
    return data


def contacts(folder: Folder, frame: Frame) -> Any:
    """The contacts as force chains: a line joins the centres of the two bodies. A large body has no useful centre, so
    the line ends at the contact point instead."""
    from pctt.look import surfaces

    contact = frame.contacts
    ends = frame.position[contact.bodies]
    far = contact.bodies >= folder.grains
    ends[far] = np.repeat(contact.point[:, None], 2, axis=1)[far]
    data = surfaces.polydata(ends.reshape(-1, 3), "lines", 2 * np.arange(1, len(ends) + 1))
    size = np.linalg.norm(contact.force, axis=1)
    columns = {
        "normal_impulse": contact.impulse[:, 0],
        "impulse": contact.force * contact.dt,
        "force": size,
        "gap": contact.gap,
        "point": contact.point,
        "bodies": contact.bodies,
    }
    surfaces.add_arrays(data.GetCellData(), columns)
    surfaces.add_arrays(data.GetPointData(), {"force": np.repeat(size, 2)})  # tubes take their width from points
    return data


def large(folder: Folder, frame: Frame, box: np.ndarray) -> Any:
    """The surfaces of the large bodies, with the id of the body. Planes are cut to the box (2, 3) of the scene."""
    from pctt.look import surfaces

    parts = []
    for row in range(len(folder.large)):
        for part in (
            surfaces.finite(folder, frame, row),
            surfaces.polygon_data(surfaces.planes(folder, frame, row, box)),
        ):
            part.GetPointData().Initialize()
            surfaces.add_arrays(part.GetCellData(), {"body": np.full(part.GetNumberOfCells(), folder.grains + row)})
            parts.append(part)
    return surfaces.joined(parts)


def write_vtp(path: Path, data: Any, time: float) -> None:
    """Write polygonal data with its time, whole or not at all; FolderError if it cannot be written."""
    from vtkmodules.vtkCommonMisc import vtkErrorCode
    from vtkmodules.vtkIOXML import vtkXMLPolyDataWriter

    from pctt.look import surfaces

    surfaces.add_arrays(data.GetFieldData(), {"TimeValue": np.array([time])})
    writer = vtkXMLPolyDataWriter()
    writer.SetInputData(data)
    writer.SetHeaderTypeToUInt64()
    writer.SetDataModeToAppended()
    writer.EncodeAppendedDataOff()
    with whole(path) as temporary:
        writer.SetFileName(str(temporary))
        if writer.Write() != 1 or writer.GetErrorCode():
            raise OSError(vtkErrorCode.GetStringFromErrorCode(writer.GetErrorCode()))


def write_pvd(path: Path, files: dict[str, float]) -> None:
    """Write a list of files with their times [s]."""
    lines = [f'    <DataSet timestep="{time!r}" file="{name}"/>' for name, time in files.items()]
    head = '<?xml version="1.0"?>\n<VTKFile type="Collection" version="0.1" byte_order="LittleEndian">\n  <Collection>'
    with whole(path) as temporary:
        temporary.write_text("\n".join([head, *lines, "  </Collection>", "</VTKFile>", ""]))


#: The command pctt-export; its exit status.
program = partial(run, main, "export")


if __name__ == "__main__":
    sys.exit(program())
