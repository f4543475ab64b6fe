"""Motions of large bodies: free, guided along a line, hinged, fixed, rotating, oscillating, gliding or along a path.

A prescribed motion is a pose as a function of time. Over a time step the body has the *mean* velocity
(x(t+dt) - x(t)) / dt, and the angular velocity that turns it from the one orientation to the other in dt the shortest
way (so less than half a turn), so that the contacts see the velocity that takes it exactly to its next pose. Any
object with the method `pose` of `Fixed` is one. If it has a method `angular_velocity()` too, a vector (3,) [rad/s], the
contacts see that one instead, at all times.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path as FilePath
from typing import Union

import numpy as np

from dem import quaternion
from dem.arrays import Floats
from dem.checks import finite, finite_vector, positive, rows, unit_quaternions, unit_vector


@dataclass(frozen=True)
class Dynamic:
    """Moved by forces."""

    def free_directions(self) -> Floats:
        """Projector (3, 3) on the directions in which forces can move the centre of mass."""
        return np.eye(3)


@dataclass(frozen=True)
class Guided(Dynamic):
    """Moved by forces along one direction of the world only, without turning: a piston, a press.

    The guide takes all other forces and all torques: the inverse mass of the other five degrees of freedom is zero. A
    drive may push along it with a constant force, beside gravity, from one time to another: at rest the contacts then
    bear that force, and the weight as far as it is along the guide. With a `speed` the drive is a servo: it pushes,
    either way, with the force that would bring the body to that speed at the end of the step if nothing touched it, but
    with `force` at most. A load L makes the body slower by dt L / mass.
    """

    direction: Sequence[float]  #: (3,), normalised
    force: float = 0.0  #: along the direction; of a servo the greatest one [N]
    start: float = 0.0  #: [s]
    end: float = np.inf  #: [s]
    speed: float | None = None  #: along the direction, that a servo keeps [m/s]

    def __post_init__(self) -> None:
        object.__setattr__(self, "direction", unit_vector("direction of a guide", self.direction))
        _check_drive("guide", "force", self.force, self.start, self.end, self.speed)

    def free_directions(self) -> Floats:
        """Projector (3, 3) on the direction of the guide."""
        return np.outer(self.direction, self.direction)

    def mean_force(self, time: float, dt: float, lack: float = 0.0) -> Floats:
        """Mean force of the drive (3,) from `time` to `time + dt` [s]. `lack` [N] is the force that takes the body to
        the speed of the servo at the end of the step."""
        return _driven(self, self.force, time, dt, lack) * np.array(self.direction)


@dataclass(frozen=True)
class Hinged(Dynamic):
    """Moved by torques about one axis of the world only, on which its centre of mass is: a wheel, a roller, a stirrer.

    The bearing takes all forces and all other torques. A drive may turn it with a constant torque, or as a servo with
    the torque that keeps a `speed`, and `torque` at most, as the force of `Guided`.
    """

    axis: Sequence[float]  #: (3,), normalised
    torque: float = 0.0  #: about the axis; of a servo the greatest one [N m]
    start: float = 0.0  #: [s]
    end: float = np.inf  #: [s]
    speed: float | None = None  #: about the axis, that a servo keeps [rad/s]

    def __post_init__(self) -> None:
        object.__setattr__(self, "axis", unit_vector("axis of a hinge", self.axis))
        _check_drive("hinge", "torque", self.torque, self.start, self.end, self.speed)

    def free_directions(self) -> Floats:
        """Projector (3, 3) on nothing: the axis stays where it is."""
        return np.zeros((3, 3))

    def mean_torque(self, time: float, dt: float, lack: float = 0.0) -> Floats:
        """Mean torque of the drive (3,) from `time` to `time + dt` [s]; `lack` [N m] as of `Guided.mean_force`."""
        return _driven(self, self.torque, time, dt, lack) * np.array(self.axis)


@dataclass(frozen=True)
class Fixed:
    """At rest."""

    def pose(self, time: float, position: Floats, orientation: Floats) -> tuple[Floats, Floats]:
        """Position (3,) and quaternion (4,) at `time` [s] of a body with the given ones at time zero."""
        return position, orientation


@dataclass(frozen=True)
class Rotation:
    """Constant rotation about an axis through a fixed point of the world from one time to another; at rest before and
    after."""

    velocity: Sequence[float]  #: angular velocity vector (3,) [rad/s]
    center: Sequence[float] = (0.0, 0.0, 0.0)  #: a point of the axis (3,) [m]
    start: float = 0.0  #: [s]
    end: float = np.inf  #: [s]

    def __post_init__(self) -> None:
        _ordered("rotation", self.start, self.end)
        object.__setattr__(self, "velocity", finite_vector("angular velocity", self.velocity))
        object.__setattr__(self, "center", finite_vector("centre of rotation", self.center))

    def pose(self, time: float, position: Floats, orientation: Floats) -> tuple[Floats, Floats]:
        """As of `Fixed`."""
        turn = quaternion.exponential(time_gone(time, self.start, self.end) * np.array(self.velocity))
        center = np.array(self.center)
        turned = quaternion.normalized(quaternion.multiply(turn, orientation))
        return center + quaternion.rotate(turn, position - center), turned


@dataclass(frozen=True)
class Oscillation:
    """Sinusoidal translation: displacement amplitude * (sin(2 pi t / period + phase) - sin(phase)), where t is the time
    since `start`. The body rests before `start`, and after `end` in its last place."""

    direction: Sequence[float]  #: (3,), normalised
    amplitude: float  #: [m]
    period: float  #: [s]
    phase: float = 0.0  #: [rad]
    start: float = 0.0  #: [s]
    end: float = np.inf  #: [s]

    def __post_init__(self) -> None:
        object.__setattr__(self, "direction", unit_vector("direction of oscillation", self.direction))
        _ordered("oscillation", self.start, self.end)
        finite_vector("amplitude, phase and start", (self.amplitude, self.phase, self.start))
        positive("period of oscillation", self.period)

    def pose(self, time: float, position: Floats, orientation: Floats) -> tuple[Floats, Floats]:
        """As of `Fixed`."""
        angle = 2.0 * np.pi * time_gone(time, self.start, self.end) / self.period
        swing = np.sin(angle + self.phase) - np.sin(self.phase)
        return position + self.amplitude * swing * np.array(self.direction), orientation


@dataclass(frozen=True)
class Glide:
    """Translation at constant velocity from one time to another; at rest before and after."""

    velocity: Sequence[float]  #: (3,) [m/s]
    start: float = 0.0  #: [s]
    end: float = np.inf  #: [s]

    def __post_init__(self) -> None:
        object.__setattr__(self, "velocity", finite_vector("velocity of a glide", self.velocity))
        _ordered("glide", self.start, self.end)

    def pose(self, time: float, position: Floats, orientation: Floats) -> tuple[Floats, Floats]:
        """As of `Fixed`."""
        return position + time_gone(time, self.start, self.end) * np.array(self.velocity), orientation


@dataclass(frozen=True)
class Path:
    """Translation through places that are given at some times, straight and at constant velocity between them; at rest
    before the first and after the last. The first place is where the body is at time zero, whatever its numbers."""

    times: Sequence[float]  #: (n,), ascending [s]
    positions: Sequence[Sequence[float]]  #: (n, 3) [m]

    def __post_init__(self) -> None:
        times = tuple(float(time) for time in self.times)
        if not times or not np.isfinite(times).all() or times[0] < 0.0 or (np.diff(times) <= 0.0).any():
            listed = ", ".join(f"{time:g}" for time in times) or "none"
            raise ValueError(f"times of a path must ascend from zero or later, got {listed}")
        if len(self.positions) != len(times):
            raise ValueError(f"a path has {len(times)} times but {len(self.positions)} positions")
        object.__setattr__(self, "times", times)
        places = tuple(finite_vector("position of a path", place) for place in self.positions)
        object.__setattr__(self, "positions", places)

    @classmethod
    def read(cls, file: str | FilePath) -> Path:
        """From a text file with time [s] and x, y, z [m] in each line, between them commas or blanks; # begins a
        remark. ValueError, with file and line, for any other line."""
        rows: list[tuple[float, ...]] = []
        for number, line in enumerate(FilePath(file).read_text().splitlines(), 1):
            words = line.partition("#")[0].replace(",", " ").split()
            try:
                row = tuple(map(float, words))
            except ValueError:
                row = ()
            if words and (len(row) != 4 or not np.isfinite(row).all()):
                raise ValueError(f"{file}, line {number}: not a time and three coordinates: {line.strip()}")
            if words and rows and row[0] <= rows[-1][0]:
                raise ValueError(f"{file}, line {number}: time {row[0]:g} s does not come after {rows[-1][0]:g} s")
            rows += [row] if words else []
        if not rows:
            raise ValueError(f"{file}: no line with a time and three coordinates")
        return cls([row[0] for row in rows], [row[1:] for row in rows])

    def pose(self, time: float, position: Floats, orientation: Floats) -> tuple[Floats, Floats]:
        """As of `Fixed`."""
        places = np.array(self.positions)
        place = np.array([np.interp(time, self.times, axis) for axis in places.T])
        return position + place - places[0], orientation


#: Motions that do not answer to forces.
Prescribed = Union[Fixed, Rotation, Oscillation, Glide, Path]
Motion = Union[Dynamic, Prescribed]


def checked_pose(motion: Prescribed, time: float, position: Floats, orientation: Floats) -> tuple[Floats, Floats]:
    """The pose of a motion, also of one that is not of this module, as arrays of its own, the quaternion of unit norm.
    ValueError if it is no pose."""
    place, turn = motion.pose(time, position.copy(), orientation.copy())
    what = f"of the pose of {type(motion).__name__} at {time:g} s"
    return rows(f"position {what}", place, 1, 3)[0], unit_quaternions(f"quaternion {what}", turn, 1)[0]


def mean_velocity(
    motion: Prescribed, time: float, dt: float, position: Floats, orientation: Floats
) -> Floats:
    """Velocity (6,) from `time` to `time + dt` of a body with the given pose at time zero."""
    start, before = checked_pose(motion, time, position, orientation)
    end, after = checked_pose(motion, time + dt, position, orientation)
    given = getattr(motion, "angular_velocity", None)
    turning = quaternion.rotation_vector(before, after) / dt if given is None else given()
    turning = rows(f"angular velocity of {type(motion).__name__}", turning, 1, 3)[0]
    return np.concatenate([(end - start) / dt, turning])


def time_gone(time: float, start: float, end: float) -> float:
    """How much of the time between start and end has gone by [s]."""
    return max(min(time, end) - start, 0.0)


def _driven(body: Guided | Hinged, strength: float, time: float, dt: float, lack: float) -> float:
    """The mean force or torque of a drive of this strength from `time` to `time + dt` [s]; of a servo what lacks."""
    share = (time_gone(time + dt, body.start, body.end) - time_gone(time, body.start, body.end)) / dt
    most = strength * share
    return most if body.speed is None else min(max(lack, -most), most)


def _ordered(what: str, start: float, end: float) -> None:
    if not (np.isfinite(start) and start <= end):
        raise ValueError(f"the {what} cannot begin at {start:g} s and end at {end:g} s")


def _check_drive(what: str, strength: str, most: float, start: float, end: float, speed: float | None) -> None:
    finite(f"{strength} of a {what}", most)
    _ordered(f"{strength} of a {what}", start, end)
    finite(f"speed of a {what}", speed or 0.0)
    if speed is not None and most <= 0.0:
        raise ValueError(f"a {what} with a speed needs the greatest {strength} of its servo, above zero, got {most:g}")
