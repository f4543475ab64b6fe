"""Spinning bodies that are no spheres, under impulses of joints, contacts, loads and springs."""

from __future__ import annotations

import numpy as np
import pytest
from mpi4py import MPI
from scipy.integrate import solve_ivp

from dem import quaternion
from dem.motion import Dynamic
from dem.scene import Scene
from dem.shapes import Sphere
from pctt.simulation import Simulation

G, ARM = 9.81, 0.1
OBLATE, PROLATE, TRIAXIAL = (1.5e-3, 1.5e-3, 2.5e-3), (2e-3, 2e-3, 1e-3), (1e-3, 2e-3, 2.6e-3)


def tilted(angle):
    """The orientation of a top whose axis leans from the vertical to x by an angle."""
    return np.cos(angle / 2), 0.0, np.sin(angle / 2), 0.0


def energy(sim, **moments):
    """Of bodies of 1 kg with these moments [J], their heights taken in the middle of the step as their velocities."""
    total = 0.0
    for name, each in moments.items():
        body = sim.body(name)
        w = quaternion.rotate(quaternion.conjugate(body.orientation), body.velocity[3:])
        v, height = body.velocity[:3], body.position[2] - 0.5 * sim.settings.dt * body.velocity[2]
        total += 0.5 * (v @ v + np.array(each) @ w**2) + G * height
    return total


def top(moments, spin, tilt):
    """A top of 1 kg on a ball joint at the origin."""
    axis = np.array([np.sin(tilt), 0.0, np.cos(tilt)])
    scene = Scene(0.0)
    place = {"position": ARM * axis, "quaternion": tilted(tilt), "angular_velocity": spin * axis}
    scene.add_body("top", [Sphere(0.02)], Dynamic(), mass=1.0, inertia=moments, **place)
    scene.add_joint("tip", None, "top", kind="ball", anchor=(0, 0, 0))
    return scene


def simulation(scene, dt=None):
    return Simulation(scene, dt=dt, comm=MPI.COMM_SELF)


def lagrange(moments, spin, tilt, times):
    """Angles between the axis of the top and the vertical at some times."""
    across, along = moments[0] + ARM**2, moments[2] * spin

    def rates(time, y):
        turn = along * (np.cos(tilt) - np.cos(y[0])) / (across * np.sin(y[0]) ** 2)
        force = across * turn**2 * np.cos(y[0]) - along * turn + G * ARM
        return [y[1], force * np.sin(y[0]) / across]

    found = solve_ivp(rates, (0.0, times[-1]), [tilt, 0.0], t_eval=times, rtol=1e-10, atol=1e-12)
    return found.y[0]


@pytest.mark.parametrize(("moments", "spin", "tilt"), [(OBLATE, 300.0, np.pi / 2), (PROLATE, 200.0, 0.5)])
def test_a_top_on_a_joint_nutates_as_lagrange_says_and_keeps_its_energy(moments, spin, tilt):
    """It turns by .2 radians in a step, as the default has it."""
    sim = simulation(top(moments, spin, tilt))
    assert 0.19 < sim.settings.dt * spin <= 0.2
    sim.step()
    begin, times, heights = energy(sim, top=moments), [], []
    for _ in range(int(0.3 / sim.settings.dt)):
        sim.step()
        times.append(sim.time)
        heights.append(sim.body("top").position[2])
        assert energy(sim, top=moments) == pytest.approx(begin, abs=1e-3 * G * ARM)
    angle = np.arccos(np.array(heights) / ARM)
    exact = lagrange(moments, spin, tilt, np.array(times))
    assert np.abs(angle - exact).max() < 0.02 * np.ptp(exact)
    assert np.ptp(angle) == pytest.approx(np.ptp(exact), rel=0.01)
