"""Convex polyhedra rest, keep their energy and make heaps, on any number of ranks, and files have them."""

from __future__ import annotations

import numpy as np
import pytest
from mpi4py import MPI

import pctt
from dem import quaternion
from dem.contact.narrow import CORNERS
from dem.scene import Scene
from dem.shapes import Clump, Plane

G, DT, R = 9.81, 2e-3, 0.1
TETRAHEDRON = R * np.array([(1, 1, 1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1)]) / 3**0.5
OCTAHEDRON = R * np.concatenate([np.eye(3), -np.eye(3)])
BRICK = R * CORNERS * [0.7, 0.5, 0.4]


def heap(count, others=True, speed=0.0):
    """Polyhedra of three shapes, some of half the size, and a few clumps and balls, turned at random, between walls;
    they come together at `speed` for each radius of distance from their middle [m/s]."""
    side = int(np.ceil(count ** (1 / 3)))
    rng, wide = np.random.default_rng(5), 2.04 * R
    place = np.stack(np.meshgrid(*[np.arange(side)] * 3), axis=-1).reshape(-1, 3)
    place = wide * (place[np.argsort(place[:, 2], kind="stable")][:count] + 0.5)
    turns = rng.normal(size=(count, 4))
    scene = Scene(0.4)
    walls = [Plane((0, 0, 1)), Plane((1, 0, 0)), Plane((0, 1, 0))]
    walls += [Plane((-1, 0, 0), (wide * side, 0, 0)), Plane((0, -1, 0), (0, wide * side, 0))]
    scene.add_body("box", walls)
    velocity = speed * (place.mean(axis=0) - place) / R
    for k, vertices in enumerate((TETRAHEDRON, OCTAHEDRON, BRICK)):
        at = slice(k, None, 4 if others else 3)
        scale = rng.choice([0.5, 1.0], len(place[at]))
        scene.add_polyhedra(place[at], vertices, 2000.0, scale=scale, quaternions=turns[at], velocity=velocity[at])
    if others:
        pair, at = Clump([(-0.04, 0, 0), (0.04, 0, 0)], [0.05, 0.04]), slice(3, None, 8)
        scene.add_clumps(place[at], pair, 2000.0, quaternions=turns[at], velocity=velocity[at])
        scene.add_spheres(place[7::8], 0.8 * R, 2000.0, velocity=velocity[7::8])
    return scene


def test_a_brick_of_vertices_slides_as_a_box_does():
    """A stack of two on an incline: the same way, to the tolerance of the solver."""
    slope, ends = 0.4, []
    for polyhedra in (False, True):
        scene = Scene(0.3, gravity=(G * np.sin(slope), 0, -G * np.cos(slope)))
        scene.add_body("floor", [Plane((0, 0, 1))])
        half = np.array([0.7, 0.5, 0.4]) * R
        places, motion = [(0, 0, half[2]), (0.01, 0.02, 3 * half[2])], {"velocity": (0.3, 0.1, 0)}
        if polyhedra:
            scene.add_polyhedra(places, BRICK, 1000.0, **motion)
        else:
            scene.add_boxes(places, half, 1000.0, **motion)
        with pctt.Simulation(scene, dt=DT, tol=1e-8, closing_work=np.inf, stiffness=1e5) as sim:
            sim.run(steps=20)
            ends.append((sim.positions, quaternion.matrix(sim.orientations)))
    for one, other in zip(*ends):
        np.testing.assert_allclose(one, other, atol=1e-6)


def test_a_tetrahedron_falls_onto_its_face_and_rests():
    """Its centre comes to a quarter of its height, R/3, less what the stiffness gives: m g / k for three corners."""
    scene = Scene(0.5, stiffness=1e6)
    scene.add_body("floor", [Plane((0, 0, 1))])
    turn = quaternion.exponential(np.array([0.3, 0.2, 0.1]))
    scene.add_polyhedra((0, 0, 1.05 * R), TETRAHEDRON, 1000.0, quaternions=turn)
    with pctt.Simulation(scene, dt=2 * DT, tol=1e-8) as sim:
        sim.run(until=0.5)
        weight = sim.world.grains.mass[0] * G
        np.testing.assert_allclose(sim.positions[0, 2], R / 3 - weight / 3e6, atol=1e-8)
        assert np.abs(sim.velocities).max() < 1e-6
        np.testing.assert_allclose(sim.body("floor").force[2], -weight, rtol=1e-6)
        assert len(sim.contacts.gap) == 3


@pytest.mark.parametrize("count", [8, pytest.param(27, marks=pytest.mark.slow)])
def test_a_heap_loses_energy_and_comes_to_rest(count):
    with pctt.Simulation(heap(count, others=False), dt=2 * DT, stiffness=1e6) as sim:
        most, lost = 0.0, []
        for _ in range(250):
            row = sim.step()
            lost.append(row["kinetic_energy [J]"] + row["potential_energy [J]"] + row["spring_energy [J]"])
            most = max(most, row["worst_overlap [m]"])
        rise = np.diff(lost).max() / (lost[0] - lost[-1])
        assert rise < 1e-3
        assert most < 0.05 * R
        assert np.abs(sim.velocities[:, :3]).max() < 0.02
        weight = sim.world.grains.mass.sum() * G
        assert sim.body("box").force[2] == pytest.approx(-weight, rel=0.02)


@pytest.mark.parallel(2)
def test_ranks_and_restarts_agree(tmp_path):
    given = {"dt": DT, "tol": 1e-8, "closing_work": np.inf, "solver": "apgd", "stiffness": 1e6}
    with pctt.Simulation(heap(27, speed=1.0), comm=MPI.COMM_WORLD, **given) as sim:
        sim.run(steps=9)
        sim.save(tmp_path / "middle.h5")
        sim.run(steps=9)
        place, turn, force, key = sim.positions, sim.orientations, sim.contacts.force, sim.last.contacts.key
        assert len(force) > 10
    with pctt.Simulation.load(tmp_path / "middle.h5", heap(27, speed=1.0), comm=MPI.COMM_WORLD, **given) as again:
        again.run(steps=9)
        np.testing.assert_array_equal(again.positions, place)
        np.testing.assert_array_equal(again.orientations, turn)
        np.testing.assert_array_equal(again.contacts.force, force)
        np.testing.assert_array_equal(again.last.contacts.key, key)
    with pctt.Simulation(heap(27, speed=1.0), comm=MPI.COMM_SELF, **given) as alone:
        alone.run(steps=18)
        np.testing.assert_allclose(alone.positions, place, atol=1e-5)


def test_a_checkpoint_of_other_polyhedra_is_refused(tmp_path):
    def scene(vertices):
        made = Scene(0.3)
        made.add_polyhedra((0, 0, 0), vertices, 1000.0)
        return made

    with pctt.Simulation(scene(TETRAHEDRON), dt=DT) as sim:
        sim.step()
        sim.save(tmp_path / "state.h5")
    with pytest.raises(Exception, match="form of a grain"):
        pctt.Simulation.load(tmp_path / "state.h5", scene(OCTAHEDRON), dt=DT)


def test_polyhedra_in_a_periodic_cell():
    """Across the boundary an octahedron touches another one tip to tip; tips that meet are a little round."""
    scene = Scene(0.3, gravity=(0, 0, 0), period=(1.0, None, None))
    scene.add_polyhedra([(0.95, 0, 0), (0.151, 0, 0)], OCTAHEDRON, 1000.0)
    with pctt.Simulation(scene, dt=DT, delta=0.01) as sim:
        sim.step()
        assert len(sim.contacts) == 1
        assert 0.001 <= sim.contacts.gap[0] < 0.002
        np.testing.assert_allclose(np.abs(sim.contacts.normal), [[1, 0, 0]], atol=1e-9)


def test_files_and_pictures_have_the_surfaces(tmp_path):
    surfaces = pytest.importorskip("pctt.look.surfaces", reason="vtk 9.4 or newer is not installed (extra `pictures`)")
    from pctt.export import series
    from pctt.folder import Folder

    with pctt.Simulation(heap(8), dt=DT) as sim:
        sim.write(tmp_path / "run", every=1)
        sim.run(steps=2)
        sim.complete()
        world, place, turn = sim.world, sim.positions, sim.orientations
        pixels = sim.render().pixels
        assert pixels.std() > 0
    folder = Folder(tmp_path / "run")
    frame = folder.frame(2)
    scene = surfaces.Scene(folder, [frame])
    found = surfaces.triangles(series("polyhedra", scene, frame))
    forms = [world.forms[k] for k in (0, 0, 1, 1, 2, 2)]
    scale = [frame.table.size[n, 0] / form.size[0] for n, form in enumerate(forms)]
    expected = np.concatenate(
        [place[n] + quaternion.rotate(turn[n], scale[n] * form.faces.vertex) for n, form in enumerate(forms)]
    )
    corners = np.unique(found.reshape(-1, 3).round(9), axis=0)
    np.testing.assert_allclose(corners, np.unique(expected.round(9), axis=0), atol=1e-9)
    volume = np.einsum("ti,ti->", found[:, 0], np.cross(found[:, 1], found[:, 2])) / 6
    np.testing.assert_allclose(volume, sum(s**3 * form.volume for s, form in zip(scale, forms)), rtol=1e-9)
    assert series("bodies", scene, frame).GetNumberOfPoints() == 6 + 2 + 1
