"""Time series for ParaView, read back by VTK."""

from __future__ import annotations

import resource
import sys
import xml.etree.ElementTree as ElementTree

import handmade
import numpy as np
import pytest
from mpi4py import MPI

from dem.scene import Scene
from pctt import export
from pctt.disk import FileError
from pctt.folder import Folder
from pctt.look import program
from pctt.simulation import Simulation

pytest.importorskip("pctt.look.surfaces", reason="vtk 9.4 is not installed (extra `pictures`)")

from vtkmodules.util.numpy_support import vtk_to_numpy
from vtkmodules.vtkIOXML import vtkXMLPolyDataReader

SERIES = ("bodies", "contacts", "large")


def collection(path):
    return {float(entry.get("timestep")): entry.get("file") for entry in ElementTree.parse(path).iter("DataSet")}


def read(path):
    """The data of a .vtp file, and its arrays of points, cells and the whole."""
    reader = vtkXMLPolyDataReader()
    reader.SetFileName(str(path))
    reader.Update()
    data = reader.GetOutput()
    parts = (data.GetPointData(), data.GetCellData(), data.GetFieldData())
    arrays = [
        {part.GetArrayName(k): vtk_to_numpy(part.GetArray(k)) for k in range(part.GetNumberOfArrays())}
        for part in parts
    ]
    return data, *arrays


def points(data):
    return vtk_to_numpy(data.GetPoints().GetData())


@pytest.mark.parallel(1, 2)
def test_the_series_hold_what_the_run_recorded(folder, tmp_path, monkeypatch):
    words = ["export", str(folder), "-output", str(tmp_path / "series"), "-first", "2"]
    monkeypatch.setattr(sys, "argv", words)
    assert program.run(export.main, "export") == 0
    MPI.COMM_WORLD.Barrier()  # the first rank writes the collections
    run = Folder(folder)
    run.require_frames()
    for name in SERIES:
        listed = collection(tmp_path / "series" / f"{name}.pvd")
        assert listed == {run.frame(step).time: f"{name}_{step:06d}.vtp" for step in (2, 3, 4)}
        assert all((tmp_path / "series" / file).exists() for file in listed.values())
    frame = run.frame(4)
    data, arrays, _, whole = read(tmp_path / "series" / "bodies_000004.vtp")
    assert whole["TimeValue"] == frame.time
    np.testing.assert_array_equal(points(data), frame.position[:125])
    np.testing.assert_array_equal(arrays["velocity"], frame.velocity[:125, :3])
    np.testing.assert_array_equal(arrays["quaternion"], frame.quaternion[:125])
    np.testing.assert_array_equal(arrays["id"], np.arange(125))
    assert (arrays["radius"] == 0.1).all()
    data, _, arrays, _ = read(tmp_path / "series" / "contacts_000004.vtp")
    assert data.GetNumberOfLines() == len(frame.contacts.gap) > 10
    np.testing.assert_array_equal(arrays["normal_impulse"], frame.contacts.impulse[:, 0])


def test_all_steps_in_one_file(show, folder, tmp_path):
    hdf = pytest.importorskip("vtkmodules.vtkIOHDF")
    show("export", "-output", tmp_path, "-format", "vtkhdf", folder=folder)
    run = Folder(folder)
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(f"{name}.vtkhdf" for name in SERIES)
    reader = hdf.vtkHDFReader()
    for name in SERIES:
        reader.SetFileName(str(tmp_path / f"{name}.vtkhdf"))
        reader.UpdateInformation()
        assert reader.GetNumberOfSteps() == len(run.steps)
        for k, step in enumerate(run.steps):
            reader.SetStep(k)
            reader.Update()
            data, frame = reader.GetOutputDataObject(0), run.frame(step)
            assert reader.GetTimeValue() == pytest.approx(frame.time)
            if name == "bodies":
                np.testing.assert_array_equal(points(data), frame.position[:125])
                velocity = vtk_to_numpy(data.GetPointData().GetArray("velocity"))
                np.testing.assert_array_equal(velocity, frame.velocity[:125, :3])
            elif name == "contacts":
                assert data.GetNumberOfLines() == len(frame.contacts.gap)
            else:
                assert data.GetNumberOfPolys() > 0


@pytest.mark.parametrize("kind", ["vtp", "vtkhdf"])
def test_a_run_without_large_bodies_has_no_file_of_them(show, tmp_path, kind):
    """A series that is empty in all steps made VTK's writer lose it, which was an error."""
    pytest.importorskip("vtkmodules.vtkIOHDF")
    scene = Scene(0.3, gravity=(0, 0, 0), period=(0.6, 0.6, 0.6), shear_rate=1.0)
    scene.add_spheres(0.2 * np.indices((3, 3, 3)).reshape(3, -1).T, 0.1, 1000.0)
    with Simulation(scene, dt=0.005, comm=MPI.COMM_SELF) as sim:
        sim.write(tmp_path / "run")
        sim.run(steps=2)
    show("export", "-output", tmp_path / "series", "-format", kind, folder=tmp_path / "run")
    end = {"vtp": ".pvd", "vtkhdf": ".vtkhdf"}[kind]
    assert {path.stem for path in (tmp_path / "series").glob(f"*{end}")} == {"bodies", "contacts"}


def test_glyphs_have_the_extents_of_the_grains_and_force_chains_join_centres(show, tmp_path):
    made = handmade.write(tmp_path / "made", handmade.FLOOR)
    show("export", folder=made)
    _, grains, _, _ = read(made / "paraview" / "bodies_000001.vtp")
    np.testing.assert_allclose(grains["extent"], [[1, 1, 1], [0.4, 0.8, 1.6], [0.6, 0.6, 1.8]])
    np.testing.assert_allclose(grains["radius"], [0.5, np.linalg.norm([0.2, 0.4, 0.8]), 0.9])
    np.testing.assert_allclose(grains["speed"], [5, 0, 2.5])
    data, ends, arrays, _ = read(made / "paraview" / "contacts_000001.vtp")
    line = points(data).reshape(2, 2, 3)
    np.testing.assert_allclose(line[0], [[0, 0, 0.5], [0, 0, 0]])  # to the contact point on the floor
    np.testing.assert_allclose(line[1], [[0, 0, 0.5], [0, 1.5, 0.3]])
    np.testing.assert_allclose(arrays["impulse"], [[4, 0, -3], [0, 2, 0]], atol=1e-14)
    np.testing.assert_allclose(arrays["force"], [10, 4])
    np.testing.assert_allclose(ends["force"], [10, 10, 4, 4])


def test_a_series_that_cannot_be_written_is_an_error(folder, tmp_path):
    """Not even a part of it stays; VTK's writer of VTKHDF files alone would say nothing."""
    from pctt.look.surfaces import Scene

    run = Folder(folder)
    run.require_frames()
    scene, before = Scene(run, [run.frame(4)]), resource.getrlimit(resource.RLIMIT_FSIZE)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (1000, before[1]))
        with pytest.raises(FileError, match="cannot write"):
            export.write_vtkhdf(tmp_path / "bodies.vtkhdf", "bodies", scene, run.steps)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert not list(tmp_path.iterdir())


def test_large_bodies_are_surfaces_where_they_are(show, folder, tmp_path):
    """The paddle after four steps of its turning, and floor and walls cut by each other."""
    show("export", "-output", tmp_path)
    run = Folder(folder)
    run.require_frames()
    data, _, arrays, _ = read(tmp_path / "large_000004.vtp")
    assert set(arrays["body"]) == {125, 126}
    assert (arrays["body"] == 125).sum() == 5
    place = points(data)
    half = 0.625
    bound = place[np.abs(np.abs(place[:, :2]) - half).max(axis=1) < 1e-9]
    assert len(bound) == 5 * 4  # the corners of five faces
    angle = 0.4 * np.pi / 3
    length, thick, tall = run.large[1]["shapes"][0]["half_extents"]
    center = run.frame(4).position[126]
    corner = center + [
        length * np.cos(angle) - thick * np.sin(angle), length * np.sin(angle) + thick * np.cos(angle), tall
    ]
    assert np.linalg.norm(place - corner, axis=1).min() < 1e-6
