"""The state of a simulation on one rank, and changes of the motion of large bodies within a run.

The functions of a change are called on all ranks alike, with the same arguments.
"""

from __future__ import annotations

import dataclasses
import json
from copy import copy
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from mpi4py import MPI

from dem import bodies, checks, joints, loads, quaternion, sources, springs
from dem import motion as motions
from dem.arrays import Floats, Ints
from dem.bodies import Bodies
from dem.clumps import Form
from dem.joints import Joint
from dem.loads import Load, On
from dem.motion import Dynamic, Motion, Pose, Prescribed, changed, checked_pose
from dem.pairs import Pairs
from dem.polyhedra import Solid
from dem.scene import LargeBody, SurfaceVelocity, checked_surface
from dem.sources import Outlet, Source, Tally, as_array
from dem.springs import Spring
from dem.together import together


@dataclass(frozen=True)
class Shear:
    """A simple shear of a periodic cell (Lees and Edwards 1972): flow along x, with its gradient along y or z."""

    rate: float  #: d v_x / d y or z [1/s]
    axis: int  #: of the gradient: 1 or 2
    length: float  #: the period along it [m]
    shift: float = 0.0  #: by how much the images behind that period are moved along x so far [m]

    @property
    def speed(self) -> float:
        """Velocity along x of the images behind the period, relative to their grains [m/s]."""
        return self.rate * self.length

    def after(self, dt: float) -> Shear:
        """dt [s] later."""
        return dataclasses.replace(self, shift=self.shift + dt * self.speed)


@dataclass(frozen=True)
class Servo:
    """The stresses or strain rates that a periodic cell is to have: its periods change, and all centres with them; see
    `dem.servo`."""

    asked: Floats  #: (3,) stresses along x, y, z, positive in compression; NaN: none [Pa]
    strain: Floats  #: (3,) strain rates in the place of the stresses from `start` on, likewise [1/s]
    start: float = 0.0  #: [s]
    rate: Floats = field(default_factory=lambda: np.zeros(3))  #: (3,) of the periods in the last step, over them [1/s]

    def given_at(self, time: float, dt: float) -> Floats:
        """Rates (3,) at which the periods are to grow in the step of dt [s] from the `time` [s]; NaN: what the asked
        stress needs, or none [1/s]."""
        return -self.strain if time >= self.start - 1e-6 * dt else np.full(3, np.nan)


#: The fields of a world that a step changes; what these refer to is replaced, and never changed in place.
STATE = (
    "grains", "large", "slabs", "only_spheres", "lists", "expected", "period", "shear", "servo", "tallies", "time",
    "step", "spare",
)  # fmt: skip


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
    pairs: Pairs  #: coefficients of contacts by pair of materials
    materials: tuple[str, ...]  #: their names; the column `material` of a table of bodies is an index into them
    grains: Bodies  #: the slab of this rank; replace it by `set_grains` only
    large: Bodies  #: one row per large body
    loads: dict[str, Load] = field(default_factory=dict)  #: by name; change them by `set_load` only
    springs: dict[str, Spring] = field(default_factory=dict)  #: by name; change them by `set_spring` only
    joints: dict[str, Joint] = field(default_factory=dict)  #: by name; change them by `set_joint` only
    period: Floats | None = None  #: (3,) lengths of the cell that repeats itself, inf: none; None: along no axis [m]
    sources: dict[str, Source] = field(default_factory=dict)  #: by name
    outlets: dict[str, Outlet] = field(default_factory=dict)  #: by name
    tallies: dict[str, Tally] = field(default_factory=dict)  #: of sources, then of outlets, by name
    clumps: tuple[Form, ...] = ()  #: shapes of grains, by their numbers
    polyhedra: tuple[Solid, ...] = ()  #: shapes of grains, by their numbers
    initial: int = 0  #: number of grains at time zero
    first_large: int = 0  #: id of the first large body
    shear: Shear | None = None  #: of the cell
    servo: Servo | None = None  #: of the size of the cell
    time: float = 0.0  #: [s]
    step: int = 0  #: number of steps done
    spare: float = 3000.0  #: iterations that steps at rest may spend beyond the limits of the solver, `pctt.run.rest`
    slabs: Ints = field(init=False)  #: (size + 1,) global index of the first grain of each rank, and the end
    only_spheres: bool = field(init=False)  #: whether all grains, of all ranks, are spheres

    changed: set[str] = field(init=False, default_factory=set)  #: large bodies with another motion than the scene gave

    loads_set: set[str] = field(init=False, default_factory=set)  #: loads with other numbers than the scene gave

    springs_set: set[str] = field(init=False, default_factory=set)  #: springs with other numbers than the scene gave

    joints_set: set[str] = field(init=False, default_factory=set)  #: joints with other numbers than the scene gave

    sources_set: set[str] = field(init=False, default_factory=set)  #: sources that the scene gave otherwise

    lists: Any = field(init=False, repr=False, default=None)  #: the `dem.contact.lists.Lists` of the last search

    #: Velocities (springs, 2, 6) that the ends of springs were to have after the last step without contacts and drives.
    expected: Floats | None = field(init=False, default=None)

    def __post_init__(self) -> None:
        self.set_grains(self.grains)

    def trial(self) -> World:
        """A world that a step may change: this one stays as it is until it takes its state."""
        other = copy(self)
        other.grains, other.large = dataclasses.replace(self.grains), dataclasses.replace(self.large)
        other.tallies = {name: dataclasses.replace(tally) for name, tally in self.tallies.items()}
        return other

    def take(self, trial: World) -> None:
        """Take the state to which a step has brought a trial."""
        for name in STATE:
            setattr(self, name, getattr(trial, name))

    def state(self) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
        """Arrays from which `dem.start.restored_world` makes this world again: rows of local grains, and replicated
        ones."""
        replicated = {f"large_{name}": column for name, column in self.large.columns().items()}
        replicated.update(slabs=self.slabs, time=np.array(self.time), step=np.array(self.step))
        if self.expected is not None:
            replicated["expected"] = self.expected
        replicated["spare"] = np.array(self.spare)
        if self.tallies:
            replicated["tallies"] = as_array(self.tallies)
        if self.shear is not None:
            replicated["shear"] = np.array([self.shear.rate, self.shear.shift])
        if self.servo is not None:
            servo = self.servo
            replicated["servo"] = np.array([servo.asked, servo.strain, [servo.start] * 3, servo.rate, self.period])
        return self.grains.columns(), replicated

    def set_grains(self, grains: Bodies) -> None:
        """Replace the slab of this rank; collective."""
        self.grains, self.lists = grains, None
        everyone = np.zeros((self.comm.size + 1, 2), np.int64)
        self.comm.Allgather(np.array([len(grains), (grains.shape != bodies.SPHERE).any()], np.int64), everyone[1:])
        self.slabs = np.cumsum(everyone[:, 0])
        self.only_spheres = not everyone[:, 1].any()

    @property
    def ids(self) -> int:
        """Number of grains that there have been; their ids are less."""
        return self.initial + sum(self.tallies[name].count for name in self.sources)

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

    def name_of(self, id: int) -> str:
        """What messages call the body of this id."""
        first = self.first_large
        return f"grain {id}" if id < first else f"body {self.large_bodies[id - first].name!r}"

    def replace_large(self, body: LargeBody) -> None:
        """Put this large body in the place of that of its name; the same on all ranks."""
        row = self.large_row(body.name)
        self.large_bodies = (*self.large_bodies[:row], body, *self.large_bodies[row + 1 :])
        self.changed.add(body.name)

    def poses(self, time: float) -> dict[int, Pose]:
        """Places (3,) and quaternions (4,) of the large bodies of prescribed motion at `time` [s], by row; collective.
        SceneError if a motion fails."""
        return together(self.comm, "motion of a large body", lambda: {
            row: checked_pose(body.motion, time, body.position, body.quaternion)
            for row, body in enumerate(self.large_bodies) if not isinstance(body.motion, Dynamic)
        })  # fmt: skip

    def put_large(self, poses: dict[int, Pose]) -> None:
        """Put large bodies, by row, into these poses."""
        for row, pose in poses.items():
            self.large.position[row], self.large.quaternion[row] = pose


def turns_unlike_spheres(world: World) -> bool:
    """Whether a body that turns freely may do so in another way than a sphere; the same on all ranks."""
    return not world.only_spheres or bool(np.isfinite(world.large.inertia).all(axis=1).any())


def set_motion(world: World, name: str, motion: Motion | None = None, **values: Any) -> None:
    """Give a large body another motion, or its own one with other `values` as of `changed`; it begins where it is now.
    ValueError for one that it cannot have: if forces move the body, they go on doing so along the same line or about
    the same axis; else they cannot begin to."""
    row = world.large_row(name)
    body = world.large_bodies[row]
    motion = changed(body.motion, world.time, **values) if motion is None else motion
    pose = body.position, body.quaternion
    motions.refuse_ignored(motion)
    _refuse_other_ways(body, motion)
    if not isinstance(motion, Dynamic):
        pose = _leading_to(motion, world.time, world.large.position[row], world.large.quaternion[row])
    world.replace_large(dataclasses.replace(body, motion=motion, position=pose[0], quaternion=pose[1]))


def set_surface(world: World, name: str, velocity: SurfaceVelocity | None) -> None:
    """Let the surface of a large body move along itself at another velocity (3,) in the body frame [m/s]. ValueError
    for a function, which a checkpoint could not keep."""
    if callable(velocity):
        raise ValueError(f"surface velocity of {name!r} can be set to a vector within a run; a function is the scene's")
    body = world.large_bodies[world.large_row(name)]
    world.replace_large(dataclasses.replace(body, surface=checked_surface(name, velocity)))


def _refuse_other_ways(body: LargeBody, motion: Motion) -> None:
    """ValueError for a motion by which forces would move a body in other ways than by its own, or would begin to."""
    if not (isinstance(body.motion, Dynamic) or isinstance(motion, Dynamic)):
        return
    if type(motion) is not type(body.motion) or not np.allclose(_ways(motion), _ways(body.motion), atol=1e-12):
        kind = f"{type(body.motion).__name__} with another drive" if isinstance(body.motion, Dynamic) else "a path"
        raise ValueError(f"body {body.name!r} cannot change its motion to {motion!r}: allowed is {kind}")


def _ways(motion: Any) -> Floats:
    """Projectors (2, 3, 3) on what forces and torques can move."""
    return np.array([motion.free_directions(), motion.free_turns()])


def set_shear_rate(world: World, rate: float) -> None:
    """Shear the cell at another rate [1/s] from now on. ValueError if the scene has no `shear_rate`."""
    if world.shear is None:
        raise ValueError("shear rate: the cell of this scene is not sheared; give the Scene a shear_rate, or 0")
    world.shear = dataclasses.replace(world.shear, rate=float(checks.finite("shear rate", rate)))


def set_stress(world: World, stress: Any) -> None:
    """Ask for other stresses (3,) of the cell along x, y, z [Pa] from now on; None: none. ValueError if the scene has
    neither `stress` nor `strain_rate`."""
    world.servo = dataclasses.replace(_servo(world, "stress"), asked=checks.stress(stress))


def set_strain_rate(world: World, strain_rate: Any) -> None:
    """Compress the cell at other rates (3,) along x, y, z [1/s] from now on; None: the stress that is asked for, or
    none. ValueError as of `set_stress`."""
    servo = _servo(world, "strain_rate")
    world.servo = dataclasses.replace(servo, strain=checks.strain_rate(strain_rate), start=world.time)


def _servo(world: World, what: str) -> Servo:
    if world.servo is None:
        raise ValueError(f"{what}: the periods of this scene are constant; give the Scene a stress or a strain_rate")
    return world.servo


def set_load(world: World, name: str, on: On = None, **values: Any) -> None:
    """Give a load other numbers: `force`, `torque`, `start` or `end`; a name that no load has begins one `on` some
    bodies, all grains if nothing is given. ValueError for what it cannot be."""
    load = world.loads[name].changed(**values) if name in world.loads else Load(on).changed(**values)
    refuse_load(world, name, load)
    world.loads[name] = load
    world.loads_set.add(name)


def refuse_load(world: World, name: str, load: Load) -> None:
    """ValueError for a load on bodies that are not there, or that no force moves; not collective."""
    if isinstance(load.on, str):
        bodies_of_name = [body for body in world.large_bodies if body.name == load.on]
        if bodies_of_name and not isinstance(bodies_of_name[0].motion, Dynamic):
            raise ValueError(f"load {name!r}: the motion of the body {load.on!r} is prescribed, so no force moves it")
        if bool(bodies_of_name) == (load.on in world.materials):
            kind = "both a body and a material" if bodies_of_name else "neither a body nor a material"
            raise ValueError(f"load {name!r}: {load.on!r} is {kind}")
    elif load.ids is not None and len(wrong := load.ids[(load.ids < 0) | (load.ids >= world.ids)]):
        raise ValueError(f"load {name!r}: there is no grain {wrong[0]}")


def set_spring(world: World, name: str, **values: Any) -> None:
    """Give a spring another `stiffness`, `damping` or rest `length`. ValueError for what it cannot have."""
    if name not in world.springs:
        raise ValueError(f"no spring {name!r}; there are: {', '.join(world.springs) or 'none'}")
    if other := sorted(set(values) - {"stiffness", "damping", "length"}):
        raise ValueError(f"spring {name!r}: {other[0]} cannot be set; allowed are stiffness, damping and length")
    world.springs[name] = dataclasses.replace(world.springs[name], **values)
    world.springs_set.add(name)


def set_source(world: World, name: str, **values: Any) -> None:
    """Give a source another `mass_rate` [kg/s] or `number_rate` [1/s], and `velocity` [m/s], from now on. ValueError
    for what it cannot have."""
    if name not in world.sources:
        raise ValueError(f"no source {name!r}; there are: {', '.join(world.sources) or 'none'}")
    world.sources[name] = world.sources[name].changed(world.time, world.tallies[name], **values)
    world.sources_set.add(name)


def restore_sources(world: World, text: str) -> None:
    """Give a world, made from its scene, the sources of `dem.sources.as_text`. ValueError if that fails."""
    for name, source in sources.from_text(text, world.sources).items():
        world.sources[name] = source
        world.sources_set.add(name)


def set_joint(world: World, name: str, **values: Any) -> None:
    """Give a joint another `speed`, `target`, `strength`, `low` or `high`. ValueError for what it cannot have."""
    if name not in world.joints:
        raise ValueError(f"no joint {name!r}; there are: {', '.join(world.joints) or 'none'}")
    world.joints[name] = world.joints[name].changed(**values)
    world.joints_set.add(name)


def restore_joints(world: World, text: str) -> None:
    """Give a world, made from its scene, the joints of `dem.joints.as_text`."""
    for name, joint in joints.from_text(text).items():
        world.joints[name] = joint
        world.joints_set.add(name)


def _leading_to(motion: Prescribed, time: float, position: Floats, orientation: Floats) -> Pose:
    """The pose at time zero of a body that the motion brings to this pose at `time`. ValueError if there is none."""
    shift, turn = checked_pose(motion, time, np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]))
    back = quaternion.conjugate(turn)
    start = quaternion.rotate(back, position - shift), quaternion.multiply(back, orientation)
    place, turned = checked_pose(motion, time, *start)
    size = np.abs([place, position]).max() + np.abs(shift).max()
    if np.abs(place - position).max() > 1e-9 * size or abs(turned @ orientation) < 1.0 - 1e-9:
        raise ValueError(f"{type(motion).__name__} does not displace the pose at time zero: the body would jump")
    return start


def changed_motions(world: World) -> str:
    """The motions that were changed as text, for `restore_motions`; empty if there are none."""
    found = {
        body.name: {
            "motion": type(body.motion).__name__,
            "values": {field.name: getattr(body.motion, field.name) for field in dataclasses.fields(body.motion)},
            "position": body.position,
            "quaternion": body.quaternion,
            **({} if callable(body.surface) else {"surface": body.surface}),
        }
        for body in world.large_bodies
        if body.name in world.changed
    }
    return json.dumps(found, default=lambda array: array.tolist()) if found else ""


def restore_motions(world: World, text: str) -> None:
    """Give the bodies of a world, made from its scene, the motions of `changed_motions`. ValueError for what is none: a
    motion is one of `dem.motion` or that of the scene, with parameters that it has, by which the body can move, and the
    pose is one."""
    for name, entry in json.loads(text).items():
        body = world.large_bodies[world.large_row(name)]
        own = type(body.motion)
        kind = own if own.__name__ == entry["motion"] else motions.KINDS.get(entry["motion"])
        if kind is None:
            raise ValueError(f"body {name!r}: neither the scene nor dem.motion has the motion {entry['motion']}")
        if strange := sorted({*entry["values"]} - {field.name for field in dataclasses.fields(kind)}):
            raise ValueError(f"body {name!r}: its motion {kind.__name__} has no {strange[0]}")
        motion = kind(**entry["values"])
        _refuse_other_ways(body, motion)
        place = checks.vector(f"position of {name!r}", entry["position"])
        turn = checks.rows(f"quaternion of {name!r}", entry["quaternion"], 1, 4)[0]
        if abs(np.linalg.norm(turn) - 1.0) > 1e-6:
            raise ValueError(f"quaternion of {name!r} is {turn.tolist()}; allowed is one of unit norm")
        surface = checked_surface(name, entry["surface"]) if "surface" in entry else body.surface
        world.replace_large(dataclasses.replace(body, motion=motion, position=place, quaternion=turn, surface=surface))


def restore_loads(world: World, text: str) -> None:
    """Give a world, made from its scene, the loads of `dem.loads.as_text`. ValueError if that fails."""
    for name, load in loads.from_text(text, world.loads).items():
        refuse_load(world, name, load)
        world.loads[name] = load
        world.loads_set.add(name)


def restore_springs(world: World, text: str) -> None:
    """Give a world, made from its scene, the springs of `dem.springs.as_text`."""
    for name, spring in springs.from_text(text).items():
        world.springs[name] = spring
        world.springs_set.add(name)
