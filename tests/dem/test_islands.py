"""Islands of bodies at rest, against the connected components of the contacts of all ranks."""

from __future__ import annotations

import numpy as np
import pytest
from mpi4py import MPI
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

import pctt
from dem.scene import Scene
from dem.shapes import Plane
from dem.step.islands import contacts_at_rest

R, SLOW, GRAVITY = 0.05, 0.3, 9.81
JOINED = [(9, 14), (30, 41)]  # spheres of columns that rest


def field(joined=()):
    """Columns and rows of up to five spheres on a floor, of which every third is thrown."""
    rng = np.random.default_rng(11)
    scene = Scene(friction=0.4)
    scene.add_body("floor", [Plane((0, 0, 1))])
    for k in range(24):
        count, flat, corner = 1 + k % 5, k % 2, np.array([0.6 * (k % 6), 0.5 * (k // 6), R])
        way = np.array([2 * R * flat, 0, 2 * R * (1 - flat)])
        thrown = rng.normal(0, 1.5, 3) * [k % 3 == 0, k % 3 == 0, 0]
        scene.add_spheres([corner + i * way for i in range(count)], R, 2500.0, velocity=thrown)
    for k, (one, two) in enumerate(joined):
        scene.add_joint(f"bar {k}", one, two, kind="ball", anchor=(1, 1, R))
    return scene


def pairs_at_rest(bodies, velocity, links, dt):
    """The pairs (nc, 2) of bodies of the contacts that rest, the floor being the last body, by scipy."""
    count = len(velocity)
    a, b = bodies.min(axis=1), bodies.max(axis=1)
    links = np.concatenate([np.stack([a, b], axis=1)[b < count], np.reshape(links, (-1, 2))]).astype(int)
    island = connected_components(coo_matrix((np.ones(len(links)), links.T), (count, count)), directed=False)[1]
    square = (velocity**2).sum(axis=1, where=np.arange(6) < 3) + 0.4 * (R * velocity[:, 3:] ** 2 * R).sum(axis=1)
    kinetic, fall = np.bincount(island, square), np.bincount(island) * (GRAVITY * dt) ** 2
    rests = (kinetic < SLOW * fall) & (np.bincount(island) > 1)
    return {(i, j) for i, j in zip(a[rests[island[a]]].tolist(), b[rests[island[a]]].tolist())}


@pytest.mark.parallel(1, 2, 3)
@pytest.mark.parametrize("joined", [(), JOINED], ids=["free", "joined"])
def test_the_islands_at_rest_are_those_of_the_whole(joined):
    sim = pctt.Simulation(field(joined), comm=MPI.COMM_WORLD)
    sim.run(steps=6)
    before = sim.velocities
    sim.step()
    system, ids = sim.last.system, np.append(sim.ids, sim.world.large.id)
    contacts, part = contacts_at_rest(sim.last.world, system, np.zeros(len(system.contacts)), SLOW)
    found = system.contacts
    id = system.near.bodies.id
    pairs = np.searchsorted(ids, np.stack([id[found.a], id[found.b]], axis=1)[contacts])
    gathered = {tuple(sorted(pair)) for piece in sim.comm.allgather(pairs.tolist()) for pair in piece}
    links = [(one, two) for one in np.ravel(joined) for two in np.ravel(joined)]
    wanted = pairs_at_rest(sim.contacts.bodies, before, links, system.dt)
    assert gathered == wanted
    assert 10 < len(wanted) < len(sim.contacts.bodies) - 3
    assert 0.0 <= part < SLOW


def test_what_a_tool_passes_does_not_rest():
    sim = pctt.Simulation(field(), comm=MPI.COMM_SELF)
    sim.run(steps=3)
    system = sim.last.system
    still = np.zeros(len(system.contacts))
    rest, _ = contacts_at_rest(sim.last.world, system, still, SLOW)
    passed = still.copy()
    passed[rest[0]] = 2 * GRAVITY * system.dt
    left, _ = contacts_at_rest(sim.last.world, system, passed, SLOW)
    assert rest[0] not in left
    assert set(left) < set(rest)
