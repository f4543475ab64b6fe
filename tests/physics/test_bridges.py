"""Capillary bridges: closed forms of their force, their rupture and their energy."""

import numpy as np
import pytest
from mpi4py import MPI

import pctt
from dem.motion import Glide
from dem.record import energy_balance
from dem.scene import Scene
from dem.shapes import Plane
from pctt.options import OptionError

R, VOLUME, GAMMA, ANGLE = 1e-3, 2e-12, 0.06, 0.3
DENSITY, G = 2000.0, 9.81
MASS = 4 / 3 * np.pi * R**3 * DENSITY
WET = {"bridge_volume": VOLUME, "surface_tension": GAMMA, "contact_angle": ANGLE}
RUPTURE = (1 + ANGLE / 2) * VOLUME ** (1 / 3)
EXACT = {"tol": 1e-9, "closing_work": np.inf}



def force(gap, radius):
    x = gap * np.sqrt(radius / VOLUME)
    return 2 * np.pi * radius * GAMMA * np.cos(ANGLE) / (1 + 1.05 * x + 2.5 * x**2)


def energy(radius):
    """The integral of the force up to the rupture."""
    root, end = np.sqrt(10.0 - 1.05**2), RUPTURE * np.sqrt(radius / VOLUME)
    angle = np.arctan((5.0 * end + 1.05) / root) - np.arctan(1.05 / root)
    return 2 * np.pi * radius * GAMMA * np.cos(ANGLE) * np.sqrt(VOLUME / radius) * 2.0 / root * angle


def apart(speed, gap=0.0, plane=False, **law):
    """Two heavy balls, or a plane and one, that part with this speed, each with half of it."""
    scene = Scene(0.5, (0, 0, 0), **{**WET, "stiffness": np.inf, **law})
    if plane:
        scene.add_body("plane", [Plane((0, 0, 1))], Glide((0, 0, -speed)))
        scene.add_spheres([0, 0, gap + R], R, 1e9)
    else:
        way = np.array([[0.0, 0.0, -0.5], [0.0, 0.0, 0.5]])
        scene.add_spheres((gap + 2 * R) * way, R, 1e9, velocity=speed * way)
    return scene


def followed(scene, until, dt):
    """Of each step the gap at its start, the speed after it and the pull; and the work of all."""
    rows, work = [], 0.0
    with pctt.Simulation(scene, dt=dt, **EXACT) as sim:
        while sim.time < until:
            sim.step()
            gap, pull = sim.last.contacts.gap, sim.last.system.attraction / sim.last.system.dt
            rows.append((gap[0], sim.velocities[-1, 2], pull[0]) if len(gap) else (np.inf, sim.velocities[-1, 2], 0.0))
            work += energy_balance(sim.last)["work_of_cohesion [J]"]
    return *np.array(rows).T, work


@pytest.mark.parametrize("plane", [False, True])
def test_bodies_that_part_are_pulled_until_the_bridge_ruptures(plane):
    speed, radius, dt = 0.01, 2 * R if plane else R, 2e-4
    gap, _, pull, work = followed(apart(speed, plane=plane), 1.1 * RUPTURE / speed, dt)
    there = gap < RUPTURE
    assert there.sum() == pytest.approx(RUPTURE / speed / dt, abs=1)
    np.testing.assert_allclose(pull[there], force(gap[there], radius), rtol=1e-9)
    assert not pull[~there].any()
    more = 0.5 * speed * dt * (force(0.0, radius) - force(RUPTURE, radius))  # pulls are those of the start of a step
    assert work == pytest.approx(-energy(radius) - more, rel=0.005)


def test_a_cycle_of_touch_and_separation_costs_the_energy_of_the_bridge():
    speed = 0.01
    scene = apart(-speed, 0.2 * RUPTURE, restitution=1.0)
    gap, velocity, pull, work = followed(scene, 1.3 * RUPTURE / speed, 5e-5)
    assert velocity[0] < 0.0 < velocity[-1]
    assert not pull[velocity < 0.0].any()
    assert (pull[(velocity > 0.0) & (gap < RUPTURE)][1:] > 0.0).all()
    assert not pull[gap > RUPTURE].any()
    assert work == pytest.approx(-energy(R), rel=0.03)


def hanging(count, part, **law):
    """A column of balls below a ceiling, whose bridges bear this part of the weight of one."""
    gamma = part * MASS * G / (4 * np.pi * R)
    scene = Scene(0.5, bridge_volume=VOLUME, surface_tension=gamma, **law)
    scene.add_body("ceiling", [Plane((0, 0, -1))])
    scene.add_spheres([[0, 0, -(2 * k + 1) * R] for k in range(count)], R, DENSITY)
    return scene


@pytest.mark.parametrize("stiffness", [np.inf, None])
def test_a_ball_hangs_if_its_bridge_bears_its_weight(stiffness):
    for part, holds in ((1.01, True), (0.99, False)):
        with pctt.Simulation(hanging(1, part, stiffness=stiffness), dt=1e-3, **EXACT) as sim:
            sim.run(until=0.05)
            assert (abs(sim.velocities[0, 2]) < 1e-6) == holds


def test_a_column_breaks_where_its_weight_exceeds_the_bridge():
    for part, falls in ((4.1, 0), (3.9, 2)):  # between the first and the second ball, with half the force of a plane
        with pctt.Simulation(hanging(3, part, stiffness=np.inf), dt=1e-3, **EXACT) as sim:
            sim.run(until=0.05)
            assert (sim.velocities[:, 2] < -1e-4).sum() == falls


def test_what_does_not_go_together_is_refused():
    with pytest.raises(ValueError, match="bridge_volume: needs a surface_tension"):
        Scene(0.5, bridge_volume=VOLUME)
    with pytest.raises(OptionError, match="bodies attract each other up to 0.000144"):
        pctt.Simulation(apart(0.0), delta=1e-4)


@pytest.mark.parallel(2)
def test_ranks_and_restarts_agree(tmp_path):
    def heap():
        scene = Scene(0.4, restitution=0.6, **WET)
        scene.add_body("floor", [Plane((0, 0, 1))])
        place = np.stack(np.meshgrid(*[np.arange(3.0)] * 3), axis=-1).reshape(-1, 3)
        places = 2.1 * R * place + np.random.default_rng(5).uniform(0, 1e-4, (27, 3)) + R
        scene.add_spheres(places, R, DENSITY, velocity=np.random.default_rng(6).uniform(-0.02, 0.02, (27, 3)))
        return scene

    given = {"dt": 5e-4, "tol": 1e-8, "closing_work": np.inf, "solver": "apgd"}
    with pctt.Simulation(heap(), comm=MPI.COMM_WORLD, **given) as sim:
        sim.run(steps=10)
        sim.save(tmp_path / "middle.h5")
        system = sim.last.system
        stretched = MPI.COMM_WORLD.allreduce(int(((system.attraction > 0.0) & (sim.last.contacts.gap > 1e-6)).sum()))
        sim.run(steps=10)
        place = sim.positions
    assert stretched > 3
    with pctt.Simulation.load(tmp_path / "middle.h5", heap(), comm=MPI.COMM_WORLD, **given) as again:
        again.run(steps=10)
        np.testing.assert_array_equal(again.positions, place)
    with pctt.Simulation(heap(), comm=MPI.COMM_SELF, **given) as alone:
        alone.run(steps=20)
        np.testing.assert_allclose(alone.positions, place, atol=1e-7)
