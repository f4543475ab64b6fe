"""Sliding, rolling, a stack and a lattice, whose motions and forces are known in closed form."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from mpi4py import MPI
from validation.rows import Row, row

from dem.contact import find_contacts
from dem.mesh import Mesh
from dem.model.world import World
from dem.scene import Scene
from dem.shapes import Plane, Shape
from dem.start import new_world
from dem.step import advance
from dem.step.system import ContactSystem
from dem.unconstrained import unconstrained
from pctt import ccp
from pctt.run.stepper import cone_problem
from pctt.simulation import Simulation

G, DT = 9.81, 0.002
RADIUS = 0.1
THORNTON = "Thornton 1979, and the balance of the forces"


def tilted(degrees: float, friction: float, floor: Shape) -> Scene:
    """A scene whose floor z = 0 is an incline that falls towards x: gravity is tilted."""
    angle = np.radians(degrees)
    scene = Scene(friction, gravity=(G * np.sin(angle), 0.0, -G * np.cos(angle)), stiffness=np.inf)
    scene.add_body("floor", [floor])
    return scene


def moved(scene: Scene, seconds: float, until: Callable[[World], bool] = lambda world: False) -> World:
    """The world after so many seconds, or after the step in which `until` is true; Coulomb's law to 1e-9."""
    world = new_world(scene, MPI.COMM_SELF)
    while world.time < seconds - 1e-9 and not until(world):
        system, impulse = solved(world)
        advance(world, system.motion, system.contacts, system.velocity(impulse))
    return world


def solved(world: World, guess: np.ndarray | None = None) -> tuple[ContactSystem, np.ndarray]:
    """The contact problem of the next step and its impulses (nc, 3)."""
    free = unconstrained(world, DT)
    system = ContactSystem(world, find_contacts(world, 0.001, free), free)
    with cone_problem(system, world.comm) as problem:
        result = ccp.solve(problem, guess, "apgd", ccp.Limits(1e-9), law=ccp.COULOMB)
    return system, result.impulse


def plane() -> Shape:
    return Plane((0, 0, 1))


def triangles() -> Shape:
    """A flat floor of 200 triangles."""
    line = np.linspace(-4.0, 4.0, 11)
    vertices = np.stack(np.meshgrid(line, line, [0.0], indexing="ij"), axis=-1).reshape(-1, 3)
    place = np.arange(121).reshape(11, 11)
    a, b, c, d = place[:-1, :-1], place[1:, :-1], place[1:, 1:], place[:-1, 1:]
    both = np.concatenate([np.stack([a, b, c], axis=2), np.stack([a, c, d], axis=2)])
    return Mesh(vertices, both.reshape(-1, 3))


def rows() -> list[Row]:
    """All comparisons; the source of each is Newton's and Coulomb's laws for one rigid body."""
    law, out = "Coulomb's law for one body", []

    scene = tilted(0.0, 0.5, plane())
    scene.add_boxes([0, 0, RADIUS], (RADIUS,) * 3, 1000.0, velocity=(2, 0, 0))
    world = moved(scene, 1.0, lambda world: bool(np.abs(world.grains.velocity).max() < 1e-6))
    way = float(world.grains.position[0, 0])
    out.append(row("sliding", "box at 2 m/s, friction 0.5: way to rest", 4 / (2 * 0.5 * G), way, law, "m", 0.01))
    lift = float(world.grains.position[0, 2]) - RADIUS
    out.append(row("sliding", "the same box: height off the floor", 0.0, lift, law, "m", 1e-6))

    for friction, speed in ((0.3, G * (np.sin(np.pi / 6) - 0.3 * np.cos(np.pi / 6)) * 0.5), (0.6, 0.0)):
        scene = tilted(30.0, friction, plane())
        scene.add_boxes([0, 0, RADIUS], (RADIUS,) * 3, 1000.0)
        found = float(moved(scene, 0.5).grains.velocity[0, 0])
        what = f"box on 30 degrees, friction {friction:g}: speed after 0.5 s"
        out.append(row("sliding", what, speed, found, law, "m/s", 1e-3 if speed else 1e-6))

    for floor, name in ((plane, "plane"), (triangles, "mesh of 200 triangles")):
        scene = tilted(20.0, 0.5, floor())
        scene.add_spheres([-3, 0.03, RADIUS], RADIUS, 1000.0)
        found = float(moved(scene, 1.0).grains.velocity[0, 0])
        what = f"sphere on 20 degrees, friction 0.5, {name}: speed after 1 s, 5/7 g t sin 20"
        out.append(row("rolling", what, 5 / 7 * G * np.sin(np.radians(20)), found, law, "m/s", 1e-3))

    scene = tilted(45.0, 0.1, plane())  # tan 45 > 7/2 friction: it slides
    scene.add_spheres([0, 0, RADIUS], RADIUS, 1000.0)
    velocity = moved(scene, 0.5).grains.velocity[0]
    slope = np.sqrt(0.5)
    for what, reference, found, unit in (
        ("speed", G * slope * (1 - 0.1) * 0.5, velocity[0], "m/s"),
        ("spin", 2.5 * 0.1 * G * slope / RADIUS * 0.5, velocity[4], "rad/s"),
    ):
        what = f"sphere on 45 degrees, friction 0.1, slides: {what} after 0.5 s"
        out.append(row("rolling", what, float(reference), float(found), law, unit, 1e-3))

    scene = tilted(0.0, 0.2, triangles())
    scene.add_spheres([-3, 0.01, RADIUS], RADIUS, 1000.0, velocity=(3, 0, 0))
    world = moved(scene, 0.7)
    what = "sphere at 3 m/s on the mesh, friction 0.2: speed when it rolls, 5/7 of the first"
    out.append(row("rolling", what, 15 / 7, float(world.grains.velocity[0, 0]), law, "m/s", 1e-3))
    what = "the same sphere: sideways"
    out.append(row("rolling", what, 0.0, float(world.grains.position[0, 1]) - 0.01, law, "m", 1e-6))
    return [*out, *stack(), lattice(0.25), lattice(0.5)]


def stack(count: int = 5) -> list[Row]:
    """Boxes on top of each other: what each face bears follows from the weights, how its corners share it does not.
    Two starts of the solver give the same sums and other corners."""
    scene = tilted(0.0, 0.5, plane())
    heights = (2 * np.arange(count) + 1) * RADIUS
    scene.add_boxes([(0, 0, z) for z in heights], (RADIUS,) * 3, 1000.0)
    world = new_world(scene, MPI.COMM_SELF)
    weight = 8 * RADIUS**3 * 1000.0 * G
    system, _ = solved(world)
    contacts = find_contacts(world, 0.001, unconstrained(world, DT))
    face = np.rint(contacts.point[:, 2] / (2 * RADIUS)).astype(int)
    borne, corners = [], []
    for seed in (0, 1):
        guess = np.zeros((len(face), 3))
        if seed:  # all on one diagonal of each face, which is in balance as well
            guess[:, 0] = weight * DT * (count - face) / 2 * (contacts.point[:, 0] * contacts.point[:, 1] > 0)
        _, impulse = solved(world, guess)
        force = impulse[:, 0] / DT
        borne.append(np.bincount(face, force, count))
        corners.append(force[face == 0])
    expected = weight * (count - np.arange(count))
    worst = float(np.abs(np.array(borne) / expected - 1.0).max())
    apart = float(np.abs(corners[0] - corners[1]).max() / weight / count)
    balance = "balance of the forces on each box"
    what = "share of the weight by which a corner differs between two starts of the solver (indeterminate: any)"
    return [
        row("stack", f"{count} boxes: worst error of what a face bears", 0.0, worst, balance, "", 1e-6),
        row("stack", what, 0.0, apart, "four contacts, three conditions of balance", "", 0.5),
    ]


def lattice(friction: float, cells: int = 3) -> Row:
    """The greatest ratio of stresses in a triaxial test of a face-centred cubic lattice. The contacts across its axis
    open. Of the others, all at 45 degrees, each bears N and slides with T = friction N: (N + T) along the axis, of
    which all take part, and (N - T) along each side, of which one half does."""
    diameter, pressure, rate, start = 0.01, 1000.0, 0.01, 0.05
    corner = np.stack(np.meshgrid(*[np.arange(cells)] * 3), axis=-1).reshape(-1, 1, 3)
    face = 0.5 * np.array([[0, 0, 0], [1, 1, 0], [1, 0, 1], [0, 1, 1]])
    side = np.sqrt(2.0) * diameter
    scene = Scene(
        friction, (0.0, 0.0, 0.0), stiffness=1e4 * pressure * diameter, period=(cells * side,) * 3,
        stress=(pressure,) * 3, strain_rate=(None, None, rate), strain_start=start,
    )  # fmt: skip
    scene.add_spheres((corner + face).reshape(-1, 3) * side, diameter / 2, 2500.0)
    sim = Simulation(scene, dt=0.001, solver="apgd", tol=1e-6, comm=MPI.COMM_SELF)
    ratio = 0.0
    while sim.time < start + 1e-3 / rate:
        sim.step()
        x, y, z = (sim.figures[f"stress_{axis}{axis} [Pa]"] for axis in "xyz")
        ratio = max(ratio, 2.0 * z / (x + y))
    what = f"cubic lattice of spheres, friction f = {friction:g}: ratio of stresses at failure, 2 (1 + f) / (1 - f)"
    return row("lattice", what, 2 * (1 + friction) / (1 - friction), ratio, THORNTON, "", 0.01)
