"""The coefficients of pairs of materials."""

from __future__ import annotations

import numpy as np
import pytest
from mpi4py import MPI

import pctt
from dem.scene import Scene
from dem.shapes import Clump, Plane


def test_a_pair_has_the_law_of_the_scene_but_for_what_is_given():
    scene = Scene(0.5, restitution=0.2)
    scene.set_pair("b", "a", friction=0.1, stiffness=2e5)
    scene.set_pair("a", "b", rolling=0.01)
    scene.set_pair("a", "a", stiffness=None, cohesion=3.0, cohesion_range=0.1)
    tables = scene.pairs(7e6)
    np.testing.assert_array_equal(tables.friction, [[0.5, 0.1], [0.1, 0.5]])
    np.testing.assert_array_equal(tables.stiffness, [[7e6, 2e5], [2e5, 7e6]])
    np.testing.assert_array_equal(tables.rolling, [[0.0, 0.01], [0.01, 0.0]])
    np.testing.assert_array_equal(tables.restitution, np.full((2, 2), 0.2))
    assert tables.resists
    assert scene.reach == 0.1


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"fricton": 0.3}, "fricton: no such coefficient of contacts; allowed are friction, .*did you mean friction"),
        ({"friction": -0.1}, "friction must not be negative, got -0.1"),
        ({"stiffness": 0.0}, "stiffness must be positive, or inf, got 0"),
        ({"restitution": 1.5}, "restitution must be from 0 to 1, got 1.5"),
        ({"touching": 0.3}, "touching must be 0 or 1, got 0.3"),
        ({"touching": np.nan}, "touching must be 0 or 1, got nan"),
        ({"cohesion": 1.0}, "cohesion: needs a cohesion_range"),
        ({"spinning": np.nan}, "spinning: NaN"),
    ],
)
def test_what_is_no_law_is_refused(given, words):
    with pytest.raises(ValueError, match=words):
        Scene(0.5).set_pair("a", "b", **given)
    with pytest.raises(ValueError, match=words):
        Scene(**{"friction": 0.5, **given})


@pytest.mark.parallel(1, 2)
def test_materials_that_do_not_touch_go_through_each_other():
    """Grains of smoke fall freely through a floor and through stones, which rest; clumps as spheres."""
    scene = Scene(0.5)
    scene.add_body("floor", [Plane((0, 0, 1))], material="stone")
    scene.add_spheres([[x, 0, 0.1] for x in (0, 1)], 0.1, 1000.0, material="stone")
    scene.add_spheres([[0, 0, 0.3]], 0.1, 1000.0, material="smoke")
    scene.add_clumps([[1, 0, 0.3]], Clump([(0, 0, 0), (0.05, 0, 0)], [0.1, 0.1]), 1000.0, material="smoke")
    scene.set_pair("stone", "smoke", touching=0)
    sim = pctt.Simulation(scene, dt=0.01, tol=1e-8, comm=MPI.COMM_WORLD)
    sim.run(steps=30)
    np.testing.assert_allclose(sim.positions[:2, 2], 0.1, atol=1e-4)
    np.testing.assert_allclose(sim.velocities[2:, 2], -9.81 * 0.3, rtol=1e-12)
    assert sim.positions[2:, 2].max() < 0.0
