"""Measures of a simulation and of its files: the same figures, on the same grains."""

from __future__ import annotations

import h5py
import numpy as np
import pytest
from mpi4py import MPI

import pctt
from dem import measures
from dem.measures import Block
from dem.mesh import Mesh
from dem.motion import Rotation
from dem.scene import Scene
from dem.shapes import Box, Plane
from pctt import analysis
from pctt.folder import Folder

WIDE = Block((-1, -1, -1), (1, 1, 1))


def lying():
    """Spheres upon a square of two triangles that lies turned in its body."""
    scene = Scene(0.5)
    turn = (np.cos(0.3), 0, 0, np.sin(0.3))
    square = Mesh([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], [[0, 1, 2], [0, 2, 3]], quaternion=turn)
    scene.add_body("floor", [square], position=(0, 0, -0.1))
    scene.add_body("ceiling", [Plane((0, 0, -1))], position=(0, 0, 5))
    scene.add_spheres([[0.4, -0.1, 0], [0.5, -0.3, 0], [-0.3, 0.4, 0], [0.4, -0.1, 0.2]], 0.1, 1000.0)
    return scene


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    path = tmp_path_factory.mktemp("measures") / "run"
    sim = pctt.Simulation(lying(), dt=0.002, solver="apgd", tol=1e-9, stiffness=np.inf, comm=MPI.COMM_SELF)
    sim.write(path)
    sim.run(steps=3)
    sim.close()
    return sim, Folder(path)


def test_nothing_is_measured_before_the_first_step():
    with pytest.raises(ValueError, match="no step was made"):
        pctt.Simulation(lying(), comm=MPI.COMM_SELF).sample  # noqa: B018


def test_the_samples_of_a_simulation_and_of_its_files_are_alike(results):
    sim, folder = results
    one, other = sim.sample, analysis.sample(folder, folder.steps[-1])
    for a, b in zip(measures.per_grain(one), measures.per_grain(other)):
        np.testing.assert_allclose(a, b, atol=1e-9)
    np.testing.assert_allclose(measures.stress(one, WIDE), measures.stress(other, WIDE), atol=1e-9)
    fields = analysis.fields(folder, folder.steps[-1], WIDE, (4, 4, 4), 0.6)
    np.testing.assert_allclose(fields.stress, measures.fields(one, WIDE, (4, 4, 4), 0.6).stress, atol=1e-9)


def test_centres_of_spheres_that_slide_on_each_other_are_alike(tmp_path):
    """A contact is that of the end of its step: one of its two bodies is moved ahead, in the files as well."""
    scene = Scene(0.5, gravity=(0, 0, 0))
    scene.add_spheres([[0, 0, 0], [0, 0, 0.2]], 0.1, 1000.0, velocity=[[0, 0, 0.1], [0.3, 0, -0.1]])
    with pctt.Simulation(scene, dt=0.002, comm=MPI.COMM_SELF) as sim:
        sim.write(tmp_path / "run")
        sim.run(steps=1)
        one = sim.sample
    other = analysis.sample(Folder(tmp_path / "run"), 1)
    assert one.force[0, 2] > 0.0
    np.testing.assert_allclose(other.center, one.center, atol=1e-12)
    np.testing.assert_allclose(one.center[0, 1] - one.point[0], 0.1 * one.normal[0], atol=1e-6)


@pytest.mark.parallel(1, 2)
def test_centres_before_impacts_and_turns_are_alike(tmp_path):
    """Spheres bounce off each other and off a bar that turns: velocities at the end of the step are not those in it."""
    scene = Scene(0.5, gravity=(0, 0, 0), restitution=0.8)
    scene.add_spheres([[0.201 * k, 0, 0] for k in range(4)], 0.1, 1000.0, velocity=[[2.0, 0, 0], *[[-1.0, 0, 0]] * 3])
    scene.add_body("bar", [Box((0.1, 0.05, 0.5))], Rotation((0, 1.0, 0)), position=(0.302, 0.152, 0))
    with pctt.Simulation(scene, dt=0.002) as sim:
        sim.write(tmp_path / "run")
        for _ in range(3):
            sim.step()
            found = sim.comm.gather((sim.sample.bodies, sim.sample.point, sim.sample.center))
            if sim.comm.rank == 0:
                bodies, point, center = (np.concatenate(columns) for columns in zip(*found))
                other = analysis.sample(Folder(tmp_path / "run"), sim.steps)
                both = (bodies, point), (other.bodies, other.point)
                one, two = (np.lexsort((*place.T.round(9), *pair.T)) for pair, place in both)
                np.testing.assert_array_equal(other.bodies[two], bodies[one])
                np.testing.assert_allclose(other.center[two], center[one], atol=1e-12)
                assert len(point)


def test_the_triangles_bear_the_weight_of_the_spheres(results):
    sim, folder = results
    force = sim.body("floor").triangle_forces()
    weight = 9.81 * sim.local.mass[0]
    np.testing.assert_allclose(force[:, 2], [-3 * weight, -weight], rtol=1e-5)
    np.testing.assert_allclose(force.sum(axis=0), sim.body("floor").force, atol=1e-9)
    np.testing.assert_allclose(analysis.triangle_forces(folder, folder.steps[-1], "floor"), force, atol=1e-9)
    with pytest.raises(ValueError, match="body 'ceiling' is not one mesh"):
        sim.body("ceiling").triangle_forces()
    with pytest.raises(ValueError, match="body 'ceiling' is not one mesh"):
        analysis.triangle_forces(folder, folder.steps[-1], "ceiling")
    with pytest.raises(ValueError, match="no large body 'roof'; there are: floor, ceiling"):
        analysis.triangle_forces(folder, folder.steps[-1], "roof")


def test_fields_are_written_as_image_data(results, tmp_path):
    found = measures.fields(results[0].sample, Block((-1, -1, -1), (1, 2, 3)), (2, 3, 4), 0.9)
    analysis.write_fields(tmp_path / "fields.vtkhdf", found)
    with h5py.File(tmp_path / "fields.vtkhdf") as file:
        root = file["VTKHDF"]
        assert root.attrs["WholeExtent"].tolist() == [0, 2, 0, 3, 0, 4]
        np.testing.assert_array_equal(root["CellData/density"][3, 1, 0], found.density[0, 1, 3])
        np.testing.assert_array_equal(root["CellData/stress"][2, 1, 0], found.stress[0, 1, 2].ravel())


def test_vtk_reads_the_fields(results, tmp_path):
    pytest.importorskip("pctt.look.surfaces", reason="vtk 9.4 is not installed (extra `pictures`)")
    from vtkmodules.vtkIOHDF import vtkHDFReader

    found = measures.fields(results[0].sample, WIDE, (2, 3, 4), 0.9)
    analysis.write_fields(tmp_path / "fields.vtkhdf", found)
    reader = vtkHDFReader()
    reader.SetFileName(str(tmp_path / "fields.vtkhdf"))
    reader.Update()
    image = reader.GetOutput()
    assert image.GetDimensions() == (3, 4, 5)
    density = image.GetCellData().GetArray("density")
    assert density.GetValue(1 + 2 * (2 + 3 * 1)) == pytest.approx(found.density[1, 2, 1])
