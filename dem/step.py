"""The semi-implicit step: new velocities come from the contact problem, and positions follow them."""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from dem import quaternion
from dem.arrays import ArrayLike, Floats
from dem.bodies import Bodies
from dem.contact import Contacts
from dem.motion import Dynamic, checked_pose
from dem.system import ContactSystem
from dem.together import meet, together
from dem.world import World


@dataclass(frozen=True)
class Step:
    """A step that was just made, with its forces, places and sums: the argument of a scene's `record`.

    `advance` was called, the grains are not yet balanced anew.
    """

    world: World  #: at the end of the step
    contacts: Contacts
    system: ContactSystem
    impulse: Floats  #: (nc, 3) of the local contacts: normal, t1, t2 [N s]

    def force_on(self, name: str) -> Floats:
        """Contact force and torque (6,) [N, N m] on a large body, about its reference point, averaged over the step."""
        row = self.world.large_row(name)
        normal, tangential = self.generalised_impulses
        return (normal[1][row] + tangential[1][row]) / self.system.dt

    def position(self, name: str) -> Floats:
        """Position (3,) of a large body [m]."""
        return self.world.large.position[self.world.large_row(name)].copy()

    def velocity(self, name: str) -> Floats:
        """Linear and angular velocity (6,) of a large body [m/s, rad/s]."""
        return self.world.large.velocity[self.world.large_row(name)].copy()

    def total(self, values: ArrayLike) -> float:
        """The sum of values (grains,) over all grains; each rank passes those of its `world.grains`. Collective: the
        `record` of a scene must call it on all ranks."""
        meet(self.world.comm, "Step.total")
        return float(self.world.comm.allreduce(float(np.sum(values))))

    @cached_property
    def generalised_impulses(self) -> tuple[tuple[Floats, Floats], tuple[Floats, Floats]]:
        """Generalised impulses on grains and large bodies by the normal and by the tangential impulses."""
        normal = self.impulse * [1.0, 0.0, 0.0]
        return self.system.generalised_impulse(normal), self.system.generalised_impulse(self.impulse - normal)


def advance(world: World, velocity: Floats, dt: float) -> None:
    """Take the velocities (owned, 6) of `ContactSystem` and move all bodies by dt [s]; collective.

    x <- x + dt v, q <- exp(dt w) q. Prescribed motions are followed exactly, whatever dt; SceneError if one fails.
    """
    large_velocity = world.large_velocity(velocity)
    _move(world.grains, velocity[: len(world.grains)], dt)
    _move(world.large, large_velocity, dt)
    world.time += dt
    world.step += 1
    follow_motions(world)


def advanced(world: World, velocity: Floats, dt: float) -> World:
    """The world that `advance` leads to; this one stays as it is. Collective."""
    after = copy(world)
    after.grains, after.large = replace(world.grains), replace(world.large)
    advance(after, velocity, dt)
    return after


def follow_motions(world: World) -> None:
    """Put the bodies of prescribed motion where they are to be now; collective. SceneError if a motion fails."""

    def follow() -> None:
        for row, body in enumerate(world.large_bodies):
            if not isinstance(body.motion, Dynamic):
                pose = checked_pose(body.motion, world.time, body.position, body.quaternion)
                world.large.position[row], world.large.quaternion[row] = pose

    together(world.comm, "motion of a large body", follow)


def _move(table: Bodies, velocity: Floats, dt: float) -> None:
    table.velocity = velocity.copy()
    table.position = table.position + dt * velocity[:, :3]
    table.quaternion = quaternion.integrate(table.quaternion, velocity[:, 3:], dt)
