"""Lees-Edwards shear: images across the boundary move, and nothing else tells where the boundary is."""

import functools

import numpy as np
import pytest
from mpi4py import MPI

import pctt
from dem.scene import Scene
from dem.shapes import Plane

CELL, RATE = (0.9, 1.1, 1.3), 1.5


@functools.cache
def collision(shift, gradient, capsules=False):
    """Two grains that collide obliquely in a sheared cell."""
    scene = Scene(0.4, (0.0, 0.0, 0.0), stiffness=np.inf, period=CELL, shear_rate=RATE, shear_gradient=gradient)
    place = np.array([[0.45, 0.5, 0.6], [0.56, 0.53, 0.61]]) + shift
    speed = np.array([[0.8, 0.0, 0.2], [-0.5, 0.1, 0.0]])
    if capsules:
        scene.add_capsules(place, radius=0.03, half_length=0.02, density=1000.0, velocity=speed)
    else:
        scene.add_spheres(place, radius=[0.05, 0.06], density=1000.0, velocity=speed)
    sim = pctt.Simulation(scene, dt=0.004, solver="apgd", tol=1e-10)
    sim.run(steps=16)
    return sim


@pytest.mark.parametrize("capsules", [False, True])
@pytest.mark.parametrize("shift", [(0.0, 0.585, 0.0), (0.395, -0.52, -0.61), (-3.4, 0.59, 0.695)])
@pytest.mark.parametrize("gradient", ["y", "z"])
def test_collision_across_the_boundary_is_that_inside(gradient, shift, capsules):
    axis = "xyz".index(gradient)
    inside, across = collision((0, 0, 0), gradient, capsules), collision(shift, gradient, capsules)
    assert np.abs(inside.velocities[0, :3] - (0.8, 0.0, 0.2)).max() > 0.1
    away = inside.positions + shift - across.positions
    crossed = np.round(away[:, axis] / CELL[axis])
    expected = inside.velocities.copy()
    expected[:, 0] -= crossed * RATE * CELL[axis]
    np.testing.assert_allclose(across.velocities, expected, atol=1e-9)
    away[:, 0] -= crossed * RATE * CELL[axis] * across.time
    np.testing.assert_allclose(away, np.round(away / CELL) * CELL, atol=1e-9)


def test_grain_that_crosses_takes_the_velocity_of_the_other_side():
    scene = Scene(0.3, (0.0, 0.0, 0.0), period=(0.5, 0.5, None), shear_rate=2.0)
    scene.add_spheres([[0.1, 0.1, 0.0]], radius=0.05, density=1000.0, velocity=(0.3, 3.0, 0.0))
    sim = pctt.Simulation(scene, dt=0.01)
    sim.run(steps=20)  # crosses at 0.1333 s
    np.testing.assert_allclose(sim.velocities[0, :3], [0.3 - 2.0 * 0.5, 3.0, 0.0], atol=1e-12)
    # once it is put back, it goes on with the velocity of its new place: x = 0.1 + 0.3 t - (shift at t)
    np.testing.assert_allclose(sim.positions[0, :2], [np.mod(0.1 + 0.06 - 0.2, 0.5), 0.2], atol=1e-12)


def test_grain_that_has_crossed_keeps_its_velocity_as_the_shear_and_the_cell_change():
    """No force acts on it, whether it is put back into the cell yet or not."""
    scene = Scene(0.3, (0.0, 0.0, 0.0), stiffness=1e4, period=(0.5,) * 3, shear_rate=2.0, strain_rate=(0.05, -0.1, 0.0))
    scene.add_spheres([[0.1, 0.1, 0.1]], radius=0.05, density=1000.0, velocity=(0.3, 2.1, 0.0))
    sim = pctt.Simulation(scene, dt=0.01)
    sim.run(steps=20)
    assert 0.5 < sim.world.grains.position[0, 1] < 0.6
    expected = sim.velocities
    sim.run(steps=2)
    np.testing.assert_allclose(sim.velocities, expected, atol=1e-12)
    sim.change("cell", shear_rate=0.5)
    np.testing.assert_allclose(sim.velocities, expected, atol=1e-12)


def test_affine_flow_keeps_its_profile():
    height = np.array([0.05, 0.2, 0.35, 0.5, 0.65])
    scene = Scene(0.3, (0.0, 0.0, 0.0), period=(0.5, 0.75, None), shear_rate=4.0)
    place = np.array([[x, y, 0.0] for y in height for x in (0.1, 0.3)])
    scene.add_spheres(place, radius=0.06, density=1000.0, velocity=place[:, [1, 2, 2]] * [4.0, 0.0, 0.0])
    sim = pctt.Simulation(scene, dt=0.01)
    sim.run(steps=75)
    np.testing.assert_allclose(sim.velocities[:, 0], 4.0 * sim.positions[:, 1], atol=1e-9)
    np.testing.assert_allclose(sim.positions[:, 1], place[:, 1], atol=1e-12)


def sheared(comm=MPI.COMM_SELF, rate=3.0):
    """A dense cell of spheres."""
    shear = {"period": (0.32, 0.328, 0.32), "shear_rate": rate, "shear_gradient": "z"}
    scene = Scene(0.5, (0.0, 0.0, 0.0), stiffness=np.inf, **shear)
    grid = np.stack(np.meshgrid(*[np.arange(4)] * 3, indexing="ij"), axis=-1).reshape(-1, 3) + 0.5
    place = grid * [0.08, 0.082, 0.08] + np.random.default_rng(3).uniform(-0.0004, 0.0004, grid.shape)
    speed = np.stack([rate * place[:, 2], 0.0 * place[:, 2], 0.0 * place[:, 2]], axis=1)
    speed += np.random.default_rng(5).normal(scale=0.2, size=speed.shape)
    scene.add_spheres(place, np.linspace(0.0385, 0.0395, len(place)), 2000.0, velocity=speed)
    return pctt.Simulation(scene, comm=comm, dt=0.002, solver="apgd", tol=1e-7)


def momentum(sim):
    """Of all grains along y and z, (2,) [N s]."""
    return sim.comm.allreduce(sim.local.mass @ sim.local.velocity[:, 1:3])


@pytest.mark.parallel(1, 2, 3)
def test_power_of_the_shear_closes_the_balance_of_energy_and_momentum_stays():
    sim = sheared(MPI.COMM_WORLD)
    sim.run(steps=10)
    before = momentum(sim)
    work, lost, found = 0.0, 0.0, 0.0
    for _ in range(6):
        sim.step()
        found += sim.figures["contacts"]
        work += sim.figures["work_of_motions [J]"]
        lost += sim.figures["friction_loss [J]"] + sim.figures["impact_loss [J]"]
        # without gravity the semi-implicit step has no error of its own
        assert abs(sim.figures["time_stepping [J]"]) < 1e-9 * sim.figures["kinetic_energy [J]"]
    assert found > 200
    assert lost > 0.0
    assert work > 0.0
    np.testing.assert_allclose(momentum(sim), before, atol=1e-12)


@pytest.mark.parallel(2, 3)
def test_ranks_change_nothing():
    alone, together = sheared(), sheared(MPI.COMM_WORLD)
    for sim in (alone, together):
        sim.run(steps=6)
    np.testing.assert_allclose(together.positions, alone.positions, atol=1e-5)
    assert len(together.contacts) == len(alone.contacts) > 10


def test_kept_lists_find_what_new_ones_find():
    """Images go on while the lists of pairs stay."""
    sim, other = sheared(rate=0.5), sheared(rate=0.5)
    kept = 0
    for _ in range(15):
        before = sim.world.lists
        sim.step()
        kept += sim.world.lists is before
        other.world.lists = None
        other.step()
        assert np.array_equal(np.sort(sim.contacts.gap), np.sort(other.contacts.gap))
    assert kept > 0


@pytest.mark.parallel(1, 2)
def test_restart_goes_on_with_the_same_bits(tmp_path):
    sim = sheared(MPI.COMM_WORLD)
    sim.run(steps=6)
    sim.change("cell", shear_rate=-2.0)
    sim.run(steps=3)
    sim.save(tmp_path / "state.h5")
    more = {"dt": 0.002, "solver": "apgd", "tol": 1e-7}
    other = pctt.Simulation.load(tmp_path / "state.h5", sim.experiment, comm=MPI.COMM_WORLD, **more)
    assert other.world.cell.shift == sim.world.cell.shift
    assert sim.world.cell.shear_rate == other.world.cell.shear_rate == -2.0
    for each in (sim, other):
        each.run(steps=4)
    assert np.array_equal(sim.positions, other.positions)
    assert np.array_equal(sim.velocities, other.velocities)


def test_refused():
    with pytest.raises(ValueError, match="periods along x and z"):
        Scene(0.3, period=(0.5, 0.5, None), shear_rate=1.0, shear_gradient="z")
    with pytest.raises(ValueError, match="shear_gradient must be"):
        Scene(0.3, period=(0.5, 0.5, 0.5), shear_rate=1.0, shear_gradient="x")
    with pytest.raises(ValueError, match="shear_gradient 'z' needs a shear_rate"):
        Scene(0.3, period=(0.5, 0.5, 0.5), shear_gradient="z")
    with pytest.raises(ValueError, match="strain_start 1 needs a strain_rate or a stress"):
        Scene(0.3, period=(0.5, 0.5, 0.5), strain_start=1.0)
    scene = Scene(0.3, period=(0.5, 0.5, None), shear_rate=1.0)
    scene.add_spheres([[0.1, 0.1, 0.1]], radius=0.05, density=1000.0)
    scene.add_body("floor", [Plane(normal=(0, 0, 1))])
    with pytest.raises(ValueError, match="'floor': a sheared cell has grains alone"):
        scene.grains()
    scene = Scene(0.3, period=(0.5, 0.5, None))
    scene.add_spheres([[0.1, 0.1, 0.1]], radius=0.05, density=1000.0)
    with pytest.raises(ValueError, match="is not sheared"):
        pctt.Simulation(scene, dt=0.01).change("cell", shear_rate=1.0)
