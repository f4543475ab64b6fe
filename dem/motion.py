"""Motions of large bodies: free, fixed, rotating or oscillating.

A prescribed motion is a pose as a function of time. Over a time step the body has the *mean* velocity
(x(t+dt) - x(t)) / dt, so that the contacts see the velocity that takes it exactly to its next pose.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Union

import numpy as np

from dem import quaternion
from dem.arrays import Floats
from dem.checks import finite_vector, positive, unit_vector


@dataclass(frozen=True)
class Dynamic:
    """Moved by forces."""


@dataclass(frozen=True)
class Fixed:
    """At rest."""

    def pose(self, time: float, position: Floats, orientation: Floats) -> tuple[Floats, Floats]:
        """Position (3,) and quaternion (4,) at `time` [s] of a body with the given ones at time zero."""
        return position, orientation

    def angular_velocity(self) -> Floats:
        """World-frame angular velocity (3,) [rad/s]."""
        return np.zeros(3)


@dataclass(frozen=True)
class Rotation:
    """Constant rotation about an axis through a fixed point of the world."""

    velocity: Sequence[float]  #: angular velocity vector (3,) [rad/s]
    center: Sequence[float] = (0.0, 0.0, 0.0)  #: a point of the axis (3,) [m]

    def __post_init__(self) -> None:
        object.__setattr__(self, "velocity", finite_vector("angular velocity", self.velocity))
        object.__setattr__(self, "center", finite_vector("centre of rotation", self.center))

    def pose(self, time: float, position: Floats, orientation: Floats) -> tuple[Floats, Floats]:
        """Position (3,) and quaternion (4,) at `time` [s] of a body with the given ones at time zero."""
        turn = quaternion.exponential(time * self.angular_velocity())
        center = np.array(self.center)
        turned = quaternion.normalized(quaternion.multiply(turn, orientation))
        return center + quaternion.rotate(turn, position - center), turned

    def angular_velocity(self) -> Floats:
        """World-frame angular velocity (3,) [rad/s]."""
        return np.array(self.velocity)


@dataclass(frozen=True)
class Oscillation:
    """Sinusoidal translation: displacement amplitude * (sin(2 pi t / period + phase) - sin(phase))."""

    direction: Sequence[float]  #: (3,), normalised
    amplitude: float  #: [m]
    period: float  #: [s]
    phase: float = 0.0  #: [rad]

    def __post_init__(self) -> None:
        object.__setattr__(self, "direction", unit_vector("direction of oscillation", self.direction))
        finite_vector("amplitude and phase", (self.amplitude, self.phase, 0.0))
        positive("period of oscillation", self.period)

    def pose(self, time: float, position: Floats, orientation: Floats) -> tuple[Floats, Floats]:
        """Position (3,) and quaternion (4,) at `time` [s] of a body with the given ones at time zero."""
        swing = np.sin(2.0 * np.pi * time / self.period + self.phase) - np.sin(self.phase)
        return position + self.amplitude * swing * np.array(self.direction), orientation

    def angular_velocity(self) -> Floats:
        """World-frame angular velocity (3,) [rad/s]."""
        return np.zeros(3)


#: Motions that do not answer to forces.
Prescribed = Union[Fixed, Rotation, Oscillation]
Motion = Union[Dynamic, Prescribed]


def mean_velocity(
    motion: Prescribed, time: float, dt: float, position: Floats, orientation: Floats
) -> Floats:
    """Velocity (6,) from `time` to `time + dt` of a body with the given pose at time zero."""
    start, _ = motion.pose(time, position, orientation)
    end, _ = motion.pose(time + dt, position, orientation)
    return np.concatenate([(end - start) / dt, motion.angular_velocity()])
