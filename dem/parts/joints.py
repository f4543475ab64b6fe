"""Joints between two bodies, or between a body and the world, with motors: hinges, sliders, balls and others.

A kind of joint is a line of `KINDS`. `dem.unconstrained.constraints` finds their impulses.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import numpy as np

from dem import checks, quaternion
from dem.arrays import Floats, Ints
from dem.compiled import inlined, loop
from dem.geometry import vectors
from dem.motion import Driven
from dem.parts.ends import HELD, LOWER, MOTOR, UPPER, Condition, Constraint, End, Geometry, Place
from dem.parts.named import Pressing

if TYPE_CHECKING:
    from dem.parts.cell import Cell


#: What turns of a joint are, see `placed`: a rotation vector, a tilt and an angle about z, Cardan angles of two pins.
VECTOR, ABOUT_Z, ABOUT_PINS = range(3)


@loop
def placed(turns, anchors, frames, place, orientation, lengths):
    """`Geometry` of joints whose turns are of these kinds (n,), with anchors (n, 2, 3) and frames (n, 2, 4) in bodies
    of these places (n, 2, 3) and orientations (n, 2, 4), in a cell of these `Cell.lengths` (3,).

    The turns are those of the second frame seen from the first, whose axes a joint holds: the rotation vector; the
    tilt of the z axis, and the angle about it; or with two pins, the z axis of the first body and the x axis of the
    second, the Cardan angles, of their cross about the first pin, between the pins, and about the second pin. Then
    the axes are those of the cross."""
    arms, error, axes = np.empty(anchors.shape), np.empty((len(turns), 6)), np.empty((len(turns), 3, 3))
    frame, relative, cross = np.empty((2, 4)), np.empty(4), np.empty(4)
    for n in range(len(turns)):
        for k in range(2):
            q, at = orientation[n, k], anchors[n, k]
            arm = vectors.turned((at[0], at[1], at[2]), (q[1], q[2], q[3]), 2.0 * q[0], 2.0)
            arms[n, k, 0], arms[n, k, 1], arms[n, k, 2] = arm
            _set_product(q, 1.0, frames[n, k], frame[k])
        _set_product(frame[0], -1.0, frame[1], relative)
        sign = -1.0 if relative[0] < 0.0 else 1.0
        w, x, y, z = sign * relative[0], sign * relative[1], sign * relative[2], sign * relative[3]
        own = frame[0]
        if turns[n] == VECTOR:
            sine = np.sqrt(x * x + y * y + z * z)
            share = 2.0 * np.arctan2(sine, w) / sine if sine > 1e-12 else 2.0
            error[n, 3], error[n, 4], error[n, 5] = share * x, share * y, share * z
        elif turns[n] == ABOUT_Z:
            error[n, 3], error[n, 4] = 2.0 * (w * x - y * z), 2.0 * (w * y + x * z)
            error[n, 5] = 2.0 * np.arctan2(z, w)
        else:
            angle = np.arctan2(2.0 * (x * y + w * z), 1.0 - 2.0 * (y * y + z * z))
            error[n, 3] = np.arctan2(2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y))
            error[n, 4] = -np.arcsin(min(max(2.0 * (x * z - w * y), -1.0), 1.0))
            error[n, 5] = angle
            relative[0], relative[1], relative[2], relative[3] = np.cos(0.5 * angle), 0.0, 0.0, np.sin(0.5 * angle)
            _set_product(own, 1.0, relative, cross)
            own = cross
        _set_axes(own, axes[n])
        for i in range(3):
            d = (place[n, 1, i] + arms[n, 1, i]) - (place[n, 0, i] + arms[n, 0, i])
            image = lengths[i] * np.round(d / lengths[i]) if lengths[i] > 0.0 else 0.0
            arms[n, 0, i] += d - image
            relative[i] = d - image
        for i in range(3):
            error[n, i] = axes[n, i, 0] * relative[0] + axes[n, i, 1] * relative[1] + axes[n, i, 2] * relative[2]
    return arms, error, axes


@inlined
def _set_axes(q, out):
    """The axes (3, 3) of a frame, as rows in the world."""
    w, x, y, z = q[0], q[1], q[2], q[3]
    out[0, 0], out[1, 1], out[2, 2] = 1 - 2 * (y * y + z * z), 1 - 2 * (x * x + z * z), 1 - 2 * (x * x + y * y)
    out[1, 0], out[0, 1] = 2 * (x * y - w * z), 2 * (x * y + w * z)
    out[2, 0], out[0, 2] = 2 * (x * z + w * y), 2 * (x * z - w * y)
    out[2, 1], out[1, 2] = 2 * (y * z - w * x), 2 * (y * z + w * x)


@inlined
def _set_product(p, sign, q, out):
    """The product of two quaternions, of the first or its inverse (sign -1), of unit norm."""
    a, b, c, d = p[0], sign * p[1], sign * p[2], sign * p[3]
    w, x = a * q[0] - b * q[1] - c * q[2] - d * q[3], a * q[1] + b * q[0] + c * q[3] - d * q[2]
    y, z = a * q[2] + c * q[0] + d * q[1] - b * q[3], a * q[3] + d * q[0] + b * q[2] - c * q[1]
    size = 1.0 / np.sqrt(w * w + x * x + y * y + z * z)
    out[0], out[1], out[2], out[3] = size * w, size * x, size * y, size * z


class Kind(NamedTuple):
    """A kind of joint."""

    holds: tuple[bool, ...]  #: which of three translations and three turns, along the axes of the joint; z is the axis
    coordinate: int = 5  #: the number of its free coordinate among these, that of motors and limits
    motor: bool = False  #: whether it may have them
    turns: int = VECTOR  #: what its turns are
    axes: int = 1  #: that it has; of two the second one is the x axis


KINDS = {
    "hinge": Kind((True, True, True, True, True, False), motor=True, turns=ABOUT_Z),
    "slider": Kind((True, True, False, True, True, True), coordinate=2, motor=True),
    "ball": Kind((True, True, True, False, False, False), axes=0),
    "fixed": Kind((True,) * 6, axes=0),
    "universal": Kind((True, True, True, False, True, False), turns=ABOUT_PINS, axes=2),
}


@dataclass(frozen=True)
class Joint(Constraint):
    """A joint. The anchors and frames are in the frames of its bodies; of the world they are places."""

    kind: str
    frames: Sequence[Sequence[float]]  #: (2, 4) quaternions, of which the z axis is that of the joint
    speed: float | None = None  #: that a motor keeps, or with a target the greatest [rad/s] or [m/s]
    #: angle [rad] or position [m] to which a motor goes, as fast as speed and strength let it go and stop there
    target: float | None = None
    strength: float = np.inf  #: the greatest torque [N m] or force [N] of the motor
    low: float = -np.inf  #: least angle [rad] or position [m]
    high: float = np.inf  #: greatest one
    touching: bool = False  #: whether its two bodies also touch each other
    CHANGED: ClassVar = ("speed", "target", "strength", "low", "high")
    KEPT: ClassVar = CHANGED

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise ValueError(f"kind of a joint {self.kind!r}: allowed are {', '.join(KINDS)}")
        super().__post_init__()
        for name in ("speed", "target"):
            if getattr(self, name) is not None:
                object.__setattr__(self, name, float(checks.finite(f"{name} of a motor", getattr(self, name))))
        if self.target is not None and self.speed is not None and self.speed <= 0.0:
            raise ValueError(f"speed of a motor with a target, {self.speed:g}: allowed is the greatest, above zero")
        checks.positive_or_inf("strength of a motor", self.strength)
        if not self.low <= self.high:
            raise ValueError(f"limits of a joint: the lower one, {self.low:g}, is above the upper one, {self.high:g}")
        for name in ("target", "low", "high"):
            angle = getattr(self, name)
            if self.kind == "hinge" and angle is not None and np.pi < abs(angle) < np.inf:
                raise ValueError(
                    f"{name} of a hinge, {angle:g} rad: allowed are angles from -pi to pi; a motor with a speed, and "
                    "without limits, turns further"
                )
        if not KINDS[self.kind].motor and (self.driven or np.isfinite([self.strength, self.low, self.high]).any()):
            raise ValueError(f"a {self.kind} joint has no motor and no limits: allowed are those of hinges and sliders")

    def refuse(self, name: str, world: Any) -> None:
        super().refuse(name, world)
        if world.cell.moves:
            what = "cell of given stress" if world.cell.deforms else "sheared cell"
            raise ValueError(f"joint {name!r}: a {what} has no joints")

    @classmethod
    def pressing(cls, members: Mapping[str, Any], scene: Any, body: Callable[[Any], tuple[float, ...]]) -> Pressing:
        """The greatest force of motors, and the lighter bodies of joints with their speeds."""
        greatest, impacts = 0.0, []
        for joint in members.values():
            if not joint.driven:
                continue
            mass, _, radius = min(body(end) for end in joint.ends)
            lever = radius if joint.kind == "hinge" else 1.0
            if np.isfinite(joint.strength):
                greatest = max(greatest, joint.strength / lever)
            if joint.speed is not None and np.isfinite(mass):
                impacts.append((mass, abs(joint.speed) * lever))
        return Pressing(greatest, impacts=tuple(impacts))

    @classmethod
    def between(
        cls, name: str, ends: tuple[End, End], scene: Any, anchor: Sequence[float], axis: Any, **given: Any
    ) -> Joint:
        """The joint with the anchor [m] and axis (3,), or axes (2, 3), of the world at time zero, where all its
        coordinates are zero."""
        place = checks.vector(f"anchor of {name!r}", anchor)
        pins = [(0.0, 0.0, 1.0)] if axis is None else axis if np.ndim(axis) > 1 else [axis]
        z, *more = (np.array(checks.unit_vector(f"axis of {name!r}", pin)) for pin in pins)
        x = more[0] if more else quaternion.across(z[None])[0]
        if abs(x @ z) > 1e-9:
            raise ValueError(f"axes of {name!r}: allowed are perpendicular ones, got {np.asarray(axis).tolist()}")
        upright = quaternion.from_matrix(np.stack([x, np.cross(z, x), z], axis=1))
        anchors: list[Any] = []
        frames: list[Any] = []
        for position, turn in (scene.pose(f"joint {name!r}", end) for end in ends):
            inverse_turn, arm = quaternion.conjugate(turn), place - position
            anchors.append(quaternion.rotate(inverse_turn, arm - scene.cell.whole(arm)))
            frames.append(tuple(quaternion.multiply(inverse_turn, upright).tolist()))
        for body in scene.large_bodies:
            if body.name in ends and isinstance(body.motion, Driven):
                raise ValueError(f"joint {name!r}: {body.name!r} has a drive of its own; allowed are other motions")
        joint = cls(ends, anchors, frames=frames, **given)
        if not joint.low <= 0.0 <= joint.high:
            span = f"{joint.low:g} to {joint.high:g}"
            raise ValueError(f"limits of {name!r}, {span}: allowed are those about 0, where it is at time zero")
        count, asked = KINDS[joint.kind].axes, 0 if axis is None else len(pins)
        if asked != count and (asked or count > 1):
            raise ValueError(f"axes of {name!r}: got {asked}, allowed are {count} of a {joint.kind} joint")
        return joint

    @property
    def driven(self) -> bool:
        """Whether a motor moves it."""
        return self.speed is not None or self.target is not None

    @property
    def coordinate(self) -> int:
        """The number of its free coordinate among three translations and three turns: that of motors and limits."""
        return KINDS[self.kind].coordinate

    def changed(self, time: float, tally: Any, **values: Any) -> Joint:
        """As of `Named`; a `speed` alone ends a target, and a `target` alone a speed that was kept. A greatest speed
        stays when another target comes."""
        if values.get("speed") is not None:
            values.setdefault("target", None)
        elif values.get("target") is not None and self.target is None:
            values.setdefault("speed", None)
        return dataclasses.replace(self, **values)

    def conditions(self, error: Floats, dt: float) -> list[Condition]:
        at = error[self.coordinate]
        holds = enumerate(KINDS[self.kind].holds)
        found = [Condition(coordinate, HELD, -error[coordinate] / dt) for coordinate, held in holds if held]
        if self.driven:
            way = np.inf if self.target is None else min(max(self.target, self.low), self.high) - at
            most = np.inf if self.speed is None else self.speed
            speed = most if self.target is None else min(max(way / dt, -most), most)
            speed = min(max(speed, (self.low - at) / dt), (self.high - at) / dt)  # it stops at its limits
            found.append(Condition(self.coordinate, MOTOR, speed, self.strength * dt, way))
        limits = (LOWER, self.low), (UPPER, self.high)
        return found + [Condition(self.coordinate, kind, (end - at) / dt) for kind, end in limits if np.isfinite(end)]

    @classmethod
    def geometry(cls, members: Sequence[Any], row: Ints, cell: Cell) -> Place:
        anchors, frames = (np.array([getattr(joint, name) for joint in members]) for name in ("anchors", "frames"))
        turns, lengths = np.array([KINDS[joint.kind].turns for joint in members]), cell.lengths

        def now(position: Floats, orientation: Floats) -> Geometry:
            return Geometry(*placed(turns, anchors, frames, position[row], orientation[row], lengths))

        return now
