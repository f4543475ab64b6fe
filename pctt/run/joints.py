"""A joint of a simulation, as it is now: what `Simulation.joint` returns."""

from __future__ import annotations

from typing import Any

import numpy as np

from dem.arrays import Floats
from dem.parts.ends import Geometry
from dem.parts.joints import KINDS, Joint
from dem.together import barrier
from dem.unconstrained.constraints import constraints_now, number_of


class JointNow:
    """A joint of a simulation. Its members are collective; vectors are in the world frame."""

    __slots__ = ("_number", "_sim", "name")

    def __init__(self, sim: Any, name: str):
        there = sim.world.named["joint"]
        if name not in there:
            raise ValueError(f"no joint {name!r}; there are: {', '.join(there) or 'none'}")
        self._sim, self.name, self._number = sim, name, number_of(sim.world, "joint", name)

    def __repr__(self) -> str:
        joint = self._sim.world.named["joint"][self.name]
        one, other = ("the world" if end is None else repr(end) for end in joint.ends)
        return f"<Joint {self.name!r}: {joint.kind} of {one} and {other}>"

    @property
    def _now(self) -> tuple[Joint, Geometry, Floats]:
        """The joint, the geometry of all, and the velocities (6,) of its second end relative to the first."""
        barrier(self._sim.comm, f"joint {self.name}")
        found, velocity = constraints_now(self._sim.world)
        relative = np.einsum("wsx,sx->w", found.rows[self._number], velocity[self._number])
        return self.motor, found, relative

    @property
    def force(self) -> Floats:
        """Force (3,) on the second end at the anchor, with that of a motor, its mean over the last step [N]."""
        return self._mean(slice(0, 3))

    @property
    def torque(self) -> Floats:
        """Torque (3,) on the second end about the anchor, with that of a motor, its mean over the last step [N m]."""
        return self._mean(slice(3, 6))

    @property
    def drive(self) -> float:
        """Torque [N m] or force [N] of the motor and the limits along the axis, its mean over the last step."""
        joint = self.motor
        return float(self._impulses[joint.coordinate] / self._sim.settings.dt) if KINDS[joint.kind].motor else 0.0

    @property
    def angle(self) -> float:
        """Angle of a hinge, between -pi and pi [rad]."""
        return float(self._free("hinge")[0])

    @property
    def angles(self) -> Floats:
        """Angles (2,) of a universal joint about the axes of the first and of the second body [rad]."""
        return self._free("universal")[::-1]

    @property
    def position(self) -> float:
        """Way of a slider [m]."""
        return float(self._free("slider")[0])

    @property
    def speed(self) -> float:
        """Of a hinge [rad/s] or a slider [m/s] in the last step."""
        joint, _, velocity = self._now
        return float(velocity[joint.coordinate])

    @property
    def motor(self) -> Joint:
        """The ``speed``, ``target``, ``strength``, ``low`` and ``high`` of the motor and the limits, to read; not
        collective."""
        joint: Joint = self._sim.world.named["joint"][self.name]
        return joint

    def _free(self, kind: str) -> Floats:
        """The free coordinates of a joint of this kind."""
        joint, found, _ = self._now
        if joint.kind != kind:
            raise ValueError(f"joint {self.name!r} is a {joint.kind}, and no {kind}")
        free: Floats = found.error[self._number, np.logical_not(KINDS[kind].holds)]
        return free

    @property
    def _impulses(self) -> Floats:
        """Impulses (6,) of the last step, along and about the axes of the joint as it was at its start."""
        step = self._sim._last
        found, out = step.system.coupling, np.zeros(6)
        rows = np.flatnonzero(found.part == self._number)
        np.add.at(out, found.way[rows], step.constraint_impulses[rows])
        return out

    def _mean(self, part: slice) -> Floats:
        axes: Floats = self._sim._last.system.coupling.axes[self._number]
        return self._impulses[part] @ axes / self._sim.settings.dt
