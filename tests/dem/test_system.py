"""The maps between bodies and contacts against their definitions."""

from __future__ import annotations

import numpy as np
import pytest
from cases import dense_map, dense_scaled_map, force_on, heap, step
from mpi4py import MPI

from dem import bodies, quaternion
from dem.contact import find_contacts
from dem.contact.search import contact_frames
from dem.scene import Scene
from dem.start import new_world
from dem.step import advance
from dem.step.system import ContactSystem
from dem.unconstrained import unconstrained

SELF = MPI.COMM_SELF
RNG = np.random.default_rng(7)
DT = 0.01


@pytest.fixture(scope="module")
def world():
    world = new_world(heap(3, side=4), SELF)
    for _ in range(20):
        step(world)
    world.pairs.stiffness[:] = np.inf
    return world


@pytest.fixture(scope="module")
def contacts(world):
    return find_contacts(world, 0.02)


@pytest.fixture(scope="module")
def system(world, contacts):
    return ContactSystem(world, contacts, unconstrained(world, DT), recovery_speed=0.1)


def test_frames_are_right_handed_and_orthonormal():
    normal = RNG.normal(size=(500, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    normal[:6] = np.concatenate([np.eye(3), -np.eye(3)])
    frame = contact_frames(normal)
    np.testing.assert_allclose(frame @ frame.transpose(0, 2, 1), np.tile(np.eye(3), (500, 1, 1)), atol=1e-14)
    np.testing.assert_allclose(np.linalg.det(frame), 1.0, rtol=1e-13)
    np.testing.assert_array_equal(frame[:, 0], normal)


def test_relative_velocity_is_the_rate_of_gaps_and_points(contacts):
    """D' v by finite differences: move all bodies a little, look at gaps and at material points."""
    world = new_world(heap(3, side=4), SELF)
    for _ in range(20):
        step(world)
    system = ContactSystem(world, contacts, unconstrained(world, DT))
    velocity = RNG.normal(size=(world.owned, 6))
    fixed = len(world.grains) + np.flatnonzero(~bodies.is_dynamic(world.large))
    velocity[fixed] = unconstrained(world, 1e-6).prescribed[fixed - len(world.grains)]
    rate = (dense_map(system) @ velocity.ravel()).reshape(-1, 3)

    eps = 1e-6
    before = contacts.near.bodies
    local = [
        quaternion.rotate(quaternion.conjugate(before.quaternion[row]), contacts.point - before.position[row])
        for row in (contacts.a, contacts.b)
    ]
    advance(world, unconstrained(world, eps), contacts, velocity)
    after = find_contacts(world, 0.03)
    place = {key: i for i, key in enumerate(after.key)}
    same = np.array([place[key] for key in contacts.key])
    np.testing.assert_allclose((after.gap[same] - contacts.gap) / eps, rate[:, 0], atol=3e-4)

    table = after.near.bodies
    carried = [
        table.position[row] + quaternion.rotate(table.quaternion[row], arm)
        for row, arm in zip((contacts.a, contacts.b), local)
    ]
    drift = np.einsum("cij,cj->ci", system.frame, carried[1] - carried[0]) / eps
    np.testing.assert_allclose(drift, rate, atol=3e-4)


def test_r_is_b_plus_relative_free_velocity(world, contacts, system):
    relative = (dense_map(system) @ system.free_velocity.ravel()).reshape(-1, 3)
    relative[:, 0] += np.maximum(contacts.gap / DT, -0.1)
    np.testing.assert_allclose(system.r, relative, atol=1e-12)
    assert (contacts.gap < -0.1 * DT).any()


def test_free_velocity_of_prescribed_bodies_is_the_mean_one(world, system):
    velocity = system.free_velocity[len(world.grains) :]
    np.testing.assert_array_equal(velocity[world.large_row("walls")], 0.0)
    blade = world.large_row("blade")
    np.testing.assert_array_equal(velocity[blade], unconstrained(world, DT).prescribed[blade])
    np.testing.assert_allclose(velocity[blade, 3:], [0, 0.3, 1.0], atol=1e-14)
    slab = world.large_row("slab")
    np.testing.assert_allclose(velocity[slab, :3] - world.large.velocity[slab, :3], DT * world.gravity)


def test_force_on_a_body_is_the_reaction_of_what_the_grains_feel(world, system):
    impulse = RNG.normal(size=(len(system.key), 3))
    load = (dense_map(system).T @ impulse.ravel()).reshape(-1, 6)
    for name in ("walls", "blade", "slab"):
        expected = load[len(world.grains) + world.large_row(name)] / DT
        np.testing.assert_allclose(force_on(world, system, name, impulse), expected, atol=1e-10)
    with pytest.raises(KeyError, match="no large body 'lid'"):
        force_on(world, system, "lid", impulse)


def test_no_contacts_and_bad_arguments():
    scene = Scene(friction=0.3)
    scene.add_spheres([[0, 0, 5]], 0.1, 1000.0, velocity=(1, 0, 0))
    world = new_world(scene, SELF)
    contacts = find_contacts(world, 0.01)
    system = ContactSystem(world, contacts, unconstrained(world, DT), 1.0)
    assert dense_map(system).shape == (0, 6)
    assert dense_scaled_map(system, SELF).shape == (0, 6)
    np.testing.assert_allclose(system.velocity(np.zeros((0, 3))), [[1, 0, -9.81 * DT, 0, 0, 0]])
    with pytest.raises(ValueError, match="time step must be positive"):
        ContactSystem(world, contacts, unconstrained(world, 0.0))
    with pytest.raises(ValueError, match="recovery speed"):
        ContactSystem(world, contacts, unconstrained(world, DT), -1.0)


@pytest.mark.parametrize(("approach", "counts"), [(1e-8, True), (1e-11, False)])
def test_only_what_is_more_than_rounding_closes(approach, counts):
    """Two spheres that fly side by side at 100 m/s: differences below 1e-12 of that are no velocities."""
    scene = Scene(friction=0.3, gravity=(0, 0, 0))
    scene.add_spheres([[0, 0, 0], [0.5, 0, 0]], 0.25, 1000.0, velocity=[[100.0, 0, 0], [100.0 - approach, 0, 0]])
    world = new_world(scene, SELF)
    system = ContactSystem(world, find_contacts(world, 0.01), unconstrained(world, DT))
    assert system.r[0, 0] == pytest.approx(-approach if counts else 0.0, rel=1e-4, abs=0.0)
    assert not system.r[0, 1:].any()
