"""Motions of large bodies: free, guided along a line, fixed, rotating, oscillating or gliding.

A prescribed motion is a pose as a function of time. Over a time step the body has the *mean* velocity
(x(t+dt) - x(t)) / dt, so that the contacts see the velocity that takes it exactly to its next pose. Any object with
the methods `pose` and `angular_velocity` of `Fixed` is one.
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

    def free_directions(self) -> Floats:
        """Projector (3, 3) on the directions in which forces can move the centre of mass."""
        return np.eye(3)


@dataclass(frozen=True)
class Guided(Dynamic):
    """Moved by forces along one direction of the world only, without turning: a piston, a press.

    The guide takes all other forces and all torques: the inverse mass of the other five degrees of freedom is zero.
    """

    direction: Sequence[float]  #: (3,), normalised

    def __post_init__(self) -> None:
        object.__setattr__(self, "direction", unit_vector("direction of a guide", self.direction))

    def free_directions(self) -> Floats:
        """Projector (3, 3) on the direction of the guide."""
        return np.outer(self.direction, self.direction)


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
    """Sinusoidal translation: displacement amplitude * (sin(2 pi t / period + phase) - sin(phase)), where t is the
    time since `start`; at rest before."""

    direction: Sequence[float]  #: (3,), normalised
    amplitude: float  #: [m]
    period: float  #: [s]
    phase: float = 0.0  #: [rad]
    start: float = 0.0  #: [s]

    def __post_init__(self) -> None:
        object.__setattr__(self, "direction", unit_vector("direction of oscillation", self.direction))
        finite_vector("amplitude, phase and start", (self.amplitude, self.phase, self.start))
        positive("period of oscillation", self.period)

    def pose(self, time: float, position: Floats, orientation: Floats) -> tuple[Floats, Floats]:
        """Position (3,) and quaternion (4,) at `time` [s] of a body with the given ones at time zero."""
        angle = 2.0 * np.pi * max(time - self.start, 0.0) / self.period
        swing = np.sin(angle + self.phase) - np.sin(self.phase)
        return position + self.amplitude * swing * np.array(self.direction), orientation

    def angular_velocity(self) -> Floats:
        """World-frame angular velocity (3,) [rad/s]."""
        return np.zeros(3)


@dataclass(frozen=True)
class Glide:
    """Translation at constant velocity from one time to another; at rest before and after."""

    velocity: Sequence[float]  #: (3,) [m/s]
    start: float = 0.0  #: [s]
    end: float = np.inf  #: [s]

    def __post_init__(self) -> None:
        object.__setattr__(self, "velocity", finite_vector("velocity of a glide", self.velocity))
        if not self.start <= self.end:
            raise ValueError(f"a glide cannot end at {self.end:g} s, before its start at {self.start:g} s")

    def pose(self, time: float, position: Floats, orientation: Floats) -> tuple[Floats, Floats]:
        """Position (3,) and quaternion (4,) at `time` [s] of a body with the given ones at time zero."""
        gone = max(min(time, self.end) - self.start, 0.0)
        return position + gone * np.array(self.velocity), orientation

    def angular_velocity(self) -> Floats:
        """World-frame angular velocity (3,) [rad/s]."""
        return np.zeros(3)


#: Motions that do not answer to forces.
Prescribed = Union[Fixed, Rotation, Oscillation, Glide]
Motion = Union[Dynamic, Prescribed]


def mean_velocity(
    motion: Prescribed, time: float, dt: float, position: Floats, orientation: Floats
) -> Floats:
    """Velocity (6,) from `time` to `time + dt` of a body with the given pose at time zero."""
    start, _ = motion.pose(time, position, orientation)
    end, _ = motion.pose(time + dt, position, orientation)
    return np.concatenate([(end - start) / dt, motion.angular_velocity()])
