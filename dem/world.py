"""The state of a simulation on one rank."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from mpi4py import MPI

from dem import bodies
from dem.arrays import Floats, Ints
from dem.bodies import Bodies
from dem.contact import find_contacts
from dem.motion import Dynamic, mean_velocity
from dem.partition import redistribute
from dem.scene import LargeBody, Scene
from dem.together import together


@dataclass
class World:
    """Bodies, materials and time.

    The global index of a body, which is its block row in matrices and vectors, counts the grains in the order
    of the ranks' slabs and then the large bodies. Large bodies are the same on all ranks; their rows belong
    to the last rank.
    """

    comm: MPI.Comm
    large_bodies: tuple[LargeBody, ...]
    gravity: Floats  #: (3,) [m/s^2]
    friction: Floats  #: (materials, materials)
    grains: Bodies  #: the slab of this rank; replace it by `set_grains` only
    large: Bodies  #: one row per large body
    time: float = 0.0  #: [s]
    step: int = 0  #: number of steps done
    slabs: Ints = field(init=False)  #: (size + 1,) global index of the first grain of each rank, and the end
    only_spheres: bool = field(init=False)  #: whether all grains, of all ranks, are spheres

    _followed: tuple[tuple[float, float], dict[int, Floats]] = field(
        init=False, repr=False, default_factory=lambda: ((np.nan, np.nan), {})
    )  #: time and dt [s] of the last question for the velocities of prescribed motions, and the answer

    def __post_init__(self) -> None:
        self.set_grains(self.grains)

    @classmethod
    def from_scene(cls, scene: Scene, comm: MPI.Comm, overlap: float = 0.01) -> World:
        """The scene at time zero, distributed; collective.

        ValueError if there is no grain, or if grains overlap each other or a large body by more than `overlap`
        radii.
        """
        grains = scene.grains()
        world = _share(scene, comm, grains.take(_even_slice(len(grains), comm)))
        redistribute(world)
        _refuse_overlap(world, overlap)
        return world

    @classmethod
    def restore(
        cls,
        scene: Scene,
        comm: MPI.Comm,
        local: Mapping[str, np.ndarray],
        replicated: Mapping[str, np.ndarray],
    ) -> World:
        """The world whose `state` was taken, for the same scene; collective.

        `local`: the rows `restart_rows` of every local array. On the number of ranks of the state, the
        restored world is the same to the last bit; on another number, the grains are distributed anew.
        """
        world = _share(scene, comm, Bodies(**{name: np.array(column) for name, column in local.items()}))
        count = len(scene.grains())
        prefix = "large_"
        large = {
            name[len(prefix) :]: np.array(replicated[name]) for name in replicated if name.startswith(prefix)
        }
        if world.slabs[-1] != count or len(large["id"]) != len(world.large):
            raise ValueError(
                f"the state has {world.slabs[-1]} grains and {len(large['id'])} large bodies, "
                f"the scene {count} and {len(world.large)}"
            )
        world.large = Bodies(**large)
        world.time, world.step = float(replicated["time"]), int(replicated["step"])
        if len(replicated["slabs"]) != comm.size + 1:
            redistribute(world)
        return world

    def state(self) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
        """Arrays from which `restore` makes this world again: rows of local grains, and replicated ones."""
        replicated = {f"large_{name}": column for name, column in self.large.columns().items()}
        replicated.update(slabs=self.slabs, time=np.array(self.time), step=np.array(self.step))
        return self.grains.columns(), replicated

    def set_grains(self, grains: Bodies) -> None:
        """Replace the slab of this rank; collective."""
        self.grains = grains
        counts, spheres = zip(*self.comm.allgather((len(grains), bool((grains.shape == bodies.SPHERE).all()))))
        self.slabs = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
        self.only_spheres = all(spheres)

    @property
    def body_count(self) -> int:
        """Number of bodies on all ranks."""
        return int(self.slabs[-1]) + len(self.large)

    @property
    def owned(self) -> int:
        """Number of bodies whose rows this rank owns: its grains, and on the last rank the large bodies."""
        return len(self.grains) + (len(self.large) if self.comm.rank == self.comm.size - 1 else 0)

    def large_row(self, name: str) -> int:
        """Row of a large body in `large`; KeyError if there is none of that name."""
        names = [body.name for body in self.large_bodies]
        if name not in names:
            raise KeyError(f"no large body {name!r}; there are: {', '.join(names) or 'none'}")
        return names.index(name)

    def prescribed_velocity(self, dt: float) -> Floats:
        """Velocities (large bodies, 6) over the next step of `dt` [s]; dynamic bodies keep theirs; collective.
        SceneError if a motion fails."""
        if self._followed[0] != (self.time, dt):  # a step asks several times
            self._followed = (self.time, dt), together(self.comm, "motion of a large body", lambda: self._follow(dt))
        velocity = self.large.velocity.copy()
        for row, mean in self._followed[1].items():
            velocity[row] = mean
        return velocity

    def _follow(self, dt: float) -> dict[int, Floats]:
        """The mean velocities (6,) of the bodies of prescribed motion over the next step, by row."""
        return {
            row: mean_velocity(body.motion, self.time, dt, body.position, body.quaternion)
            for row, body in enumerate(self.large_bodies)
            if not isinstance(body.motion, Dynamic)
        }


def restart_rows(slabs: Ints, comm: MPI.Comm) -> slice:
    """Rows of a whole state's grain arrays that this rank hands to `World.restore`; slabs as in the state."""
    if len(slabs) == comm.size + 1:
        return slice(int(slabs[comm.rank]), int(slabs[comm.rank + 1]))
    return _even_slice(int(slabs[-1]), comm)


def _even_slice(count: int, comm: MPI.Comm) -> slice:
    return slice(count * comm.rank // comm.size, count * (comm.rank + 1) // comm.size)


def _share(scene: Scene, comm: MPI.Comm, grains: Bodies) -> World:
    return World(
        comm, tuple(scene.large_bodies), scene.gravity, scene.friction_table(), grains, scene.large()
    )


def _refuse_overlap(world: World, overlap: float) -> None:
    """ValueError, on all ranks, that names the worst pair if bodies overlap by more than `overlap` radii."""
    contacts = find_contacts(world, 0.0)
    world.grains.weight[:] = 0.0
    table = contacts.near.bodies
    worst = (0.0, 0.0, -1, -1)
    if len(contacts):
        radius = bodies.bounding_radius(table)
        radius[table.shape == bodies.COMPOUND] = np.inf
        relative = -contacts.gap / np.minimum(radius[contacts.a], radius[contacts.b])
        c = int(np.argmax(relative))
        a, b = int(table.id[contacts.a[c]]), int(table.id[contacts.b[c]])
        worst = (float(relative[c]), float(-contacts.gap[c]), a, b)
    relative_depth, depth, a, b = world.comm.allreduce(worst, MPI.MAX)
    if relative_depth > overlap:
        names = [
            f"grain {i}" if i < world.slabs[-1] else f"body {world.large_bodies[i - world.slabs[-1]].name!r}"
            for i in (a, b)
        ]
        raise ValueError(f"overlapping start: {names[0]} and {names[1]} overlap by {depth:g} m")
