"""Motions of large bodies: free, guided along a line, hinged, fixed, rotating, oscillating, gliding or along a path.

A prescribed motion is a pose as a function of time. Over a time step the body has the *mean* velocity
(x(t+dt) - x(t)) / dt, and the angular velocity that turns it from the one orientation to the other in dt the shortest
way (so less than half a turn), so that the contacts see the velocity that takes it exactly to its next pose. Any
object with the method `pose` of `Fixed` is one. If it has a method `angular_velocity()` too, a vector (3,) [rad/s], the
contacts see that one instead, at all times.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path as FilePath
from typing import Any, ClassVar, Union

import numpy as np

from dem import quaternion
from dem.arrays import Floats
from dem.checks import check_fields, finite, positive, rows, unit_quaternions, unit_vector, vector


class Timed:
    """What lasts from one time to another."""

    start: float  #: [s]
    end: float  #: [s]

    def _check_times(self) -> None:
        if not (np.isfinite(self.start) and self.start <= self.end):
            raise ValueError(f"{type(self).__name__} cannot begin at {self.start:g} s and end at {self.end:g} s")

    def gone(self, time: float) -> float:
        """How much of the time between start and end has gone by [s]."""
        return max(min(time, self.end) - self.start, 0.0)


@dataclass(frozen=True)
class Dynamic:
    """Moved by forces."""

    def free_directions(self) -> Floats:
        """Projector (3, 3) on the directions in which forces can move the centre of mass."""
        return np.eye(3)


class Driven(Dynamic, Timed):
    """Moved by forces along one line of the world only, or by torques about one only, with a drive that acts on it."""

    speed: float | None
    _line: ClassVar[str]  #: the name of the field with the line
    _strength: ClassVar[str]  #: the name of the field with the force or torque of the drive

    def __post_init__(self) -> None:
        check_fields(self, **{self._line: unit_vector, self._strength: finite})
        self._check_times()
        most, kind = getattr(self, self._strength), type(self).__name__
        finite(f"{kind}.speed", self.speed or 0.0)
        if self.speed is not None and most <= 0.0:
            raise ValueError(f"{kind}.{self._strength} of a servo, with a speed, must be above zero, got {most:g}")

    @property
    def line(self) -> Floats:
        """Unit vector (3,) of the line."""
        return np.array(getattr(self, self._line))

    def mean_drive(self, time: float, dt: float, lack: float) -> Floats:
        """Mean force or torque (3,) of the drive from `time` to `time + dt` [s]; of a servo what lacks to the speed at
        the end of the step, `lack` [N or N m], as far as its strength goes."""
        most = getattr(self, self._strength) * (self.gone(time + dt) - self.gone(time)) / dt
        return (most if self.speed is None else min(max(lack, -most), most)) * self.line


@dataclass(frozen=True)
class Guided(Driven):
    """Moved by forces along one direction of the world only, without turning: a piston, a press.

    The guide takes all other forces and all torques. A drive may push along it with a constant force, beside gravity,
    from one time to another. With a `speed` the drive is a servo: it pushes, either way, with the force that would
    bring the body to that speed at the end of the step if nothing touched it, but with `force` at most. A load L makes
    the body slower by dt L / mass.
    """

    direction: Sequence[float]  #: (3,), normalised
    force: float = 0.0  #: along the direction; of a servo the greatest one [N]
    start: float = 0.0  #: [s]
    end: float = np.inf  #: [s]
    speed: float | None = None  #: along the direction, that a servo keeps [m/s]
    _line, _strength = "direction", "force"

    def free_directions(self) -> Floats:
        """Projector (3, 3) on the direction of the guide."""
        return np.outer(self.direction, self.direction)


@dataclass(frozen=True)
class Hinged(Driven):
    """Moved by torques about one axis of the world only, on which its centre of mass is: a wheel, a roller, a stirrer.

    The bearing takes all forces and all other torques. A drive may turn it with a constant torque, or as a servo with
    the torque that keeps a `speed`, and `torque` at most, as the force of `Guided`.
    """

    axis: Sequence[float]  #: (3,), normalised
    torque: float = 0.0  #: about the axis; of a servo the greatest one [N m]
    start: float = 0.0  #: [s]
    end: float = np.inf  #: [s]
    speed: float | None = None  #: about the axis, that a servo keeps [rad/s]
    _line, _strength = "axis", "torque"

    def free_directions(self) -> Floats:
        """Projector (3, 3) on nothing: the axis stays where it is."""
        return np.zeros((3, 3))


@dataclass(frozen=True)
class Fixed:
    """At rest."""

    def pose(self, time: float, position: Floats, orientation: Floats) -> tuple[Floats, Floats]:
        """Position (3,) and quaternion (4,) at `time` [s] of a body with the given ones at time zero."""
        return position, orientation


@dataclass(frozen=True)
class Rotation(Timed):
    """Constant rotation about an axis through a fixed point of the world from one time to another; at rest before and
    after."""

    velocity: Sequence[float]  #: angular velocity vector (3,) [rad/s]
    center: Sequence[float] = (0.0, 0.0, 0.0)  #: a point of the axis (3,) [m]
    start: float = 0.0  #: [s]
    end: float = np.inf  #: [s]

    def __post_init__(self) -> None:
        self._check_times()
        check_fields(self, velocity=vector, center=vector)

    def pose(self, time: float, position: Floats, orientation: Floats) -> tuple[Floats, Floats]:
        turn = quaternion.exponential(self.gone(time) * np.array(self.velocity))
        center = np.array(self.center)
        turned = quaternion.normalized(quaternion.multiply(turn, orientation))
        return center + quaternion.rotate(turn, position - center), turned


@dataclass(frozen=True)
class Oscillation(Timed):
    """Sinusoidal translation: displacement amplitude * (sin(2 pi t / period + phase) - sin(phase)), where t is the time
    since `start`. The body rests before `start`, and after `end` in its last place."""

    direction: Sequence[float]  #: (3,), normalised
    amplitude: float  #: [m]
    period: float  #: [s]
    phase: float = 0.0  #: [rad]
    start: float = 0.0  #: [s]
    end: float = np.inf  #: [s]

    def __post_init__(self) -> None:
        self._check_times()
        check_fields(self, direction=unit_vector, amplitude=finite, period=positive, phase=finite)

    def pose(self, time: float, position: Floats, orientation: Floats) -> tuple[Floats, Floats]:
        angle = 2.0 * np.pi * self.gone(time) / self.period
        swing = np.sin(angle + self.phase) - np.sin(self.phase)
        return position + self.amplitude * swing * np.array(self.direction), orientation


@dataclass(frozen=True)
class Glide(Timed):
    """Translation at constant velocity from one time to another; at rest before and after."""

    velocity: Sequence[float]  #: (3,) [m/s]
    start: float = 0.0  #: [s]
    end: float = np.inf  #: [s]

    def __post_init__(self) -> None:
        self._check_times()
        check_fields(self, velocity=vector)

    def pose(self, time: float, position: Floats, orientation: Floats) -> tuple[Floats, Floats]:
        return position + self.gone(time) * np.array(self.velocity), orientation


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
        places = rows("positions of a path", self.positions, len(times), 3)
        object.__setattr__(self, "positions", tuple(map(tuple, places.tolist())))

    @classmethod
    def read(cls, file: str | FilePath) -> Path:
        """From a text file with time [s] and x, y, z [m] in each line, between them commas or blanks; # begins a
        remark. ValueError, which names the file, for any other line."""
        found = []
        for number, line in enumerate(FilePath(file).read_text().splitlines(), 1):
            words = line.partition("#")[0].replace(",", " ").split()
            if not words:
                continue
            try:
                time, *place = map(float, words)
                found.append((time, vector("place", place)))
            except ValueError:
                raise ValueError(f"{file}, line {number}: not a time and three coordinates: {line.strip()}") from None
        try:
            return cls(*zip(*found)) if found else cls((), ())
        except ValueError as error:
            raise ValueError(f"{file}: {error}") from None

    def pose(self, time: float, position: Floats, orientation: Floats) -> tuple[Floats, Floats]:
        places = np.array(self.positions)
        place = np.array([np.interp(time, self.times, axis) for axis in places.T])
        return position + place - places[0], orientation


#: Motions that do not answer to forces.
Prescribed = Union[Fixed, Rotation, Oscillation, Glide, Path]
Motion = Union[Dynamic, Prescribed]
Pose = tuple[Floats, Floats]  #: position (3,) [m] and quaternion (4,)


def checked_pose(motion: Prescribed, time: float, position: Floats, orientation: Floats) -> Pose:
    """The pose of a motion, also of one that is not of this module, as arrays of its own, the quaternion of unit norm.
    ValueError if it is no pose."""
    place, turn = motion.pose(time, position.copy(), orientation.copy())
    what = f"of the pose of {type(motion).__name__} at {time:g} s"
    return rows(f"position {what}", place, 1, 3)[0], unit_quaternions(f"quaternion {what}", turn, 1)[0]


def mean_velocity(motion: Prescribed, time: float, dt: float, position: Floats, orientation: Floats) -> Floats:
    """Velocity (6,) from `time` to `time + dt` of a body with the given pose at time zero."""
    pose = position, orientation
    return velocity_between(motion, checked_pose(motion, time, *pose), checked_pose(motion, time + dt, *pose), dt)


def velocity_between(motion: Prescribed, start: Pose, end: Pose, dt: float) -> Floats:
    """Velocity (6,) that takes a body from one of its poses to another in dt [s]."""
    given = getattr(motion, "angular_velocity", None)
    if given is not None:
        turning = given()
    else:
        turning = quaternion.rotation_vector(start[1], end[1]) / dt if (start[1] != end[1]).any() else np.zeros(3)
    turning = vector(f"angular velocity of {type(motion).__name__}", turning)
    return np.concatenate([(end[0] - start[0]) / dt, turning])


def top_speed(motion: Motion, position: Floats, reach: float) -> float:
    """The greatest speed [m/s] that a motion or its servo gives to points within the `reach` [m] of the centre of a
    body which is at `position` (3,) at time zero; 0 of motions that are not of this module."""
    if isinstance(motion, Rotation):
        of_center = np.linalg.norm(np.cross(motion.velocity, position - np.array(motion.center)))
        return float(of_center + np.linalg.norm(motion.velocity) * reach)
    if isinstance(motion, Oscillation):
        return abs(2.0 * np.pi * motion.amplitude / motion.period)
    if isinstance(motion, Glide):
        return float(np.linalg.norm(motion.velocity))
    if isinstance(motion, Path):
        ways = np.linalg.norm(np.diff(np.array(motion.positions), axis=0), axis=1)
        return float((ways / np.diff(motion.times)).max(initial=0.0))
    speed = abs(getattr(motion, "speed", None) or 0.0)
    return speed * reach if isinstance(motion, Hinged) else speed


def changed(motion: Motion, time: float, **values: Any) -> Motion:
    """The motion with other parameters from `time` [s] on. An oscillation of another period stays in its phase, unless
    a phase is given. ValueError for a parameter that the motion does not have, or a bad value."""
    if not dataclasses.is_dataclass(motion):
        raise ValueError(f"{type(motion).__name__} is no dataclass, so its parameters cannot be changed within a run")
    names = [field.name for field in dataclasses.fields(motion)]
    for name in values:
        if name not in names:
            raise ValueError(f"{type(motion).__name__} has no {name}; it has {', '.join(names) or 'no parameters'}")
    after = dataclasses.replace(motion, **values)
    if isinstance(motion, Oscillation) and isinstance(after, Oscillation) and "phase" not in values:
        turns = motion.gone(time) / motion.period - after.gone(time) / after.period
        after = dataclasses.replace(after, phase=motion.phase + 2.0 * np.pi * turns)
    return after
