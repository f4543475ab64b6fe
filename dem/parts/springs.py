"""Springs and dampers between bodies, or between a body and the world.

A spring of length l between two anchors pulls them together with the force k (l - L) + c l', along the line between
them; with the rest length L = 0 the force is k d + c d' for the vector d between them, in all directions. In a step

    g = -dt (k (1 - L / l) d + c P (d'_old + d'_new) / 2)

is the impulse on the second anchor, with l and d at the start of the step, the rates d' = J v of the velocities before
the step and after it but without contacts and drives, and P the projector on the line. The velocities are those of the
middles of steps. So the force of the spring is explicit, and that of the damper the mean of both rates; both are of
second order, and no step takes or gives energy but by damping, as long as dt is below 2 / w with w the highest
frequency of the springs (Hairer, Lubich, Wanner, "Geometric numerical integration illustrated by the Stoermer-Verlet
method", Acta Numerica 12 (2003)). Springs whose bodies meet in chains are solved together, by dense factors.

What contacts and drives did to the velocities in the last step is added to d'_new. So the damper of a body that a floor
bears does not see it fall, and what a damper misses in the step of an impact it takes in the next.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from dem import checks, quaternion
from dem.arrays import Floats
from dem.parts.ends import End, Ends, Tie
from dem.parts.named import Force, Pressing
from dem.together import SceneError

RESOLVED = 0.2  #: the step times the highest frequency of springs; 2 is their limit


@dataclass(frozen=True)
class Spring(Tie, Force):
    """A spring with a damper. Anchors are in the frames of their bodies, or places in the world."""

    stiffness: float = 0.0  #: [N/m]
    damping: float = 0.0  #: [N s/m]
    length: float = 0.0  #: at rest [m]
    CHANGED: ClassVar = ("stiffness", "damping", "length")
    KEPT: ClassVar = CHANGED
    MEMORY: ClassVar = 15  #: its impulse (3,) on the second end, and velocities (2, 6) that the ends were to have

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("stiffness", "damping", "length"):
            object.__setattr__(self, name, float(checks.not_negative(f"{name} of a spring", getattr(self, name))))

    def vector(self, what: str, scene: Any) -> Floats:
        """The vector (3,) from the first anchor to the second in a scene at time zero [m]."""
        poses = [scene.pose(what, end) for end in self.ends]
        one, two = (place + quaternion.rotate(turn, np.array(at)) for (place, turn), at in zip(poses, self.anchors))
        between: Floats = two - one
        return between

    def refuse(self, name: str, world: Any) -> None:
        super().refuse(name, world)
        if world.cell.periodic:
            raise ValueError(f"spring {name!r}: springs have no images, so periods allow none")

    @classmethod
    def pressing(cls, members: Mapping[str, Any], scene: Any, body: Callable[[Any], tuple[float, ...]]) -> Pressing:
        """The greatest force on a body, what springs let meet, and a time step for a bound of their frequencies, see
        `impulses`."""
        ends: dict[End, list[tuple[float, float, float]]] = {}
        impacts = []
        for spring in members.values():
            stretch = abs(float(np.linalg.norm(spring.vector("spring", scene))) - spring.length)
            force, light = spring.stiffness * stretch, 0.0
            for end, at in zip(spring.ends, spring.anchors):
                ends.setdefault(end, []).append((force, math.sqrt(spring.stiffness), math.hypot(*at)))
                light += 1.0 / body(end)[0]
            if light > 0.0 and force > 0.0:
                damped = force / spring.damping if spring.damping > 0.0 else np.inf
                impacts.append((1.0 / light, min(stretch * math.sqrt(spring.stiffness * light), damped)))
        greatest, square = 0.0, 0.0
        for end, held in ends.items():
            mass, moment, _ = body(end)
            pull, root, arm = np.array(held).T
            greatest = max(greatest, float(pull.sum()))
            square = max(square, float((root * (root.sum() / mass + arm * (root @ arm) / moment)).max()))
        highest = math.sqrt(2.0 * square)
        steps = ((f"springs of {highest:.3g} rad/s", RESOLVED / highest),) if highest > 0.0 else ()
        return Pressing(greatest, impacts=tuple(impacts), steps=steps)

    @classmethod
    def act(cls, members: Mapping[str, Any], world: Any, applied: Any) -> Floats:
        ends, dt, before = applied.ends(world, members), applied.dt, world.memory.get("spring")
        expected = None if before is None else before[:, 3:].reshape(-1, 2, 6)
        given = list(members.values()), ends, expected, dt
        found = impulses(*given) if world.comm.rank == 0 else None
        g, change, expected, highest = world.comm.bcast(found)  # processors may round in other ways
        if dt * highest >= 2.0:
            raise SceneError(
                f"the springs {', '.join(members)[:200]} have frequencies up to {highest:.3g} rad/s: dt {dt:g} s is "
                f"too large for them; take less than {2.0 / highest:.3g} s, and a tenth of that to resolve them"
            )
        applied.add(world, ends, change)
        return np.concatenate([g, expected.reshape(-1, 12)], axis=1)


def vectors(springs: Sequence[Spring], ends: Ends) -> tuple[Floats, Floats]:
    """Arms (2, s, 3) from the centres of the bodies to the anchors, and the vectors (s, 3) from the first anchors to
    the second [m]."""
    row, anchors = ends.row, np.array([spring.anchors for spring in springs])
    arm = np.array([quaternion.rotate(ends.quaternion[row[:, k]], anchors[:, k]) for k in (0, 1)])
    return arm, ends.position[row[:, 1]] + arm[1] - ends.position[row[:, 0]] - arm[0]


def impulses(
    springs: Sequence[Spring], ends: Ends, expected: Floats | None, dt: float
) -> tuple[Floats, Floats, Floats, float]:
    """Of springs between these ends: impulses (s, 3) on the second anchors over a step of dt [s], impulses and angular
    impulses (n, 6) on the bodies, the velocities (s, 2, 6) that the ends are expected to have after it without contacts
    and drives, and the bound w [1/s] of the frequencies. `expected` (s, 2, 6): those of the last step, None if there
    was none."""
    numbers = [(spring.stiffness, spring.damping, spring.length) for spring in springs]
    k, c, rest = np.array(numbers).T
    arm, d = vectors(springs, ends)
    row, many = ends.row, len(springs)
    A = np.zeros((many, 2, 3, 6))  # from velocities of the ends to rates of d
    for side, sign in ((0, -1.0), (1, 1.0)):
        A[:, side, :, :3] = sign * np.eye(3)
        A[:, side, :, 3:] = sign * np.cross(np.eye(3), arm[side][:, None, :]).transpose(0, 2, 1)  # w x r
    mobility = np.zeros((many, many, 3, 3))  # J M^-1 J', of springs that share a body
    one, other, at, by = np.nonzero(row[:, None, :, None] == row[None, :, None, :])
    shared = ends.inverse_mass[row[one, at]]
    np.add.at(mobility, (one, other), A[one, at] @ shared @ A[other, by].transpose(0, 2, 1))
    root = np.sqrt(k)
    highest = (np.abs(mobility) * (root[:, None] * root)[:, :, None, None]).sum(axis=(1, 3)).max(initial=0.0)
    length = quaternion.length(d)
    along = d / np.maximum(length, 1e-300)[:, None]
    P = np.where((rest > 0.0)[:, None, None], along[:, :, None] * along[:, None, :], np.eye(3))
    g = -dt * k[:, None] * (d - rest[:, None] * along)
    if c.any():
        twice = ends.velocity[row] + ends.free[row]
        if expected is not None:
            twice += ends.velocity[row] - expected
        half = 0.5 * dt * c[:, None, None] * P
        matrix = np.eye(3 * many) + (half[:, None] @ mobility).transpose(0, 2, 1, 3).reshape(3 * many, 3 * many)
        right = g - np.einsum("sij,skjx,skx->si", half, A, twice)
        g = np.linalg.solve(matrix, right.ravel()).reshape(many, 3)
    change = np.zeros_like(ends.velocity)
    np.add.at(change, row, np.einsum("skix,si->skx", A, g))
    velocity = ends.free + np.einsum("nxy,ny->nx", ends.inverse_mass, change)
    return g, change, velocity[row], float(np.sqrt(highest))
