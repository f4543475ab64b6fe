"""The loop of a simulation, one step at a time, and the scenes that several tests use."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from mpi4py import MPI

from dem import quaternion
from dem.arrays import Floats
from dem.bodies import Bodies
from dem.contact import Contacts, find_contacts
from dem.motion import Fixed, Motion
from dem.partition import rebalance
from dem.scene import Scene
from dem.shapes import Plane
from dem.stepper import advance
from dem.system import ContactSystem
from dem.world import World
from pctt import ccp
from pctt.run.simulate import cone_problem

G = 9.81  #: gravity [m/s^2]
SOLVERS = ("pdip", "apgd")


@dataclass
class Step:
    """What one step did."""

    contacts: Contacts
    system: ContactSystem
    impulse: Floats
    result: ccp.Result

    def normal_impulses(self) -> Floats:
        return self.impulse[:, 0]


def world_of(scene: Scene, comm: MPI.Comm = MPI.COMM_SELF) -> World:
    return World.from_scene(scene, comm)


def run(
    world: World,
    steps: int,
    dt: float,
    *,
    solver: str = "apgd",
    tol: float = 1e-8,
    delta: float = 0.01,
    recovery_speed: float = np.inf,
) -> Iterator[Step]:
    """Make steps one by one; each must be solved to `tol`."""
    for _ in range(steps):
        rebalance(world)
        contacts = find_contacts(world, delta)
        system = ContactSystem(world, contacts, dt, recovery_speed)
        problem = cone_problem(system, world.comm)
        result = ccp.solve(problem, None, solver, ccp.Limits(tol=tol))
        problem.destroy()
        assert result.converged, f"step {world.step + 1}: {result.reason}, residual {result.natural_residual:.1e}"
        advance(world, system.velocity(result.impulse), dt)
        yield Step(contacts, system, result.impulse, result)


def finish(steps: Iterator[Step]) -> Step:
    """Make all steps; the last one."""
    last = None
    for last in steps:
        pass
    assert last is not None
    return last
