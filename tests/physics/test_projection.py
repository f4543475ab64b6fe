"""-projection: forces of touching contacts alone, positions without overlaps; guards of what must not change."""

from __future__ import annotations

import numpy as np
import pytest
from mpi4py import MPI

import pctt
from dem.motion import Glide
from dem.scene import Scene
from dem.shapes import Box, Plane, Sphere

R, DENSITY, G = 0.1, 2500.0, 9.81
MASS = DENSITY * 4 / 3 * np.pi * R**3
EXACT = {"tol": 1e-10, "closing_work": np.inf, "solver": "apgd", "projection": True}


@pytest.mark.parametrize("dt", [0.002, 0.02])
def test_a_sphere_lands_without_overlap_and_without_bounce(dt):
    """In the step in which it arrives no force acts on it, yet it does not enter the floor."""
    scene = Scene(friction=0.3, stiffness=np.inf)
    scene.add_body("floor", [Plane((0, 0, 1))])
    scene.add_spheres([[0, 0, 0.5]], R, DENSITY)
    with pctt.Simulation(scene, dt=dt, **EXACT) as sim:
        heights, speeds, impulse = [], [], 0.0
        while sim.time < 0.6:
            sim.step()
            heights.append(sim.positions[0, 2])
            speeds.append(sim.velocities[0, 2])
            impulse -= dt * sim.body("floor").force[2]
    assert min(heights) > R - 1e-9
    assert min(speeds) == pytest.approx(-np.sqrt(2 * G * 0.4), abs=1.5 * G * dt)
    assert max(speeds) < 1e-6
    assert (heights[-1], speeds[-1]) == pytest.approx((R, 0.0), abs=1e-6)
    assert impulse == pytest.approx(MASS * G * sim.time, rel=1e-9)  # all momentum of the fall


def test_smooth_motion_is_of_second_order():
    """A sphere slides without friction off a fixed one; energy at equal times, with the mean of two velocities."""
    errors = []
    for dt in (0.008, 0.004, 0.002):
        scene = Scene(friction=0.0, stiffness=np.inf)
        scene.add_body("dome", [Sphere(1.0)])
        scene.add_spheres([[(1 + R) * np.sin(0.2), 0, (1 + R) * np.cos(0.2)]], R, DENSITY)
        with pctt.Simulation(scene, dt=dt, **EXACT) as sim:
            whole = []
            while sim.time < 0.4:
                place, before = sim.positions[0], sim.velocities[0, :3]
                sim.step()
                speed = 0.5 * (before + sim.velocities[0, :3]) if sim.steps > 1 else before
                whole.append(0.5 * speed @ speed + G * place[2])
            fallen = G * (whole_start(0.2) - sim.positions[0, 2])
        errors.append(abs(whole[-1] - G * whole_start(0.2)) / fallen)
        assert np.linalg.norm(sim.positions[0]) == pytest.approx(1 + R, abs=1e-3)
    assert errors[0] < 0.02
    assert errors[1] < 0.4 * errors[0]
    assert errors[2] < 0.4 * errors[1]


def whole_start(angle: float) -> float:
    return (1 + R) * np.cos(angle)


@pytest.mark.parallel(1, 2, 3)
def test_a_plate_moves_a_row_and_keeps_out_of_it(ranks):
    """10 cm a step, a radius: every sphere gets the speed of the plate, one after the other, and none overlaps."""
    scene = Scene(friction=0.3, gravity=(0, 0, 0), stiffness=np.inf)
    scene.add_body("plate", [Box((0.02, 0.5, 0.5))], Glide((5.0, 0, 0)), position=(-0.05, 0, 0))
    scene.add_spheres([[0.1 + 0.22 * k, 0, 0] for k in range(6)], R, DENSITY)
    found = []
    for comm in (MPI.COMM_WORLD, MPI.COMM_SELF):
        with pctt.Simulation(scene, dt=0.02, comm=comm, **EXACT) as sim:
            for _ in range(8):
                sim.step()
                assert np.diff(sim.positions[:, 0]).min() > 2 * R - 1e-3 * R
                assert sim.positions[0, 0] - sim.body("plate").position[0] > R + 0.02 - 1e-3 * R
            np.testing.assert_allclose(sim.velocities[:, 0], 5.0, rtol=1e-6)
            assert sim.figures["projection_its"] >= 0
            found.append(sim.positions)
    np.testing.assert_allclose(found[0], found[1], atol=1e-6)
