"""Forces and torques on bodies: mechanics in closed form, changes within the loop, restarts, ranks."""

from __future__ import annotations

import numpy as np
import pytest
from cases import random_quaternions
from mpi4py import MPI

import pctt
from dem.motion import Dynamic, Fixed, Guided, Hinged
from dem.quaternion import matrix
from dem.scene import Scene
from dem.shapes import Box, Plane
from dem.together import SceneError

SELF, WORLD, DT = MPI.COMM_SELF, MPI.COMM_WORLD, 0.01
BOX = {"mass": 2.0, "inertia": (0.5, 0.5, 0.5)}


def free(motion=Dynamic(), gravity=(0, 0, 0), **more):  # noqa: B008 - immutable
    """A large body and eight grains of two materials, some of them boxes, far from each other."""
    scene = Scene(0.3, gravity)
    scene.add_body("tool", [Box((0.1, 0.1, 0.1))], motion, position=(50, 0, 0), **(BOX | more))
    scene.add_spheres([[k, 0, 0] for k in range(5)], 0.1, 1000.0, material="glass")
    turns = random_quaternions(np.random.default_rng(0), 3)
    scene.add_boxes([[k, 0, 0] for k in range(5, 8)], (0.1, 0.2, 0.3), 1000.0, quaternions=turns, material="wood")
    return scene


def simulation(scene, comm=SELF, **more):
    return pctt.Simulation(scene, dt=DT, delta=0.01, solver="apgd", comm=comm, **more)


def test_a_constant_load_gives_each_body_its_impulse():
    scene = free()
    scene.add_load("wind", force=(0, 3.0, 0), torque=(0, 0, 1e-3), end=0.05)
    scene.add_load("kick", on=[6, 1], force=[[0, 0, 1.0], [0, 0, 2.0]])
    scene.add_load("weight", on="wood", force=(0, 0, -5.0), start=0.025)
    scene.add_load("thrust", on="tool", force=(1.0, 0, 0), torque=(0, 2.0, 0))
    sim = simulation(scene)
    table = sim.local
    mass, moment, turn = table.mass.copy(), table.inertia.copy(), table.quaternion.copy()
    sim.run(until=0.1)
    order = np.argsort(sim.local.id)
    expected = np.zeros((8, 3))
    expected[:, 1] = 3.0 * 0.05
    expected[[6, 1], 2] = 0.1, 0.2
    expected[5:, 2] -= 5.0 * 0.075
    np.testing.assert_allclose(sim.velocities[:, :3], expected / mass[order, None], atol=1e-15)
    np.testing.assert_allclose(sim.velocities[:5, 5], 1e-3 * 0.05 / moment[order[0], 0])
    np.testing.assert_allclose(sim.body("tool").velocity, [0.05, 0, 0, 0, 0.4, 0], rtol=1e-13)
    first = simulation(scene)  # a torque turns a box by its tensor of inertia
    first.step()
    frames = matrix(turn)
    tensors = np.einsum("nij,nj,nkj->nik", frames, moment, frames)
    spin = np.linalg.solve(tensors, np.broadcast_to([0, 0, 1e-3 * DT], (8, 3))[..., None])[..., 0]
    np.testing.assert_allclose(first.local.velocity[:, 3:], spin, atol=1e-12)  # it turns a little in the step


def test_a_force_of_the_place_lets_grains_oscillate():
    """An oscillator of 1 Hz has the frequency asin(w dt / 2) / (dt / 2) in semi-implicit steps, and keeps its size."""
    scene, rate = free(), 2 * np.pi
    scene.add_load("springs", on="glass", force=lambda time, table: -(rate**2) * table.mass[:, None] * (
        table.position - table.id[:, None] * [1.0, 0, 0] - [0, 0.5, 0]
    ))  # fmt: skip
    sim, places = simulation(scene), []
    sim.run(steps=125, call=lambda sim: places.append(sim.positions[:5, 1] - 0.5))
    discrete = 2 / DT * np.arcsin(rate * DT / 2)
    phase = discrete * DT * (np.arange(1, 126) + 0.5)  # from rest: the velocity is that of half a step before
    size = -0.5 / np.cos(discrete * DT / 2)
    np.testing.assert_allclose(places, np.repeat(size * np.cos(phase)[:, None], 5, axis=1), atol=1e-11)


def test_a_force_of_the_time_and_a_drag():
    scene = free()
    scene.add_load("pulse", on="tool", force=lambda time, table: (time, 0, 0))
    scene.add_load("drag", force=lambda time, table: -3.0 * table.mass[:, None] * (table.velocity[:, :3] - [0, 1.0, 0]))
    sim = simulation(scene)
    sim.run(steps=100)
    assert sim.body("tool").velocity[0] == pytest.approx(DT * DT * 99 * 100 / 2 / 2.0)
    np.testing.assert_allclose(sim.velocities[:, 1], 1.0 - (1 - 3.0 * DT) ** 100, rtol=1e-12)


def test_the_work_of_loads_is_in_the_balance_of_energy():
    scene = free(gravity=(0, 0, -9.81))
    scene.add_load("wind", force=(2.0, 0, 1.0))
    scene.add_load("thrust", on="tool", force=(5.0, 0, 0), torque=(0, 0, 1.0))
    sim = simulation(scene)
    work = sum(sim.step()["work_of_motions [J]"] + sim.figures["time_stepping [J]"] for _ in range(20))
    mass = np.concatenate([sim.local.mass, [2.0]])
    assert not sim.figures["energy_jump [J]"]
    height = np.concatenate([sim.local.position[:, 2], sim.world.large.position[:, 2]])
    assert sim.kinetic_energy + 9.81 * mass @ height == pytest.approx(work, rel=1e-12)


def test_the_floor_bears_what_a_load_presses():
    scene = Scene(0.5, stiffness=np.inf)
    scene.add_body("floor", [Plane((0, 0, 1))])
    scene.add_body("press", [Box((0.3, 0.3, 0.01))], Guided((0, 0, 1)), mass=1.0, position=(0, 0, 0.21))
    scene.add_spheres([[x, y, 0.1] for x in (-0.15, 0.15) for y in (-0.15, 0.15)], 0.1, 1000.0)
    scene.add_load("pressure", on="press", force=(0, 7.0, -100.0))
    sim = simulation(scene, tol=1e-9)
    sim.run(steps=5)
    weight = 9.81 * (1.0 + sim.local.mass.sum())
    assert sim.body("floor").force[2] == pytest.approx(-weight - 100.0, rel=1e-5)
    sim.change("load pressure", force=(0, 0, -50.0))
    sim.run(steps=5)
    assert sim.body("floor").force[2] == pytest.approx(-weight - 50.0, rel=1e-5)
    np.testing.assert_array_equal(sim.loads["pressure"].force, [0, 0, -50])


def test_a_torque_turns_a_hinged_body_and_its_servo_makes_up_for_it():
    sim = simulation(free(Hinged((0, 0, 1)), inertia=(1, 1, 0.5)))
    sim.change("load twist", on="tool", torque=(3.0, 0, 2.0))
    sim.run(steps=10)
    np.testing.assert_allclose(sim.body("tool").velocity, [0, 0, 0, 0, 0, 0.4], atol=1e-13)
    sim = simulation(free(Hinged((0, 0, 1), torque=9.0, speed=0.1), inertia=(1, 1, 0.5)))
    sim.change("load twist", on="tool", torque=(3.0, 0, 2.0))
    sim.run(steps=10)
    np.testing.assert_allclose(sim.body("tool").velocity[5], 0.1, rtol=1e-12)


def loaded():
    """Spheres in a heap, pushed by loads of all kinds."""
    scene = Scene(0.3)
    scene.add_body("floor", [Plane((0, 0, 1)), Plane((1, 0, 0), (-0.15, 0, 0))])
    scene.add_body("tool", [Box((0.1, 0.1, 0.05))], position=(0.2, 0.2, 0.7), motion=Dynamic(), **BOX)
    places = np.stack(np.meshgrid(*[np.arange(3) * 0.205] * 3, indexing="ij"), -1).reshape(-1, 3) + [0, 0, 0.1]
    ids = scene.add_spheres(places, 0.1, 1000.0)
    scene.add_load("wind", force=lambda time, table: np.sin(table.position) - table.velocity[:, :3])
    scene.add_load("kick", on=ids[3:9], torque=np.arange(18.0).reshape(6, 3))
    return scene


@pytest.mark.parallel(1, 2, 3)
def test_loads_are_the_same_on_any_ranks_and_after_a_restart(tmp_path):
    def change(sim):
        if sim.steps == 6:
            sim.change("load kick", force=[[0, 1.0 + sim.comm.rank, 0]] * 6)  # the first rank's counts
            sim.change("load pull", on=[26, 2], force=(0, 0, 3.0), end=1.0)
            sim.change("load tug", on="tool", force=(4.0, 0, 0))

    sims = [simulation(loaded(), comm, tol=1e-9) for comm in (WORLD, SELF)]
    for sim in sims:
        sim.run(steps=10, call=change)
    positions = sims[0].positions
    first = WORLD.bcast(sims[1].positions)
    np.testing.assert_allclose(positions, first, atol=1e-7)
    sims[0].save(tmp_path / "state.h5")
    again = pctt.Simulation.load(
        tmp_path / "state.h5", loaded(), dt=DT, delta=0.01, solver="apgd", tol=1e-9, comm=WORLD
    )
    for sim in (sims[0], again):
        sim.run(steps=5)
    np.testing.assert_array_equal(again.positions, sims[0].positions)
    np.testing.assert_array_equal(again.body("tool").velocity, sims[0].body("tool").velocity)
    assert again.loads["pull"].end == 1.0


def failing(time, table):
    raise ZeroDivisionError("no wind")


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"name": "tool"}, "loads and large bodies need distinct names, got 'tool'"),
        ({"on": "paper"}, "load 'a': 'paper' is neither a body nor a material"),
        ({"on": "floor"}, "load 'a': the motion of the body 'floor' is prescribed"),
        ({"on": [3, 3]}, "ids of grains, each once"),
        ({"on": [3, 8]}, "load 'a': there is no grain 8"),
        ({"on": [3], "force": np.zeros((2, 3))}, r"force of a load must have shape \(3,\) or \(1, 3\), got \(2, 3\)"),
        ({"torque": (1, 2)}, r"torque of a load must have shape \(3,\), got \(2,\)"),
        ({"force": (0, 0, np.nan)}, "force of a load: NaN"),
        ({"start": 2.0, "end": 1.0}, "Load cannot begin at 2 s and end at 1 s"),
    ],
)
def test_what_is_no_load_is_refused(arguments, words):
    scene = free()
    scene.add_body("floor", [Plane((0, 0, 1), (0, 0, -50))], Fixed())

    def load():
        scene.add_load(**{"name": "a", **arguments})
        simulation(scene)

    with pytest.raises(ValueError, match=words):
        load()


def test_a_law_that_fails_names_its_load():
    for law, words in ((failing, "no wind"), (lambda *_: np.zeros((2, 3)), r"must have shape \(3,\) or \(8, 3\)")):
        scene = free()
        scene.add_load("wind", force=law)
        sim = simulation(scene)
        with pytest.raises(SceneError, match=f"load 'wind': .*{words}"):
            sim.step()
    with pytest.raises(ValueError, match="force of load wind can be set to numbers .* a function comes from the scene"):
        simulation(free()).change("load wind", on=None, force=failing)
