"""Files, pictures and series of a run whose grains come and go."""

import numpy as np
import pytest
from mpi4py import MPI

from dem import measures
from dem.measures import Block
from dem.scene import Scene
from dem.shapes import Plane
from pctt import analysis
from pctt.folder import Folder
from pctt.simulation import Simulation


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """The folder, and by step the ids, positions and mass of the grains, and the bodies of the contacts."""
    path = tmp_path_factory.mktemp("rain") / "run"
    scene = Scene(0.3)
    scene.add_spheres([(0.5, 0.0, 0.02)], 0.02, 1000.0)
    scene.add_body("floor", [Plane((0, 0, 1))])
    region = Block((-0.1, -0.1, 0.03), (0.1, 0.1, 0.2))
    scene.add_source("rain", region, radius=(0.01, 0.02), density=1000.0, number_rate=500.0, velocity=(0, 0, -1))
    scene.add_outlet("hole", Block((-1, -1, -1), (0, 1, 0.021)))
    seen = {}
    with Simulation(scene, comm=MPI.COMM_SELF, dt=0.004, delta=0.004, solver="apgd", stiffness=1e5) as sim:
        sim.write(path, every=5)
        for _ in range(40):
            sim.step()
            mass = float(sim.local.mass.sum())
            seen[sim.steps] = sim.ids, sim.positions, mass, sim.contacts.bodies, sim.outlet("hole").count
    return path, seen


def test_frames_have_the_grains_that_there_were(run):
    path, seen = run
    folder = Folder(path)
    assert folder.steps == [*range(5, 41, 5)]
    folder.require_frames()
    counts = []
    for step in folder.steps:
        frame, (ids, position, mass, bodies, _) = folder.frame(step), seen[step]
        grains = frame.table.grains
        np.testing.assert_array_equal(frame.table.id[:grains], ids)
        np.testing.assert_array_equal(frame.position[:grains], position)
        assert frame.table.mass[:grains].sum() == pytest.approx(mass)
        assert sorted(map(tuple, frame.contacts.bodies)) == sorted(map(tuple, bodies))
        assert len(frame.load()) == grains + 1
        counts.append(grains)
    assert len(set(counts)) > 3
    assert seen[40][4] > 0


def test_records_count_what_passed(run):
    path, seen = run
    records = Folder(path).records()
    np.testing.assert_array_equal(records["count_hole"], [row[4] for row in seen.values()])
    there = 1 + records["count_rain"] - records["count_hole"]
    np.testing.assert_array_equal(there, [len(row[0]) for row in seen.values()])


def test_measures_of_the_files_are_those_of_the_grains(run):
    path, seen = run
    found = analysis.sample(Folder(path), 40)
    assert found.mass.sum() == pytest.approx(seen[40][2])
    grains = measures.per_grain(found)
    assert len(grains.force) == len(seen[40][0])
    assert grains.force[0, 2] == pytest.approx(found.mass[0] * 9.81, rel=1e-3)  # the first lies at rest


def test_series_for_paraview_have_the_grains_of_each_step(run):
    surfaces = pytest.importorskip("pctt.look.surfaces", reason="vtk is not installed (extra `pictures`)")
    from vtkmodules.util.numpy_support import vtk_to_numpy

    from pctt.export import series

    path, seen = run
    folder = Folder(path)
    folder.require_frames()
    scene = surfaces.Scene(folder, [folder.frame(5), folder.frame(40)])
    for step in (5, 40):
        data = series("bodies", scene, folder.frame(step))
        np.testing.assert_array_equal(vtk_to_numpy(data.GetPointData().GetArray("id")), seen[step][0])
        assert series("contacts", scene, folder.frame(step)).GetNumberOfCells() == len(seen[step][3])
        assert series("large", scene, folder.frame(step)).GetNumberOfPoints() > 0


@pytest.mark.parametrize("colour", ["speed", "material", "force"])
def test_frames_of_any_number_of_grains_are_drawn(run, colour):
    pytest.importorskip("pctt.look.stage", reason="vtk is not installed (extra `pictures`)")
    from pctt.look.program import View
    from pctt.render import _stage

    folder = Folder(run[0])
    folder.require_frames()
    frames = [folder.frame(step) for step in (5, 40)]
    draw = _stage(folder, frames, View(width=96, height=64), colour)
    assert not np.array_equal(draw(frames[0]).pixels, draw(frames[1]).pixels)
