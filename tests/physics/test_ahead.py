"""Contacts have the directions of the end of the step."""

from __future__ import annotations

import numpy as np
import pytest
from drive import RADIUS, G
from mpi4py import MPI

import pctt
from dem import quaternion
from dem.bodies import POLYHEDRON
from dem.contact import find_contacts
from dem.contact.narrow import CORNERS
from dem.mesh import Mesh
from dem.motion import Glide, Rotation
from dem.scene import Scene
from dem.shapes import Box, Capsule, Clump, Cylinder, Plane, Sphere
from dem.start import new_world
from dem.step import advanced
from dem.step.system import ContactSystem
from dem.unconstrained import unconstrained

DENSITY = 2500.0
EXACT = {"tol": 1e-10, "closing_work": np.inf, "stiffness": np.inf}
TETRAHEDRON = 0.07 * CORNERS[[0, 3, 5, 6]] * [1.0, 0.9, 0.8]
SHEET = [[-0.3, -0.3, 0], [1.2, -0.3, 0], [-0.3, 1.2, 0], [1.2, 1.2, 0]]
CELL = {"period": (0.84, 0.84, 0.84), "shear_rate": 0.8, "shear_gradient": "z"}


def crowd(grains="clumps", floor="plane", **cell):
    """Spheres, others and boxes among them, which move and turn, above a floor that turns and beside a box that
    glides."""
    rng = np.random.default_rng(7)
    scene = Scene(0.3, gravity=(0, 0, 0), **cell)

    def moves(n):
        return {"velocity": rng.uniform(-0.5, 0.5, (n, 3)), "angular_velocity": rng.uniform(-3, 3, (n, 3))}

    places = 0.21 * np.stack(np.meshgrid(*[np.arange(4)] * 3, indexing="ij"), axis=-1).reshape(-1, 3) + 0.12
    turns = rng.normal(size=(64, 4))
    if cell or grains == "clumps":
        scene.add_spheres(places, RADIUS, DENSITY, **moves(64))
    if cell:
        return new_world(scene, MPI.COMM_SELF)
    if grains == "clumps":
        scene.add_clumps(places[::4] + [0, 0, 0.87], Clump([[0, 0, -0.05], [0, 0, 0.05]], [0.08, 0.08]), DENSITY,
                         **moves(16))  # fmt: skip
    elif grains == "capsules":
        scene.add_capsules(places, 0.06, 0.04, DENSITY, **moves(64), quaternions=turns)
    else:
        scene.add_polyhedra(places, TETRAHEDRON, DENSITY, **moves(64), quaternions=turns)
    if floor == "plane":
        scene.add_boxes(places[:4] + [0.84, 0, 0], (0.1, 0.09, 0.1), DENSITY, **moves(4))
    shape = Plane((0, 0, 1)) if floor == "plane" else Mesh(SHEET, [[0, 1, 2], [1, 3, 2]])
    scene.add_body("floor", [shape], Rotation((0.4, -0.3, 0.0)))
    wall = [Box((0.1, 0.5, 0.5)), Sphere(0.1, (0.0, 0.0, 0.8))]
    scene.add_body("wall", wall, Glide((0.7, 0.0, 0.1)), position=(-0.1, 0.4, 0.5))
    return new_world(scene, MPI.COMM_SELF)


@pytest.mark.parametrize(
    ("grains", "floor", "cell", "kinds"),
    [
        ("clumps", "plane", {}, 8),
        ("clumps", "plane", CELL, 1),
        ("clumps", "mesh", {}, 5),
        ("capsules", "plane", {}, 5),
        ("capsules", "mesh", {}, 2),
        ("polyhedra", "plane", {}, 5),
    ],
)
def test_where_velocities_stay_the_end_is_met(grains, floor, cell, kinds):
    """Normals are those that bodies have after the step, and linear gaps lead to the gaps that they have then."""
    dt = 0.002  # nothing goes further than FURTHEST
    world = crowd(grains, floor, **cell)
    free = unconstrained(world, dt)
    contacts = find_contacts(world, 0.06, free)
    velocity = np.concatenate([world.grains.velocity, free.prescribed])
    start = find_contacts(world, 0.0, None, contacts.near.margin[: len(world.grains)], contacts.shifts)
    assert {tuple(pair) for pair in start.body} <= {tuple(pair) for pair in contacts.body}
    end = find_contacts(advanced(world, free, contacts, velocity), 0.08)
    near = contacts.near.bodies.velocity.copy()
    near[len(world.grains) :] = velocity[len(world.grains) :]
    opening = ContactSystem(world, contacts, free).contact_map.relative_velocities(near)[:, 0]
    if contacts.drift is not None:
        opening = opening + np.einsum("ci,ci->c", contacts.normal, contacts.drift)
    at = {key: k for k, key in enumerate(end.key)}
    pairs = np.array([(c, at[contacts.key[c]]) for c in range(len(contacts)) if contacts.key[c] in at])
    assert len(pairs) > 70
    here, there = pairs.T
    touching = {tuple(pair) for pair in start.body[start.gap <= 1e-4 * RADIUS] if pair[1] >= len(world.grains)}
    ends = np.array([tuple(pair) not in touching for pair in contacts.body[here]])  # what touches a tool keeps normals
    ends &= (grains != "clumps") | (contacts.b[here] >= len(world.grains))  # two spheres turn by what they slide
    np.testing.assert_allclose(contacts.normal[here[ends]], end.normal[there[ends]], atol=1e-12)
    np.testing.assert_allclose((contacts.linear + dt * opening)[here], end.gap[there], atol=1e-12)
    shape = np.minimum(contacts.near.bodies.shape, POLYHEDRON)
    found = {tuple(sorted(pair)) for pair in zip(shape[contacts.a[here]], shape[contacts.b[here]])}
    assert len(found) >= kinds, found
    if grains == "clumps":
        assert np.abs(contacts.linear - contacts.gap).max() > 1e-6  # where surfaces are curved


def test_no_gap_is_deeper_than_the_bodies_overlap():
    """A box rises beside another one, over its edge: the normal of the end leads to an overlap at the start that the
    two do not have."""
    scene = Scene(0.3, gravity=(0, 0, 0))
    scene.add_body("block", [Box((0.1, 0.1, 0.1))])
    scene.add_boxes([0.151, 0, 0.145], (0.05, 0.05, 0.05), DENSITY, velocity=(0, 0, 1.0))
    world = new_world(scene, MPI.COMM_SELF)
    contacts = find_contacts(world, 0.01, unconstrained(world, 0.02))
    assert contacts.linear.min() < -0.003
    np.testing.assert_allclose(contacts.gap, 0.001, atol=1e-12)


def test_a_rim_that_rolls_is_foreseen_to_the_end_of_the_step():
    """A coin rolls on its rim, that goes further than a quarter of its half thickness: the linear gap leads to that of
    the end, and the sliding has the arm of the middle of the step."""
    radius, height, tilt, dt = 0.1, 0.002, 1.0, 1e-3
    spin = 18.0 * np.array([-np.cos(tilt), 0.0, np.sin(tilt)])

    def rim(turn):
        """From the centre of a coin that has turned to the lowest point of its rim."""
        axis = quaternion.rotate(quaternion.exponential(turn), np.array([np.sin(tilt), 0.0, np.cos(tilt)]))
        across = axis[2] * axis - [0.0, 0.0, 1.0]
        return radius * across / np.linalg.norm(across) - 0.5 * height * axis

    first, last = rim(np.zeros(3)), rim(dt * spin)
    scene = Scene(0.5)
    scene.add_body("floor", [Plane((0, 0, 1))])
    turn = quaternion.exponential(np.array([0.0, tilt, 0.0]))
    speed = -np.cross(spin, first)
    place = [0.0, 0.0, -first[2]]
    scene.add_grains(place, Cylinder(radius, height), DENSITY, quaternions=turn, velocity=speed, angular_velocity=spin)
    world = new_world(scene, MPI.COMM_SELF)
    contacts = find_contacts(world, 1e-4, unconstrained(world, dt))
    nearest = np.argmin(contacts.gap)
    bent = (last - first - dt * np.cross(spin, first))[2]
    assert contacts.linear[nearest] == pytest.approx(bent, rel=0.02)
    swing = 0.5 * np.cross(spin, last - first)[:2]  # the normal points down, from the coin to the floor
    np.testing.assert_allclose(contacts.swing[nearest, :2], -swing, atol=0.02 * np.abs(swing).max())


DOME = Sphere(1.0)
TOP = Mesh.revolved([(np.sin(a), np.cos(a)) for a in np.linspace(0.9, 0.0, 120)], 200)
PILL = Capsule(1.0, 0.3, quaternion=(np.sqrt(0.5), np.sqrt(0.5), 0.0, 0.0))  # across the way


def slid_off(dome, dt, **motion):
    """The relative error of the kinetic energy of a sphere that has slid off a dome without friction for 0.4 s, with
    the mean of the velocities before and after a step."""
    scene = Scene(friction=0.0, stiffness=np.inf)
    scene.add_body("dome", [dome], **motion)
    start = (1 + RADIUS) * np.array([np.sin(0.2), 0, np.cos(0.2)])
    speed = np.array(motion["motion"].velocity if isinstance(motion.get("motion"), Glide) else (0.0, 0.0, 0.0))
    scene.add_spheres([start], RADIUS, DENSITY, velocity=speed)
    with pctt.Simulation(scene, dt=dt, **EXACT) as sim:
        while sim.time < 0.4:
            place, before = sim.positions[0], sim.velocities[0, :3]
            sim.step()
        speed, fallen = 0.5 * (before + sim.velocities[0, :3]) - speed, start[2] - place[2]
    return 0.5 * speed @ speed / (G * fallen) - 1


@pytest.mark.parametrize(("dome", "most"), [(PILL, 1e-3), (TOP, 5e-3)])
def test_spheres_keep_their_energy_on_curved_bodies_at_rest(dome, most):
    """The normals of the start, and gaps of the end: of second order in dt; beside the edges of triangles."""
    errors = [abs(slid_off(dome, dt)) for dt in (0.008, 0.004)]
    assert errors[0] < most
    assert errors[1] < max(0.35 * errors[0], 0.5 * most)


@pytest.mark.parametrize("motion", [Rotation((0, 0, 0.1)), Glide((0.4, 0, 0))])
def test_spheres_keep_their_energy_on_tools_that_move(motion):
    """As on bodies at rest."""
    errors = [abs(slid_off(DOME, dt, motion=motion)) for dt in (0.008, 0.004)]
    assert errors[0] < 2e-3
    assert errors[1] < 0.35 * errors[0]


def swings(scene, count, **settings):
    """The first angles at which the one grain of a scene turns about, on either side, over that of the start."""
    sim, angles = pctt.Simulation(scene, **settings), []
    x = sim.positions[0]
    start = np.arctan2(x[0], -x[2])
    while sim.time < (count + 0.2) * np.pi * np.sqrt(0.45 / G):
        sim.step()
        x = sim.positions[0]
        angles.append(np.arctan2(x[0], -x[2]))
    at = np.abs(angles) / start
    return at[1:-1][(at[1:-1] > at[:-2]) & (at[1:-1] >= at[2:]) & (at[1:-1] > 0.1)]


def test_a_sphere_swings_in_a_bowl_of_triangles():
    """By the default step: what the edges of triangles take is left. With normals of the end 0.8 of it were left."""
    scene = Scene(friction=0.0)
    arc = [(0.5 * np.sin(a), -0.5 * np.cos(a)) for a in np.linspace(0, 0.66, 45)]
    scene.add_body("bowl", [Mesh.revolved(arc, 160)])
    scene.add_spheres([[0.45 * np.sin(0.5), 0.001, -0.45 * np.cos(0.5)]], 0.05, DENSITY)
    assert all(0.98 < swing < 1.005 for swing in swings(scene, 2))


@pytest.mark.parametrize(("shape", "settings"), [("capsule", {}), ("box", {"dt": 0.005})])
def test_other_shapes_swing_in_a_trough_of_triangles(shape, settings):
    """Each corner and end finds its own direction at the start. The triangles are 300 times as long as wide: what their
    edges hold is asked across these; else the sides of a box catch on them, and 0.6 to 1.1 of the angle is left."""
    count, a = 230, np.linspace(-0.75, 0.75, 230)
    corners = [np.stack([0.5 * np.sin(a), np.full(count, y), -0.5 * np.cos(a)], axis=1) for y in (-0.5, 0.5)]
    k = np.arange(count - 1)
    strips = np.concatenate([np.stack([k, k + 1, count + k], 1), np.stack([k + 1, count + k + 1, count + k], 1)])
    scene = Scene(friction=0.0)
    scene.add_body("trough", [Mesh(np.concatenate(corners), strips)])
    half = 0.08 if shape == "capsule" else 0.04  # what of it lies along the way
    depth = np.sqrt((0.5 if shape == "box" else 0.45) ** 2 - half**2) - (0.04 if shape == "box" else 0.0)
    place, tilt = [[depth * np.sin(0.6), 0.003, -depth * np.cos(0.6)]], [np.cos(-0.3), 0.0, np.sin(-0.3), 0.0]
    if shape == "box":
        scene.add_boxes(place, (0.04, 0.04, 0.04), DENSITY, quaternions=[tilt])
    else:
        turn = [np.cos(np.pi / 4 - 0.3), 0.0, np.sin(np.pi / 4 - 0.3), 0.0]
        scene.add_capsules(place, 0.05, 0.08, DENSITY, quaternions=[turn])
    assert 0.985 < swings(scene, 1, **settings)[0] < 1.005
