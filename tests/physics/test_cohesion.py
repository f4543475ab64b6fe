"""Cohesion: closed forms of bodies that attract each other."""

import numpy as np
import pytest
from mpi4py import MPI

import pctt
from dem.record import energy_balance
from dem.scene import Scene
from dem.shapes import Plane
from pctt import ccp
from pctt.options import OptionError

R, DENSITY, G = 0.1, 1000.0, 9.81
MASS = 4 / 3 * np.pi * R**3 * DENSITY
EXACT = {"tol": 1e-9, "closing_work": np.inf}
SOLVERS = [name for name in ccp.SOLVERS if name not in ("pdip", "kucera", "gpminres", "jacobi")]


def hanging(count, cohesion, gap=0.0, reach=0.01, **more):
    """A column of spheres below a ceiling, this gap apart from it."""
    scene = Scene(0.5, cohesion=cohesion, cohesion_range=reach, **more)
    scene.add_body("ceiling", [Plane((0, 0, -1))], material="steel")
    scene.add_spheres([[0, 0, -gap - (2 * k + 1) * R] for k in range(count)], R, DENSITY)
    return scene


@pytest.mark.parametrize("dt", [0.02, 0.002])
@pytest.mark.parametrize("stiffness", [np.inf, 1e6])
def test_a_sphere_hangs_if_cohesion_bears_its_weight(stiffness, dt):
    for part, holds in ((1.001, True), (0.999, False)):
        scene = hanging(1, part * MASS * G, stiffness=stiffness)
        with pctt.Simulation(scene, dt=dt, **EXACT) as sim:
            sim.run(steps=20)
            assert (abs(sim.velocities[0, 2]) < 1e-6) == holds
            assert (sim.body("ceiling").force[2] == pytest.approx(-MASS * G, rel=1e-6)) == holds


def test_a_column_breaks_where_its_weight_exceeds_the_cohesion():
    for part, falls in ((3.01, 0), (2.99, 3)):  # in the uppermost contact
        with pctt.Simulation(hanging(3, part * MASS * G), dt=0.01, stiffness=np.inf, **EXACT) as sim:
            sim.run(steps=10)
            assert (sim.velocities[:, 2] < -1e-3).sum() == falls
            if not falls:
                weights = np.sort(np.abs(sim.contacts.force[:, 2])) / (MASS * G)
                np.testing.assert_allclose(weights, [1, 2, 3], rtol=1e-6)


def test_attraction_ends_with_its_range():
    for gap, pull in ((0.0101, 0.0), (0.0099, 3.0)):
        with pctt.Simulation(hanging(1, 3.0 * MASS * G, gap), dt=1e-3, **EXACT) as sim:
            sim.run(steps=5)
            np.testing.assert_allclose(sim.velocities[0, 2], (pull - 1.0) * G * 5e-3, rtol=1e-9)
    with pytest.raises(OptionError, match="bodies attract each other up to 0.01 m"):
        pctt.Simulation(hanging(1, 1.0), delta=0.005)
    with pytest.raises(ValueError, match="needs a cohesion_range"):
        hanging(1, 1.0, reach=0.0)


@pytest.mark.parametrize("dt", [0.02, 0.005])
def test_springs_bear_the_attraction_whatever_dt_is(dt):
    c, k = 5.0 * MASS * G, 1e5
    scene = Scene(0.5, cohesion=c, cohesion_range=0.01, stiffness=k)
    scene.add_body("floor", [Plane((0, 0, 1))])
    scene.add_spheres([[0, 0, R]], R, DENSITY)
    with pctt.Simulation(scene, dt=dt, **EXACT) as sim:
        sim.run(until=0.4)
        assert R - sim.positions[0, 2] == pytest.approx((MASS * G + c) / k, rel=1e-3)
        assert sim.body("floor").force[2] == pytest.approx(-MASS * G, rel=1e-5)


def test_energy_of_a_pair_that_meets_is_the_work_of_cohesion():
    c, gap = 2.0, 0.008
    scene = Scene(0.5, (0, 0, 0), cohesion=c, cohesion_range=0.01, stiffness=np.inf)
    scene.add_spheres([[0, 0, 0], [2 * R + gap, 0, 0]], R, DENSITY)
    rows = []
    with pctt.Simulation(scene, dt=1e-3, **EXACT) as sim:
        sim.run(steps=150, call=lambda sim: rows.append(energy_balance(sim.last)))
        assert np.abs(sim.velocities).max() < 1e-9
        np.testing.assert_allclose(sim.positions[1, 0] - sim.positions[0, 0], 2 * R, atol=1e-7)
    work, lost = (sum(row[name] for row in rows) for name in ("work_of_cohesion [J]", "impact_loss [J]"))
    assert work == pytest.approx(c * gap, rel=1e-6)
    assert lost == pytest.approx(c * gap, rel=0.05)


def test_friction_bears_with_the_shifted_force():
    mu = 0.2
    for part in (0.5, 2.0):  # a sphere falls along a wall that attracts it, and rolls where friction allows it
        c = part * 2 / 7 * MASS * G / mu
        scene = Scene(mu, cohesion=c, cohesion_range=0.01)
        scene.add_body("wall", [Plane((1, 0, 0))])
        scene.add_spheres([[R, 0, 0]], R, DENSITY)
        with pctt.Simulation(scene, dt=1e-4, stiffness=np.inf, **EXACT) as sim:
            sim.run(steps=10)
            exact = 5 / 7 * G if part > 1 else G - mu * c / MASS
            assert sim.velocities[0, 2] == pytest.approx(-exact * 1e-3, rel=1e-6)


@pytest.mark.parametrize("solver", SOLVERS)
def test_all_solvers_find_the_same(solver):
    with pctt.Simulation(hanging(3, 4.0 * MASS * G), dt=0.01, solver=solver, tol=1e-6, stiffness=np.inf) as sim:
        sim.run(steps=5)
        np.testing.assert_allclose(sim.velocities, 0.0, atol=1e-4)
        assert sim.body("ceiling").force[2] == pytest.approx(-3 * MASS * G, rel=1e-4)


@pytest.mark.parallel(2)
def test_ranks_and_restarts_agree(tmp_path):
    def heap():
        scene = Scene(0.4, cohesion=3.0 * MASS * G, cohesion_range=0.01)
        scene.add_body("floor", [Plane((0, 0, 1))], material="steel")
        scene.set_pair("steel", "default", cohesion=0.0)
        place = np.stack(np.meshgrid(*[np.arange(3.0)] * 3), axis=-1).reshape(-1, 3)
        scene.add_spheres(2.05 * R * place + np.random.default_rng(3).uniform(0, 1e-3, (27, 3)) + R, R, DENSITY)
        return scene

    given = {"dt": 5e-3, "tol": 1e-8, "closing_work": np.inf, "solver": "apgd"}
    with pctt.Simulation(heap(), comm=MPI.COMM_WORLD, **given) as sim:
        sim.run(steps=3)
        sim.save(tmp_path / "middle.h5")
        sim.run(steps=3)
        place, force = sim.positions, sim.contacts.force
    with pctt.Simulation.load(tmp_path / "middle.h5", heap(), comm=MPI.COMM_WORLD, **given) as again:
        again.run(steps=3)
        np.testing.assert_array_equal(again.positions, place)
        np.testing.assert_array_equal(again.contacts.force, force)
    with pctt.Simulation(heap(), comm=MPI.COMM_SELF, **given) as alone:
        alone.run(steps=6)
        np.testing.assert_allclose(alone.positions, place, atol=1e-7)
