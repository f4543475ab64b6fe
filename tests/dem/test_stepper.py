from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from cases import heap, step
from mpi4py import MPI

from dem.contact import find_contacts
from dem.motion import Glide
from dem.scene import Scene
from dem.shapes import Box
from dem.start import new_world
from dem.step import advance
from dem.step.missed import carried
from dem.step.system import ContactSystem
from dem.unconstrained import unconstrained

SELF = MPI.COMM_SELF


def fly(world, dt, steps):
    for _ in range(steps):
        contacts = find_contacts(world, 0.0)
        free = unconstrained(world, dt)
        advance(world, free, contacts, ContactSystem(world, contacts, free).velocity(np.zeros((len(contacts), 3))))


def test_a_body_is_where_its_motion_puts_it_from_the_start_on():
    """A motion that began before time zero: no jump in the first step, and overlaps are seen at the true place."""
    scene = Scene(friction=0.3)
    scene.add_spheres([[0, 0, 5]], 0.1, 1000.0)
    scene.add_body("plate", [Box((0.1, 0.1, 0.1))], Glide((0.0, 0.0, -2.0), start=-0.5), position=(1, 0, 4))
    world = new_world(scene, SELF)
    np.testing.assert_allclose(world.large.position[0], [1, 0, 3])
    fly(world, 0.01, 1)
    np.testing.assert_allclose(world.large.position[0], [1, 0, 3 - 0.02])
    scene.add_body("press", [Box((0.1, 0.1, 0.1))], Glide((0.0, 0.0, -2.0), start=-0.5), position=(0, 0, 6))
    with pytest.raises(ValueError, match="grain 0 and body 'press' overlap"):
        new_world(scene, SELF)


def test_a_step_changes_no_array_of_the_step_before():
    world = new_world(heap(1, side=3), SELF)
    before = world.grains
    kept = {name: (column, column.copy()) for name, column in before.columns().items()}
    contacts = step(world)
    assert len(contacts) > 0
    assert np.abs(world.grains.position - kept["position"][1]).max() > 0
    for column, copy in kept.values():
        np.testing.assert_array_equal(column, copy)


def test_a_wider_search_keeps_the_contacts_that_were_linearised_anew():
    world = new_world(heap(), SELF, overlap=1.0)
    found = find_contacts(world, 0.02, unconstrained(world, 0.001))
    anew = replace(found, gap=found.gap - 1.0)  # such gaps come from no search
    wider = find_contacts(world, 0.02, unconstrained(world, 0.001), np.full(len(world.grains), 0.05))
    both = carried(world, anew, wider)
    assert len(found) < len(wider)
    np.testing.assert_array_equal(both.key[both.gap < -0.5], found.key)
    np.testing.assert_array_equal(np.sort(both.key), np.sort(wider.key))
    np.testing.assert_array_equal(both.near.index[both.a], both.body[:, 0])
