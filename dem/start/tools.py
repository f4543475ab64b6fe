"""How fast tools of prescribed motion go, and how fast they swing: what a time step has to resolve.

A swing is told by the mean velocities v of a body in intervals h, and by how much they change from one to the next:
(2 sin(w h / 2))^2 = <|dv|^2> / <|v|^2> for a sine of the angular frequency w. Jumps of a velocity, such as starts and
stops, are no swing: of each RUN changes after each other the median counts.
"""

from __future__ import annotations

from collections.abc import Collection
from operator import itemgetter
from typing import TYPE_CHECKING

import numpy as np

from dem import quaternion
from dem.arrays import Floats
from dem.motion import KINDS, Oscillation, Path, velocity_between
from dem.shapes import Plane, outline
from dem.start.turns import SLACK, TURN

if TYPE_CHECKING:
    from dem.model.world import World
    from dem.scene import LargeBody

SAMPLES = 1000  #: poses of a motion of one's own that are looked at, from time zero on
FINE = 0.25  #: between them, in steps in which grains come to rest
ROUNDED = 1e-10  #: of their places [m] and of a radian, that poses may be off without being moved
RUN = 5  #: changes of velocity
DRIVEN = 0.2  #: the way of the fastest tool in a step, in radii: docs/choose.md has the errors of forces
PACE = 2.0  #: radii in a step above which it is told: a tool passes a grain
WINDOW = 20  #: steps of a run whose velocities are looked at together; a tool that swings in two of them is told


def top_speed(body: LargeBody, point: Floats, radius: Floats, step: float) -> float:
    """The greatest speed [m/s] that its motion or servo gives to what is within `radius` (n,) [m] of `point` (n, 3) [m]
    at time zero, of a large body. Motions of one's own are looked at in every FINE part of a `step` [s]."""
    if not _is_own(body):
        center = np.array(getattr(body.motion, "center", body.position))
        return greatest_speed(body.motion.top_velocity(), center, point, radius)
    _, velocity = _sampled(body, step)
    spin = velocity[np.linalg.norm(velocity[:, 3:], axis=1).argmax(), 3:]  # about an axis that goes with the body
    turning = greatest_speed(np.concatenate([np.zeros(3), spin]), body.position, point, radius)
    return float(np.linalg.norm(velocity[:, :3], axis=1).max()) + turning


def half_turn_remark(body: LargeBody, dt: float) -> str:
    """What to say of a dt [s] in which the motion of a large body turns it by more than half a turn, as the shortest
    way from pose to pose is another one then; empty if it does not. Of motions of one's own nothing is known."""
    spin = 0.0 if _is_own(body) else float(np.linalg.norm(body.motion.top_velocity()[3:]))
    if dt * spin <= np.pi:
        return ""
    turns = f"{body.name} turns by {dt * spin:.3g} rad in a step"
    return f"dt {dt:g} s is too large: {turns}; take less than {np.pi / spin:.2g} s"


def greatest_speed(velocity: Floats, center: Floats, point: Floats, radius: Floats) -> float:
    """The greatest speed [m/s] within `radius` (n,) of the points (n, 3) [m] of a body which moves and turns about
    `center` (3,) with `velocity` (6,) for ever: points keep their distances from the axis, by which they go fast."""
    around = np.linalg.norm(np.cross(velocity[3:], point - center), axis=1) + np.linalg.norm(velocity[3:]) * radius
    return float(np.linalg.norm(velocity[:3]) + around.max())


def swing(body: LargeBody, step: float) -> float:
    """The angular frequency [rad/s] with which the motion of a large body swings; 0 of those that do not. Motions of
    one's own are looked at in every FINE part of a `step` [s]."""
    if _is_own(body):
        lasts, velocity = _sampled(body, step)
        return float(max(_frequency(lasts, velocity[:, :3]), _frequency(lasts, velocity[:, 3:])))
    if isinstance(body.motion, Path):
        return float(_frequency(body.motion.lasts, body.motion.velocities))
    return float(getattr(body.motion, "angular_frequency", 0.0))


def _is_own(body: LargeBody) -> bool:
    """Whether the motion of a large body is prescribed, and not of a class of `dem.motion`."""
    return hasattr(body.motion, "pose") and type(body.motion) not in KINDS.values()


def _sampled(body: LargeBody, step: float) -> tuple[Floats, Floats]:
    """Intervals (n,) [s] and the mean velocities (n, 6) in them, linear in the world and angular at time zero, of a
    motion of one's own, up to a time for which it has no pose: a run tells of that when it comes there."""
    lasts, poses = FINE * step, [body.pose(0.0)]
    try:
        poses += [body.pose(lasts * number) for number in range(1, SAMPLES)]
    except Exception:  # noqa: BLE001 - of code that is not ours
        poses = poses if len(poses) > 1 else poses * 2
    velocity = np.array([velocity_between(*two, lasts) for two in zip(poses, poses[1:])])
    least = ROUNDED / lasts * np.array([np.abs([place for place, _ in poses]).max(), 1.0])
    velocity[np.abs(velocity) <= least.repeat(3)] = 0.0
    turn = np.array([turn for _, turn in poses[1:]])
    within = quaternion.rotate(quaternion.conjugate(turn), velocity[:, 3:])
    velocity[:, 3:] = quaternion.rotate(poses[0][1], within)
    return np.full(len(velocity), lasts), velocity


def _frequency(lasts: Floats, velocity: Floats) -> Floats:
    """The angular frequencies (...,) [rad/s] of swings with mean velocities (n, ..., 3) in intervals (n,) [s] after
    each other; 0 where there are too few to tell."""
    square = np.einsum("n...i,n...i->...", velocity, velocity)
    if len(lasts) <= RUN:
        return np.zeros(square.shape)
    between = 0.5 * (lasts[1:] + lasts[:-1]).reshape(-1, *[1] * square.ndim)
    rate = np.linalg.norm(np.diff(velocity, axis=0), axis=-1) / between
    squares = np.median(np.lib.stride_tricks.sliding_window_view(rate**2, RUN, axis=0), axis=-1).sum(axis=0)
    mean: Floats = np.sqrt(np.divide(squares, square, out=np.zeros(square.shape), where=square > 0.0))
    half = 0.5 * float(lasts.mean())
    return np.arcsin(np.minimum(half * mean, 1.0)) / half


def hull(body: LargeBody) -> tuple[Floats, Floats]:
    """Points (n, 3) in the frame of a body, and radii (n,) of balls about them, that hold its shapes [m]. A plane has
    no end: a body of planes alone is its origin."""
    parts = [outline(shape) for shape in body.shapes if not isinstance(shape, Plane)]
    point, radius = zip(*parts or [(np.zeros((1, 3)), np.zeros(1))])
    return np.concatenate(point), np.concatenate(radius)


class PaceWatch:
    """Tells once of a large body that goes too far in a step, as of a motion that a run has changed: by more than PACE
    times a `half` thickness of the grains [m], and is none of those that are `leaving` them."""

    def __init__(self, half: float, leaving: Collection[str]) -> None:
        self._half, self._leaving, self._steps, self._told = half, leaving, 0, False
        self._hulls: dict[str, tuple[Floats, Floats]] = {}

    def look(self, world: World, dt: float) -> str:
        """What to say of a dt [s], most often nothing: after the first step, and each WINDOW; collective."""
        self._steps += 1
        if self._told or self._steps % WINDOW != 2:  # the first is at time zero, before motions
            return ""
        fastest = {body.name: self._speed(world, row) for row, body in enumerate(world.large_bodies)
                   if body.name not in self._leaving}  # fmt: skip
        name, speed = world.comm.bcast(max(fastest.items(), key=itemgetter(1), default=("", 0.0)))
        if dt * speed <= PACE * self._half:
            return ""
        self._told = True
        return (
            f"dt {dt:g} s is too large: {name} goes with {speed:.3g} m/s, by {dt * speed / self._half:.2g} half "
            f"thicknesses of the grains in a step; take at most {DRIVEN * self._half / speed:.2g} s"
        )

    def _speed(self, world: World, row: int) -> float:
        """The greatest speed [m/s] of a large body."""
        body, velocity = world.large_bodies[row], world.large.velocity[row]
        if not velocity.any():
            return 0.0
        if body.name not in self._hulls:
            self._hulls[body.name] = hull(body)
        point, radius = self._hulls[body.name]
        arm = quaternion.rotate(world.large.quaternion[row], point)
        along = np.linalg.norm(velocity[:3] + np.cross(velocity[3:], arm), axis=1)
        return float((along + np.linalg.norm(velocity[3:]) * radius).max())


class SwingWatch:
    """Tells once of a tool that swings too far in a step: by a `Path`, by a motion of one's own, or by one that a run
    has changed."""

    def __init__(self) -> None:
        self._seen: list[Floats] = []
        self._before: set[str] = set()
        self._told = False

    def look(self, world: World, dt: float) -> str:
        """What to say of a dt [s] after a step, most often nothing; collective."""
        if self._told:
            return ""
        self._seen.append(world.large.velocity)
        if len(self._seen) < WINDOW:
            return ""
        seen, self._seen = self._seen, []
        rows = [row for row, body in enumerate(world.large_bodies)
                if isinstance(body.motion, (Oscillation, Path)) or _is_own(body)]  # fmt: skip
        if not rows:
            return ""
        velocity = np.array(seen)[:, rows].reshape(WINDOW, -1, 2, 3)
        found: Floats = world.comm.bcast(_frequency(np.full(WINDOW, dt), velocity).max(axis=1))
        swings = {world.large_bodies[row].name: w for row, w in zip(rows, found.tolist()) if dt * w > SLACK * TURN}
        before, self._before = self._before, set(swings)
        for name in sorted(before & set(swings)):
            self._told, w = True, swings[name]
            return (
                f"dt {dt:g} s is too large: {name} swings with about {w:.2g} rad/s, by {dt * w:.2g} rad of its phase "
                f"in a step; take at most {TURN / w:.2g} s"
            )
        return ""
