"""A step that was made, with its forces, places and sums: the argument of a scene's `record`."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from dem.arrays import ArrayLike, Floats
from dem.contact import Contacts
from dem.system import ContactSystem
from dem.together import meet
from dem.world import World


@dataclass(frozen=True)
class Step:
    """A step that was just made: `advance` was called, the grains are not yet balanced anew."""

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
