"""The state of a world, and one world on any number of ranks."""

from __future__ import annotations

import numpy as np
import pytest
from cases import contacts_by_key, dense_map, force_on, heap, step
from mpi4py import MPI
from several_ranks import alone

from dem import bodies
from dem.contact import find_contacts
from dem.model.partition import rebalance
from dem.scene import Scene
from dem.shapes import Plane
from dem.start import new_world, restored_world
from dem.step import advance
from dem.step.system import ContactSystem
from dem.unconstrained import unconstrained

SELF = MPI.COMM_SELF


def test_a_state_of_another_scene_is_refused():
    local, replicated = new_world(heap(1, side=3), SELF).state()
    with pytest.raises(ValueError, match="the state has 27 grains and 4 large bodies, the scene 64 and 4"):
        restored_world(heap(1, side=4), SELF, local, replicated)
    with pytest.raises(ValueError, match="the scene 27 and 0"):
        restored_world(heap(1, side=3, large=False), SELF, local, replicated)


def contacts_of(comm, delta, dt):
    world = new_world(heap(2, side=6, capsules=True), comm)
    for _ in range(2):
        step(world)
    contacts = find_contacts(world, delta, unconstrained(world, dt) if dt else None)
    # Every contact on the rank of its lower body, in order.
    owner = contacts.body.min(axis=1)
    end = world.slabs[comm.rank + 1] + (len(world.large) if comm.rank == comm.size - 1 else 0)
    assert ((world.slabs[comm.rank] <= owner) & (owner < end)).all()
    # First those of which both bodies are of this rank or of prescribed motion.
    large = np.maximum(contacts.body - world.slabs[-1], -1)
    prescribed = (large >= 0) & ~bodies.is_dynamic(world.large)[large]
    own = (world.slabs[comm.rank] <= contacts.body) & (contacts.body < end)
    boundary = ~(own | prescribed).all(axis=1)
    assert (np.lexsort((contacts.key, owner, boundary)) == np.arange(len(contacts))).all()
    assert (contacts.body[:, 0] == contacts.near.index[contacts.a]).all()
    if comm.size > 1:
        assert comm.allreduce(contacts.near.ghosts) > 10
        assert comm.allreduce(int(boundary.sum())) > 10
    return contacts_by_key(contacts, comm)


@pytest.mark.parallel(2, 3, 4)
@pytest.mark.parametrize(("delta", "dt"), [(0.06, 0.0), (0.01, 0.06)])
def test_the_contacts_are_the_same_on_any_number_of_ranks(delta, dt):
    found, expected = contacts_of(MPI.COMM_WORLD, delta, dt), alone(lambda comm: contacts_of(comm, delta, dt))
    assert len(expected["key"]) > 300
    for name in ("key", "a", "b", "friction"):
        np.testing.assert_array_equal(found[name], expected[name])
    for name in ("point", "normal", "gap"):
        np.testing.assert_allclose(found[name], expected[name], atol=1e-11)


@pytest.mark.parallel(1, 3, 4)
def test_errors_reach_all_ranks_and_one_body_is_enough():
    comm = MPI.COMM_WORLD

    # Errors that one rank sees are raised by all.
    scene = Scene(friction=0.3)
    scene.add_spheres([[0.3 * k, 0, 1.0] for k in range(20)], 0.1, 1000.0)
    scene.add_body("floor", [Plane((0, 0, 1))])
    world = new_world(scene, comm)
    if comm.rank == comm.size - 1:
        world.grains.position[0] = np.nan
    with pytest.raises(FloatingPointError, match="no finite position"):
        find_contacts(world, 0.01)
    scene.add_spheres([[0.05, 0, 1.0]], 0.1, 1000.0)
    with pytest.raises(ValueError, match="grain 0 and grain 20 overlap by 0.15 m"):
        new_world(scene, comm)
    boxes = Scene(friction=0.3)
    boxes.add_boxes([[0, 0, 0], [0.15, 0, 0], [5, 0, 0]], (0.1, 0.1, 0.1), 1000.0)
    with pytest.raises(ValueError, match="grain 0 and grain 1 overlap by 0.05 m"):
        new_world(boxes, comm)

    # One body on many ranks, without and with a contact.
    for height in (5.0, 0.1):
        scene = Scene(friction=0.3)
        scene.add_spheres([[0, 0, height]], 0.1, 1000.0)
        scene.add_body("floor", [Plane((0, 0, 1))])
        world = new_world(scene, comm)
        for _ in range(3):
            contacts = find_contacts(world, 0.01)
            system = ContactSystem(world, contacts, unconstrained(world, 0.01))
            impulse = np.zeros((len(contacts), 3))
            impulse[:, 0] = world.grains.mass[0] * 9.81 * 0.01 if len(world.grains) else 0.0
            assert dense_map(system).shape == (3 * len(contacts), 12)
            force = force_on(world, system, "floor", impulse)
            advance(world, system.motion, system.contacts, system.velocity(impulse))
            rebalance(world)
        assert comm.allreduce(len(contacts)) == (height < 1)
        if height < 1:
            np.testing.assert_allclose(force[2], -1000 * 4 / 3 * np.pi * 0.1**3 * 9.81)
            assert comm.allreduce(float(np.abs(world.grains.velocity).sum())) < 1e-12
