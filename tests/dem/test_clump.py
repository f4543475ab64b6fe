"""Clumps of spheres: mass and moments of unions, and contacts sphere by sphere."""

from __future__ import annotations

import numpy as np
import pytest
from mpi4py import MPI

from dem import quaternion
from dem.bodies import CLUMP
from dem.contact import find_contacts
from dem.free_motion import free_velocity
from dem.measures import Block, solid_fraction
from dem.scene import Scene
from dem.shapes import Clump, Plane, clumps
from dem.start import new_world
from pctt.simulation import Simulation

DUMBBELL = Clump([(-0.1, 0, 0), (0.2, 0, 0)], [0.1, 0.05])
TRIPOD = Clump([(0.1, 0, 0), (-0.05, 0.0866, 0), (-0.05, -0.0866, 0)], [0.06, 0.06, 0.06])


def test_mass_and_moments_of_a_dumbbell_are_exact():
    one, two = 4 / 3 * np.pi * 0.1**3, 4 / 3 * np.pi * 0.05**3
    reduced, axial = one * two / (one + two), 0.4 * (one * 0.1**2 + two * 0.05**2)
    found = clumps.form(DUMBBELL)
    np.testing.assert_allclose(found.volume, one + two, rtol=1e-14)
    np.testing.assert_allclose(found.place, [(-0.1 * one + 0.2 * two) / (one + two), 0, 0], atol=1e-16)
    np.testing.assert_allclose(found.moments, [axial, axial + reduced * 0.3**2, axial + reduced * 0.3**2], rtol=1e-13)
    np.testing.assert_allclose(found.center.T @ (found.radius**3), 0.0, atol=1e-17)


@pytest.mark.parametrize("apart", [0.02, 0.1, 0.19])
@pytest.mark.parametrize("axis", [(0, 0, 1), (1, 0, 0), (2, -1, 2), (0.3, 0.5, -0.7)])
def test_two_equal_balls_that_overlap(apart, axis):
    """The union is two balls, each cut at the plane in the middle: a ball of which z < -d is cut off, with d half the
    distance. V = pi (2/3 R^3 + R^2 d - d^3/3), and the integrals of z^2 and r^2 over its slices are polynomials."""
    R, d = 0.1, apart / 2
    z = np.polynomial.Polynomial([0, 1])
    area = np.pi * (R**2 - (z - d) ** 2)  # of the half with z > 0, its centre at z = d

    def over(p):
        whole = p.integ()
        return 2 * (whole(R + d) - whole(0))

    volume, along, across = over(area), over(area * z**2), over(area**2 / (4 * np.pi))
    axis = np.array(axis) / np.linalg.norm(axis)
    found, place, tensor = clumps.union(np.array([0.5 * apart * axis, -0.5 * apart * axis]), np.array([R, R]))
    np.testing.assert_allclose(found, volume, rtol=1e-6)
    np.testing.assert_allclose(place, 0, atol=1e-6 * R)
    expected = 2 * across * np.outer(axis, axis) + (along + across) * (np.eye(3) - np.outer(axis, axis))
    np.testing.assert_allclose(tensor, expected, atol=2e-6 * np.trace(expected))


def test_the_lens_is_within_the_stated_error():
    R, d = 0.1, 0.13
    lens = np.pi * (4 * R + d) * (2 * R - d) ** 2 / 12
    found, _, _ = clumps.union(np.array([[0.3, 0.2, 0.1], [0.3 + 0.05, 0.2 + 0.12, 0.1]]), np.array([R, R]))
    np.testing.assert_allclose(2 * 4 / 3 * np.pi * R**3 - found, lens, rtol=1e-5)


def test_what_three_balls_share_counts_once():
    """A small ball in a larger one, twice the same ball, and three in a row of which each two share a lens."""
    whole, one = 4 / 3 * np.pi * 0.1**3, np.array([0.1])
    same, _, tensor = clumps.union(np.zeros((4, 3)) + [0.1, 0.2, 0.3], np.array([0.1, 0.1, 0.05, 0.1]))
    np.testing.assert_allclose(same, whole, rtol=1e-5)
    np.testing.assert_allclose(tensor, clumps.union(np.zeros((1, 3)), one)[2], atol=1e-5 * tensor.max())
    row = np.array([[0.0, 0, 0], [0.15, 0, 0], [0.3, 0, 0]])
    lens = np.pi * (4 * 0.1 + 0.15) * (2 * 0.1 - 0.15) ** 2 / 12
    np.testing.assert_allclose(clumps.union(row, np.full(3, 0.1))[0], 3 * whole - 2 * lens, rtol=1e-6)


def test_the_frame_goes_to_the_centre_of_mass():
    """The spheres are where the user has put them."""
    scene, turn = Scene(0.3), np.array([0.5, -0.5, 0.1, 0.7]) / 1.0
    turn /= np.linalg.norm(turn)
    shape = Clump([(0, 0, 0), (0.1, 0.2, 0), (0.1, 0.2, 0.3)], [0.05, 0.08, 0.06])
    ids = scene.add_clumps([(1, 2, 3), (4, 5, 6)], shape, 1000.0, quaternions=turn)
    scene.add_clumps((7, 8, 9), Clump([(0, 0, 0), (0.1, 0.2, 0), (0.1, 0.2, 0.3)], [0.05, 0.08, 0.06]), 500.0)
    assert ids.tolist() == [0, 1]
    assert len(scene.forms) == 1
    grains, form = scene.grains(), scene.forms[0]
    assert (grains.shape == CLUMP).all()
    for n, (origin, own) in enumerate([((1, 2, 3), turn), ((4, 5, 6), turn), ((7, 8, 9), np.array([1.0, 0, 0, 0]))]):
        found = grains.position[n] + quaternion.rotate(grains.quaternion[n], form.center)
        np.testing.assert_allclose(found, origin + quaternion.rotate(own, np.array(shape.centres)), atol=1e-14)
    np.testing.assert_allclose(grains.mass, form.volume * np.array([1000, 1000, 500]))
    around = np.linalg.norm(form.center, axis=1) + form.radius
    np.testing.assert_allclose(grains.size[:, 0], around.max())


@pytest.mark.parametrize(
    ("centres", "radii"),
    [
        ([(0, 0, 0)], [0.1, 0.2]), ([(0, 0, 0)], [0.0]), ([(0, 0)], [0.1]), (np.zeros((0, 3)), []),
        ([(0, 0, np.nan)], [1]),
    ],
)
def test_bad_clumps(centres, radii):
    with pytest.raises(ValueError, match="Clump"):
        Clump(centres, radii)


def test_free_spin_keeps_the_angular_momentum():
    scene = Scene(0.3, gravity=(0, 0, 0))
    shape = Clump([(0, 0, 0), (0.1, 0.2, 0), (0.1, 0.2, 0.3)], [0.05, 0.08, 0.06])
    scene.add_clumps((0, 0, 0), shape, 1000.0, angular_velocity=(3.0, -2.0, 5.0))
    table, dt = scene.grains(), 0.01

    def momentum(half):
        """In the middle of a step, where the integrator keeps it."""
        turn = quaternion.integrate(table.quaternion, table.velocity[:, 3:], half)
        frame = quaternion.matrix(turn)[0]
        return frame @ (table.inertia[0] * (quaternion.matrix(table.quaternion)[0].T @ table.velocity[0, 3:]))

    before = momentum(0.5 * dt)
    for _ in range(200):
        table.quaternion = quaternion.integrate(table.quaternion, table.velocity[:, 3:], dt)
        table.velocity = free_velocity(table, np.zeros(3), dt)
    np.testing.assert_allclose(momentum(0.5 * dt), before, rtol=1e-6)


def world_of(scene, comm=MPI.COMM_SELF):
    return new_world(scene, comm, overlap=0.5)


def spheres_of(grains, form):
    """Centres (n, k, 3) of the spheres of clumps of one form."""
    turned = quaternion.rotate(grains.quaternion[:, None], form.center[None])
    return grains.position[:, None] + turned


def test_contacts_are_those_of_the_spheres():
    """All pairs of spheres of different clumps whose gap is within delta, with the gap of two spheres; and distinct
    keys."""
    rng, scene, delta = np.random.default_rng(0), Scene(0.3), 0.03
    scene.add_body("floor", [Plane((0, 0, 1), (0, 0, -0.3))])
    turns = rng.normal(size=(40, 4))
    scene.add_clumps(rng.uniform(-0.3, 0.3, (20, 3)), DUMBBELL, 1000.0, quaternions=turns[:20])
    scene.add_clumps(rng.uniform(-0.3, 0.3, (20, 3)), TRIPOD, 1000.0, quaternions=turns[20:])
    scene.add_spheres(rng.uniform(-0.3, 0.3, (5, 3)), 0.05, 1000.0)
    world = new_world(scene, MPI.COMM_SELF, overlap=np.inf)
    found = find_contacts(world, delta)
    assert len(np.unique(found.key)) == len(found)
    grains, place, radius, of = world.grains, [], [], []
    for n in range(len(grains)):
        form = scene.forms[grains.shape[n] - CLUMP] if grains.shape[n] >= CLUMP else None
        at = grains.position[n][None] if form is None else spheres_of(grains.take([n]), form)[0]
        place.append(at)
        radius.append(grains.size[n, :1] if form is None else form.radius)
        of += [n] * len(at)
    place, radius, of = np.concatenate(place), np.concatenate(radius), np.array(of)
    i, j = np.triu_indices(len(of), 1)
    gap = np.linalg.norm(place[i] - place[j], axis=1) - radius[i] - radius[j]
    near = (gap <= delta) & (of[i] != of[j])
    floor = place[:, 2] + 0.3 - radius
    expected = np.sort(np.concatenate([gap[near], floor[floor <= delta]]))
    np.testing.assert_allclose(np.sort(found.gap), expected, atol=1e-14)
    pairs = np.sort(np.stack([of[i], of[j]], axis=1)[near], axis=1)
    mine = found.b < len(grains)
    seen = np.sort(np.stack([grains.id[found.a], found.near.bodies.id[found.b]], axis=1)[mine], axis=1)
    owned = np.sort(grains.id[pairs], axis=1)
    np.testing.assert_array_equal(owned[np.lexsort(owned.T)], seen[np.lexsort(seen.T)])


def test_contacts_with_other_grains():
    """A dumbbell meets a capsule with both its balls."""
    scene = Scene(0.3)
    shape = Clump([(-0.1, 0, 0), (0.1, 0, 0)], [0.05, 0.05])
    scene.add_capsules((0, 0, 0), 0.05, 0.3, 1000.0, quaternions=(np.sqrt(0.5), 0, np.sqrt(0.5), 0))
    scene.add_clumps((0, 0, 0.11), shape, 1000.0)
    found = find_contacts(world_of(scene), 0.02)
    np.testing.assert_allclose(found.gap, [0.01, 0.01], atol=1e-14)
    np.testing.assert_allclose(np.sort(found.point[:, 0]), [-0.1, 0.1], atol=1e-14)
    assert len(np.unique(found.key)) == 2


def test_overlaps_at_the_start_are_refused():
    scene = Scene(0.3)
    scene.add_clumps([(0, 0, 0), (0.25, 0, 0)], DUMBBELL, 1000.0)
    with pytest.raises(ValueError, match="grain 0 and grain 1 overlap"):
        new_world(scene, MPI.COMM_SELF)
    near = Scene(0.3)  # the spheres about them overlap, the clumps do not
    near.add_clumps([(0, 0, 0), (0, 0.25, 0)], DUMBBELL, 1000.0)
    new_world(near, MPI.COMM_SELF)


def test_volumes_are_those_of_the_unions():
    scene = Scene(0.3, gravity=(0, 0, 0))
    overlapping = Clump([(-0.05, 0, 0), (0.05, 0, 0)], [0.1, 0.1])
    scene.add_clumps([(0, 0, 0), (1, 0, 0)], overlapping, 1000.0)
    scene.add_spheres((0, 1, 0), 0.1, 1000.0)
    sim = Simulation(scene, dt=0.01)
    sim.step()
    form = scene.forms[0]
    np.testing.assert_allclose(sim.sample.volume, [form.volume, form.volume, 4 / 3 * np.pi * 1e-3], rtol=1e-13)
    region = Block((-0.5, -0.5, -0.5), (1.5, 0.5, 0.5))
    np.testing.assert_allclose(solid_fraction(sim.sample, region), 2 * form.volume / 2.0, rtol=1e-13)


@pytest.mark.parallel(2, 3)
def test_contacts_on_several_ranks():
    def found(comm):
        rng, scene = np.random.default_rng(1), Scene(0.3)
        scene.add_body("floor", [Plane((0, 0, 1), (0, 0, -0.5))])
        turns = rng.normal(size=(60, 4))
        scene.add_clumps(rng.uniform(-0.5, 0.5, (40, 3)), DUMBBELL, 1000.0, quaternions=turns[:40])
        scene.add_clumps(rng.uniform(-0.5, 0.5, (20, 3)), TRIPOD, 1000.0, quaternions=turns[40:])
        contacts = find_contacts(new_world(scene, comm, overlap=np.inf), 0.02)
        parts = comm.allgather((contacts.key, contacts.gap, contacts.normal, contacts.point))
        key, *others = (np.concatenate(columns) for columns in zip(*parts))
        order = np.argsort(key)
        return [key[order], *(column[order] for column in others)]

    for one, many in zip(found(MPI.COMM_SELF), found(MPI.COMM_WORLD)):
        np.testing.assert_array_equal(one, many)
