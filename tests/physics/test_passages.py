"""Grains that go further than two radii in a step: they pass through nothing, or the step is refused."""

from __future__ import annotations

import numpy as np
import pytest
from mpi4py import MPI

import pctt
from dem.mesh import Mesh
from dem.motion import Guided, Oscillation
from dem.scene import Scene
from dem.shapes import Box, Plane, Sphere
from dem.start import new_world, step_remark
from dem.together import SceneError

RADIUS = 0.1
PLATE = [[-0.5, -0.5, 0], [0.5, -0.5, 0], [0.5, 0.5, 0], [-0.5, 0.5, 0]]


def target(kind: str) -> Scene:
    scene = Scene(0.3, gravity=(0, 0, 0))
    if kind == "sphere":
        scene.add_spheres([0, 0, 0], RADIUS, 2500.0)
    else:
        mesh = Mesh(np.array(PLATE, dtype=float), np.array([[0, 1, 2], [0, 2, 3]]))
        shape = {"box": Box((0.5, 0.5, 0.005)), "mesh": mesh, "plane": Plane((0, 0, 1))}[kind]
        scene.add_body("target", [shape])
    return scene


def simulation(scene: Scene, dt: float, comm: MPI.Comm = MPI.COMM_SELF) -> pctt.Simulation:
    settings = pctt.Settings(dt=dt, delta=0.02, solver="apgd", tol=1e-8)
    return pctt.Simulation(scene, settings, comm=comm, say=lambda line: None)


@pytest.mark.parallel(1, 2)
@pytest.mark.parametrize("kind", ["box", "mesh", "plane", "sphere"])
def test_no_fast_grain_ends_behind_what_stands_in_its_way(kind, ranks):
    refused = 0
    for speed in (10.0, 32.0, 200.0, 1e5) if ranks == 1 else (32.0, 200.0):
        for dt, height in ((0.01, 1.03), (0.01, 0.37), (0.001, 0.37)):
            scene = target(kind)
            aside = (0.0, 0.0) if kind == "sphere" else (0.02, 0.01)
            scene.add_spheres([*aside, height], RADIUS, 2500.0, velocity=(0, 0, -speed))
            mass = scene.grains().mass
            with simulation(scene, dt, MPI.COMM_WORLD) as sim:
                try:
                    for _ in range(min(int(2.0 / (speed * dt)) + 1, 25)):
                        sim.step()
                except SceneError as error:
                    said = str(error)
                else:
                    said = ""
                refused += bool(said)
                assert not said or (f"{speed:.4g} m/s" in said and f"{dt:g} s" in said and speed * dt > 2 * RADIUS)
                # at the start of the refused step it was still in front
                grains = sim.world.grains
                z = dict(sim.comm.allreduce([(int(i), p[2]) for i, p in zip(grains.id, grains.position)]))
                last = len(mass) - 1
                assert z[last] - (z[0] if kind == "sphere" else 0.0) > 0.9 * RADIUS
                if kind == "sphere":
                    momentum = sim.comm.allreduce(grains.mass @ grains.velocity[:, :3])
                    np.testing.assert_allclose(momentum, [0, 0, -mass[last] * speed], atol=1e-9 * mass[last] * speed)
    assert refused > 0


def test_a_fast_grain_that_meets_nothing_flies_on():
    """Past a sphere, at a tenth of a radius, and away from a wall."""
    scene = Scene(0.0, gravity=(0, 0, 0))
    scene.add_body("wall", [Plane((0, 0, 1))])
    scene.add_spheres([[0, 0, 3.0], [2.1 * RADIUS, 0, 1.8]], RADIUS, 2500.0, velocity=[[0, 0, 0], [0, 0, 200.0]])
    with simulation(scene, 0.01) as sim:
        sim.step()
        sim.step()
        order = np.argsort(sim.world.grains.id)
        np.testing.assert_allclose(sim.world.grains.position[order], [[0, 0, 3.0], [2.1 * RADIUS, 0, 5.8]], atol=1e-12)


def test_a_grain_that_goes_from_one_triangle_to_the_next_has_met_the_mesh():
    """A sphere strikes a soft mesh, on another triangle at the end of a step than at its start, while another one flies
    far."""
    scene = Scene(0.0, gravity=(0, 0, 0), stiffness=1e4)
    scene.add_body("floor", [Mesh(np.array(PLATE, dtype=float), np.array([[0, 1, 2], [0, 2, 3]]))])
    places, speeds = [[0.005, -0.005, RADIUS + 0.002], [0, 0, 3.0]], [[-1.0, 1.0, -1.0], [0, 0, 30.0]]
    scene.add_spheres(places, RADIUS, 2500.0, velocity=speeds)
    with simulation(scene, 0.01) as sim:
        sim.step()
        assert sim.positions[0][2] < RADIUS - 0.001


def test_a_grain_that_an_impulse_throws_is_not_thrown_through_a_plate():
    """A heavy ball sends a light one off at nearly 4 radii a step, at a plate behind it."""
    scene = Scene(0.0, gravity=(0, 0, 0), restitution=1.0)
    scene.add_body("plate", [Box((0.005, 0.5, 0.5))], position=(0.4, 0, 0))
    scene.add_spheres([-0.35, 0, 0], 0.2, 2.5e7, velocity=(20.0, 0, 0))
    scene.add_spheres([0.0, 0, 0], RADIUS, 2.5)
    with simulation(scene, 0.01) as sim:
        with pytest.raises(SceneError, match="grain 1 moves at .* 'plate'"):
            sim.step()
        assert sim.world.grains.position[:, 0].max() < 0.4


def test_a_large_time_step_is_named():
    scene = target("plane")
    scene.add_spheres([0, 0, 1.0], RADIUS, 2500.0, velocity=(0, 0, -200.0))
    assert "dt 0.01 s is too large" in step_remark(new_world(scene, MPI.COMM_SELF), 0.01)
    assert not step_remark(new_world(scene, MPI.COMM_SELF), 0.9e-3)
    falling = Scene(0.3)
    falling.add_spheres([0, 0, 1.0], RADIUS, 2500.0)
    world, fall = new_world(falling, MPI.COMM_SELF), np.sqrt(2 * RADIUS / 9.81)
    assert not step_remark(world, 0.99 * fall)
    assert "diameter" in step_remark(world, 1.01 * fall)


def test_an_overlap_that_no_force_can_part_is_reported():
    """A wall that swings into a body from the side, across its guide."""
    scene = Scene(0.3)
    scene.add_body("guided", [Sphere(0.2)], Guided((0, 0, 1)), position=(0, 0, 1), mass=10.0)
    scene.add_body("wall", [Plane((-1, 0, 0))], Oscillation((-1, 0, 0), 0.5, 4.0), position=(0.3, 0, 0))
    scene.add_spheres([-2, 0, 0.1], RADIUS, 2500.0)
    with simulation(scene, 0.01) as sim:
        worst = max([sim.step()["worst_overlap"] for _ in range(25)])
    swing = 0.5 * np.sin(2.0 * np.pi * 0.24 / 4.0)  # overlaps are those at the start of a step
    assert worst == pytest.approx(0.2 - (0.3 - swing), abs=1e-12)
