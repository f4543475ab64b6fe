"""Periodic boundaries: what happens across them is what happens inside."""

import numpy as np
import pytest
from mpi4py import MPI

import pctt
from dem.scene import Scene
from dem.shapes import Box, Plane, Sphere
from dem.start import new_world
from dem.together import SceneError
from pctt.scenes import Incline

CELL = (0.9, 1.1, 1.3)


def collision(shift, period=CELL, comm=MPI.COMM_SELF):
    """Two spheres that collide obliquely, and their velocities in the end."""
    scene = Scene(friction=0.4, gravity=(0.0, 0.0, 0.0), stiffness=np.inf, period=period)
    place = np.array([[0.45, 0.5, 0.6], [0.56, 0.53, 0.61]]) + shift
    speed = np.array([[0.8, 0.0, 0.2], [-0.5, 0.1, 0.0]])
    scene.add_spheres(place, radius=[0.05, 0.06], density=1000.0, velocity=speed)
    sim = pctt.Simulation(scene, comm=comm, dt=0.004, solver="apgd", tol=1e-10)
    sim.run(steps=12)
    return sim


@pytest.mark.parametrize("shift", [(0.4, 0, 0), (-0.5, 0.59, 0), (0.41, 0.58, 0.69), (0.395, -0.52, -0.61)])
def test_collision_through_the_boundary_is_that_inside(shift):
    inside, across = collision((0, 0, 0)), collision(shift)
    assert np.abs(inside.velocities[0, :3] - (0.8, 0.0, 0.2)).max() > 0.1
    np.testing.assert_allclose(across.velocities, inside.velocities, atol=1e-9)
    np.testing.assert_allclose(across.positions, np.mod(inside.positions + shift, CELL), atol=1e-10)
    mass = across.local.mass[np.argsort(across.local.id)]
    before = mass @ np.array([[0.8, 0.0, 0.2], [-0.5, 0.1, 0.0]])
    np.testing.assert_allclose(mass @ across.velocities[:, :3], before, atol=1e-12)


def packing(shift=0.0, comm=MPI.COMM_SELF, period=(0.43, 0.35, None), capsules=False):
    """A bed of grains on a plane and a sphere at rest at the edge, with gravity tilted along the cell."""
    scene = Scene(friction=0.5, gravity=(3.0, 0.4, -9.0), stiffness=np.inf, period=period)
    scene.add_body("floor", [Plane(normal=(0, 0, 1))])
    scene.add_body("bump", [Sphere(radius=0.03, center=tuple(np.mod([0.42 + shift, 0.2, 0.0], [0.43, 0.35, 9.0])))])
    grid = np.stack(np.meshgrid(np.arange(5), np.arange(4), np.arange(3), indexing="ij"), axis=-1).reshape(-1, 3)
    noise = np.random.default_rng(3).uniform(-0.003, 0.003, grid.shape)
    place = grid * [0.086, 0.0875, 0.086] + [0.04, 0.04, 0.06] + noise + [shift, 0.0, 0.0]
    speed = (1.0, 0.3, -1.0)
    if capsules:
        scene.add_capsules(place, radius=0.03, half_length=0.009, density=2000.0, velocity=speed)
    else:
        scene.add_spheres(place, radius=np.linspace(0.037, 0.04, len(place)), density=2000.0, velocity=speed)
    return pctt.Simulation(scene, comm=comm, dt=0.004, solver="apgd", tol=1e-9)


@pytest.mark.parametrize("capsules", [False, True])
def test_packing_is_itself_shifted(capsules):
    first, second = packing(capsules=capsules), packing(0.17, capsules=capsules)
    first.run(steps=20)
    second.run(steps=20)
    away = second.positions - first.positions - [0.17, 0.0, 0.0]
    away -= np.round(away / [0.43, 0.35, 1e9]) * [0.43, 0.35, 0.0]
    assert np.abs(away).max() < 1e-6  # solved to a tolerance
    assert len(first.contacts) == len(second.contacts) > 80


@pytest.mark.parallel(1, 2, 3)
def test_ranks_change_nothing():
    alone, together = packing(), packing(comm=MPI.COMM_WORLD)
    for sim in (alone, together):
        sim.run(steps=10)
    np.testing.assert_allclose(together.positions, alone.positions, atol=1e-5)
    assert len(together.contacts) == len(alone.contacts)


@pytest.mark.parallel(1, 2)
def test_restart_goes_on_with_the_same_bits(tmp_path):
    comm = MPI.COMM_WORLD
    sim = packing(comm=comm)
    sim.run(steps=12)
    sim.save(tmp_path / "state.h5")
    scene = sim.experiment
    other = pctt.Simulation.load(tmp_path / "state.h5", scene, comm=comm, dt=0.004, solver="apgd", tol=1e-9)
    for each in (sim, other):
        each.run(steps=12)
    assert np.array_equal(sim.positions, other.positions)
    assert np.array_equal(sim.velocities, other.velocities)


def test_grain_goes_around():
    """It falls freely through the boundary, again and again."""
    scene = Scene(friction=0.3, gravity=(0, 0, 0), period=(0.5, None, None))
    scene.add_spheres([[0.1, 0, 0]], radius=0.05, density=1000.0, velocity=(5.0, 0.0, 0.0))
    sim = pctt.Simulation(scene, dt=0.01)
    sim.run(steps=37)
    np.testing.assert_allclose(sim.positions, [[np.mod(0.1 + 37 * 0.05, 0.5), 0, 0]], atol=1e-12)


def test_refused():
    def grains(**more):
        scene = Scene(friction=0.3, period=more.pop("period", (0.5, None, 0.6)))
        scene.add_spheres([[0.1, 0, 0.3]], radius=more.pop("radius", 0.05), density=1000.0, **more)
        return scene

    with pytest.raises(ValueError, match="period must be positive"):
        Scene(friction=0.3, period=(0.5, -1.0, None))
    with pytest.raises(ValueError, match="three entries"):
        Scene(friction=0.3, period=(0.5, 1.0))
    with pytest.raises(ValueError, match="along x is too short"):
        grains(radius=0.125).grains()
    scene = grains()
    scene.add_body("floor", [Plane(normal=(0, 0, 1))])
    with pytest.raises(ValueError, match="'floor' has a plane across the periodic direction z"):
        scene.grains()
    scene = grains()
    scene.add_body("box", [Box(half_extents=(0.3, 0.1, 0.1), center=(0.2, 0, 0.2))])
    with pytest.raises(ValueError, match="'box': a box must have its centre in the cell"):
        scene.grains()
    scene = grains()
    scene.add_spring("rope", 0, stiffness=1.0)
    with pytest.raises(ValueError, match="spring 'rope': springs have no images"):
        new_world(scene, MPI.COMM_SELF)
    fast = pctt.Simulation(grains(period=(0.25, None, None), velocity=(5.0, 0, 0)), dt=0.02)
    with pytest.raises(SceneError, match="six diameters are always enough"):
        fast.step()


def test_incline_obeys_the_balance_of_momentum_and_stops_where_it_is_flat():
    """Contacts across the boundary give no momentum: all of it comes from gravity and from the bottom."""
    speeds, fractions = [], []
    for angle, end in ((8.0, 0.15), (40.0, 0.05)):
        sim = pctt.Simulation(Incline(n=2, angle=angle), comm=MPI.COMM_SELF)
        sim.run(until=end)
        grains = sim.world.grains
        mass, before = grains.mass.sum(), grains.mass @ grains.velocity[:, :3]
        sim.step()
        after = sim.world.grains.mass @ sim.world.grains.velocity[:, :3]
        push = mass * sim.world.gravity - sim.body("bottom").force
        np.testing.assert_allclose(after - before, sim.settings.dt * push, atol=1e-9 * mass)
        speeds.append(sim.figures["speed [m/s]"])
        fractions.append(sim.figures["solid_fraction"])
    assert 10.0 * abs(speeds[0]) < speeds[1]  # one has come to rest, the other speeds up
    assert 0.5 < fractions[0] < 0.7
