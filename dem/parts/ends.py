"""Parts between two bodies, or between a body and the world, and those of them that hold these bodies."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple, Union

import numpy as np

from dem import checks
from dem.arrays import Floats, Ints
from dem.motion import Dynamic
from dem.parts.named import Named
from dem.quaternion import cross

if TYPE_CHECKING:
    from dem.parts.cell import Cell

HELD, MOTOR, LOWER, UPPER = range(4)  #: kinds of conditions: what is held, a motor, limits

#: A large body by its name, a grain by its id, or the world.
End = Union[str, int, None]


@dataclass(frozen=True)
class Tie(Named):
    """A part between two bodies. Anchors are in the frames of its bodies, or places in the world."""

    ends: tuple[End, End]
    anchors: Sequence[Sequence[float]]  #: (2, 3) [m]
    touching = True  #: whether its two bodies also touch each other

    def __post_init__(self) -> None:
        kind = type(self).__name__.lower()
        ends = tuple(end if end is None or isinstance(end, str) else int(end) for end in self.ends)
        if ends[0] == ends[1]:
            raise ValueError(f"both ends of a {kind} are at {ends[0]}: allowed are two bodies, or a body and the world")
        anchors = tuple(tuple(checks.vector(f"anchor of a {kind}", anchor).tolist()) for anchor in self.anchors)
        object.__setattr__(self, "ends", ends)
        object.__setattr__(self, "anchors", anchors)

    def refuse(self, name: str, world: Any) -> None:
        """ValueError for a tie of bodies that no force moves, which would do nothing, and of grains beside outlets."""
        kind, motion = type(self).__name__.lower(), {body.name: body.motion for body in world.large_bodies}
        if not any(isinstance(end, int) or isinstance(motion.get(end), Dynamic) for end in self.ends):
            ends = " and ".join("the world" if end is None else repr(end) for end in self.ends)
            what = f"{kind} {name!r}: the motions of {ends} are prescribed, so it holds nothing"
            raise ValueError(f"{what}; allowed is one body at least that forces move, by Dynamic() say")
        if world.passages.removes and any(isinstance(end, int) for end in self.ends):
            raise ValueError(f"{kind} {name!r} holds a grain: with outlets {kind}s may hold large bodies alone")


class Geometry(NamedTuple):
    """n constraints as they are."""

    arms: Floats  #: (n, 2, 3) from the ends to where they are held together, as the first of them sees it [m]
    error: Floats  #: (n, 6) coordinates: translations [m] and turns [rad] of the second end relative to the first
    axes: Floats  #: (n, 3, 3) rows x, y, z in the world

    @property
    def rows(self) -> Floats:
        """(n, 6, 2, 6) from velocities of the ends to relative ones along, and about, the three axes."""
        out = np.zeros((len(self.axes), 6, 2, 6))
        for k, sign in ((0, -1.0), (1, 1.0)):
            out[:, :3, k, :3] = out[:, 3:, k, 3:] = sign * self.axes
            out[:, :3, k, 3:] = sign * cross(self.arms[:, k, None], self.axes)
        return out


#: A function of positions (bodies, 3) [m] and quaternions (bodies, 4).
Place = Callable[[Floats, Floats], Geometry]


class Condition(NamedTuple):
    """What a constraint asks of one of its six relative velocities."""

    coordinate: int  #: which of the six
    kind: int  #: HELD, MOTOR, LOWER or UPPER
    target: float  #: [m/s, rad/s]
    bound: float = np.inf  #: greatest impulse of a motor
    way: float = np.inf  #: to where a motor stops [m, rad]; inf: nowhere


class Constraint(Tie):
    """A part whose impulses follow from what it asks of relative velocities of its bodies, together with those of all
    contacts; see `dem.unconstrained.constraints`."""

    @classmethod
    def geometry(cls, members: Sequence[Any], row: Ints, cell: Cell) -> Place:
        """Of n parts of the kind between bodies in the rows `row` (n, 2) what their places make of them. The second
        ends are those images in the cell whose anchors are nearest to the first ones."""
        raise NotImplementedError

    def conditions(self, error: Floats, dt: float) -> list[Condition]:
        """What it asks in a step of dt [s] that begins with these coordinates (6,)."""
        raise NotImplementedError


class Ends(NamedTuple):
    """The n bodies at the ends of parts: grains, then all large bodies, and the world as the last row."""

    ids: Ints  #: of the grains, in ascending order
    row: Ints  #: (parts, 2) of their ends
    position: Floats  #: (n, 3) [m]
    quaternion: Floats  #: (n, 4)
    velocity: Floats  #: (n, 6) before the step
    free: Floats  #: (n, 6) after the step, without contacts, drives and what is not yet applied [m/s, rad/s]
    root: Floats  #: (n, 6, 6) M^-1/2
    moments: Floats  #: (n, 3) principal moments of inertia, inf: it does not turn freely [kg m^2]
    spin_change: Floats  #: (n, 3) what is applied changes of the angular velocities in `free` [rad/s]

    @property
    def inverse_mass(self) -> Floats:
        """(n, 6, 6)"""
        return self.root @ self.root
