"""Tops, an arch, an overhang, cards, a chain and structures at rest by default settings, and what mechanics says."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from mpi4py import MPI
from scipy.optimize import brentq
from validation.rows import Row, band, row

from dem.motion import Dynamic
from dem.scene import Scene
from dem.shapes import Plane, Sphere
from pctt.simulation import Simulation

G, DENSITY = 9.81, 1000.0
LAGRANGE = "Lagrange's top: energy and two angular momenta are constant"


def rows() -> list[Row]:
    """What stands, what hangs, and what rests."""
    return [*statics(), chain(), *at_rest()]


def standing(scene: Scene, seconds: float, fallen: Callable[[Simulation], bool]) -> bool:
    """Whether a structure has not fallen after so many seconds."""
    sim = Simulation(scene, comm=MPI.COMM_SELF)
    while sim.time < seconds:
        sim.run(until=min(sim.time + 0.1, seconds))
        if fallen(sim):
            return False
    return True


# -- tops -----------------------------------------------------------------------------------------------------


def top_energy(sim: Simulation, inertia: np.ndarray, axis: np.ndarray) -> float:
    """Kinetic and potential energy [J] of a body of 1 kg whose axis of symmetry has this direction now."""
    body = sim.body("top")
    velocity, spin = body.velocity[:3], body.velocity[3:]
    along = float(spin @ axis)
    across = float(spin @ spin) - along**2
    turning = 0.5 * (inertia[0] * across + inertia[2] * along**2)
    return turning + 0.5 * float(velocity @ velocity) + G * float(body.position[2])


def tops() -> list[Row]:
    """An oblate and a prolate rotor on a ball joint, let go with their axes level, and one that stands on a floor."""
    out, arm, mass = [], 0.1, 1.0
    for name, inertia, spin in (
        ("oblate", np.array([1.5e-3, 1.5e-3, 2.5e-3]), 300.0), ("prolate", np.array([2.5e-3, 2.5e-3, 1e-3]), 600.0),
    ):  # fmt: skip
        scene = Scene(0.5)
        level = (np.sqrt(0.5), 0.0, np.sqrt(0.5), 0.0)  # the axis of symmetry, z, is level
        scene.add_body("top", [Sphere(0.02)], Dynamic(), mass=mass, inertia=inertia.tolist(), position=(arm, 0, 0),
                       quaternion=level, angular_velocity=(spin, 0, 0))  # fmt: skip
        scene.add_joint("pivot", None, "top", kind="ball", anchor=(0, 0, 0))
        sim = Simulation(scene, comm=MPI.COMM_SELF)
        begin = top_energy(sim, inertia, np.array([1.0, 0, 0]))
        worst, low = 0.0, 0.0
        while sim.time < 0.6:
            sim.step()
            place = sim.body("top").position
            worst = max(worst, abs(top_energy(sim, inertia, place / np.linalg.norm(place)) - begin))
            low = min(low, float(place[2]))
        # (1 - u^2) 2 m g l / I = (I3 w / I)^2 (u0 - u) for the cosine u of the lowest place, u0 = 0
        about = inertia[0] + mass * arm**2
        drive, hold = 2.0 * mass * G * arm / about, (inertia[2] * spin / about) ** 2
        lowest = arm * brentq(lambda u, d=drive, h=hold: (1 - u * u) * d + h * u, -0.9, -1e-9)
        what = f"{name} rotor on a ball joint, {spin:g} rad/s"
        out.append(row("tops", f"{what}: change of energy over m g l in 0.6 s", 0.0, worst / (mass * G * arm), LAGRANGE,
                       "", 1e-3))  # fmt: skip
        out.append(row("tops", f"{what}: lowest place of its nutation", 1e3 * lowest, 1e3 * low, LAGRANGE, "mm", 0.01))
    return [*out, on_floor()]


def on_floor(spin: float = 150.0, arm: float = 0.1, tip: float = 0.002) -> Row:
    """A top with a round tip on a rough floor, 0.2 rad from the vertical: the tip rolls, so nothing takes energy."""
    inertia, tilt = np.array([1.5e-3, 1.5e-3, 2.5e-3]), 0.2
    axis = np.array([np.sin(tilt), 0.0, np.cos(tilt)])
    scene = Scene(0.9)
    scene.add_body("floor", [Plane((0, 0, 1))])
    place = [0.0, 0.0, tip] + arm * axis
    scene.add_body("top", [Sphere(tip, (0, 0, -arm))], Dynamic(), mass=1.0, inertia=inertia.tolist(),
                   position=place.tolist(), quaternion=(np.cos(tilt / 2), 0, np.sin(tilt / 2), 0),
                   angular_velocity=(spin * axis).tolist())  # fmt: skip
    sim = Simulation(scene, dt=0.2 / spin, comm=MPI.COMM_SELF)
    worst, begin = 0.0, top_energy(sim, inertia, axis)
    while sim.time < 1.0:
        sim.step()
        turn = sim.body("top").orientation
        w, x, y, z = turn
        axis = np.array([2 * (x * z + w * y), 2 * (y * z - w * x), w * w - x * x - y * y + z * z])
        worst = max(worst, abs(top_energy(sim, inertia, axis) - begin))
    what = f"top on a floor, {spin:g} rad/s, 0.2 rad a step: change of energy over m g l in 1 s"
    return row("tops", what, 0.0, worst / (G * arm), "a tip that rolls takes no energy", "", 1e-3)


# -- statics --------------------------------------------------------------------------------------------------


def arch(thickness: float, count: int = 15) -> Scene:
    """A semicircle of mean radius 1 m of so many equal voussoirs on a floor."""
    scene = Scene(0.9)
    scene.add_body("floor", [Plane((0, 0, 1))])
    ends = np.linspace(0.0, np.pi, count + 1)
    for one, other in zip(ends[:-1], ends[1:]):
        corners = [
            [r * np.cos(angle), y, r * np.sin(angle)]
            for angle in (one, other) for r in (1.0 - thickness / 2, 1.0 + thickness / 2) for y in (-0.1, 0.1)
        ]  # fmt: skip
        middle = np.mean(corners, axis=0)
        scene.add_polyhedra(middle, np.array(corners) - middle, 2000.0)
    return scene


def overhang(part: float, count: int = 10) -> Scene:
    """Blocks of 0.4 m, each shifted against the one below by this part of 1/2k of its length, k counted from above."""
    scene, half = Scene(0.5), np.array([0.2, 0.1, 0.02])
    scene.add_body("floor", [Plane((0, 0, 1))])
    ways = part * half[0] / np.arange(count - 1, 0, -1)  # from the lowest to the next
    x = np.concatenate([[0.0], np.cumsum(ways)])
    z = half[2] * (2 * np.arange(count) + 1)
    scene.add_boxes(np.stack([x, 0 * x, z], axis=1), half, DENSITY)
    return scene


def cards(degrees: float, friction: float, half: Sequence[float] = (0.002, 0.035, 0.05)) -> Scene:
    """Two cards that lean on each other at this angle from the vertical."""
    scene, angle = Scene(friction), np.radians(degrees)
    scene.add_body("floor", [Plane((0, 0, 1))])
    thick, _, high = half
    up, out = np.array([np.sin(angle), 0, np.cos(angle)]), np.array([np.cos(angle), 0, -np.sin(angle)])
    inner = high * up + thick * out  # of the left card, from its centre: it meets the other one there
    z = high * np.cos(angle) + thick * np.sin(angle)  # the lowest corner stands on the floor
    for side in (1, -1):
        turn = (np.cos(angle / 2), 0, side * np.sin(angle / 2), 0)
        scene.add_boxes([-side * inner[0], 0, z], half, DENSITY, quaternions=turn)
    return scene


def statics() -> list[Row]:
    """What stands, and what falls."""
    out = []
    sizes = (0.098, 0.105, 0.11, 0.114, 0.12)
    stands = [t for t in sizes if standing(arch(t), 2.0, lambda sim: sim.positions[7, 2] < 0.9)]
    found = min(stands, default=np.inf)
    what = f"semicircle of 15 voussoirs: the least thickness over radius that stands, of {', '.join(map(str, sizes))}"
    out.append(row("arch", what, 0.1075, float(found), "Milankovitch 1907", "", 0.07))
    parts = (0.93, 0.97, 1.03)
    stands = [p for p in parts if standing(overhang(p), 3.0, lambda sim: sim.positions[-1, 2] < 0.3)]
    what = f"10 blocks: the greatest overhang over the harmonic sum that stands, of {', '.join(map(str, parts))}"
    out.append(band("overhang", what, 0.92, 1.0, float(max(stands, default=0.0)), "balance of moments", ""))
    parts = (0.9, 1.1, 1.5, 2.5)
    for degrees in (15.0, 20.0, 30.0):
        least = 0.5 * (np.tan(np.radians(degrees)) - 0.002 / 0.05)  # moments about the foot; the apex pushes level
        stands = [p for p in parts if standing(cards(degrees, p * least), 0.6, lambda sim: sim.positions[0, 2] < 0.04)]
        what = f"two cards at {degrees:g} degrees: least friction over that of statics, of {', '.join(map(str, parts))}"
        out.append(band("cards", what, 1.0, 1.15, float(min(stands, default=np.inf)), "balance of moments", ""))
    return out


def at_rest() -> list[Row]:
    """The force on the floor, which is the weight in every step."""
    def column(count: int) -> Scene:
        scene = Scene(0.5)
        scene.add_spheres([[0, 0, 0.1 + 0.2 * k] for k in range(count)], 0.1, DENSITY)
        return scene

    def boxes(masses: Sequence[float]) -> Scene:
        scene = Scene(0.5)
        for k, mass in enumerate(masses):
            scene.add_boxes([0, 0, 0.1 + 0.2 * k], (0.1,) * 3, DENSITY * mass)
        return scene

    out = []
    for name, scene in (
        ("column of 20 spheres", column(20)), ("tower of 30 boxes", boxes([1.0] * 30)),
        ("box on one of 1/100 of its mass", boxes([1.0, 100.0])),
        ("box on one of 1/10000 of its mass", boxes([1.0, 1e4])),
        ("tower of 5 boxes, the top 100 times as heavy", boxes([1.0, 1.0, 1.0, 1.0, 100.0])),
    ):  # fmt: skip
        scene.add_body("floor", [Plane((0, 0, 1))])
        sim = Simulation(scene, comm=MPI.COMM_SELF)
        weight = G * float(sim.local.mass.sum())
        sim.run(until=1.0)
        force = []
        while sim.time < 2.0:
            sim.step()
            force.append(-sim.body("floor").force[2] / weight)
        what = f"{name}: deviation of the force on the floor, over the weight"
        out.append(row("at rest", what, 0.0, float(np.std(force)), "balance of forces", "", 5e-3))
        out.append(row("at rest", "the same: its mean over the weight", 1.0, float(np.mean(force)), "balance of forces",
                       "", 1e-3))  # fmt: skip
    return out


def chain(count: int = 12, span: float = 0.6) -> Row:
    """Equal links with ball joints between two pins, which a drag brings to rest: link k has the slope V_k / H, with
    the vertical force V_k at its middle. In the limit of many links it is the catenary."""
    link, mass, drag = 1.0 / count, 0.01, 4.0
    share = np.arange(count) - 0.5 * (count - 1)

    def width(level: float) -> float:
        return float(link * np.cos(np.arctan(mass * G * share / level)).sum()) - span

    level = brentq(width, 1e-4, 10.0)
    fold = np.arccos(span) * np.where(np.arange(count) < count // 2, -1.0, 1.0)  # it begins as a V
    ends = np.concatenate([[[0.0, 0.0]], np.cumsum(link * np.stack([np.cos(fold), np.sin(fold)], axis=1), axis=0)])
    scene = Scene(0.0)
    radius = 0.1 * link
    density = mass / (np.pi * radius**2 * (0.4 * link + 4.0 / 3.0 * radius))
    middle, half = 0.5 * (ends[:-1] + ends[1:]), np.pi / 4 - fold / 2  # of the turn from z to the link
    turns = np.stack([np.cos(half), 0 * half, np.sin(half), 0 * half], axis=1)
    names = scene.add_capsules(np.insert(middle, 1, 0.0, axis=1), radius, 0.2 * link, density, quaternions=turns)
    for k in range(count + 1):
        one, other = (None if not 0 <= n < count else names[n] for n in (k - 1, k))
        anchor = (ends[k, 0], 0.0, ends[k, 1])
        first, second = (other, one) if one is None else (one, other)
        scene.add_joint(f"pin {k}", first, second, kind="ball", anchor=anchor)
    scene.add_load("drag", force=lambda time, table: -drag * table.mass[:, None] * table.velocity[:, :3])
    sim = Simulation(scene, comm=MPI.COMM_SELF)
    sim.run(until=4.0)
    forces = []
    while sim.time < 4.5:
        sim.step()
        forces.append(abs(sim.joint("pin 0").force[0]))
    found = float(np.mean(forces))
    what = f"hanging chain of {count} links, span 0.6 of its length: horizontal force"
    return row("chain", what, float(level), found, "balance of forces; the catenary is its limit", "N", 5e-3)
