"""Parts between two bodies, or between a body and the world."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Union

import numpy as np

from dem import checks, quaternion
from dem.arrays import Floats, Ints
from dem.parts.named import Named

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
        if world.outlets and any(isinstance(end, int) for end in self.ends):
            kind = type(self).__name__.lower()
            raise ValueError(f"{kind} {name!r} holds a grain: with outlets {kind}s may hold large bodies alone")

    def vector(self, what: str, scene: Any) -> Floats:
        """The vector (3,) from the first anchor to the second in a scene at time zero [m]."""
        poses = [scene.pose(what, end) for end in self.ends]
        one, two = (place + quaternion.rotate(turn, np.array(at)) for (place, turn), at in zip(poses, self.anchors))
        between: Floats = two - one
        return between


class Ends(NamedTuple):
    """The n bodies at the ends of parts: grains, then all large bodies, and the world as the last row."""

    ids: Ints  #: of the grains, in ascending order
    row: Ints  #: (parts, 2) of their ends
    position: Floats  #: (n, 3) [m]
    quaternion: Floats  #: (n, 4)
    velocity: Floats  #: (n, 6) before the step
    free: Floats  #: (n, 6) after the step, without contacts, drives and what is not yet applied [m/s, rad/s]
    inverse_mass: Floats  #: (n, 6, 6)
    moments: Floats  #: (n, 3) principal moments of inertia, inf: it does not turn freely [kg m^2]
    given: Floats  #: (n, 3) what is applied changes of the angular velocities in `free` [rad/s]
