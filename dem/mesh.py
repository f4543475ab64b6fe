"""Surfaces made of triangles: tools such as buckets, wheels, hoppers and drums, drawn elsewhere or turned on a lathe.

A surface has no thickness and two sides; a body that touches it stays on its side. A closed surface whose normals point
outwards bounds a solid, which has volume, centre and inertia.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from dem.arrays import ArrayLike, Bools, Floats, Ints
from dem.checks import between, check_fields, finite, not_negative, number, positive, rows, unit_quaternion, vector
from dem.compiled import loop
from dem.geometry import obj, stl
from dem.quaternion import cross, length

SIDE = 1 << 20  # more cubes than any side of a neighbourhood has

#: One number for the integer coordinates of a cube.
_CODE = np.array([SIDE * SIDE, SIDE, 1])


class Closest(NamedTuple):
    """Where triangles are closest to points."""

    point: Floats  #: (m, 3) [m]
    feature: Ints  #: (m,) of the surface: a triangle, an edge or a vertex
    distance: Floats  #: (m,) [m]


class Cells(NamedTuple):
    """Cubes that tile the neighbourhood of a surface, each with the triangles that come within a reach of it."""

    low: Floats  #: (3,) lowest corner of all [m]
    width: float  #: of a cube [m]
    code: Ints  #: (cubes,) numbers of the cubes that have triangles, ascending
    start: Ints  #: (cubes + 1,)
    triangle: Ints  #: (start[-1],)


def _unit(vector: Floats) -> Floats:
    """Vectors (..., 3) over their lengths; zero where these are."""
    size = length(vector)[..., None]
    return vector / np.where(size > 0.0, size, 1.0)


class Surface:
    """Triangles with the edges and vertices that they share, and cells in which they are found.

    Features are numbered: the triangles, then the edges, then the vertices.

    Attributes, of m triangles and n vertices, about the middle of the box that encloses them:
        middle (3,): middle of the box in the frame of the vertices that were given [m]
        half (3,): half extents of the box [m]
        vertex (n, 3), triangle (m, 3): places [m], and rows of vertices
        corner (m, 3, 3), normal (m, 3): places of the corners; unit normals by the order of the corners, zero
            where a triangle has no area
        edge (edges, 2): rows of vertices, the lower one first
        side (m, 3): the edges from each corner to the next
    """

    def __init__(self, vertices: Floats, triangles: Ints) -> None:
        low, high = vertices.min(axis=0), vertices.max(axis=0)
        self.middle, self.half = 0.5 * (low + high), 0.5 * (high - low)
        self.vertex, self.triangle = vertices - self.middle, triangles
        self.corner = self.vertex[triangles]
        across = cross(self.corner[:, 1] - self.corner[:, 0], self.corner[:, 2] - self.corner[:, 0])
        longest = length(self.corner - np.roll(self.corner, -1, axis=1)).max(axis=1)
        area = length(across)
        flat = area <= 1e-10 * longest**2
        self.normal = np.where(flat[:, None], 0.0, across / np.where(flat, 1.0, area)[:, None])
        self._center = self.corner.mean(axis=1)
        self._radius = length(self.corner - self._center[:, None]).max(axis=1)
        ends = np.stack([triangles, np.roll(triangles, -1, axis=1)], axis=2).reshape(-1, 2)
        self.edge, side = np.unique(np.sort(ends, axis=1), axis=0, return_inverse=True)
        self.side = side.reshape(-1, 3)
        self.features = len(triangles) + len(self.edge) + len(vertices)
        self._cells: dict[int, Cells] = {}

    @cached_property
    def around(self) -> tuple[Ints, Floats]:
        """The ways around edges and vertices (start, unit vectors), in the order of features without the triangles:
        from an edge across its triangles, from a vertex along the edges that end there."""
        count, along = len(self.edge), _unit(np.roll(self.corner, -1, axis=1) - self.corner)
        across = np.roll(self.corner, 1, axis=1) - self.corner  # the edge from corner k is opposite corner k + 2
        across -= np.einsum("mki,mki->mk", across, along)[:, :, None] * along
        ends = _unit(self.vertex[self.edge[:, 1]] - self.vertex[self.edge[:, 0]])
        of = np.concatenate([self.side.ravel(), count + self.edge[:, 0], count + self.edge[:, 1]])
        way = np.concatenate([_unit(across).reshape(-1, 3), ends, -ends])
        start = np.concatenate([[0], np.cumsum(np.bincount(of, minlength=count + len(self.vertex)))])
        return start, way[np.argsort(of, kind="stable")]

    @cached_property
    def loose(self) -> Bools:
        """Which edges, and behind them which vertices (edges + vertices,), other triangles may meet that do not have
        them: edges that are not those of two triangles, and their ends."""
        edges = np.bincount(self.side.ravel(), minlength=len(self.edge)) != 2
        vertices = np.zeros(len(self.vertex), bool)
        vertices[self.edge[edges]] = True
        return np.concatenate([edges, vertices])

    @cached_property
    def ridges(self) -> np.ndarray:
        """Which edges (edges,) are no mere lines in a flat face: open ones, and those where faces meet at an angle."""
        count = np.bincount(self.side.ravel(), minlength=len(self.edge))
        face = np.argsort(self.side.ravel(), kind="stable") // 3  # edge by edge
        first = np.cumsum(count) - count
        second = np.minimum(first + 1, len(face) - 1)
        sine = length(cross(self.normal[face[first]], self.normal[face[second]]))
        return (count != 2) | (sine > 1e-5)

    @cached_property
    def beyond(self) -> tuple[Ints, Ints, Ints]:
        """The triangles beyond the sides of triangles (m, 3); whether they go up there, as seen along the normal (1),
        down (-1), or on in the plane (0) (m, 3), which they also do where there is none or more than one; and the same
        of these triangles, as seen from those beyond (m, 3)."""
        side, face = self.side.ravel(), np.repeat(np.arange(len(self.triangle)), 3)
        order = np.argsort(side, kind="stable")
        one, two = order[:-1], order[1:]
        shared = (np.bincount(side)[side[one]] == 2) & (side[one] == side[two])
        one, two = one[shared], two[shared]
        other = np.full(len(side), -1)
        other[one], other[two] = two, one
        opposite = np.roll(self.corner, 1, axis=1).reshape(-1, 3)
        away = opposite[other] - self.corner[face, 0]
        sine = np.einsum("ki,ki->k", away, self.normal[face]) / np.maximum(length(away), 1e-300)
        turn = np.where((other < 0) | (np.abs(sine) < 1e-9), 0.0, np.sign(sine)).astype(np.int64)
        return face[other].reshape(-1, 3), turn.reshape(-1, 3), turn[other].reshape(-1, 3)

    @cached_property
    def hull(self) -> Ints:
        """The vertices that a plane can touch first: those of the convex hull, or all where that has no volume."""
        try:
            return np.sort(ConvexHull(self.vertex).vertices).astype(np.int64)
        except QhullError:
            return np.arange(len(self.vertex))

    def near(self, points: Floats, reach: Floats) -> tuple[Ints, Ints]:
        """Pairs (rows of points, triangles), by rows; at least all triangles within reach (n,) [m] of points (n, 3)."""
        level = np.frexp(reach)[1]
        found = []
        for k in np.unique(level):
            cells = self._table(int(k))
            row, entry = _entries(points, (level == k).nonzero()[0], cells.low, cells.width, cells.code, cells.start)
            found.append((row, cells.triangle[entry]))
        row, triangle = found[0] if found else (np.zeros(0, np.int64),) * 2
        if len(found) > 1:
            row, triangle = map(np.concatenate, zip(*found))
            order = np.argsort(row, kind="stable")
            row, triangle = row[order], triangle[order]
        close = self._within(points, row, triangle, reach * (1.0 + 1e-9))
        return row[close], triangle[close]

    def _within(self, points: Floats, row: Ints, triangle: Ints, reach: Floats) -> Ints:
        """Which of triangles (m,) may be within reach (n,) [m] of points (n, 3), these rows (m,) of them, by the
        spheres about the triangles and then by their planes."""
        return _may_reach(points, row, triangle, reach, self._center, self._radius, self.normal)

    @cached_property
    def _rims(self) -> tuple[Ints, Ints]:
        """The features (m, 3) of the sides of triangles, and of their corners."""
        edges, vertices = len(self.triangle), len(self.triangle) + len(self.edge)
        return edges + self.side, vertices + self.triangle

    def closest(self, points: Floats, triangle: Ints) -> Closest:
        """The points of triangles (m,) that are closest to points (m, 3): over the face, or else of the three edges."""
        return Closest(*_closest(points, triangle, self.corner, self.normal, *self._rims))

    def _table(self, level: int) -> Cells:
        """The cells for reaches up to 2^level [m]: halved, with the triangles that come near, until they are half as
        wide as the reach or there are many pairs of both, which would fill the memory."""
        if level in self._cells:
            return self._cells[level]
        reach = 2.0**level
        width = 2.0 * float(self.half.max() + reach) * (1.0 + 1e-9)
        low = np.full(3, -0.5 * width)
        place = np.zeros((len(self.triangle), 3), np.int64)
        triangle = np.arange(len(self.triangle))
        while width > 0.5 * reach and len(triangle) < max(30_000, 4 * len(self.triangle)):
            width *= 0.5
            place = (2 * place[:, None] + np.indices((2, 2, 2)).reshape(3, 8).T).reshape(-1, 3)
            triangle = np.repeat(triangle, 8)
            far = 0.5 * np.sqrt(3.0) * width + reach * (1.0 + 1e-9)
            middle = low + (place + 0.5) * width
            close = self._within(middle, np.arange(len(triangle)), triangle, np.full(len(triangle), far))
            close = close[self.closest(middle[close], triangle[close]).distance <= far]
            place, triangle = place[close], triangle[close]
        codes = place @ _CODE
        order = np.argsort(codes, kind="stable")
        code, start = np.unique(codes[order], return_index=True)
        cells = Cells(low, width, code, np.append(start, len(order)), triangle[order])
        self._cells[level] = cells
        return cells


@loop
def _closest(points, triangle, corner, normal, edge, vertex):
    """`Closest` of points (m, 3) and triangles (m,) with the features `edge` and `vertex` (triangles, 3), each from one
    corner to the next."""
    point, feature, distance = np.empty((len(points), 3)), np.empty(len(points), np.int64), np.empty(len(points))
    for n in range(len(points)):
        t, face, best = triangle[n], True, 0.0
        x, y, z = points[n, 0], points[n, 1], points[n, 2]
        for k in range(3):
            end = (k + 1) % 3
            a, b, c = corner[t, k, 0], corner[t, k, 1], corner[t, k, 2]
            p, q, r = corner[t, end, 0] - a, corner[t, end, 1] - b, corner[t, end, 2] - c
            u, v, w = x - a, y - b, z - c
            across = normal[t, 0] * (q * w - r * v) + normal[t, 1] * (r * u - p * w) + normal[t, 2] * (p * v - q * u)
            face &= across > 0.0
            square = p * p + q * q + r * r
            along = min(max((p * u + q * v + r * w) / (square if square > 0.0 else 1.0), 0.0), 1.0)
            a, b, c = a + along * p, b + along * q, c + along * r
            apart = np.sqrt((x - a) ** 2 + (y - b) ** 2 + (z - c) ** 2)
            if k == 0 or apart < best:
                best, point[n, 0], point[n, 1], point[n, 2], distance[n] = apart, a, b, c, apart
                feature[n] = edge[t, k] if 0.0 < along < 1.0 else vertex[t, k if along == 0.0 else end]
        if face:
            u, v, w = x - corner[t, 0, 0], y - corner[t, 0, 1], z - corner[t, 0, 2]
            height = normal[t, 0] * u + normal[t, 1] * v + normal[t, 2] * w
            point[n, 0], point[n, 1] = x - height * normal[t, 0], y - height * normal[t, 1]
            point[n, 2], feature[n], distance[n] = z - height * normal[t, 2], t, abs(height)
    return point, feature, distance


@loop
def _may_reach(points, row, triangle, reach, center, radius, normal):
    """The loop of `Surface._within`."""
    close, found = np.empty(len(row), np.int64), 0
    for n in range(len(row)):
        p, t = row[n], triangle[n]
        x, y, z = points[p, 0] - center[t, 0], points[p, 1] - center[t, 1], points[p, 2] - center[t, 2]
        height = abs(x * normal[t, 0] + y * normal[t, 1] + z * normal[t, 2])
        if height <= reach[p] and x * x + y * y + z * z <= (reach[p] + radius[t]) ** 2:
            close[found] = n
            found += 1
    return close[:found]


@loop
def _entries(points, rows, low, width, code, start):
    """Pairs (m,) of the points of these rows, and of the entries of the cube that they are in."""
    at, count = np.full(len(rows), -1), 0
    for n in range(len(rows)):
        number, inside = 0, True
        for k in range(3):
            place = np.floor((points[rows[n], k] - low[k]) / width)
            inside &= (place >= 0.0) & (place < SIDE)
            number = number * SIDE + int(place if inside else 0.0)
        first, last = 0, len(code) - 1 if inside else -1
        while first < last:
            middle = (first + last) // 2
            first, last = (middle + 1, last) if code[middle] < number else (first, middle)
        if first == last and code[first] == number:
            at[n] = first
            count += start[first + 1] - start[first]
    row, entry, found = np.empty(count, np.int64), np.empty(count, np.int64), 0
    for n in range(len(rows)):
        if at[n] >= 0:
            for e in range(start[at[n]], start[at[n] + 1]):
                row[found], entry[found] = rows[n], e
                found += 1
    return row, entry


def spread(start: Ints, of: Ints) -> tuple[Ints, Ints]:
    """All entries of the lists `of` (n,) among those that begin at `start`: numbers 0 ... n - 1 of the list, and the
    entries."""
    count = start[of + 1] - start[of]
    row = np.repeat(np.arange(len(of)), count)
    return row, np.arange(len(row)) - np.repeat(np.cumsum(count) - count, count) + start[of][row]


@dataclass(frozen=True, eq=False, repr=False)
class Mesh:
    """Triangles in space, which all shapes but meshes touch from both sides. With a density the surface must be
    closed, its normals outwards."""

    vertices: ArrayLike  #: (n, 3) [m]
    triangles: ArrayLike | Ints  #: (m, 3) rows of vertices; seen from outside a solid they turn left
    center: Sequence[float] = (0.0, 0.0, 0.0)  #: where the origin of the vertices is (3,) [m]
    quaternion: Sequence[float] = (1.0, 0.0, 0.0, 0.0)  #: (4,)
    surface: Surface = field(init=False, repr=False)  #: the same triangles, prepared for the search

    def __post_init__(self) -> None:
        vertices, triangles = finite("vertices of a mesh", self.vertices), np.asarray(self.triangles)
        if vertices.ndim != 2 or vertices.shape[1] != 3:
            raise ValueError(f"vertices of a mesh must have shape (n, 3), got {vertices.shape}")
        if triangles.ndim != 2 or triangles.shape[1] != 3 or not len(triangles) or triangles.dtype.kind not in "iu":
            raise ValueError(f"triangles of a mesh must be integers (m, 3), got {triangles.shape} of {triangles.dtype}")
        low, high, count = triangles.min(), triangles.max(), len(vertices)
        if low < 0 or high >= count:
            raise ValueError(f"triangles of a mesh must be rows of its {count} vertices, got {low} to {high}")
        triangles = triangles.astype(np.int64)
        a, b, c = triangles.T
        triangles = triangles[(a != b) & (b != c) & (c != a)]
        if not len(triangles):
            raise ValueError("no triangle of the mesh has three corners")
        used, row = np.unique(triangles, return_inverse=True)
        object.__setattr__(self, "vertices", vertices[used])
        object.__setattr__(self, "triangles", row.reshape(-1, 3))
        object.__setattr__(self, "surface", Surface(vertices[used], row.reshape(-1, 3)))
        check_fields(self, center=vector, quaternion=unit_quaternion)

    def __repr__(self) -> str:
        size = " x ".join(f"{length:.4g}" for length in np.ptp(self.surface.vertex, axis=0))
        return f"<Mesh of {len(self.surface.triangle)} triangles, {size} m, at {tuple(self.center)}>"

    def solid(self) -> tuple[float, Floats, Floats]:
        """Volume [m^3], centre of mass (3,) and inertia tensor (3, 3) about it at density one, in the frame of the
        vertices. ValueError unless the surface is closed, of one orientation and with its normals outwards."""
        surface = self.surface
        body = _trimesh("the mass of a mesh is computed").Trimesh(surface.vertex, surface.triangle, process=False)
        if not body.is_watertight:
            wrong = np.flatnonzero(np.bincount(surface.side.ravel()) != 2)
            x, y, z = surface.middle + surface.vertex[surface.edge[wrong[0]]].mean(axis=0)
            raise ValueError(
                f"a mesh that is not closed has no mass: {len(wrong)} of {len(surface.edge)} edges belong to one "
                f"triangle or to more than two, such as that at ({x:g}, {y:g}, {z:g})"
            )
        if not body.is_winding_consistent:
            raise ValueError("a mesh whose triangles are turned both ways has no mass: normals change sides")
        if body.volume <= 0.0:
            raise ValueError("a mesh whose normals point inwards has no mass: reverse its triangles")
        return float(body.volume), surface.middle + body.center_mass, np.asarray(body.moment_inertia)

    @classmethod
    def read(
        cls, file: str | Path, scale: float = 1.0, *, center: Sequence[float] = (0.0, 0.0, 0.0),
        quaternion: Sequence[float] = (1.0, 0.0, 0.0, 0.0),
    ) -> Mesh:  # fmt: skip
        """From an STL or OBJ file, or another one that trimesh reads; `scale` is the unit of its numbers in metres
        (1e-3: millimetres). Corners in the same place become one vertex.

        ValueError, which names the file, if it cannot be read, has no triangle or needs trimesh, which is not there.
        """
        if not isinstance(file, (str, Path)):
            raise ValueError(f"file of a mesh {file!r}: allowed is the name of a file")
        positive(f"scale of {file}", number(f"scale of {file}", scale))
        if not Path(file).is_file():
            raise ValueError(f"{file}: no such file")
        try:
            kind = Path(file).suffix[1:].lower()
            if kind == "stl":
                corners = stl.corners(Path(file).read_bytes())
                vertices, triangles = corners.reshape(-1, 3), np.arange(3 * len(corners)).reshape(-1, 3)
            elif kind == "obj":
                vertices, triangles = obj.triangles(Path(file).read_bytes())
            else:
                load = _trimesh(f"{file}: such meshes are read").load
                loaded = load(str(file), file_type=kind, force="mesh", process=False)
                vertices, triangles = np.array(loaded.vertices, dtype=float), np.array(loaded.faces, dtype=np.int64)
            vertices, triangles = _merged(vertices, triangles)
        except NoTrimeshError:
            raise
        except Exception as error:  # whatever a damaged file makes of the reader
            why = str(error) if isinstance(error, ValueError) else f"{type(error).__name__}: {error}"
            raise ValueError(f"{file}: cannot be read as a mesh ({why})") from None
        if not len(triangles):
            raise ValueError(f"{file}: has no triangle")
        try:
            return cls(scale * vertices, triangles, center, quaternion)
        except ValueError as error:
            raise ValueError(f"{file}: {error}") from None

    @classmethod
    def revolved(
        cls, profile: Sequence[Sequence[float]], sides: int = 64, *, center: Sequence[float] = (0.0, 0.0, 0.0),
        quaternion: Sequence[float] = (1.0, 0.0, 0.0, 0.0),
    ) -> Mesh:  # fmt: skip
        """A profile, places (k, 2) of radius and z [m] from point to point, turned about the z axis with `sides` flat
        sides: a drum, a silo, a funnel, a wheel. The corners are on the circles.

        Normals point to the right of the way along the profile, outwards where z grows on the outside: a profile from
        (0, 0) by (r, 0) and (r, h) to (0, h) makes a solid cylinder.
        """
        places = rows("profile of a mesh", profile, len(profile), 2)
        not_negative("radii of a profile", places[:, 0])
        between(2)("places of a profile", len(places))
        between(3)("sides of a surface of revolution", sides)
        angle = 2.0 * np.pi * np.arange(sides) / sides
        circle = np.stack([np.cos(angle), np.sin(angle)], axis=1)
        vertices = np.empty((len(places), sides, 3))
        vertices[:, :, :2] = places[:, None, :1] * circle
        vertices[:, :, 2] = places[:, 1:]
        row = np.arange(len(places) * sides).reshape(len(places), sides)
        row[places[:, 0] == 0.0] = row[places[:, 0] == 0.0, :1]  # a point of the axis is one vertex
        here, there = row[:-1], row[1:]
        next_here, next_there = np.roll(here, -1, axis=1), np.roll(there, -1, axis=1)
        triangles = [np.stack(three, axis=2) for three in ((here, next_here, there), (next_here, next_there, there))]
        return cls(vertices.reshape(-1, 3), np.concatenate(triangles).reshape(-1, 3), center, quaternion)

    def write(self, file: str | Path) -> None:
        """Write the triangles, in their own frame and in metres, as an STL or OBJ file, by the end of its name.
        ValueError for another one."""
        if Path(file).suffix.lower() not in (".stl", ".obj"):
            raise ValueError(f"{file}: allowed is a name that ends in .stl or .obj")
        trimesh = _trimesh(f"{file}: meshes are written")
        trimesh.Trimesh(self.vertices, self.triangles, process=False).export(str(file))


def _merged(vertices: Floats, triangles: Ints) -> tuple[Floats, Ints]:
    """The same triangles, with one vertex for all corners in a place, whatever texture they have: files have six or
    seven digits."""
    if not len(triangles):
        return vertices, triangles
    digits = 6 - int(np.ceil(np.log10(max(float(np.ptp(finite("corners", vertices), axis=0).max()), 1e-300))))
    _, first, row = np.unique(np.round(vertices * 10.0**digits), axis=0, return_index=True, return_inverse=True)
    return vertices[first], row.reshape(-1)[triangles]


class NoTrimeshError(ValueError):
    """The optional package trimesh is not there."""


def _trimesh(what: str) -> Any:
    """The optional package; NoTrimeshError if it is not there."""
    try:
        import trimesh
    except ImportError:
        raise NoTrimeshError(f"{what} by trimesh, which is not there: pip install 'pctt[meshes]', or trimesh") from None
    return trimesh
