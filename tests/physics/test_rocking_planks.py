"""Planks rock on logs, balls roll on what turns, and blocks rock from edge to edge: only impacts brake them."""

from __future__ import annotations

import numpy as np
import pytest
from mpi4py import MPI

from dem import quaternion
from dem.motion import Dynamic, Rotation
from dem.scene import Scene
from dem.shapes import Box, Capsule, Cylinder, Mesh, Plane, Sphere
from pctt.simulation import Simulation

G, RADIUS, THICK, HALF = 9.81, 0.08, 0.015, 0.35
ALONG_Y = (np.sqrt(0.5), np.sqrt(0.5), 0.0, 0.0)
LOGS = {"capsule": Capsule(RADIUS, 0.3), "cylinder": Cylinder(RADIUS, 0.6), "ball": Sphere(RADIUS)}


def slab():
    """A box of triangles."""
    corner = np.array([[x, y, z] for x in (-HALF, HALF) for y in (-0.1, 0.1) for z in (-THICK, THICK)])
    sides = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    return Mesh(corner, [triangle for a, b, c, d in sides for triangle in ((a, b, c), (a, c, d))])


PLANKS = {"box": Box((HALF, 0.1, THICK)), "coin": Cylinder(HALF, 2 * THICK), "mesh": slab()}


def energy(sim, **bodies):
    """Kinetic and potential [J] of bodies of these masses and moments, heights in the middle of the step."""
    total = 0.0
    for name, (mass, moments) in bodies.items():
        body = sim.body(name)
        spin = quaternion.rotate(quaternion.conjugate(body.orientation), body.velocity[3:])
        velocity, height = body.velocity[:3], body.position[2] - 0.5 * sim.settings.dt * body.velocity[2]
        total += 0.5 * (mass * velocity @ velocity + np.array(moments) @ spin**2) + mass * G * height
    return total


def swinging(plank, log, free):
    """A plank that lies askew on a log, where it would be after rolling there from the middle. Returns its energies
    over that of rest [J] after .1 s and .5 s, by the defaults."""
    tilt, own, other = 0.12, (1.0, (0.02, 0.05, 0.06)), (3.0, (0.1, 0.1, 0.0096))
    scene = Scene(1.0)
    if free:
        scene.add_body("floor", [Plane((0, 0, 1), (0, 0, -RADIUS))])
        motion = {"motion": Dynamic(), "mass": other[0], "inertia": other[1]}
    else:
        motion = {}
    scene.add_body("log", [LOGS[log]], quaternion=ALONG_Y, **motion)
    across, along = np.array([np.sin(tilt), 0, np.cos(tilt)]), np.array([np.cos(tilt), 0, -np.sin(tilt)])
    place = (RADIUS + THICK) * across - RADIUS * tilt * along
    turn = (np.cos(tilt / 2), 0, np.sin(tilt / 2), 0)
    scene.add_body("plank", [PLANKS[plank]], Dynamic(), mass=1.0, inertia=own[1], position=place, quaternion=turn)
    sim, found, bodies = Simulation(scene, comm=MPI.COMM_SELF), [], {"plank": own, **({"log": other} if free else {})}
    for seconds in (0.1, 0.5):
        sim.run(until=seconds)
        found.append(energy(sim, **bodies) - G * (RADIUS + THICK))
    return found


PAIRS = [("box", "capsule"), ("box", "ball"), ("coin", "cylinder"), ("mesh", "cylinder")]


@pytest.mark.parametrize(("plank", "log"), PAIRS)
def test_a_plank_rocks_on_a_log_without_loss(plank, log):
    early, late = swinging(plank, log, free=False)
    assert late == pytest.approx(early, rel=0.006)


def test_a_plank_rocks_on_a_log_that_rolls():
    early, late = swinging("box", "cylinder", free=True)
    assert late == pytest.approx(early, rel=0.012)


def seesaw(friction, dt):
    """A ball runs down a plank on a hinge. Returns the error of energy over the kinetic one, and its spin [rad/s]."""
    radius, plank, ball = 0.04, (2.0, (0.05, 0.4, 0.4)), (1.0, (6.4e-4,) * 3)
    scene = Scene(friction)
    scene.add_body("plank", [Box((1.0, 0.2, 0.02))], Dynamic(), mass=plank[0], inertia=plank[1])
    scene.add_joint("pin", None, "plank", kind="hinge", anchor=(0, 0, 0), axis=(0, 1, 0))
    place = (0.25, 0, 0.02 + radius)
    scene.add_body("ball", [Sphere(radius)], Dynamic(), mass=ball[0], inertia=ball[1], position=place)
    sim = Simulation(scene, dt=dt, comm=MPI.COMM_SELF)
    sim.step()
    first = energy(sim, plank=plank, ball=ball)
    sim.run(until=0.4)
    error = energy(sim, plank=plank, ball=ball) - first
    return error / sim.figures["kinetic_energy [J]"], sim.body("ball").velocity[4]


def test_a_ball_without_friction_does_not_spin_on_a_plank_that_turns():
    error, spin = seesaw(0.0, 0.004)
    assert abs(spin) < 1e-9
    assert abs(error) < 3e-4


def test_a_ball_rolls_on_a_plank_that_turns():
    error, spin = seesaw(1.0, 0.004)
    assert spin > 8.0
    assert abs(error) < 1.5e-3


def test_a_ball_on_a_turntable_goes_on_a_circle():
    """By the default step it keeps its speed, and turns by 2/7 of the angle of the table (Weckesser 1997)."""
    scene = Scene(1.0)
    scene.add_body("table", [Plane((0, 0, 1))], Rotation((0, 0, 2.0)))
    scene.add_spheres([[1.0, 0, 0.05]], 0.05, 2500.0, velocity=(0.0, 0.5, 0.0))
    sim = Simulation(scene, comm=MPI.COMM_SELF)
    sim.run(until=0.5)  # it slips no more
    time, first = sim.time, complex(*sim.velocities[0, :2])
    sim.run(until=1.5)
    last = complex(*sim.velocities[0, :2])
    assert abs(last / first - np.exp(2j / 7 * 2.0 * (sim.time - time))) < 3e-4


BLOCKS = [(0.1, 0.4, 0.1), (0.1, 0.4, 0.11), (0.01, 0.1, 0.05)]


@pytest.mark.parametrize(("half", "high", "tilt"), BLOCKS)
def test_a_block_rocks_as_housner_says(half, high, tilt):
    """By the default step: each landing leaves (1 - 3/2 sin^2 alpha)^2 of the energy. Of these starts the first lands
    at the end of a step, the second at the start of one, and a thin block lands slowly."""
    steep, reach = np.arctan2(half, high), np.hypot(half, high)
    scene = Scene(1.0)
    scene.add_body("floor", [Plane((0, 0, 1))])
    place = [half - reach * np.sin(steep - tilt), 0, reach * np.cos(steep - tilt)]
    scene.add_boxes([place], (half, 0.2, high), 1000.0, quaternions=[(np.cos(tilt / 2), 0, np.sin(tilt / 2), 0)])
    sim, angles = Simulation(scene, comm=MPI.COMM_SELF), []
    while sim.time < (1.4 if half > 0.01 else 0.8):
        sim.step()
        angles.append(2 * np.arctan2(sim.orientations[0, 2], sim.orientations[0, 0]))
    angle = np.array(angles)
    lands = np.flatnonzero((angle[1:] < 0) != (angle[:-1] < 0))
    assert len(lands) > 2
    left = np.cos(steep - tilt) - np.cos(steep)
    for start, end in zip(lands[:2], lands[1:]):
        left *= (1 - 1.5 * np.sin(steep) ** 2) ** 2
        peak = steep - np.arccos(np.cos(steep) + left)
        assert np.abs(angle[start : end + 1]).max() == pytest.approx(peak, rel=0.01)
