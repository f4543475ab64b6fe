"""``python -m pctt.export DIR``: the recorded steps of a run as time series for ParaView, or as one HDF5 file.

The program writes DIR/paraview/bodies.pvd and contacts.pvd, and large.pvd and polyhedra.pvd if there are such. Each
is a list of .vtp files, one per step. Any number of ranks share the steps. Every ParaView and VTK of the last fifteen
years reads these formats. With ``-format vtkhdf`` the first rank writes files of these names and the ending .vtkhdf
instead, for ParaView 5.12 or newer. Each of these files has all steps.

With ``-single FILE.h5`` the first rank writes one HDF5 file instead. It has the data that state.h5 links to, in the
same groups.
"""

from __future__ import annotations

import argparse
import sys
from functools import partial
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from mpi4py import MPI

from pctt.disk import FileError, hdf5, refuse_links, whole, write_text
from pctt.folder import RUN_FILES, Folder, Frame
from pctt.look.program import chosen, described_steps, made_folder, parser, run
from pctt.options import OptionError

SERIES = ("bodies", "contacts", "large", "polyhedra")


def arguments() -> argparse.Namespace:
    line = parser("export", "the recorded steps of a run as time series for ParaView (.pvd of .vtp files)", "paraview")
    line.add_argument("-format", choices=("vtp", "vtkhdf"), help="a .vtp file per step, the usual, or one .vtkhdf")
    line.add_argument("-single", type=Path, metavar="FILE.h5", help="write one HDF5 file like state.h5 instead")
    return line.parse_args()


def main(comm: MPI.Comm) -> None:
    given = arguments()
    if given.single and (given.output or given.format):
        other = f"-output {given.output}" if given.output else f"-format {given.format}"
        raise OptionError(f"{other}: has no effect on the file of -single {given.single}; allowed is one of them")
    folder = Folder(given.folder)
    folder.require_frames()
    steps = chosen(folder.steps, given)
    if given.single:
        if comm.rank == 0:
            write_single(given.single, folder, steps)
            print(f"{described_steps(folder, steps)}: {given.single}")
        return
    target = made_folder(given.output or folder.path / "paraview")

    from vtkmodules.vtkCommonCore import vtkLogger

    from pctt.look.surfaces import Scene  # imported here, because it needs vtk and -help does not

    vtkLogger.SetStderrVerbosity(vtkLogger.VERBOSITY_OFF)  # the writers' results are checked
    absent = set() if folder.large else {"large"}
    absent |= set() if any("triangles" in form for form in folder.forms) else {"polyhedra"}
    names = [name for name in SERIES if name not in absent]
    scene = Scene(folder, [folder.frame(step) for step in (steps[0], steps[-1])])
    form = given.format or "vtp"
    if form == "vtp":
        times = {}
        for step in steps[comm.rank :: comm.size]:
            frame = folder.frame(step)
            times[step] = frame.time
            for name in names:
                write_vtp(target / f"{name}_{step:06d}.vtp", series(name, scene, frame), frame.time)
        shared = comm.gather(times)
    if comm.rank == 0:
        for name in names:
            if form == "vtp":
                together = {step: time for part in shared or [] for step, time in part.items()}
                write_pvd(target / f"{name}.pvd", {f"{name}_{step:06d}.vtp": together[step] for step in steps})
            else:
                write_vtkhdf(target / f"{name}.vtkhdf", name, scene, steps)
        kind = "pvd" if form == "vtp" else "vtkhdf"
        print(f"{described_steps(folder, steps)}: {target}/" + ", ".join(f"{name}.{kind}" for name in names))
    comm.Barrier()  # all files exist when any rank returns


def write_single(path: Path, folder: Folder, steps: list[int]) -> None:
    """Write one HDF5 file with the data of these steps to which state.h5 links.

    FileError if a file cannot be read or written, or belongs to the run.
    """
    frames = folder.bodies_path.parent.resolve()
    if path.resolve().parent == frames or path.resolve() in [(folder.path / name).resolve() for name in RUN_FILES]:
        raise FileError(f"-single {path}: is a file of the run; allowed is another name")
    parts = {"bodies": folder.bodies_path, **{f"steps/{step:06d}": folder.frame_path(step) for step in steps}}
    with whole(path) as temporary, hdf5(temporary) as file:
        source = folder.path / "state.h5"
        try:
            if not source.exists():  # of a run that goes on, or was killed
                folder.derive()
            with h5py.File(source, "r") as links:
                file.attrs.update({name: value for name, value in links.attrs.items() if name != "links"})
            for name, source in parts.items():
                with h5py.File(source, "r") as part:
                    refuse_links(part)
                    file.copy(part["/"], name)
        except (OSError, RuntimeError, ValueError) as error:
            raise FileError(f"{source}: cannot be copied ({error})") from None


def series(name: str, scene: Any, frame: Frame) -> Any:
    """One step of the series ``name``, one of SERIES, as vtkPolyData; ``scene`` is a
    `pctt.look.surfaces.Scene`."""
    return {"bodies": bodies, "contacts": contacts, "large": large, "polyhedra": facets}[name](scene, frame)


def bodies(scene: Any, frame: Frame) -> Any:
    """The grains as points, with the data for glyphs.

    Scale a unit sphere or box by the vector `extent` and turn it by `quaternion`: the result is the grain. `radius` is
    the radius of the sphere that encloses the grain. A clump has a point for each of its spheres instead, with the
    `extent` of the sphere; its other columns are those of the clump. Polyhedra have the `extent` of the sphere about
    them.
    """
    from pctt.look import surfaces

    table = frame.table
    of_form, place, radius = surfaces.members(frame)
    whole = np.setdiff1d(np.arange(table.grains), of_form)
    rows = np.concatenate([whole, of_form])
    data = surfaces.polydata(np.concatenate([frame.position[whole], place]), "verts", 1)
    extent = surfaces.extent(scene.folder.path, table)[rows]
    extent[len(whole) :] = 2.0 * radius[:, None]
    each = {name: column[rows] for name, column in _of_grains(frame).items()}
    surfaces.add_arrays(data.GetPointData(), {"extent": extent, **each})
    return data


def facets(scene: Any, frame: Frame) -> Any:
    """The surfaces of the grains that are polyhedra, with the data of the grain for each triangle."""
    from pctt.look import surfaces

    rows, corners = surfaces.faces(frame)
    data = surfaces.polydata(corners, "polys", 3)
    surfaces.add_arrays(data.GetCellData(), {name: column[rows] for name, column in _of_grains(frame).items()})
    return data


def _of_grains(frame: Frame) -> dict[str, np.ndarray]:
    """What the files have of each grain."""
    table, grains = frame.table, slice(frame.table.grains)
    return {
        "id": table.id[grains],
        "radius": table.radius,
        "quaternion": frame.quaternion[grains],
        "velocity": frame.velocity[grains, :3],
        "angular_velocity": frame.velocity[grains, 3:],
        "speed": frame.speed[grains],
        "force": frame.load()[grains],
        "mass": table.mass[grains],
        "material": table.material[grains],
        "shape": table.shape[grains],
    }


def contacts(scene: Any, frame: Frame) -> Any:
    """The contacts as force chains: a line joins the centres of the two bodies. A large body has no useful centre, so
    the line ends at the contact point instead."""
    from pctt.look import surfaces

    contact = frame.contacts
    ends = frame.position[contact.bodies]
    far = contact.bodies >= frame.table.grains
    ends[far] = np.repeat(contact.point[:, None], 2, axis=1)[far]
    data = surfaces.polydata(ends, "lines", 2)
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


def large(scene: Any, frame: Frame) -> Any:
    """The surfaces of the large bodies, with the id of the body. Planes are cut to the size of the scene."""
    from pctt.look import surfaces

    parts = []
    for row in range(len(scene.folder.large)):
        part = surfaces.joined([scene.surface(frame, row), scene.planes(frame, row)])
        body = np.full(part.GetNumberOfCells(), frame.table.grains + row)
        part.GetPointData().Initialize()
        part.GetCellData().Initialize()
        surfaces.add_arrays(part.GetCellData(), {"body": body})
        parts.append(part)
    return surfaces.joined(parts)


def write_vtp(path: Path, data: Any, time: float) -> None:
    """Write polygonal data with its time, whole or not at all; FileError if it cannot be written."""
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
    write_text(path, "\n".join([head, *lines, "  </Collection>", "</VTKFile>", ""]))


def write_vtkhdf(path: Path, name: str, scene: Any, steps: list[int]) -> None:
    """Write all steps of a series into one file; FileError if it cannot be written."""
    from vtkmodules.util.vtkAlgorithm import VTKPythonAlgorithmBase
    from vtkmodules.vtkCommonCore import vtkVersion
    from vtkmodules.vtkCommonExecutionModel import vtkStreamingDemandDrivenPipeline as Pipeline
    from vtkmodules.vtkIOHDF import vtkHDFWriter

    points: dict[int, int] = {}

    class PolyDataSource(VTKPythonAlgorithmBase):
        """The steps as a series that VTK asks for by time; here the number of the step is the time."""

        def RequestInformation(self, _request: Any, _inputs: Any, outputs: Any) -> int:
            outputs.GetInformationObject(0).Set(Pipeline.TIME_STEPS(), range(len(steps)), len(steps))
            outputs.GetInformationObject(0).Set(Pipeline.TIME_RANGE(), [0, len(steps) - 1], 2)
            return 1

        def RequestData(self, _request: Any, _inputs: Any, outputs: Any) -> int:
            step = steps[int(outputs.GetInformationObject(0).Get(Pipeline.UPDATE_TIME_STEP()))]
            data = series(name, scene, scene.folder.frame(step))
            points[step] = data.GetNumberOfPoints()
            outputs.GetInformationObject(0).Get(data.DATA_OBJECT()).ShallowCopy(data)
            return 1

    source = PolyDataSource(nInputPorts=0, outputType="vtkPolyData")
    writer = vtkHDFWriter(write_all_time_steps=True, chunk_size=1000)
    writer.SetInputConnection(source.GetOutputPort())
    with whole(path) as temporary:
        # VTK's writer tells no errors, and does not return if it cannot open the file, so the room is tried before
        with open(temporary, "wb") as file:
            for step in steps:
                file.write(bytes(2 * scene.folder.frame_path(step).stat().st_size))
        writer.SetFileName(str(temporary))
        writer.Write()
        del writer  # VTK 9.4 closes the file then
        with h5py.File(temporary, "r+") as file:
            root = file["VTKHDF"]
            if root["NumberOfPoints"][()].tolist() != [points[step] for step in steps]:
                raise OSError(f"vtk {vtkVersion.GetVTKVersion()} loses data; take a newer one, or -format vtp")
            del root["Steps/Values"]  # in single precision
            root["Steps/Values"] = np.array([scene.folder.frame(step).time for step in steps])


#: The command pctt-export; its exit status.
program = partial(run, main, "export")


if __name__ == "__main__":
    sys.exit(program())
