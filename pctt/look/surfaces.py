"""Surfaces of grains and large bodies for VTK; planes are cut to the size of the scene."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from vtkmodules.util.numpy_support import numpy_to_vtk, numpy_to_vtkIdTypeArray, vtk_to_numpy
from vtkmodules.vtkCommonCore import mutable, vtkPoints, vtkVersion
from vtkmodules.vtkCommonDataModel import vtkCellArray, vtkPolyData, vtkStaticCellLocator
from vtkmodules.vtkCommonTransforms import vtkTransform
from vtkmodules.vtkFiltersCore import vtkAppendPolyData, vtkTriangleFilter
from vtkmodules.vtkFiltersGeneral import vtkTransformFilter
from vtkmodules.vtkFiltersSources import vtkCubeSource, vtkCylinderSource, vtkSphereSource

from dem import quaternion
from dem.bodies import BOX, CAPSULE, SPHERE
from pctt.disk import FileError
from pctt.folder import Folder, Frame, Table

if tuple(map(int, vtkVersion.GetVTKVersion().split(".")[:2])) < (9, 4):  # as Debian 12 has it
    raise ModuleNotFoundError(f"vtk {vtkVersion.GetVTKVersion()} is older than 9.4", name="vtkmodules")

MARGIN = 0.06  # how far walls go beyond the scene, in diagonals of the scene
HOLLOW = 0.2  # a hollow body is empty up to this part of the way from its middle to its bounds
SHARE = 0.25  # part of the grains within the bounds of a hollow body


@dataclass(frozen=True)
class Wall:
    """A rectangle that bounds the grains; for a plane, it is larger than the scene."""

    center: np.ndarray  #: (3,) [m]
    normal: np.ndarray  #: (3,) unit vector towards the grains
    halves: np.ndarray  #: (2, 3) halves of two edges [m]; they and the normal are right-handed
    row: int  #: of the large body

    def corners(self) -> np.ndarray:
        """The corners (4, 3), counterclockwise as seen from the grains."""
        return self.center + np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) @ self.halves

    def covers(self, places: np.ndarray) -> bool:
        """Whether all points (n, 3) lie in the prism over the rectangle."""
        along = np.abs((places - self.center) @ self.halves.T)
        return bool((along <= (1 + 1e-9) * (self.halves**2).sum(axis=1)).all())


class Scene:
    """The surfaces of the large bodies of a folder: walls, shells and tools.

    A body is hollow if it is empty around its middle and has a good part of the grains within its bounds, in the first
    or in the last of the ``frames``. Walls are planes and the boxes of hollow bodies, shells are the meshes of hollow
    bodies, such as drums and silos, and tools are all else; their cells have the row of the body as ``body``. ``box``
    (2, 3) has the lowest and the highest corner of grains, shells and tools in all of the frames [m], ``bed`` that of
    grains and hollow bodies: walls end above it. The rows of ``hidden`` are as if they were not there.
    """

    def __init__(self, folder: Folder, frames: Sequence[Frame], hidden: Collection[int] = ()):
        self.folder, self._rows = folder, [row for row in range(len(folder.large)) if row not in hidden]
        self._hollow = {row for row in self._rows for frame in (frames[0], frames[-1]) if self._is_hollow(frame, row)}
        tables = [frame.table for frame in frames]
        corners = [frame.position[: table.grains] + sign * table.radius[:, None]
                   for frame, table in zip(frames, tables) for sign in (-1, 1)]  # fmt: skip
        corners += [points(self.shells(frame)) for frame in frames]
        tools = [points(self.tools(frame)) for frame in frames]
        self.box = _bounds(corners + tools)
        corners += [wall.center[None] for frame in frames for row in self._hollow for wall in self._boxes(frame, row)]
        self.bed, self.box = _bounds(corners), _bounds(corners + tools)

    def surface(self, frame: Frame, row: int, kinds: Collection[str] = ()) -> vtkPolyData:
        """The surface of a large body, or of its shapes of some kinds, without its planes."""
        pose, shapes = self._pose(frame, row), self.folder.large[row]["shapes"]
        wanted = (shape for shape in shapes if (shape["kind"] in kinds if kinds else shape["kind"] != "Plane"))
        return joined(_placed(shape, *pose) for shape in wanted)

    def tools(self, frame: Frame) -> vtkPolyData:
        """The surfaces of all tools."""
        return joined(_of_body(self.surface(frame, row), row) for row in self._rows if row not in self._hollow)

    def shells(self, frame: Frame) -> vtkPolyData:
        """The triangles of all shells, as seen from inside."""
        found = []
        for row in self._hollow:
            surface = self.surface(frame, row, ("Mesh",))
            corners, middle = triangles(surface), np.reshape(surface.GetBounds(), (3, 2)).mean(axis=1)
            normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
            away = np.einsum("mi,mi->m", normal, corners.mean(axis=1) - middle) > 0.0
            corners[away] = corners[away, ::-1]
            found.append(_of_body(polydata(corners, "polys", 3), row))
        return joined(found)

    def walls(self, frame: Frame) -> vtkPolyData:
        """All planes, and the sides of boxes that the grains see, as polygons seen from inside."""
        boxes = [wall for row in self._hollow for wall in self._boxes(frame, row)]
        return self._cut([wall for row in self._rows for wall in self._planes(frame, row)] + boxes)

    def planes(self, frame: Frame, row: int) -> vtkPolyData:
        """The planes of a large body as polygons, as seen from their open side."""
        return self._cut(self._planes(frame, row))

    def _cut(self, walls: Sequence[Wall]) -> vtkPolyData:
        """The parts of walls that lie at most MARGIN beyond the scene, above beyond the bed, and behind no other
        wall."""
        beyond = MARGIN * np.linalg.norm(self.bed[1] - self.bed[0])
        high = np.append(self.box[1, :2], self.bed[1, 2])
        sides = [(axis, self.box[0] - beyond) for axis in np.eye(3)]
        sides += [(-axis, high + beyond) for axis in np.eye(3)]
        polygons = []
        for wall in walls:
            polygon = wall.corners()
            for normal, point in sides:
                polygon = _before(polygon, normal, point) if len(polygon) else polygon
            for other in walls:
                if len(polygon) and other is not wall and other.covers(_before(polygon, -other.normal, other.center)):
                    polygon = _before(polygon, other.normal, other.center)
            polygons.append(polygon)
        pairs = [(polygon, wall.row) for polygon, wall in zip(polygons, walls) if len(polygon)]
        return joined(_of_body(polydata(polygon, "polys", len(polygon)), row) for polygon, row in pairs)

    def _pose(self, frame: Frame, row: int) -> tuple[np.ndarray, np.ndarray]:
        return frame.position[frame.table.grains + row], frame.quaternion[frame.table.grains + row]

    def _planes(self, frame: Frame, row: int) -> list[Wall]:
        (place, turn), found = self._pose(frame, row), []
        middle, size = self.box.mean(axis=0), 4 * np.linalg.norm(self.box[1] - self.box[0])
        for shape in self.folder.large[row]["shapes"]:
            if shape["kind"] == "Plane":
                normal = quaternion.rotate(turn, np.array(shape["normal"]))
                point = place + quaternion.rotate(turn, np.array(shape["center"]))
                first = np.cross(normal, np.eye(3)[np.argmin(np.abs(normal))])
                halves = size / np.linalg.norm(first) * np.array([first, np.cross(normal, first)])
                found.append(Wall(middle - normal * (normal @ (middle - point)), normal, halves, row))
        return found

    def _boxes(self, frame: Frame, row: int) -> list[Wall]:
        (place, turn), found = self._pose(frame, row), []
        for shape in self.folder.large[row]["shapes"]:
            if shape["kind"] == "Box":
                center = place + quaternion.rotate(turn, np.array(shape["center"]))
                axes = quaternion.matrix(quaternion.multiply(turn, np.array(shape["quaternion"]))).T
                edges = np.array(shape["half_extents"])[:, None] * axes
                offset = axes @ (self.box.mean(axis=0) - center)
                k = int(np.argmax(np.abs(offset) - shape["half_extents"]))
                side = np.sign(offset[k])
                halves = np.array([edges[k - 2], side * edges[k - 1]])
                found.append(Wall(center + side * edges[k], side * axes[k], halves, row))
        return found

    def _is_hollow(self, frame: Frame, row: int) -> bool:
        """Whether a large body has a good part of the grains within its bounds and is empty around its middle."""
        corners = triangles(self.surface(frame, row))
        if not len(corners):
            return False
        low, high = corners.min(axis=(0, 1)), corners.max(axis=(0, 1))
        grains = frame.position[: frame.table.grains]
        within = ((low <= grains) & (grains <= high)).all(axis=1)
        if (low == high).any() or np.count_nonzero(within) < SHARE * len(grains):
            return False
        locator, squared = vtkStaticCellLocator(), mutable(0.0)
        locator.SetDataSet(polydata(2 * (corners - low) / (high - low) - 1, "polys", 3))
        locator.BuildLocator()
        locator.FindClosestPoint((0, 0, 0), [0.0] * 3, mutable(0), mutable(0), squared)
        return squared.get() > HOLLOW**2


def _bounds(places: Sequence[np.ndarray]) -> np.ndarray:
    found = np.concatenate(places) if sum(map(len, places)) else np.array([[-0.5] * 3, [0.5] * 3])  # no grain yet
    return np.array([found.min(axis=0), found.max(axis=0)])


def extent(path: Path, table: Table) -> np.ndarray:
    """Widths (grains, 3) of the grains along their own axes, of forms those of the spheres about them [m]."""
    shape, size = table.shape[: table.grains, None], table.size[: table.grains]
    unknown = set(np.unique(shape).tolist()) - {SPHERE, BOX, CAPSULE, *(form["kind"] for form in table.forms)}
    if unknown:
        raise FileError(f"{path}: no surface is known for grains of shape {unknown.pop()}")
    round_ones = size[:, :1] + [0, 0, 1] * size[:, 1:2] * (shape == CAPSULE)
    return 2 * np.where(shape == BOX, size, round_ones)


def members(frame: Frame) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The spheres of all grains whose form has some: the row of the grain (m,), centres (m, 3) and radii (m,) [m]."""
    table = frame.table
    rows, places, radii = [np.zeros(0, int)], [np.zeros((0, 3))], [np.zeros(0)]
    for form in table.forms:
        grains = np.flatnonzero(table.shape[: table.grains] == form["kind"])
        for center, radius in zip(np.array(form.get("centres", ())), form.get("radii", ())):
            rows.append(grains)
            places.append(frame.position[grains] + quaternion.rotate(frame.quaternion[grains], center))
            radii.append(np.full(len(grains), radius))
    return np.concatenate(rows), np.concatenate(places), np.concatenate(radii)


def faces(frame: Frame) -> tuple[np.ndarray, np.ndarray]:
    """The triangles of all grains whose form has some: the row of the grain (m,) and the corners (m, 3, 3) [m]."""
    table = frame.table
    rows, corners = [np.zeros(0, int)], [np.zeros((0, 3, 3))]
    for form in table.forms:
        if "triangles" not in form:
            continue
        grains = np.flatnonzero(table.shape[: table.grains] == form["kind"])
        vertex, triangle = np.array(form["vertices"]), np.array(form["triangles"])
        scale = table.size[grains, 0] / np.linalg.norm(vertex, axis=1).max()
        places = quaternion.rotate(frame.quaternion[grains, None], scale[:, None, None] * vertex[None])
        corners.append((frame.position[grains, None] + places)[:, triangle].reshape(-1, 3, 3))
        rows.append(np.repeat(grains, len(triangle)))
    return np.concatenate(rows), np.concatenate(corners)


def polydata(places: np.ndarray, cells: str, size: int) -> vtkPolyData:
    """Cells `verts`, `lines` or `polys` that take ``size`` points each, from the points (..., 3) in their order."""
    places = np.ascontiguousarray(places).reshape(-1, 3)
    data, spots, array = vtkPolyData(), vtkPoints(), vtkCellArray()
    spots.SetData(numpy_to_vtk(places, deep=True))
    data.SetPoints(spots)
    array.SetData(size, numpy_to_vtkIdTypeArray(np.arange(len(places)), deep=True))
    {"verts": data.SetVerts, "lines": data.SetLines, "polys": data.SetPolys}[cells](array)
    return data


def add_arrays(attributes: Any, arrays: Mapping[str, np.ndarray]) -> None:
    """Add arrays (n,) or (n, k) by name to the point, cell or field data."""
    for name, values in arrays.items():
        array = numpy_to_vtk(np.ascontiguousarray(values), deep=True)
        array.SetName(name)
        attributes.AddArray(array)


def points(data: vtkPolyData) -> np.ndarray:
    """The points (n, 3)."""
    return vtk_to_numpy(data.GetPoints().GetData()).astype(float) if data.GetNumberOfPoints() else np.zeros((0, 3))


def triangles(surface: vtkPolyData) -> np.ndarray:
    """The corners (m, 3, 3) of the triangles of a surface."""
    data = made(vtkTriangleFilter(), surface)
    cells = data.GetPolys()
    order = vtk_to_numpy(cells.GetConnectivityArray()) if cells.GetNumberOfCells() else np.zeros(0, int)
    return points(data)[order.reshape(-1, 3)]


def _of_body(data: vtkPolyData, row: int) -> vtkPolyData:
    """The cells, each with the row of their large body."""
    add_arrays(data.GetCellData(), {"body": np.full(data.GetNumberOfCells(), row)})
    return data


def joined(parts: Iterable[vtkPolyData]) -> vtkPolyData:
    """Several surfaces as one."""
    whole = vtkAppendPolyData()
    for part in (vtkPolyData(), *parts):
        whole.AddInputData(part)
    return made(whole)


def made(source: Any, data: vtkPolyData | None = None) -> vtkPolyData:
    """What a source, or a filter of the data, makes."""
    if data is not None:
        source.SetInputData(data)
    source.Update()
    return source.GetOutput()


def cylinder(radius: float, length: float, caps: bool) -> vtkPolyData:
    """The side of a cylinder along z; with ``caps`` a capsule."""
    upright = vtkCylinderSource(radius=radius, height=length, resolution=32, capping=caps, capsule_cap=caps)
    turn = vtkTransform()
    turn.RotateX(90)  # from y
    return made(vtkTransformFilter(transform=turn), made(upright))


def _placed(shape: Mapping[str, Any], place: np.ndarray, turn: np.ndarray) -> vtkPolyData:
    """The surface of a shape of a body with this pose, in the world."""
    matrix = np.eye(4)
    matrix[:3, :3] = quaternion.matrix(quaternion.multiply(turn, np.array(shape.get("quaternion", (1.0, 0, 0, 0)))))
    matrix[:3, 3] = place + quaternion.rotate(turn, np.array(shape["center"]))
    return made(vtkTransformFilter(transform=vtkTransform(matrix=matrix.ravel())), _surface(shape))


def _surface(shape: Mapping[str, Any]) -> vtkPolyData:
    """The surface of a shape of a large body, in the frame of the shape."""
    if "triangles" in shape:
        return polydata(np.array(shape["vertices"])[np.ravel(shape["triangles"])], "polys", 3)
    if shape["kind"] == "Capsule":
        return cylinder(shape["radius"], 2 * shape["half_length"], caps=True)
    if shape["kind"] == "Box":
        x, y, z = shape["half_extents"]
        return made(vtkCubeSource(bounds=(-x, x, -y, y, -z, z)))
    return made(vtkSphereSource(radius=shape["radius"], theta_resolution=32, phi_resolution=24))


def _before(polygon: np.ndarray, normal: np.ndarray, point: np.ndarray) -> np.ndarray:
    """The part of a convex polygon (k, 3) in front of a plane; whole if it lies in the plane.

    vtkClipPolyData would do this in single precision.
    """
    height = (polygon - point) @ normal
    height[np.abs(height) < 1e-9 * np.ptp(polygon)] = 0.0
    after, there = np.roll(polygon, -1, axis=0), np.roll(height, -1)
    crosses = height * there < 0
    part = np.divide(height, height - there, out=np.zeros_like(height), where=crosses)
    corners = np.stack([polygon, polygon + part[:, None] * (after - polygon)], axis=1)
    return corners[np.stack([height >= 0, crosses], axis=1)]
