"""The compiled loops against the numpy code that runs without numba."""

from __future__ import annotations

import numpy as np
import pytest
from cases import contacts_by_key, crude_impulse, heap, random_quaternions, step
from mpi4py import MPI

from dem import free_motion, impulses, quaternion
from dem import system as contact_system
from dem.contact import broad, find_contacts, primitives, search
from dem.free_motion import free_spin
from dem.loops import loops
from dem.scene import Scene
from dem.start import new_world
from dem.system import ContactSystem

SELF = MPI.COMM_SELF

pytestmark = pytest.mark.skipif(loops() is None, reason="no numba")


@pytest.fixture
def without_loops(monkeypatch):
    """A function that calls another as if numba were not there."""

    def call(work, *arguments):
        with monkeypatch.context() as patch:
            for module in (broad, contact_system, free_motion, impulses, primitives, quaternion, search):
                patch.setattr(module, "loops", lambda: None)
            return work(*arguments)

    return call


def sorted_rows(pairs):
    return pairs[np.lexsort(pairs.T[::-1])]


@pytest.mark.parametrize("count", [0, 1, 2, 50, 2000])
@pytest.mark.parametrize("decades", [0, 2])
def test_pairs_in_cells(count, decades):
    rng = np.random.default_rng(count)
    position, radius = rng.uniform(-1, 1, (count, 3)), 10.0 ** rng.uniform(-1.5 - decades, -1.0, count)
    position[::7] *= 1e5  # some far away
    pairs = sorted_rows(broad.close_pairs(position, radius + 0.005))
    close = []
    for i in range(count):
        distance = np.linalg.norm(position[i + 1 :] - position[i], axis=1)
        close += [(i, i + 1 + j) for j in np.flatnonzero(distance <= radius[i] + radius[i + 1 :] + 0.01)]
    np.testing.assert_array_equal(pairs, np.array(close).reshape(-1, 2))


def test_pairs_of_spheres_that_touch_to_rounding_and_of_concentric_ones():
    grid = np.stack(np.meshgrid(*[0.2 * np.arange(6)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    assert len(broad.close_pairs(grid, np.full(len(grid), 0.1))) == 3 * 5 * 36
    assert len(broad.close_pairs(np.zeros((5, 3)), np.ones(5))) == 10


def test_order():
    rng = np.random.default_rng(1)
    for count, groups in ((0, 1), (1, 1), (500, 1), (500, 7), (500, 1000)):
        key, major = rng.permutation(10**6)[:count], rng.integers(0, groups, count)
        np.testing.assert_array_equal(loops().lexsort(key, major, groups), np.lexsort((key, major)))


def run(capsules):
    """Contacts, systems and velocities of some steps."""
    world = new_world(heap(5, side=4, capsules=capsules), SELF)
    for _ in range(15):
        step(world)
    contacts = find_contacts(world, 0.03, 0.01)
    system = ContactSystem(world, contacts, 0.01)
    numbers = {"frame": system.frame, "r": system.r, "velocity": system.velocity(crude_impulse(system))}
    return numbers | contacts_by_key(contacts, SELF)


@pytest.mark.parametrize("capsules", [False, True])
def test_steps_are_the_same(capsules, without_loops):
    compiled, plain = run(capsules), without_loops(run, capsules)
    assert len(plain["key"]) > 100
    for name, value in plain.items():
        np.testing.assert_allclose(compiled[name], value, rtol=0, atol=1e-9 * max(1.0, np.abs(value).max()))


def test_contacts_of_equal_bodies_agree_to_rounding(without_loops):
    """Frames, gaps and points of the same positions, of concentric spheres too."""
    rng = np.random.default_rng(2)
    scene = Scene(friction=0.2)
    scene.add_spheres(rng.uniform(-0.4, 0.4, (200, 3)), rng.uniform(0.05, 0.1, 200), 1000.0)
    scene.add_spheres([[2.0, 0, 0]] * 2, [0.1, 0.05], 1000.0)
    world = new_world(scene, SELF, overlap=np.inf)
    compiled, plain = (contacts_by_key(call(find_contacts, world, 0.02), SELF) for call in (_call, without_loops))
    assert len(plain["key"]) > 500
    for name, value in plain.items():
        np.testing.assert_allclose(compiled[name], value, rtol=1e-13, atol=1e-13)


def test_no_contacts(without_loops):
    """Every function of no contacts, with and without numba: shapes and types."""
    none, rows = np.zeros((0, 3)), np.zeros((0, 2), np.int64)
    frame, arm, position = np.zeros((0, 3, 3)), np.zeros((0, 6)), np.zeros((4, 3))
    calls = {
        (0, 3, 3): (contact_system.contact_frames, none),
        (0, 6): (contact_system.contact_arms, none, position, rows),
        (0, 3): (contact_system.relative_velocity, frame, arm, rows, np.zeros((4, 6))),
        (4, 6): (contact_system.sum_of_impulses, frame, arm, rows, none, 4),
        (0, 4): (impulses.in_the_world, none, frame),
    }
    for shape, (work, *arguments) in calls.items():
        for result in (work(*arguments), without_loops(work, *arguments)):
            assert result.shape == shape
            assert result.dtype == np.float64
            assert not result.any()


def test_impulses_in_the_world_and_back(without_loops):
    rng = np.random.default_rng(4)
    normal, impulse = rng.normal(size=(50, 3)), rng.normal(size=(50, 3))
    frame = contact_system.contact_frames(normal / np.linalg.norm(normal, axis=1, keepdims=True))
    stored = impulses.in_the_world(impulse, frame)
    np.testing.assert_allclose(stored, without_loops(impulses.in_the_world, impulse, frame), atol=1e-15)
    np.testing.assert_allclose(impulses.in_frames(stored, frame), impulse, atol=1e-14)
    np.testing.assert_allclose(without_loops(impulses.in_frames, stored, frame), impulse, atol=1e-14)


def test_orientations(without_loops):
    rng = np.random.default_rng(6)
    turn, spin = random_quaternions(rng, 30), 20.0 * rng.normal(size=(30, 3))
    spin[:3] = 0.0
    spin[3:6] *= 1e-12
    plain = without_loops(quaternion.integrate, turn, spin, 0.02)
    np.testing.assert_allclose(quaternion.integrate(turn, spin, 0.02), plain, atol=1e-15)


def _call(work, *arguments):
    return work(*arguments)


@pytest.mark.parametrize("turn", [1e-9, 0.01, 0.3, 1.0, 30.0, 1e6])
def test_free_spins_agree(turn, without_loops):
    """Also of rods and plates, of bodies at rest, of a step that turns too far, and of a body that is lost. The loop
    ends Newton's method for each body, numpy for all."""
    rng = np.random.default_rng(0)
    moments = np.concatenate([rng.uniform(0.5, 1.0, (40, 3)), [[1.0, 1.0, 1e-3], [0.5, 0.5, 1.0], [1.0, 1.0, 1.0]]])
    spin = rng.normal(size=(43, 3)) * turn / 0.01
    spin[:3] = 0.0, np.nan, np.inf
    frame = random_quaternions(rng, 43)
    compiled, plain = (call(free_spin, frame, spin, moments, 0.01) for call in (_call, without_loops))
    np.testing.assert_allclose(compiled, plain, rtol=1e-9, atol=1e-10 * turn / 0.01)


def test_there_are_no_loops_where_numba_is_switched_off(monkeypatch):
    monkeypatch.setattr("numba.config.DISABLE_JIT", 1)
    assert loops.__wrapped__() is None
