"""Contacts of spheres have the directions of the end of the step."""

from __future__ import annotations

import numpy as np
import pytest
from drive import RADIUS, G
from mpi4py import MPI

import pctt
from dem.clumps import Clump
from dem.contact import find_contacts
from dem.motion import Glide, Rotation
from dem.scene import Scene
from dem.shapes import Box, Plane, Sphere
from dem.start import new_world
from dem.step import advanced
from dem.system import ContactSystem

DENSITY = 2500.0
EXACT = {"tol": 1e-10, "closing_work": np.inf, "stiffness": np.inf}


def crowd(period=None, shear_rate=None):
    """Spheres, clumps and a box among them, which move and turn, on a plane that turns and a box that glides."""
    rng = np.random.default_rng(7)
    cell = {} if period is None else {"period": period, "shear_rate": shear_rate, "shear_gradient": "z"}
    scene = Scene(0.3, gravity=(0, 0, 0), **cell)

    def moves(n):
        return {"velocity": rng.uniform(-0.5, 0.5, (n, 3)), "angular_velocity": rng.uniform(-3, 3, (n, 3))}

    places = 0.21 * np.stack(np.meshgrid(*[np.arange(4)] * 3, indexing="ij"), axis=-1).reshape(-1, 3) + 0.12
    scene.add_spheres(places, RADIUS, DENSITY, **moves(64))
    if period is None:
        dumbbell = Clump([[0, 0, -0.05], [0, 0, 0.05]], [0.08, 0.08])
        scene.add_clumps(places[::4] + [0, 0, 0.87], dumbbell, DENSITY, **moves(16))
        scene.add_boxes(places[:4] + [0.84, 0, 0], (0.1, 0.09, 0.1), DENSITY, **moves(4))
        scene.add_body("plane", [Plane((0, 0, 1))], Rotation((0.4, -0.3, 0.0)))
        scene.add_body("box", [Box((0.1, 0.5, 0.5)), Sphere(0.1, (0.0, 0.0, 0.8))], Glide((0.7, 0.0, 0.1)),
                       position=(-0.1, 0.4, 0.5))  # fmt: skip
    return new_world(scene, MPI.COMM_SELF)


@pytest.mark.parametrize("cell", [{}, {"period": (0.84, 0.84, 0.84), "shear_rate": 0.8}])
def test_where_velocities_stay_the_end_is_met(cell):
    """Normals are those that bodies have after the step, and linear gaps lead to the gaps that they have then."""
    dt = 0.004
    world = crowd(**cell)
    contacts = find_contacts(world, 0.04, dt)
    velocity = np.concatenate([world.grains.velocity, world.prescribed_velocity(dt)])
    end = find_contacts(advanced(world, velocity, dt), 0.06)
    near = contacts.near.bodies.velocity.copy()
    near[len(world.grains) :] = velocity[len(world.grains) :]
    opening = ContactSystem(world, contacts, dt).contact_map.relative_velocities(near)[:, 0]
    if contacts.drift is not None:
        opening = opening + np.einsum("ci,ci->c", contacts.normal, contacts.drift)
    at = {key: k for k, key in enumerate(end.key)}
    turned = np.flatnonzero(contacts.moved.any(axis=1))
    pairs = np.array([(c, at[contacts.key[c]]) for c in turned if contacts.key[c] in at])
    assert len(pairs) > 100
    here, there = pairs.T
    np.testing.assert_allclose(contacts.normal[here], end.normal[there], atol=1e-12)
    np.testing.assert_allclose((contacts.linear + dt * opening)[here], end.gap[there], atol=1e-12)
    assert np.abs(contacts.linear - contacts.gap).max() > 1e-6  # where surfaces are curved
    shape = contacts.near.bodies.shape
    kinds = {tuple(sorted(pair)) for pair in zip(shape[contacts.a[here]], shape[contacts.b[here]])}
    assert len(kinds) == (1 if cell else 5), kinds


def test_energy_of_smooth_motion_is_of_first_order():
    """A sphere slides without friction off a dome; energy at equal times, with the mean of two velocities."""
    errors = []
    for dt in (0.008, 0.004, 0.002):
        scene = Scene(friction=0.0, stiffness=np.inf)
        scene.add_body("dome", [Sphere(1.0)])
        start = (1 + RADIUS) * np.array([np.sin(0.2), 0, np.cos(0.2)])
        scene.add_spheres([start], RADIUS, DENSITY)
        with pctt.Simulation(scene, dt=dt, **EXACT) as sim:
            while sim.time < 0.4:
                place, before = sim.positions[0], sim.velocities[0, :3]
                sim.step()
            speed, fallen = 0.5 * (before + sim.velocities[0, :3]), start[2] - place[2]
            assert np.linalg.norm(sim.positions[0]) == pytest.approx(1 + RADIUS, abs=1e-5)
        errors.append(abs(0.5 * speed @ speed / (G * fallen) - 1))
    assert errors[0] < 0.02
    assert errors[1] < 0.6 * errors[0]
    assert errors[2] < 0.6 * errors[1]
