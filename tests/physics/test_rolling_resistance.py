"""Rolling and spinning resistance: closed forms of one sphere on a plane."""

from pathlib import Path

import numpy as np
import pytest
from mpi4py import MPI

import pctt
from dem.experiment import from_file
from dem.measures import per_grain
from dem.record import energy_balance
from dem.scene import Scene
from dem.shapes import Plane
from pctt import ccp
from pctt.analysis import sample
from pctt.folder import Folder
from pctt.options import OptionError

R, DENSITY, G = 0.1, 1000.0, 9.81
MASS = 4 / 3 * np.pi * R**3 * DENSITY
INERTIA = 0.4 * MASS * R**2
EXACT = {"tol": 1e-10, "closing_work": np.inf, "stiffness": np.inf}


def on_a_plane(slope=0.0, rolling=0.0, spinning=0.0, velocity=(0, 0, 0), angular_velocity=(0, 0, 0)):
    gravity = (G * np.sin(slope), 0, -G * np.cos(slope))
    scene = Scene(0.6, gravity, rolling=rolling, spinning=spinning)
    scene.add_body("plane", [Plane((0, 0, 1))])
    scene.add_spheres([[0, 0, R]], R, DENSITY, velocity=velocity, angular_velocity=angular_velocity)
    return scene


@pytest.mark.parametrize("solver", ["apgd", pytest.param("conic", marks=pytest.mark.slow)])
def test_a_sphere_rolls_to_rest(solver):
    """v falls by 5/7 g rho / R: m v' = -F, and I v' / R = F R - rho m g."""
    rho, v, dt = 0.004, 0.35, 0.01
    slower = 5 / 7 * G * rho / R
    rows = []
    scene = on_a_plane(rolling=rho, velocity=(v, 0, 0), angular_velocity=(0, v / R, 0))
    with pctt.Simulation(scene, dt=dt, solver=solver, **EXACT) as sim:
        for steps in (10, 30):
            sim.run(steps=steps, call=lambda sim: rows.append(energy_balance(sim.last)))
            exact = v - slower * sim.time
            np.testing.assert_allclose(sim.velocities[0, [0, 4]], [exact, exact / R], rtol=1e-7)
            torque = per_grain(sim.sample).torque[0, 1]
            assert torque == pytest.approx(-INERTIA * slower / R, rel=1e-6)
            lever = rho + (sim.last.contacts.point - sim.last.contacts.moved)[0, 0]  # as seen from the plane
            assert sim.body("plane").torque[1] == pytest.approx(lever * MASS * G, rel=1e-6)
        sim.run(until=1.2 * v / slower, call=lambda sim: rows.append(energy_balance(sim.last)))
        assert np.abs(sim.velocities).max() < 1e-8
        assert sim.positions[0, 0] == pytest.approx(v**2 / 2 / slower, rel=0.02)
        assert sim.positions[0, 2] == pytest.approx(R, abs=1e-9)  # nothing opens that rolls
    assert sum(row["friction_loss [J]"] for row in rows) == pytest.approx(0.7 * MASS * v**2, rel=1e-5)


def test_a_spinning_sphere_stops():
    sigma, spin = 0.002, 5.0
    slower = sigma * MASS * G / INERTIA
    with pctt.Simulation(on_a_plane(spinning=sigma, angular_velocity=(0, 0, spin)), dt=0.01, **EXACT) as sim:
        sim.run(steps=20)
        assert sim.velocities[0, 5] == pytest.approx(spin - slower * sim.time, rel=1e-7)
        assert sim.body("plane").torque[2] == pytest.approx(sigma * MASS * G, rel=1e-6)
        sim.run(until=1.1 * spin / slower)
        assert np.abs(sim.velocities).max() < 1e-8


def test_a_sphere_on_an_incline_rolls_above_rho_over_r():
    rho = 0.02
    for part in (0.99, 1.5):
        slope = np.arctan(part * rho / R)
        with pctt.Simulation(on_a_plane(slope, rho), dt=0.01, **EXACT) as sim:
            sim.run(steps=20)
            exact = 5 / 7 * G * (np.sin(slope) - rho / R * np.cos(slope)) * sim.time
            assert sim.velocities[0, 0] == pytest.approx(max(exact, 0.0), rel=1e-7, abs=1e-9)


def test_coefficients_are_times_the_effective_radius():
    """1 / (1/r + 1/r'): r on what is flat. Two spheres that roll on each other have the moment of both."""
    with pytest.raises(ValueError, match="rolling, a length, and rolling_coefficient.*give one"):
        Scene(0.6, rolling=0.01, rolling_coefficient=0.1)
    for radius in (R, 3 * R):
        scene = Scene(0.6, rolling_coefficient=0.05, spinning_coefficient=0.02)
        scene.add_body("plane", [Plane((0, 0, 1))])
        spin = (0, 0.5 / radius, 3.0)
        scene.add_spheres([[0, 0, radius]], radius, DENSITY, velocity=(0.5, 0, 0), angular_velocity=spin)
        with pctt.Simulation(scene, dt=0.01, **EXACT) as sim:
            sim.run(steps=10)
            assert sim.velocities[0, 0] == pytest.approx(0.5 - 5 / 7 * G * 0.05 * sim.time, rel=1e-5)
            assert sim.velocities[0, 5] == pytest.approx(3.0 - 2.5 * 0.02 * G / radius * sim.time, rel=1e-5)
    scene = Scene(0.6, gravity=(0, 0, 0), rolling_coefficient=0.05)
    scene.add_spheres([[0, 0, 0], [4 * R, 0, 0]], [R, 3 * R], DENSITY)
    with pctt.Simulation(scene, dt=0.01, **EXACT) as sim:
        sim.step()
        found = sim.last.system.resistance
        assert found.most[0] * found.length == pytest.approx(0.05 * 0.75 * R, rel=1e-12)


def test_the_relaxation_opens_what_rolls():
    rho, v, dt = 0.004, 0.5, 0.01
    scene = on_a_plane(rolling=rho, velocity=(v, 0, 0), angular_velocity=(0, v / R, 0))
    with pctt.Simulation(scene, dt=dt, law=ccp.RELAXATION, **EXACT) as sim:
        sim.run(steps=1)
        assert sim.positions[0, 2] - R == pytest.approx(dt * rho * sim.velocities[0, 4], rel=1e-6)


def test_other_solvers_refuse():
    for solver in set(ccp.SOLVERS) - {"auto", "apgd", "conic"}:
        with pytest.raises(OptionError, match=f"^solver {solver}: .* rolling .* allowed are conic, auto, apgd"):
            pctt.Simulation(on_a_plane(rolling=0.01), solver=solver)
    with pytest.raises(OptionError, match="^newton contact: .* resistance; allowed is body"):
        pctt.Simulation(on_a_plane(rolling=0.01), newton="contact", law=ccp.RELAXATION)
    with pytest.raises(ValueError, match="rolling must not be negative"):
        Scene(0.5, rolling=-1.0)


def heap():
    """27 spheres and a box that fall on a plane; the sort of wheels resists rolling among itself alone."""
    scene = Scene(0.4)
    scene.add_body("floor", [Plane((0, 0, 1))], material="steel")
    scene.set_pair("wheels", "wheels", rolling=0.01, spinning=0.003)
    scene.set_pair("wheels", "steel", rolling=0.005, cohesion=20.0, cohesion_range=0.01)
    place = np.stack(np.meshgrid(*[np.arange(3.0)] * 3), axis=-1).reshape(-1, 3)
    near = 2.05 * R * place + np.random.default_rng(3).uniform(0, 1e-3, (27, 3)) + R
    scene.add_spheres(near, R, DENSITY, material="wheels", angular_velocity=(0.0, 2.0, 1.0))
    scene.add_boxes([[0.2, 0.2, 0.8]], (0.1, 0.08, 0.07), DENSITY)
    return scene


@pytest.mark.parallel(2)
def test_ranks_and_restarts_agree(tmp_path):
    given = {"dt": 5e-3, "tol": 1e-8, "closing_work": np.inf}
    with pctt.Simulation(heap(), comm=MPI.COMM_WORLD, **given) as sim:
        sim.run(steps=5)
        sim.save(tmp_path / "middle.h5")
        sim.run(steps=5)
        place, force = sim.positions, sim.contacts.force
        assert np.abs(sim.contacts.moment).max() > 1e-3
    with pctt.Simulation.load(tmp_path / "middle.h5", heap(), comm=MPI.COMM_WORLD, **given) as again:
        again.run(steps=5)
        np.testing.assert_array_equal(again.positions, place)
        np.testing.assert_array_equal(again.contacts.force, force)
    with pctt.Simulation(heap(), comm=MPI.COMM_SELF, **given) as alone:
        alone.run(steps=10)
        np.testing.assert_allclose(alone.positions, place, atol=1e-7)


def test_the_files_of_a_run_have_the_moments(tmp_path):
    rho = 0.004
    scene = on_a_plane(rolling=rho, velocity=(0.5, 0, 0), angular_velocity=(0, 5.0, 0))
    with pctt.Simulation(scene, dt=0.01, **EXACT) as sim:
        sim.write(tmp_path / "run")
        sim.run(steps=2)
        there = per_grain(sim.sample).torque
        np.testing.assert_allclose(sim.contacts.moment, [[0, rho * MASS * G, 0]], atol=1e-6)
    folder = Folder(tmp_path / "run")
    np.testing.assert_allclose(per_grain(sample(folder, 2)).torque, there, rtol=1e-6, atol=1e-9)


@pytest.mark.slow
def test_heaps_are_steeper_with_rolling_resistance():
    """What rests on the shelf of the study `validate`, with rho of 0, 0.1 and 0.2 radii; docs/contact_laws.md."""
    Heap, left = from_file(Path(__file__).parents[2] / "run/studies/validation/heap.py"), []  # noqa: N806 - a class
    for rho in (0.0, 0.1, 0.2):
        with pctt.Simulation(Heap(rolling=rho), solver="apgd") as sim:
            sim.run(until=2.0)
            place = sim.positions
        left.append(((place[:, 2] > 0.0) & (place[:, 0] < 0.0)).sum())
    assert left[1] > 1.1 * left[0]
    assert left[2] > 1.03 * left[1]
