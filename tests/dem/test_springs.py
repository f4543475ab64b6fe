"""Springs and dampers: periods, decay, energy, order, stability, ranks, restarts."""

from __future__ import annotations

import numpy as np
import pytest
from mpi4py import MPI

import pctt
from dem import quaternion
from dem.motion import Dynamic, Glide, Guided, Held
from dem.scene import Scene
from dem.shapes import Box, Plane
from dem.together import SceneError

SELF, WORLD = MPI.COMM_SELF, MPI.COMM_WORLD
BALL = 1000.0 * 4e-3 / 3 * np.pi  # kg


def simulation(scene, dt, comm=SELF, **more):
    return pctt.Simulation(scene, dt=dt, delta=0.01, solver="apgd", tol=1e-9, comm=comm, **more)


def balls(places, **more):
    scene = Scene(0.3, gravity=more.pop("gravity", (0, 0, 0)), stiffness=np.inf)
    scene.add_spheres(places, 0.1, 1000.0, **more)
    return scene


def swing(dt, damping, rest=1.0, until=0.4):
    """Errors of the place of a ball at a spring along z with k = 40 m and c = 2 D sqrt(k m), that starts 0.1 m from
    rest; the speed at the start is that of half a step before."""
    rate, share = np.sqrt(40.0), damping
    state = np.array([0.1, 0.0])
    fall = np.array([[0.0, 1.0], [-(rate**2), -2 * share * rate]])

    def exact(time):
        values, vectors = np.linalg.eig(fall)
        return (vectors @ (np.exp(values * time) * np.linalg.solve(vectors, state))).real

    scene = balls([0, 0, 1.1], velocity=(0, 0, exact(-0.5 * dt)[1]))
    scene.add_spring(
        "a", 0, stiffness=40.0 * BALL, damping=2 * share * rate * BALL, length=rest, other_anchor=(0, 0, 1.0 - rest)
    )
    sim = simulation(scene, dt)
    places = []
    sim.run(until=until, call=lambda sim: places.append(sim.positions[0, 2] - 1.0))
    return np.array(places) - [exact(dt * step)[0] for step in range(1, len(places) + 1)]


@pytest.mark.parametrize("rest", [0.0, 1.0])
@pytest.mark.parametrize("damping", [0.0, 0.2, 3.0])
def test_a_ball_at_a_spring_swings_and_decays_with_second_order(damping, rest):
    errors = [np.abs(swing(dt, damping, rest)).max() for dt in (0.02, 0.01)]
    assert errors[0] < 2e-3
    assert errors[0] / errors[1] == pytest.approx(4.0, rel=0.2)


def test_two_balls_swing_about_their_centre_and_keep_it():
    """The frequency of the step is asin(w dt / 2) / (dt / 2), with the reduced mass; energy does not drift."""
    scene, dt = balls([[0, 0, 0], [0.5, 0, 0]]), 0.01
    scene.add_spring("a", 0, 1, stiffness=40.0 * BALL, length=0.4)
    sim, lengths, jumps = simulation(scene, dt), [], []

    def look(sim):
        lengths.append(np.linalg.norm(sim.positions[1] - sim.positions[0]))
        jumps.append(sim.figures["energy_jump [J]"])

    sim.run(steps=100, call=look)
    rate = 2 / dt * np.arcsin(np.sqrt(80.0) * dt / 2)
    size = 0.1 / np.cos(rate * dt / 2)
    np.testing.assert_allclose(lengths, 0.4 + size * np.cos(rate * dt * (np.arange(1, 101) + 0.5)), atol=1e-9)
    np.testing.assert_allclose(sim.positions.mean(axis=0), [0.25, 0, 0], atol=1e-12)
    assert max(jumps) == 0.0
    pull = 40.0 * BALL * (lengths[-2] - 0.4)
    np.testing.assert_allclose(sim.spring_force("a"), [-pull, 0, 0], atol=1e-9)


def test_the_balance_of_energy_has_the_work_of_springs():
    scene = balls([[0, 0, 0], [0.5, 0, 0]])
    scene.add_spring("a", 0, 1, stiffness=40.0 * BALL, damping=3.0, length=0.4, anchor=(0, 0.05, 0))
    sim = simulation(scene, 0.005)
    work = sum(sim.step()["work_of_motions [J]"] for _ in range(50))
    assert sim.kinetic_energy == pytest.approx(work, rel=1e-3)
    angular = np.cross(sim.positions, BALL * sim.velocities[:, :3]).sum(axis=0)
    spin = 0.4 * BALL * 0.01 * sim.velocities[:, 3:].sum(axis=0)
    np.testing.assert_allclose(angular + spin, 0.0, atol=1e-3 * np.abs(spin).max())  # to the order of dt
    np.testing.assert_allclose(sim.velocities[:, :3].sum(axis=0), 0.0, atol=1e-13)


def test_a_chain_of_damped_springs_has_the_modes_of_its_matrix():
    """Five balls between walls, the ends of the chain in the world: displacements by the exact exponential."""
    k, c, dt = 50.0, 1.5, 1e-3
    places = [[0.5 * n, 0, 0] for n in range(1, 6)]
    places[0][0] += 0.5 * dt * 0.1  # velocities are those of half a step before
    scene = balls(places, velocity=[[0.1, 0, 0]] + [[0, 0, 0]] * 4)
    for n in range(6):
        ends, wall = (n - 1 if n else None, n if n < 5 else None), (3.0 * (n == 5), 0, 0)
        numbers = {"stiffness": k * BALL, "damping": c * BALL, "length": 0.5}
        scene.add_spring(f"s{n}", *ends, **numbers, other_anchor=wall)
    sim = simulation(scene, dt)
    sim.run(steps=200)
    chain = 2 * np.eye(5) - np.eye(5, k=1) - np.eye(5, k=-1)
    rates, modes = np.linalg.eigh(chain)
    found, time = np.zeros(5), 0.2 + 0.5 * dt
    for rate, mode in zip(rates, modes.T):
        decay, turn = 0.5 * c * rate, np.sqrt(k * rate - (0.5 * c * rate) ** 2 + 0j)
        found += mode * (mode[0] * 0.1 * np.exp(-decay * time) * np.sin(turn * time) / turn).real
    np.testing.assert_allclose(sim.positions[:, 0] - 0.5 * np.arange(1, 6), found, atol=1e-6)


def test_anchors_turn_with_their_bodies():
    """A box that hangs by a corner from the world swings about the anchor, at rest with its centre below."""
    scene = balls([50, 0, 0], gravity=(0, 0, -9.81))
    tilt = quaternion.exponential(np.array([0.2, 0.1, 0]))
    body = {"mass": 2.0, "inertia": (0.02, 0.03, 0.04), "quaternion": tilt}
    scene.add_body("box", [Box((0.1, 0.1, 0.1))], Dynamic(), position=(1, 2, 3), **body)
    anchors = {"anchor": (0.1, 0.1, 0.1), "other_anchor": (1, 2, 4)}
    scene.add_spring("rope", "box", stiffness=1e3, damping=20.0, length=0.5, **anchors)
    sim = simulation(scene, 0.01)
    box = sim.body("box")
    for _ in range(120):
        sim.step()
        sim.change("load drag", on="box", force=-20.0 * box.velocity[:3], torque=-0.6 * box.velocity[3:])
    np.testing.assert_allclose(sim.spring_force("rope"), [0, 0, 2.0 * -9.81], atol=0.1)
    np.testing.assert_allclose(box.position, [1, 2, 4 - 0.5 - 2.0 * 9.81 / 1e3 - 0.1 * np.sqrt(3)], atol=3e-3)


def test_springs_pull_at_guided_held_and_prescribed_bodies():
    scene = balls([50, 0, 0])
    for place, (name, motion) in enumerate(
        {"slide": Guided((1, 0, 0)), "rig": Held((None, 0, 0), (0, 0, 0)), "hook": Glide((0.3, 0, 0))}.items()
    ):
        mass = {} if name == "hook" else {"mass": 1.5}
        scene.add_body(name, [Box((0.1, 0.1, 0.1))], motion, position=(place, place % 2, 0), **mass)
    scene.add_spring("a", "slide", "rig", stiffness=30.0, length=1.0)
    scene.add_spring("b", "rig", "hook", stiffness=20.0, damping=1.0)
    sim = simulation(scene, 0.01)
    sim.run(steps=30)
    for name in ("slide", "rig"):
        assert not sim.body(name).velocity[1:].any()
        assert sim.body(name).position[1] == (name == "rig")
    np.testing.assert_allclose(sim.body("hook").position, [2.09, 0, 0], rtol=1e-13)
    force, momentum = np.zeros(3), 1.5 * (sim.body("slide").velocity[0] + sim.body("rig").velocity[0])
    sim.step()
    force = -sim.spring_force("b")  # the guides bear what is across
    after = 1.5 * (sim.body("slide").velocity[0] + sim.body("rig").velocity[0])
    assert after - momentum == pytest.approx(0.01 * force[0])


def test_a_body_that_a_spring_presses_on_the_floor():
    scene = Scene(0.5, stiffness=np.inf)
    scene.add_body("floor", [Plane((0, 0, 1))])
    scene.add_spheres([0, 0, 0.1], 0.1, 1000.0)
    scene.add_spring("a", 0, stiffness=500.0, length=1.0, other_anchor=(0, 0, 0.9))
    sim = simulation(scene, 0.005)
    sim.run(steps=4)
    assert sim.body("floor").force[2] == pytest.approx(-9.81 * BALL - 500.0 * 0.2, rel=1e-6)


def test_the_damper_of_a_body_on_the_floor_does_not_see_it_fall():
    """A block on a belt, held by a rope: it bears mu m g, and nothing of the weight."""
    scene = Scene(0.3, stiffness=np.inf)
    scene.add_body("belt", [Box((1, 1, 0.1))], position=(0, 0, -0.1), surface_velocity=(0.5, 0, 0))
    scene.add_boxes([0, 0, 0.1], (0.1, 0.1, 0.1), 250.0)
    scene.add_spring("rope", None, 0, anchor=(0, 0, 0.1), stiffness=1600.0, damping=120.0, length=0.0)
    sim = simulation(scene, 0.005)
    sim.run(steps=125)
    np.testing.assert_allclose(sim.spring_force("rope"), [-0.3 * 2.0 * 9.81, 0, 0], atol=1e-3)
    np.testing.assert_allclose(sim.positions[0], [0.3 * 2.0 * 9.81 / 1600.0, 0, 0.1], atol=1e-5)


@pytest.mark.parallel(1, 2, 3)
def test_springs_are_the_same_on_any_ranks_and_after_a_restart(tmp_path):
    def make(comm, **more):
        scene = balls([[0.21 * x, 0.21 * y, 0.1] for x in range(4) for y in range(4)], gravity=(0, 0, -9.81))
        scene.add_body("floor", [Plane((0, 0, 1))])
        for n in range(12):
            scene.add_spring(f"s{n}", n, n + 4, stiffness=300.0, damping=2.0, length=0.25, anchor=(0, 0, 0.05))
        scene.add_spring("top", 5, "floor", stiffness=100.0, other_anchor=(0, 0, 1.0))
        return simulation(scene, 0.01, comm, **more)

    one, alone = make(WORLD), make(SELF)
    for sim in (one, alone):
        sim.run(steps=3)
        sim.change("spring top", length=0.1 + sim.comm.rank, damping=3.0)
        sim.run(steps=3)
    np.testing.assert_allclose(one.positions, WORLD.bcast(alone.positions), atol=1e-6)
    one.save(tmp_path / "state.h5")
    again = make(WORLD, restart=tmp_path / "state.h5")
    assert again.springs["top"].length == 0.1
    for sim in (one, again):
        sim.run(steps=3)
    np.testing.assert_array_equal(one.positions, again.positions)
    np.testing.assert_array_equal(one.spring_force("top"), again.spring_force("top"))


def test_a_step_too_large_for_the_springs_is_refused():
    for dt, fits in ((1.99 / np.sqrt(40.0), True), (2.01 / np.sqrt(40.0), False)):
        scene = balls([0, 0, 1.1])
        scene.add_spring("a", 0, stiffness=40.0 * BALL, damping=5.0, length=1.0)
        sim = simulation(scene, dt)
        if fits:
            sim.run(steps=100)
            assert abs(sim.positions[0, 2] - 1.0) < 0.2
        else:
            with pytest.raises(SceneError, match=r"springs a have frequencies up to 6.32 rad/s: dt.*less than 0.316 s"):
                sim.step()


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"one": 0, "other": 0}, "both ends of a spring are at 0"),
        ({"one": 7}, "spring 'a': there is no body or grain 7 yet"),
        ({"one": "rope"}, "spring 'a': there is no body or grain 'rope' yet"),
        ({"one": 0, "stiffness": -1.0}, "stiffness of a spring must not be negative"),
        ({"one": 0, "length": np.inf}, "length of a spring: NaN or infinite"),
        ({"one": 0, "anchor": (0, 0)}, "anchor of a spring"),
    ],
)
def test_what_is_no_spring_is_refused(given, words):
    with pytest.raises(ValueError, match=words):
        balls([0, 0, 0]).add_spring("a", **{"stiffness": 1.0, **given})


def test_only_the_numbers_of_springs_can_be_set():
    sim = simulation(balls([0, 0, 0]), 0.01)
    with pytest.raises(ValueError, match="no spring 'a'; there are: none"):
        sim.change("spring a", length=1.0)
