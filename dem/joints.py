"""Joints between two bodies, or between a body and the world: hinges, sliders, balls and fixed ones, with motors.

A joint has rows J of the velocities of its two bodies. In a step with the free velocities v* the velocity is

    v = v* + M^-1 J' g,    J v + e (g - f) = t,

with t = -error / dt for what the joint holds, so that its error is gone at the end of the step, to second order in dt.
Motors have t = their speed. Their e is 0 if nothing bounds them. A bounded one gives the impulse f which brings it to
its speed without contacts, within its strength, and e as `dem.motion.Driven` has its grip. Contacts see the joints in
their inverse mass (`dem.contact_map.jointed`), so joints and contacts are solved together.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from dem import checks, quaternion
from dem.arrays import Floats, Ints
from dem.motion import DROOP
from dem.springs import End, Ends

KINDS = ("hinge", "slider", "ball", "fixed")
#: Which of three translations and three turns, along the axes of the joint, a kind holds; z is the axis.
HOLDS = {
    "hinge": (True, True, True, True, True, False),
    "slider": (True, True, False, True, True, True),
    "ball": (True, True, True, False, False, False),
    "fixed": (True,) * 6,
}


@dataclass(frozen=True)
class Joint:
    """A joint. The anchors and frames are in the frames of its bodies; of the world they are places."""

    kind: str
    ends: tuple[End, End]
    anchors: Sequence[Sequence[float]]  #: (2, 3) [m]
    frames: Sequence[Sequence[float]]  #: (2, 4) quaternions, of which the z axis is that of the joint
    speed: float | None = None  #: that a motor keeps [rad/s] or [m/s]
    target: float | None = None  #: angle [rad] or position [m] to which a motor goes, in one step as far as it can
    strength: float = np.inf  #: the greatest torque [N m] or force [N] of the motor
    low: float = -np.inf  #: least angle [rad] or position [m]
    high: float = np.inf  #: greatest one

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise ValueError(f"kind of a joint {self.kind!r}: allowed are {', '.join(KINDS)}")
        ends = tuple(end if end is None or isinstance(end, str) else int(end) for end in self.ends)
        if ends[0] == ends[1]:
            raise ValueError(f"both ends of a joint are at {ends[0]}: allowed are two bodies, or a body and the world")
        object.__setattr__(self, "ends", ends)
        if self.speed is not None and self.target is not None:
            raise ValueError("the motor of a joint: allowed is a speed or a target, not both")
        for name in ("speed", "target"):
            if getattr(self, name) is not None:
                object.__setattr__(self, name, float(checks.finite(f"{name} of a motor", getattr(self, name))))
        checks.positive_or_inf("strength of a motor", self.strength)
        if not self.low <= self.high:
            raise ValueError(f"limits of a joint: the lower one, {self.low:g}, is above the upper one, {self.high:g}")
        if self.kind in ("ball", "fixed") and (self.driven or np.isfinite([self.low, self.high]).any()):
            raise ValueError(f"a {self.kind} joint has no motor and no limits: allowed are those of hinges and sliders")

    @property
    def driven(self) -> bool:
        """Whether a motor moves it."""
        return self.speed is not None or self.target is not None

    @property
    def way(self) -> int:
        """The number of its free coordinate among three translations and three turns: that of motors and limits."""
        return 2 if self.kind == "slider" else 5

    def changed(self, **values: Any) -> Joint:
        """The joint with another `speed`, `target` (the other of both is then None), `strength`, `low` or `high`."""
        if other := sorted(set(values) - {"speed", "target", "strength", "low", "high"}):
            raise ValueError(f"{other[0]} of a joint cannot be set; allowed are speed, target, strength, low and high")
        if values.get("speed") is not None:
            values.setdefault("target", None)
        if values.get("target") is not None:
            values.setdefault("speed", None)
        return dataclasses.replace(self, **values)


@dataclass(frozen=True)
class Geometry:
    """Joints as they are: n of them."""

    rows: Floats  #: (n, 6, 2, 6) from velocities of the ends to relative ones along, and about, the axes of the joint
    error: Floats  #: (n, 6) translations [m] and turns [rad] of the second end relative to the first
    axes: Floats  #: (n, 3, 3) rows x, y, z in the world


def geometry(joints: Sequence[Joint], row: Ints, ends: Ends) -> Geometry:
    """Of joints between bodies in the rows `row` (n, 2)."""
    anchors, frames = (np.array([getattr(joint, name) for joint in joints]) for name in ("anchors", "frames"))
    turn = [quaternion.normalized(quaternion.multiply(ends.quaternion[row[:, k]], frames[:, k])) for k in (0, 1)]
    places = [ends.position[row[:, k]] + quaternion.rotate(ends.quaternion[row[:, k]], anchors[:, k]) for k in (0, 1)]
    axes = np.stack([quaternion.rotate(turn[0], unit) for unit in np.eye(3)], axis=1)
    relative = quaternion.multiply(quaternion.conjugate(turn[0]), turn[1])
    relative = np.where(relative[:, :1] < 0.0, -relative, relative)
    sine = quaternion.length(relative[:, 1:])
    angle = 2.0 * np.arctan2(sine, relative[:, 0])
    turned = relative[:, 1:] * np.divide(angle, sine, out=np.full_like(sine, 2.0), where=sine > 1e-12)[:, None]
    hinge = np.array([joint.kind == "hinge" for joint in joints])
    z = np.einsum("nij,nj->ni", axes, quaternion.rotate(turn[1], np.array([0.0, 0.0, 1.0])))
    turned[hinge, 0], turned[hinge, 1] = -z[hinge, 1], z[hinge, 0]
    turned[hinge, 2] = 2.0 * np.arctan2(relative[hinge, 3], relative[hinge, 0])
    d = places[1] - places[0]
    error = np.concatenate([np.einsum("nij,nj->ni", axes, d), turned], axis=1)
    out = np.zeros((len(joints), 6, 2, 6))
    for k, sign in ((0, -1.0), (1, 1.0)):
        arm = places[1] - ends.position[row[:, k]]
        out[:, :3, k, :3] = sign * axes
        out[:, :3, k, 3:] = sign * np.cross(arm[:, None], axes)
        out[:, 3:, k, 3:] = sign * axes
    return Geometry(out, error, axes)


@dataclass(frozen=True)
class Coupling:
    """The rows of the joints of a step, and what they do to n bodies without contacts."""

    rows: Floats  #: (k, n, 6) J
    scaled: Floats  #: (k, 6 n) B = J M^-1/2
    solver: Floats  #: (k, k) (B B' + e)^-1
    impulse: Floats  #: (k,) without contacts [N s, N m s]
    change: Floats  #: (n, 6) of velocities, by these impulses
    matrix: Floats  #: (6 n, 6 n) K of `dem.contact_map.jointed`
    joint: Ints  #: (k,) of which joint each row is
    way: Ints  #: (k,) which of its six coordinates
    axes: Floats  #: (joints, 3, 3) rows x, y, z in the world


def coupling(joints: Sequence[Joint], row: Ints, ends: Ends, dt: float) -> Coupling:
    """Of joints between bodies in the rows `row` (n, 2) in a step of dt [s].

    Motors that are too weak, and limits that are not reached, are found without contacts, by an active set."""
    found = geometry(joints, row, ends)
    count = len(ends.free)
    chosen: list[tuple[int, int]] = []
    target, most, kind = [], [], []  # kind: 0 held, 1 motor, 2 lower limit, 3 upper limit
    for n, joint in enumerate(joints):
        for way in np.flatnonzero(HOLDS[joint.kind]).tolist():
            chosen.append((n, way))
            target.append(-found.error[n, way] / dt)
            most.append(np.inf)
            kind.append(0)
        at = found.error[n, joint.way]
        if joint.driven:
            chosen.append((n, joint.way))
            target.append(joint.speed if joint.speed is not None else (joint.target - at) / dt)
            most.append(joint.strength * dt)
            kind.append(1)
        for side, limit in ((2, joint.low), (3, joint.high)):
            if np.isfinite(limit):
                chosen.append((n, joint.way))
                target.append((limit - at) / dt)
                most.append(np.inf)
                kind.append(side)
    rows = np.array(chosen, np.int64).reshape(-1, 2)
    which, ways = rows[:, 0], rows[:, 1]
    t, bound, code = np.array(target), np.array(most), np.array(kind)
    J = np.zeros((len(t), count, 6))
    for side in (0, 1):
        np.add.at(J, (np.arange(len(t)), row[which, side]), found.rows[which, ways, side])
    root = _roots(ends.inverse_mass)
    B = np.einsum("knx,nxy->kny", J, root).reshape(len(t), -1)
    now, free = J.reshape(len(t), -1) @ ends.velocity.ravel(), J.reshape(len(t), -1) @ ends.free.ravel()
    A = B @ B.T
    on, pushed = code < 2, np.zeros(len(t))  # rows that hold; given impulses of the others
    for _ in range(2 * len(t) + 1):
        g = pushed.copy()
        g[on] = np.linalg.lstsq(A[np.ix_(on, on)], (t - free - A @ pushed)[on], rcond=1e-12)[0]
        after = free + A @ g
        weak = on & (code == 1) & (np.abs(g) > bound)
        reached = ~on & (((code == 2) & (after < t - 1e-12)) | ((code == 3) & (after > t + 1e-12)))
        pulls = on & (((code == 2) & (g < 0.0)) | ((code == 3) & (g > 0.0)))
        if not (weak | reached | pulls).any():
            break
        pushed[weak] = (np.sign(g) * bound)[weak]
        on = (on | reached) & ~weak & ~pulls
    slip = np.maximum(np.maximum(DROOP * np.abs(t), np.abs(t - now)), 1e-9 * np.abs(bound) * np.diag(A))
    room = bound - np.abs(g)
    bounded = np.isfinite(bound)
    e = np.where(bounded, np.divide(slip, room, out=np.full_like(slip, np.inf), where=bounded & (room > 0.0)), 0.0)
    on &= np.isfinite(e)
    solver = np.zeros_like(A)
    solver[np.ix_(on, on)] = np.linalg.pinv(A[np.ix_(on, on)] + np.diag(e[on]), rcond=1e-12, hermitian=True)
    value, vector = np.linalg.eigh(B.T @ solver @ B)
    K = (vector * (1.0 - np.sqrt(np.clip(1.0 - value, 0.0, 1.0)))) @ vector.T
    change = np.einsum("nxy,ny->nx", root, (B.T @ g).reshape(-1, 6))
    return Coupling(J, B, solver, g, change, K, which, ways, found.axes)


def _roots(matrix: Floats) -> Floats:
    """Symmetric roots of symmetric matrices (n, 6, 6)."""
    value, vector = np.linalg.eigh(matrix)
    return (vector * np.sqrt(np.maximum(value, 0.0))[:, None]) @ vector.transpose(0, 2, 1)


def as_text(joints: dict[str, Joint]) -> str:
    """Joints as text, for `from_text`."""
    return json.dumps({name: dataclasses.asdict(joint) for name, joint in joints.items()})


def from_text(text: str) -> dict[str, Joint]:
    """The joints of a text."""
    values: dict[str, Any] = json.loads(text)
    return {name: Joint(**{**given, "ends": tuple(given["ends"])}) for name, given in values.items()}
