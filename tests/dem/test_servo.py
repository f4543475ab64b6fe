"""Drives: hinged bodies, and servos that keep a speed with a bounded force or torque."""

from __future__ import annotations

import numpy as np
import pytest
from cases import force_on
from mpi4py import MPI

from dem import quaternion
from dem.contact import find_contacts
from dem.mesh import Mesh
from dem.motion import Dynamic, Glide, Guided, Hinged
from dem.scene import Scene
from dem.shapes import Box, Plane, Sphere, mass_properties
from dem.start import new_world
from dem.step import advance
from dem.step.system import ContactSystem
from dem.unconstrained import unconstrained
from pctt import Simulation, ccp
from pctt.run.stepper import cone_problem

SELF, DT = MPI.COMM_SELF, 0.01
AXIS = np.array([1.0, 2.0, 2.0]) / 3.0


def world_of(shapes, motion, gravity=(0, 0, -9.81), **options):
    """A body with a drive, and a sphere far away, without which there is no scene."""
    scene = Scene(0.5, gravity)
    scene.add_body("tool", shapes, motion, **options)
    scene.add_spheres([0, 0, 100.0], 0.1, 1000.0)
    return new_world(scene, SELF)


def step(world, tol=1e-9, dt=DT):
    """One time step by Coulomb's law; the force on the tool."""
    free = unconstrained(world, dt)
    system = ContactSystem(world, find_contacts(world, 0.01, free), free)
    with cone_problem(system, SELF) as problem:
        impulse = ccp.solve(problem, None, "apgd", ccp.Limits(tol), law=ccp.COULOMB).impulse
    advance(world, system.motion, system.contacts, system.velocity(impulse))
    return force_on(world, system, "tool", impulse)


def test_a_wheel_on_a_hinge_turns_by_its_torque_and_stays_in_its_place():
    pytest.importorskip("trimesh")
    wheel = Mesh.revolved([(0, -0.1), (0.5, -0.1), (0.5, 0.1), (0, 0.1)], 60)
    tilt = (0.5, 0.5, -0.5, 0.5)
    world = world_of([wheel], Hinged(AXIS, torque=3.0, end=0.2), density=100.0, position=(1, 2, 3), quaternion=tilt)
    sphere = world_of([Sphere(0.5)], Hinged(AXIS, torque=3.0), density=100.0, position=(1, 2, 3))
    for _ in range(25):
        step(world)
        step(sphere)
    moment = 0.4 * 0.25 * 100.0 * 4 / 3 * np.pi * 0.125
    np.testing.assert_allclose(sphere.large.velocity[0], [0, 0, 0, *(3.0 * 0.25 / moment * AXIS)], atol=1e-12)
    speed = world.large.velocity[0, 3:]
    np.testing.assert_allclose(np.cross(speed, AXIS), 0.0, atol=1e-12)
    turn = np.linalg.norm(speed)
    np.testing.assert_allclose(world.large.position[0], [1, 2, 3], atol=1e-12)
    local = quaternion.rotate(quaternion.conjugate(np.array(tilt)), AXIS)
    assert turn == pytest.approx(3.0 * 0.2 / (local @ mass_properties([wheel], 100.0)[2] @ local))


@pytest.mark.parametrize(("force", "speed"), [(2000.0, 0.2), (800.0, 0.0)])
def test_a_press_with_a_servo_rises_if_it_is_strong_enough(force, speed):
    """It weighs 981 N and stands on the floor: with 2 kN it rises at its speed, with 800 N the floor bears the rest."""
    scene = Scene(0.5, stiffness=np.inf)
    scene.add_body("floor", [Plane((0, 0, 1))])
    press = Guided((0, 0, 1), force=force, speed=0.2)
    scene.add_body("tool", [Box((0.1, 0.1, 0.1))], press, mass=100.0, position=(0, 0, 0.1))
    scene.add_spheres([0, 5, 0.1], 0.1, 1000.0)
    world = new_world(scene, SELF)
    for _ in range(20):
        borne = step(world)
    assert world.large.velocity[1, 2] == pytest.approx(speed, abs=1e-6)
    assert borne[2] == pytest.approx(0.0 if speed else 981.0 - 800.0, abs=1e-3)


def test_a_bearing_bears_what_presses_on_the_axis():
    """A roller on a moving belt: neither can give way along the normal, so that there is no contact between them."""
    scene = Scene(0.5)
    scene.add_body("belt", [Plane((0, 0, 1))], Glide((1.0, 0, 0)))
    roller = Hinged((0, 1, 0), torque=50.0, speed=2.0)
    scene.add_body("tool", [Sphere(0.5)], roller, density=100.0, position=(0, 0, 0.5))
    scene.add_spheres([0, 5, 0.1], 0.1, 1000.0)
    world = new_world(scene, SELF)
    assert len(find_contacts(world, 0.01)) == 1  # the small sphere on the belt
    for _ in range(25):
        step(world)
    assert world.large.velocity[1, 4] == pytest.approx(2.0, rel=1e-9)


def test_the_mass_scaled_map_of_a_hinged_body_has_one_direction():
    scene = Scene(0.3)
    scene.add_body("tool", [Sphere(0.5)], Hinged(AXIS), density=100.0)
    scene.add_spheres([[0.6, 0, 0], [0, 0.601, 0]], 0.1, 1000.0)
    world = new_world(scene, SELF)
    system = ContactSystem(world, find_contacts(world, 0.01), unconstrained(world, DT))
    rows = system.contact_map.block_rows
    blocks = rows.blocks[rows.indices == 2].reshape(-1, 6)
    np.testing.assert_array_equal(blocks[:, :3], 0.0)
    np.testing.assert_allclose(np.cross(blocks[:, 3:], AXIS), 0.0, atol=1e-15)
    compact = system.contact_map.source.root[-1, 6:]
    moment = 0.4 * 0.25 * 100.0 * 4 / 3 * np.pi * 0.125
    np.testing.assert_allclose(compact, (np.outer(AXIS, AXIS) / np.sqrt(moment))[np.triu_indices(3)], atol=1e-15)


@pytest.mark.parametrize("dt", [0.01, 0.0005])
def test_a_servo_that_is_stopped_pushes_with_all_its_strength(dt):
    """A light plate against a wall, whatever the step is: 500 N, and not what its own mass would need."""
    scene = Scene(0.5, gravity=(0, 0, 0), stiffness=np.inf)
    scene.add_body("wall", [Plane((-1, 0, 0))], position=(0.1, 0, 0))
    scene.add_body("tool", [Box((0.1, 0.1, 0.1))], Guided((1, 0, 0), force=500.0, speed=1.0), mass=0.1)
    scene.add_spheres([0, 5, 0.1], 0.1, 1000.0)
    world = new_world(scene, SELF)
    for _ in range(3):
        assert step(world, dt=dt)[0] == pytest.approx(-500.0, rel=1e-6)
    assert world.large.velocity[1, 0] == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize(("load", "speed"), [(0.0, 2.0), (90.0, 2.0), (120.0, None)])
def test_a_servo_keeps_its_speed_under_a_load_that_it_can_bear(load, speed):
    """A drum of radius 0.5 m on a hinge, 50 N m, with a block that a guide presses on it: friction 0.9 brakes it with
    0.45 m times the force of the block. It reaches its speed, keeps it to a thousandth, or is stopped."""
    scene = Scene(0.9, gravity=(0, 0, 0), stiffness=np.inf)
    scene.add_body("tool", [Sphere(0.5)], Hinged((0, 1, 0), torque=50.0, speed=2.0), density=10.0)
    scene.add_body("block", [Box((0.1, 0.1, 0.1))], Guided((-1, 0, 0), force=load), mass=1.0, position=(0.6, 0, 0))
    scene.add_spheres([0, 5, 0.1], 0.1, 1000.0)
    world = new_world(scene, SELF)
    for _ in range(100):
        step(world)
    found = world.large.velocity[0, 4]
    assert found == pytest.approx(speed, rel=1.1e-3) if speed else abs(found) < 1e-9


def test_a_servo_gives_no_more_than_its_strength_when_its_body_strikes_a_wall():
    """A plate at its speed of 1 m/s meets a wall within a step. The wall takes its momentum of 0.1 N s and what the
    drive gives, 500 N at most, from the first step on."""
    scene = Scene(0.5, gravity=(0, 0, 0), stiffness=np.inf)
    scene.add_body("wall", [Plane((-1, 0, 0))], position=(0.12, 0, 0))
    scene.add_body("tool", [Box((0.1, 0.1, 0.1))], Guided((1, 0, 0), force=500.0, speed=1.0), mass=0.1)
    scene.add_spheres([0, 5, 0.1], 0.1, 1000.0)
    dt, given = 0.01, []
    with Simulation(scene, comm=SELF, dt=dt, tol=1e-9, solver="apgd") as sim:
        for _ in range(6):
            before = sim.body("tool").velocity[0]
            sim.step()
            tool = sim.body("tool")
            given.append(0.1 * (tool.velocity[0] - before) / dt - tool.force[0])
    assert max(given) == pytest.approx(500.0, rel=1.1e-3)
    assert min(given) > -1e-6
    assert given[-1] == pytest.approx(500.0, rel=1.1e-3)
    assert tool.velocity[0] == pytest.approx(0.0, abs=1e-9)


def plate_on(scene, kind, along, strength):
    """A plate of 10 kg with a drive of 0.05 m/s."""
    plate = {"mass": 10.0, "inertia": (0.1, 0.1, 0.1)}
    if kind == "guided":
        scene.add_body("tool", [Box((0.1, 0.1, 0.1))], Guided(along, force=strength, speed=0.05), **plate)
    else:
        scene.add_body("tool", [Box((0.1, 0.1, 0.1))], Dynamic(), **plate)
        slider = {"kind": "slider", "anchor": (0, 0, 0), "axis": along}
        scene.add_joint("slider", None, "tool", **slider, speed=0.05, strength=strength)


@pytest.mark.parametrize("kind", ["guided", "joint"])
@pytest.mark.parametrize(
    ("along", "load", "strength"),
    [((0, 0, -1), 0.0, 500.0), ((0, 0, -1), 0.0, 40.0), ((1, 0, 0), 400.0, 500.0), ((1, 0, 0), -400.0, 500.0)],
)
def test_a_servo_that_its_load_helps_and_that_is_stopped_pushes_with_all_its_strength(kind, along, load, strength):
    """Against a stop, by the defaults: the stop bears the strength, the weight and the load along the drive. Before it
    the drive brakes where weight and load alone would make the plate faster than it should be in a step."""
    scene, line = Scene(0.0), np.array(along, float)
    scene.add_body("stop", [Box((0.1, 0.1, 0.1))], position=0.202 * line)
    plate_on(scene, kind, along, strength)
    if load:
        scene.add_load("load", on="tool", force=load * line)
    sim = Simulation(scene, comm=SELF)
    sim.run(until=0.2)
    assert sim.body("stop").force @ line == pytest.approx(strength - 98.1 * line[2] + load, rel=1e-3)


@pytest.mark.parametrize(
    ("kind", "load", "against", "net"), [("joint", -250.0, 300.0, -50.0), ("guided", 300.0, 900.0, -100.0)]
)
def test_a_servo_that_bears_a_load_gives_way_where_a_press_needs_more_than_its_strength(kind, load, against, net):
    """500 N, a load on its plate, and a press of 5 kg: what is too much moves both of them."""
    scene = Scene(0.0, gravity=(0, 0, 0))
    plate_on(scene, kind, (1, 0, 0), 500.0)
    scene.add_body("press", [Box((0.1, 0.1, 0.1))], Guided((-1, 0, 0), force=against), mass=5.0, position=(0.2, 0, 0))
    scene.add_load("load", on="tool", force=(load, 0, 0))
    sim = Simulation(scene, comm=SELF)
    sim.run(until=0.05)
    assert sim.body("tool").velocity[0] == pytest.approx(net / 15.0 * sim.time, rel=0.01)
    sim.change("load load", force=(against - 400.0, 0, 0))  # now it is strong enough
    sim.run(until=1.2)
    assert sim.body("tool").velocity[0] == pytest.approx(0.05, rel=2e-3)
