"""The loop of a simulation, one step at a time, and small scenes that several tests use.

The plain cone complementarity problem (CCP) asks y_n >= mu |y_t| of the contact velocities y, where y_n is
gap/dt + the normal velocity. A contact that slides with speed s keeps a gap of dt mu s: here, the lift.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from mpi4py import MPI

import dem.step
from dem.arrays import Floats
from dem.contact import find_contacts
from dem.model.partition import rebalance
from dem.model.world import World
from dem.scene import Scene
from dem.shapes import Plane
from dem.start import new_world
from dem.step import advance
from dem.step.system import ContactSystem
from dem.unconstrained import unconstrained
from pctt import ccp
from pctt.run.stepper import cone_problem

Triple = tuple[float, float, float]

G = 9.81  #: gravity [m/s^2]
RADIUS = 0.1  #: of single spheres [m]
HALF = (0.2, 0.15, 0.05)  #: half extents of single blocks [m]

#: Both solvers, with tolerances that they reach on small problems.
SOLVERS = {"pdip": 1e-8, "apgd": 1e-10}


class Step(dem.step.Step):
    """What one step did."""

    def impulse_on_b(self) -> Floats:
        """Impulses (nc, 3) on the second bodies, in the world frame [N s]."""
        return (self.impulse[:, None, :] @ self.system.frame)[:, 0]

    def friction_used(self) -> float:
        """Sum of the tangential impulses over the sum of the normal ones."""
        return float(np.hypot(self.impulse[:, 1], self.impulse[:, 2]).sum() / self.impulse[:, 0].sum())


def steps(
    world: World,
    count: int,
    dt: float,
    solver: str = "apgd",
    tol: float | None = None,
    delta: float = 0.01,
    recovery_speed: float = np.inf,
    iterations: int | None = None,
    law: str = ccp.RELAXATION,
) -> Iterator[Step]:
    """Make steps one by one; each must be solved to `tol`, by default that of SOLVERS, or is left after a
    number of `iterations`. Contacts are rigid."""
    world.pairs.stiffness[:] = np.inf
    limits = ccp.Limits(SOLVERS[solver] if tol is None else tol)
    if iterations is not None:
        limits = ccp.Limits(1e-300, iterations, fallback=False)
    for _ in range(count):
        rebalance(world)
        free = unconstrained(world, dt)
        contacts = find_contacts(world, delta, free)
        system = ContactSystem(world, contacts, free, recovery_speed)
        problem = cone_problem(system, world.comm)
        result = ccp.solve(problem, None, solver, limits, law=law)
        problem.destroy()
        reached = f"{result.reason}, residual {result.residual:.1e}"
        assert result.converged or iterations, f"step {world.step + 1}: {reached}"
        advance(world, free, contacts, system.velocity(result.impulse))
        yield Step(world, contacts, system, result.impulse)


def make_steps(world: World, count: int, dt: float, *args, **options) -> Step:
    """Make all steps; the last one."""
    return list(steps(world, count, dt, *args, **options))[-1]


def on_incline(slope: float, friction: float) -> Scene:
    """An empty incline, seen in its own axes: x down the slope, z away from it; gravity is turned instead."""
    scene = Scene(friction, gravity=(G * np.sin(slope), 0.0, -G * np.cos(slope)))
    scene.add_body("floor", [Plane((0, 0, 1))])
    return scene


def block(scene: Scene, lift: float = 0.0, velocity: Triple = (0.0, 0.0, 0.0)) -> World:
    """The scene with one block at the height `lift` above the plane z = 0."""
    scene.add_boxes([0.0, 0.0, HALF[2] + lift], HALF, 1000.0, velocity=velocity)
    return new_world(scene, MPI.COMM_SELF)


def sphere(
    scene: Scene, lift: float = 0.0, velocity: Triple = (0.0, 0.0, 0.0), spin: Triple = (0.0, 0.0, 0.0)
) -> World:
    """The scene with one sphere at the height `lift` above the plane z = 0."""
    scene.add_spheres([0.0, 0.0, RADIUS + lift], RADIUS, 1000.0, velocity=velocity, angular_velocity=spin)
    return new_world(scene, MPI.COMM_SELF)


def momentum(world: World) -> Floats:
    """Linear and angular momentum (6,) of the spheres of this rank, about the origin [N s, N m s]."""
    grains = world.grains
    linear = grains.mass[:, None] * grains.velocity[:, :3]
    angular = np.cross(grains.position, linear) + grains.inertia * grains.velocity[:, 3:]
    return np.concatenate([linear.sum(axis=0), angular.sum(axis=0)])


def by_id(world: World) -> dict[str, Floats]:
    """Positions, quaternions and velocities of all grains in the order of their ids, on every rank."""
    names = ("id", "position", "quaternion", "velocity")
    parts = world.comm.allgather({name: getattr(world.grains, name) for name in names})
    table = {name: np.concatenate([part[name] for part in parts]) for name in names}
    order = np.argsort(table["id"])
    return {name: column[order] for name, column in table.items()}


def spinning(shape, tip, seed=0, half_length=3 * RADIUS, pitch=2.06, dt=0.01):
    """Grains in a box without gravity that fly to the middle and spin; their tips move by `tip` radii in a step."""
    rng, far = np.random.default_rng(seed), pitch * (RADIUS + half_length)
    scene = Scene(0.3, gravity=(0, 0, 0))
    sides = np.concatenate([np.eye(3), -np.eye(3)])
    scene.add_body("box", [Plane(tuple(-side), tuple(1.6 * far * side)) for side in sides])
    place = far * (np.indices((3, 3, 3)).reshape(3, -1).T - 1.0)
    turns, spin = rng.normal(size=(27, 4)), rng.normal(size=(27, 3))
    spin *= tip * RADIUS / (RADIUS + half_length) / dt / np.linalg.norm(spin, axis=1, keepdims=True)
    motion = {"quaternions": turns, "velocity": -2.0 * place, "angular_velocity": spin}
    if shape == "capsules":
        scene.add_capsules(place, RADIUS, half_length, 1000.0, **motion)
    else:
        scene.add_boxes(place, (RADIUS, RADIUS, half_length), 1000.0, **motion)
    return scene
