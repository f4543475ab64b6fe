"""How far bodies turn in a step that are no spheres: a step has to resolve it.

The angular momentum of such a body depends on its orientation, and so do the places where it touches others, or where a
joint or spring holds it. Errors are of second order in the angle of a step. Spheres may turn as fast as they will, if
they are not held beside their centres.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from operator import itemgetter
from typing import TYPE_CHECKING, Any

import numpy as np

from dem import bodies
from dem.arrays import Floats
from dem.exchange import greatest
from dem.parts.ends import Tie
from dem.shapes import Sphere

if TYPE_CHECKING:
    from dem.model.world import World
    from dem.scene import LargeBody

TURN = 0.2  #: the greatest angle [rad] by which bodies that are no spheres should turn in a step
SLACK = 1.1  #: times that is told: a body that tumbles freely turns faster at times
STEADY = 5  #: steps after each other in which the same body does so before it is told: what it hits may stop it sooner


def turning_of_large(table: bodies.Bodies, members: Sequence[LargeBody]) -> Floats:
    """`dem.bodies.turning` of the large bodies of a table (n,) [rad/s]; zero of balls about their centres of mass."""
    speeds = bodies.turning(table)
    for row in speeds.nonzero()[0].tolist():
        if _is_ball(members[row]):
            speeds[row] = 0.0
    return speeds


def held_beside(named: Mapping[str, Mapping[str, Any]]) -> list[int]:
    """The ids of the grains that joints and springs among these parts hold beside their centres."""
    ties = [tie for members in named.values() for tie in members.values() if isinstance(tie, Tie)]
    ends = [(end, np.any(anchor)) for tie in ties for end, anchor in zip(tie.ends, tie.anchors)]
    return sorted({end for end, beside in ends if isinstance(end, int) and beside})


def turning_of_grains(grains: bodies.Bodies, held: Sequence[int]) -> Floats:
    """`dem.bodies.turning` of grains (n,), also of spheres whose ids are among those `held_beside` [rad/s]."""
    speeds = bodies.turning(grains)
    if held:
        rows = np.isin(grains.id, held).nonzero()[0]
        speeds[rows] = np.linalg.norm(grains.velocity[rows, 3:], axis=1)
    return speeds


def _is_ball(body: LargeBody) -> bool:
    balls = all(isinstance(shape, Sphere) and not np.any(shape.center) for shape in body.shapes)
    return balls and bool(body.inertia.min() >= (1.0 - 1e-9) * body.inertia.max())  # inf of bodies that do not move


class TurnWatch:
    """Tells once of a body that turns too far in a step: at the start, or later in STEADY steps after each other."""

    def __init__(self) -> None:
        self._times, self._last, self._told = STEADY - 1, -1, False
        self._held: list[int] | None = None

    def look(self, world: World, dt: float) -> str:
        """What to say of a dt [s] for the world as it is now, most often nothing; collective."""
        if self._held is None:
            self._held = held_beside(world.named)
        if self._told or not (world.turns_unlike_spheres or self._held):
            return ""
        tables = [(turning_of_grains(world.grains, self._held), world.grains.id)]
        if world.large_moves:
            tables.append((turning_of_large(world.large, world.large_bodies), world.large.id))
        fastest = [(float(speeds.max()), int(ids[speeds.argmax()])) for speeds, ids in tables if len(ids)]
        speed, id = greatest(world.comm, max(fastest, key=itemgetter(0), default=(0.0, -1)))
        again = self._times + 1 if self._last in (-1, id) else 1
        self._times = again if dt * speed > SLACK * TURN else 0
        self._last = id
        self._told = self._times >= STEADY
        if not self._told:
            return ""
        angle, most = dt * speed, TURN / speed
        return (
            f"dt {dt:g} s is too large: {world.name_of(id)} turns by {angle:.2g} rad in a step, and errors are of the "
            f"square of that; take at most {most:.2g} s"
        )
