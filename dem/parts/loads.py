"""Forces and torques that a user puts on bodies, beside gravity, contacts and the drives of motions."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, ClassVar, Union

import numpy as np

from dem import bodies, checks
from dem.arrays import ArrayLike, Bools, Floats, Ints
from dem.bodies import Bodies
from dem.motion import Dynamic, Timed
from dem.parts.named import Force, Pressing
from dem.together import together

#: The time [s] and the table of n bodies at the start of a step; returns forces [N] or torques [N m], (3,) or (n, 3).
Law = Callable[[float, Bodies], ArrayLike]

#: A large body or a material of grains by its name, ids of grains, or all grains.
On = Union[str, Sequence[int], None]


@dataclass(frozen=True)
class Load(Force, Timed):
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
    BEGINS: ClassVar = "on"

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

    def refuse(self, name: str, world: Any) -> None:
        """ValueError for a load on bodies that are not there, or that no force moves."""
        if isinstance(self.on, str):
            of_name = [body for body in world.large_bodies if body.name == self.on]
            if of_name and not isinstance(of_name[0].motion, Dynamic):
                what = f"the motion of the body {self.on!r} is prescribed, so no force moves it"
                raise ValueError(f"load {name!r}: {what}")
            if bool(of_name) == (self.on in world.materials):
                kind = "both a body and a material" if of_name else "neither a body nor a material"
                raise ValueError(f"load {name!r}: {self.on!r} is {kind}")
        elif self.ids is not None and len(wrong := self.ids[(self.ids < 0) | (self.ids >= world.ids)]):
            raise ValueError(f"load {name!r}: there is no grain {wrong[0]}")

    @classmethod
    def pressing(cls, members: Mapping[str, Any], scene: Any, body: Callable[[Any], tuple[float, ...]]) -> Pressing:
        """The greatest force of loads on a grain, their sums over grains, the accelerations of these, and the pushes on
        large bodies. Laws are not known."""
        single, names, every = 0.0, {body.name for body in scene.large_bodies}, scene.expected()
        half, mass = (float(values.min()) for values in (bodies.least_half_thickness(every), every.mass))
        spread, accelerations, pushes = [], [], []
        for load in members.values():
            force, torque = (np.zeros(3) if callable(given) else np.array(given) for given in (load.force, load.torque))
            if load.on in names:
                pushes.append((load.on, force, float(np.linalg.norm(torque))))
                continue
            each = np.linalg.norm(np.atleast_2d(force), axis=1)
            single = max(single, float(each.max()), float(np.linalg.norm(np.atleast_2d(torque), axis=1).max()) / half)
            count = scene.count if load.on is None else len(load.on)
            if isinstance(load.on, str):
                number = scene.materials.index(load.on) if load.on in scene.materials else -1
                count = sum(int(np.full(part.count, part.material == number).sum()) for part in scene.parts)
            spread.append(np.array(count * force if force.ndim == 1 else force.sum(axis=0)))
            accelerations.append(scene.gravity + np.atleast_2d(force)[each.argmax()] / mass)
        return Pressing(single, tuple(spread), tuple(accelerations), tuple(pushes))

    @classmethod
    def act(cls, members: Mapping[str, Any], world: Any, applied: Any) -> None:
        for name, load in members.items():
            of_large = np.array([body.name == load.on for body in world.large_bodies], bool)
            of_one = bool(of_large.any())
            table, out = (world.large, applied.large) if of_one else (world.grains, applied.grains)
            rows = of_large if of_one else load.chosen(table, world.materials)
            call = partial(load.impulses, world.time, applied.dt, table.take(rows))
            found = together(world.comm, f"load {name!r}", call)
            out[rows] += world.comm.bcast(found) if of_one else found  # processors may round in other ways

    def chosen(self, grains: Bodies, materials: Sequence[str]) -> Ints | Bools:
        """The rows or the mask of the grains of a table that have the load."""
        if isinstance(self.on, str):
            return grains.material == materials.index(self.on)
        return np.arange(len(grains)) if self.ids is None else np.isin(grains.id, self.ids)

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
        return (self.elapsed(time + dt) - self.elapsed(time)) * out
