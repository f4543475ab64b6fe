"""Lists of pairs that are kept over steps: a search with them finds what a fresh one finds, bit for bit."""

from __future__ import annotations

from copy import copy
from dataclasses import replace

import numpy as np
import pytest
from cases import crude_impulse, heap
from mpi4py import MPI

from dem.contact import find_contacts
from dem.model.partition import rebalance
from dem.motion import Hinged, Rotation
from dem.scene import Scene
from dem.shapes import Box, Mesh, Plane
from dem.start import new_world, restored_world
from dem.step import advance
from dem.step.system import ContactSystem
from dem.unconstrained import unconstrained

DT = 0.005


def among_walls():
    """All shapes of grains among walls, with a fast blade, an oscillating ball and a free slab."""
    return heap(3, side=4, capsules=True)


def among_surfaces():
    """Spheres and capsules about a tumbling tetrahedron of triangles and a driven paddle, in a tilted box."""
    rng = np.random.default_rng(2)
    scene = Scene(0.3, gravity=(1.0, 0, -9.81))
    grid = np.stack(np.meshgrid(*[0.23 * np.arange(5)] * 3, indexing="ij"), axis=-1).reshape(-1, 3) + 0.15
    grid[:, 2] += 0.8
    speed = rng.normal(size=grid.shape)
    scene.add_spheres(grid[::2], rng.uniform(0.06, 0.11, len(grid[::2])), 1000.0, velocity=speed[::2])
    scene.add_capsules(grid[1::2], 0.05, 0.04, 1000.0, velocity=speed[1::2], angular_velocity=9.0 * speed[1::2])
    walls = [Plane((0, 0, 1)), Plane((1, 0, 0)), Plane((-1, 0, 0), (1.3, 0, 0)), Plane((0, 1, 0))]
    scene.add_body("box", [*walls, Plane((0, -1, 0), (0, 1.3, 0))])
    corners = 0.25 * np.array([[1.0, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]])
    faces = [[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]]
    scene.add_body("tool", [Mesh(corners, faces)], Rotation((0, 1, 6.0)), position=(0.6, 0.6, 0.5))
    return scene


def among_blades():
    """Spheres of two sizes about a wheel of boxes that a servo drives."""
    rng = np.random.default_rng(4)
    scene = Scene(0.3)
    grid = np.stack(np.meshgrid(*[0.23 * np.arange(5)] * 3, indexing="ij"), axis=-1).reshape(-1, 3) + 0.15
    scene.add_spheres(grid + [0, 0, 0.8], rng.choice([0.05, 0.11], len(grid)), 1000.0, velocity=(0.4, 0, -2.0))
    walls = [Plane((0, 0, 1)), Plane((1, 0, 0)), Plane((-1, 0, 0), (1.3, 0, 0)), Plane((0, 1, 0))]
    scene.add_body("box", [*walls, Plane((0, -1, 0), (0, 1.3, 0))])
    turns = [(1.0, 0, 0, 0), (np.sqrt(0.5), 0, np.sqrt(0.5), 0)]
    blades = [Box((0.4, 0.3, 0.02), (0, 0, 0), turn) for turn in turns]
    motion = Hinged((0, 1, 0), torque=500.0, speed=4.0)
    scene.add_body("wheel", blades, motion, position=(0.65, 0.65, 0.4), density=500.0)
    return scene


def in_a_flow():
    """Spheres in a cell that is sheared and changes its size."""
    scene = Scene(0.3, (0, 0, 0), stiffness=1e4, period=(1.15,) * 3, shear_rate=3.0, strain_rate=(0.1, -0.2, 0.3))
    grid = np.stack(np.meshgrid(*[0.23 * np.arange(5)] * 3, indexing="ij"), axis=-1).reshape(-1, 3) + 0.11
    speed = np.random.default_rng(5).normal(size=grid.shape)
    scene.add_spheres(grid, 0.11, 1000.0, velocity=2.0 * speed + grid[:, [1, 1, 1]] * [3.0, 0, 0])
    return scene


def assert_same(found, expected, ranks):
    for name, column in expected.columns().items():
        # the rows of ghosts and of what follows differ: the lists may know of more ghosts
        if ranks == 1 or name not in ("a", "b"):
            np.testing.assert_array_equal(getattr(found, name), column, err_msg=name)
    np.testing.assert_array_equal(found.near.margin[: found.near.grains], expected.near.margin[: found.near.grains])


def forgetful(world):
    """The world without the lists of the last search."""
    other = copy(world)
    other.grains, other.lists = replace(world.grains), None
    return other


@pytest.mark.parallel(1, 2, 3)
@pytest.mark.parametrize("make", [among_walls, among_surfaces, among_blades, in_a_flow])
def test_a_search_with_kept_lists_finds_what_a_fresh_one_finds(make):
    comm, scene = MPI.COMM_WORLD, make()
    world = new_world(scene, comm)
    made, lists = 0, None
    for n in range(26):
        rebalance(world, 1.2)
        if n == 20:  # a restart
            world = restored_world(scene, comm, *world.state())
        free = unconstrained(world, DT)
        contacts = find_contacts(world, 0.01, free)
        made += contacts.lists is not lists
        lists = contacts.lists
        if n % 2:
            assert_same(contacts, find_contacts(forgetful(world), 0.01, free), comm.size)
        if n % 10 == 3:  # as of a step in which a grain goes further than was seen
            margin = np.where(world.grains.id % 5 == 0, 0.05, 0.0)
            wider = find_contacts(world, 0.01, free, margin)
            assert_same(wider, find_contacts(forgetful(world), 0.01, free, margin), comm.size)
            assert comm.allreduce(len(wider)) > comm.allreduce(len(contacts))
            contacts, lists = replace(contacts, lists=wider.lists), wider.lists
        system = ContactSystem(world, contacts, free, recovery_speed=0.5)
        advance(world, system.motion, system.contacts, system.velocity(crude_impulse(system)))
    assert comm.allreduce(len(contacts)) > 50
    assert 4 < made < 18  # else nothing was shown


def test_other_grains_and_places_need_new_lists():
    world = new_world(among_walls(), MPI.COMM_SELF)
    world.lists = lists = find_contacts(world, 0.01).lists
    assert find_contacts(world, 0.01).lists is lists
    world.grains.position = world.grains.position + [0.2, 0.0, 0.0]
    moved = find_contacts(world, 0.01)
    assert moved.lists is not lists
    assert_same(moved, find_contacts(forgetful(world), 0.01), 1)
    world.lists, world.grains.size = moved.lists, 1.1 * world.grains.size
    thick = find_contacts(world, 0.01)
    assert thick.lists is not moved.lists
    assert len(thick) > len(moved)
    world.set_grains(world.grains.take(slice(0, 50)))
    assert_same(find_contacts(world, 0.01), find_contacts(forgetful(world), 0.01), 1)
