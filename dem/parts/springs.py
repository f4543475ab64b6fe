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

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, Union

import numpy as np

from dem import checks, quaternion
from dem.arrays import Floats
from dem.parts.named import Named

#: A large body by its name, a grain by its id, or the world.
End = Union[str, int, None]


@dataclass(frozen=True)
class Spring(Named):
    """A spring with a damper. Anchors are in the frames of their bodies, or places in the world."""

    ends: tuple[End, End]
    anchors: Sequence[Sequence[float]]  #: (2, 3) [m]
    stiffness: float = 0.0  #: [N/m]
    damping: float = 0.0  #: [N s/m]
    length: float = 0.0  #: at rest [m]
    CHANGED: ClassVar = ("stiffness", "damping", "length")
    KEPT: ClassVar = CHANGED

    def __post_init__(self) -> None:
        ends = tuple(end if end is None or isinstance(end, str) else int(end) for end in self.ends)
        if ends[0] == ends[1]:
            raise ValueError(f"both ends of a spring are at {ends[0]}: allowed are two bodies, or a body and the world")
        anchors = tuple(tuple(checks.vector("anchor of a spring", anchor).tolist()) for anchor in self.anchors)
        object.__setattr__(self, "ends", ends)
        object.__setattr__(self, "anchors", anchors)
        for name in ("stiffness", "damping", "length"):
            object.__setattr__(self, name, float(checks.not_negative(f"{name} of a spring", getattr(self, name))))


@dataclass(frozen=True)
class Ends:
    """The bodies at the ends of springs, and the world as the last row."""

    position: Floats  #: (n, 3) [m]
    quaternion: Floats  #: (n, 4)
    velocity: Floats  #: (n, 6) before the step
    free: Floats  #: (n, 6) after the step, without contacts, springs and drives [m/s, rad/s]
    inverse_mass: Floats  #: (n, 6, 6)
    moments: Floats  #: (n, 3) principal moments of inertia, inf: it does not turn freely [kg m^2]
    given: Floats  #: (n, 3) what loads and springs change of the angular velocities in `free` [rad/s]


def vectors(springs: list[Spring], row: np.ndarray, ends: Ends) -> tuple[Floats, Floats]:
    """Arms (2, s, 3) from the centres of the bodies in the rows `row` (s, 2) to the anchors, and the vectors (s, 3)
    from the first anchors to the second [m]."""
    anchors = np.array([spring.anchors for spring in springs])
    arm = np.array([quaternion.rotate(ends.quaternion[row[:, k]], anchors[:, k]) for k in (0, 1)])
    return arm, ends.position[row[:, 1]] + arm[1] - ends.position[row[:, 0]] - arm[0]


def impulses(
    springs: list[Spring], row: np.ndarray, ends: Ends, expected: Floats | None, dt: float
) -> tuple[Floats, Floats, Floats, float]:
    """Of springs between bodies in the rows `row` (s, 2): impulses (s, 3) on the second anchors over a step of dt [s],
    impulses and angular impulses (n, 6) on the bodies, the velocities (s, 2, 6) that the ends are expected to have
    after it without contacts and drives, and the bound w [1/s] of the frequencies. `expected` (s, 2, 6): those of the
    last step, None if there was none."""
    numbers = [(spring.stiffness, spring.damping, spring.length) for spring in springs]
    k, c, rest = np.array(numbers).T
    arm, d = vectors(springs, row, ends)
    many = len(springs)
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
