"""Impacts of single spheres, and the cooling of a gas of them, whose speeds are known in closed form."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from mpi4py import MPI
from validation.rows import Row, row

from dem.packing import random_packing
from dem.scene import Scene
from dem.shapes import Plane
from pctt.simulation import Simulation

WALTON = "rigid limit of hard spheres (Walton 1993); cases of Chung and Ooi 2011"
DENSITY = 2500.0
PHASES = (0.15, 0.5, 0.85)  #: parts of the way of a step at which bodies touch


class Meeting(NamedTuple):
    """Two spheres, or one and a plane (of infinite radius), that meet along z: the first comes from below."""

    radii: tuple[float, float]
    velocity: tuple[Sequence[float], Sequence[float]]  #: (3,) each [m/s]
    spin: tuple[Sequence[float], Sequence[float]]  #: (3,) each [rad/s]
    restitution: float
    friction: float


def closed_form(case: Meeting) -> np.ndarray:
    """Velocities and spins (2, 6) after an impact: the normal impulse is (1 + e) m v_n, the tangential one what stops
    the sliding, 2/7 m v_t with the reduced mass m, or what friction allows."""
    radius = np.array(case.radii)
    inverse = 1.0 / (DENSITY * 4.0 / 3.0 * np.pi * radius**3)
    velocity, spin = np.array(case.velocity, float), np.array(case.spin, float)
    reach, n = np.where(np.isinf(radius), 0.0, radius), np.array([0.0, 0.0, 1.0])
    surface = [v + np.cross(w, side * r * n) for v, w, side, r in zip(velocity, spin, (1, -1), reach)]
    came = surface[0] - surface[1]
    normal = (1.0 + case.restitution) * came[2] / inverse.sum()
    slip = came * [1.0, 1.0, 0.0]
    speed = np.linalg.norm(slip)
    tangential = min(2.0 / 7.0 * speed / inverse.sum(), case.friction * normal)
    impulse = -normal * n - (tangential / speed if speed else 0.0) * slip  # on the first
    out = np.concatenate([velocity, spin], axis=1)
    for body, side in ((0, 1.0), (1, -1.0)):
        if np.isfinite(radius[body]):
            out[body, :3] += side * impulse * inverse[body]
            arm = side * reach[body] * n
            out[body, 3:] += 2.5 * inverse[body] / reach[body] ** 2 * np.cross(arm, side * impulse)
    return out


def simulated(case: Meeting, phase: float) -> np.ndarray:
    """The same (2, 6) by default settings. The bodies touch within the fourth step, after this part of it."""
    scene = Scene(case.friction, (0, 0, 0), restitution=case.restitution)
    alone = np.isinf(case.radii[1])
    dt = Simulation(_placed(scene, case, 1.0, alone), comm=MPI.COMM_SELF).settings.dt
    closing = case.velocity[0][2] - case.velocity[1][2]
    scene = Scene(case.friction, (0, 0, 0), restitution=case.restitution)
    sim = Simulation(_placed(scene, case, closing * dt * (3 + phase), alone), dt=dt, comm=MPI.COMM_SELF)
    sim.run(steps=8)
    out = np.zeros((2, 6))
    out[: 1 if alone else 2] = sim.velocities
    return out


def _placed(scene: Scene, case: Meeting, gap: float, alone: bool) -> Scene:
    if alone:
        scene.add_body("plate", [Plane((0, 0, -1))])
        scene.add_spheres([0, 0, -gap - case.radii[0]], case.radii[0], DENSITY, velocity=case.velocity[0],
                          angular_velocity=case.spin[0])  # fmt: skip
        return scene
    # they meet where the tangential ways have brought them above each other
    closing = case.velocity[0][2] - case.velocity[1][2]
    beside = gap / closing * (np.array(case.velocity[0]) - case.velocity[1]) * [1.0, 1.0, 0.0]
    scene.add_spheres([[0, 0, 0], [*beside[:2], gap + sum(case.radii)]], case.radii, DENSITY, velocity=case.velocity,
                      angular_velocity=case.spin)  # fmt: skip
    return scene


def worst(cases: Sequence[Meeting]) -> tuple[float, float]:
    """The greatest errors of speeds and of spins times radius, over the speed at which the surfaces meet."""
    speeds, spins = 0.0, 0.0
    for case in cases:
        exact, radius = closed_form(case), np.array(case.radii)
        size = np.where(np.isinf(radius), 0.0, radius)
        way = np.array(case.velocity[0]) - case.velocity[1]
        scale = np.linalg.norm(way) + np.abs(np.array(case.spin) * size[:, None]).max()
        for phase in PHASES:
            off = np.abs(simulated(case, phase) - exact)
            speeds = max(speeds, float(off[:, :3].max() / scale))
            spins = max(spins, float((off[:, 3:] * size[:, None]).max() / scale))
    return speeds, spins


def on_plate(radius: float, speed: float, degrees: float, e: float, mu: float, spin: float = 0.0) -> Meeting:
    """A sphere that comes at this angle from the normal."""
    angle = np.radians(degrees)
    velocity = (speed * np.sin(angle), 0.0, speed * np.cos(angle))
    return Meeting((radius, np.inf), (velocity, (0, 0, 0)), ((0, spin, 0), (0, 0, 0)), e, mu)


def pair(radii: tuple[float, float], spin: float, e: float, mu: float) -> Meeting:
    """Two spheres that meet at 0.2 m/s each, with the same spin; the lighter one comes from below."""
    return Meeting(radii, ((0, 0, 0.2), (0, 0, -0.2)), ((0, spin, 0), (0, spin, 0)), e, mu)


def rows() -> list[Row]:
    """Tests 3 to 8 of Chung and Ooi by the kind of impact, each at three places within a step."""
    tests = {
        "3, a sphere on a plate, restitution 0.2 to 1": [
            on_plate(0.0025, speed, 0.0, e, 0.0) for speed in (0.1, 3.9) for e in (0.2, 0.6, 1.0)
        ],
        "4, at 5 to 85 degrees, 3.9 m/s, e = 0.98, friction 0.092": [
            on_plate(0.0025, 3.9, angle, 0.98, 0.092) for angle in (5.0, 20.0, 30.0, 45.0, 60.0, 85.0)
        ],
        "5, the same normal speed, 1 to 40 times as fast along, e = 0.5, friction 0.3": [
            on_plate(0.025, np.hypot(0.2, side), np.degrees(np.arctan(side / 0.2)), 0.5, 0.3)
            for side in (0.2, 0.5, 2.0, 8.0)
        ],
        "6, with spin alone, 2 to 200 rad/s, e = 0.5, friction 0.4": [
            on_plate(0.1, 0.2, 0.0, 0.5, 0.4, spin) for spin in (2.0, 10.0, 200.0)
        ],
        "7, two equal spheres with spins": [pair((0.1, 0.1), spin, 0.5, 0.4) for spin in (2.0, 20.0, 100.0)],
        "8, two spheres of other sizes, with spins": [pair((0.02, 0.1), spin, 0.5, 0.4) for spin in (5.0, 40.0)],
    }  # fmt: skip
    out = []
    for name, cases in tests.items():
        speeds, spins = worst(cases)
        out.append(row("impacts", f"test {name}: worst error of a speed", 0.0, speeds, WALTON, "", 0.01))
        if any(case.friction for case in cases):
            what = f"test {name.split(',')[0]}: worst error of a spin times radius"
            out.append(row("impacts", what, 0.0, spins, WALTON, "", 0.01))
    return [*out, haff()]


def haff(count: int = 400, fraction: float = 0.1, e: float = 0.9) -> Row:
    """The time tau of Haff's law, T = T0 / (1 + t / tau)^2, of a gas without friction: 6 / ((1 - e^2) w) with Enskog's
    frequency of impacts w = 24 phi chi / (sqrt(pi) d) sqrt(T), chi by Carnahan and Starling."""
    radius = 0.01
    side = (count * 4.0 / 3.0 * np.pi * radius**3 / fraction) ** (1.0 / 3.0)
    place, sizes = random_packing((side,) * 3, radius, fraction, periodic=(True,) * 3, seed=1)
    velocity = np.random.default_rng(2).standard_normal(place.shape)
    velocity -= velocity.mean(axis=0)
    scene = Scene(0.0, (0, 0, 0), restitution=e, period=(side,) * 3)
    scene.add_spheres(place, sizes, DENSITY, velocity=velocity)
    sim = Simulation(scene, comm=MPI.COMM_SELF)
    begin = sim.kinetic_energy
    chi = (1.0 - fraction / 2.0) / (1.0 - fraction) ** 3
    temperature = (velocity**2).sum() / (3.0 * len(place))
    frequency = 24.0 * fraction * chi / (np.sqrt(np.pi) * 2.0 * radius) * np.sqrt(temperature)
    tau = 6.0 / ((1.0 - e**2) * frequency)
    sim.run(until=tau)
    found = sim.time / (np.sqrt(begin / sim.kinetic_energy) - 1.0)
    what = f"{len(place)} spheres without friction, solid fraction {fraction:g}, e = {e:g}: time of cooling"
    return row("Haff's law", what, float(tau), float(found), "Haff 1983, with Enskog's frequency of impacts", "s", 0.05)
