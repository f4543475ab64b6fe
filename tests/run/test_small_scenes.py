"""Scenes at the edge of what can be simulated, through the Python interface: few bodies, none, or bad ones."""

from __future__ import annotations

import numpy as np
import pytest
from mpi4py import MPI

from dem.motion import Dynamic, Glide, Guided
from dem.scene import Scene
from dem.shapes import Box
from pctt.simulation import Simulation


def simulation_of(scene, **settings):
    """A simulation with the solver of the program."""
    return Simulation(scene, comm=MPI.COMM_SELF, **{"solver": "pdip", "dt": 0.025, **settings})


@pytest.fixture(autouse=True)
def _elsewhere(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


@pytest.mark.parametrize("solver", ["pdip", "apgd"])
def test_what_a_struck_grain_strikes_is_seen(solver):
    """A tool that goes 5 cm a step pushes two spheres in contact; the third, 3 cm ahead, was far from all motion."""
    scene = Scene(0.0, gravity=(0, 0, 0), stiffness=np.inf)
    scene.add_body("tool", [Box((0.02, 0.3, 0.3))], Glide((2.0, 0, 0)))
    scene.add_spheres([[0.12, 0, 0], [0.32, 0, 0], [0.55, 0, 0]], 0.1, 1000.0)
    sim = simulation_of(scene, solver=solver, tol=1e-8)
    line = sim.step()
    assert line["contacts"] == 3
    assert line["newton_its"] == (line["iterations"] if solver == "pdip" else 0)
    order = np.argsort(sim.world.grains.id)
    np.testing.assert_allclose(sim.world.grains.position[order, 0], [0.17, 0.37, 0.57], atol=1e-6)
    assert sim.figures["worst_overlap [m]"] < 1e-9
    sim.step()
    assert sim.figures["worst_overlap [m]"] < 1e-6


@pytest.mark.parametrize("motion", [Dynamic(), Guided((0, 0, 1))], ids=["free", "guided"])
def test_what_a_struck_plate_strikes_is_seen(motion):
    """A light plate between two spheres: the upper one would send it 8 cm in a step, the lower one is 6 cm off."""
    scene = Scene(0.0, gravity=(0, 0, 0))
    scene.add_body("plate", [Box((0.3, 0.3, 0.01))], motion, density=10.0)
    scene.add_spheres([[0, 0, 0.13], [0, 0, -0.17]], 0.1, 5000.0, velocity=[[0, 0, -10.0], [0, 0, 0]])
    sim = simulation_of(scene, solver="apgd", tol=1e-8, delta=0.01, dt=0.01)
    for _ in range(2):
        sim.step()
        places = sim.world.grains.position[np.argsort(sim.world.grains.id), 2]
        gaps = np.abs(places - sim.world.large.position[0, 2]) - 0.11
        assert gaps.min() > -1e-6
    mass = 5000.0 * 4e-3 / 3 * np.pi
    speed = 10.0 * mass / (2 * mass + 10.0 * 0.6 * 0.6 * 0.02)
    np.testing.assert_allclose(sim.world.grains.velocity[:, 2], -speed, rtol=1e-5)


def test_a_contact_that_does_not_close_needs_no_impulse():
    scene = Scene(0.3, gravity=(0, 0, 0))
    scene.add_spheres([[0, 0, 0], [0.202, 0, 0]], 0.1, 1000.0)
    line = simulation_of(scene).step()
    assert (line["contacts"], line["newton_its"], line["natural_residual"]) == (1, 0, 0.0)


@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_a_speed_whose_square_overflows_is_refused():
    with pytest.raises(ValueError, match=r"velocity: allowed is up to 1e\+150, got 1e\+200 in row 0"):
        Scene(0.3).add_spheres([0, 0, 0], 0.1, 1000.0, velocity=(1e200, 0, 0))
