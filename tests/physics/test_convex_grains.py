"""Cylinders and superellipsoids roll, stand, tip and rock as mechanics says, on any number of ranks."""

from __future__ import annotations

import numpy as np
import pytest
from mpi4py import MPI

import pctt
from dem import quaternion
from dem.scene import Scene
from dem.shapes import Box, Cylinder, Plane, Superellipsoid
from dem.step.overlaps import overlaps

G = 9.81
ACROSS = (np.sqrt(0.5), np.sqrt(0.5), 0.0, 0.0)  # the axis along y
FLOORS = {"plane": Plane((0, 0, 1)), "box": Box((9, 9, 1), (0, 0, -1))}


def on_floor(floor, friction, slope=0.0, way=0.0):
    """A scene with a floor at z = 0, inclined in the direction of an angle."""
    down = np.sin(slope) * np.array([np.cos(way), np.sin(way)])
    scene = Scene(friction, gravity=(G * down[0], G * down[1], -G * np.cos(slope)))
    scene.add_body("floor", [FLOORS[floor]])
    return scene


def energies(scene, seconds):
    """Kinetic and potential energy in the middle of a step, as velocities are, soon after the start and at the end, by
    the defaults."""
    with pctt.Simulation(scene) as sim:
        found = []
        for until in (0.1 * seconds, seconds):
            sim.run(until=until)
            before = sim.figures["potential_energy [J]"]
            row = sim.step()
            found.append(row["kinetic_energy [J]"] + 0.5 * (before + row["potential_energy [J]"]))
        return found


@pytest.mark.parametrize(("radius", "height", "tilt"), [
    (0.012, 0.002, 20.0), pytest.param(0.1, 0.004, 15.0, marks=pytest.mark.slow), (0.1, 0.02, 25.0)
])
def test_a_wobbling_coin_keeps_its_energy(radius, height, tilt):
    """It rolls on its rim, without slip: nothing brakes it."""
    tilt = np.radians(tilt)
    across, turn = np.array([np.cos(tilt), 0, -np.sin(tilt)]), (np.cos(tilt / 2), 0, np.sin(tilt / 2), 0)
    spin = 2 * np.sqrt(G / (radius * np.sin(tilt))) * np.sin(tilt) * across
    place = np.array([0, 0, radius * np.sin(tilt)]) + height / 2 * np.array([np.sin(tilt), 0, np.cos(tilt)])
    scene = on_floor("plane", 0.5)
    scene.add_grains(place, Cylinder(radius, height), 2000.0, quaternions=turn, angular_velocity=spin)
    first, last = energies(scene, 4 * np.sqrt(radius / G))
    assert last == pytest.approx(first, rel=7e-4)


@pytest.mark.parametrize(
    ("radii", "friction"), [((0.06, 0.06, 0.012), 0.7), ((0.02, 0.02, 0.06), 0.0), ((0.15, 0.1, 0.06), 0.7)]
)
def test_an_ellipsoid_that_topples_rises_again(radii, friction):
    """It presses with up to 36 times its weight on its way over its flat side; by the defaults."""
    scene, tilt = on_floor("plane", friction), 0.2
    tilt = np.pi / 2 - tilt if radii[0] > radii[2] else tilt  # on its edge, or upright
    place = [0, 0, np.hypot(radii[0] * np.sin(tilt), radii[2] * np.cos(tilt))]
    scene.add_grains(place, Superellipsoid(radii), 2000.0, quaternions=(np.cos(tilt / 2), 0, np.sin(tilt / 2), 0))
    first, last = energies(scene, 5 * np.sqrt(max(radii) / G))
    mass = 2000.0 * 4 / 3 * np.pi * np.prod(radii)
    assert last - first == pytest.approx(0.0, abs=0.03 * mass * G * (max(radii) - min(radii)))


@pytest.mark.parametrize("radii", [(0.03, 0.03, 0.015), (0.2, 0.1, 0.1)])
def test_an_ellipsoid_rocks_without_loss(radii):
    tilt = 0.5
    scene = on_floor("plane", 0.5)
    place = [0, 0, np.hypot(radii[0] * np.sin(tilt), radii[2] * np.cos(tilt))]
    turn = (np.cos(tilt / 2), 0, np.sin(tilt / 2), 0)
    scene.add_grains(place, Superellipsoid(radii), 2000.0, quaternions=turn)
    first, last = energies(scene, 8 * np.sqrt(max(radii) / G))
    assert last == pytest.approx(first, rel=0.001)


@pytest.mark.parametrize("floor", FLOORS)
def test_a_cylinder_rolls_down_at_two_thirds_of_what_slides(floor):
    slope, r = 0.4, 0.12
    scene = on_floor(floor, 0.7, slope)
    scene.add_grains([(0, 0, r)], Cylinder(r, 0.3), 800.0, quaternions=ACROSS)
    with pctt.Simulation(scene, dt=4e-3, tol=1e-8) as sim:
        sim.run(steps=50)
        way, speed = 2 / 3 * G * np.sin(slope) * np.array([0.5 * 0.2 * 0.204, 0.2])  # as implicit steps go
        velocity = sim.local.velocity[0]
        np.testing.assert_allclose(velocity[[0, 1, 4]], [speed, 0, speed / r], rtol=1e-3, atol=1e-3)
        assert sim.positions[0, 0] == pytest.approx(way, rel=1e-3)


@pytest.mark.parametrize("floor", FLOORS)
def test_a_cylinder_stands_without_creep(floor):
    r, length = 0.1, 0.35
    scene = on_floor(floor, 0.5, 0.2, 0.7)
    scene.add_grains([(0, 0, length / 2)], Cylinder(r, length), 1200.0)
    with pctt.Simulation(scene, dt=5e-3, tol=1e-9) as sim:
        sim.run(steps=30)
        before = sim.positions[0]
        sim.run(steps=20)
        weight = 1200.0 * np.pi * r**2 * length * G
        np.testing.assert_allclose(np.linalg.norm(sim.body("floor").force), weight, rtol=1e-5)
        np.testing.assert_allclose(sim.positions[0], before, atol=3e-8)


@pytest.mark.parametrize(("share", "way"), [(0.95, np.pi / 6), (1.05, 0.1)])
def test_a_cylinder_tips_where_its_weight_leaves_its_end(share, way):
    """It stands where its weight is between two of the points that bear, and falls where it is above one of them."""
    r, length = 0.1, 0.4
    scene = on_floor("plane", 2.0, share * np.arctan(2 * r / length), way)
    scene.add_grains([(0, 0, length / 2)], Cylinder(r, length), 1000.0)
    with pctt.Simulation(scene, dt=5e-3, tol=1e-6) as sim:
        sim.run(steps=50)
        tilt = 2.0 * np.hypot(*sim.orientations[0, 1:3])
        assert tilt > 0.03 if share > 1.0 else tilt < 0.003


def test_an_ellipsoid_rocks_with_the_period_of_its_curvature():
    """On its short axis c, in the plane of a: R = a^2/c is the radius below, omega^2 = m g (R - c) / (I + m c^2)."""
    a, b, c, start = 0.3, 0.25, 0.2, 0.05
    scene = on_floor("plane", 3.0)
    height = np.hypot(c * np.cos(start), a * np.sin(start))
    turn = (np.cos(start / 2), 0, np.sin(start / 2), 0)
    scene.add_grains([(0, 0, height)], Superellipsoid((a, b, c)), 1000.0, quaternions=turn)
    omega = np.sqrt(G * (a**2 / c - c) / ((a**2 + c**2) / 5 + c**2))
    dt, signs, tilts = 4e-3, [], []
    with pctt.Simulation(scene, dt=dt, tol=1e-9) as sim:
        for _ in range(int(2 * np.pi / omega / dt) + 10):
            sim.step()
            signs.append(sim.local.velocity[0, 4])
            tilts.append(2 * sim.orientations[0, 2])
    turns = np.flatnonzero(np.diff(np.sign(signs[2:]))) + 2
    ends = [k + signs[k] / (signs[k] - signs[k + 1]) for k in turns]
    assert (ends[0] + 0.5) * dt == pytest.approx(np.pi / omega, rel=0.02)
    assert (ends[1] - ends[0]) * dt == pytest.approx(np.pi / omega, rel=0.02)
    assert min(tilts) == pytest.approx(-start, rel=0.1)
    assert tilts[turns[1]] == pytest.approx(start, rel=0.15)


def overlap(sim):
    """Of the last step, as a part of half thicknesses."""
    return overlaps(sim.last, np.array([np.inf]))[0]


def test_superellipsoids_rock_on_ends_of_cylinders_without_overlaps():
    """On nearly flat sides: the point that bears goes far within a step, as impacts change how they turn."""
    rng, many = np.random.default_rng(3), 6
    place, tilt, way = 0.3 * np.eye(3)[:1] * np.arange(many)[:, None], *rng.uniform(0.05, [0.15, 6.0], (many, 2)).T
    axis = np.stack([np.cos(way), np.sin(way), 0 * way], axis=1)
    scene = on_floor("plane", 0.4)
    scene.add_grains(place + [0, 0, 0.03], Cylinder(0.1, 0.06), 1500.0)
    scene.add_grains(
        place + [0, 0, 0.145], Superellipsoid((0.08, 0.08, 0.07), (5, 5)), 1500.0, velocity=(0, 0, -1),
        quaternions=quaternion.exponential(tilt[:, None] * axis), angular_velocity=[0, 0, 2] - 8 * axis,
    )  # fmt: skip
    with pctt.Simulation(scene, dt=4e-3, tol=1e-6) as sim:
        for _ in range(12):
            sim.step()
            assert overlap(sim) <= 2.0 * sim.expected_overlap


@pytest.mark.parametrize("n", [8, 20])
def test_superellipsoids_stand_on_flat_sides_or_slide_by_friction(n):
    """A step does not follow how they rock there; so they make no energy of that."""
    for over in (0.9, 1.1):
        tangent, half = 0.4 * over, 0.05
        gravity = 9.81 * np.array([tangent, 0, -1]) / np.hypot(tangent, 1)
        scene = Scene(0.4, gravity=gravity)
        scene.add_body("floor", [Plane((0, 0, 1))])
        scene.add_grains([(0, 0, half)], Superellipsoid((2 * half, 2 * half, half), (n, n)), 1000.0)
        with pctt.Simulation(scene) as sim:
            sim.run(steps=60)
            speed = sim.time * max(0.0, gravity[0] + 0.4 * gravity[2])
            assert sim.velocities[0] == pytest.approx([speed, 0, 0, 0, 0, 0], abs=3e-3)


def bed(side, layers):
    """Cylinders, superellipsoids, balls, boxes and capsules above a box of walls."""
    rng, wide = np.random.default_rng(11), 0.25
    place = np.stack(np.meshgrid(*[np.arange(side)] * 2, np.arange(layers), indexing="ij"), axis=-1).reshape(-1, 3)
    place, turns = wide * (place + 0.5), rng.normal(size=(len(place), 4))
    scene = Scene(0.4)
    walls = [Plane((0, 0, 1)), Plane((1, 0, 0)), Plane((0, 1, 0))]
    scene.add_body("box", [*walls, Plane((-1, 0, 0), (wide * side, 0, 0)), Plane((0, -1, 0), (0, wide * side, 0))])
    for k, shape in enumerate((Cylinder(0.08, 0.16), Superellipsoid((0.12, 0.09, 0.07)), Cylinder(0.1, 0.06),
                               Superellipsoid((0.08, 0.08, 0.07), (5, 5)))):  # fmt: skip
        at = slice(k, None, 6)
        scene.add_grains(place[at], shape, 1500.0, scale=rng.uniform(0.8, 1.0, len(place[at])), quaternions=turns[at])
    scene.add_spheres(place[4::6], 0.09, 1500.0)
    scene.add_boxes(place[5::12], (0.08, 0.07, 0.05), 1500.0, quaternions=turns[5::12])
    scene.add_capsules(place[11::12], 0.06, 0.05, 1500.0, quaternions=turns[11::12])
    return scene


@pytest.mark.parallel(2)
def test_ranks_agree():
    given = {"dt": 4e-3, "tol": 1e-8, "solver": "apgd", "stiffness": 1e6}
    with pctt.Simulation(bed(2, 3), comm=MPI.COMM_WORLD, **given) as sim:
        sim.run(steps=50)
        place, many = sim.positions, len(sim.contacts)
    with pctt.Simulation(bed(2, 3), comm=MPI.COMM_SELF, **given) as alone:
        alone.run(steps=50)
        assert len(alone.contacts) > 10
        np.testing.assert_allclose(alone.positions, place, atol=1e-5)
        assert many == len(alone.contacts)


@pytest.mark.slow
def test_a_bed_of_all_shapes_settles():
    with pctt.Simulation(bed(4, 6), dt=2.5e-3, tol=1e-6) as sim:
        energy, kinetic, springs = [], [], []
        for _ in range(900):  # without resistance to rolling some rock for long
            row = sim.step()
            kinetic.append(row["kinetic_energy [J]"])
            energy.append(kinetic[-1] + row["potential_energy [J]"])
            springs.append(row["spring_energy_before [J]"])
            assert overlap(sim) <= 3.0 * sim.expected_overlap  # 2.0 where this was written
            assert row["energy_jump"] == 0.0
        assert (np.diff(energy) <= np.array(springs[1:]) + 1e-6 * energy[0]).all()  # they give back what they have
        assert kinetic[-1] < 1e-3 * max(kinetic)
        assert sim.positions[:, 2].min() > 0.04
