"""Impacts of rigid spheres: speed and spin by Walton's closed form, wherever in a step the two touch; and in a row."""

from __future__ import annotations

import numpy as np
import pytest
from mpi4py import MPI

import pctt
from dem.motion import Rotation
from dem.scene import Scene
from dem.shapes import Box, Capsule, Cylinder, Mesh, Plane, Sphere, Superellipsoid

R, DENSITY = 0.01, 2500.0
EXACT = {"tol": 1e-9, "closing_work": np.inf, "delta": 0.05 * R}
FLOORS = {
    "plane": Plane((0, 0, 1)),
    "box": Box((1, 1, 0.5), center=(0, 0, -0.5)),
    "mesh": Mesh([(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)], [(0, 1, 2), (0, 2, 3)]),
}
RUBS = [(0.5, 1.0), (0.1, 3.0)]  #: friction, speed along the surfaces: one pair sticks, the other slides


@pytest.mark.parametrize(
    ("floor", "e"), [("plane", 0.0), ("plane", 0.5), ("plane", 1.0), ("box", 0.5), ("mesh", 0.5)]
)
@pytest.mark.parametrize(("mu", "along"), RUBS)
def test_oblique_impacts_on_a_floor(floor, e, mu, along):
    """A ball that comes with 1 m/s sticks, v = 5/7 v0 and w = v / R, or slides: w = 5/2 mu (1 + e) u / R."""
    for way, phase in ((0.1, 0.15), (0.3, 0.5), (0.85, 0.85)):
        dt = way * R
        scene = Scene(friction=mu, gravity=(0, 0, 0), restitution=e)
        scene.add_body("floor", [FLOORS[floor]])
        scene.add_spheres([[0, 0, R + dt * (1 + phase)]], R, DENSITY, velocity=(along, 0, -1.0))
        with pctt.Simulation(scene, dt=dt, stiffness=np.inf, **EXACT) as sim:
            sim.run(steps=4)
            v = sim.velocities[0]
        slides = mu * (1 + e) < 2 / 7 * along
        speed = along - mu * (1 + e) if slides else 5 / 7 * along
        assert v[0] == pytest.approx(speed, rel=1e-5)
        assert R * v[4] == pytest.approx(2.5 * (along - speed), rel=1e-5)
        assert v[2] == pytest.approx(e, abs=1e-5)


@pytest.mark.parametrize("stiffness", [np.inf, None])
@pytest.mark.parametrize("radii", [(R, R), (R, 3 * R)])
@pytest.mark.parametrize("e", [0.0, 0.5, 1.0])
def test_oblique_impacts_of_two_free_spheres(radii, e, stiffness):
    """They bounce where they touch, however far they go along each other in the step, and momentum and angular momentum
    are kept; a step later they may pass each other."""
    radius = np.array(radii)
    mass = DENSITY * 4 / 3 * np.pi * radius**3
    reduced, inertia = 1 / (1 / mass).sum(), 0.4 * mass * radius**2
    n, t = np.array([0.9, 0.3, 0.316227766]), np.array([-0.316227766, 0.0, 0.9])
    n, t = n / np.linalg.norm(n), t / np.linalg.norm(t)
    for way, phase, mu, along in ((0.1, 0.05, 0.5, 1.0), (0.3, 0.95, 0.1, 3.0), (0.9, 0.5, 0.5, 3.0)):
        dt = way * R
        coming = -n + along * t
        place = 0.1 + np.array([[0.0, 0.0, 0.0], radius.sum() * n - dt * (1 + phase) * coming])
        velocity = np.array([-mass[1], mass[0]])[:, None] * coming / mass.sum()
        scene = Scene(friction=mu, gravity=(0, 0, 0), restitution=e)
        scene.add_spheres(place, radius, DENSITY, velocity=velocity)
        settings = EXACT if stiffness is None else {**EXACT, "stiffness": stiffness}
        with pctt.Simulation(scene, dt=dt, **settings) as sim:
            sim.run(steps=5)
            found, ends = sim.velocities, sim.positions
        push = (1 + e) * reduced
        rub = min(mu * push, 2 / 7 * along * reduced)
        impulse = push * n - rub * t
        after = velocity + np.array([-1, 1])[:, None] * impulse / mass[:, None]
        np.testing.assert_allclose(found[:, :3], after, atol=1e-5)
        spin = -np.cross(n, impulse) * (radius / inertia)[:, None]
        np.testing.assert_allclose(R * found[:, 3:], R * spin, atol=1e-5)
        orbit = (mass[:, None] * np.cross(ends, found[:, :3]) + inertia[:, None] * found[:, 3:]).sum(axis=0)
        before = (mass[:, None] * np.cross(place, velocity)).sum(axis=0)
        np.testing.assert_allclose(orbit, before, atol=1e-5 * reduced * np.linalg.norm(coming) * radius.sum())


def cradle(gap, e, floor, dt=0.01, count=5, radius=0.05):
    """Of a row of balls the first moves with 1 m/s; velocities after it, and the energy over that before."""
    scene = Scene(friction=0.0, gravity=(0, 0, -9.81 if floor else 0.0), restitution=e)
    if floor:
        scene.add_body("floor", [Plane((0, 0, 1))])
    place = np.zeros((count, 3))
    place[:, 0], place[:, 2] = np.arange(count) * (2 * radius + gap), radius
    scene.add_spheres(place, radius, DENSITY, velocity=[(float(k == 0), 0, 0) for k in range(count)])
    with pctt.Simulation(scene, dt=dt, tol=1e-8, closing_work=np.inf) as sim:
        sim.run(until=count * gap + 2 * dt)
        return sim.velocities[:, 0]


@pytest.mark.parametrize("floor", [False, True])
@pytest.mark.parametrize("gap", [1e-4, 1e-3, 5e-3, 5e-3 * (1 - 1e-9), 5e-3 * (1 + 1e-12), 5e-3 * (1 + 1e-9)])
def test_balls_in_a_row_hand_the_impact_on_within_a_step(gap, floor):
    """10 mm a step: the last one leaves with the speed of the first, and no energy is lost. With gaps of half of that,
    balls touch at the end of a step, but for rounding."""
    np.testing.assert_allclose(cradle(gap, 1.0, floor), [0, 0, 0, 0, 1], atol=1e-3)


def test_balls_in_a_row_of_one_step_lose_what_restitution_takes():
    """Of three balls with e = 0.5: 1 and 2 meet, 2 and 3, and 1 and 2 once more."""
    v, e = np.array([1.0, 0.0, 0.0]), 0.5
    for k in (0, 1, 0):
        mean, half = (v[k] + v[k + 1]) / 2, (v[k] - v[k + 1]) / 2
        v[k], v[k + 1] = mean - e * half, mean + e * half
    np.testing.assert_allclose(cradle(1e-4, e, False, count=3), v, atol=1e-3)


def test_impacts_that_are_not_followed_are_counted():
    """A box that bounces, and a sphere."""
    for add, counted in (("add_boxes", True), ("add_spheres", False)):
        scene = Scene(friction=0.3, gravity=(0, 0, 0), restitution=0.5)
        scene.add_body("floor", [Plane((0, 0, 1))])
        size = (R, R, R) if counted else R
        getattr(scene, add)([[0, 0, 1.5 * R]], size, DENSITY, velocity=(0, 0, -1.0))
        with pctt.Simulation(scene, dt=0.01 * 0.9, **EXACT) as sim:
            assert (sim.step()["impacts_at_once"] > 0) == counted


def test_a_gas_in_a_box_keeps_its_energy_where_nothing_is_lost():
    """By the default tolerance: an impact of many in a step is no more too strong than the next is too weak."""
    scene = Scene(friction=0.0, gravity=(0, 0, 0), restitution=1.0)
    places = 10 * R * (np.indices((4, 4, 4)).reshape(3, -1).T - 1.5)
    scene.add_spheres(places, 3 * R, DENSITY, velocity=np.random.default_rng(1).normal(size=(64, 3)))
    scene.add_body("box", [Plane(s * n, -s * 20 * R * n) for n in np.eye(3) for s in (-1, 1)])
    with pctt.Simulation(scene) as sim:
        energy = sim.kinetic_energy
        sim.run(steps=200)  # some 20 impacts of each ball
        assert sim.kinetic_energy == pytest.approx(energy, rel=1e-3)


def test_a_ball_keeps_its_height_where_nothing_is_lost():
    """e = 1 under gravity: heights of bounces by places of touch, in steps of a third of a radius at most."""
    scene = Scene(friction=0.3, restitution=1.0)
    scene.add_body("floor", [Plane((0, 0, 1))])
    scene.add_spheres([[0, 0, 11 * R]], R, DENSITY)
    with pctt.Simulation(scene, dt=0.0021, **EXACT) as sim:
        energy = []
        for _ in range(250):
            before = sim.velocities[0, 2]
            sim.step()
            mean = 0.5 * (before + sim.velocities[0, 2])
            if before * sim.velocities[0, 2] > 0.0 and sim.positions[0, 2] > 2 * R:
                energy.append(0.5 * mean**2 + 9.81 * (sim.positions[0, 2] - 0.0021 * sim.velocities[0, 2] - R))
    assert max(energy) == pytest.approx(min(energy), rel=1e-2)


@pytest.mark.parametrize("height", [0.5, 1.1, 2.0])
def test_a_ball_that_bounces_is_no_jump_of_energy(height):
    """What falls and rises within a step gets its speed from gravity, also in steps as long as the defaults."""
    scene = Scene(friction=0.3, restitution=1.0)
    scene.add_body("floor", [Plane((0, 0, 1))])
    scene.add_spheres([[0, 0, (1 + height) * R]], R, DENSITY)
    with pctt.Simulation(scene, comm=MPI.COMM_SELF) as sim:
        for _ in range(120):
            assert sim.step()["energy_jump"] == 0.0


@pytest.mark.parallel(2)
def test_ranks_follow_the_same_impacts(ranks):
    """A gas of 50 spheres in a periodic box."""
    rng = np.random.default_rng(3)
    places = 0.0175 + 0.035 * np.indices((6, 6, 6)).reshape(3, -1).T[::4][:50]
    scene = Scene(friction=0.3, gravity=(0, 0, 0), restitution=0.9, period=(0.21, 0.21, 0.21))
    scene.add_spheres(places, R, DENSITY, velocity=rng.uniform(-1, 1, (50, 3)))
    found = []
    for comm in (MPI.COMM_WORLD, MPI.COMM_SELF):
        with pctt.Simulation(scene, dt=0.004, comm=comm, **EXACT) as sim:
            sim.run(steps=4)
            found.append((sim.positions, sim.velocities))
    for one, other in zip(*found):
        np.testing.assert_allclose(one, other, atol=1e-5)


FOLD = [(x, y, z) for x, y in ((0, 0), (1, 0), (0, -1)) for z in (-1, 1)]
HOSTS = {
    "sphere": (Sphere(3 * R), 4 * R),
    "capsule": (Capsule(3 * R, 9 * R), 4 * R),
    "cylinder": (Cylinder(3 * R, 9 * R), 4 * R),
    "superellipsoid": (Superellipsoid((3 * R, 3 * R, 5 * R), (2, 2)), 4 * R),
    "edge of a box": (Box((1.0, 1.0, 1.0), center=(1.0, -1.0, 0.0)), R),
    "edge of a mesh": (Mesh(FOLD, [(0, 1, 2), (1, 2, 3), (0, 1, 4), (1, 4, 5)]), R),
    "corner of a mesh": (Mesh([(0, 0, 0), (1, 0, 0), (0, -1, 0)], [(0, 1, 2)]), R),
}


@pytest.mark.parametrize("host", HOSTS)
def test_a_ball_bounces_off_a_curved_body_where_it_touches_that(host):
    """Its normal there, not that of the end of the step, which at an edge was 10 degrees off."""
    (shape, reach), mu = HOSTS[host], 0.2
    n, coming = np.array([0.8, -0.6, 0.0]), np.array([1.0, 0.0, 0.0])
    along = np.array([0.6, 0.8, 0.0])
    push, slide = 1.5 * 0.8, 0.6
    rub = min(mu * push, 2 / 7 * slide)
    after = coming - push * n - rub * along
    for way, phase in ((0.2, 0.05), (0.2, 0.95), (0.6, 0.5)):
        dt = way * R
        scene = Scene(friction=mu, gravity=(0, 0, 0), restitution=0.5)
        scene.add_body("host", [shape])
        scene.add_spheres([-reach * n - dt * (1 + phase) * coming], R, DENSITY, velocity=coming)
        with pctt.Simulation(scene, dt=dt, stiffness=np.inf, **EXACT) as sim:
            sim.run(steps=4)
            np.testing.assert_allclose(sim.velocities[0, :3], after, atol=1e-5)
            place = -reach * n + dt * (3 - phase) * after
            np.testing.assert_allclose(sim.positions[0], place, atol=1e-5 * R)


@pytest.mark.parametrize("mu", [0.0, 0.3])
def test_a_turning_paddle_strikes_a_ball_along_its_face_of_that_time(mu):
    """It parts with (1 + e) times the speed of the face, along the normal of the time of touch: not .02 off."""
    speed, far, thick, e = 3.0, 25 * R, 2 * R, 0.5
    for turn in (0.4, 0.405, 0.41):
        out = np.array([np.cos(turn), np.sin(turn), 0.0])
        ahead = np.array([-out[1], out[0], 0.0])
        scene = Scene(friction=mu, gravity=(0, 0, 0), restitution=e)
        scene.add_body("paddle", [Box((30 * R, thick, 10 * R))], Rotation((0, 0, speed)))
        scene.add_spheres([far * out + (thick + R) * ahead], R, DENSITY)
        with pctt.Simulation(scene, dt=0.02 / speed, **EXACT) as sim:
            sim.run(until=turn / speed + 0.03)
            found = sim.velocities[0, :3]
        push = (1 + e) * speed * far
        rub = min(mu * push, 2 / 7 * speed * thick)
        np.testing.assert_allclose(found, push * ahead - rub * out, atol=2e-3 * push)
