"""Bodies that overlap are pushed apart no faster than the recovery speed."""

from __future__ import annotations

import numpy as np
import pytest
from drive import RADIUS, SOLVERS, steps
from mpi4py import MPI

from dem.scene import Scene
from dem.start import new_world


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
