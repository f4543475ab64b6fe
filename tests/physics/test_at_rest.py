"""Bodies at rest by the defaults: the floor bears their weight in every step, nothing creeps, iterations are few."""

from __future__ import annotations

import warnings

import numpy as np
import pytest

import pctt
from dem import record as recording
from dem.motion import Guided, Rotation
from dem.scene import Scene
from dem.shapes import Box, Plane, Sphere
from pctt.ccp import newton
from pctt.run import rest

G, H = 9.81, 0.05  # m/s^2, half the side of boxes [m]
STEP = 10  # of APGD cost as much as a step of the conic method, and up to fifty


def on_floor():
    scene = Scene(friction=0.5)
    scene.add_body("floor", [Plane((0, 0, 1))])
    return scene


def column(count=14, radius=0.05):
    scene = on_floor()
    scene.add_spheres([[0, 0, radius * (1 + 2 * k)] for k in range(count)], radius, 2500.0)
    return scene


def tower(*densities):
    scene = on_floor()
    scene.add_boxes([[0, 0, H * (1 + 2 * k)] for k in range(len(densities))], (H, H, H), densities)
    return scene


def overhang(part, count=8):
    """Blocks of which each stands out over the one below by this part of the harmonic limit 1 / k half lengths."""
    scene = on_floor()
    shift = [0.0, *(part * H / k for k in range(count - 1, 0, -1))]
    places = [[x, 0, H * (0.5 + k)] for k, x in enumerate(np.cumsum(shift))]
    scene.add_boxes(places, (H, H, 0.5 * H), 2000.0)
    return scene


def wall(rows=12, columns=12):
    """More contacts than `pctt.ccp.newton.elimination` takes."""
    scene = on_floor()
    places = [
        [2 * H * (i + 0.5 * (k % 2)), 0, H * (0.5 + k)] for k in range(rows) for i in range(columns - k % 2)
    ]  # fmt: skip
    scene.add_boxes(places, (0.98 * H, 0.5 * H, 0.5 * H), 2000.0)
    return scene


def at_rest(scene, seconds, begin, **settings):
    """The run; from its time `begin` [s] on the force on the floor over the weight, step by step, creep and energy; and
    the mean cost of a step in iterations of APGD."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.simplefilter("ignore", DeprecationWarning)  # of the compiler of loops
        sim = pctt.Simulation(scene, **settings)
        weight, share, cost = G * sim.comm.allreduce(sim.world.grains.mass.sum()), [], []
        sim.run(until=begin)
        start = sim.positions.copy()
        while sim.time < seconds:
            figures = sim.step()
            assert figures["converged"]
            assert figures["energy_jump"] == 0.0
            share.append(-sim.body("floor").force[2] / weight)
            cost.append(figures["iterations"] + (STEP - 1) * figures["newton_its"])
    creep = np.abs(sim.positions - start).max() / (sim.time - begin)
    energy = sim.kinetic_energy / (weight * H)
    return sim, np.array(share), creep, energy, np.mean(cost)


@pytest.mark.parametrize(
    "scene",
    [
        column(),
        tower(*[1000.0] * 16),
        tower(1000.0, 3e5),
        tower(1000.0, 3e6),
        tower(1e5, 30.0),
        tower(1000.0, 1000.0, 1000.0, 4e4),
        overhang(0.93),
    ],
    ids=["column", "tower", "1:300", "1:3000", "light on heavy", "heaviest on top", "overhang"],
)
def test_the_floor_bears_the_weight_in_every_step_and_nothing_creeps(scene):
    sim, share, creep, energy, cost = at_rest(scene, 0.55, 0.3)
    assert abs(share.mean() - 1.0) < 1e-3
    assert share.std() < 1e-3  # 0.03 to 0.3 where steps stop as soon as the limits are met
    assert creep < 1e-6
    assert energy < 1e-9
    assert cost < 80
    assert sim.figures["unbalanced_force"] < 1e-3


@pytest.mark.parallel(2)
def test_things_at_rest_on_several_ranks():
    """Few contacts of several ranks are solved by the first one: APGD needs thousands of iterations here."""
    for scene in (tower(1000.0, 3e6), column(5)):
        _, share, creep, _, cost = at_rest(scene, 0.16, 0.12)
        assert share.std() < 1e-3
        assert creep < 5e-6
        assert cost < 80


def test_many_contacts_at_rest():
    _, share, creep, energy, cost = at_rest(wall(), 0.6, 0.4)
    assert share.std() < 1e-4
    assert creep < 1e-6
    assert energy < 1e-9
    assert cost < 45


def beside(guest, **law):
    """A column of ten spheres with a `guest` that moves, two metres away."""
    scene = Scene(friction=0.5, **law)
    scene.add_body("floor", [Plane((0, 0, 1))])
    scene.add_spheres([[0, 0, H * (1 + 2 * k)] for k in range(10)], H, 2500.0)
    if guest == "roller":
        scene.add_spheres([[2, 0, H]], H, 2500.0, velocity=(1, 0, 0))
    elif guest == "mixed bed":
        places = np.stack(np.meshgrid(*[2.4 * H * np.arange(3)] * 3), axis=-1).reshape(-1, 3) + [2, 0, 0.06]
        scene.add_spheres(places, H, 2500.0)
        scene.add_body("paddle", [Box((0.3, 0.02, 0.1))], Rotation((0, 0, 5)), position=(2.1, -0.15, 0.12))
    elif guest == "pendulum":
        scene.add_spheres([[2.5, 0, 1]], H, 2500.0)
        scene.add_joint("string", 10, kind="ball", anchor=(2, 0, 1))
        scene.add_spheres([[3, 0, H]], H, 2500.0, velocity=(0, 1, 0))
    return scene


@pytest.mark.parametrize(
    ("guest", "law"),
    [
        ("roller", {}), ("roller", {"rolling": 0.002}), ("roller", {"restitution": 0.5}), ("pendulum", {}),
        pytest.param("mixed bed", {}, marks=pytest.mark.slow),
    ],
)
def test_a_column_is_at_rest_whatever_moves_beside_it(guest, law):
    sim, share = pctt.Simulation(beside(guest, **law)), []
    floor, weight = len(sim.ids), G * 10 * 2500.0 * 4 / 3 * np.pi * H**3

    def note(sim):
        on_floor = (sim.contacts.bodies == floor).any(axis=1) & (sim.contacts.bodies < 10).any(axis=1)
        share.append(abs(sim.contacts.force[on_floor, 2].sum()) / weight)

    sim.run(until=0.3)
    sim.run(until=0.5, call=note)
    assert sim.kinetic_energy > 1e-3
    assert abs(np.mean(share) - 1.0) < 1e-4
    assert np.std(share) < 1e-4  # 0.02 to 0.2 where all islands have the limits of the whole


def test_a_stack_falls_that_hangs_over_too_far():
    sim = pctt.Simulation(overhang(1.06))
    sim.run(until=0.7, stop=lambda sim: sim.positions[-1, 2] < (8 - 1) * H)
    assert sim.time < 0.7


def test_a_light_box_under_a_heavy_one_stays():
    """By seven powers of ten: it is not thrown out, and the floor bears the weight."""
    sim = pctt.Simulation(tower(1000.0, 1e10))
    sim.run(until=0.3)
    share = []
    sim.run(until=0.6, call=lambda s: share.append(-s.body("floor").force[2] / (G * s.world.grains.mass.sum())))
    assert np.std(share) < 5e-3
    assert abs(sim.positions[0, 2] - H) < 0.02 * H


def test_a_pinched_grain_does_not_creep():
    scene = Scene(friction=0.5)
    scene.add_capsules([[0, 0, 0]], 0.02, 0.05, 1000.0)
    scene.add_body("left", [Box((0.02, 0.1, 0.1), center=(-0.04, 0, 0))])
    scene.add_body("right", [Box((0.02, 0.1, 0.1), center=(0.04, 0, 0))], Guided((1, 0, 0), force=-150.0), mass=1.0)
    sim = pctt.Simulation(scene)
    sim.run(until=0.3)
    start = sim.positions.copy()
    sim.run(until=0.7)
    assert np.abs(sim.positions - start).max() < 4e-7


def test_what_moves_is_solved_to_the_limits_alone():
    """A ball that flies, a tool that turns beside a column: no step has an aim beyond the limits."""
    flying = on_floor()
    flying.add_spheres([[0, 0, 0.5]], 0.05, 2500.0, velocity=(1, 0, 0))
    passing = column(3)
    passing.add_body("tool", [Sphere(0.05)], Rotation((0, 0, 60)), position=(0.1005, 0, 0.05))
    for scene in (flying, passing):
        sim = pctt.Simulation(scene)
        sim.step()
        limits = rest.limits_of(sim.settings.limits, sim.world, sim.last.system)
        assert limits.aim == 1.0


def test_impulses_of_an_island_that_spoil_the_whole_are_left_out(monkeypatch):
    """The residual is relative: with smaller impulses of the island that of the others may be above the tolerance."""
    given, spoilt = rest.with_part, []

    def halved(problem, result, rows, part):
        part.impulse *= 0.5
        whole = given(problem, result, rows, part)
        spoilt.append(whole.accuracy.coulomb_residual)
        return whole

    monkeypatch.setattr(rest, "with_part", halved)
    sim = pctt.Simulation(beside("roller"))
    for _ in range(60):
        sim.step()
        assert sim.figures["converged"]
        assert sim.figures["coulomb_residual"] <= sim.settings.tol
    assert max(spoilt) > 10 * sim.settings.tol


def test_the_order_of_elimination_is_kept_where_a_part_is_solved_by_itself(monkeypatch):
    scene = tower(2000.0, 2000.0, 2000.0)
    scene.add_spheres([[-1, 0, 0.1]], 0.1, 2500.0, velocity=(-2.0, 0, 0), angular_velocity=(0, -20.0, 0))
    sim, orders = pctt.Simulation(scene, solver="conic", dt=0.005), []
    sim.run(steps=5)
    find = newton.order_of
    monkeypatch.setattr(newton, "order_of", lambda N: orders.append(N) or find(N))
    sim.run(steps=5)
    assert sim.figures["cone_problems"] == 1
    assert not orders


def test_iterations_that_lead_nowhere_are_counted():
    sim = pctt.Simulation(column(2))
    sim.run(steps=60)
    world, limits = sim.world, rest.limits_of(sim.settings.limits, sim.world, sim.last.system)
    assert (limits.aim, limits.spare) == (rest.AIM, rest.ATTEMPT)
    failed = pctt.ccp.Result(np.zeros((0, 3)), pctt.ccp.Status.CONVERGED, "", 1e-4, 160, beyond=100)
    before = world.spare = 500.0
    rest.account(world, limits, failed)
    assert world.spare == before - 100 + rest.SHARE * 160
    world.spare = rest.ATTEMPT - 1.0
    assert rest.limits_of(sim.settings.limits, world, sim.last.system).spare == 0
    failed.residual = limits.aimed
    rest.account(world, limits, failed)
    assert world.spare == rest.SPARE


def test_the_count_is_in_checkpoints(tmp_path):
    scene = column(3)
    sim = pctt.Simulation(scene)
    sim.run(steps=2)
    sim.world.spare = 123.0
    sim.save(tmp_path / "state.h5")
    assert pctt.Simulation.load(tmp_path / "state.h5", scene).world.spare == 123.0


@pytest.mark.parametrize(
    ("program", "words"), [(False, "a smaller dt=, a stiffness="), (True, "a smaller -dt, a -stiffness")]
)
def test_jumps_are_told_once_in_the_language_of_the_door(monkeypatch, program, words):
    row = recording.row
    monkeypatch.setattr(recording, "row", lambda *given: row(*given) | {"energy_jump [J]": 3.0})
    sim = pctt.Simulation(column(2), program=program)
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        sim.run(steps=3)
    assert [words in str(one.message) for one in told] == [True]


@pytest.mark.parametrize(("dt", "damping"), [(0.01, 5.0), (0.003, 0.0)])
def test_a_bob_on_a_slow_spring_is_no_jump(dt, damping):
    """Gravity and spring work on the same velocities, also where the bob turns back."""
    scene = Scene(0.5)
    (bob,) = scene.add_spheres([0, 0, 0], 0.1, 1000.0)
    scene.add_spring("spring", None, bob, anchor=(0, 0, 0.5), stiffness=400.0, length=0.5, damping=damping)
    jumps = []
    pctt.Simulation(scene, dt=dt).run(until=1.0, call=lambda sim: jumps.append(sim.figures["energy_jump"]))
    assert max(jumps) == 0.0


def test_a_swing_on_the_springs_is_no_jump():
    """A column that falls by less than a thousandth of a radius: its energy rises tenfold, and is next to nothing."""
    scene = on_floor()
    scene.add_spheres([[0, 0, 0.05002 + 0.10001 * k] for k in range(10)], 0.05, 2500.0)
    jumps = []
    pctt.Simulation(scene, dt=1e-4).run(steps=60, call=lambda s: jumps.append(s.figures["energy_jump"]))
    assert max(jumps) == 0.0
