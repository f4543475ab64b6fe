"""The state of a simulation on one rank."""

from __future__ import annotations

from dataclasses import dataclass, field
from operator import attrgetter
from typing import Any

import numpy as np
from mpi4py import MPI

from dem import bodies
from dem.arrays import Floats, Ints, Keys
from dem.bodies import Bodies
from dem.motion import Dynamic, Pose
from dem.parts.cell import OPEN, Cell
from dem.parts.contact_law import ContactLaw
from dem.parts.passages import Passages
from dem.scene import LargeBody, no_parts
from dem.shapes.forms import Form
from dem.together import together

#: The fields of a world that a step changes; what these refer to is replaced, and never changed in place.
STATE = (
    "grains", "large", "slabs", "only_spheres", "any_spheres", "lists", "memory", "cell", "passages", "time", "step",
    "spare", "owned",
)  # fmt: skip
_state_of = attrgetter(*STATE)


@dataclass(repr=False)
class World:
    """Bodies, materials and time.

    The global index of a body, which is its block row in matrices and vectors, counts the grains in the order
    of the ranks' slabs and then the large bodies. Large bodies are the same on all ranks; their rows belong
    to the last rank.
    """

    comm: MPI.Comm
    large_bodies: tuple[LargeBody, ...]
    gravity: Floats  #: (3,) [m/s^2]
    pairs: ContactLaw  #: tables of the coefficients of contacts, by pair of materials
    materials: tuple[str, ...]  #: their names; the column `material` of a table of bodies is an index into them
    grains: Bodies  #: the slab of this rank; replace it by `set_grains` only
    large: Bodies  #: one row per large body
    #: parts by kind and name, see `dem.scene.KINDS`; `dem.model.changes.change` alone changes them
    named: dict[str, dict[str, Any]] = field(default_factory=no_parts)
    #: pairs of ids, the lower + 1j the upper, of bodies at the ends of a part that do not touch each other
    apart: Keys = field(default_factory=lambda: np.zeros(0, complex))
    cell: Cell = OPEN
    passages: Passages = field(default_factory=Passages)  #: where grains come and go
    forms: tuple[Form, ...] = ()  #: shapes of grains, by their numbers
    initial: int = 0  #: number of grains at time zero
    first_large: int = 0  #: id of the first large body
    time: float = 0.0  #: [s]
    step: int = 0  #: number of steps done
    spare: float = 3000.0  #: iterations that steps at rest may spend beyond the limits of the solver, `pctt.run.rest`
    slabs: Ints = field(init=False)  #: (size + 1,) global index of the first grain of each rank, and the end
    only_spheres: bool = field(init=False)  #: whether all grains, of all ranks, are spheres
    any_spheres: bool = field(init=False)  #: whether any is one
    #: number of bodies whose rows this rank owns: its grains, and on the last rank the large bodies
    owned: int = field(init=False)
    large_moves: bool = field(init=False)  #: whether forces move any large body

    #: Kinds and names of the parts and large bodies that a run has changed by `dem.model.changes.change`.
    changed: set[tuple[str, str]] = field(init=False, default_factory=set)

    lists: Any = field(init=False, repr=False, default=None)  #: the `dem.contact.lists.Lists` of the last search

    #: What parts of a kind, by its name, hand from the last step to the next: (parts, `dem.parts.named.Force.MEMORY`).
    memory: dict[str, Floats] = field(init=False, default_factory=dict)

    def __post_init__(self) -> None:
        self.set_grains(self.grains)
        self._set_large(self.large_bodies)

    def _set_large(self, large_bodies: tuple[LargeBody, ...]) -> None:
        self.large_bodies = large_bodies
        self.large_moves = any(isinstance(body.motion, Dynamic) for body in large_bodies)

    def trial(self) -> World:
        """A world that a step may change: this one stays as it is until it takes its state."""
        other = object.__new__(type(self))
        vars(other).update(vars(self))
        other.grains, other.large = self.grains.copy(), self.large.copy()
        return other

    def take(self, trial: World) -> None:
        """Take the state to which a step has brought a trial."""
        vars(self).update(zip(STATE, _state_of(trial)))

    def state(self) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
        """Arrays from which `dem.start.restored_world` makes this world again: rows of local grains, and replicated
        ones."""
        replicated = {f"large_{name}": column for name, column in self.large.columns().items()}
        replicated.update(slabs=self.slabs, time=np.array(self.time), step=np.array(self.step))
        replicated.update({f"memory_{kind}": array for kind, array in self.memory.items()})
        replicated["spare"] = np.array(self.spare)
        return self.grains.columns(), replicated | self.passages.state() | self.cell.state()

    def set_grains(self, grains: Bodies) -> None:
        """Replace the slab of this rank; collective."""
        self.grains, self.lists = grains, None
        self.owned = len(grains) + (len(self.large) if self.comm.rank == self.comm.size - 1 else 0)
        everyone, balls = np.zeros((self.comm.size + 1, 2), np.int64), np.count_nonzero(grains.shape == bodies.SPHERE)
        self.comm.Allgather(np.array([len(grains), balls], np.int64), everyone[1:])
        self.slabs = np.cumsum(everyone[:, 0])
        self.only_spheres, self.any_spheres = bool((everyone[:, 0] == everyone[:, 1]).all()), bool(everyone[:, 1].any())

    @property
    def ids(self) -> int:
        """Number of grains that there have been; their ids are less."""
        return self.initial + self.passages.inserted_count

    def __repr__(self) -> str:
        return f"<World: {self.body_count} bodies, {len(self.grains)} grains of this rank, time {self.time:g} s>"

    @property
    def body_count(self) -> int:
        """Number of bodies on all ranks."""
        return int(self.slabs[-1]) + len(self.large)

    @property
    def turns_unlike_spheres(self) -> bool:
        """Whether a body that turns freely may do so in another way than a sphere; the same on all ranks."""
        return not self.only_spheres or (self.large_moves and bool(np.isfinite(self.large.inertia).all(axis=1).any()))

    def large_row(self, name: str) -> int:
        """Row of a large body in `large`; KeyError if there is none of that name."""
        names = [body.name for body in self.large_bodies]
        if name not in names:
            raise KeyError(f"no large body {name!r}; there are: {', '.join(names) or 'none'}")
        return names.index(name)

    def name_of(self, id: int) -> str:
        """What messages call the body of this id."""
        first = self.first_large
        return f"grain {id}" if id < first else f"body {self.large_bodies[id - first].name!r}"

    def replace_large(self, body: LargeBody) -> None:
        """Put this large body in the place of that of its name; the same on all ranks."""
        row = self.large_row(body.name)
        self._set_large((*self.large_bodies[:row], body, *self.large_bodies[row + 1 :]))
        self.changed.add(("body", body.name))

    def poses(self, time: float) -> dict[int, Pose]:
        """Places (3,) and quaternions (4,) of the large bodies of prescribed motion at `time` [s], by row; collective.
        SceneError if a motion fails."""
        return together(self.comm, "motion of a large body", lambda: {
            row: body.pose(time)
            for row, body in enumerate(self.large_bodies) if not isinstance(body.motion, Dynamic)
        })  # fmt: skip

    def put_large(self, poses: dict[int, Pose]) -> None:
        """Put large bodies, by row, into these poses."""
        for row, pose in poses.items():
            self.large.position[row], self.large.quaternion[row] = pose
