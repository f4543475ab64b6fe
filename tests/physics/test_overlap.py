"""Bodies that overlap are pushed apart no faster than the recovery speed."""

from __future__ import annotations

import numpy as np
import pytest
from drive import RADIUS, SOLVERS, steps
from mpi4py import MPI

import pctt
from dem.scene import Scene
from dem.shapes import Plane
from dem.start import new_world
from pctt.run import rest


def overlapping_pair(depth):
    scene = Scene(0.3, gravity=(0, 0, 0))
    scene.add_spheres([[0, 0, 0], [2 * RADIUS - depth, 0, 0]], RADIUS, [1000.0, 3000.0])
    return new_world(scene, MPI.COMM_SELF, overlap=0.5)


@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize(("depth", "speed"), [(0.02, 0.5), (0.02, 1.9), (0.003, 0.5), (0.02, np.inf)])
def test_overlapping_spheres_part_at_the_recovery_speed_at_most(solver, depth, speed):
    dt, world = 0.01, overlapping_pair(depth)
    gaps = []
    for step in steps(world, 8, dt, solver, recovery_speed=speed):
        order = np.argsort(world.grains.id)
        mass, velocity = world.grains.mass[order], world.grains.velocity[order, 0]
        assert velocity[1] - velocity[0] == pytest.approx(min(depth / dt, speed), rel=1e-6)
        assert mass @ velocity == pytest.approx(0.0, abs=1e-12)
        gaps += list(step.contacts.gap)
    assert gaps[0] == pytest.approx(-depth)
    needed = max(1, round(depth / dt / min(depth / dt, speed)))
    assert np.less(gaps[:needed], -1e-6).all()


@pytest.mark.parametrize("solver", ["apgd", "auto"])
def test_light_spheres_that_collide_beside_heavy_ones_overlap_by_little(monkeypatch, solver):
    """Heavy spheres at rest, and two that have a millionth of their mass and fly at each other. Their impulse is
    nothing next to those of the heavy ones, which a step begins with. Without a limit of the closing speed the two
    overlap by more than a twentieth of a radius, where steps are not accurate as those of bodies at rest."""
    scene = Scene(0.3)
    scene.add_body("floor", [Plane((0, 0, 1))])
    scene.add_spheres([[x, 0, RADIUS] for x in np.arange(10) * 3 * RADIUS], RADIUS, 1e5)
    scene.add_spheres([[0, 1, 0.5], [0, 1 + 2.5 * RADIUS, 0.5]], RADIUS, 0.1, velocity=[[0, 1, 0], [0, -1, 0]])
    deep = []
    monkeypatch.setattr(rest, "SLOW", 0.0)
    for speed in (None, np.inf):
        with pctt.Simulation(scene, comm=MPI.COMM_SELF, dt=0.01, solver=solver, closing_speed=speed) as sim:
            for _ in range(8):
                assert sim.step()["converged"]
                deep.append(2 * RADIUS - np.linalg.norm(np.diff(sim.positions[-2:], axis=0)))
    assert max(deep[:8]) < 0.012 * RADIUS
    assert max(deep[8:]) > 0.05 * RADIUS
