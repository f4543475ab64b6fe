"""The semi-implicit step: new velocities come from the contact problem, and positions follow them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from dem import quaternion
from dem.arrays import ArrayLike, Floats
from dem.bodies import Bodies
from dem.measures import Sample
from dem.model.world import World
from dem.step.laws import along_normal
from dem.together import barrier
from dem.unconstrained import UnconstrainedMotion, large_velocity

if TYPE_CHECKING:
    from dem.contact import Contacts
    from dem.step.system import ContactSystem


@dataclass(frozen=True, repr=False)
class Step:
    """A step that was just made, with its forces, places and sums: the argument of a scene's `record`.

    `advance` was called, the grains are not yet balanced anew.
    """

    world: World  #: at the end of the step
    contacts: Contacts
    system: ContactSystem
    impulse: Floats  #: (nc, 3) of the local contacts: normal, t1, t2; with their attraction [N s]
    moment: Floats | None = None  #: (nc, 3) about normal, t1, t2, over `Resistance.length`; None without [N s]

    def __repr__(self) -> str:
        return f"<Step to {self.world.time:g} s: {len(self.impulse)} contacts of this rank>"

    def force_on(self, name: str) -> Floats:
        """Contact force and torque (6,) [N, N m] on a large body, about its reference point, averaged over the step."""
        return self.impulse_on_large[self.world.large_row(name)] / self.system.dt

    def spring_force(self, name: str) -> Floats:
        """Force (3,) of a spring on its second end, averaged over the step [N]; the first has the opposite one.
        ValueError if there is none of that name."""
        names = list(self.world.named["spring"])
        if name not in names:
            raise ValueError(f"no spring {name!r}; there are: {', '.join(names) or 'none'}")
        force: Floats = self.world.memory["spring"][names.index(name), :3] / self.system.dt
        return force

    @cached_property
    def constraint_impulses(self) -> Floats:
        """`ContactSystem.constraint_impulses` of this step; collective at its first use."""
        return self.system.constraint_impulses(self.impulse, self.moment)

    def position(self, name: str) -> Floats:
        """Position (3,) of a large body [m]."""
        return self.world.large.position[self.world.large_row(name)].copy()

    def velocity(self, name: str) -> Floats:
        """Linear and angular velocity (6,) of a large body [m/s, rad/s]."""
        return self.world.large.velocity[self.world.large_row(name)].copy()

    def total(self, values: ArrayLike) -> float:
        """The sum of values (grains,) over all grains; each rank passes those of its `world.grains`. Collective: the
        `record` of a scene must call it on all ranks."""
        return barrier(self.world.comm, "Step.total", number=float(np.sum(values)))

    @property
    def in_cone(self) -> Floats:
        """The impulses (nc, 3) without the attraction of contacts, which are in the friction cones [N s]."""
        attraction = self.system.attraction
        return self.impulse if attraction is None else self.impulse + along_normal(attraction)

    @cached_property
    def force(self) -> Floats:
        """Forces (nc, 3) on the second bodies in the world, averaged over the step [N]."""
        force: Floats = np.einsum("ci,cij->cj", self.impulse, self.system.frame) / self.system.dt
        return force

    @property
    def moments(self) -> Floats | None:
        """Moments (nc, 3) on the second bodies, beside those of the forces, in the world, of contacts that resist
        rolling or spinning, averaged over the step [N m]."""
        if self.moment is None or self.system.resistance is None:
            return None
        size = self.moment * self.system.resistance.length[:, None] / self.system.dt
        return np.einsum("ci,cij->cj", size, self.system.frame)

    @cached_property
    def point(self) -> Floats:
        """The points (nc, 3) of the contacts at the start of the step, in the cell that there was [m]."""
        return self.world.cell.before(self.system.dt).wrapped(self.contacts.point)

    @cached_property
    def sample(self) -> Sample:
        """This rank's grains and contacts for the functions of `dem.measures`; not collective."""
        contacts, grains, near = self.contacts, self.world.cell.inside(self.world.grains), self.contacts.near.bodies
        pair = np.stack([contacts.a, contacts.b], axis=1)
        center = near.position[pair]
        if contacts.moved is not None:
            center[:, 1] += contacts.moved
            center += (self.point - contacts.point)[:, None]
        vectors, drift = self.world.cell.lattice
        number, first, count = near.id[pair], self.world.first_large, self.world.ids
        names = ("id", "position", "velocity", "mass", "shape", "size", "material")
        return Sample(
            comm=self.world.comm,
            count=count,
            **{name: getattr(grains, name) for name in names},
            materials=self.world.materials,
            bodies=np.where(number < first, number, number - first + count),
            center=center,
            point=self.point,
            normal=contacts.normal,
            gap=contacts.gap,
            force=self.force,
            moment=self.moments,
            lattice=vectors,
            drift=drift,
        )

    @cached_property
    def impulse_on_large(self) -> Floats:
        """Impulses and angular impulses (large, 6) of the contacts on the large bodies; the same on all ranks."""
        return self.system.impulse_on_large(self.impulse, self.moment)


def advance(
    world: World, free: UnconstrainedMotion, contacts: Contacts, velocity: Floats, kept: Floats | None = None
) -> None:
    """Take the velocities (owned, 6) of `ContactSystem` and move all bodies by the step of the motion `free` with these
    contacts; `kept` (owned, 6) are those with which they go into the next step, if they are others. Collective.

    x <- x + dt (v + E x) + lag, q <- exp(dt w) q, with the rate E of a cell that changes its size, and the lag
    (grains, 3) of `Contacts` [m]; grains outside of a sheared cell go with the images there. The next search begins
    with the lists of this one, and the balancer goes by the contacts that grains own.
    Prescribed motions are followed exactly, whatever dt.
    """
    dt, start, of_large = free.dt, world.grains.position, large_velocity(world, free, velocity)
    large_kept = None if kept is None else large_velocity(world, free, kept)
    _move(world.grains, velocity[: len(world.grains)], dt)
    _move(world.large, of_large, dt)
    if kept is not None and large_kept is not None:
        world.grains.velocity, world.large.velocity = kept[: len(world.grains)].copy(), large_kept
    if contacts.lag is not None:
        world.grains.position = world.grains.position + contacts.lag
    world.lists, world.grains.weight = contacts.lists, contacts.owned
    if world.cell.deforms:
        world.grains.position = world.grains.position + dt * world.cell.rate * start
    if free.applied is not None:
        world.memory = free.applied.memory
    then, world.cell = world.cell, world.cell.after(dt)
    world.grains.velocity = world.cell.taken_along(then, start, world.grains.velocity)
    world.time += dt
    world.step += 1
    world.put_large(free.poses)


def advanced(world: World, free: UnconstrainedMotion, contacts: Contacts, velocity: Floats) -> World:
    """Return the world that `advance` leads to; this one stays as it is. Collective."""
    after = world.trial()
    advance(after, free, contacts, velocity)
    return after


def _move(table: Bodies, velocity: Floats, dt: float) -> None:
    table.velocity = velocity.copy()
    table.position = table.position + dt * velocity[:, :3]
    table.quaternion = quaternion.integrate(table.quaternion, velocity, dt)
