"""Joints between two bodies, or between a body and the world: hinges, sliders, balls and fixed ones, with motors.

A joint has rows J of the velocities of its two bodies. In a step with the free velocities v* the velocity is

    v = v* + M^-1 J' g,    J v + e (g - f) = t,

with t for what the joint holds such that its error is gone at the end of the step, see `coupling`.
Motors have t = their speed. Their e is 0 if nothing bounds them. A bounded one gives the impulse f which brings it to
its speed without contacts, within its strength, and e as `dem.motion.Driven` has its grip. Contacts see the joints in
their inverse mass (`dem.contact_map.mass`), so joints and contacts are solved together. Which limits are reached and
which motors are too weak is found without contacts first (`coupling`). Where the contacts of the step show another set,
they are solved once more with it (`refound`).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from dem import checks, quaternion
from dem.arrays import Bools, Floats, Ints
from dem.free_motion import free_spin, unequal
from dem.motion import DROOP
from dem.parts.ends import Ends, Tie
from dem.parts.named import Pressing

KINDS = ("hinge", "slider", "ball", "fixed")
#: Which of three translations and three turns, along the axes of the joint, a kind holds; z is the axis.
HOLDS = {
    "hinge": (True, True, True, True, True, False),
    "slider": (True, True, False, True, True, True),
    "ball": (True, True, True, False, False, False),
    "fixed": (True,) * 6,
}

ROUNDS = 8  #: of the iteration for what is not linear in the velocities, at most
FAR = 0.5  #: radians in a step above which it does not converge, and the step takes joints as linear

HELD, MOTOR, LOWER, UPPER = range(4)  #: kinds of rows: what a joint holds, its motor, its limits


@dataclass(frozen=True)
class Joint(Tie):
    """A joint. The anchors and frames are in the frames of its bodies; of the world they are places."""

    kind: str
    frames: Sequence[Sequence[float]]  #: (2, 4) quaternions, of which the z axis is that of the joint
    speed: float | None = None  #: that a motor keeps [rad/s] or [m/s]
    target: float | None = None  #: angle [rad] or position [m] to which a motor goes, in one step as far as it can
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

    def refuse(self, name: str, world: Any) -> None:
        super().refuse(name, world)
        if world.shear is not None or world.servo is not None:
            cell = "sheared cell" if world.servo is None else "cell of given stress"
            raise ValueError(f"joint {name!r}: a {cell} has no joints")

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

    @property
    def driven(self) -> bool:
        """Whether a motor moves it."""
        return self.speed is not None or self.target is not None

    @property
    def way(self) -> int:
        """The number of its free coordinate among three translations and three turns: that of motors and limits."""
        return 2 if self.kind == "slider" else 5

    def changed(self, time: float, tally: Any, **values: Any) -> Joint:
        """As of `Named`; with a `speed` there is no `target`, and the other way round."""
        if values.get("speed") is not None:
            values.setdefault("target", None)
        if values.get("target") is not None:
            values.setdefault("speed", None)
        return dataclasses.replace(self, **values)


def whole_periods(way: Floats, period: Floats | None) -> Floats:
    """The part (..., 3) of ways (..., 3) that is whole periods (3,) of the cell [m]; without it, ways lead to the
    nearest image."""
    if period is None:
        return np.zeros_like(way)
    cell = np.where(np.isfinite(period), period, 1.0)
    return np.where(np.isfinite(period), cell * np.round(way / cell), 0.0)


@dataclass(frozen=True)
class Geometry:
    """Joints as they are: n of them."""

    rows: Floats  #: (n, 6, 2, 6) from velocities of the ends to relative ones along, and about, the axes of the joint
    error: Floats  #: (n, 6) translations [m] and turns [rad] of the second end relative to the first
    axes: Floats  #: (n, 3, 3) rows x, y, z in the world


def geometry(
    joints: Sequence[Joint], row: Ints, position: Floats, orientation: Floats, period: Floats | None = None
) -> Geometry:
    """Of joints between bodies in the rows `row` (n, 2), with positions (bodies, 3) [m] and quaternions (bodies, 4).
    With a `period` (3,) of the cell [m] the second ends are those images whose anchors are nearest to the first
    ones."""
    anchors, frames = (np.array([getattr(joint, name) for joint in joints]) for name in ("anchors", "frames"))
    turn = [quaternion.normalized(quaternion.multiply(orientation[row[:, k]], frames[:, k])) for k in (0, 1)]
    places = [position[row[:, k]] + quaternion.rotate(orientation[row[:, k]], anchors[:, k]) for k in (0, 1)]
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
    image = whole_periods(d, period)
    d -= image
    error = np.concatenate([np.einsum("nij,nj->ni", axes, d), turned], axis=1)
    out = np.zeros((len(joints), 6, 2, 6))
    for k, sign in ((0, -1.0), (1, 1.0)):
        arm = places[1] - (1 - k) * image - position[row[:, k]]
        out[:, :3, k, :3] = sign * axes
        out[:, :3, k, 3:] = sign * np.cross(arm[:, None], axes)
        out[:, 3:, k, 3:] = sign * axes
    return Geometry(out, error, axes)


@dataclass(frozen=True)
class Coupling:
    """The rows of the joints of a step, and what they do to n bodies without contacts."""

    rows: Floats  #: (k, n, 6) J
    scaled: Floats  #: (k, 6 n) B = J M^-1/2
    root: Floats  #: (n, 6, 6) M^-1/2
    joint: Ints  #: (k,) of which joint each row is
    way: Ints  #: (k,) which of its six coordinates
    kind: Ints  #: (k,) HELD, MOTOR, LOWER or UPPER
    target: Floats  #: (k,) t
    bound: Floats  #: (k,) greatest impulses, inf: none
    free: Floats  #: (k,) J v*
    slip: Floats  #: (k,) what bounded motors lose to the load that they can just bear
    axes: Floats  #: (joints, 3, 3) rows x, y, z in the world
    on: Bools  #: (k,) the rows that hold
    given: Floats  #: (k,) impulses of the others: of motors that are too weak
    solver: Floats  #: (k, k) (B B' + e)^-1 of the rows that hold
    impulse: Floats  #: (k,) without contacts [N s, N m s]
    change: Floats  #: (n, 6) of velocities, by these impulses
    matrix: Floats  #: (6 n, 6 n) K of `dem.contact_map.mass`
    spin: Floats  #: (n, 3) angular velocities without joints and contacts; NaN where all moments are equal, or infinite
    middle: Floats  #: (n, 3) about which they are linear in the impulses, see `dem.free_motion.free_spin`

    def impulses(self, push: Floats) -> Floats:
        """Impulses (k,) of the rows where contacts give the bodies the mass-scaled momenta `push` (n, 6)."""
        return self.impulse - self.solver @ (self.scaled @ push.ravel())

    @property
    def decides(self) -> bool:
        """Whether contacts may change which rows hold: those of limits and of motors with a bound."""
        return bool(((self.kind > MOTOR) | np.isfinite(self.bound)).any())


def coupling(
    joints: Sequence[Joint], row: Ints, ends: Ends, dt: float, period: Floats | None, push: Floats
) -> Coupling:
    """Of joints between bodies in the rows `row` (n, 2) in a step of dt [s], with the period of the cell, where
    contacts are expected to give the bodies the mass-scaled momenta `push` (n, 6).

    Motors that are too weak, and limits that are reached, are found without contacts, by an active set. What is not
    linear is found by a fixed-point iteration, whose error falls by about the angle of a step each time: the angular
    momentum of bodies that are no spheres, and the errors of joints at the end of the step. So joints hold there, as
    in the method SHAKE, with forces of the start of the step, and energy does not drift (Hairer, Lubich, Wanner,
    "Geometric Numerical Integration", section VII.1.4)."""
    found = geometry(joints, row, ends.position, ends.quaternion, period)
    count = len(ends.free)
    chosen: list[tuple[int, int]] = []
    target, most, kinds = [], [], []
    for n, joint in enumerate(joints):
        for way in np.flatnonzero(HOLDS[joint.kind]).tolist():
            chosen.append((n, way))
            target.append(-found.error[n, way] / dt)
            most.append(np.inf)
            kinds.append(HELD)
        at = found.error[n, joint.way]
        if joint.driven:
            chosen.append((n, joint.way))
            speed = joint.speed if joint.speed is not None else (joint.target - at) / dt
            target.append(min(max(speed, (joint.low - at) / dt), (joint.high - at) / dt))  # it stops at its limits
            most.append(joint.strength * dt)
            kinds.append(MOTOR)
        for side, limit in ((LOWER, joint.low), (UPPER, joint.high)):
            if np.isfinite(limit):
                chosen.append((n, joint.way))
                target.append((limit - at) / dt)
                most.append(np.inf)
                kinds.append(side)
    rows = np.array(chosen, np.int64).reshape(-1, 2)
    which, ways = rows[:, 0], rows[:, 1]
    t, bound, kind = np.array(target), np.array(most), np.array(kinds)
    J = np.zeros((len(t), count, 6))
    for side in (0, 1):
        np.add.at(J, (np.arange(len(t)), row[which, side]), found.rows[which, ways, side])
    root = _roots(ends.inverse_mass)
    B = np.einsum("knx,nxy->kny", J, root).reshape(len(t), -1)
    now, velocity = J.reshape(len(t), -1) @ ends.velocity.ravel(), ends.free.copy()
    A = B @ B.T
    slip = np.maximum(DROOP * np.abs(t), np.abs(t - now))
    motors = np.isfinite(bound)
    slip[motors] = np.maximum(slip, 1e-9 * np.diag(A) * np.where(motors, bound, 0.0))[motors]
    on, given = kind <= MOTOR, np.zeros(len(t))
    rows = np.flatnonzero(unequal(ends.moments))
    known = ends.quaternion[rows], ends.velocity[rows, 3:], ends.moments[rows]
    spin, middle = np.full((2, count, 3), np.nan)
    held, left = kind == HELD, t.copy()
    expected, pushed = push.ravel(), B @ push.ravel()
    for _ in range(ROUNDS):
        change = np.einsum("nxy,ny->nx", root, expected.reshape(-1, 6))
        alone, middle[rows] = free_spin(*known, dt, change[rows, 3:] + ends.given[rows])
        spin[rows] = velocity[rows, 3:] = alone + ends.given[rows]
        free = J.reshape(len(t), -1) @ velocity.ravel()
        for _ in range(2 * len(t) + 1):
            g = _impulses(A, t, free, on, given)
            wrong = _wrong(kind, t, bound, on, g, free + A @ g, 0.0)
            if not wrong.any():
                break
            on, given = _turned(kind, bound, on, given, g, wrong)
        last, expected = expected, B.T @ g
        if pushed.any():
            expected = push.ravel() + B.T @ _impulses(A, t, free + pushed, on, given)
        if np.abs(expected - last).max() <= 1e-7 * np.abs(expected).max():
            break
        after = velocity + np.einsum("nxy,ny->nx", root, expected.reshape(-1, 6))
        if dt * np.abs(after[:, 3:]).max(initial=0.0) > FAR:
            break
        place, turn = ends.position + dt * after[:, :3], quaternion.integrate(ends.quaternion, after[:, 3:], dt)
        error = geometry(joints, row, place, turn, period).error
        bent = (error - found.error)[which, ways] / dt - J.reshape(len(t), -1) @ after.ravel()
        t = np.where(held, left - bent, left)
    fixed = (J, B, root, which, ways, kind, t, bound, free, slip, found.axes)
    return Coupling(*fixed, on, given, *_solved(B, root, t, bound, free, slip, on, given), spin=spin, middle=middle)


def refound(known: Coupling, push: Floats) -> Coupling | None:
    """The coupling with other rows that hold, where contacts give the bodies the mass-scaled momenta `push` (n, 6) with
    the known one and show by it that a limit is passed or pulls, or that a motor is too weak, or strong enough. None if
    all rows are right; the contacts of the other one are to be solved anew."""
    g = known.impulses(push)
    after = known.free + known.scaled @ (push.ravel() + known.scaled.T @ g)
    wrong = _wrong(known.kind, known.target, known.bound, known.on, g, after, DROOP)
    if not wrong.any():
        return None
    on, given = _turned(known.kind, known.bound, known.on, known.given, g, wrong)
    numbers = known.target, known.bound, known.free, known.slip
    solver, impulse, change, matrix = _solved(known.scaled, known.root, *numbers, on, given)
    return dataclasses.replace(
        known, on=on, given=given, solver=solver, impulse=impulse, change=change, matrix=matrix
    )


def _impulses(A: Floats, t: Floats, free: Floats, on: Bools, given: Floats) -> Floats:
    """Impulses (k,) that bring the rows that hold to t; of the others the given ones."""
    g = given.copy()
    g[on] = np.linalg.lstsq(A[np.ix_(on, on)], (t - free - A @ given)[on], rcond=1e-12)[0]
    return g


def _wrong(kind: Ints, t: Floats, bound: Floats, on: Bools, g: Floats, after: Floats, loose: float) -> Bools:
    """Which rows (k,) should hold and do not, or the other way round, with impulses g and velocities `after`. Where
    solvers are not exact, a part `loose` of the impulses does not count."""
    little, speed = loose * np.abs(g).max(initial=0.0), 1e-12 + 1e-6 * loose * np.abs(after - t).max(initial=0.0)
    weak = on & (kind == MOTOR) & (np.abs(g) > (1.0 + loose) * bound)
    strong = ~on & (kind == MOTOR) & (np.sign(g) * (after - t) > speed)
    reached = ~on & (((kind == LOWER) & (after < t - speed)) | ((kind == UPPER) & (after > t + speed)))
    pulls = on & (((kind == LOWER) & (g < -little)) | ((kind == UPPER) & (g > little)))
    wrong: Bools = weak | strong | reached | pulls
    return wrong


def _turned(kind: Ints, bound: Floats, on: Bools, given: Floats, g: Floats, wrong: Bools) -> tuple[Bools, Floats]:
    """The rows that hold and the given impulses of the others, after the wrong ones have changed sides."""
    given = given.copy()
    given[wrong] = 0.0
    weak = wrong & on & (kind == MOTOR)
    given[weak] = np.sign(g[weak]) * bound[weak]
    return on ^ wrong, given


def _solved(
    B: Floats, root: Floats, t: Floats, bound: Floats, free: Floats, slip: Floats, on: Bools, given: Floats
) -> tuple[Floats, Floats, Floats, Floats]:
    """`solver`, `impulse`, `change` and `matrix` of a `Coupling`."""
    A = B @ B.T
    g = _impulses(A, t, free, on, given)
    room = bound - np.abs(g)  # not positive where only contacts bring a motor to its speed: it is held there
    yields = np.isfinite(bound) & (room > 0.0)
    e = np.divide(slip, room, out=np.zeros_like(slip), where=yields)
    solver = np.zeros_like(A)
    solver[np.ix_(on, on)] = np.linalg.pinv(A[np.ix_(on, on)] + np.diag(e[on]), rcond=1e-12, hermitian=True)
    value, vector = np.linalg.eigh(B.T @ solver @ B)
    K = (vector * (1.0 - np.sqrt(np.clip(1.0 - value, 0.0, 1.0)))) @ vector.T
    change = np.einsum("nxy,ny->nx", root, (B.T @ g).reshape(-1, 6))
    return solver, g, change, K


def _roots(matrix: Floats) -> Floats:
    """Symmetric roots of symmetric matrices (n, 6, 6)."""
    value, vector = np.linalg.eigh(matrix)
    return (vector * np.sqrt(np.maximum(value, 0.0))[:, None]) @ vector.transpose(0, 2, 1)
