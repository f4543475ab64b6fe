"""run/study compare_chrono without Chrono: what its driver gets, and what is made of its answer."""

from __future__ import annotations

import compare_chrono
import numpy as np
import pytest
from mpi4py import MPI

from dem.contact import find_contacts
from dem.motion import Glide
from dem.scene import Scene
from dem.shapes import Box, Plane
from dem.start import new_world


@pytest.fixture
def state():
    """Two spheres on a floor that touch each other; a box pushes one of them."""
    scene = Scene(friction=0.3)
    scene.add_spheres([[0, 0, 0.1], [0.2, 0, 0.1]], 0.1, 1000.0, velocity=[[0.5, 0, 0], [0, 0.2, 0]])
    scene.add_body("floor", [Plane((0, 0, 1))])
    scene.add_body("pusher", [Box((0.1, 0.1, 0.1))], Glide((1, 0, 0)), position=(-0.2, 0, 0.1))
    return compare_chrono.State("pushed", new_world(scene, MPI.COMM_SELF, np.inf), 0.01, 0.001)


def test_the_scene_has_the_bodies_in_the_order_of_their_indices(state):
    numbers = np.array(compare_chrono.scene_text(state).split(), dtype=float)
    assert numbers[:8].tolist() == [0, 0, -9.81, 0.01, 0.001, 0.3, 2, 2]
    spheres, boxes = numbers[8:32].reshape(2, 12), numbers[32:].reshape(2, 16)
    np.testing.assert_array_equal(spheres[:, :3], state.world.grains.position)
    np.testing.assert_array_equal(spheres[:, 9], 0.1)
    floor, pusher = boxes
    assert floor[2] + floor[15] == pytest.approx(0.0, abs=1e-12)
    assert (np.abs(floor[:2]) + 0.5 < floor[13:15]).all()
    np.testing.assert_allclose(pusher, [-0.2, 0, 0.1, 1, 0, 0, 0, 1, 0, 0, 0, 0, 0, 0.1, 0.1, 0.1], atol=1e-12)


def test_impulses_come_back_whatever_the_order_of_contacts_and_bodies(state):
    step = compare_chrono.assembled(state, find_contacts(state.world, state.delta))
    rng = np.random.default_rng(0)
    count = len(step.body)
    assert count == 4
    impulse, order, turned = rng.normal(size=(count, 3)), rng.permutation(count), np.array([1, 0, 1, 0], dtype=bool)
    theirs = np.zeros(count, dtype=compare_chrono.CONTACT)
    theirs["body"] = np.where(turned[:, None], step.body[:, ::-1], step.body)
    theirs["impulse"] = np.einsum("ci,cij->cj", impulse, step.frame) * np.where(turned, -1.0, 1.0)[:, None]
    np.testing.assert_allclose(compare_chrono.mapped(step.body, step.frame, theirs[order]), impulse)
    with pytest.raises(compare_chrono.DriverError, match="4 here and 3 in Chrono; 1 are only here, 0 only there"):
        compare_chrono.mapped(step.body, step.frame, theirs[1:])
