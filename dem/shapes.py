"""The primitives of which large bodies are made, placed in the body frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, Union

import numpy as np

from dem import quaternion
from dem.arrays import Floats
from dem.checks import finite_vector, positive, unit_quaternion, unit_vector
from dem.mesh import Mesh


@dataclass(frozen=True)
class Plane:
    """Half space: everything on the side of `center` away from the outward `normal` is solid."""

    normal: Sequence[float]  #: outward normal (3,), normalised
    center: Sequence[float] = (0.0, 0.0, 0.0)  #: a point of the surface (3,) [m]

    def __post_init__(self) -> None:
        object.__setattr__(self, "normal", unit_vector("normal of a plane", self.normal))
        object.__setattr__(self, "center", finite_vector("point of a plane", self.center))


@dataclass(frozen=True)
class Box:
    """Oriented box."""

    half_extents: Sequence[float]  #: (3,) [m]
    center: Sequence[float] = (0.0, 0.0, 0.0)  #: (3,) [m]
    quaternion: Sequence[float] = (1.0, 0.0, 0.0, 0.0)  #: (4,)

    def __post_init__(self) -> None:
        positive("half extents of a box", self.half_extents)
        object.__setattr__(self, "half_extents", finite_vector("half extents of a box", self.half_extents))
        object.__setattr__(self, "center", finite_vector("centre of a box", self.center))
        object.__setattr__(self, "quaternion", unit_quaternion("quaternion of a box", self.quaternion))


@dataclass(frozen=True)
class Sphere:
    """Ball."""

    radius: float  #: [m]
    center: Sequence[float] = (0.0, 0.0, 0.0)  #: (3,) [m]

    def __post_init__(self) -> None:
        positive("radius of a sphere", self.radius)
        object.__setattr__(self, "center", finite_vector("centre of a sphere", self.center))


@dataclass(frozen=True)
class Capsule:
    """Cylinder with two half balls as its ends: all points within `radius` of a core segment along the z axis of its
    frame."""

    radius: float  #: [m]
    half_length: float  #: of the core segment [m]
    center: Sequence[float] = (0.0, 0.0, 0.0)  #: (3,) [m]
    quaternion: Sequence[float] = (1.0, 0.0, 0.0, 0.0)  #: (4,)

    def __post_init__(self) -> None:
        positive("radius of a capsule", self.radius)
        positive("half length of a capsule", self.half_length)
        object.__setattr__(self, "center", finite_vector("centre of a capsule", self.center))
        object.__setattr__(self, "quaternion", unit_quaternion("quaternion of a capsule", self.quaternion))


Shape = Union[Plane, Box, Sphere, Capsule, Mesh]


def described(shape: Shape) -> dict[str, Any]:
    """The kind of a shape and its parameters by name."""
    if isinstance(shape, Mesh):
        names = ("vertices", "triangles", "center", "quaternion")
        return {"kind": "Mesh", **{name: np.asarray(getattr(shape, name)).tolist() for name in names}}
    return {"kind": type(shape).__name__, **asdict(shape)}


def sphere_mass(radius: Floats, density: Floats) -> tuple[Floats, Floats]:
    """Masses (n,) and principal moments (n, 3) of solid spheres of radius (n,) and density (n,)."""
    mass = density * (4.0 / 3.0) * np.pi * radius**3
    return mass, np.repeat((0.4 * mass * radius**2)[:, None], 3, axis=1)


def box_mass(half_extents: Floats, density: Floats) -> tuple[Floats, Floats]:
    """Masses (n,) and principal moments (n, 3) of solid boxes of half extents (n, 3) and density (n,)."""
    mass = density * 8.0 * half_extents.prod(axis=1)
    squares = half_extents**2
    return mass, mass[:, None] / 3.0 * (squares.sum(axis=1, keepdims=True) - squares)


def capsule_mass(radius: Floats, half_length: Floats, density: Floats) -> tuple[Floats, Floats]:
    """Masses (n,) and principal moments (n, 3), the axis last, of solid capsules of radius, half length of the core
    segment and density (n,): a cylinder and two half balls, each with its centre of mass 3/8 radius off its base."""
    cylinder = density * 2.0 * np.pi * radius**2 * half_length
    ball, moments = sphere_mass(radius, density)
    axial = 0.5 * cylinder * radius**2 + moments[:, 0]
    lateral = cylinder * (radius**2 / 4.0 + half_length**2 / 3.0)
    lateral += moments[:, 0] + ball * (half_length**2 + 0.75 * half_length * radius)
    return cylinder + ball, np.stack([lateral, lateral, axial], axis=1)


def solid_properties(shape: Shape, density: float) -> tuple[float, Floats, Floats]:
    """Mass, centre of mass (3,) and inertia tensor (3, 3) about it of one shape, in the body frame; ValueError as of
    `mass_properties`."""
    if isinstance(shape, Plane):
        raise ValueError("a half space has no finite mass: give mass and inertia, or a prescribed motion")
    place = np.array(shape.center)
    turn = np.eye(3) if isinstance(shape, Sphere) else quaternion.matrix(np.array(shape.quaternion))
    if isinstance(shape, Mesh):
        shape.surface.refuse_unless_solid()
        volume, first, second = shape.surface.integrals()
        center = first / volume
        spread = second - volume * np.outer(center, center)
        tensor = density * turn @ (np.trace(spread) * np.eye(3) - spread) @ turn.T
        return density * volume, place + turn @ (shape.surface.middle + center), tensor
    solid = np.array([density])
    if isinstance(shape, Sphere):
        mass, moments = sphere_mass(np.array([shape.radius]), solid)
    elif isinstance(shape, Box):
        mass, moments = box_mass(np.array([shape.half_extents]), solid)
    else:
        mass, moments = capsule_mass(np.array([shape.radius]), np.array([shape.half_length]), solid)
    return float(mass[0]), place, (turn * moments[0]) @ turn.T


def mass_properties(shapes: Sequence[Shape], density: float) -> tuple[float, Floats, Floats]:
    """Mass, centre of mass (3,) and inertia tensor (3, 3) about it, in the body frame.

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
    """The shape in a frame with origin `center` (3,) and orientation `turn` (4,) in the present one."""
    back = quaternion.conjugate(turn)
    place = tuple(quaternion.rotate(back, np.array(shape.center) - center).tolist())
    if isinstance(shape, Plane):
        return Plane(tuple(quaternion.rotate(back, np.array(shape.normal)).tolist()), place)
    if isinstance(shape, Sphere):
        return replace(shape, center=place)
    orientation = quaternion.multiply(back, np.array(shape.quaternion))
    return replace(shape, center=place, quaternion=tuple(orientation.tolist()))
