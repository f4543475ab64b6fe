"""The primitives of which large bodies are made, placed in the body frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from itertools import product
from typing import Any, Union, get_args

import numpy as np

from dem import quaternion
from dem.arrays import Floats, Ints
from dem.bodies import BOX, CAPSULE, CONVEX, MESH, PLANE, SPHERE, enclosing_radius
from dem.checks import check_fields, finite, positive, rows, unit_quaternion, unit_vector, vector
from dem.mesh import Mesh
from dem.shapes.convex import Convex, centred
from dem.shapes.cylinder import Cylinder
from dem.shapes.superellipsoid import Superellipsoid


@dataclass(frozen=True)
class Plane:
    """Half space: everything on the side of `center` away from the outward `normal` is solid."""

    normal: Sequence[float]  #: outward normal (3,), normalised
    center: Sequence[float] = (0.0, 0.0, 0.0)  #: a point of the surface (3,) [m]

    def __post_init__(self) -> None:
        check_fields(self, normal=unit_vector, center=vector)


@dataclass(frozen=True)
class Box:
    """Oriented box."""

    half_extents: Sequence[float]  #: (3,) [m]
    center: Sequence[float] = (0.0, 0.0, 0.0)  #: (3,) [m]
    quaternion: Sequence[float] = (1.0, 0.0, 0.0, 0.0)  #: (4,)

    def __post_init__(self) -> None:
        check_fields(self, half_extents=positive)
        check_fields(self, half_extents=vector, center=vector, quaternion=unit_quaternion)


@dataclass(frozen=True)
class Sphere:
    """A ball about its centre, as a shape of a large body; grains come by `Scene.add_spheres`."""

    radius: float  #: [m]
    center: Sequence[float] = (0.0, 0.0, 0.0)  #: (3,) [m]

    def __post_init__(self) -> None:
        check_fields(self, radius=positive, center=vector)


@dataclass(frozen=True)
class Capsule:
    """Cylinder with two half balls as its ends: all points within `radius` of a core segment along the z axis of its
    frame."""

    radius: float  #: [m]
    half_length: float  #: of the core segment [m]
    center: Sequence[float] = (0.0, 0.0, 0.0)  #: (3,) [m]
    quaternion: Sequence[float] = (1.0, 0.0, 0.0, 0.0)  #: (4,)

    def __post_init__(self) -> None:
        check_fields(self, radius=positive, half_length=positive, center=vector, quaternion=unit_quaternion)


#: The kinds of convex shapes that are known by their support functions.
CONVEX_SHAPES: tuple[type[Convex], ...] = (Cylinder, Superellipsoid)

Shape = Union[Plane, Box, Sphere, Capsule, Mesh, Convex]


@dataclass(frozen=True)
class Clump:
    """Spheres that are rigidly joined, overlapping or not: a shape of grains, see `dem.scene.Scene.add_clumps`."""

    centres: Sequence[Sequence[float]]  #: (k, 3) in the frame of the clump [m]
    radii: Sequence[float]  #: (k,) [m]

    def __post_init__(self) -> None:
        radii = np.atleast_1d(positive("Clump.radii", self.radii))
        if radii.ndim != 1 or not len(radii):
            raise ValueError(f"Clump.radii must have shape (k,), got {radii.shape}")
        centres = rows("Clump.centres", np.atleast_2d(finite("Clump.centres", self.centres)), len(radii), 3)
        if len(np.atleast_2d(self.centres)) != len(radii):
            raise ValueError(f"Clump: {len(np.atleast_2d(self.centres))} centres with {len(radii)} radii")
        object.__setattr__(self, "centres", tuple(map(tuple, centres.tolist())))
        object.__setattr__(self, "radii", tuple(radii.tolist()))


def refuse_other_than_shapes(name: str, given: Sequence[Any]) -> None:
    """Raise ValueError if something among the shapes of the body `name` is none."""
    for shape in given:
        if not isinstance(shape, get_args(Shape)):
            names = ", ".join(kind.__name__ for kind in (Plane, Box, Sphere, Capsule, Mesh, *CONVEX_SHAPES))
            raise ValueError(f"shapes of {name!r}: {shape!r} is none; allowed are {names} of pctt")


def described(shape: Shape) -> dict[str, Any]:
    """Return the kind of a shape and its parameters by name."""
    if isinstance(shape, Mesh):
        names = ("vertices", "triangles", "center", "quaternion")
        return {"kind": "Mesh", **{name: np.asarray(getattr(shape, name)).tolist() for name in names}}
    surface = centred(shape).described() if isinstance(shape, Convex) else {}
    return {"kind": type(shape).__name__, **asdict(shape), **surface}


def placed(shape: Shape) -> tuple[int, Floats, Floats, Floats]:
    """Return kind, centre (3,), quaternion (4,) and size (3,), as of `Bodies`, of a shape in the frame of its body; of
    a mesh those of the box about it, and as the size of a half space its normal. The kind of a convex shape is CONVEX,
    without the number of its form."""
    center, turn = np.array(shape.center), np.array(getattr(shape, "quaternion", (1.0, 0.0, 0.0, 0.0)))
    if isinstance(shape, Plane):
        return PLANE, center, turn, np.array(shape.normal)
    if isinstance(shape, Sphere):
        return SPHERE, center, turn, np.array([shape.radius, 0.0, 0.0])
    if isinstance(shape, Box):
        return BOX, center, turn, np.array(shape.half_extents)
    if isinstance(shape, Capsule):
        return CAPSULE, center, turn, np.array([shape.radius, shape.half_length, 0.0])
    if isinstance(shape, Convex):
        return CONVEX, center, turn, centred(shape).size
    return MESH, center + quaternion.rotate(turn, shape.surface.middle), turn, shape.surface.half


def outline(shape: Shape) -> tuple[Floats, Floats]:
    """Return points (n, 3), and radii (n,) of balls about them, whose hull holds a shape in the frame of its body [m]:
    the vertices of a mesh, the corners of a box, the ball about any other shape."""
    kind, place, turn, size = placed(shape)
    if isinstance(shape, Mesh):
        point = place + quaternion.rotate(turn, shape.surface.vertex)
    elif isinstance(shape, Box):
        point = place + quaternion.rotate(turn, size * np.array(list(product((-1.0, 1.0), repeat=3))))
    else:
        return place[None], enclosing_radius(np.array([kind]), size[None])
    return point, np.zeros(len(point))


def solid(kind: int, size: Floats, density: Floats) -> tuple[Floats, Floats]:
    """Return masses (n,) and principal moments (n, 3) of solid boxes, spheres or capsules of sizes (n, 3) and densities
    (n,).

    A capsule is a cylinder and two half balls, each with its centre of mass 3/8 radius off its base; a sphere is a
    capsule of length zero.
    """
    if kind == BOX:
        mass, squares = density * 8.0 * size.prod(axis=1), size**2
        return mass, mass[:, None] / 3.0 * (squares.sum(axis=1, keepdims=True) - squares)
    radius, half_length = size[:, 0], size[:, 1]
    cylinder, ball = density * 2.0 * np.pi * radius**2 * half_length, density * (4.0 / 3.0) * np.pi * radius**3
    moment = 0.4 * ball * radius**2
    axial = moment + 0.5 * cylinder * radius**2
    lateral = moment + ball * (half_length**2 + 0.75 * half_length * radius)
    lateral += cylinder * (radius**2 / 4.0 + half_length**2 / 3.0)
    return ball + cylinder, np.stack([lateral, lateral, axial], axis=1)


def volumes(kind: Ints, size: Floats) -> Floats:
    """Return the volumes (n,) of grains of kinds (n,) and sizes (n, 3), as of `Bodies` [m^3]."""
    out = 4.0 / 3.0 * np.pi * size[:, 1] ** 3
    for each in (SPHERE, BOX, CAPSULE):
        rows = kind == each
        out[rows] = solid(each, size[rows], np.ones(int(rows.sum())))[0]
    return out


def solid_properties(shape: Shape, density: float) -> tuple[float, Floats, Floats]:
    """Return the mass, centre of mass (3,) and inertia tensor (3, 3) about it of one shape, in the body frame;
    ValueError as of `mass_properties`."""
    kind, place, turn, size = placed(shape)
    frame = quaternion.matrix(turn)
    if isinstance(shape, Plane):
        raise ValueError("a half space has no finite mass: give mass and inertia, or a prescribed motion")
    if isinstance(shape, Mesh):
        volume, center, tensor = shape.solid()
        return density * volume, np.array(shape.center) + frame @ center, density * frame @ tensor @ frame.T
    if isinstance(shape, Convex):
        form = centred(shape)
        return density * form.volume, place, density * (frame * form.moments) @ frame.T
    mass, moments = solid(kind, size[None], np.array([density]))
    return float(mass[0]), place, (frame * moments[0]) @ frame.T


def mass_properties(shapes: Sequence[Shape], density: float) -> tuple[float, Floats, Floats]:
    """Return the mass, centre of mass (3,) and inertia tensor (3, 3) about it, in the body frame.

    Volumes that shapes share count once for each of them. ValueError for half spaces and for meshes that are open or
    have their normals inwards: they have no mass.
    """
    masses, centers, tensors = (np.array(column) for column in zip(*(solid_properties(s, density) for s in shapes)))
    total = masses.sum()
    center = masses @ centers / total
    arms = centers - center
    # Parallel axes: m (|r|^2 E - r r') for every part.
    steiner = np.sum(masses * (arms**2).sum(axis=1)) * np.eye(3) - (arms.T * masses) @ arms
    return float(total), center, tensors.sum(axis=0) + steiner


def moved(shape: Shape, center: Floats, turn: Floats) -> Shape:
    """Return the shape in a frame with origin `center` (3,) and orientation `turn` (4,) in the present one."""
    inverse_turn = quaternion.conjugate(turn)
    changes: dict[str, Any] = {"center": quaternion.rotate(inverse_turn, np.array(shape.center) - center)}
    if isinstance(shape, Plane):
        changes["normal"] = quaternion.rotate(inverse_turn, np.array(shape.normal))
    elif not isinstance(shape, Sphere):
        changes["quaternion"] = quaternion.multiply(inverse_turn, np.array(shape.quaternion))
    return replace(shape, **changes)
