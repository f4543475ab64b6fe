"""Contacts of a stated stiffness have the closed forms of springs, whatever the time step is."""

from __future__ import annotations

import numpy as np
import pytest

import pctt
from dem.scene import Scene
from dem.shapes import Plane

R, DENSITY, G = 0.1, 2500.0, 9.81
MASS = DENSITY * 4 / 3 * np.pi * R**3
EXACT = {"tol": 1e-10, "closing_work": np.inf, "delta": 0.01}


def column(stiffness: float, count: int = 5) -> Scene:
    """Spheres on top of each other on a floor."""
    scene = Scene(friction=0.3, stiffness=stiffness)
    scene.add_body("floor", [Plane((0, 0, 1))])
    scene.add_spheres([[0, 0, R + 2 * R * k] for k in range(count)], R, DENSITY)
    return scene


@pytest.mark.parametrize("solver", ["apgd", "pdip", "conic"])
@pytest.mark.parametrize("coulomb", [False, True])
def test_a_column_rests_on_the_overlaps_that_its_weight_makes(solver, coulomb):
    stiffness = 1e6
    with pctt.Simulation(column(stiffness), dt=0.01, solver=solver, coulomb=coulomb, **EXACT) as sim:
        sim.run(steps=150)
        height = sim.positions[:, 2]
        overlap = 2 * R - np.diff(np.concatenate([[-R], height]))
        expected = MASS * G * np.arange(5, 0, -1) / stiffness
        np.testing.assert_allclose(overlap, expected, rtol=1e-4)
        np.testing.assert_allclose(sim.body("floor").force, [0, 0, -5 * MASS * G], atol=1e-3 * MASS * G)


@pytest.mark.parametrize("dt", [0.002, 0.005, 0.02])
def test_the_overlaps_do_not_depend_on_the_step(dt):
    stiffness = 1e6
    with pctt.Simulation(column(stiffness), dt=dt, solver="apgd", **EXACT) as sim:
        sim.run(until=1.5)
        top = sim.positions[-1, 2]
    assert 9 * R - top == pytest.approx(15 * MASS * G / stiffness, rel=1e-4)
