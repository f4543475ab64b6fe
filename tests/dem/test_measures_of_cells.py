"""Measures of regions that reach over periodic boundaries: what is behind them counts as images."""

from __future__ import annotations

import dataclasses
import functools
from itertools import product

import numpy as np
import pytest
from mpi4py import MPI

import pctt
from dem import measures
from dem.measures import Block, Cylinder, Sample
from dem.mesh import Mesh
from dem.packing import random_packing
from dem.parts.cell import Cell
from dem.scene import Scene
from pctt import analysis
from pctt.folder import Folder

PERIOD = np.array([1.0, 1.3, 0.9])


def cell(period, shear=(), seed=0, count=12):
    """Spheres within a cell, and contacts of some of them that reach anywhere near it."""
    rng = np.random.default_rng(seed)
    pairs = np.array([[a, b] for a in range(count) for b in range(a + 1, count + 1, 3)])  # the last body is large
    n, vectors = rng.standard_normal((len(pairs), 3)), (len(pairs), 3)
    point = rng.uniform(0.0, PERIOD, vectors)
    way, drift = Cell(np.where(period, PERIOD, np.inf), *shear).lattice
    return Sample(
        comm=MPI.COMM_SELF, count=count, id=np.arange(count), position=rng.uniform(0.0, PERIOD, (count, 3)),
        velocity=rng.standard_normal((count, 6)), mass=rng.uniform(1.0, 2.0, count), shape=np.zeros(count, np.int64),
        size=np.column_stack([rng.uniform(0.05, 0.2, count), np.zeros((count, 2))]),
        material=np.arange(count) % 2, materials=("one", "other"), bodies=pairs,
        center=point[:, None] + rng.uniform(-0.2, 0.2, (len(pairs), 2, 3)), point=point,
        normal=n / np.linalg.norm(n, axis=1)[:, None], gap=np.zeros(len(pairs)), force=3.0 * n + rng.random(vectors),
        lattice=way, drift=drift,
    )  # fmt: skip


def copied(sample, times=3):
    """The same cell and its images as a sample of its own, without periods."""
    axes = [range(-times, times + 1) if way.any() else (0,) for way in sample.lattice]
    steps = np.array(list(product(*axes)), float)
    n, m = len(steps), sample.count
    ways, speeds = steps @ sample.lattice, np.pad(steps @ sample.drift, ((0, 0), (0, 3)))

    def each(values, moved):
        moved = moved.reshape(n, *[1] * (values.ndim - 1), -1)
        return (values + moved).reshape(-1, *values.shape[1:])

    def same(values):
        return np.tile(values, (n, *[1] * (values.ndim - 1)))

    number = np.repeat(np.arange(n), len(sample.bodies))[:, None] * m
    bodies = same(sample.bodies)
    names = ("mass", "shape", "size", "material", "normal", "gap", "force")
    columns = {name: same(getattr(sample, name)) for name in names}
    return dataclasses.replace(
        sample, count=n * m, id=np.arange(n * m), position=each(sample.position, ways),
        velocity=each(sample.velocity, speeds), bodies=np.where(bodies < m, bodies + number, n * m),
        center=each(sample.center, ways), point=each(sample.point, ways), lattice=np.zeros((3, 3)),
        drift=np.zeros((3, 3)), **columns,
    )  # fmt: skip


CELLS = [
    ((1, 1, 1), ()), ((1, 0, 1), ()), ((0, 1, 0), ()),
    ((1, 1, 1), (2, 2.0, 17.37)), ((1, 1, 0), (1, -3.0, -0.44)),
]  # fmt: skip
BLOCKS = [Block((-0.7, 0.2, -0.3), (0.4, 1.9, 0.5)), Block((0, 0, 0), PERIOD), Block((1.2, -0.9, 0.3), (1.5, 0.4, 2.2))]
TUBES = [Cylinder((-0.5, 0.1, -0.2), (0.9, 1.5, 0.4), 0.4), Cylinder((0.5, 0.5, -0.6), (0.5, 0.5, 1.2), 0.7)]


@pytest.mark.parametrize(("period", "shear"), CELLS)
def test_a_cell_measures_as_its_images_do(period, shear):
    one = cell(np.array(period, bool), shear)
    other = copied(one)
    for region in (*BLOCKS, *TUBES):
        for measure in (measures.stress, measures.kinetic_stress, measures.fabric, measures.solid_fraction):
            np.testing.assert_allclose(measure(one, region), measure(other, region), rtol=1e-9, atol=1e-9)
    for region in BLOCKS:
        for kernel in ("lucy", "gauss"):
            found = [measures.fields(each, region, (3, 4, 5), 0.2, kernel) for each in (one, other)]
            for a, b in zip(*found):
                np.testing.assert_allclose(a, b, rtol=1e-8, atol=1e-9)
        found = [measures.mixing(each, each.of_material("one"), region, (2, 2, 2)) for each in (one, other)]
        np.testing.assert_allclose(found[0], found[1])  # NaN of one kind alone


@pytest.mark.parametrize(("period", "shear"), CELLS)
@pytest.mark.parametrize("axis", [(1, 0, 0), (0, -2, 0), (0, 0, 1)])
def test_a_profile_goes_on_over_the_boundary_of_its_axis(period, shear, axis):
    one = cell(np.array(period, bool), shear)
    along = np.abs(axis).argmax()
    own = np.arange(3) == along
    other = copied(dataclasses.replace(one, lattice=one.lattice * own[:, None]))
    for edges in (np.linspace(-1.4, 1.9, 9), np.linspace(0.2, 0.6, 3)):
        for a, b in zip(measures.profile(one, axis, edges), measures.profile(other, axis, edges)):
            np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-9)
    if one.lattice[along].any():
        whole = measures.profile(one, np.eye(3)[along], [-0.3, PERIOD[along] - 0.3])
        assert whole.grains == pytest.approx(12)
    across = measures.profile(one, (1.0, 1.0, 0.0), [-9.0, 9.0])
    assert across.grains == pytest.approx(12)  # each once along a direction that is no axis


def test_regions_of_too_many_cells_are_refused():
    with pytest.raises(ValueError, match="reaches over 1e.06 periodic cells; allowed are at most 10000"):
        measures.solid_fraction(cell(np.ones(3, bool)), Block((0, 0, 0), 100.0 * PERIOD))
    measures.fabric(cell(np.array([True, False, False])), Block((0, -1e9, -1e9), (2, 1e9, 1e9)))


@functools.cache
def packing():
    return random_packing((0.08,) * 3, 0.0065, 0.5, periodic=(True,) * 3, seed=1)


def pressed(shear=0.0, comm=MPI.COMM_SELF):
    """A dense cell of given stress, or a sheared one, after some steps."""
    size = 0.08
    x, radius = packing()
    more = {"shear_rate": shear, "shear_gradient": "z"} if shear else {}
    scene = Scene(0.4, gravity=(0, 0, 0), period=(size,) * 3, stress=(1000.0,) * 3, **more)
    scene.add_spheres(x, radius, 2500.0, velocity=np.outer(x[:, 2], [shear, 0, 0]))
    sim = pctt.Simulation(scene, comm=comm, tol=1e-5)
    sim.run(steps=12)
    return sim


def figures(comm, shear):
    sim = pressed(shear, comm)
    sample, box = sim.sample, Block((0, 0, 0), tuple(sim.period))
    stress = measures.stress(sample, box) + measures.kinetic_stress(sample, box)
    mask = np.ones(len(sample.id), bool)
    fields = measures.fields(sample, box, (12,) * 3, 0.02)
    mean = [fields.density.mean(), *fields.stress.mean(axis=(0, 1, 2)).ravel()]
    return sim, [stress, measures.solid_fraction(sample, box), mean, measures.stress(sample, mask, sim.period.prod())]


@pytest.mark.parallel(1, 2)
@pytest.mark.parametrize("shear", [0.0, 5.0])
def test_the_whole_cell_has_the_stress_and_the_grains_that_it_has(shear):
    comm = MPI.COMM_WORLD
    sim, (stress, fraction, mean, masked) = figures(comm, shear)
    volume = comm.allreduce(sim.sample.volume.sum()) / sim.period.prod()
    assert fraction == pytest.approx(volume, rel=1e-4)
    contact = measures.stress(sim.sample, Block((0, 0, 0), tuple(sim.period)))
    np.testing.assert_allclose(contact, masked, atol=1e-9 * np.abs(masked).max())
    if not shear:
        for k, axis in enumerate("xyz"):
            assert stress[k, k] == pytest.approx(sim.figures[f"stress_{axis}{axis} [Pa]"], rel=1e-4)
    assert mean[0] / 2500.0 == pytest.approx(volume, rel=1e-3)
    np.testing.assert_allclose(mean[1:], contact.ravel(), atol=1e-3 * np.abs(masked).max())
    shifted = Block((-0.03, 0.05, 0.03), tuple(np.add((-0.03, 0.05, 0.03), sim.period)))
    np.testing.assert_allclose(measures.stress(sim.sample, shifted), contact, atol=1e-6 * np.abs(masked).max())
    assert measures.solid_fraction(sim.sample, shifted) == pytest.approx(volume, rel=1e-4)


def test_files_of_a_cell_measure_as_the_simulation_does(tmp_path):
    sim = pressed(5.0)
    sim.write(tmp_path / "run")
    sim.run(steps=2)
    sim.close()
    folder = Folder(tmp_path / "run")
    other = analysis.sample(folder, folder.steps[-1])
    region = Block((-0.02, 0.03, -0.03), (0.05, 0.1, 0.02))
    for measure in (measures.stress, measures.kinetic_stress, measures.solid_fraction, measures.fabric):
        one = measure(sim.sample, region)
        np.testing.assert_allclose(measure(other, region), one, atol=1e-9 * np.abs(one).max())
    for a, b in zip(measures.per_grain(other), measures.per_grain(sim.sample)):
        np.testing.assert_allclose(a, b, atol=1e-9 * np.abs(b).max())


def test_the_triangles_of_a_mesh_that_reaches_over_the_boundary_bear_what_lies_there():
    """A square about x = 0: one sphere lies on its left triangle, which is at the right end of the cell."""
    scene = Scene(0.5, period=(1.0, None, None))
    square = Mesh([[-0.2, -0.3, 0], [0.2, -0.3, 0], [0.2, 0.3, 0], [-0.2, 0.3, 0]], [[0, 1, 2], [0, 2, 3]])
    scene.add_body("plate", [square], position=(0.01, 0.0, 0.0))
    scene.add_spheres([[0.86, 0.15, 0.05], [0.12, -0.15, 0.05]], 0.05, [1000.0, 3000.0])
    sim = pctt.Simulation(scene, dt=0.002, tol=1e-9)
    sim.run(steps=40)
    weight = 9.81 * sim.local.mass[np.argsort(sim.local.id)]
    np.testing.assert_allclose(sim.body("plate").triangle_forces()[:, 2], -weight[::-1], rtol=1e-3)
