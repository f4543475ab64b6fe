"""Motions of large bodies: free, guided along a line, hinged, held in part, fixed, rotating, oscillating, gliding or
along a path.

A prescribed motion is a pose as a function of time. Over a time step the body has the *mean* velocity
(x(t+dt) - x(t)) / dt, and the angular velocity that turns it from the one orientation to the other in dt the shortest
way (so less than half a turn), so that the contacts see the velocity that takes it exactly to its next pose. Any
object with the method `pose` of `Fixed` is one.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path as FilePath
from typing import Any, ClassVar, Union, get_args

import numpy as np

from dem import checks, quaternion
from dem.arrays import Floats
from dem.checks import check_fields, finite, number, numbers, positive, rows, unit_quaternion, unit_vector, vector

DROOP = 1e-3  #: of its speed that a servo loses at most under a load that it can bear


class Timed:
    """What lasts from one time to another."""

    start: float  #: [s]
    end: float  #: [s]

    def _check_times(self) -> None:
        kind = type(self).__name__
        start, end = number(f"start of {kind}", self.start), number(f"end of {kind}", self.end)
        if not (np.isfinite(start) and start <= end):
            raise ValueError(f"{kind} cannot begin at {start:g} s and end at {end:g} s")

    def elapsed(self, time: float) -> float:
        """How much of the time between start and end has gone by [s]."""
        return max(min(time, self.end) - self.start, 0.0)


@dataclass(frozen=True)
class Dynamic:
    """Moved by forces."""

    def free_directions(self) -> Floats:
        """Projector (3, 3) on the directions in which forces can move the centre of mass."""
        return np.eye(3)

    def free_turns(self) -> Floats:
        """Projector (3, 3) on the axes about which torques can turn the body."""
        return np.eye(3)

    def held(self, time: float, dt: float) -> Floats:
        """The mean velocity (6,) from `time` to `time + dt` [s] of what neither forces nor torques can change."""
        return np.zeros(6)

    def top_velocity(self) -> Floats:
        """The greatest velocity (6,) that a drive or what holds the body asks for."""
        return np.zeros(6)


class Driven(Dynamic, Timed):
    """Moved by forces along one line of the world only, or by torques about one only, with a drive that acts on it.

    A servo is implicit in the step: with f the force of `mean_drive`, which brings the body to its speed if nothing
    touches it, and v_free what that gives, it acts with f + c (v_free - v) at the end of the step. c is such that all
    its strength is used where the body is as far from its speed as it was before the step, or by DROOP of the speed.
    Where a load proves to be more than it can bear, the step is solved anew with all its strength and no more.
    """

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

    def top_velocity(self) -> Floats:
        """As of `Dynamic`."""
        along: Floats = (self.speed or 0.0) * np.concatenate([self.free_directions(), self.free_turns()]) @ self.line
        return along

    def strength(self, time: float, dt: float) -> float:
        """The greatest mean force or torque from `time` to `time + dt` [s]."""
        return float(getattr(self, self._strength) * (self.elapsed(time + dt) - self.elapsed(time)) / dt)

    def mean_drive(self, time: float, dt: float, lack: float) -> Floats:
        """Mean force or torque (3,) of the drive from `time` to `time + dt` [s]; of a servo what lacks to the speed at
        the end of the step, `lack` [N or N m], as far as its strength goes."""
        most = self.strength(time, dt)
        return (most if self.speed is None else min(max(lack, -most), most)) * self.line

    def servo_inertia(self, time: float, dt: float, mass: float, speed: float, lack: float) -> float:
        """c dt of a servo [kg or kg m^2], for the mass or moment, and the `speed` before the step; else 0."""
        if self.speed is None:
            return 0.0
        most, slip = self.strength(time, dt), self.speed - speed
        given = min(max(lack, -most), most)
        room = most - np.copysign(given, given * slip)  # beyond what it gives without contacts, towards its speed
        slip = abs(slip) + abs(lack - given) * dt / mass  # of what that leads to
        return dt * room / max(slip, DROOP * abs(self.speed), 1e-6 * dt * most / mass) if most > 0.0 else 0.0


@dataclass(frozen=True)
class Guided(Driven):
    """Moved by forces along one direction of the world only, without turning: a piston, a press.

    The guide takes all other forces and all torques. A drive may push along it with a constant force, beside gravity,
    from one time to another. With a `speed` the drive is a servo: it pushes, either way, with the force that keeps
    the body at that speed, to a thousandth, but with `force` at most. Against a larger load it gives way.
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

    def free_turns(self) -> Floats:
        """Projector (3, 3) on nothing."""
        return np.zeros((3, 3))


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

    def free_turns(self) -> Floats:
        """Projector (3, 3) on the axis."""
        return np.outer(self.axis, self.axis)


@dataclass(frozen=True)
class Held(Dynamic, Timed):
    """Some components of the velocity of the centre of mass and of the angular velocity are held, in the axes of the
    world, and forces move the body in the others: a wheel that turns at a given speed and is free to rise and sink.

    None stands for a free component, a number for one that is held: at this value from `start` to `end`, and at zero
    before and after. Of the turns all, none or one may be free; of one the others are held at zero. What holds the body
    bears all other forces and torques.
    """

    velocity: Sequence[float | None] = (None, None, None)  #: (3,) [m/s]
    angular_velocity: Sequence[float | None] = (None, None, None)  #: (3,) [rad/s]
    start: float = 0.0  #: [s]
    end: float = np.inf  #: [s]

    def __post_init__(self) -> None:
        self._check_times()
        for name in ("velocity", "angular_velocity"):
            given = tuple(getattr(self, name))
            found = vector(f"Held.{name}", [0.0 if value is None else value for value in given])
            values = tuple(None if value is None else float(x) for value, x in zip(given, found))
            object.__setattr__(self, name, values)
        held = [value for value in self.angular_velocity if value is not None]
        if len(held) == 1 or (len(held) == 2 and any(held)):
            raise ValueError(
                f"Held.angular_velocity {self.angular_velocity}: allowed are three numbers, three times None, or None "
                "for one axis and zero for the others"
            )

    def free_directions(self) -> Floats:
        """Projector (3, 3) on the axes along which the velocity is free."""
        return np.diag([float(value is None) for value in self.velocity])

    def free_turns(self) -> Floats:
        """Projector (3, 3) on the axes about which the angular velocity is free."""
        return np.diag([float(value is None) for value in self.angular_velocity])

    def top_velocity(self) -> Floats:
        """As of `Dynamic`."""
        return np.array([value or 0.0 for value in (*self.velocity, *self.angular_velocity)])

    def held(self, time: float, dt: float) -> Floats:
        """The velocity (6,) that is held, its mean from `time` to `time + dt` [s]; zero where it is free."""
        return (self.elapsed(time + dt) - self.elapsed(time)) / dt * self.top_velocity()


@dataclass(frozen=True)
class Fixed:
    """At rest."""

    def pose(self, time: float, position: Floats, orientation: Floats) -> tuple[Floats, Floats]:
        """Position (3,) and quaternion (4,) at `time` [s] of a body with the given ones at time zero."""
        return position, orientation

    def top_velocity(self) -> Floats:
        """The greatest velocity (6,) of the body; turns are about `center` if the motion has one."""
        return np.zeros(6)


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
        """As of `Fixed`."""
        turn = quaternion.exponential(self.elapsed(time) * np.array(self.velocity))
        center = np.array(self.center)
        turned = quaternion.normalized(quaternion.multiply(turn, orientation))
        return center + quaternion.rotate(turn, position - center), turned

    def top_velocity(self) -> Floats:
        """As of `Fixed`."""
        return np.array([0.0, 0.0, 0.0, *self.velocity])


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
        """As of `Fixed`."""
        angle = 2.0 * np.pi * self.elapsed(time) / self.period
        swing = np.sin(angle + self.phase) - np.sin(self.phase)
        return position + self.amplitude * swing * np.array(self.direction), orientation

    @property
    def angular_frequency(self) -> float:
        """[rad/s]; 0 without an amplitude."""
        return 2.0 * np.pi / self.period if self.amplitude else 0.0

    def top_velocity(self) -> Floats:
        """As of `Fixed`."""
        return np.array([*(self.amplitude * self.angular_frequency * np.array(self.direction)), 0.0, 0.0, 0.0])


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
        """As of `Fixed`."""
        return position + self.elapsed(time) * np.array(self.velocity), orientation

    def top_velocity(self) -> Floats:
        """As of `Fixed`."""
        return np.array([*self.velocity, 0.0, 0.0, 0.0])


@dataclass(frozen=True)
class Path:
    """Translation through places that are given at some times, straight and at constant velocity between them; at rest
    before the first and after the last. The first place is where the body is at time zero, whatever its numbers."""

    times: Sequence[float]  #: (n,), ascending [s]
    positions: Sequence[Sequence[float]]  #: (n, 3) [m]

    def __post_init__(self) -> None:
        times = tuple(numbers("times of a path", self.times).ravel().tolist())
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
        remark. ValueError, which names the file, if it cannot be read, and for any other line."""
        try:
            text = FilePath(file).read_text("utf-8-sig", "replace")
        except OSError as error:
            raise ValueError(f"{file}: cannot be read ({error.strerror or error})") from None
        found = []
        for row, line in enumerate(text.splitlines(), 1):
            words = line.partition("#")[0].replace(",", " ").split()
            if not words:
                continue
            try:
                time, *place = map(float, words)
                found.append((time, vector("place", place)))
            except ValueError:
                allowed = "not a time and three coordinates, as 0.5, 0, 0, 1.2; names begin with #"
                raise ValueError(f"{file}, line {row}: {checks.short(line.strip())}: {allowed}") from None
        try:
            return cls(*zip(*found)) if found else cls((), ())
        except ValueError as error:
            raise ValueError(f"{file}: {error}") from None

    def pose(self, time: float, position: Floats, orientation: Floats) -> tuple[Floats, Floats]:
        """As of `Fixed`."""
        places = np.array(self.positions)
        place = np.array([np.interp(time, self.times, axis) for axis in places.T])
        return position + place - places[0], orientation

    @property
    def lasts(self) -> Floats:
        """How long the body goes from each place to the next (n - 1,) [s]."""
        return np.diff(self.times)

    @property
    def velocities(self) -> Floats:
        """The velocities (n - 1, 3) from each place to the next."""
        return np.diff(np.array(self.positions), axis=0) / self.lasts[:, None]

    def top_velocity(self) -> Floats:
        """As of `Fixed`."""
        return np.array([*max(self.velocities, key=np.linalg.norm, default=np.zeros(3)), 0.0, 0.0, 0.0])


#: Motions that do not answer to forces.
Prescribed = Union[Fixed, Rotation, Oscillation, Glide, Path]
Motion = Union[Dynamic, Prescribed]
#: The motions of this module by name.
KINDS = {kind.__name__: kind for kind in (Dynamic, Guided, Hinged, Held, *get_args(Prescribed))}
Pose = tuple[Floats, Floats]  #: position (3,) [m] and quaternion (4,)


def checked_pose(motion: Prescribed, time: float, position: Floats, orientation: Floats) -> Pose:
    """The pose of a motion, also of one that is not of this module, as arrays of its own, the quaternion of unit norm.
    ValueError if it is no pose."""
    place, turn = motion.pose(time, position.copy(), orientation.copy())
    what = f"of the pose of {type(motion).__name__} at {time:g} s"
    return vector(f"position {what}", place), unit_quaternion(f"quaternion {what}", turn)


def velocity_between(start: Pose, end: Pose, dt: float) -> Floats:
    """Velocity (6,) that takes a body from one of its poses to another in dt [s]."""
    velocity = np.zeros(6)
    velocity[:3] = (end[0] - start[0]) / dt
    if start[1].tolist() != end[1].tolist():
        velocity[3:] = quaternion.rotation_vector(start[1], end[1]) / dt
    return velocity


#: What classes of motions might define, and what the program asks of those of a kind.
KNOWN = {"pose", "position", "orientation", "velocity", "angular_velocity", "force", "torque", "free_directions"}
KNOWN |= {"free_turns", "mean_drive", "held"}
OF_FORCES, OF_DRIVES = {"free_directions", "free_turns", "held"}, {"mean_drive"}


def refuse_ignored(motion: Motion) -> None:
    """ValueError for what is no motion, and for a motion of a class that is not of this module, and that defines a
    method or a property which nothing asks for: neither the program of such a motion, nor its own methods."""
    own: dict[str, Any] = {}
    for kind in reversed(type(motion).__mro__):
        if kind is not object and kind.__module__ != __name__:
            own |= vars(kind)
    asked = OF_FORCES.copy() if isinstance(motion, Dynamic) else {"pose"}
    asked |= OF_DRIVES if isinstance(motion, Driven) else set()
    codes = [getattr(value, "fget", value) for value in own.values()]
    asked |= {name for code in codes for name in getattr(getattr(code, "__code__", None), "co_names", ())}
    methods = {name for name, value in own.items() if callable(value) or isinstance(value, property)}
    for name in sorted(KNOWN & methods - asked):
        called, allowed = type(motion).__name__, ", ".join(sorted(asked & KNOWN))
        raise ValueError(f"the motion {called} defines {name}, which nothing asks for; allowed: {allowed}")
    if not (isinstance(motion, Dynamic) or hasattr(motion, "pose")):
        raise ValueError(f"the motion {motion!r}: allowed is an object of dem.motion, or one with a method pose")


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
        turns = motion.elapsed(time) / motion.period - after.elapsed(time) / after.period
        after = dataclasses.replace(after, phase=motion.phase + 2.0 * np.pi * turns)
    return after
