"""The table of rigid bodies: one row per body, one array per quantity."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np

from dem import quaternion
from dem.arrays import Bools, Floats, Ints, Tabular
from dem.compiled import inlined, loop

#: Kinds of bodies (the column `shape`); a COMPOUND is a large body, its primitives are kept elsewhere. Half spaces and
#: meshes are parts of large bodies only.
SPHERE, BOX, COMPOUND, CAPSULE, PLANE, MESH = range(6)

#: Shapes of grains that a scene describes, its forms (`dem.shapes.forms.Form`), are the kinds from here on. Their
#: `size` is
#: alike, so that nothing else needs to know what they are.
FORM = 6

#: Of clumps of spheres, of convex polyhedra, and of other convex bodies: CLUMP + n, POLYHEDRON + n or CONVEX + n has
#: the form n of `dem.scene.Scene.forms`.
CLUMP, POLYHEDRON, CONVEX = FORM, 1 << 20, 1 << 21


@dataclass(repr=False)
class Bodies(Tabular):
    """Rigid bodies as a struct of arrays; all vectors in the world frame, SI units.

    Bodies whose motion is prescribed have infinite mass and moments, so that every inverse is exactly zero.
    """

    id: Ints  #: (n,) persistent number: grains first, then large bodies
    position: Floats  #: (n, 3) centre of mass; of a body with prescribed motion its reference point [m]
    quaternion: Floats  #: (n, 4) orientation (w, x, y, z)
    velocity: Floats  #: (n, 6) linear [m/s] and angular [rad/s] velocity
    mass: Floats  #: (n,) [kg]
    inertia: Floats  #: (n, 3) principal moments of inertia in the body frame [kg m^2]
    material: Ints  #: (n,) row of the friction table
    shape: Ints  #: (n,) SPHERE, BOX, CAPSULE, COMPOUND, or that of a form
    #: (n, 3) sphere: (radius, 0, 0); box: half extents; capsule: (radius, half length, 0); form: radii of the sphere
    #: that encloses it, of the ball of its volume, and of its largest sphere [m]
    size: Floats
    weight: Floats  #: (n,) contacts owned at the last search, the load that balancing spreads

    def __len__(self) -> int:
        return len(self.id)

    def columns(self) -> dict[str, np.ndarray]:
        """The arrays by name, without copies."""
        return dict(vars(self))

    def copy(self) -> Bodies:
        """Another table of the same arrays."""
        return Bodies(**vars(self))

    def take(self, rows: Ints | Bools | slice) -> Bodies:
        """The bodies of the given rows (index array, mask or slice)."""
        if isinstance(rows, slice):
            return Bodies(**{name: column[rows] for name, column in self.columns().items()})
        index: Ints = np.arange(len(self))[rows]
        return Bodies(**{name: column.take(index, axis=0) for name, column in self.columns().items()})


def concatenate(parts: Sequence[Bodies]) -> Bodies:
    """Return one table of the rows of several, in their order."""
    names = [field.name for field in fields(Bodies)]
    return Bodies(**{name: np.concatenate([getattr(part, name) for part in parts]) for name in names})


def none() -> Bodies:
    """Return a table without rows."""
    vectors, numbers, whole = np.zeros((0, 3)), np.zeros(0), np.zeros(0, np.int64)
    turn, velocity = np.zeros((0, 4)), np.zeros((0, 6))
    return Bodies(whole, vectors, turn, velocity, numbers, vectors, whole, whole, vectors, numbers)


def is_dynamic(bodies: Bodies) -> Bools:
    """Return the mask (n,) of the bodies that forces can move."""
    return np.isfinite(bodies.mass)


def bounding_radius(bodies: Bodies) -> Floats:
    """Return the radius (n,) of the sphere about the centre that encloses a grain [m]."""
    return enclosing_radius(bodies.shape, bodies.size)


@loop
def enclosing_radius(kind: Ints, size: Floats) -> Floats:
    """Radius (n,) of the sphere about the centre that encloses a shape of kind (n,) and size (n, 3) [m]."""
    out = np.empty(len(kind))
    for n in range(len(kind)):
        out[n] = radius_about(kind[n], size[n])
    return out


@inlined
def radius_about(kind, size):
    """The same of one shape."""
    radius = np.sqrt(size[0] ** 2 + size[1] ** 2 + size[2] ** 2)
    if kind == CAPSULE:
        radius = size[0] + size[1]
    elif kind >= FORM:
        radius = size[0]
    return radius


def least_half_thickness(bodies: Bodies) -> Floats:
    """Return the radius (n,) of the greatest sphere that fits into a grain [m]."""
    return half_thickness(bodies.shape, bodies.size)


@loop
def half_thickness(kind: Ints, size: Floats) -> Floats:
    """Return the radius (n,) of the greatest sphere that fits into a shape of kind (n,) and size (n, 3), as of
    `dem.shapes.placed` [m]; of a mesh into the box about it."""
    half = np.empty(len(kind))
    for n in range(len(kind)):
        half[n] = half_of(kind[n], size[n])
    return half


@inlined
def half_of(kind, size):
    """The same of one shape."""
    if kind in (BOX, MESH):
        return min(size[0], size[1], size[2])
    return size[2] if kind >= FORM else size[0]


def turning(bodies: Bodies) -> Floats:
    """Return angular speeds (n,) of bodies that are no spheres [rad/s]; zero of spheres, and of what does not turn
    freely."""
    return _turning(bodies.velocity, bodies.inertia, bodies.shape)


@loop
def _turning(velocity: Floats, inertia: Floats, shape: Ints) -> Floats:
    out = np.zeros(len(shape))
    for n in range(len(shape)):
        held = np.isinf(inertia[n, 0]) or np.isinf(inertia[n, 1]) or np.isinf(inertia[n, 2])
        if shape[n] != SPHERE and not held:
            out[n] = np.hypot(np.hypot(velocity[n, 3], velocity[n, 4]), velocity[n, 5])  # squares could overflow
    return out


def inverse_root_inertia(bodies: Bodies) -> Floats:
    """Return symmetric square roots (n, 3, 3) of the inverse inertia tensors in the world frame."""
    turn = quaternion.matrix(bodies.quaternion)
    return (turn / np.sqrt(bodies.inertia)[:, None, :]) @ turn.transpose(0, 2, 1)
