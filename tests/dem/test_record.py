"""What is recorded of a step: against formulas, against the impulses of single contacts, and on several ranks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from cases import crude_impulse, force_on, heap
from mpi4py import MPI
from several_ranks import alone

from dem import record
from dem.bodies import COMPOUND
from dem.contact import find_contacts
from dem.experiment import Experiment
from dem.model.partition import rebalance
from dem.motion import Glide, Guided, Hinged, Oscillation
from dem.record.energies import energy
from dem.scene import Scene
from dem.shapes import Plane, Sphere
from dem.start import new_world
from dem.step import Step, advance
from dem.step.system import ContactSystem
from dem.unconstrained import unconstrained
from pctt import Simulation

SELF = MPI.COMM_SELF
DT = 0.01


def made(world, solve=crude_impulse, dt=DT, delta=0.02):
    """A step of the world, its contacts rigid, with the impulses that `solve` finds."""
    world.pairs.stiffness[:] = np.inf
    contacts = find_contacts(world, delta)
    system = ContactSystem(world, contacts, unconstrained(world, dt), recovery_speed=0.5)
    impulse = solve(system)
    advance(world, system.motion, system.contacts, system.velocity(impulse))
    return Step(world, contacts, system, impulse)


def energy_error(balance, before):
    """What the change of energy and its recorded causes leave over."""
    change = balance["kinetic_energy [J]"] + balance["potential_energy [J]"] - before
    causes = balance["work_of_motions [J]"] - balance["friction_loss [J]"] - balance["impact_loss [J]"]
    return change - causes - balance["time_stepping [J]"]


def test_an_impact_without_bounce_takes_the_whole_kinetic_energy():
    scene = Scene(0.0, gravity=(0, 0, 0))
    scene.add_body("floor", [Plane((0, 0, 1))])
    scene.add_spheres([0, 0, 0.1], 0.1, 1000.0, velocity=(0, 0, -2.0))
    world = new_world(scene, SELF)
    mass = world.grains.mass[0]
    balance = record.energy_balance(made(world, lambda system: np.array([[2.0 * mass, 0, 0]])))
    assert balance["kinetic_energy [J]"] == pytest.approx(0.0, abs=1e-12)
    assert balance["impact_loss [J]"] == pytest.approx(2.0 * mass)
    assert balance["friction_loss [J]"] == pytest.approx(0.0, abs=1e-12)
    assert balance["time_stepping [J]"] == pytest.approx(0.0, abs=1e-12)


def test_a_moving_floor_does_work_through_friction():
    """The floor slides under a sphere at rest: its work is the friction's loss and what the sphere gains."""
    scene = Scene(0.3, gravity=(0, 0, 0))
    scene.add_spheres([0, 0, 0.1], 0.1, 1000.0)
    scene.add_body("floor", [Plane((0, 0, 1))], Glide((2.0, 0, 0)))
    world = new_world(scene, SELF)
    mass = world.grains.mass[0]
    pull = 0.1 * mass  # impulse on the sphere along x

    def solve(system):  # the impulse is that on the second body, the floor
        tangents = system.frame[0, 1:] @ [-pull, 0, 0]
        return np.array([[0.0, *tangents]])

    step = made(world, solve)
    balance = record.energy_balance(step)
    kinetic = 0.5 * pull**2 / mass + 0.5 * (pull * 0.1) ** 2 / (0.4 * mass * 0.01)
    assert balance["work_of_motions [J]"] == pytest.approx(pull * 2.0)
    assert balance["kinetic_energy [J]"] == pytest.approx(kinetic)
    assert balance["friction_loss [J]"] == pytest.approx(pull * 2.0 - kinetic)
    np.testing.assert_allclose(step.force_on("floor")[:3], [-pull / DT, 0, 0], atol=1e-9)
    np.testing.assert_allclose(step.velocity("floor"), [2.0, 0, 0, 0, 0, 0], atol=1e-12)
    np.testing.assert_allclose(step.position("floor"), [2.0 * DT, 0, 0], atol=1e-12)


def test_a_plate_that_shakes_does_no_work_in_a_cycle_on_what_sits_on_it():
    """Next to the greatest kinetic energy."""
    swing, period, steps = 0.005, 0.2, 50
    scene = Scene(0.3)
    scene.add_spheres([0, 0, 0.01], 0.01, 2500.0)
    scene.add_body("plate", [Plane((0, 0, 1))], Oscillation((0, 0, 1), swing, period))
    sim = Simulation(scene, dt=period / steps, comm=SELF)
    sim.run(steps=steps)
    cycle = [[sim.step()[name] for name in ("work_of_motions [J]", "impact_loss [J]")] for _ in range(steps)]
    kinetic = 0.5 * sim.local.mass[0] * (2.0 * np.pi * swing / period) ** 2
    assert np.abs(np.sum(cycle, axis=0)).max() < 0.03 * kinetic


@pytest.mark.parametrize(
    ("motion", "work"),
    [
        (Guided((1, 0, 0), force=100.0, start=0.033, end=0.1), 0.5 * (100.0 * 0.067) ** 2 / 50.0),
        (Hinged((0, 0, 1), torque=3.0, speed=0.5), 0.5 * 2.0 * 0.5**2),
    ],
    ids=["guided", "hinged"],
)
def test_drives_do_the_work_that_the_bodies_have_afterwards(motion, work):
    """Nothing else acts; also a drive that begins within a step gives its whole impulse."""
    scene = Scene(0.3, gravity=(0, 0, 0))
    scene.add_spheres([0, 0, 9.0], 0.1, 1000.0)
    scene.add_body("tool", [Sphere(0.1)], motion, mass=50.0, inertia=(2.0, 2.0, 2.0))
    world = new_world(scene, SELF)
    rows = [record.energy_balance(made(world)) for _ in range(50)]
    assert rows[-1]["kinetic_energy [J]"] == pytest.approx(work, rel=1e-12)
    assert sum(row["work_of_motions [J]"] for row in rows) == pytest.approx(work, rel=1e-12)
    np.testing.assert_allclose([row["time_stepping [J]"] for row in rows], 0.0, atol=1e-12)


def test_the_balance_of_a_heap_closes_whatever_the_impulses():
    world = new_world(heap(boxes=False), SELF)
    dt = 0.005
    before = sum(sum(energy(table, world.gravity)) for table in (world.grains, world.large))
    for _ in range(10):
        old = np.concatenate([world.grains.velocity, world.large.velocity[3:]])
        step = made(world, dt=dt)
        balance = record.energy_balance(step)
        assert energy_error(balance, before) == pytest.approx(0.0, abs=1e-10 * abs(before))
        new = np.concatenate([world.grains.velocity, world.large.velocity[3:]])
        mass = np.concatenate([world.grains.mass, world.large.mass[3:]])
        stepping = 0.5 * dt * 9.81 * (mass * (new - old)[:, 2]).sum()
        assert balance["time_stepping [J]"] == pytest.approx(stepping, abs=1e-4)  # and a little of the turning slab
        before = balance["kinetic_energy [J]"] + balance["potential_energy [J]"]
    assert abs(balance["friction_loss [J]"]) > 1.0  # there was something to balance
    assert abs(balance["work_of_motions [J]"]) > 0.01


def test_contact_statistics_count_what_the_impulses_say():
    """Three spheres in a row on the floor, two of them touching; the third contact is open."""
    scene = Scene(0.5)
    scene.add_body("floor", [Plane((0, 0, 1))])
    scene.add_spheres([[0, 0, 0.0999], [0.2, 0, 0.1], [0.41, 0, 0.1]], 0.1, 1000.0)
    world = new_world(scene, SELF)

    def solve(system):
        impulse = np.zeros((len(system.key), 3))
        impulse[:, 0] = 1.0
        impulse[0, 1] = 0.499  # slides
        impulse[1, 2] = -0.3  # sticks
        impulse[-1, 0] = 1e-4  # as a solver leaves it at an open contact
        return impulse

    step = made(world, solve)
    found = record.contact_statistics(step)
    assert found["contacts"] == 5
    assert found["active_contacts"] == 4
    assert found["sliding_fraction"] == 0.25
    with_floor = step.contacts.near.bodies.shape[step.contacts.b[:-1]] == COMPOUND
    assert found["coordination_number"] == pytest.approx((2 * 4 - with_floor.sum()) / 3)
    assert found["worst_overlap [m]"] == pytest.approx(1e-4)


@dataclass(frozen=True)
class Here(Experiment):
    domain = ((0.0, 0.0, 0.0), (1.0, 1.0, 1.0))

    def record(self, step):
        return {"high": step.total(step.world.grains.position[:, 2] > 0.5), "angle [rad]": 2}


def test_a_row_has_the_forces_on_all_large_bodies_and_what_the_scene_adds():
    world = new_world(heap(), SELF)
    step = made(world)
    row = record.row(step, Here())
    assert list(row)[:2] == ["step", "time [s]"]
    assert (row["step"], row["time [s]"]) == (1, DT)
    for name in ("walls", "blade", "ball", "slab"):
        force = [row[f"force_{name}_{axis} [N]"] for axis in "xyz"] + [row[f"torque_{name}_{a} [N m]"] for a in "xyz"]
        np.testing.assert_allclose(force, force_on(world, step.system, name, step.impulse), rtol=1e-12, atol=1e-12)
    place = world.grains.position
    assert row["high"] == (place[:, 2] > 0.5).sum()
    assert row["grains_outside"] == ((place < 0) | (place > 1)).any(axis=1).sum() > 0
    assert all(np.isfinite(value) for value in row.values())


def rows_of(comm):
    world = new_world(heap(), comm)
    rows = []
    for _ in range(5):
        rebalance(world, 1.0)
        rows.append({name: float(value) for name, value in record.row(made(world), Here()).items()})
    assert all(rows == other for other in comm.allgather(rows))
    return rows


@pytest.mark.parallel(2, 3)
def test_records_do_not_depend_on_the_number_of_ranks():
    for row, same in zip(rows_of(MPI.COMM_WORLD), alone(rows_of)):
        assert list(row) == list(same)
        for name, value in same.items():
            np.testing.assert_allclose(row[name], value, rtol=1e-9, atol=1e-9, err_msg=name)
