"""Spinning bodies that are no spheres, under impulses of joints, contacts, loads and springs."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
from mpi4py import MPI
from scipy.integrate import solve_ivp

from dem import quaternion
from dem.motion import Dynamic
from dem.scene import Scene
from dem.shapes import Box, Plane, Sphere
from dem.start.time_step import recommended
from pctt.simulation import Simulation

G, ARM = 9.81, 0.1
OBLATE, PROLATE, TRIAXIAL = (1.5e-3, 1.5e-3, 2.5e-3), (2e-3, 2e-3, 1e-3), (1e-3, 2e-3, 2.6e-3)


def tilted(angle):
    """The orientation of a top whose axis leans from the vertical to x by an angle."""
    return np.cos(angle / 2), 0.0, np.sin(angle / 2), 0.0


def energy(sim, **moments):
    """Of bodies of 1 kg with these moments [J], their heights taken in the middle of the step as their velocities."""
    total = 0.0
    for name, each in moments.items():
        body = sim.body(name)
        w = quaternion.rotate(quaternion.conjugate(body.orientation), body.velocity[3:])
        v, height = body.velocity[:3], body.position[2] - 0.5 * sim.settings.dt * body.velocity[2]
        total += 0.5 * (v @ v + np.array(each) @ w**2) + G * height
    return total


def top(moments, spin, tilt):
    """A top of 1 kg on a ball joint at the origin."""
    axis = np.array([np.sin(tilt), 0.0, np.cos(tilt)])
    scene = Scene(0.0)
    place = {"position": ARM * axis, "quaternion": tilted(tilt), "angular_velocity": spin * axis}
    scene.add_body("top", [Sphere(0.02)], Dynamic(), mass=1.0, inertia=moments, **place)
    scene.add_joint("tip", None, "top", kind="ball", anchor=(0, 0, 0))
    return scene


def simulation(scene, dt=None, **more):
    return Simulation(scene, dt=dt, comm=MPI.COMM_SELF, **more)


def lagrange(moments, spin, tilt, times):
    """Angles between the axis of the top and the vertical at some times."""
    across, along = moments[0] + ARM**2, moments[2] * spin

    def rates(time, y):
        turn = along * (np.cos(tilt) - np.cos(y[0])) / (across * np.sin(y[0]) ** 2)
        force = across * turn**2 * np.cos(y[0]) - along * turn + G * ARM
        return [y[1], force * np.sin(y[0]) / across]

    found = solve_ivp(rates, (0.0, times[-1]), [tilt, 0.0], t_eval=times, rtol=1e-10, atol=1e-12)
    return found.y[0]


@pytest.mark.parametrize(("moments", "spin", "tilt"), [(OBLATE, 300.0, np.pi / 2), (PROLATE, 200.0, 0.5)])
def test_a_top_on_a_joint_nutates_as_lagrange_says_and_keeps_its_energy(moments, spin, tilt):
    """It turns by .2 radians in a step, as the default has it."""
    sim = simulation(top(moments, spin, tilt))
    assert 0.19 < sim.settings.dt * spin <= 0.2
    sim.step()
    begin, times, heights = energy(sim, top=moments), [], []
    for _ in range(int(0.08 / sim.settings.dt)):
        sim.step()
        times.append(sim.time)
        heights.append(sim.body("top").position[2])
        assert energy(sim, top=moments) == pytest.approx(begin, abs=1e-3 * G * ARM)
    angle = np.arccos(np.array(heights) / ARM)
    exact = lagrange(moments, spin, tilt, np.array(times) + 0.5 * sim.settings.dt)
    assert np.abs(angle - exact).max() < 0.01 * np.ptp(exact)
    assert np.ptp(angle) == pytest.approx(np.ptp(exact), rel=0.01)


def test_a_top_on_a_floor_keeps_its_energy():
    """Its tip of 2 mm soon rolls; then nothing is lost. It turns by .15 radians in a step."""
    scene, spin, tilt = Scene(0.9), 150.0, 0.2
    axis = np.array([np.sin(tilt), 0.0, np.cos(tilt)])
    scene.add_body("floor", [Plane((0, 0, 1))])
    shapes = [Sphere(0.002, center=(0, 0, -ARM)), Sphere(0.02)]
    place = {"position": ARM * axis + [0, 0, 0.002], "quaternion": tilted(tilt), "angular_velocity": spin * axis}
    scene.add_body("top", shapes, Dynamic(), mass=1.0, inertia=OBLATE, **place)
    sim = simulation(scene, 1e-3)
    sim.step()
    begin = energy(sim, top=OBLATE)
    for _ in range(150):
        sim.step()
    assert energy(sim, top=OBLATE) == pytest.approx(begin, abs=5e-4 * G * ARM)


def worst_angle(dt):
    """The error of a prolate top's angle [rad] within .03 s. Velocities are those of the middles of steps, that of time
    zero too, so the top is half a step ahead of one that is let go then."""
    sim, found, times = simulation(top(PROLATE, 200.0, 0.5), dt), [], []
    for _ in range(round(0.03 / dt)):
        sim.step()
        found.append(np.arccos(sim.body("top").position[2] / ARM))
        times.append(sim.time)
    return np.abs(np.array(found) - lagrange(PROLATE, 200.0, 0.5, np.array(times) + 0.5 * dt)).max()


def test_the_nutation_of_a_top_is_of_second_order():
    coarse, fine = worst_angle(1e-3), worst_angle(5e-4)
    assert fine < 0.3 * coarse
    assert coarse < 2e-4


def test_bodies_whose_joints_are_beside_their_axes_keep_their_energy():
    """Two triaxial bodies in a chain, which turn about .1 to .2 radians in a step, mostly across their joints."""
    spin = np.array([0.0, 10.0, 40.0])
    scene = Scene(0.0)
    for n, name in enumerate(("one", "other")):
        place = np.array([ARM + 2 * n * ARM, 0.0, 0.0])
        motion = {"velocity": np.cross(spin, place), "angular_velocity": spin}
        scene.add_body(name, [Sphere(0.02)], Dynamic(), position=place, mass=1.0, inertia=TRIAXIAL, **motion)
    scene.add_joint("first", None, "one", kind="ball", anchor=(0, 0, 0))
    scene.add_joint("second", "one", "other", kind="ball", anchor=(2 * ARM, 0, 0))
    sim = simulation(scene, 0.004)
    sim.step()
    begin, found = energy(sim, one=TRIAXIAL, other=TRIAXIAL), []
    for _ in range(60):
        sim.step()
        found.append(energy(sim, one=TRIAXIAL, other=TRIAXIAL))
    assert found == pytest.approx(np.full(60, begin), rel=0.01)
    ends = [sim.body(name).position for name in ("one", "other")]
    turns = [quaternion.rotate(sim.body(name).orientation, np.array([ARM, 0, 0])) for name in ("one", "other")]
    np.testing.assert_allclose([ends[0] - turns[0], ends[1] - turns[1] - ends[0] - turns[0]], 0.0, atol=1e-6)


def test_a_constant_torque_gives_its_angular_momentum():
    """A free triaxial body turns by .1 to .2 radians in a step. Its momentum is that in the middle of a step."""
    spin, torque = np.array([20.0, 5.0, 30.0]), np.array([0.2, 0.1, 0.3])
    scene = Scene(0.0, gravity=(0, 0, 0))
    scene.add_body("rotor", [Sphere(0.02)], Dynamic(), mass=1.0, inertia=TRIAXIAL, angular_velocity=spin)
    scene.add_load("motor", on="rotor", torque=torque)
    sim = simulation(scene, 0.004)

    def momentum():
        body = sim.body("rotor")
        middle = quaternion.integrate(body.orientation[None], body.velocity[None, 3:], -0.5 * sim.settings.dt)[0]
        return quaternion.rotate(middle, TRIAXIAL * quaternion.rotate(quaternion.conjugate(middle), body.velocity[3:]))

    sim.step()
    begin = momentum()
    for _ in range(50):
        sim.step()
    np.testing.assert_allclose(momentum() - begin, 50 * 0.004 * torque, rtol=1e-6)


def test_bodies_get_the_angular_momentum_of_their_impacts():
    """Two boxes collide that turn by .1 radians in a step: what each of them gets is what acts on it, to rounding."""
    scene = Scene(0.3, gravity=(0, 0, 0), restitution=0.8)
    turn = quaternion.exponential(np.array([[0.0, 0.0, np.pi / 4], [0.0, 0.0, 0.0]]))
    motion = {"velocity": [[1.0, 0, 0], [0, 0, 0]], "angular_velocity": [[0, 40, 100], [30, 0, -80]]}
    scene.add_boxes([[-0.2, 0.02, 0.01], [0, 0, 0]], (0.06, 0.1, 0.04), 1000.0, quaternions=turn, **motion)
    sim = simulation(scene, 1e-3)

    def momenta():
        table = sim.world.grains
        middle = quaternion.integrate(table.quaternion, table.velocity[:, 3:], -0.5 * sim.settings.dt)
        own = quaternion.rotate(quaternion.conjugate(middle), table.velocity[:, 3:])
        return quaternion.rotate(middle, table.inertia * own)

    begin, given = momenta(), np.zeros((2, 3))
    for _ in range(10):
        sim.step()
        step = sim.last
        given += step.system.contact_map.sums_of_impulses(step.impulse)[:, 3:]
    assert np.abs(given).max() > 0.1
    np.testing.assert_allclose(momenta() - begin, given, atol=1e-9)


def test_dt_resolves_the_spin_of_what_is_no_sphere():
    def chosen(add):
        scene = Scene(0.0, gravity=(0, 0, 0))
        add(scene)
        return recommended(scene)

    fast = {"angular_velocity": (0, 60, 80)}
    assert chosen(lambda scene: scene.add_boxes([0, 0, 0], (0.1, 0.1, 0.2), 1000.0, **fast)) == 2e-3
    assert chosen(lambda scene: scene.add_capsules([[0, 0, 0], [1, 0, 0]], 0.1, 0.1, 1000.0, **fast)) == 2e-3
    assert chosen(lambda scene: scene.add_spheres([0, 0, 0], 0.1, 1000.0, **fast)) == 1e-2
    scene = Scene(0.0, gravity=(0, 0, 0))
    scene.add_spheres([0, 0, 0], 1.0, 1000.0)  # of whose radius a tool may go a part in a step
    place = {"position": (0, 0, 2), "angular_velocity": (0, 0, 300)}
    scene.add_body("ball", [Sphere(0.02)], Dynamic(), density=1000.0, **place)
    assert recommended(scene) == 1e-2
    scene.add_body("rotor", [Sphere(0.02)], Dynamic(), mass=1.0, inertia=OBLATE, **place)
    assert recommended(scene) == 6.6e-4


def test_a_body_that_turns_too_far_in_a_step_is_told_once():
    """At the start, or later in some steps after each other."""
    with pytest.warns(UserWarning, match=r"dt 0.005 s is too large: body 'top' turns by 1 rad .* at most 0.001 s"):
        sim = simulation(top(PROLATE, 200.0, 0.5), 0.005)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        sim.step()
        scene = Scene(0.0, gravity=(0, 0, 0))
        scene.add_boxes([0, 0, 0], (0.1, 0.1, 0.2), 1000.0)
        scene.add_load("motor", torque=(0, 0, 20.0))
        slow = simulation(scene, 0.005)
    with pytest.warns(UserWarning, match="grain 0 turns by 0.2") as told:
        slow.run(until=0.4)
    assert len(told) == 1
    assert 0.005 * slow.velocities[0, 5] > 0.3


def sharp_top(kind, floor, spin=300.0, tilt=0.2):
    """A top whose tip is a corner, on the origin; its axis leans by an angle."""
    axis = np.array([np.sin(tilt), 0.0, np.cos(tilt)])
    motion = {"quaternions": tilted(tilt), "angular_velocity": spin * axis}
    scene = Scene(0.9)
    scene.add_body("floor", [floor])
    if kind == "cone":
        angle = np.pi / 6 * np.arange(12)
        rim = np.stack([0.05 * np.cos(angle), 0.05 * np.sin(angle), np.full(12, 0.1)], axis=1)
        scene.add_polyhedra([0, 0, 0], np.vstack([np.zeros(3), rim]), 1000.0, **motion)
    else:
        half = np.arccos(1 / np.sqrt(3.0)) / 2  # a corner of the cube is turned downwards
        down = np.cos(half), np.sin(half) / np.sqrt(2.0), -np.sin(half) / np.sqrt(2.0), 0.0
        turn = quaternion.multiply(np.array([tilted(tilt)]), np.array([down]))
        scene.add_boxes(0.04 * np.sqrt(3.0) * axis, (0.04,) * 3, 1000.0, **{**motion, "quaternions": turn})
    return scene


def lost(kind, floor, dt, time=0.05):
    """The energy that a sharp top loses at most in a time, over m g l."""
    sim = simulation(sharp_top(kind, floor), dt, stiffness=np.inf, tol=1e-8)
    mass, moments = sim.world.grains.mass[0], sim.world.grains.inertia[0]
    lever = mass * G * np.linalg.norm(sim.positions[0])

    def energy():
        grains = sim.world.grains
        spin = quaternion.rotate(quaternion.conjugate(grains.quaternion), grains.velocity[:, 3:])[0]
        velocity = grains.velocity[0, :3]
        height = grains.position[0, 2] - 0.5 * dt * velocity[2]
        return 0.5 * (mass * velocity @ velocity + moments @ spin**2) + mass * G * height

    for _ in range(20):
        sim.step()  # it sinks in its spring
    begin, found = energy(), []
    while sim.time < time:
        sim.step()
        found.append(energy())
    return np.abs(np.array(found) - begin).max() / lever


@pytest.mark.parametrize(("kind", "floor"), [
    pytest.param("cone", Plane((0, 0, 1)), marks=pytest.mark.slow), ("cone", Box((1, 1, 0.1), (0, 0, -0.1))),
    pytest.param("cone", Sphere(1.0, (0, 0, -1)), marks=pytest.mark.slow),
    pytest.param("cube", Plane((0, 0, 1)), marks=pytest.mark.slow), ("cube", Sphere(1.0, (0, 0, -1))),
])  # fmt: skip
def test_a_top_with_a_sharp_tip_keeps_its_energy(kind, floor):
    """It turns by .2 radians in a step, and its loss is of second order in dt."""
    coarse, fine = (lost(kind, floor, 0.2 / 300.0 / parts) for parts in (1, 2))
    assert coarse < 4e-4
    assert fine < 0.3 * coarse
