"""Description of a scene: its bodies, materials and gravity at time zero.

A scene is the same on every rank and knows nothing of ranks; `dem.start.new_world` distributes it::

    scene = Scene(friction=0.3)
    scene.add_body("floor", [Plane(normal=(0, 0, 1))])
    scene.add_spheres(positions, radius=0.1, density=2500.0)
    world = new_world(scene, MPI.COMM_WORLD)

It keeps what is given of grains, and makes their table in parts: each rank makes the rows that it needs. What is given
by a `dem.arrays.Rule` takes no memory at all.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass, replace
from functools import cached_property, partial, wraps
from inspect import signature
from typing import Any, TypeVar, Union, cast

import numpy as np
from mpi4py import MPI

from dem import bodies, checks, quaternion, shapes
from dem.arrays import ArrayLike, Floats, Ints, Rule, frozen
from dem.bodies import BOX, CAPSULE, COMPOUND, PLANE, SPHERE, Bodies
from dem.geometry.region import Block, Cylinder
from dem.geometry.survey import Survey, survey
from dem.motion import Driven, Dynamic, Fixed, Guided, Held, Hinged, Motion, Pose, checked_pose, refuse_ignored
from dem.parts import cell, contact_law
from dem.parts.contact_law import ContactLaw
from dem.parts.ends import End
from dem.parts.joints import Joint
from dem.parts.loads import Law, Load, On
from dem.parts.named import Named
from dem.parts.passages import Outlet, Passages
from dem.parts.sizes import Sizes
from dem.parts.sources import Source
from dem.parts.springs import Spring
from dem.quaternion import across, length
from dem.shapes import Box, Capsule, Clump, Shape, Sphere, clumps, convex, polyhedra, refuse_other_than_shapes
from dem.shapes.convex import Convex
from dem.shapes.forms import Form

#: The kinds of parts with names, in the order in which they act.
KINDS: dict[str, type[Named]] = {"load": Load, "spring": Spring, "joint": Joint, "source": Source}

N = TypeVar("N", bound=Named)


def no_parts() -> dict[str, dict[str, Any]]:
    """Parts by kind and name: none yet."""
    return {kind: {} for kind in KINDS}


def kinds_of(base: type[N], named: Mapping[str, dict[str, Any]]) -> list[tuple[str, type[N], dict[str, N]]]:
    """The kinds derived from a class that have parts in `named`: name, class and the parts by their names."""
    return [(kind, own, named[kind]) for kind, own in KINDS.items() if named[kind] and issubclass(own, base)]


#: A velocity (3,), or a function of points (n, 3) [m] and outward normals (n, 3) that returns (3,) or (n, 3) [m/s].
SurfaceVelocity = Union[Sequence[float], Callable[[Floats, Floats], ArrayLike]]


def checked_surface(name: str, velocity: SurfaceVelocity | None) -> SurfaceVelocity | None:
    """The surface velocity of the body of this name; ValueError for what is none."""
    if velocity is None or callable(velocity):
        return velocity
    return tuple(checks.vector(f"surface velocity of {name!r}", velocity).tolist())


@dataclass(frozen=True)
class LargeBody:
    """A body that every rank holds: container, tool, incline. The pose is that of time zero."""

    name: str
    shapes: tuple[Shape, ...]  #: in the body frame
    motion: Motion
    material: int
    position: Floats  #: (3,) [m]
    quaternion: Floats  #: (4,)
    velocity: Floats  #: (6,) at time zero, of dynamic bodies
    mass: float  #: infinite unless the motion is dynamic [kg]
    inertia: Floats  #: (3,) principal moments in the body frame; infinite if the body cannot turn [kg m^2]
    surface: SurfaceVelocity | None = None  #: of its surface along itself, in the body frame [m/s]
    density: float | None = None  #: from which its mass is made [kg/m^3]

    def pose(self, time: float) -> Pose:
        """The pose at a time [s], of a motion that does not answer to forces. ValueError if it is none."""
        return self._rest if type(self.motion) is Fixed else self._pose(time)

    @cached_property
    def _rest(self) -> Pose:
        return self._pose(0.0)

    def _pose(self, time: float) -> Pose:
        return checked_pose(self.motion, time, self.position, self.quaternion)  # type: ignore[arg-type]


@dataclass(frozen=True)
class Column:
    """A quantity of grains that were added together: one row for all, a row for each, or a `Rule` for the rows."""

    name: str
    values: Floats | Rule
    row: tuple[int, ...]
    check: Callable[[str, ArrayLike], Floats]

    @classmethod
    def checked(
        cls, name: str, values: ArrayLike, count: int, *row: int, check: Callable[..., Floats] = checks.finite
    ) -> Column:
        """ValueError for what is none; rows by a rule are checked when they are made."""
        if not isinstance(values, Rule):
            values = np.array(check(name, values))
            checks.shape(name, values, count, *row)
        elif len(values) != count:
            raise ValueError(f"{name} must have {count} rows, got {len(values)}")
        return cls(name, values, row, check)

    def part(self, first: int, end: int) -> Floats:
        """The rows (end - first, ...) from `first` on and before `end`."""
        one = not isinstance(self.values, Rule) and self.values.shape == self.row
        rows = self.values if one else self.check(self.name, self.values[first:end])  # type: ignore[index]
        return checks.rows(self.name, rows, end - first, *self.row)

    def sample(self) -> Floats:
        """What was given; of a rule rows of the beginning and the end."""
        if not isinstance(self.values, Rule):
            return self.values
        count = len(self.values)
        return np.concatenate([self.part(0, min(count, 1000)), self.part(max(0, count - 1000), count)])


@dataclass(frozen=True)
class Part:
    """Grains of one kind that were added together."""

    count: int
    kind: int
    material: int | Ints  #: of all, or (count,)
    given: dict[str, Column]
    #: from the columns of `given`: position, quaternion, size, mass and inertia, as of `Bodies`
    solid: Callable[[dict[str, Floats]], tuple[Floats, ...]]

    def rows(self, first: int, end: int) -> Bodies:
        """The table of the grains from `first` on and before `end`, counted within this part."""
        given, many = {name: column.part(first, end) for name, column in self.given.items()}, end - first
        position, turn, size, mass, inertia = self.solid(given)
        return Bodies(
            id=np.arange(first, end),
            position=position,
            quaternion=turn,
            velocity=np.hstack([given["velocity"], given["angular velocity"]]),
            mass=mass,
            inertia=inertia,
            material=np.full(many, self.material if isinstance(self.material, int) else self.material[first:end]),
            shape=np.full(many, self.kind),
            size=size,
            weight=np.zeros(many),
        )


Method = TypeVar("Method", bound=Callable[..., Any])


def _building(method: Method) -> Method:
    """A method that adds to a scene, or changes it: ValueError once a simulation has the scene, TypeError for an
    argument that it does not have."""
    named_well = checks.known_arguments()(method)

    @wraps(method)
    def checked(scene: Scene, *given: Any, **named: Any) -> Any:
        scene.refuse_finished(method.__name__)
        return named_well(scene, *given, **named)

    return cast(Method, checked)


class Scene:
    """Collects grains, large bodies, materials and gravity; checks each as it comes (ValueError). A scene of which a
    simulation was made stays as it is; `copy` makes one that can be changed."""

    def __init__(
        self, friction: float, gravity: Sequence[float] = (0.0, 0.0, -9.81), *,
        period: Sequence[float | None] | None = None, shear_rate: float | None = None, shear_gradient: str = "y",
        stress: Sequence[float | None] | None = None, strain_rate: Sequence[float | None] | None = None,
        strain_start: float = 0.0, **law: float | None,
    ) -> None:  # fmt: skip
        """`gravity`: (3,) [m/s^2]. `friction` and the `law`, such as `stiffness`, `restitution` or `cohesion`, are the
        coefficients of the contacts of all pairs of materials, but of those of `set_pair`: the fields of
        `dem.parts.contact_law.ContactLaw`, see docs/contact_laws.md.
        `period`: (3,) lengths of the cell, from zero on, that repeats itself along x, y, z [m], None: not along that
        axis. `shear_rate`: d v_x / dy of the cell, or d v_x / dz for the `shear_gradient` "z" [1/s]; None: it is at
        rest. `stress`: (3,) that the cell is to have along x, y, z, positive in compression [Pa]: its periods then
        change; None: not along that axis. `strain_rate`: (3,) at which it is compressed along x, y, z [1/s] from the
        time `strain_start` [s] on, in the place of the stress along that axis. See docs/periodic.md.
        """
        given = gravity, period, shear_rate, shear_gradient, stress, strain_rate, strain_start
        self.cell = cell.of_scene(*given)
        self.gravity = checks.vector("gravity", gravity)
        self.large_bodies: list[LargeBody] = []
        #: Names of large bodies that go away from the grains: their speed asks for no stiffness. A simulation refuses
        #: names that no large body has.
        self.leaving: set[str] = set()
        self._law = contact_law.law({"friction": friction, **law}, beside=[*signature(Scene).parameters][:-1])
        self._pairs: dict[tuple[int, int], ContactLaw] = {}
        self._materials: dict[str, int] = {}
        self.parts: list[Part] = []  #: the grains, as they were added
        self._survey: Survey | None = None
        self.forms: list[Form] = []  #: the distinct shapes of clumps and polyhedra, see `dem.bodies`
        self.named = no_parts()  #: loads, springs, joints and sources by kind and name, see `KINDS`
        self.passages = Passages(self.named["source"])  #: sources and outlets
        self._finished = False

    def finish(self) -> None:
        """Refuse changes from now on: a simulation that has the scene would not see them."""
        if not self._finished:
            self.gravity = frozen(self.gravity.copy())
        self._finished = True

    def refuse_finished(self, what: str) -> None:
        """ValueError for a change once the scene is finished."""
        if self._finished:
            allowed = "allowed are scene.copy() for another one, and change(...) of the simulation"
            raise ValueError(f"{what}: a simulation was made of this scene, and would not see the change; {allowed}")

    def __setattr__(self, name: str, value: object) -> None:
        """AttributeError for a name that a scene does not have, ValueError as of `refuse_finished`."""
        if (known := vars(self)).get("_finished") is not None and not name.startswith("_"):
            if name not in known:
                raise AttributeError(f"a Scene has no {name!r} to set{checks.nearest(name, known)}")
            self.refuse_finished(name)
        super().__setattr__(name, value)

    def copy(self) -> Scene:
        """Return a scene with the same contents, which can be changed by itself."""
        return deepcopy(self)

    __copy__ = copy

    def __getstate__(self) -> dict[str, Any]:
        """For copies, which can be changed."""
        return {**vars(self), "_finished": False}

    def __setstate__(self, kept: dict[str, Any]) -> None:
        vars(self).update(kept, gravity=np.array(kept["gravity"]))

    def __repr__(self) -> str:
        parts = [f"{self.count} grains", f"{len(self.large_bodies)} large bodies"]
        parts[1] += "".join(f", {body.name!r}" for body in self.large_bodies[:5])
        parts += [f"{len(members)} {kind}s" for kind, members in self.named.items() if members]
        return f"<Scene: {'; '.join(parts)}; friction {self._law.friction:g}>"

    @_building
    def add_spheres(
        self, positions: ArrayLike, radius: ArrayLike, density: ArrayLike, *, material: str | Sequence[str] = "default",
        velocity: ArrayLike = (0.0, 0.0, 0.0), angular_velocity: ArrayLike = (0.0, 0.0, 0.0),
    ) -> Ints | range:  # fmt: skip
        """Add solid spheres and return their ids (n,).

        positions (n, 3) [m]; radius [m] and density [kg/m^3] one for all or (n,); velocities (3,) or (n, 3); the name
        of a material, or (n,) names. What has a row for each sphere may be a `dem.arrays.Rule`, of which every rank
        makes its part alone; so of other grains. `pctt.beds.read_spheres` has these arguments from a file.
        """
        upright, lengths = (1.0, 0.0, 0.0, 0.0), {"radius": radius}
        return self._append(SPHERE, positions, lengths, density, material, upright, velocity, angular_velocity)

    @_building
    def add_boxes(
        self, positions: ArrayLike, half_extents: ArrayLike, density: ArrayLike, *,
        quaternions: ArrayLike = (1.0, 0.0, 0.0, 0.0), material: str = "default", velocity: ArrayLike = (0.0, 0.0, 0.0),
        angular_velocity: ArrayLike = (0.0, 0.0, 0.0),
    ) -> Ints | range:  # fmt: skip
        """Add solid boxes and return their ids (n,).

        positions (n, 3) and half extents (3,) or (n, 3) [m]; density [kg/m^3] one for all or (n,);
        quaternions (4,) or (n, 4); velocities (3,) or (n, 3).
        """
        lengths = {"half extents": half_extents}
        return self._append(BOX, positions, lengths, density, material, quaternions, velocity, angular_velocity)

    @_building
    def add_capsules(
        self, positions: ArrayLike, radius: ArrayLike, half_length: ArrayLike, density: ArrayLike, *,
        quaternions: ArrayLike = (1.0, 0.0, 0.0, 0.0), material: str = "default", velocity: ArrayLike = (0.0, 0.0, 0.0),
        angular_velocity: ArrayLike = (0.0, 0.0, 0.0),
    ) -> Ints | range:  # fmt: skip
        """Add solid capsules, along the z axes of their frames, and return their ids (n,).

        positions (n, 3) [m]; radius, half length of the core segment [m] and density [kg/m^3] one for all or (n,);
        quaternions (4,) or (n, 4); velocities (3,) or (n, 3).
        """
        lengths = {"radius": radius, "half length": half_length}
        return self._append(CAPSULE, positions, lengths, density, material, quaternions, velocity, angular_velocity)

    @_building
    def add_clumps(
        self, positions: ArrayLike, shape: Clump, density: ArrayLike, *, quaternions: ArrayLike = (1.0, 0.0, 0.0, 0.0),
        material: str = "default", velocity: ArrayLike = (0.0, 0.0, 0.0), angular_velocity: ArrayLike = (0.0, 0.0, 0.0),
    ) -> Ints | range:  # fmt: skip
        """Add solid clumps of spheres of one shape and return their ids (n,).

        positions (n, 3) [m] and quaternions (4,) or (n, 4) are those of the frame in which `shape` has its centres.
        The grains have theirs at the centre of mass along the principal axes, see `dem.shapes.clumps`. density
        [kg/m^3] one for all or (n,); velocities (3,) or (n, 3), the linear one is that of the centre of mass.
        """
        if not isinstance(shape, Clump):
            raise ValueError(f"shape of clumps: allowed is a Clump, got {type(shape).__name__}")
        form, scale = clumps.form(shape), {"scale": 1.0}
        return self._append(form, positions, scale, density, material, quaternions, velocity, angular_velocity)

    @_building
    def add_polyhedra(
        self, positions: ArrayLike, vertices: ArrayLike, density: ArrayLike, *, scale: ArrayLike = 1.0,
        quaternions: ArrayLike = (1.0, 0.0, 0.0, 0.0), material: str = "default", velocity: ArrayLike = (0.0, 0.0, 0.0),
        angular_velocity: ArrayLike = (0.0, 0.0, 0.0),
    ) -> Ints | range:  # fmt: skip
        """Add solid convex polyhedra of one shape, the hull of 4 to 32 `vertices` (v, 3) [m], and return their ids
        (n,).

        positions (n, 3) [m] and quaternions (4,) or (n, 4) are those of the frame of the vertices, which a grain has
        times its `scale`. The grains have theirs at the centre of mass along the principal axes, see
        `dem.shapes.polyhedra`.
        scale and density [kg/m^3] one for all or (n,); velocities (3,) or (n, 3), the linear one is that of the centre
        of mass. ValueError for vertices that are not the corners of a convex solid.
        """
        form, lengths = polyhedra.solid(vertices), {"scale": scale}
        return self._append(form, positions, lengths, density, material, quaternions, velocity, angular_velocity)

    @_building
    def add_grains(
        self, positions: ArrayLike, shape: Convex, density: ArrayLike, *, scale: ArrayLike = 1.0,
        quaternions: ArrayLike = (1.0, 0.0, 0.0, 0.0), material: str = "default", velocity: ArrayLike = (0.0, 0.0, 0.0),
        angular_velocity: ArrayLike = (0.0, 0.0, 0.0),
    ) -> Ints | range:  # fmt: skip
        """Add solid grains of one convex `shape`, such as a `dem.shapes.Cylinder`, and return their ids (n,).

        positions (n, 3) [m] and quaternions (4,) or (n, 4) are those of the frame of the shape, which must have its
        origin there; a grain has the shape times its `scale`. scale and density [kg/m^3] one for all or (n,);
        velocities (3,) or (n, 3). ValueError for other shapes.
        """
        form, lengths = convex.form(shape), {"scale": scale}
        return self._append(form, positions, lengths, density, material, quaternions, velocity, angular_velocity)

    @_building
    def add_body(
        self, name: str, shapes: Sequence[Shape], motion: Motion = Fixed(), *,  # noqa: B008 - immutable
        position: Sequence[float] = (0.0, 0.0, 0.0), quaternion: Sequence[float] = (1.0, 0.0, 0.0, 0.0),
        material: str = "default", density: float | None = None, mass: float | None = None,
        inertia: Sequence[float] | None = None, velocity: Sequence[float] = (0.0, 0.0, 0.0),
        angular_velocity: Sequence[float] = (0.0, 0.0, 0.0), surface_velocity: SurfaceVelocity | None = None,
    ) -> None:  # fmt: skip
        """Add a large body made of `shapes`, which are placed in its body frame.

        The pose and the velocities are those of time zero. A dynamic body needs either its `density` [kg/m^3], or its
        `mass` [kg] and principal moments `inertia` (3,) [kg m^2]. With a density, its frame is moved to the centre of
        mass and the principal axes; with a mass, the frame must be there already. A guided body needs no moments. The
        frame of a hinged body is turned until its z axis is that of the hinge, and its centre of mass must be on that
        axis. Two large bodies touch if at least one of them is dynamic.
        """
        checks.new_name("large bodies", name, [body.name for body in self.large_bodies])
        if not isinstance(shapes, Iterable) or not (shapes := tuple(shapes)):
            raise ValueError(f"shapes of {name!r}: {shapes!r}; allowed is a list of one or more")
        refuse_other_than_shapes(name, shapes)
        if isinstance(motion, type):
            raise ValueError(f"motion of {name!r}: the class {motion.__name__}; allowed is one, {motion.__name__}(...)")
        place = checks.vector(f"position of {name!r}", position)
        turn = checks.unit_quaternion(f"quaternion of {name!r}", quaternion)
        speed = np.hstack([checks.vector(f"{kind}velocity", given)
                           for kind, given in (("", velocity), ("angular ", angular_velocity))])  # fmt: skip
        refuse_ignored(motion)
        _refuse_speed(name, motion, speed)
        weights = {"density": density, "mass": mass, "inertia": inertia}
        body = LargeBody(name, tuple(shapes), motion, -1, place, turn, speed, np.inf, np.full(3, np.inf))
        if not isinstance(motion, Dynamic):
            weighs = [kind for kind, given in weights.items() if given is not None]
            if weighs and isinstance(motion, Fixed):
                raise ValueError(f"{weighs[0]} of {name!r}, which stands still: allowed is a motion, Dynamic() say")
        elif density is not None and mass is None and inertia is None:
            body = _centered(body, float(checks.positive(f"density of {name!r}", density)))
        elif density is None and mass is not None and (inertia is not None or not motion.free_turns().any()):
            body = replace(body, mass=float(checks.positive(f"mass of {name!r}", mass)))
            if inertia is not None:
                moments = checks.positive(f"inertia of {name!r}", inertia)
                body = replace(body, inertia=checks.vector(f"inertia of {name!r}", moments))
        else:
            raise ValueError(f"dynamic body {name!r} needs either its density or both mass and inertia")
        if isinstance(motion, Hinged):
            arm = body.position - place
            if length(np.cross(motion.line, arm)) > 1e-6 * max(length(arm), np.sqrt(body.inertia.max() / body.mass)):
                raise ValueError(f"{name!r} is hinged: its centre of mass must be on the axis through its position")
        if isinstance(motion, Dynamic):
            body = _turning(body, motion)
        body = replace(body, surface=checked_surface(name, surface_velocity))
        for shape in body.shapes:
            if isinstance(shape, Convex):
                self._know(convex.centred(shape))
        self.large_bodies.append(replace(body, material=self._material(material)))

    @_building
    def add_load(
        self, name: str, on: On = None, *, force: ArrayLike | Law = (0.0, 0.0, 0.0),
        torque: ArrayLike | Law = (0.0, 0.0, 0.0), start: float = 0.0, end: float = np.inf,
    ) -> None:  # fmt: skip
        """Put a force [N] at the centre of mass and a torque [N m] on each of some bodies: a large body or the grains
        of a material by its name, grains by their ids, or all grains. Each is (3,), for ids also (ids, 3), or a
        function of the time [s] and the table of the bodies, see `dem.parts.loads.Load`. They act from `start` to
        `end` [s].
        """
        taken = [*self.named["load"], *(body.name for body in self.large_bodies)]
        checks.new_name("loads and large bodies", name, taken)
        self.named["load"][name] = Load(on, force, torque, start, end)

    @_building
    def add_spring(
        self, name: str, one: End, other: End = None, *, stiffness: float, damping: float = 0.0,
        length: float | None = None, anchor: Sequence[float] = (0.0, 0.0, 0.0),
        other_anchor: Sequence[float] = (0.0, 0.0, 0.0),
    ) -> None:  # fmt: skip
        """Join two bodies, or a body and the world (None), by a spring with a damper, see `dem.parts.springs`.

        A body is a large body by its name or a grain by its id. The anchors (3,) are in the frames of the bodies, that
        of the world is a place [m]. stiffness [N/m], damping [N s/m], rest `length` [m]: None is the distance at time
        zero; with zero the spring acts in all directions.
        """
        checks.new_name("springs", name, self.named["spring"])
        spring = Spring((one, other), (anchor, other_anchor), stiffness, damping, 0.0 if length is None else length)
        rest = float(np.linalg.norm(spring.vector(f"spring {name!r}", self)))
        self.named["spring"][name] = spring if length is not None else replace(spring, length=rest)

    @_building
    def add_joint(
        self, name: str, one: End, other: End = None, *, kind: str = "hinge", anchor: Sequence[float],
        axis: ArrayLike | None = None, speed: float | None = None, target: float | None = None,
        strength: float = np.inf, limits: Sequence[float] = (-np.inf, np.inf), touching: bool = False,
    ) -> None:  # fmt: skip
        """Join two bodies, or a body and the world (None), by a joint of a `kind` of `dem.parts.joints.KINDS`.

        A body is a large body by its name or a grain by its id. The `anchor` (3,) [m] and the `axis` (3,), by default
        z, or the axes that the kind has, are in the world at time zero, where angle and position are zero; they are
        those of `other` relative to `one`. A motor keeps a `speed` [rad/s, m/s], or goes to a `target` [rad, m], with a
        `speed` at that at most, with a torque or force of at most `strength` [N m, N]; inf: as much as it takes.
        `limits` (2,): least and greatest angle [rad] or position [m]. The two bodies go through each other, unless they
        are `touching`.
        """
        checks.new_name("joints", name, self.named["joint"])
        ends = checks.numbers(f"limits of {name!r}", limits)
        if ends.shape != (2,):
            raise ValueError(f"limits of {name!r}: allowed are two numbers, got {checks.short(limits)}")
        given = {"kind": kind, "speed": speed, "target": target, "strength": checks.number("strength", strength)}
        given |= {"low": float(ends[0]), "high": float(ends[1])}
        joint = Joint.between(name, (one, other), self, anchor, axis, **given, touching=touching)
        self.named["joint"][name] = joint

    def pose(self, what: str, end: End) -> tuple[Floats, Floats]:
        """Position (3,) and quaternion (4,) of an end of a spring or joint at time 0; ValueError if there is none."""
        if end is None:
            return np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0])
        if isinstance(end, str):
            table = self.large().take(np.flatnonzero([body.name == end for body in self.large_bodies]))
        else:
            table = self.row(end) if 0 <= end < self.count else bodies.none()
        if not len(table):
            raise ValueError(f"{what}: there is no body or grain {end!r} yet")
        return table.position[0], table.quaternion[0]

    def row(self, id: int) -> Bodies:
        """The table of one grain at time zero."""
        return self._rows(id, id + 1)

    @_building
    def add_source(
        self, name: str, region: Block | Cylinder, *, radius: float | Sequence[float] | Sizes | None = None,
        density: float, mass_rate: float | None = None, number_rate: float | None = None, most: float = np.inf,
        material: str = "default", velocity: Sequence[float] = (0.0, 0.0, 0.0),
        shape: Sphere | Box | Capsule | Clump | Convex | ArrayLike | None = None, start: float = 0.0,
        end: float = np.inf, seed: int = 0,
    ) -> None:  # fmt: skip
        """Let grains come in a region of `dem.measures`, where there is room, from `start` to `end` [s].

        They are spheres of a `radius` [m], which may be a distribution of `dem.parts.sizes`; or have a `shape`, that
        may also be the vertices (v, 3) of a polyhedron, times the `radius`, 1 by default; a clump has one size. Their
        `density` [kg/m^3]; either the `mass_rate` [kg/s] or the `number_rate` [1/s]; the `most` that come in all; their
        `velocity` (3,) at birth [m/s]; the `seed` of sizes, turns and places, see `dem.parts.sources.Source`.
        ValueError for what is none of these.
        """
        own = None if shape is None else _of_grains(shape)
        number = self._know(own) if isinstance(own, Form) else 0
        source = Source(
            region, radius, density=density, mass_rate=mass_rate, number_rate=number_rate, most=most,
            material=self._material(material), velocity=velocity, shape=own, number=number, start=start, end=end,
            seed=seed,
        )  # fmt: skip
        self.passages.add(name, source)

    @_building
    def add_outlet(self, name: str, region: Block | Cylinder, *, outside: bool = False) -> None:
        """Let grains leave whose centres are in a region of `dem.measures`; `outside`: those that are not in it."""
        self.passages.add(name, Outlet(region, outside))

    @property
    def first_large(self) -> int:
        """The id of the first large body: more than that of any grain that may come."""
        return self.passages.first_large(self.count)

    @property
    def kinds(self) -> list[int]:
        """The kinds of grains that there are, or that may come, as of `dem.bodies`."""
        return sorted({part.kind for part in self.parts} | {*self.passages.extremes().shape.tolist()})

    @property
    def count(self) -> int:
        """Number of the grains at time zero."""
        return sum(part.count for part in self.parts)

    def survey(self, comm: MPI.Comm = MPI.COMM_SELF) -> Survey:
        """Of the grains at time zero; collective. It is made once, and then known to this rank alone."""
        if self._survey is None:
            self._survey = survey(self._rows, self.count, self.speeds, comm)
        return self._survey

    def speeds(self, grains: Bodies) -> Floats:
        """Speeds (n,) of grains, in a sheared cell beside the flow [m/s]."""
        x, y, z = self.cell.beside_flow(grains.position, grains.velocity[:, :3]).T
        return np.hypot(np.hypot(x, y), z)  # squares could overflow

    def expected(self) -> Bodies:
        """Grains that stand for those of time zero, see `Survey`, and for those that may come. A scene without both has
        its large bodies that forces move, as spheres that fit into their shapes. ValueError as of `grains`."""
        self.grains(0, 0)
        found = bodies.concatenate([self.survey().extremes, self.passages.extremes()])
        return found if len(found) else self._free()

    def _free(self) -> Bodies:
        """The large bodies that forces move, as spheres that fit into the thinnest of their shapes. Half spaces have no
        size, and bodies of these alone are not among them."""
        moves = np.array([isinstance(body.motion, Dynamic) for body in self.large_bodies], bool)
        radius = np.array([least_half(body) for body in self.large_bodies], float)
        rows = np.flatnonzero(moves & np.isfinite(radius))
        size = np.outer(radius[rows], [1.0, 0.0, 0.0])
        return replace(self.large().take(rows), shape=np.full(len(rows), SPHERE), size=size)

    @_building
    def set_pair(self, material: str, other: str, **law: float | None) -> None:
        """Coefficients of the contacts of two materials (which may be the same one), the fields of
        `dem.parts.contact_law.ContactLaw`; those not given stay as they are. ValueError for a bad one."""
        one, two = sorted((self._material(material), self._material(other)))
        self._pairs[one, two] = contact_law.law(law, self._pairs.get((one, two), self._law))

    @property
    def materials(self) -> tuple[str, ...]:
        """The names of the materials, in the order of their numbers."""
        return tuple(self._materials)

    def doubts(self) -> str:
        """What is likely a mistake, in words: materials that nothing has, and what laws doubt; empty if there is
        nothing."""
        used = {int(number) for part in self.parts for number in np.unique(part.material)}
        used |= {body.material for body in self.large_bodies}
        used |= {source.material for source in self.passages.sources.values()}
        here = {name for name, number in self._materials.items() if number in used}
        unused = [name for name in self.materials if name not in here]
        found = [f"no body has the material {name!r}{checks.nearest(name, here)}" for name in unused]
        if self.count:
            radius = float(bodies.bounding_radius(self.survey().extremes).max())
            found += dict.fromkeys(law.doubt(radius) for law in (self._law, *self._pairs.values()))
        return "; ".join(filter(None, found))

    def figures(self) -> dict[str, str]:
        """What tells the scene from others with as many bodies, to five digits: gravity, coefficients of contact,
        masses, sizes, materials."""
        laws = {"": self._law}
        laws |= {f" of {self.materials[a]} with {self.materials[b]}": law for (a, b), law in self._pairs.items()}
        found = {name + pair: value for pair, law in laws.items() for name, value in vars(law).items()
                 if not pair or value != vars(self._law)[name]}  # fmt: skip
        found |= {f"gravity {axis} [m/s^2]": value for axis, value in zip("xyz", self.gravity)}
        found |= {"mass of the grains [kg]": self.survey().mass, "sum of their radii [m]": self.survey().radius}
        found |= {f"mass of {body.name} [kg]": body.mass for body in self.large_bodies}
        numbers = {name: f"{value:.5g}" for name, value in found.items() if value is not None}
        return numbers | {f"material of {body.name}": self.materials[body.material] for body in self.large_bodies}

    def pairs(self, stiffness: float) -> ContactLaw:
        """The tables of all pairs of materials, with this `stiffness` [N/m] where none is stated."""
        return contact_law.tables(len(self._materials), self._law, self._pairs, stiffness)

    @property
    def reach(self) -> float:
        """The greatest gap at which bodies attract each other [m]."""
        return self.pairs(np.inf).reach()

    @property
    def states_stiffness(self) -> bool:
        """Whether the stiffness of all or some contacts was stated."""
        return any(law.stiffness is not None for law in (self._law, *self._pairs.values()))

    def grains(self, first: int = 0, end: int | None = None) -> Bodies:
        """The grains from the id `first` on and before `end`, all by default. ValueError if there is nothing that
        moves."""
        later = self.passages.extremes()
        if self.count + len(later) + len(self._free()) == 0:
            raise ValueError("empty scene: there is no grain, and no large body that forces move")
        if self.cell.periodic:
            tables = self.survey().extremes, later
            _refuse_in_cell(self, max(float(bodies.bounding_radius(t).max(initial=0.0)) for t in tables))
        return self._rows(first, self.count if end is None else end)

    def _rows(self, first: int, end: int) -> Bodies:
        tables, before = [], 0
        for part in self.parts:
            low, high = max(first - before, 0), min(end - before, part.count)
            if low < high:
                tables.append(part.rows(low, high))
                tables[-1].id += before
            before += part.count
        return tables[0] if len(tables) == 1 else bodies.concatenate([bodies.none(), *tables])

    def large(self) -> Bodies:
        """The table of the large bodies at time zero, in the order in which they were added."""
        count, first = len(self.large_bodies), self.first_large
        return Bodies(
            id=np.arange(first, first + count),
            **{
                name: np.array([getattr(body, name) for body in self.large_bodies]).reshape(count, *row)
                for name, row in {"position": (3,), "quaternion": (4,), "velocity": (6,), "inertia": (3,)}.items()
            },
            mass=np.array([body.mass for body in self.large_bodies]),
            material=np.array([body.material for body in self.large_bodies], dtype=np.int64),
            shape=np.full(count, COMPOUND),
            size=np.zeros((count, 3)),
            weight=np.zeros(count),
        )

    def _material(self, name: str) -> int:
        if not isinstance(name, str) or not name:
            raise ValueError(f"material {name!r}: allowed is a name, such as 'steel'")
        return self._materials.setdefault(name, len(self._materials))

    def _know(self, form: Form) -> int:
        """The number of a form among those of the scene."""
        if form not in self.forms:
            self.forms.append(form)
        return self.forms.index(form)

    def _append(
        self, what: int | Form, positions: ArrayLike, lengths: Mapping[str, ArrayLike], density: ArrayLike,
        material: str | Sequence[str], quaternions: ArrayLike, velocity: ArrayLike, angular_velocity: ArrayLike,
    ) -> Ints | range:  # fmt: skip
        """Add grains of one kind, of which `lengths` has the columns of `size` by name, or of one form, times a scale,
        in whose first frame positions and quaternions are; their ids, a range where the positions are a `Rule`."""
        kind, solid = (
            (what.BASE + self._know(what), partial(_formed, what)) if isinstance(what, Form)
            else (what, partial(_plain, what, tuple(lengths)))
        )  # fmt: skip
        if not isinstance(positions, Rule):
            positions = np.atleast_2d(checks.finite("positions", positions))
        count, first = len(positions), self.count
        columns = [Column.checked("positions", positions, count, 3, check=checks.finite)]
        row = (3,) if kind == BOX else ()
        for name, values in lengths.items():
            columns.append(Column.checked(name, values, count, *row, check=checks.positive))
        columns += [
            Column.checked("density", density, count, check=checks.positive),
            Column.checked("quaternions", quaternions, count, 4, check=checks.not_zero),
            Column.checked("velocity", velocity, count, 3),
            Column.checked("angular velocity", angular_velocity, count, 3),
        ]
        given = {column.name: column for column in columns}
        one = isinstance(material, str) or not isinstance(material, Iterable)
        if not one and len(material) != count:
            raise ValueError(f"material must be one name or {count} names, got {len(material)}")
        numbers = self._material(cast(str, material)) if one else np.array([self._material(name) for name in material])
        self.parts.append(Part(count, kind, numbers, given, solid))
        self._survey = None
        ids = range(first, first + count)
        return ids if isinstance(positions, Rule) else np.array(ids, np.int64)


def _plain(kind: int, lengths: tuple[str, ...], given: dict[str, Floats]) -> tuple[Floats, ...]:
    """`Part.solid` of spheres, boxes and capsules, of which `lengths` are the columns of `size` by name."""
    size = np.zeros((len(given["density"]), 3))
    for k, name in enumerate(lengths):
        size[:, slice(None) if kind == BOX else k] = given[name]
    return given["positions"], _unit(given["quaternions"]), size, *shapes.solid(kind, size, given["density"])


def _formed(form: Form, given: dict[str, Floats]) -> tuple[Floats, ...]:
    """`Part.solid` of grains of a form."""
    turns, scale = _unit(given["quaternions"]), given["scale"]
    centers = given["positions"] + quaternion.rotate(turns, scale[:, None] * form.place)
    turns = quaternion.multiply(turns, np.tile(form.turn, (len(scale), 1)))
    return centers, turns, *form.grown(scale, given["density"])


def _of_grains(shape: Any) -> Sphere | Box | Capsule | Form:
    """The shape of the grains of a source, or the form of one that has some. ValueError for what is none."""
    if isinstance(shape, (Sphere, Box, Capsule)):
        _, center, turn, _ = shapes.placed(shape)
        if center.any() or turn[1:].any():
            raise ValueError("shape of a source: its center and quaternion must be those of its frame")
        return shape
    if isinstance(shape, Clump):
        return clumps.form(shape)
    if isinstance(shape, Convex):
        return convex.form(shape)
    if np.ndim(shape) == 0:
        allowed = "allowed are a Sphere, Box, Capsule, Clump or convex shape such as a Cylinder, or vertices (v, 3)"
        raise ValueError(f"shape of a source: {allowed}, got {type(shape).__name__}")
    return polyhedra.solid(shape)


def _unit(quaternions: Floats) -> Floats:
    return quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True)


def _refuse_speed(name: str, motion: Motion, speed: Floats) -> None:
    """ValueError for an initial velocity (6,) that the motion does not allow."""
    if not isinstance(motion, Dynamic) and speed.any():
        raise ValueError(f"the motion of {name!r} is prescribed: it takes no initial velocity")
    if isinstance(motion, Held) and (kept := speed - _freely(motion, speed)).any():
        raise ValueError(f"{name!r} is held: its initial velocity must be free, got {kept} of what is not")
    if isinstance(motion, Driven):
        allowed, other = (speed[:3], speed[3:]) if isinstance(motion, Guided) else (speed[3:], speed[:3])
        if other.any() or length(np.cross(motion.line, allowed)) > 1e-12 * length(allowed):
            kind, along = ("guided", "along the guide") if isinstance(motion, Guided) else ("hinged", "about the hinge")
            raise ValueError(f"{name!r} is {kind}: its initial velocity must be {along}")


def _freely(motion: Dynamic, speed: Floats) -> Floats:
    """The part of a velocity (6,) that forces and torques can change."""
    return np.concatenate([motion.free_directions() @ speed[:3], motion.free_turns() @ speed[3:]])


def _reframed(body: LargeBody, center: Floats, inner: Floats) -> LargeBody:
    """The same body with its frame at `center` (3,) and in the orientation `inner` (4,) in its present frame."""
    moved = tuple(shapes.moved(part, center, inner) for part in body.shapes)
    place = body.position + quaternion.rotate(body.quaternion, center)
    return replace(body, shapes=moved, position=place, quaternion=quaternion.multiply(body.quaternion, inner))


def _centered(body: LargeBody, density: float) -> LargeBody:
    """The same body with its frame at the centre of mass along the principal axes, with mass and moments."""
    mass, center, tensor = shapes.mass_properties(body.shapes, density)
    moments, turn = quaternion.principal(tensor)
    return replace(_reframed(body, center, turn), mass=mass, inertia=moments, density=density)


def _turning(body: LargeBody, motion: Dynamic) -> LargeBody:
    """The same body with moments about those axes alone about which torques turn it. If there is only one, it is the z
    axis of its frame."""
    turns = motion.free_turns()
    if not turns.any():
        return replace(body, inertia=np.full(3, np.inf))
    if np.trace(turns) > 1.5:
        return body
    axis = motion.line if isinstance(motion, Hinged) else np.diag(turns)
    inverse_turn = quaternion.conjugate(body.quaternion)
    moment = float(body.inertia @ quaternion.rotate(inverse_turn, axis) ** 2)
    x = across(axis[None])[0]
    upright = quaternion.from_matrix(np.stack([x, np.cross(axis, x), axis], axis=1))
    turned = _reframed(body, np.zeros(3), quaternion.multiply(inverse_turn, upright))
    return replace(turned, quaternion=upright, inertia=np.array([np.inf, np.inf, moment]))


def least_half(body: LargeBody) -> float:
    """The least half extent of the shapes of a large body [m]; inf of half spaces."""
    solid = [(kind, size) for kind, _, _, size in map(shapes.placed, body.shapes) if kind != PLANE]
    return float(min((bodies.half_thickness(np.array([kind]), size[None])[0] for kind, size in solid), default=np.inf))


def _refuse_in_cell(scene: Scene, radius: float) -> None:
    """ValueError for what a scene with periods and grains of at most this radius [m] cannot have."""
    period, axes = scene.cell.period, np.flatnonzero(scene.cell.axes)
    for k in axes:
        if period[k] <= 4.0 * radius:
            raise ValueError(
                f"period of {period[k]:g} m along {'xyz'[k]} is too short: a grain could meet another one on both its "
                f"sides, or its own image; allowed is more than two greatest diameters, {4.0 * radius:g} m"
            )
    if scene.cell.moves:
        what = "cell of given stress" if scene.cell.deforms else "sheared cell"
        if scene.large_bodies:
            raise ValueError(f"large body {scene.large_bodies[0].name!r}: a {what} has grains alone")
        if scene.passages:
            raise ValueError(f"{scene.passages.names[0]!r}: a {what} has no sources and outlets")
    for body in scene.large_bodies:
        if wrong := scene.cell.why_refused(body.name, body.motion, body.shapes, body.quaternion):
            raise ValueError(wrong)
        for shape in body.shapes:
            kind, center, _, size = shapes.placed(shape)
            if kind == PLANE:
                continue
            middle = body.position + quaternion.rotate(body.quaternion, center)
            wide = float(bodies.enclosing_radius(np.array([kind]), size[None])[0])
            for k in axes:
                if not 0.0 <= middle[k] <= period[k] or 2.0 * (wide + radius) >= period[k]:
                    raise ValueError(
                        f"large body {body.name!r}: a {type(shape).__name__.lower()} must have its centre in the cell "
                        f"along {'xyz'[k]}, and a sphere about it and a grain must be shorter than the period of "
                        f"{period[k]:g} m"
                    )
