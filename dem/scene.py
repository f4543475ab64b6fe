"""Description of a scene: its bodies, materials and gravity at time zero.

A scene is the same on every rank and knows nothing of ranks; `dem.start.new_world` distributes it.

    scene = Scene(friction=0.3)
    scene.add_body("floor", [Plane(normal=(0, 0, 1))])
    scene.add_spheres(positions, radius=0.1, density=2500.0)
    world = new_world(scene, MPI.COMM_WORLD)
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from dem import bodies, checks, quaternion, shapes
from dem.arrays import ArrayLike, Floats, Ints
from dem.bodies import BOX, CAPSULE, COMPOUND, SPHERE, Bodies
from dem.mesh import Mesh
from dem.motion import Driven, Dynamic, Fixed, Guided, Hinged, Motion
from dem.quaternion import across, length
from dem.shapes import Box, Shape


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


class Scene:
    """Collects grains, large bodies, materials and gravity; checks each as it comes (ValueError)."""

    def __init__(
        self,
        friction: float,
        gravity: Sequence[float] = (0.0, 0.0, -9.81),
        stiffness: float | None = None,
        restitution: float = 0.0,
    ) -> None:
        """`friction`: coefficient, `stiffness` [N/m] and coefficient of `restitution` of the contacts of all pairs of
        materials not set otherwise; `gravity`: (3,) [m/s^2]. A stiffness of inf is that of rigid contacts; None:
        `dem.stiffness.recommended`.
        """
        self.gravity = checks.vector("gravity", gravity)
        self.large_bodies: list[LargeBody] = []
        self._friction = float(checks.not_negative("friction", friction))
        self.stiffness = None if stiffness is None else _stiffness(stiffness)  #: [N/m]; None: not stated
        #: Names of large bodies that go away from the grains: their speed asks for no stiffness.
        self.leaving: set[str] = set()
        self._restitution = _restitution(restitution)
        self._pairs: dict[str, dict[tuple[int, int], float]] = {"friction": {}, "stiffness": {}, "restitution": {}}
        self._materials: dict[str, int] = {}
        self._grains: list[Bodies] = []

    def add_spheres(
        self,
        positions: ArrayLike,
        radius: ArrayLike,
        density: ArrayLike,
        *,
        material: str = "default",
        velocity: ArrayLike = (0.0, 0.0, 0.0),
        angular_velocity: ArrayLike = (0.0, 0.0, 0.0),
    ) -> Ints:
        """Add solid spheres and return their ids (n,).

        positions (n, 3) [m]; radius [m] and density [kg/m^3] one for all or (n,); velocities (3,) or (n, 3).
        """
        upright, lengths = (1.0, 0.0, 0.0, 0.0), {"radius": radius}
        return self._add_grains(SPHERE, positions, lengths, density, material, upright, velocity, angular_velocity)

    def add_boxes(
        self,
        positions: ArrayLike,
        half_extents: ArrayLike,
        density: ArrayLike,
        *,
        quaternions: ArrayLike = (1.0, 0.0, 0.0, 0.0),
        material: str = "default",
        velocity: ArrayLike = (0.0, 0.0, 0.0),
        angular_velocity: ArrayLike = (0.0, 0.0, 0.0),
    ) -> Ints:
        """Add solid boxes and return their ids (n,).

        positions (n, 3) and half extents (3,) or (n, 3) [m]; density [kg/m^3] one for all or (n,);
        quaternions (4,) or (n, 4); velocities (3,) or (n, 3).
        """
        lengths = {"half extents": half_extents}
        return self._add_grains(BOX, positions, lengths, density, material, quaternions, velocity, angular_velocity)

    def add_capsules(
        self,
        positions: ArrayLike,
        radius: ArrayLike,
        half_length: ArrayLike,
        density: ArrayLike,
        *,
        quaternions: ArrayLike = (1.0, 0.0, 0.0, 0.0),
        material: str = "default",
        velocity: ArrayLike = (0.0, 0.0, 0.0),
        angular_velocity: ArrayLike = (0.0, 0.0, 0.0),
    ) -> Ints:
        """Add solid capsules, along the z axes of their frames, and return their ids (n,).

        positions (n, 3) [m]; radius, half length of the core segment [m] and density [kg/m^3] one for all or (n,);
        quaternions (4,) or (n, 4); velocities (3,) or (n, 3).
        """
        lengths = {"radius": radius, "half length": half_length}
        return self._add_grains(CAPSULE, positions, lengths, density, material, quaternions, velocity, angular_velocity)

    def add_body(
        self,
        name: str,
        shapes: Sequence[Shape],
        motion: Motion = Fixed(),  # noqa: B008 - immutable
        *,
        position: Sequence[float] = (0.0, 0.0, 0.0),
        quaternion: Sequence[float] = (1.0, 0.0, 0.0, 0.0),
        material: str = "default",
        density: float | None = None,
        mass: float | None = None,
        inertia: Sequence[float] | None = None,
        velocity: Sequence[float] = (0.0, 0.0, 0.0),
        angular_velocity: Sequence[float] = (0.0, 0.0, 0.0),
    ) -> None:
        """Add a large body made of `shapes`, which are placed in its body frame.

        The pose and the velocities are those of time zero. A dynamic body needs either its `density` [kg/m^3], or its
        `mass` [kg] and principal moments `inertia` (3,) [kg m^2]. With a density, its frame is moved to the centre of
        mass and the principal axes; with a mass, the frame must be there already. A guided body needs no moments. The
        frame of a hinged body is turned until its z axis is that of the hinge, and its centre of mass must be on that
        axis. Two large bodies touch if at least one of them is dynamic.
        """
        if not name or name in (body.name for body in self.large_bodies):
            raise ValueError(f"large bodies need distinct names, got {name!r}")
        if not shapes:
            raise ValueError(f"large body {name!r} has no shape")
        place = checks.vector(f"position of {name!r}", position)
        turn = checks.unit_quaternion(f"quaternion of {name!r}", quaternion)
        speed = _velocities(velocity, angular_velocity, 1)[0]
        _refuse_speed(name, motion, speed)
        body = LargeBody(name, tuple(shapes), motion, -1, place, turn, speed, np.inf, np.full(3, np.inf))
        if not isinstance(motion, Dynamic):
            pass
        elif density is not None and mass is None and inertia is None:
            body = _centered(body, float(checks.positive(f"density of {name!r}", density)))
        elif density is None and mass is not None and (inertia is not None or isinstance(motion, Guided)):
            body = replace(body, mass=float(checks.positive(f"mass of {name!r}", mass)))
            if inertia is not None:
                moments = checks.positive(f"inertia of {name!r}", inertia)
                body = replace(body, inertia=checks.vector(f"inertia of {name!r}", moments))
        else:
            raise ValueError(f"dynamic body {name!r} needs either its density or both mass and inertia")
        if isinstance(motion, Guided):
            body = replace(body, inertia=np.full(3, np.inf))
        if isinstance(motion, Hinged):
            body = _on_hinge(body, motion.line, body.position - place)
        self.large_bodies.append(replace(body, material=self._material(material)))

    def set_friction(self, friction: float, material: str, other: str) -> None:
        """Friction coefficient between two materials (which may be the same one)."""
        self._set_pair("friction", float(checks.not_negative("friction", friction)), material, other)

    def set_stiffness(self, stiffness: float, material: str, other: str) -> None:
        """Stiffness of the contacts of two materials (which may be the same one) [N/m]; inf: rigid."""
        self._set_pair("stiffness", _stiffness(stiffness), material, other)

    def set_restitution(self, restitution: float, material: str, other: str) -> None:
        """Coefficient of restitution of impacts between two materials (which may be the same one), from 0 to 1."""
        self._set_pair("restitution", _restitution(restitution), material, other)

    def _set_pair(self, name: str, value: float, material: str, other: str) -> None:
        one, two = sorted((self._material(material), self._material(other)))
        self._pairs[name][one, two] = value

    @property
    def materials(self) -> tuple[str, ...]:
        """The names of the materials, in the order of their numbers."""
        return tuple(self._materials)

    def friction_table(self) -> Floats:
        """Friction coefficients (materials, materials), symmetric."""
        return self._table("friction", self._friction)

    def stiffness_table(self, usual: float) -> Floats:
        """Stiffnesses of contacts (materials, materials), symmetric [N/m]; the `usual` one of pairs not set."""
        return self._table("stiffness", usual)

    @property
    def states_stiffness(self) -> bool:
        """Whether the stiffness of all or some contacts was stated."""
        return self.stiffness is not None or bool(self._pairs["stiffness"])

    def restitution_table(self) -> Floats:
        """Coefficients of restitution (materials, materials), symmetric."""
        return self._table("restitution", self._restitution)

    def _table(self, name: str, usual: float) -> Floats:
        table = np.full((len(self._materials), len(self._materials)), usual)
        for (i, j), value in self._pairs[name].items():
            table[i, j] = table[j, i] = value
        return table

    def grains(self) -> Bodies:
        """All grains, in the order of their ids. ValueError if there is none, or if a mesh might meet boxes or other
        meshes, which it cannot touch."""
        if sum(len(part) for part in self._grains) == 0:
            raise ValueError("empty scene: there is no grain")
        _refuse_beside_meshes(self.large_bodies, any((part.shape == BOX).any() for part in self._grains))
        return bodies.concatenate(self._grains)

    def large(self) -> Bodies:
        """The table of the large bodies at time zero, in the order in which they were added."""
        count, first = len(self.large_bodies), sum(len(part) for part in self._grains)
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
        return self._materials.setdefault(name, len(self._materials))

    def _add_grains(
        self, kind: int, positions: ArrayLike, lengths: dict[str, ArrayLike], density: ArrayLike, material: str,
        quaternions: ArrayLike, velocity: ArrayLike, angular_velocity: ArrayLike,
    ) -> Ints:  # fmt: skip
        """Add grains of one kind, of which `lengths` has the columns of `size` by name; their ids."""
        centers = np.atleast_2d(checks.finite("positions", positions))
        count, first = len(centers), sum(len(part) for part in self._grains)
        size = np.zeros((count, 3))
        for k, (name, values) in enumerate(lengths.items()):
            column, row = (slice(None), (3,)) if kind == BOX else (k, ())
            size[:, column] = checks.rows(name, checks.positive(name, values), count, *row)
        mass, inertia = shapes.solid(kind, size, checks.rows("density", checks.positive("density", density), count))
        table = Bodies(
            id=np.arange(first, first + count),
            position=checks.rows("positions", centers, count, 3),
            quaternion=checks.unit_quaternions("quaternions", quaternions, count),
            velocity=_velocities(velocity, angular_velocity, count),
            mass=mass,
            inertia=inertia,
            material=np.full(count, self._material(material)),
            shape=np.full(count, kind),
            size=size,
            weight=np.zeros(count),
        )
        self._grains.append(table)
        return table.id


def _restitution(value: float) -> float:
    checks.between(0.0, 1.0)("restitution", value)
    return float(value)


def _stiffness(value: float) -> float:
    if not float(value) > 0.0:
        raise ValueError(f"stiffness must be a positive number or inf, got {value}")
    return float(value)


def _refuse_speed(name: str, motion: Motion, speed: Floats) -> None:
    """ValueError for an initial velocity (6,) that the motion does not allow."""
    if not isinstance(motion, Dynamic) and speed.any():
        raise ValueError(f"the motion of {name!r} is prescribed: it takes no initial velocity")
    if isinstance(motion, Driven):
        allowed, other = (speed[:3], speed[3:]) if isinstance(motion, Guided) else (speed[3:], speed[:3])
        if other.any() or length(np.cross(motion.line, allowed)) > 1e-12 * length(allowed):
            kind, along = ("guided", "along the guide") if isinstance(motion, Guided) else ("hinged", "about the hinge")
            raise ValueError(f"{name!r} is {kind}: its initial velocity must be {along}")


def _reframed(body: LargeBody, center: Floats, inner: Floats) -> LargeBody:
    """The same body with its frame at `center` (3,) and in the orientation `inner` (4,) in its present frame."""
    moved = tuple(shapes.moved(part, center, inner) for part in body.shapes)
    place = body.position + quaternion.rotate(body.quaternion, center)
    return replace(body, shapes=moved, position=place, quaternion=quaternion.multiply(body.quaternion, inner))


def _centered(body: LargeBody, density: float) -> LargeBody:
    """The same body with its frame at the centre of mass along the principal axes, with mass and moments."""
    mass, center, tensor = shapes.mass_properties(body.shapes, density)
    moments, axes = np.diag(tensor).copy(), np.eye(3)
    if np.abs(tensor - np.diag(moments)).max() > 1e-12 * moments.max():
        moments, axes = np.linalg.eigh(tensor)
        axes[:, 2] *= np.linalg.det(axes)  # right-handed
    return replace(_reframed(body, center, quaternion.from_matrix(axes)), mass=mass, inertia=moments)


def _on_hinge(body: LargeBody, axis: Floats, arm: Floats) -> LargeBody:
    """The same body in a frame whose z axis is the axis (3,) of its hinge, with a moment about that alone. ValueError
    if its centre of mass, at `arm` (3,) from a point of the axis, is not on it."""
    if length(np.cross(axis, arm)) > 1e-6 * max(length(arm), np.sqrt(body.inertia.max() / body.mass)):
        raise ValueError(f"{body.name!r} is hinged: its centre of mass must be on the axis through its position")
    back = quaternion.conjugate(body.quaternion)
    moment = float(body.inertia @ quaternion.rotate(back, axis) ** 2)
    x = across(axis[None])[0]
    upright = quaternion.from_matrix(np.stack([x, np.cross(axis, x), axis], axis=1))
    turned = _reframed(body, np.zeros(3), quaternion.multiply(back, upright))
    return replace(turned, quaternion=upright, inertia=np.array([np.inf, np.inf, moment]))


def _refuse_beside_meshes(members: Sequence[LargeBody], box_grains: bool) -> None:
    """ValueError for pairs of a mesh and a box or another mesh that might meet: they have no contacts."""
    for body in members:
        if not any(isinstance(shape, Mesh) for shape in body.shapes):
            continue
        if box_grains:
            raise ValueError(f"grains that are boxes cannot touch the mesh of {body.name!r}: take spheres or capsules")
        for other in members:
            moves = isinstance(body.motion, Dynamic) or isinstance(other.motion, Dynamic)
            kinds = [type(shape).__name__ for shape in other.shapes if isinstance(shape, (Box, Mesh))]
            if other is not body and moves and kinds:
                raise ValueError(
                    f"the {kinds[0].lower()} of {other.name!r} cannot touch the mesh of {body.name!r}, of which one is "
                    "dynamic: make the other of planes, spheres or capsules"
                )


def _velocities(linear: ArrayLike, angular: ArrayLike, count: int) -> Floats:
    return np.hstack([checks.rows("velocity", linear, count, 3), checks.rows("angular velocity", angular, count, 3)])
