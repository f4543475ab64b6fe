"""Measures of grains and contacts: closed forms, balances, and the same on several ranks."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from cases import crude_impulse, heap
from mpi4py import MPI
from several_ranks import alone

from dem import measures
from dem.contact import find_contacts
from dem.measures import Block, Cylinder, Sample
from dem.mesh import Mesh
from dem.model.partition import rebalance
from dem.start import new_world
from dem.step import Step
from dem.step.system import ContactSystem
from dem.unconstrained import unconstrained

SELF = MPI.COMM_SELF
R, G, DENSITY = 0.1, 9.81, 1000.0
MASS = DENSITY * 4.0 / 3.0 * np.pi * R**3


def sample(position, bodies=(), point=(), normal=(), force=(), velocity=None, material=None):
    """Spheres of radius R with these contacts; the body of the highest number is large, at the origin."""
    position, n = np.asarray(position, float), len(position)
    pairs, vectors = np.asarray(bodies, np.int64).reshape(-1, 2), (-1, 3)
    return Sample(
        comm=SELF, count=n, id=np.arange(n), position=position,
        velocity=np.zeros((n, 6)) if velocity is None else np.asarray(velocity, float), mass=np.full(n, MASS),
        shape=np.zeros(n, np.int64), size=np.tile([R, 0.0, 0.0], (n, 1)),
        material=np.zeros(n, np.int64) if material is None else np.asarray(material), materials=("one", "other"),
        bodies=pairs, center=np.append(position, [[0.0, 0.0, 0.0]], axis=0)[pairs],
        point=np.reshape(point, vectors).astype(float), normal=np.reshape(normal, vectors).astype(float),
        gap=np.zeros(len(pairs)), force=np.reshape(force, vectors).astype(float),
    )  # fmt: skip


def column(count=4):
    """Spheres upon each other on a floor, in equilibrium."""
    height = R * (1.0 + 2.0 * np.arange(count))
    position = height[:, None] * [0.0, 0.0, 1.0]
    bodies = [[k, k + 1] for k in range(count - 1)] + [[0, count]]
    normal = np.tile([0.0, 0.0, 1.0], (count, 1))
    normal[-1] = [0.0, 0.0, -1.0]
    weight = np.append(np.arange(count - 1, 0, -1), count) * MASS * G
    point = np.append(height[:-1] + R, 0.0)[:, None] * [0.0, 0.0, 1.0]
    return sample(position, bodies, point, normal, weight[:, None] * normal)


def scattered(seed=0):
    rng = np.random.default_rng(seed)
    position = rng.uniform(-0.2, 0.2, (9, 3))
    bodies = np.array([[a, b] for a in range(8) for b in range(a + 1, 10, 2)])
    n = rng.standard_normal((len(bodies), 3))
    return sample(
        position, bodies, rng.uniform(-0.2, 0.2, n.shape), n / np.linalg.norm(n, axis=1)[:, None],
        rng.standard_normal(n.shape), rng.standard_normal((9, 6)), rng.integers(0, 2, 9),
    )  # fmt: skip


WIDE = Block((-1, -1, -1), (1, 1, 1))


def test_the_grains_of_a_column_are_in_equilibrium_and_bear_what_is_above():
    found = measures.per_grain(column())
    np.testing.assert_allclose(found.force, np.tile([0, 0, MASS * G], (4, 1)), rtol=1e-12)
    np.testing.assert_allclose(found.torque, 0.0, atol=1e-12)
    np.testing.assert_array_equal(found.coordination, [2, 2, 2, 1])
    np.testing.assert_allclose(found.moment[:, 2, 2], R * MASS * G * np.array([7, 5, 3, 1]), rtol=1e-12)


def test_a_tangential_force_turns_a_grain():
    one = sample([[0, 0, R]], [[0, 1]], [[0, 0, 0]], [[0, 0, -1]], [[-1.0, 0, 0]])  # on the floor; 1 N on the grain
    np.testing.assert_allclose(measures.per_grain(one).torque, [[0, -R, 0]], atol=1e-15)


def test_the_stress_of_a_column_is_its_mean_weight_and_regions_leave_nothing_out():
    part = [measures.stress(column(), Block((-1, -1, z), (1, 1, z + 0.25))) * 1.0 for z in np.arange(0, 1, 0.25)]
    whole = measures.stress(column(), Block((-1, -1, 0), (1, 1, 1)))
    np.testing.assert_allclose(np.mean(part, axis=0), whole, rtol=1e-12)
    assert whole[2, 2] == pytest.approx(16 * R * MASS * G / 4.0)
    np.testing.assert_allclose(measures.stress(column(), np.ones(4, bool), 4.0), whole, rtol=1e-12)
    round_one = Cylinder((0, 0, 0), (0, 0, 2 * R), 0.5)
    assert measures.stress(column(), round_one)[2, 2] == pytest.approx(7 * R * MASS * G / round_one.volume)
    with pytest.raises(ValueError, match="volume"):
        measures.stress(column(), np.ones(4, bool))
    for measure in (measures.stress, measures.kinetic_stress):
        with pytest.raises(ValueError, match=r"volume 3: a Block has its own, 8 m\^3; give none"):
            measure(column(), WIDE, 3.0)


def test_a_line_through_a_cylinder():
    tube = Cylinder((0, 0, 0), (0, 0, 1), 0.5)
    start = np.array([[-1, 0, 0.5], [0, 0, -1], [-1, 0.6, 0.5], [0, 0, 2], [0, 0.6, 0]], float)
    end = np.array([[1, 0, 0.5], [0, 0, 3], [1, 0.6, 0.5], [0, 0, 3], [0, 0.6, 1]], float)
    np.testing.assert_allclose(tube.part(start, end), [0.5, 0.25, 0, 0, 0])


def test_the_kinetic_stress_leaves_the_mean_velocity_out():
    two = sample([[0, 0, 0], [0.1, 0, 0]], velocity=[[3, 0, 0, 0, 0, 0], [1, 0, 0, 0, 0, 0]])
    np.testing.assert_allclose(measures.kinetic_stress(two, WIDE), np.diag([2 * MASS / 8.0, 0, 0]))


def test_the_fabric_of_a_column_is_upright():
    np.testing.assert_allclose(measures.fabric(column(), WIDE), np.diag([0, 0, 1.0]))
    assert not measures.fabric(column(), Block((5, 5, 5), (6, 6, 6))).any()


@pytest.mark.parametrize(
    ("low", "part"), [((0, -1, -1), 1 / 2), ((0, 0, -1), 1 / 4), ((0, 0, 0), 1 / 8), ((0.5 * R, -1, -1), 5 / 32)]
)
def test_the_solid_fraction_of_a_cut_sphere(low, part):
    box = Block(low, (1, 1, 1))
    found = measures.solid_fraction(sample([[0, 0, 0]]), box) * box.volume
    assert found == pytest.approx(part * MASS / DENSITY, rel=1e-3 if sum(x == 0 for x in low) > 1 else 1e-12)
    inside = Block((-R / 2, -R / 2, -R / 2), (R / 2, R / 2, R / 2))
    assert measures.solid_fraction(sample([[0, 0, 0]]), inside) == pytest.approx(1.0)


@pytest.mark.parametrize(("kernel", "width", "tol"), [("lucy", 0.25, 1e-3), ("gauss", 0.1, 3e-3)])
def test_the_integrals_of_the_fields_are_mass_momentum_and_stress(kernel, width, tol):
    """The kernels are sampled at the middles of cells."""
    data = scattered()
    found = measures.fields(data, WIDE, (50, 50, 50), width, kernel)
    cell = found.spacing.prod()
    assert found.density.sum() * cell == pytest.approx(9 * MASS, rel=tol)
    momentum = data.mass @ data.velocity[:, :3]
    np.testing.assert_allclose(found.momentum.sum(axis=(0, 1, 2)) * cell, momentum, atol=tol * 9 * MASS)
    whole = measures.stress(data, WIDE)
    mean = found.stress.mean(axis=(0, 1, 2))
    np.testing.assert_allclose(mean, whole, atol=tol * np.abs(whole).max())
    kinetic = found.kinetic_stress + np.einsum("...a,...b->...ab", found.momentum, found.velocity)
    flow = np.einsum("n,na,nb->ab", data.mass, data.velocity[:, :3], data.velocity[:, :3])
    np.testing.assert_allclose(kinetic.sum(axis=(0, 1, 2)) * cell, flow, atol=tol * np.trace(flow))


def test_the_stress_of_a_column_balances_its_weight():
    """div stress = rho g, away from the floor, whose force is no part of the stress."""
    box, width = Block((-0.4, -0.4, -0.4), (0.4, 0.4, 1.4)), 0.3
    found = measures.fields(column(5), box, (16, 16, 72), width)
    area = found.spacing[0] * found.spacing[1]
    force, weight = found.stress[..., 2, 2].sum(axis=(0, 1)) * area, found.density.sum(axis=(0, 1)) * area * G
    balance = np.gradient(force, found.spacing[2]) + weight
    height = found.low[2] + (np.arange(72) + 0.5) * found.spacing[2]
    assert np.abs(balance[height > width + 0.05]).max() < 0.02 * weight.max()


def test_bad_kernels_are_refused():
    with pytest.raises(ValueError, match="kernel 'box': allowed is one of gauss, lucy"):
        measures.fields(column(), WIDE, (2, 2, 2), 0.1, "box")
    with pytest.raises(ValueError, match="width of the kernel"):
        measures.fields(column(), WIDE, (2, 2, 2), 0.0)


@pytest.mark.parametrize(("cells", "words"), [
    ((4, 0, 4), r"cells: allowed are whole numbers >= 1, got 4, 0, 4"),
    ((4, 2.5, 4), r"cells: allowed are whole numbers >= 1, got 4, 2.5, 4"),
    ((4, 4), "cells must be 3 numbers"),
])  # fmt: skip
def test_a_grid_without_cells_is_refused(cells, words):
    with pytest.raises(ValueError, match=words):
        measures.fields(column(), WIDE, cells, 0.1)
    with pytest.raises(ValueError, match=words):
        measures.mixing(column(), np.ones(4, bool), WIDE, cells)


@pytest.mark.parametrize("axis", [2, "z", (0, 1), (0, 0, 0), (0, 0, np.nan)])
def test_an_axis_of_a_profile_that_is_no_direction_is_refused(axis):
    with pytest.raises(ValueError, match=r"axis .*: allowed are three numbers that are not all zero"):
        measures.profile(column(), axis, [0, 1])


@pytest.mark.parametrize("mask", [np.ones(4, int), np.arange(4), np.ones(5, bool), np.ones((4, 1), bool), [0.0] * 4])
def test_a_mask_that_is_none_is_refused(mask):
    data, words = column(), r"mask: allowed is .*True or False for each of the 4 grains here, got "
    for measured in (
        lambda: measures.stress(data, mask, 1.0),
        lambda: measures.kinetic_stress(data, mask, 1.0),
        lambda: measures.mixing(data, mask, WIDE, (2, 2, 2)),
        lambda: measures.mean_position(data, mask),
    ):
        with pytest.raises(ValueError, match=words):
            measured()
    assert (measures.stress(data, [True] * 4, 1.0) == measures.stress(data, np.ones(4, bool), 1.0)).all()


@pytest.mark.parametrize("edges", [[0.3, 0.2, 0.0], [0.1], [[0, 1], [1, 2]], [0, np.nan]])
def test_edges_of_a_profile_that_do_not_ascend_are_refused(edges):
    with pytest.raises(ValueError, match=r"edges .*: allowed are two or more numbers, none below the one before"):
        measures.profile(column(), (0, 0, 1), edges)


def test_a_profile_of_a_shear_flow():
    position = np.array([[0, 0, 0.05], [0, 0, 0.05], [0, 0, 0.15], [0, 0, 0.35]])
    data = sample(position, velocity=np.concatenate([position[:, ::-1], np.zeros((4, 3))], axis=1))
    found = measures.profile(data, (0, 0, 2), np.linspace(0, 0.3, 4))
    np.testing.assert_allclose(found.middle, [0.05, 0.15, 0.25])
    np.testing.assert_array_equal(found.grains, [2, 1, 0])
    np.testing.assert_allclose(found.mass, MASS * found.grains)
    np.testing.assert_allclose(found.velocity[:, 0], [0.05, 0.15, 0])
    np.testing.assert_array_equal(measures.profile(data, (0, 0, 1), [-np.inf, 0.1, 0.1, np.inf]).grains, [2, 0, 2])


def test_mixing_is_zero_of_halves_and_one_of_chance():
    places = np.stack(np.meshgrid(*[np.arange(8) + 0.5] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    box, cells = Block((0, 0, 0), (8, 8, 8)), (2, 2, 2)
    data = sample(places)
    halves = measures.mixing(data, places[:, 0] < 4, box, cells)
    assert halves == pytest.approx((0.0, 1.0))
    even = measures.mixing(data, places.sum(axis=1) % 2 < 1, box, cells)  # like a chess board
    assert even == pytest.approx((1 / (1 - 1 / 64), 0.0))
    chance = [measures.mixing(data, np.random.default_rng(k).random(512) < 0.3, box, cells).lacey for k in range(200)]
    assert np.mean(chance) == pytest.approx(1.0, abs=5e-3)
    for few, mask in {"every": np.ones(512, bool), "no": np.zeros(512, bool)}.items():
        with pytest.warns(UserWarning, match=f"the mask has {few} grain of the region"):
            assert np.isnan(measures.mixing(data, mask, box, cells).lacey)
    np.testing.assert_allclose(measures.mean_position(data, places[:, 0] < 4), [2, 4, 4])


def test_forces_on_the_triangles_of_a_turned_mesh():
    """Two triangles of a square, which the body turns onto the y-z plane."""
    mesh = Mesh([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], [[0, 1, 2], [0, 2, 3]], center=(0, 0, 1))
    turn = np.array([np.sqrt(0.5), 0, np.sqrt(0.5), 0])  # about y: z becomes x, x becomes -z
    point = [[1.001, 0.2, -0.8], [1.0, 0.8, -0.2], [1.0, 0.7, -0.1]]
    force = [[-k, 0, 0] for k in (1, 2, 4)]
    data = sample([[1.1, 0, 0]] * 3, [[k, 3] for k in range(3)], point, [[-1, 0, 0]] * 3, force)
    found = measures.triangle_forces(data, 3, mesh, np.zeros(3), turn)
    np.testing.assert_allclose(found, [[-1, 0, 0], [-6, 0, 0]], atol=1e-12)
    assert not measures.triangle_forces(data, 9, mesh, np.zeros(3), turn).any()


def measured(comm):
    world = new_world(heap(), comm)
    rebalance(world)
    contacts = find_contacts(world, 0.05)
    system = ContactSystem(world, contacts, unconstrained(world, 0.01))
    data = Step(world, contacts, system, crude_impulse(system)).sample
    low, high = np.array([-1.0, -1, -1]), np.array([2.0, 2, 2])
    box, mask = Block(low, high), data.id % 2 == 0
    out = [*measures.per_grain(data), measures.stress(data, box), measures.stress(data, mask, 2.0)]
    out += [measures.kinetic_stress(data, mask, 1.0), measures.fabric(data, box), measures.solid_fraction(data, box)]
    out += [*measures.fields(data, box, (6, 6, 6), 0.6), *measures.profile(data, (1, 0, 0), [-1, 0, 1, 2])]
    return out + [measures.mixing(data, mask, box, (2, 2, 2)), measures.mean_position(data, mask)]


@pytest.mark.parallel(1, 2, 3)
def test_measures_are_the_same_on_several_ranks():
    found, expected = measured(MPI.COMM_WORLD), alone(measured)
    assert found[0].any()
    assert found[3].any()
    for one, other in zip(found, expected):
        np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-9 * (1e-300 + np.abs(np.asarray(other)).max()))


def test_a_material_that_is_not_there_is_refused():
    data = dataclasses.replace(column(), material=np.array([0, 1, 0, 1]))
    np.testing.assert_array_equal(data.of_material("other"), [False, True, False, True])
    with pytest.raises(ValueError, match="material 'third': allowed is one of one, other"):
        data.of_material("third")
