"""Clumps of spheres fall, rest, hold on an incline and make piles, on any number of ranks."""

from __future__ import annotations

import numpy as np
import pytest
from drive import G, by_id, make_steps, on_incline
from mpi4py import MPI

import pctt
from dem import quaternion
from dem.bodies import CLUMP
from dem.scene import Scene
from dem.shapes import Clump, Plane
from dem.start import new_world

DT, R = 0.005, 0.05
TRIPOD = Clump([(0.08, 0, 0), (-0.04, 0.04 * 3**0.5, 0), (-0.04, -0.04 * 3**0.5, 0)], [R, R, R])
DUMBBELL = Clump([(-0.04, 0, 0), (0.04, 0, 0)], [R, 0.8 * R])
EXACT = {"solver": "apgd", "tol": 1e-10, "closing_work": np.inf, "stiffness": np.inf}


def test_a_clump_of_one_sphere_is_a_sphere():
    """It falls on the floor beside another one, slides and rolls."""
    ends = []
    for clump in (False, True):
        scene = Scene(0.3)
        scene.add_body("floor", [Plane((0, 0, 1))])
        places, motion = [(0, 0, R + 0.01), (2.1 * R, 0, R)], {"velocity": (1.0, 0.2, 0)}
        if clump:
            scene.add_clumps(places, Clump([(0, 0, 0)], [R]), 1000.0, **motion)
        else:
            scene.add_spheres(places, R, 1000.0, **motion)
        with pctt.Simulation(scene, dt=DT, **{**EXACT, "tol": 1e-13}) as sim:
            sim.run(steps=30)
            ends.append((sim.positions, sim.velocities))
    np.testing.assert_allclose(ends[1][0], ends[0][0], atol=1e-12)
    np.testing.assert_allclose(ends[1][1], ends[0][1], atol=1e-11)


def test_a_tripod_rests_flat_on_the_floor():
    """Three gaps of zero, and a third of the weight on each sphere."""
    scene = Scene(0.3)
    scene.add_body("floor", [Plane((0, 0, 1))])
    scene.add_clumps((0, 0, R + 1e-3), TRIPOD, 1000.0)
    with pctt.Simulation(scene, dt=DT, **EXACT) as sim:
        sim.run(steps=40)
        weight = sim.world.grains.mass[0] * G
        assert len(sim.contacts) == 3
        assert len(np.unique(sim.last.contacts.key)) == 3
        np.testing.assert_allclose(sim.contacts.gap, 0.0, atol=1e-9)
        np.testing.assert_allclose(sim.contacts.force[:, 2], -np.full(3, weight / 3), rtol=1e-6)
        np.testing.assert_allclose(sim.velocities, 0.0, atol=1e-8)
        np.testing.assert_allclose(sim.positions[0], [0, 0, R], atol=1e-8)
        assert sim.figures["iterations"] <= 6  # the impulses of the last step are found by their keys


@pytest.mark.parametrize("share", [0.9, 1.2])
def test_a_tripod_on_an_incline_holds_below_the_friction_angle(share):
    friction, count = 0.3, 40
    slope = np.arctan(share * friction)
    scene = on_incline(slope, friction)
    scene.add_clumps((0, 0, R), TRIPOD, 1000.0)
    world = new_world(scene, MPI.COMM_SELF)
    make_steps(world, count, DT)
    end = by_id(world)
    if share < 1.0:
        np.testing.assert_allclose(end["position"][0], [0, 0, R], atol=1e-6)
    else:
        speed = G * (np.sin(slope) - friction * np.cos(slope)) * DT * (count - friction**2)
        np.testing.assert_allclose(np.abs(end["velocity"][0, 0]), speed, rtol=1e-3)


def pile(count, clearance=1.02):
    """Clumps of two shapes, turned at random, on a lattice above a floor between walls."""
    side = int(np.ceil(count ** (1 / 3)))
    rng, wide = np.random.default_rng(5), 0.27 * clearance
    place = np.stack(np.meshgrid(*[np.arange(side)] * 3), axis=-1).reshape(-1, 3)
    place = wide * (place[np.argsort(place[:, 2], kind="stable")][:count] + 0.5)
    turns = rng.normal(size=(count, 4))
    scene = Scene(0.4)
    walls = [Plane((0, 0, 1)), Plane((1, 0, 0)), Plane((0, 1, 0))]
    walls += [Plane((-1, 0, 0), (wide * side, 0, 0)), Plane((0, -1, 0), (0, wide * side, 0))]
    scene.add_body("box", walls)
    half = count // 2
    scene.add_clumps(place[:half], TRIPOD, 2000.0, quaternions=turns[:half])
    scene.add_clumps(place[half:], DUMBBELL, 2000.0, quaternions=turns[half:])
    return scene


@pytest.mark.slow
def test_a_pile_of_200_comes_to_rest():
    """Stopped at 3 m/s overlaps are what the stiffness allows; at rest they are those of the weight."""
    with pctt.Simulation(pile(200), dt=2e-3) as sim:
        sim.run(until=3.0)  # some roll off late
        radius = sim.world.grains.size[:, 0].min()
        assert np.abs(sim.velocities[:, :3]).max() < 0.02
        assert sim.contacts.gap.min() > -0.006 * radius
        force = sim.body("box").force
        weight = sim.world.grains.mass.sum() * G
        assert force[2] == pytest.approx(-weight, rel=0.05)


@pytest.mark.parallel(2)
def test_ranks_and_restarts_agree(tmp_path):
    given = {"dt": DT, "tol": 1e-8, "closing_work": np.inf, "solver": "apgd"}
    with pctt.Simulation(pile(27), comm=MPI.COMM_WORLD, **given) as sim:
        sim.run(steps=12)
        sim.save(tmp_path / "middle.h5")
        sim.run(steps=12)
        place, turn, force, key = sim.positions, sim.orientations, sim.contacts.force, sim.last.contacts.key
        assert len(force) > 10
    with pctt.Simulation.load(tmp_path / "middle.h5", pile(27), comm=MPI.COMM_WORLD, **given) as again:
        again.run(steps=12)
        np.testing.assert_array_equal(again.positions, place)
        np.testing.assert_array_equal(again.orientations, turn)
        np.testing.assert_array_equal(again.contacts.force, force)
        np.testing.assert_array_equal(again.last.contacts.key, key)
    with pctt.Simulation(pile(27), comm=MPI.COMM_SELF, **given) as alone:
        alone.run(steps=24)
        np.testing.assert_allclose(alone.positions, place, atol=1e-5)


def test_a_checkpoint_of_other_clumps_is_refused(tmp_path):
    def scene(shape):
        made = Scene(0.3)
        made.add_clumps((0, 0, 0), shape, 1000.0)
        return made

    with pctt.Simulation(scene(TRIPOD), dt=DT) as sim:
        sim.step()
        sim.save(tmp_path / "state.h5")
    with pytest.raises(Exception, match="form of a grain"):
        pctt.Simulation.load(tmp_path / "state.h5", scene(DUMBBELL), dt=DT)


def test_turning_clumps_do_not_run_into_each_other():
    """Long ones turn about their middles beside a floor: an end strikes it within a step, and does not go in."""
    scene = Scene(0.0, gravity=(0, 0, 0))
    scene.add_body("floor", [Plane((0, 0, 1))])
    rod = Clump([(x, 0, 0) for x in np.linspace(-0.5, 0.5, 11)], np.full(11, R))
    scene.add_clumps((0, 0, 0.35), rod, 1000.0, angular_velocity=(0, 20.0, 0))
    with pctt.Simulation(scene, dt=0.01, delta=0.1 * R, solver="apgd", tol=1e-6, stiffness=np.inf) as sim:
        for _ in range(30):
            assert sim.step()["converged"]
            assert sim.contacts.gap.min(initial=0.0) > -0.02 * R


def test_clumps_that_land_bear_nothing_before():
    """They roll from sphere to sphere: a step does none of the work for bodies that go from edge to edge."""
    scene = Scene(0.5)
    scene.add_body("floor", [Plane((0, 0, 1))])
    tilted = quaternion.exponential(np.array([[0.0, 0.2, 0.0]]))
    scene.add_clumps((0, 0, 1.3 * R), DUMBBELL, 1000.0, quaternions=tilted)
    struck = 0
    with pctt.Simulation(scene, dt=DT) as sim:
        for _ in range(40):
            sim.step()
            struck = max(struck, np.count_nonzero(sim.contacts.force[:, 2]))
            assert sim.last.system.landing is None
    assert struck == 2


def test_clumps_in_a_periodic_cell():
    """One of two spheres across the boundary touches a grain on the other side."""
    scene = Scene(0.3, gravity=(0, 0, 0), period=(1.0, None, None))
    scene.add_clumps((0.98, 0, 0), DUMBBELL, 1000.0)
    scene.add_spheres((0.02 + 0.04 + 0.8 * R - 0.04 + R + 0.001, 0, 0), R, 1000.0)
    with pctt.Simulation(scene, dt=DT, delta=0.01) as sim:
        sim.step()
        np.testing.assert_allclose(sim.contacts.gap, [0.001], atol=1e-12)


def test_files_have_the_spheres(tmp_path):
    pytest.importorskip("pctt.look.surfaces", reason="vtk 9.4 is not installed (extra `pictures`)")
    from pctt.export import series
    from pctt.folder import Folder
    from pctt.look import surfaces

    scene = pile(8)
    scene.add_spheres((0.1, 0.1, 3.0), R, 1000.0)
    with pctt.Simulation(scene, dt=DT) as sim:
        sim.write(tmp_path / "run", every=1)
        sim.run(steps=2)
        sim.complete()
        place, turn, forms = sim.positions, sim.orientations, sim.world.forms
    folder = Folder(tmp_path / "run")
    frame = folder.frame(2)
    data = series("bodies", surfaces.Scene(folder, [frame]), frame)
    expected = [place[8:9]] + [
        place[n] + quaternion.rotate(turn[n], forms[frame.table.shape[n] - CLUMP].center) for n in range(8)
    ]
    found = surfaces.points(data)
    assert len(found) == 1 + 4 * 3 + 4 * 2
    expected = np.concatenate(expected)
    order = (np.lexsort(points.T.round(9)) for points in (found, expected))
    np.testing.assert_allclose(found[next(order)], expected[next(order)], atol=1e-9)
