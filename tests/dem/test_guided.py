"""Bodies that forces move along one direction only."""

from __future__ import annotations

import numpy as np
import pytest
from cases import crude_impulse, dense_scaled_map, force_on
from mpi4py import MPI

from dem.contact import find_contacts
from dem.motion import Guided
from dem.scene import Scene
from dem.shapes import Box, Plane
from dem.start import new_world
from dem.step import advance
from dem.step.system import ContactSystem
from dem.unconstrained import unconstrained

SELF = MPI.COMM_SELF
SLANT = (1.0, 0.0, 2.0)


def pressed(motion, **options):
    """Four spheres on a floor under a press, all with some velocity."""
    scene = Scene(0.4)
    scene.add_body("floor", [Plane((0, 0, 1))])
    places = [[0, 0, 0.1], [0.3, 0, 0.1], [0, 0.3, 0.1], [0.3, 0.3, 0.1]]
    scene.add_spheres(places, 0.1, 1000.0, velocity=(0.3, 0.1, 0.4), angular_velocity=(1.0, 2.0, 3.0))
    scene.add_body("press", [Box((0.5, 0.4, 0.05))], motion, position=(0.1, 0.1, 0.25), **options)
    return new_world(scene, SELF)


def system_of(world):
    return ContactSystem(world, find_contacts(world, 0.02), unconstrained(world, 0.01))


@pytest.mark.parametrize("direction", [(0, 0, 1), SLANT])
def test_only_the_motion_along_the_guide_answers_to_forces(direction):
    unit = np.array(direction) / np.linalg.norm(direction)
    world = pressed(Guided(direction), density=500.0, velocity=0.2 * unit)
    system = system_of(world)
    impulse = crude_impulse(system)
    force = force_on(world, system, "press", impulse)
    assert np.abs(force[[0, 2, 3, 4, 5]]).min() > 0
    mass = world.large.mass[1]
    assert mass == pytest.approx(500.0 * 1.0 * 0.8 * 0.1)
    speed = 0.2 + 0.01 * unit @ (force[:3] / mass + [0, 0, -9.81])
    velocity = system.velocity(impulse)[5]
    np.testing.assert_allclose(velocity, [*(speed * unit), 0, 0, 0], atol=1e-13)
    turn = world.large.quaternion[1].copy()
    advance(world, system.motion, system.contacts, system.velocity(impulse))
    np.testing.assert_array_equal(world.large.quaternion[1], turn)
    np.testing.assert_allclose(world.large.position[1], [0.1, 0.1, 0.25] + 0.01 * speed * unit, atol=1e-14)


def test_what_holds_a_guided_body_across_its_guide_makes_no_contact():
    """A press between two walls that it fills exactly rubs on neither; it does touch a stop in its way."""
    scene = Scene(0.4)
    scene.add_spheres([[0, 0, 5.0]], 0.1, 1000.0)
    scene.add_body("walls", [Box((0.1, 1, 1), (side * 0.6, 0, 0)) for side in (-1, 1)])
    scene.add_body("stop", [Box((0.3, 0.3, 0.1), (0, 0, -0.15))])
    scene.add_body("press", [Box((0.5, 0.5, 0.05))], Guided((0, 0, 1)), density=500.0)
    contacts = find_contacts(new_world(scene, SELF), 0.02)
    assert len(contacts) > 0
    assert set(map(tuple, contacts.body)) == {(2, 3)}  # the stop and the press
    np.testing.assert_allclose(np.abs(contacts.normal), [[0, 0, 1]] * len(contacts), atol=1e-12)
    world = new_world(scene, SELF)
    step = ContactSystem(world, contacts, unconstrained(world, 0.01))
    rows = dense_scaled_map(step, SELF)[::3]
    assert (rows**2).sum(axis=1).min() > 0  # no normal impulse without effect


def test_a_guided_motion_with_an_angular_velocity_is_refused():
    """It was ignored."""

    class Turned(Guided):
        def angular_velocity(self):
            return (0.0, 0.0, 1.0)

    with pytest.raises(ValueError, match="the motion Turned defines angular_velocity, which nothing asks for"):
        pressed(Turned((0, 0, 1)), density=500.0)
