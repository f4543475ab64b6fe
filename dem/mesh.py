"""Surfaces made of triangles: tools such as buckets, wheels, hoppers and drums, drawn elsewhere or turned on a lathe.

A surface has no thickness and two sides; a body that touches it stays on its side. A closed surface whose normals point
outwards bounds a solid, which has volume, centre and inertia.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import ConvexHull, QhullError, cKDTree

from dem.arrays import ArrayLike, Floats, Ints
from dem.checks import finite, finite_vector, positive, unit_quaternion
from dem.quaternion import cross, length

#: Vertices of a file that are closer than this share of the extent are one: numbers of STL files have seven digits.
SAME = 1e-6

#: Pairs of cells and triangles beyond which the cells of a surface are not made any smaller.
MOST_PAIRS = 30_000


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
        self._directed = np.stack([triangles, np.roll(triangles, -1, axis=1)], axis=2).reshape(-1, 2)
        self.edge, side = np.unique(np.sort(self._directed, axis=1), axis=0, return_inverse=True)
        self.side = side.reshape(-1, 3)
        self.features = len(triangles) + len(self.edge) + len(vertices)
        self._cells: dict[int, Cells] = {}

    @cached_property
    def around(self) -> tuple[Ints, Ints]:
        """The vertices around edges and vertices (start, vertex), in the order of features without the triangles: the
        corners opposite an edge, and the other ends of the edges at a vertex."""
        count = len(self.edge)
        opposite = np.roll(self.triangle, 1, axis=1)  # the edge from corner k is opposite corner k + 2
        of = np.concatenate([self.side.ravel(), count + self.edge[:, 0], count + self.edge[:, 1]])
        vertex = np.concatenate([opposite.ravel(), self.edge[:, 1], self.edge[:, 0]])
        start = np.concatenate([[0], np.cumsum(np.bincount(of, minlength=count + len(self.vertex)))])
        return start, vertex[np.argsort(of, kind="stable")]

    @cached_property
    def ridges(self) -> np.ndarray:
        """Which edges (edges,) are no mere lines in a flat face: open ones, and those where faces meet at an angle."""
        count = np.bincount(self.side.ravel(), minlength=len(self.edge))
        total = np.zeros((len(self.edge), 3))
        outer = np.zeros((len(self.edge), 3, 3))
        normal = np.repeat(self.normal, 3, axis=0)
        np.add.at(total, self.side.ravel(), normal)
        np.add.at(outer, self.side.ravel(), normal[:, :, None] * normal[:, None, :])
        # Parallel normals, whatever their signs, make a matrix of rank one: its trace is its greatest eigenvalue.
        trace = np.trace(outer, axis1=1, axis2=2)
        return (count != 2) | (trace - np.linalg.eigvalsh(outer)[:, 2] > 1e-10)

    @cached_property
    def hull(self) -> Ints:
        """The vertices that a plane can touch first: those of the convex hull, or all where that has no volume."""
        try:
            return np.sort(ConvexHull(self.vertex).vertices).astype(np.int64)
        except QhullError:
            return np.arange(len(self.vertex))

    def refuse_unless_solid(self) -> None:
        """ValueError unless the surface is closed, of one orientation and with its normals outwards."""
        count = np.bincount(self.side.ravel(), minlength=len(self.edge))
        if (count != 2).any():
            e = int(np.flatnonzero(count != 2)[0])
            x, y, z = self.middle + self.vertex[self.edge[e]].mean(axis=0)
            raise ValueError(
                f"a mesh that is not closed has no mass: {np.count_nonzero(count != 2)} of {len(count)} edges belong "
                f"to one triangle or to more than two, such as that at ({x:g}, {y:g}, {z:g})"
            )
        forward = np.bincount(self.side.ravel(), self._directed[:, 0] < self._directed[:, 1], len(self.edge))
        if (forward != 1).any():
            raise ValueError(
                "a mesh whose triangles are turned both ways has no mass: across "
                f"{np.count_nonzero(forward != 1)} edges the normals change sides"
            )
        if self.integrals()[0] <= 0.0:
            raise ValueError("a mesh whose normals point inwards has no mass: reverse its triangles")

    def integrals(self) -> tuple[float, Floats, Floats]:
        """Volume [m^3] and the integrals over it of x (3,) [m^4] and x x' (3, 3) [m^5], about the middle.

        By the divergence theorem: sums over the tetrahedra between the origin and each triangle, whose volumes have
        signs (Tonon 2004, "Explicit exact formulas for the 3-D tetrahedron inertia tensor").
        """
        six = np.einsum("mi,mi->m", self.corner[:, 0], cross(self.corner[:, 1], self.corner[:, 2]))
        total = self.corner.sum(axis=1)
        products = np.einsum("m,mki,mkj->ij", six, self.corner, self.corner)
        products += np.einsum("m,mi,mj->ij", six, total, total)
        return float(six.sum() / 6.0), six @ total / 24.0, products / 120.0

    def near(self, points: Floats, reach: Floats) -> tuple[Ints, Ints]:
        """Pairs (rows of points, triangles): all triangles within reach (n,) [m] of points (n, 3), and some more."""
        found = [(np.zeros(0, np.int64), np.zeros(0, np.int64))]
        level = np.frexp(reach)[1]
        for k in np.unique(level):
            cells, rows = self._table(int(k)), np.flatnonzero(level == k)
            place = np.floor((points[rows] - cells.low) / cells.width)
            inside = ((place >= 0.0) & (place < _SIDE)).all(axis=1)
            code = _code(np.where(inside[:, None], place, 0.0).astype(np.int64))
            at = np.minimum(np.searchsorted(cells.code, code), len(cells.code) - 1)
            hit = np.flatnonzero(inside & (cells.code[at] == code))
            row, entry = spread(cells.start, at[hit])
            found.append((rows[hit[row]], cells.triangle[entry]))
        row, triangle = (np.concatenate(parts) for parts in zip(*found))
        height = np.einsum("ij,ij->i", points[row] - self.corner[triangle, 0], self.normal[triangle])
        close = np.abs(height) <= reach[row] * (1.0 + 1e-9)
        return row[close], triangle[close]

    def closest(self, points: Floats, triangle: Ints) -> Closest:
        """The points of triangles (m,) that are closest to points (m, 3): over the face, or else of the three edges."""
        corner, normal = self.corner[triangle], self.normal[triangle]
        side = np.roll(corner, -1, axis=1) - corner
        offset = points[:, None] - corner
        inward = np.einsum("mi,mki->mk", normal, cross(side, offset))
        face = (inward > 0.0).all(axis=1)
        square = np.einsum("mki,mki->mk", side, side)
        along = np.einsum("mki,mki->mk", side, offset)
        along = np.clip(along / np.where(square > 0.0, square, 1.0), 0.0, 1.0)
        foot = corner + along[:, :, None] * side
        distance = length(points[:, None] - foot)
        rows, k = np.arange(len(points)), distance.argmin(axis=1)
        height = np.einsum("mi,mi->m", normal, offset[:, 0])
        share = along[rows, k]
        end = np.where(share == 0.0, k, (k + 1) % 3)
        edges, vertices = len(self.triangle), len(self.triangle) + len(self.edge)
        at_end = (share == 0.0) | (share == 1.0)
        rim = np.where(at_end, vertices + self.triangle[triangle, end], edges + self.side[triangle, k])
        return Closest(
            np.where(face[:, None], points - height[:, None] * normal, foot[rows, k]),
            np.where(face, triangle, rim),
            np.where(face, np.abs(height), distance[rows, k]),
        )

    def _table(self, level: int) -> Cells:
        """The cells for reaches up to 2^level [m]: halved, with the triangles that come near, until they are half as
        wide as the reach or there are many."""
        if level in self._cells:
            return self._cells[level]
        reach = 2.0**level
        width = 2.0 * float(self.half.max() + reach) * (1.0 + 1e-9)
        low = np.full(3, -0.5 * width)
        place = np.zeros((len(self.triangle), 3), np.int64)
        triangle = np.arange(len(self.triangle))
        while width > 0.5 * reach and len(triangle) < MOST_PAIRS:
            width *= 0.5
            place = (2 * place[:, None] + _EIGHT).reshape(-1, 3)
            triangle = np.repeat(triangle, 8)
            far = 0.5 * np.sqrt(3.0) * width + reach * (1.0 + 1e-9)
            middle = low + (place + 0.5) * width
            height = np.einsum("ij,ij->i", middle - self.corner[triangle, 0], self.normal[triangle])
            close = np.flatnonzero(np.abs(height) <= far)
            close = close[self.closest(middle[close], triangle[close]).distance <= far]
            place, triangle = place[close], triangle[close]
        codes = _code(place)
        order = np.argsort(codes, kind="stable")
        code, start = np.unique(codes[order], return_index=True)
        cells = Cells(low, width, code, np.append(start, len(order)), triangle[order])
        self._cells[level] = cells
        return cells


#: The eight halves of a cube.
_EIGHT = np.stack(np.meshgrid([0, 1], [0, 1], [0, 1], indexing="ij"), axis=-1).reshape(8, 3)

#: More cubes than any side of a neighbourhood has.
_SIDE = 1 << 20


def _code(place: Ints) -> Ints:
    """One number (n,) for each cube at the integer coordinates (n, 3)."""
    return (place[:, 0] * _SIDE + place[:, 1]) * _SIDE + place[:, 2]


def spread(start: Ints, of: Ints) -> tuple[Ints, Ints]:
    """All entries of the lists `of` (n,) among those that begin at `start`: numbers 0 ... n - 1 of the list, and the
    entries."""
    count = start[of + 1] - start[of]
    row = np.repeat(np.arange(len(of)), count)
    return row, np.arange(len(row)) - np.repeat(np.cumsum(count) - count, count) + start[of][row]


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles in space, which spheres and capsules touch from both sides. With a density the surface must be closed,
    its normals outwards."""

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
        if triangles.min() < 0 or triangles.max() >= len(vertices):
            raise ValueError(
                f"triangles of a mesh must be rows of its {len(vertices)} vertices, "
                f"got {triangles.min()} to {triangles.max()}"
            )
        triangles = triangles.astype(np.int64)
        a, b, c = triangles.T
        triangles = triangles[(a != b) & (b != c) & (c != a)]
        if not len(triangles):
            raise ValueError("no triangle of the mesh has three corners")
        used, rows = np.unique(triangles, return_inverse=True)
        object.__setattr__(self, "vertices", vertices[used])
        object.__setattr__(self, "triangles", rows.reshape(-1, 3))
        object.__setattr__(self, "center", finite_vector("centre of a mesh", self.center))
        object.__setattr__(self, "quaternion", unit_quaternion("quaternion of a mesh", self.quaternion))
        object.__setattr__(self, "surface", Surface(vertices[used], rows.reshape(-1, 3)))

    @classmethod
    def read(
        cls,
        file: str | Path,
        scale: float = 1.0,
        *,
        center: Sequence[float] = (0.0, 0.0, 0.0),
        quaternion: Sequence[float] = (1.0, 0.0, 0.0, 0.0),
    ) -> Mesh:
        """From an STL or OBJ file, or another that trimesh reads; `scale` is the unit of its numbers in metres (1e-3:
        millimetres). Corners in the same place become one vertex.

        ValueError, which names the file, if it cannot be read, has no triangle or if trimesh is not there.
        """
        positive(f"scale of {file}", scale)
        try:
            import trimesh
        except ImportError:
            remedy = "pip install 'pctt[meshes]', or trimesh"
            raise ValueError(f"{file}: meshes are read by trimesh, which is not there: {remedy}") from None
        if not Path(file).is_file():
            raise ValueError(f"{file}: no such file")
        try:
            loaded = trimesh.load(str(file), force="mesh", process=False)
            vertices, triangles = np.array(loaded.vertices, dtype=float), np.array(loaded.faces, dtype=np.int64)
        except Exception as error:  # whatever a damaged file makes of the reader
            raise ValueError(f"{file}: cannot be read as a mesh ({type(error).__name__}: {error})") from None
        if not len(triangles):
            raise ValueError(f"{file}: has no triangle")
        if not np.isfinite(vertices).all():
            raise ValueError(f"{file}: NaN or infinite number")
        vertices, triangles = merged(scale * vertices, triangles)
        try:
            return cls(vertices, triangles, center, quaternion)
        except ValueError as error:
            raise ValueError(f"{file}: {error}") from None

    @classmethod
    def revolved(
        cls,
        profile: Sequence[Sequence[float]],
        sides: int = 64,
        *,
        center: Sequence[float] = (0.0, 0.0, 0.0),
        quaternion: Sequence[float] = (1.0, 0.0, 0.0, 0.0),
    ) -> Mesh:
        """A profile, places (k, 2) of radius and z [m] from point to point, turned about the z axis with `sides` flat
        sides: a drum, a silo, a funnel, a wheel. The corners are on the circles.

        Normals point to the right of the way along the profile, outwards where z grows on the outside: a profile from
        (0, 0) by (r, 0) and (r, h) to (0, h) makes a solid cylinder.
        """
        places = finite("profile of a mesh", profile)
        if places.ndim != 2 or places.shape[1] != 2 or len(places) < 2:
            raise ValueError(f"a profile must have places (k, 2), two at least, got {places.shape}")
        if (places[:, 0] < 0.0).any():
            raise ValueError(f"radii of a profile must not be negative, got {places[:, 0].min():g}")
        if sides < 3:
            raise ValueError(f"a surface of revolution must have at least 3 sides, got {sides}")
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
        """Write the triangles, in their own frame and in metres, as a binary STL file."""
        corner = np.asarray(self.vertices)[np.asarray(self.triangles)]
        facet = np.zeros(len(corner), dtype=[("vectors", "<f4", (4, 3)), ("attribute", "<u2")])
        facet["vectors"][:, 0], facet["vectors"][:, 1:] = self.surface.normal, corner
        Path(file).write_bytes(b"pctt".ljust(80) + np.array(len(corner), "<u4").tobytes() + facet.tobytes())


def merged(vertices: Floats, triangles: Ints) -> tuple[Floats, Ints]:
    """The same triangles (m, 3) with one vertex for all of `vertices` (n, 3) that are in the same place."""
    vertices, row = np.unique(vertices, axis=0, return_inverse=True)
    pairs = cKDTree(vertices).query_pairs(SAME * float(np.ptp(vertices, axis=0).max()), output_type="ndarray")
    links = coo_matrix((np.ones(len(pairs)), pairs.T), shape=(len(vertices), len(vertices)))
    _, group = connected_components(links, directed=False)
    _, first = np.unique(group, return_index=True)
    return vertices[first], group[row.ravel()[triangles]]
