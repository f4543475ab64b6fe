"""Joints: closed forms of mechanisms, contacts through joints, restarts, ranks."""

import warnings

import numpy as np
import pytest
from mpi4py import MPI
from scipy.special import ellipk

import pctt
from dem.measures import Block
from dem.motion import Dynamic, Glide, Held
from dem.scene import Scene
from dem.shapes import Box, Plane
from dem.unconstrained import constraints
from pctt import ccp
from pctt.ccp.delassus import BlockMap
from pctt.folder import Folder
from pctt.options import OptionError
from pctt.run.stepper import NoSolutionError

G = 9.81


def simulation(scene, dt=0.002, **given):
    return pctt.Simulation(scene, dt=dt, tol=1e-9, comm=MPI.COMM_SELF, say=lambda text: None, **given)


def pendulum(dt, length=1.0, kind="hinge"):
    """A small sphere that begins at the height of its hinge."""
    scene = Scene(friction=0.3)
    (ball,) = scene.add_spheres([length, 0, 0], 0.05, 1000.0)
    axis = (0, 1, 0) if kind == "hinge" else None
    scene.add_joint("pin", None, ball, kind=kind, anchor=(0, 0, 0), axis=axis)
    return simulation(scene, dt)


def test_pendulum_force_and_distance():
    sim = pendulum(0.01)
    mass = sim.local.mass[0]
    lowest = 0.0
    while sim.time < 0.8:
        sim.step()
        lowest = max(lowest, sim.joint("pin").force[2] / (mass * G))
        assert np.linalg.norm(sim.positions[0]) == pytest.approx(1.0, abs=1e-3)
    moment = 1.0 + 0.4 * 0.05**2  # about the hinge, over the mass
    assert lowest == pytest.approx(1.0 + 2.0 / moment, rel=1e-2)


@pytest.mark.parametrize("kind", ["ball", "hinge", "fixed", None])
def test_bodies_that_fall_side_by_side_have_no_impulses(kind):
    """Boxes that touch, and pendula that swing in parallel: what closes is the rounding of their velocities alone."""
    scene = Scene(friction=0.3)
    boxes = scene.add_boxes([[0, 0.013, 5.1], [0.3, 0, 5.1], [0.6, 0.03, 5.1]], (0.15, 0.1, 0.1), 1000.0)
    scene.add_boxes([[0, 0.213, 5.1]], (0.15, 0.1, 0.1), 300.0)
    if kind is not None:
        scene.add_joint("link", boxes[0], boxes[1], kind=kind, anchor=(0.15, 0, 5.1))
        for k, ball in enumerate(scene.add_spheres([[1, 0.2 * k, 0] for k in range(3)], 0.1, 1000.0)):
            scene.add_joint(f"pin {k}", None, ball, kind="ball", anchor=(0, 0.2 * k, 0))
    sim = simulation(scene, 0.005)
    for _ in range(40):
        figures = sim.step()
        assert (figures["converged"], figures["iterations"], figures["impulse_norm"]) == (True, 0, 0.0)


def energies(sim, until):
    """Of each step, over m g of the first grain: the velocities of a step are those of its middle, so the potential
    energy is that of the mean of two places."""
    out, mass, before = [], sim.local.mass, sim.positions[:, 2]
    while sim.time < until - 1e-9:
        kinetic = sim.step()["kinetic_energy [J]"]
        after = sim.positions[:, 2]
        out.append((kinetic + G * mass @ (before + after) / 2.0) / (mass[0] * G))
        before = after
    return np.array(out)


def test_energy_of_a_pendulum_is_of_second_order_and_does_not_drift():
    coarse, fine = (np.abs(energies(pendulum(dt, kind="ball"), 2.2)) for dt in (0.04, 0.02))
    assert fine.max() < 8e-3
    assert coarse.max() > 3.5 * fine.max()


def test_the_period_of_a_pendulum_is_that_of_the_elliptic_integral():
    """From 90 degrees, 2 K(1/2) sqrt(I / m g l) pass between two passages of the lowest point."""
    moment = 1.0 + 0.4 * 0.05**2
    exact, errors = 2.0 * ellipk(0.5) * np.sqrt(moment / G), []
    for dt in (0.04, 0.02):
        sim, passed, before = pendulum(dt), [], 1.0
        while len(passed) < 2:
            sim.step()
            x = sim.positions[0, 0]
            if x * before < 0.0:
                passed.append(sim.time - dt * x / (x - before))
            before = x
        errors.append(abs((passed[1] - passed[0]) / exact - 1.0))
    assert errors[1] < 2e-3
    assert errors[0] > 3.0 * errors[1]


def test_energy_of_a_double_pendulum_is_of_second_order():
    worst = []
    for dt in (0.02, 0.01):
        scene = Scene(friction=0.3)
        one, two = scene.add_spheres([[0.5, 0, 0], [1.0, 0, 0]], 0.05, 1000.0)
        scene.add_joint("pin", None, one, anchor=(0, 0, 0), axis=(0, 1, 0))
        scene.add_joint("elbow", one, two, anchor=(0.5, 0, 0), axis=(0, 1, 0))
        worst.append(np.abs(energies(simulation(scene, dt), 0.7)).max())
    assert worst[1] < 0.01
    assert worst[0] > 3.0 * worst[1]


def test_a_heavy_load_swings_on_a_light_chain():
    """Its five links, of a 4300th of the load, would swing at 2900 rad/s, 15 in a step."""
    radius, load, scene = 0.025, 0.15, Scene(friction=0.3)
    line, ends = np.array([np.sin(0.3), 0, -np.cos(0.3)]), 2.0 * radius * np.arange(6)[:, None]
    ids = [None, *scene.add_spheres((ends[:-1] + radius) * line, radius, 200.0)]
    ids += [*scene.add_spheres([(ends[-1] + load) * line], load, 4000.0)]
    for k, place in enumerate(ends):
        scene.add_joint(f"link {k}", ids[k], ids[k + 1], kind="ball", anchor=place * line)
    sim, energy, weight = simulation(scene, 0.005), [], 4000.0 * 4.0 / 3.0 * np.pi * load**3 * G
    before = sim.step()["potential_energy [J]"]
    for _ in range(40):
        figures = sim.step()
        after = figures["potential_energy [J]"]
        energy.append((figures["kinetic_energy [J]"] + 0.5 * (before + after)) / weight)
        before = after
        assert sim.joint("link 0").force[2] == pytest.approx(weight, rel=0.15)
    assert np.ptp(energy) < 2e-3 * (ends[-1, 0] + load) * (1.0 - np.cos(0.3))


@pytest.mark.parametrize("load", [10.0, 5e3])
def test_a_light_chain_that_swings_does_not_burst(load):
    """Of ten links of 7 g each, from the horizontal: the load falls on a circle, at any ratio of masses."""
    scene, upright, last = Scene(0.4), (0.5**0.5, 0, 0.5**0.5, 0), None
    places = [[0.1 * k + 0.05, 0, 0] for k in range(10)]
    links = [int(scene.add_capsules(at, 0.005, 0.04, 1000.0, quaternions=upright)[0]) for at in places]
    ball = scene.add_spheres([1.2, 0, 0], 0.2, load / (4 / 3 * np.pi * 0.2**3))
    for k, link in enumerate([*links, int(ball[0])]):
        scene.add_joint(f"pin {k}", last, link, kind="ball", anchor=(0.1 * k, 0, 0))
        last = link
    sim = pctt.Simulation(scene, dt=2.5e-3)
    sim.run(until=0.6)
    assert np.linalg.norm(sim.positions[-1]) == pytest.approx(1.2, rel=1e-3)
    assert sim.kinetic_energy == pytest.approx(-load * G * sim.positions[-1, 2], rel=0.03)
    assert np.abs(sim.local.velocity[:-1, 3:]).max() < 50.0


def test_a_slider_crank_moves_as_its_geometry_says():
    """Joints and motor have 21 rows for the 18 velocities of three bodies: some are redundant."""
    crank, rod = 0.3, 1.0
    scene = Scene(friction=0.3)
    one = scene.add_boxes([crank / 2, 0, 0], (crank / 2, 0.05, 0.05), 500.0)[0]
    two = scene.add_boxes([crank + rod / 2, 0.3, 0], (rod / 2, 0.05, 0.05), 500.0)[0]
    (three,) = scene.add_spheres([crank + rod, 0.6, 0], 0.05, 500.0)
    scene.add_joint("crank", None, one, anchor=(0, 0, 0), axis=(0, 1, 0), speed=3.0)
    scene.add_joint("knee", one, two, anchor=(crank, 0.15, 0), axis=(0, 1, 0))
    scene.add_joint("head", two, three, anchor=(crank + rod, 0.45, 0), axis=(0, 1, 0))
    scene.add_joint("bore", None, three, kind="slider", anchor=(crank + rod, 0.6, 0), axis=(1, 0, 0))
    sim = simulation(scene, 0.02)
    while sim.time < 1.2:
        sim.step()
        angle = 3.0 * sim.time
        exact = crank * np.cos(angle) + np.sqrt(rod**2 - (crank * np.sin(angle)) ** 2)
        assert sim.positions[2, 0] == pytest.approx(exact, abs=1e-7)


def test_a_hanging_chain_bears_its_weight():
    scene = Scene(friction=0.3)
    ids = scene.add_spheres([[0, 0, -0.3 * k] for k in range(1, 6)], 0.1, 1000.0)
    for k, one in enumerate([None, *ids[:-1]]):
        scene.add_joint(f"link {k}", one, ids[k], kind="ball", anchor=(0, 0, -0.3 * k - 0.15))
    sim = simulation(scene)
    sim.run(until=0.05)
    weight = sim.local.mass[0] * G
    for k in range(5):
        assert sim.joint(f"link {k}").force == pytest.approx([0, 0, (5 - k) * weight], abs=1e-6 * weight)


def test_a_fixed_joint_has_the_force_and_moment_of_its_cut():
    scene = Scene(friction=0.3)
    one, two = scene.add_boxes([[0.5, 0, 0], [1.6, 0, 0]], (0.5, 0.1, 0.1), 100.0)
    scene.add_joint("wall", None, one, kind="fixed", anchor=(0, 0, 0))
    scene.add_joint("cut", one, two, kind="fixed", anchor=(1.05, 0, 0))
    sim = simulation(scene)
    sim.run(until=0.1)
    weight = 4.0 * G
    assert sim.joint("cut").force == pytest.approx([0, 0, weight], abs=1e-6)
    assert sim.joint("cut").torque == pytest.approx([0, -0.55 * weight, 0], abs=1e-5)
    assert sim.joint("wall").torque == pytest.approx([0, -2.1 * weight, 0], abs=1e-5)
    assert sim.positions[1] == pytest.approx([1.6, 0, 0], abs=1e-7)


def wheel(**motor):
    scene = Scene(friction=0.3, gravity=(0, 0, 0))
    (ball,) = scene.add_spheres([0, 0, 0], 0.1, 1000.0)
    scene.add_joint("axle", None, ball, anchor=(0, 0, 0), **motor)
    return scene


def test_a_motor_keeps_its_speed_and_is_changed_within_the_loop():
    sim = simulation(wheel(speed=3.0), 0.01)
    sim.run(until=0.1)
    assert sim.joint("axle").speed == pytest.approx(3.0)
    assert sim.joint("axle").angle == pytest.approx(0.3)
    sim.change("joint axle", speed=-1.0)
    sim.run(until=0.2)
    assert sim.joint("axle").angle == pytest.approx(0.2)
    sim.change("joint axle", target=0.5)
    sim.step()
    assert sim.joint("axle").angle == pytest.approx(0.5)
    assert sim.joint("axle").motor.speed is None


@pytest.mark.parametrize(
    ("gravity", "strength", "seconds", "dt"),
    [(0.0, 200.0, 0.3, 0.004), (G, 25.0, 1.5, 0.01)],
)
def test_a_weak_motor_stops_at_its_target(gravity, strength, seconds, dt):
    """An arm of 1 m and 4 kg, which bears at most 19.6 N m by its weight, goes up to an angle without passing it."""
    scene = Scene(friction=0.0, gravity=(0, 0, -gravity))
    place, inertia = (0.5, 0, 1), (0.01, 0.33, 0.33)
    scene.add_body("arm", [Box((0.5, 0.03, 0.03))], Dynamic(), mass=4.0, inertia=inertia, position=place)
    scene.add_joint("pin", None, "arm", anchor=(0, 0, 1), axis=(0, -1, 0), target=1.0, strength=strength)
    sim, most = simulation(scene, dt), 0.0
    while sim.time < seconds:
        sim.step()
        most = max(most, sim.joint("pin").angle)
    assert most < 1.005
    sim.run(steps=20)
    assert sim.joint("pin").angle == pytest.approx(1.0, abs=1e-6)
    assert abs(sim.joint("pin").drive) == pytest.approx(4.0 * gravity * 0.5 * np.cos(1.0), abs=1e-4)


def test_a_weak_slider_stops_at_its_target_beside_its_limit():
    scene = Scene(friction=0.0, gravity=(0, 0, 0))
    scene.add_body("cart", [Box((0.1, 0.1, 0.1))], Dynamic(), mass=1.0, inertia=(0.1, 0.1, 0.1))
    scene.add_joint(
        "rail", None, "cart", kind="slider", anchor=(0, 0, 0), axis=(1, 0, 0), target=2.0, strength=5.0, limits=(-1, 1)
    )
    sim = simulation(scene, 0.02)
    sim.run(steps=50)
    assert sim.joint("rail").position == pytest.approx(1.0, abs=1e-6)
    sim.change("joint rail", target=-0.5)
    sim.run(steps=75)
    assert sim.joint("rail").position == pytest.approx(-0.5, abs=1e-6)


def test_a_linkage_passes_its_dead_points():
    """Two cranks of equal length and a coupler, which may tilt where the three are in line: the motor bears the weight
    of the three."""
    scene, length, start = Scene(friction=0.3), 0.3, 0.4
    up, turn = np.array([np.sin(start), 0, np.cos(start)]), (np.cos(start / 2), 0, np.sin(start / 2), 0)
    cranks = [length / 2 * up, [1, 0, 0] + length / 2 * up]
    scene.add_boxes(cranks, (0.02, 0.02, length / 2), 1000.0, quaternions=[turn, turn])
    scene.add_boxes([0.5, 0.05, 0] + length * up, (0.5, 0.02, 0.02), 1000.0)
    scene.add_joint("A", None, 0, anchor=(0, 0, 0), axis=(0, 1, 0), speed=3.0)
    scene.add_joint("B", None, 1, anchor=(1, 0, 0), axis=(0, 1, 0))
    scene.add_joint("C", 0, 2, anchor=length * up, axis=(0, 1, 0))
    scene.add_joint("D", 1, 2, anchor=[1, 0, 0] + length * up, axis=(0, 1, 0))
    sim, drives = pctt.Simulation(scene, dt=0.009), []
    while sim.time < 1.5:  # over both of them
        sim.step()
        drives.append(abs(sim.joint("A").drive))
        assert abs(sim.orientations[2][2]) < 1e-4  # the coupler stays level
    assert max(drives[3:]) == pytest.approx(G * length * (0.48 + 1.6), rel=0.01)


def test_a_ball_without_weight_is_held_from_the_first_step_on():
    """It goes about a ball joint at its surface with nothing that pushes at the start."""
    scene = Scene(friction=0.3, gravity=(0, 0, 0))
    (ball,) = scene.add_spheres([0.05, 0, 0], 0.05, 1000.0, velocity=(0, 3.0, 0), angular_velocity=(0, 0, 60.0))
    scene.add_joint("pin", None, ball, kind="ball", anchor=(0, 0, 0))
    sim = simulation(scene, 0.002)
    sim.run(steps=3)
    assert np.linalg.norm(sim.positions[0]) == pytest.approx(0.05, rel=1e-6)


def test_a_spinning_ball_on_a_joint_nods_as_deep_as_it_should():
    """The default step resolves the spin of a sphere that is held beside its centre. At the lowest point of its arm,
    with the moments A about the joint and C about the arm, sin / cos^2 = 2 A m g r / (C w)^2 (energy and momentum)."""
    scene, r, spin = Scene(0.3), 0.05, 200.0
    (ball,) = scene.add_spheres([r, 0, 0], r, 1000.0, angular_velocity=(spin, 0, 0))
    scene.add_joint("pin", None, ball, kind="ball", anchor=(0, 0, 0))
    with pctt.Simulation(scene) as sim:
        depth = []
        sim.run(until=30.0 / spin, call=lambda sim: depth.append(-sim.positions[0, 2] / r))
        assert sim.settings.dt * spin <= 0.2 + 1e-9
    x = 2 * 1.4 * r**2 * G * r / (0.4 * r**2 * spin) ** 2
    assert max(depth) == pytest.approx((np.sqrt(1 + 4 * x**2) - 1) / (2 * x), rel=2e-3)


def test_a_weak_motor_stalls_at_its_torque_and_its_work_is_in_the_balance():
    sim = simulation(wheel(speed=100.0, strength=0.2))
    moment = sim.local.inertia[0, 0]
    figures = sim.step()
    assert sim.joint("axle").drive == pytest.approx(0.2)
    assert sim.joint("axle").speed == pytest.approx(0.2 * 0.002 / moment)
    assert figures["work_of_motions [J]"] == pytest.approx(figures["kinetic_energy [J]"])


@pytest.mark.parametrize("strength", [np.inf, 5.0])
def test_a_motor_stops_at_its_limit(strength):
    sim = simulation(wheel(speed=3.0, strength=strength, limits=(-1.0, 0.1)), dt=0.01)
    for step in range(1, 8):
        sim.step()
        assert sim.joint("axle").angle == pytest.approx(min(0.03 * step, 0.1), rel=1e-2)
        assert sim.joint("axle").angle < 0.1 + 1e-9
    assert sim.joint("axle").angle == pytest.approx(0.1, rel=1e-9)
    assert sim.joint("axle").drive == pytest.approx(0.0, abs=1e-9)


def test_a_slider_stops_at_its_limit():
    scene = Scene(friction=0.3)
    (ball,) = scene.add_spheres([0, 0, 1], 0.1, 1000.0)
    scene.add_joint("rod", None, ball, kind="slider", anchor=(0, 0, 1), axis=(0, 0, 1), limits=(-0.2, 1.0))
    sim = simulation(scene, 0.005)
    sim.run(until=0.3)
    assert sim.joint("rod").position == pytest.approx(-0.2, abs=1e-9)
    assert sim.joint("rod").drive == pytest.approx(sim.local.mass[0] * G)


def test_a_hinge_rests_at_its_limit():
    scene = Scene(friction=0.3)
    (ball,) = scene.add_spheres([1, 0, 0], 0.05, 1000.0)
    scene.add_joint("pin", None, ball, anchor=(0, 0, 0), axis=(0, 1, 0), limits=(-1.0, 0.5))
    sim = simulation(scene, 0.01)
    while sim.time < 0.6:
        sim.step()
        assert sim.joint("pin").angle < 0.5 + 1e-9
    assert sim.joint("pin").angle == pytest.approx(0.5, abs=1e-9)
    assert sim.joint("pin").drive == pytest.approx(-sim.local.mass[0] * G * np.cos(0.5), rel=1e-4)


def test_a_limit_holds_against_what_contacts_push():
    """A heavy wall runs into a ball, which would pass its limit within the same step."""
    scene = Scene(friction=0.0, gravity=(0, 0, 0))
    given = {"position": (-0.21, 0, 0), "mass": 50.0, "inertia": (1, 1, 1), "velocity": (2.0, 0, 0)}
    scene.add_body("wall", [Box((0.1, 1, 1))], Dynamic(), **given)
    (ball,) = scene.add_spheres([0, 0, 0], 0.1, 1000.0)
    scene.add_joint("rail", None, ball, kind="slider", anchor=(0, 0, 0), axis=(1, 0, 0), limits=(-0.1, 0.02))
    sim, pushes = simulation(scene, 0.02), []
    for _ in range(5):
        sim.step()
        assert sim.joint("rail").position < 0.02 + 1e-9
        pushes.append(sim.joint("rail").drive)
    assert max(pushes) < 1e-6  # it pushes back, and pulls never
    assert min(pushes) < -1000.0
    assert pushes[-1] == 0.0  # the wall has gone


def test_a_motor_that_runs_into_a_stop_pushes_with_its_bound():
    scene = Scene(friction=0.0, gravity=(0, 0, 0))
    scene.add_body("stop", [Box((0.1, 0.1, 0.1))], position=(0.8, 0.16, 0))
    scene.add_body("arm", [Box((0.5, 0.05, 0.05))], Dynamic(), position=(0.5, 0, 0), mass=3.0, inertia=(1, 1, 1))
    scene.add_joint("pin", None, "arm", anchor=(0, 0, 0), axis=(0, 0, 1), speed=1.0, strength=2000.0)
    sim = simulation(scene, 0.002, stiffness=np.inf)
    sim.step()
    for _ in range(20):
        assert sim.step()["energy_jump [J]"] == 0.0
        assert abs(sim.joint("pin").drive) <= 2000.0 * (1.0 + 1e-3)
    assert sim.joint("pin").drive == pytest.approx(2000.0, rel=1e-3)
    assert sim.joint("pin").speed == pytest.approx(0.0, abs=1e-6)
    assert sim.body("stop").torque + np.cross([0.8, 0.16, 0], sim.body("stop").force) == pytest.approx(
        [0, 0, 2000.0], rel=1e-3, abs=1.0
    )


@pytest.mark.parallel(1, 2)
def test_a_mechanism_of_large_bodies_alone(tmp_path):
    """A boom falls on a post; time step, contact distance and stiffness are those that the scene needs."""
    scene = Scene(friction=0.0)
    scene.add_body("post", [Box((0.05, 0.05, 0.05))], position=(0.8, 0, -0.35))
    boom = {"mass": 4.0, "inertia": (0.01, 0.33, 0.33)}
    scene.add_body("boom", [Box((0.5, 0.03, 0.03))], Dynamic(), position=(0.5, 0, 0), **boom)
    scene.add_joint("pin", None, "boom", anchor=(0, 0, 0), axis=(0, 1, 0))
    with pctt.Simulation(scene, tol=1e-8, comm=MPI.COMM_WORLD, say=lambda text: None) as sim:
        assert sim.settings.delta == pytest.approx(0.03 / 20)
        sim.write(tmp_path / "out", every=0, checkpoint_every=100)
        sim.run(until=0.3)
        at = sim.joint("pin").angle
        # an edge of the post touches the lower side of the boom
        assert 0.85 * np.sin(at) - 0.3 * np.cos(at) == pytest.approx(-0.03, abs=1e-3)
        push = sim.body("post").force
        assert np.cross([0.85, 0, -0.3], -push)[1] == pytest.approx(-4.0 * G * 0.5 * np.cos(at), rel=1e-2)
        assert Folder(tmp_path / "out").summary["worst_overlap"]["smallest_radius [m]"] == 0.03


def test_friction_of_jointed_bodies_that_slide_is_coulombs():
    """Two spheres that a fixed joint keeps from rolling slide with the deceleration mu g."""
    scene = Scene(friction=0.3)
    scene.add_body("floor", [Plane((0, 0, 1))])
    one, two = scene.add_spheres([[0, 0, 0.1], [0.5, 0, 0.1]], 0.1, 1000.0, velocity=(1.0, 0, 0))
    scene.add_joint("bar", one, two, kind="fixed", anchor=(0.25, 0, 0.1))
    sim = simulation(scene, 0.005)
    sim.run(until=0.2)
    assert sim.velocities[:, 0] == pytest.approx([1.0 - 0.3 * G * 0.2] * 2, rel=1e-4)
    weight = 2.0 * sim.local.mass[0] * G
    assert sim.body("floor").force == pytest.approx([0.3 * weight, 0, -weight], rel=1e-4, abs=1e-3)
    sim.run(until=0.5)
    assert sim.velocities == pytest.approx(np.zeros((2, 6)), abs=1e-5)


@pytest.mark.parametrize("solver", ccp.SOLVERS)
def test_contacts_and_joints_are_solved_together(solver):
    """A lever that is hinged at one end lies with the other on the floor, which bears half of its weight."""
    scene = Scene(friction=0.0)
    scene.add_body("floor", [Plane((0, 0, 1))])
    (ball,) = scene.add_spheres([1, 0, 0.1], 0.1, 1000.0)
    scene.add_body("bar", [Box((0.4, 0.05, 0.05))], Dynamic(), position=(0.45, 0, 0.2), mass=8.0, inertia=(1, 1, 1))
    scene.add_joint("pin", None, "bar", anchor=(0, 0, 0.2), axis=(0, 1, 0))
    scene.add_joint("foot", "bar", ball, kind="fixed", anchor=(0.9, 0, 0.2))
    sim = simulation(scene, solver=solver, stiffness=np.inf)
    for _ in range(10):
        assert sim.step()["converged"]
    bears = (8.0 * 0.45 + sim.local.mass[0]) * G  # about the hinge, the arm of the floor is 1 m
    assert -sim.body("floor").force[2] == pytest.approx(bears, rel=1e-4)


def test_a_cart_whose_wheels_resist_rolling_comes_to_rest():
    """Of two wheels of mass m and a bar of mass M, with N on both together, v' (2 m + M + 2 I / R^2) = -rho N / R."""
    R, rho, M, v, dt = 0.1, 0.004, 8.0, 0.2, 0.01
    scene = Scene(0.6, rolling=rho)
    scene.add_body("floor", [Plane((0, 0, 1))])
    given = {"mass": M, "inertia": (1, 1, 1), "velocity": (v, 0, 0)}
    scene.add_body("bar", [Box((0.05, 0.02, 0.02))], Dynamic(), position=(0, 0, R), **given)
    turning = {"velocity": (v, 0, 0), "angular_velocity": (0, v / R, 0)}
    wheels = scene.add_spheres([[-0.3, 0, R], [0.3, 0, R]], R, 1000.0, **turning)
    for x, wheel in zip((-0.3, 0.3), wheels):
        scene.add_joint(f"axle {x}", "bar", wheel, anchor=(x, 0, R), axis=(0, 1, 0))
    sim = simulation(scene, dt, stiffness=np.inf)
    m = sim.local.mass[0]
    slower = rho * (2 * m + M) * G / R / (2 * m + M + 2 * 0.4 * m)
    sim.run(steps=10)
    assert sim.body("bar").velocity[0] == pytest.approx(v - slower * sim.time, rel=1e-5)
    force = sim.joint("axle 0.3").force  # on the wheel: it brings the wheel and half of the bar to rest
    assert force == pytest.approx([-0.5 * M * -slower, 0, -0.5 * M * G], rel=1e-4, abs=1e-4)
    sim.run(until=1.1 * v / slower)
    assert abs(sim.body("bar").velocity).max() < 1e-5


def test_a_joint_goes_through_the_boundary_of_a_periodic_cell():
    """A dumbbell that flies and turns, with periods and without; begun across the boundary, too."""
    runs = []
    for period, place in ((None, 0.0), ((1.0, 1.0, None), 0.0), ((1.0, 1.0, None), 0.45)):
        scene = Scene(friction=0.3, gravity=(0, 0, 0), period=period)
        begin = np.array([[0.4, 0.5, 0.0], [0.6, 0.5, 0.0]]) + [place, 0, 0]
        inside = begin if period is None else begin % 1.0 * [1, 1, 0]
        velocity = [[1.0, 0.4, 0], [1.0, 0.8, 0]]
        one, two = scene.add_spheres(inside, 0.08, 1000.0, velocity=velocity)
        scene.add_joint("bar", one, two, kind="fixed", anchor=(0.5 + place, 0.5, 0))
        sim = simulation(scene, 0.02)
        sim.run(until=0.9)
        runs.append((sim.velocities, sim.positions - begin, sim.joint("bar").force))
    for velocity, way, force in runs[1:]:
        assert velocity == pytest.approx(runs[0][0], abs=1e-9)
        off = way - runs[0][1]
        assert off == pytest.approx(np.round(off), abs=1e-9)
        assert force == pytest.approx(runs[0][2], abs=1e-6)


def test_joints_are_refused_in_cells_that_are_sheared():
    scene = Scene(friction=0.3, period=(1.0, 1.0, 1.0), shear_rate=0.1)
    one, two = scene.add_spheres([[0.3, 0.5, 0.5], [0.6, 0.5, 0.5]], 0.1, 1000.0)
    scene.add_joint("bar", one, two, kind="fixed", anchor=(0.45, 0.5, 0.5))
    with pytest.raises(ValueError, match="joint 'bar': a sheared cell has no joints"):
        simulation(scene)


def test_a_motor_presses_a_head_on_the_floor_with_the_force_of_the_closed_form():
    """The boom of docs/loads.md is lowered until its head rests on the floor: forces are those of the closed form, and
    nothing overlaps or leaves its hinge by more than a part of what one step goes."""
    scene = Scene(friction=0.0)
    scene.add_body("floor", [Plane((0, 0, 1), (0, 0, 0.8))])
    boom = {"mass": 4.0, "inertia": (0.01, 0.33, 0.33)}
    scene.add_body("boom", [Box((0.5, 0.03, 0.03))], Dynamic(), position=(0.5, 0, 1), **boom)
    (head,) = scene.add_spheres([1.15, 0, 1], 0.1, 1000.0)
    hinge = {"anchor": (0, 0, 1), "axis": (0, 1, 0)}
    scene.add_joint("shoulder", None, "boom", **hinge, speed=0.2, strength=100.0, limits=(-0.3, 1.0))
    scene.add_joint("weld", "boom", head, kind="fixed", anchor=(1, 0, 1))
    sim = simulation(scene, 0.01, stiffness=np.inf)
    mass = sim.local.mass[0]
    angle = np.arcsin(0.1 / 1.15)
    while sim.time < 0.6:
        sim.step()
        assert sim.positions[0, 2] > 0.9 - 1e-6  # of the head: it touches, and stays above the floor
        assert sim.joint("shoulder").angle < angle + 1e-6
    moment = (4.0 * 0.5 + mass * 1.15) * G * np.cos(angle)
    bears = (100.0 + moment) / (1.15 * np.cos(angle))
    assert -sim.body("floor").force[2] == pytest.approx(bears, rel=2e-3)
    sim.change("joint shoulder", speed=-0.8)
    sim.run(until=1.2)
    assert sim.joint("shoulder").angle == pytest.approx(-0.3, abs=1e-9)


@pytest.mark.parallel(1, 2, 3)
@pytest.mark.parametrize("rolling", [0.0, 0.01])
def test_rows_of_the_map_are_those_of_its_products(rolling):
    """Of a chain, a pair, and a body that the world holds, among grains that no joint joins."""
    comm = MPI.COMM_WORLD
    scene = Scene(0.5, rolling=rolling)
    scene.add_body("floor", [Plane((0, 0, 1))])
    scene.add_body("lid", [Box((0.4, 0.4, 0.05))], Dynamic(), position=(0.3, 0.3, 0.25), density=500.0)
    grid = np.stack(np.meshgrid(*[0.2 * np.arange(4)] * 2, [0.1], indexing="ij"), axis=-1).reshape(-1, 3)
    grains = scene.add_spheres(grid, 0.1, 1000.0, velocity=(0.3, 0.1, -0.4))
    for k, (one, other) in enumerate([(0, 5), (5, 6), (6, 15), (2, 3), (None, 12), ("lid", 9)]):
        ends = [one if one in (None, "lid") else grains[one], grains[other]]
        scene.add_joint(f"joint {k}", *ends, kind="hinge", anchor=grid[other] + [0.05, 0.1, 0], axis=(0, 1, k))
    sim = pctt.Simulation(scene, comm=comm, dt=0.005, say=lambda text: None)
    sim.step()
    G, random = sim.last.system.problem_map, np.random.default_rng(comm.rank)
    assert comm.allreduce(len(sim.last.system.key)) > 30
    rows = BlockMap(comm, G.block_rows)
    v, g = random.normal(size=(G.columns, 6)), random.normal(size=(G.rows, 3))
    np.testing.assert_allclose(rows.velocities(v), G.velocities(v), atol=1e-12)
    np.testing.assert_allclose(rows.momenta(g), G.momenta(g), atol=1e-12)
    y, image, expected = np.zeros_like(g), G.image(), G.velocities(G.momenta(g))
    G.add_delassus(g, y)
    np.testing.assert_allclose(y, expected, atol=1e-12)
    G.find_image(g, image)
    G.find_velocities(image, np.zeros_like(image), -0.5, np.zeros_like(y), y)
    np.testing.assert_allclose(2.0 * y, expected, atol=1e-12)
    energy = comm.allreduce(G.energy_of_step(image, *np.zeros((2, *image.shape)), 0.0))
    assert energy == pytest.approx(comm.allreduce(float(np.vdot(g, expected))), rel=1e-12)
    away = comm.allreduce(int((np.diff(G.block_rows.indptr) <= 2).sum()))
    assert away > 0  # contacts that see no joint have the blocks of their two bodies


def test_much_friction_of_jointed_boxes_is_solved_by_interior_points():
    """Boxes that the world holds in a corner fall on each other: first-order methods circle about Coulomb's law."""
    scene = Scene(3.0)
    scene.add_body("walls", [Plane((0, 0, 1)), Plane((1, 0, 0)), Plane((0, 1, 0))])
    turned = np.random.default_rng(1).normal(size=(8, 4))
    turned /= np.linalg.norm(turned, axis=1, keepdims=True)
    places = 0.15 + 0.29 * np.indices((2, 2, 2)).reshape(3, -1).T
    boxes = scene.add_boxes(places, (0.1, 0.06, 0.08), 1000.0, quaternions=turned, velocity=(-1.0, -2.0, -1.0))
    scene.add_joint("pin", None, boxes[0], kind="ball", anchor=(0.3, 0.1, 0.3))
    scene.add_joint("rod", boxes[3], boxes[6], kind="fixed", anchor=(0.3, 0.3, 0.3))
    sim = pctt.Simulation(scene, dt=0.01, comm=MPI.COMM_SELF, say=lambda text: None)
    newton = iterations = 0
    for _ in range(40):
        figures = sim.step()
        assert figures["converged"], figures["reason"]
        newton, iterations = newton + figures["newton_its"], iterations + figures["iterations"]
    assert newton > 0
    assert iterations < 20_000  # 4,000 to 6,000, of which one step may take half; first-order methods 27,000 in one


def test_a_body_that_is_squeezed_against_its_joint_has_no_solution():
    """A wall runs into a box that a slider holds: no impulse of a rigid contact stops the wall."""
    for motion, ends in ((Glide((0.5, 0, 0)), True), (Glide((0, 0, 0.5)), False)):
        scene = Scene(friction=0.0, gravity=(0, 0, 0))
        scene.add_body("wall", [Box((0.1, 1, 1))], motion, position=(-0.101, 0, 0))
        (box,) = scene.add_boxes([0.1, 0, 0], (0.1, 0.1, 0.1), 1000.0)
        scene.add_joint("rail", None, box, kind="slider", anchor=(0.1, 0, 0), axis=(0, 0, 1))
        sim = simulation(scene, dt=0.01, stiffness=np.inf, max_it=2000)
        if ends:
            with pytest.raises(NoSolutionError, match="unbounded"):
                sim.run(steps=2)
        else:
            sim.run(steps=2)


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"kind": "rope"}, "kind of a joint"),
        ({"speed": -1.0, "target": 1.0}, "speed of a motor with a target, -1: allowed is the greatest, above zero"),
        ({"kind": "ball", "speed": 1.0}, "no motor"),
        ({"limits": (1.0, 0.0)}, "limits"),
        ({"kind": "fixed", "axis": (0, 1, 0)}, "axes of 'axle': got 1, allowed are 0 of a fixed joint"),
        ({"kind": "universal"}, "axes of 'axle': got 0, allowed are 2 of a universal joint"),
        ({"strength": -1.0}, "strength"),
        ({"target": 4.0}, "target of a hinge, 4 rad: allowed are angles from -pi to pi"),
        ({"limits": (-1.0, 3.2)}, "high of a hinge, 3.2 rad"),
        ({"limits": (-4.0, 1.0), "speed": 1.0}, "low of a hinge, -4 rad"),
        ({"kind": "ball", "strength": 5.0}, "a ball joint has no motor and no limits"),
        ({"limits": (0.5, 1.0)}, "limits of 'axle', 0.5 to 1: allowed are those about 0, where it is at time zero"),
    ],
)
def test_wrong_joints_are_refused(given, words):
    with pytest.raises(ValueError, match=words):
        wheel(**given)


def pusher():
    """An arm whose motor pushes through a row of spheres."""
    scene = Scene(friction=0.3)
    scene.add_body("floor", [Plane((0, 0, 1))])
    scene.add_spheres([[0.5 + 0.21 * k, 0.3, 0.1] for k in range(4)], 0.1, 1000.0)
    scene.add_body("arm", [Box((0.6, 0.05, 0.05))], Dynamic(), position=(0.6, 0, 0.15), mass=5.0, inertia=(1, 1, 1))
    scene.add_joint("pin", None, "arm", anchor=(0, 0, 0.15), axis=(0, 0, 1), speed=1.0, strength=200.0)
    return scene


def test_a_restart_goes_on_with_the_same_bits(tmp_path):
    sim = simulation(pusher(), dt=0.01)
    sim.run(steps=15)
    sim.change("joint pin", speed=0.5)
    sim.save(tmp_path / "state.h5")
    sim.run(steps=8)
    again = pctt.Simulation.load(tmp_path / "state.h5", pusher(), dt=0.01, tol=1e-9, comm=MPI.COMM_SELF)
    again.run(steps=8)
    assert np.array_equal(again.positions, sim.positions)
    assert again.joint("pin").angle == sim.joint("pin").angle
    assert sim.joint("pin").speed == pytest.approx(0.5, rel=1e-2)


@pytest.mark.parallel(2)
def test_joints_do_not_depend_on_the_ranks():
    alone = simulation(pusher(), dt=0.01)
    sim = pctt.Simulation(pusher(), dt=0.01, tol=1e-9, comm=MPI.COMM_WORLD)
    for each in (alone, sim):
        each.run(steps=10)
    assert sim.positions == pytest.approx(alone.positions, abs=1e-6)
    assert sim.joint("pin").force == pytest.approx(alone.joint("pin").force, abs=1e-2)


@pytest.mark.parallel(1, 2)
def test_a_flap_swings_as_ever_while_grains_come_and_go_elsewhere():
    """Large bodies have other numbers in scenes with sources."""
    angles = []
    for more in (False, True):
        scene = Scene(friction=0.3)
        scene.add_spheres([5, 0, 0], 0.05, 1000.0)
        scene.add_body("flap", [Box((0.2, 0.2, 0.02))], Dynamic(), position=(0.25, 0, 0), density=800.0)
        scene.add_joint("hinge", None, "flap", kind="hinge", anchor=(0, 0, 0), axis=(0, 1, 0))
        if more:
            region = Block((4, 4, 4), (5, 5, 5))
            scene.add_source("rain", region, radius=0.05, density=1000.0, number_rate=100.0)
            scene.add_outlet("drain", Block((4, 4, 0), (5, 5, 4.2)))
        sim = pctt.Simulation(scene, dt=0.01, delta=0.01, tol=1e-9, comm=MPI.COMM_WORLD)
        sim.run(until=0.25)
        angles.append(sim.joint("hinge").angle)
    assert sim.outlet("drain").count > 0
    assert abs(angles[0]) > 0.5
    assert angles[1] == pytest.approx(angles[0], abs=1e-9)


def test_a_joint_of_bodies_that_no_force_moves_is_refused():
    """It would hold nothing, and its motor would turn nothing."""
    scene = Scene(friction=0.3)
    scene.add_spheres([5, 0, 0], 0.05, 1000.0)
    scene.add_body("sled", [Box((0.1, 0.1, 0.1))], Glide((1, 0, 0)))
    scene.add_joint("pin", None, "sled", anchor=(0, 0, 0), axis=(0, 1, 0), target=1.0)
    words = "joint 'pin': the motions of the world and 'sled' are prescribed, so it holds nothing; allowed is one body"
    with pytest.raises(OptionError, match=words):
        simulation(scene)


@pytest.mark.parametrize("strength", [np.inf, 100.0])
def test_a_motor_goes_to_its_target_at_its_greatest_speed(strength):
    """Another target keeps that speed; a speed alone is kept, and a target alone after it has none."""
    sim = simulation(wheel(target=0.5, speed=2.0, strength=strength), dt=0.01)
    axle = sim.joint("axle")
    sim.run(until=0.2)
    assert (axle.speed, axle.angle) == pytest.approx((2.0, 0.4), rel=2e-2)
    sim.run(until=0.5)
    assert (axle.speed, axle.angle) == pytest.approx((0.0, 0.5), abs=1e-6)
    sim.change("joint axle", target=-0.5)
    sim.run(steps=20)
    assert (axle.speed, axle.angle) == pytest.approx((-2.0, 0.1), rel=2e-2)
    sim.change("joint axle", speed=4.0, target=-0.5)
    sim.run(steps=10)
    assert axle.speed == pytest.approx(-4.0, rel=2e-2)
    sim.change("joint axle", speed=-1.0)
    assert axle.motor.target is None
    sim.change("joint axle", target=0.0)
    assert axle.motor.speed is None


@pytest.mark.parallel(1, 2)
@pytest.mark.parametrize(("motion", "words"), [
    (Held((0.5, 0, None), (0, 0, 0)), "joint 'pin' does not hold, its sides are 0.045 m apart: its bodies are held"),
    (Held((0, 0, None), (0, 1.9, 0)), "joint 'pin' does not hold, its sides are 0.17 rad apart"),
    (Held((None, 0, None), (0, 0, 0)), ""),
])  # fmt: skip
def test_a_joint_that_cannot_hold_is_told_once(motion, words):
    """No force of a joint moves what a motion holds; it is looked at after nine steps."""
    scene = Scene(friction=0.3)
    scene.add_spheres([5, 0, 0], 0.09, 1000.0)
    scene.add_body("axle", [Box((0.1, 0.1, 0.1))], motion, mass=1.0)
    scene.add_joint("pin", None, "axle", kind="fixed", anchor=(0, 0, 0))
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always", UserWarning)
        sim = pctt.Simulation(scene, dt=0.01, delta=0.01, comm=MPI.COMM_WORLD)
        sim.run(steps=20)
    found = [str(each.message) for each in told if "does not hold" in str(each.message)]
    assert len(found) == bool(words and sim.comm.rank == 0)
    assert all(each.startswith(words) for each in found)


def test_a_joint_of_a_grain_is_refused_beside_an_outlet():
    scene = Scene(friction=0.3)
    (ball,) = scene.add_spheres([1, 0, 0], 0.05, 1000.0)
    scene.add_joint("pin", None, ball, kind="ball", anchor=(0, 0, 0))
    scene.add_outlet("drain", Block((4, 4, 0), (5, 5, 3.9)))
    with pytest.raises(OptionError, match="joint 'pin' holds a grain"):
        simulation(scene)


@pytest.mark.parametrize("touching", [False, True])
def test_joined_bodies_touch_each_other_only_if_asked(touching):
    """A slider draws two spheres together: they go through each other, or stop where they touch."""
    scene = Scene(friction=0.5, gravity=(0, 0, 0))
    one, two = scene.add_spheres([[0, 0, 0], [0.25, 0, 0]], 0.1, 1000.0)
    motor = {"speed": -1.0, "strength": 1000.0, "touching": touching}
    scene.add_joint("rail", one, two, kind="slider", anchor=(0, 0, 0), axis=(1, 0, 0), **motor)
    sim = pctt.Simulation(scene, dt=0.005, solver="apgd", tol=1e-6, comm=MPI.COMM_SELF)
    sim.run(steps=20)
    gap = np.linalg.norm(sim.positions[1] - sim.positions[0])
    assert gap == pytest.approx(0.2 if touching else 0.15, abs=2e-3)


def test_no_shape_of_a_joined_body_touches_the_other_body():
    """Bodies of several shapes are as many pairs of shapes."""
    scene = Scene(friction=0.5, gravity=(0, 0, 0))
    bars = [Box((0.1, 0.1, 0.1), center=(0, 0, z)) for z in (0.0, 0.15, 0.3)]
    for name, x in (("one", 0.0), ("other", 0.15)):
        scene.add_body(name, bars, Dynamic(), position=(x, 0, 0), mass=1.0, inertia=(0.1, 0.1, 0.1))
    scene.add_joint("weld", "one", "other", kind="fixed", anchor=(0.1, 0, 0))
    sim = pctt.Simulation(scene, dt=0.005, solver="apgd", tol=1e-6, comm=MPI.COMM_SELF)
    sim.run(steps=2)
    assert len(sim.last.contacts) == 0


def shafts(bend, moment, torque=0.0):
    """A motor turns the first of two shafts of a moment of inertia with 2 rad/s, and a torque brakes the second one,
    whose axis is bent by an angle; both, and these axes."""
    one, two = np.array([0.0, 0.0, 1.0]), np.array([np.sin(bend), 0.0, np.cos(bend)])
    scene = Scene(friction=0.3, gravity=(0, 0, 0))
    shaft = {"mass": 1.0, "inertia": (moment,) * 3}
    scene.add_body("in", [Box((0.05, 0.05, 0.2))], Dynamic(), position=-0.5 * one, **shaft)
    scene.add_body("out", [Box((0.05, 0.05, 0.2))], Dynamic(), position=0.5 * two, **shaft)
    scene.add_joint("motor", None, "in", anchor=-0.5 * one, axis=one, speed=2.0)
    scene.add_joint("bearing", None, "out", anchor=0.5 * two, axis=two)
    pins = [(0, 1, 0), np.cross(two, (0, 1, 0))]
    scene.add_joint("cross", "in", "out", kind="universal", anchor=(0, 0, 0), axis=pins)
    scene.add_load("brake", on="out", torque=-torque * two)
    return simulation(scene, 0.01)


def test_a_universal_joint_turns_shafts_as_cardan_says():
    """tan(out) = tan(in) cos(bend) and M_in d in = M_out d out, of shafts without inertia."""
    bend, angles = 1.1, []
    sim = shafts(bend, 1e-5, torque=3.0)
    sim.run(until=0.9, every=10, call=lambda sim: angles.append([sim.joint(x).angle for x in ("motor", "bearing")]))
    a, b = np.transpose(angles)
    np.testing.assert_allclose(np.cos(a) * np.sin(b), np.sin(a) * np.cos(bend) * np.cos(b), atol=1e-7)
    assert np.all(np.cos(a - b) > 0.0)
    assert np.ptp(a) > 1.5
    begin = a[-1] - 0.01 * 2.0  # of the last step, whose forces are those of its start
    slope = np.cos(bend) / (1.0 - (np.sin(begin) * np.sin(bend)) ** 2)
    assert sim.joint("motor").drive == pytest.approx(3.0 * slope, rel=1e-3)


def test_a_motor_pays_for_what_comes_out_of_a_universal_joint():
    sim = shafts(0.7, 0.02, torque=1.5)
    work = []
    sim.step()
    energy, angle = sim.kinetic_energy, sim.joint("bearing").angle
    sim.run(until=0.4, call=lambda sim: work.append(sim.joint("motor").drive * 2.0 * sim.settings.dt))
    left = sim.kinetic_energy - energy + 1.5 * (sim.joint("bearing").angle - angle)
    assert left > 0.7
    assert sum(work) == pytest.approx(left, rel=0.01)


@pytest.mark.parametrize(("spin", "angles"), [((0, 3, 0), (0.6, 0)), ((1.5, 0, 0), (0, 0.3)), ((0, 0, 2), (0, 0))])
def test_a_universal_joint_leaves_the_turns_about_its_axes(spin, angles):
    scene = Scene(friction=0.3, gravity=(0, 0, 0))
    motion = {"mass": 1.0, "inertia": (0.1, 0.1, 0.1), "angular_velocity": spin}
    scene.add_body("bob", [Box((0.1, 0.1, 0.1))], Dynamic(), **motion)
    scene.add_joint("cross", None, "bob", kind="universal", anchor=(0, 0, 0), axis=[(0, 2, 0), (1, 0, 0)])
    sim = simulation(scene, 0.01)
    sim.run(until=0.2)
    np.testing.assert_allclose(sim.joint("cross").angles, angles, atol=1e-7)


@pytest.mark.parametrize(("kind", "axis", "words"), [
    ("universal", (0, 0, 1), "axes of 'j': got 1, allowed are 2 of a universal joint"),
    ("hinge", [(0, 0, 1), (1, 0, 0)], "axes of 'j': got 2, allowed are 1 of a hinge joint"),
    ("universal", [(0, 0, 1), (1, 0, 1)], "axes of 'j': allowed are perpendicular ones"),
    ("universal", [(0, 0, 1), (0, 0, 0)], "axis of 'j' is the zero vector"),
    ("cardan", (0, 0, 1), "kind of a joint 'cardan': allowed are hinge, .*, universal"),
])  # fmt: skip
def test_axes_that_a_joint_cannot_have(kind, axis, words):
    scene = Scene(friction=0.3)
    scene.add_spheres([0, 0, 0], 0.1, 1000.0)
    with pytest.raises(ValueError, match=words):
        scene.add_joint("j", None, 0, kind=kind, anchor=(0, 0, 0), axis=axis)


def test_products_of_the_rows_of_constraints_leave_out_zeros_alone():
    rng = np.random.default_rng(0)
    body, along = rng.integers(0, 7, (12, 2)), rng.normal(size=(12, 2, 6))
    root = rng.normal(size=(7, 6, 6))
    J, B = constraints.rows_of_conditions(along, body, root)
    dense = np.zeros((12, 7, 6))
    for side in (0, 1):
        dense[np.arange(12), body[:, side]] += along[:, side]
    np.testing.assert_allclose(J, dense.reshape(12, -1))
    np.testing.assert_allclose(B, np.einsum("kni,nij->knj", dense, root).reshape(12, -1), atol=1e-12)
    S = rng.normal(size=(12, 12))
    np.testing.assert_allclose(constraints.gram(B), B @ B.T, atol=1e-11)
    np.testing.assert_allclose(constraints.between(B, S), B.T @ S @ B, atol=1e-10)


def test_rows_that_depend_on_others_have_the_pseudo_inverse():
    """Those of a closed chain do; rows of very different sizes do not."""
    rows = np.random.default_rng(1).normal(size=(9, 24))
    size, here = np.geomspace(1.0, 1e6, 9), np.delete(np.arange(9), 4)
    B = size[:, None] * rows
    inverse = constraints._inverse(B @ B.T, np.arange(9) != 4)
    assert not inverse[4].any()
    scaled = (size[:, None] * inverse * size)[np.ix_(here, here)]
    np.testing.assert_allclose(scaled @ rows[here] @ rows[here].T, np.eye(8), atol=1e-9)
    closed = np.concatenate([rows, rows[:1] + rows[1:2]])
    found = constraints._inverse(closed @ closed.T, np.ones(10, bool))
    np.testing.assert_allclose(found, np.linalg.pinv(closed @ closed.T, rcond=1e-10, hermitian=True), atol=1e-9)
