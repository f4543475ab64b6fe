"""Impacts with restitution have the closed forms of Newton's law."""

from __future__ import annotations

import numpy as np
import pytest

import pctt
from dem.motion import Guided
from dem.scene import Scene
from dem.shapes import Box, Plane, Sphere

R, DENSITY, G = 0.1, 2500.0, 9.81
EXACT = {"tol": 1e-10, "closing_work": np.inf}
STIFF = pytest.mark.parametrize("stiffness", [1e7, np.inf])


@STIFF
@pytest.mark.parametrize("solver", ["apgd", "pdip", "conic"])
def test_two_spheres_of_other_masses_part_as_newton_says(stiffness, solver):
    """Head on, m1 and 8 m1: momentum is kept and the relative speed is e times that before."""
    e, mass = 0.6, np.array([1.0, 8.0])
    scene = Scene(friction=0.0, gravity=(0, 0, 0), stiffness=stiffness, restitution=e)
    scene.add_spheres([[-0.101, 0, 0]], R, DENSITY, velocity=(2.0, 0, 0))
    scene.add_spheres([[0.201, 0, 0]], 2 * R, DENSITY, velocity=(-1.0, 0, 0))
    with pctt.Simulation(scene, dt=0.005, solver=solver, **EXACT) as sim:
        lost = sum(sim.step()["impact_loss [J]"] for _ in range(4))
        found = sim.velocities
    centre = (2.0 - 8.0) / 9.0
    apart = e * 3.0
    np.testing.assert_allclose(found[:, 0], [centre - apart * 8 / 9, centre + apart / 9], rtol=1e-5)
    reduced = 8.0 / 9.0 * mass[0] * DENSITY * 4 / 3 * np.pi * R**3
    assert lost == pytest.approx(0.5 * reduced * 9.0 * (1 - e**2), rel=1e-5)


@STIFF
def test_a_ball_bounces_to_lesser_heights_and_comes_to_rest(stiffness):
    e, fall = 0.7, 0.3
    scene = Scene(friction=0.3, stiffness=stiffness)
    scene.add_body("floor", [Plane((0, 0, 1))], material="steel")
    scene.add_spheres([[0, 0, R + fall]], R, DENSITY, material="rubber")
    scene.set_pair("steel", "rubber", restitution=e)
    with pctt.Simulation(scene, dt=0.01, solver="apgd", delta=0.01, **EXACT) as sim:
        time, height = [], []

        def note(sim):
            time.append(sim.time)
            height.append(sim.positions[0, 2] - R)

        sim.run(until=1.75, call=note)
        speed = sim.velocities[0, 2]
    height, time = np.array(height), np.array(time)
    first = np.sqrt(2 * fall / G)
    rest = first * (1 + e) / (1 - e)  # of endlessly many bounces
    assert rest < 1.6
    assert abs(speed) < 1e-9
    assert np.abs(height[time > 1.7]).max() < 1e-4


@pytest.mark.parametrize("shape", ["sphere", "box"])
@pytest.mark.parametrize("e", [1.0, 0.8])
@pytest.mark.parametrize("dt", [0.01, 0.007])
def test_each_bounce_leads_to_e2_of_the_height_before_whatever_the_step(shape, e, dt):
    """Every place and velocity lies on a parabola of the discrete flight, whose top is e^2k of that of the fall."""
    scene = Scene(friction=0.3, restitution=e)
    scene.add_body("floor", [Plane((0, 0, 1))])
    if shape == "box":
        scene.add_boxes([[0, 0, R + 0.12]], (R, R, R), DENSITY)
    else:
        scene.add_spheres([[0, 0, R + 0.12]], R, DENSITY)
    with pctt.Simulation(scene, dt=dt, solver="apgd", **EXACT) as sim:
        tops = []
        sim.run(until=0.7, call=lambda sim: tops.append(
            sim.positions[0, 2] - R + (sim.velocities[0, 2] - 0.5 * dt * G) ** 2 / (2 * G)
        ))  # fmt: skip
    first = 0.12 + G * dt**2 / 8  # velocities are those of the middle of a step
    bounces = np.cumsum(np.abs(np.diff(tops, prepend=first)) > 1e-6 * first) if e < 1.0 else np.zeros(len(tops))
    np.testing.assert_allclose(tops, first * e ** (2 * bounces), rtol=1e-6)
    assert e == 1.0 or bounces[-1] == 3  # the fourth after .77 s


def test_bodies_at_rest_do_not_bounce():
    scene = Scene(friction=0.3, restitution=0.9, stiffness=1e7)
    scene.add_body("floor", [Plane((0, 0, 1))])
    scene.add_spheres([[0, 0, R * (2 * k + 1)] for k in range(3)], R, DENSITY)
    with pctt.Simulation(scene, dt=0.005, solver="apgd", **EXACT) as sim:
        sim.run(steps=80)
        assert sim.kinetic_energy < 1e-12


PRESSED = {  # what presses a body of 10 kg on a floor with some 10 g, and with which weight beside it
    "load": 0.0, "load beside gravity": G, "spring": 0.0, "press": 0.0, "cohesion": 0.0,
}  # fmt: skip


@pytest.mark.parametrize("shape", ["sphere", "box"])
@pytest.mark.parametrize("by", PRESSED)
def test_what_forces_press_on_a_floor_comes_to_rest(shape, by):
    """Whatever presses a body: it falls by 1 mm and bounces to lesser and lesser heights, for 0.1 s in all. Then the
    floor bears the forces in every step."""
    push, weight = 981.0, 10.0 * PRESSED[by]
    law = {"cohesion": push, "cohesion_range": 0.01} if by == "cohesion" else {}
    scene = Scene(0.3, gravity=(0, 0, -PRESSED[by]), restitution=0.8, **law)
    scene.add_body("floor", [Plane((0, 0, 1))])
    place = [0, 0, R + 1e-3]
    if by == "press":
        head = [Box((R, R, R))] if shape == "box" else [Sphere(R)]
        scene.add_body("press", head, Guided((0, 0, -1), force=push), mass=10.0, position=place)
    elif shape == "box":
        scene.add_boxes([place], (R, R, R), 10.0 / (8 * R**3))
    else:
        scene.add_spheres([place], R, 10.0 / (4 / 3 * np.pi * R**3))
    if by.startswith("load"):
        scene.add_load("push", force=(0, 0, -push))
    if by == "spring":
        scene.add_spring("push", None, 0, anchor=(0, 0, 5.0), stiffness=2.0, length=4.9 + push / 2.0)
    with pctt.Simulation(scene) as sim:
        sim.run(until=0.15)
        borne = [0.0 if by == "cohesion" else push + weight] * 10
        found = []
        sim.run(steps=10, call=lambda sim: found.append(-sim.body("floor").force[2]))
        np.testing.assert_allclose(found, borne, rtol=2e-3, atol=1e-3 * push)
        assert sim.kinetic_energy < 1e-7


def test_a_heap_that_a_load_presses_comes_to_rest():
    """Those that touch each other bear what presses the others, and do not bounce, as under gravity."""
    scene = Scene(0.3, gravity=(0, 0, 0), restitution=0.7)
    sides = np.concatenate([np.eye(3), -np.eye(3)])
    scene.add_body("box", [Plane(tuple(side), tuple(-3.6 * R * side)) for side in sides])
    scene.add_spheres(2.4 * R * (np.indices((3, 3, 3)).reshape(3, -1).T - 1.0), R, 1.0 / (4 / 3 * np.pi * R**3))
    scene.add_load("wind", force=(-0.5 * G, 0, -G))
    with pctt.Simulation(scene) as sim:
        sim.run(until=1.5)
        assert sim.kinetic_energy < 1e-9
        np.testing.assert_allclose(sim.body("box").force, [-13.5 * G, 0, -27 * G], atol=0.01 * G)


@pytest.mark.parametrize("by", ["load", "spring"])
def test_a_ball_bounces_under_a_load_as_under_gravity_and_makes_no_energy(by):
    """Between an impact and the end of its step a force may do more than its work on the mean of the two velocities."""
    found, strong = [], 98.1
    for press in ("gravity", by):
        scene = Scene(0.3, gravity=(0, 0, -strong if press == "gravity" else 0.0), restitution=0.8)
        scene.add_body("floor", [Plane((0, 0, 1))])
        scene.add_spheres([[0, 0, R + 1e-3]], R, 1.0 / (4 / 3 * np.pi * R**3))
        if press == "load":
            scene.add_load("push", force=(0, 0, -strong))
        elif press == "spring":
            scene.add_spring("push", None, 0, anchor=(0, 0, 5.0), stiffness=1e-3, length=4.9 + strong * 1e3)
        with pctt.Simulation(scene, dt=6.8e-4, stiffness=1e7) as sim:
            heights = []
            for _ in range(40):
                assert sim.step()["energy_jump [J]"] == 0.0
                heights.append(sim.positions[0, 2])
        found.append(heights)
    np.testing.assert_allclose(found[1], found[0], atol=1e-8)


@pytest.mark.parametrize("bad", [-0.1, 1.5])
def test_a_coefficient_is_between_0_and_1(bad):
    with pytest.raises(ValueError, match="restitution must be from 0 to 1"):
        Scene(friction=0.3, restitution=bad)


@pytest.mark.parametrize(("angle", "bounces"), [(0.6, 0.9), (0.0, 1.0)])
def test_a_rod_that_hits_a_rough_floor_gains_no_energy(angle, bounces):
    """With Newton's law and friction that sticks, this one left with 1.035 times its energy (Kane and Levinson 1985):
    it bounces with nine tenths of e. An upright one, whose impact loses energy, bounces as ever."""
    e, radius, half = 0.9, 0.01, 0.1
    scene = Scene(1.0, (0, 0, 0), restitution=e)
    scene.add_body("floor", [Plane((0, 0, 1))])
    turn = (np.cos(angle / 2), 0, np.sin(angle / 2), 0)
    high = half * np.cos(angle) + radius + 0.002
    scene.add_capsules([[0, 0, high]], radius, half, 1000.0, quaternions=turn, velocity=[1.0, 0, -1.0])
    with pctt.Simulation(scene, dt=1e-3, tol=1e-8) as sim:
        tip = np.array([-half * np.sin(angle), 0, -half * np.cos(angle)])
        energy = [sim.step()["kinetic_energy [J]"] for _ in range(4)]
        speed = (sim.velocities[:, :3] + np.cross(sim.local.velocity[:, 3:], tip))[0, 2]
    assert energy[-1] < energy[0]
    assert speed == pytest.approx(bounces * e, rel=0.05)


@pytest.mark.parametrize("friction", [0.5, 1.0, 1.5])
def test_a_ball_bounces_out_of_a_corner(friction):
    """It meets both walls in one step. Their friction on it may lock it, and then has no part in the impact."""
    radius = 0.01
    scene = Scene(friction, (0, 0, 0), restitution=1.0)
    scene.add_body("corner", [Plane((1, 0, 0)), Plane((0, 0, 1))])
    scene.add_spheres([radius + 3e-4, 0, radius + 2e-4], radius, 1000.0, velocity=(-1.0, 0, -0.7))
    with pctt.Simulation(scene, dt=1e-3) as sim:
        mass = sim.world.grains.mass[0]
        step = sim.step()
        assert step["converged"]
        assert 0.6 < step["kinetic_energy [J]"] / (0.5 * mass * 1.49) < 1.0
        assert (sim.velocities[0, [0, 2]] > 0.6).all()
