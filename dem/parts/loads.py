"""Forces and torques that a user puts on bodies, beside gravity, contacts and the drives of motions."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import ClassVar, Union

import numpy as np

from dem import checks
from dem.arrays import ArrayLike, Floats, Ints
from dem.bodies import Bodies
from dem.motion import Timed
from dem.parts.named import Named

#: The time [s] and the table of n bodies at the start of a step; returns forces [N] or torques [N m], (3,) or (n, 3).
Law = Callable[[float, Bodies], ArrayLike]

#: A large body or a material of grains by its name, ids of grains, or all grains.
On = Union[str, Sequence[int], None]


@dataclass(frozen=True)
class Load(Named, Timed):
    """A force at the centre of mass, and a torque, on each of some bodies from one time to another, in the world frame.

    Both are numbers (3,) for each body or, of ids, rows (ids, 3) in their order; or a `Law` of the time and the state
    of the bodies. Each rank asks a law for its own grains, in any order, so that it must treat each row alike.
    """

    on: On
    force: ArrayLike | Law = (0.0, 0.0, 0.0)  #: [N]
    torque: ArrayLike | Law = (0.0, 0.0, 0.0)  #: [N m]
    start: float = 0.0  #: [s]
    end: float = np.inf  #: [s]
    CHANGED: ClassVar = ("on", "force", "torque", "start", "end")
    KEPT: ClassVar = CHANGED

    def __post_init__(self) -> None:
        self._check_times()
        if not (self.on is None or isinstance(self.on, str)):
            ids = np.asarray(self.on)
            if ids.ndim != 1 or ids.dtype.kind not in "iu" or len(np.unique(ids)) < len(ids):
                raise ValueError("the bodies of a load are ids of grains, each once, the name of a body or a material")
            object.__setattr__(self, "on", tuple(ids.tolist()))
        for name in ("force", "torque"):
            value = getattr(self, name)
            if not callable(value):
                array = checks.finite(f"{name} of a load", value)
                rows = None if self.ids is None else (len(self.ids), 3)
                if array.shape not in ((3,), rows):
                    allowed = "(3,)" if rows is None else f"(3,) or {rows}"
                    raise ValueError(f"{name} of a load must have shape {allowed}, got {array.shape}")
                object.__setattr__(self, name, array)

    @property
    def ids(self) -> Ints | None:
        """The ids (n,) of a load on these."""
        return None if self.on is None or isinstance(self.on, str) else np.array(self.on, np.int64)

    def impulses(self, time: float, dt: float, table: Bodies) -> Floats:
        """Impulses and angular impulses (n, 6) from `time` to `time + dt` [s] on n of its bodies, as they are at
        `time`. ValueError for what is none."""
        place = np.zeros(len(table), np.int64)
        if self.ids is not None:
            order = np.argsort(self.ids)
            place = order[np.searchsorted(self.ids, table.id, sorter=order)]
        out = np.empty((len(table), 6))
        for part, name in ((slice(0, 3), "force"), (slice(3, 6), "torque")):
            value = getattr(self, name)
            if callable(value):
                out[:, part] = checks.rows(f"the {name} that a load returns", value(time, table), len(table), 3)
            else:
                out[:, part] = value if value.ndim == 1 else value[place]
        return (self.gone(time + dt) - self.gone(time)) * out
