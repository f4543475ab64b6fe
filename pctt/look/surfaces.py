"""Surfaces of grains and large bodies for VTK; planes are cut to the size of the scene."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from vtkmodules.util.numpy_support import numpy_to_vtk, numpy_to_vtkIdTypeArray, vtk_to_numpy
from vtkmodules.vtkCommonCore import vtkPoints
from vtkmodules.vtkCommonDataModel import vtkCellArray, vtkPolyData
from vtkmodules.vtkCommonExecutionModel import vtkTrivialProducer
from vtkmodules.vtkCommonTransforms import vtkTransform
from vtkmodules.vtkFiltersCore import vtkAppendPolyData, vtkTriangleFilter
from vtkmodules.vtkFiltersGeneral import vtkTransformFilter
from vtkmodules.vtkFiltersSources import vtkCubeSource, vtkCylinderSource, vtkSphereSource

from dem import quaternion
from dem.bodies import BOX, CAPSULE, SPHERE
from dem.mesh import Surface
from pctt.folder import Folder, FolderError, Frame

MARGIN = 0.06  # how far walls go beyond the grains, in diagonals of the scene
HOLLOW = 0.3  # a hollow body is empty up to this part of the way from its middle to its bounds


def bounds(folder: Folder, frames: Sequence[Frame]) -> np.ndarray:
    """Lowest and highest corner (2, 3) of the scene in these frames [m]. The scene has the grains and the large bodies
    among or around them, without walls."""
    radius = folder.radius[:, None]
    places = [frame.position[: folder.grains] for frame in frames]
    low = np.min([(place - radius).min(axis=0) for place in places], axis=0)
    high = np.max([(place + radius).max(axis=0) for place in places], axis=0)
    box = np.array([low, high])
    corners = [low, high]
    for frame in frames:
        for row in range(len(folder.large)):
            for solid in (finite(folder, frame, row, box), shell(folder, frame, row)):
                if solid.GetNumberOfPoints():
                    corners += list(np.reshape(solid.GetBounds(), (3, 2)).T)
    return np.array([np.min(corners, axis=0), np.max(corners, axis=0)])


def extent(folder: Folder) -> np.ndarray:
    """Widths (grains, 3) of the grains along their own axes [m]."""
    shape, size = folder.shape[: folder.grains, None], folder.size[: folder.grains]
    unknown = set(np.unique(shape).tolist()) - {SPHERE, BOX, CAPSULE}
    if unknown:
        raise FolderError(f"{folder.path}: no surface is known for grains of shape {unknown.pop()}")
    round_ones = size[:, :1] + [0, 0, 1] * size[:, 1:2]  # a sphere is a capsule of length zero
    return 2 * np.where(shape == BOX, size, round_ones)


def polydata(points: np.ndarray, cells: str = "", ends: np.ndarray | None = None) -> vtkPolyData:
    """Data with points (n, 3), and with cells `verts`, `lines` or `polys` that take the points in their order.

    A cell ends before each of the indices `ends`; by default every point is a cell.
    """
    data = vtkPolyData()
    place = vtkPoints()
    place.SetData(numpy_to_vtk(np.ascontiguousarray(points).reshape(-1, 3), deep=True))
    data.SetPoints(place)
    if cells:
        array = vtkCellArray()
        offsets = np.concatenate([[0], np.arange(1, len(points) + 1) if ends is None else ends]).astype(np.int64)
        order = np.arange(len(points), dtype=np.int64)
        array.SetData(numpy_to_vtkIdTypeArray(offsets, deep=True), numpy_to_vtkIdTypeArray(order, deep=True))
        {"verts": data.SetVerts, "lines": data.SetLines, "polys": data.SetPolys}[cells](array)
    return data


def add_arrays(attributes: Any, arrays: Mapping[str, np.ndarray]) -> None:
    """Add arrays (n,) or (n, k) by name to the point, cell or field data."""
    for name, values in arrays.items():
        array = numpy_to_vtk(np.ascontiguousarray(values), deep=True)
        array.SetName(name)
        attributes.AddArray(array)


def cube() -> vtkPolyData:
    """The surface of a box of widths 1."""
    return _surface({"kind": "Box", "half_extents": (0.5, 0.5, 0.5)})


def cylinder() -> vtkPolyData:
    """The side of a cylinder along z of diameter and length 1."""
    source = vtkCylinderSource()
    source.SetResolution(32)
    source.CappingOff()
    return _along_z(source)


def finite(folder: Folder, frame: Frame, row: int, box: np.ndarray | None = None) -> vtkPolyData:
    """The surface of the large body `row` without its planes.

    With a box (2, 3), the surface also lacks the walls beside the box. For a `shell` it is empty then.
    """
    parts = _parts(folder, frame, row)
    if box is not None and is_shell(folder, row):
        parts = []
    elif box is not None and len(folder.large[row]["shapes"]) > 1:  # a single shape is a tool, such as a blade
        parts = [(shape, part) for shape, part in parts if shape["kind"] != "Box" or not _is_wall(part, box)]
    return joined([part for _, part in parts])


def _parts(folder: Folder, frame: Frame, row: int) -> list[tuple[Mapping[str, Any], vtkPolyData]]:
    """The shapes of the large body `row` without its planes, and their surfaces in the world."""
    place, turn = _pose(folder, frame, row)
    solid = [shape for shape in folder.large[row]["shapes"] if shape["kind"] != "Plane"]
    return [(shape, _placed(_surface(shape), shape, place, turn)) for shape in solid]


def _is_wall(solid: vtkPolyData, box: np.ndarray) -> bool:
    """Whether a solid stands beside the box (2, 3) and is about as long as it is in some direction."""
    low, high = np.reshape(solid.GetBounds(), (3, 2)).T
    middle = (low + high) / 2
    beside = (middle < box[0]) | (middle > box[1])
    along = np.minimum(high, box[1]) - np.maximum(low, box[0]) > 0.8 * (box[1] - box[0])
    return bool(beside.any() and along.any())


def shell(folder: Folder, frame: Frame, row: int) -> vtkPolyData:
    """The triangles of the large body `row`, as seen from inside, if it is a shell, such as a drum or a silo.

    Otherwise the surface is empty.
    """
    if not is_shell(folder, row):
        return vtkPolyData()
    triangles = _solid(folder, frame, row)
    middle = 0.5 * (triangles.min(axis=(0, 1)) + triangles.max(axis=(0, 1)))
    normal = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    away = np.einsum("mi,mi->m", normal, triangles.mean(axis=1) - middle) > 0.0
    if any(shape["kind"] == "Box" for shape in folder.large[row]["shapes"]):
        triangles = triangles[~away]  # only the inner sides of thick walls
    else:
        triangles[away] = triangles[away, ::-1]
    return polydata(triangles.reshape(-1, 3), "polys", 3 * np.arange(1, len(triangles) + 1))


@lru_cache(maxsize=256)
def is_shell(folder: Folder, row: int) -> bool:
    """Whether the large body `row` is a hollow body around the grains.

    It consists of meshes, or of boxes that stand obliquely to each other. At the first or at the last recorded step
    half of the grains are inside.
    """
    solid = [shape for shape in folder.large[row]["shapes"] if shape["kind"] != "Plane"]
    meshes = any(shape["kind"] == "Mesh" for shape in solid)
    if not solid or {shape["kind"] for shape in solid} - {"Box", "Mesh"} or not (meshes or len(solid) > 2):
        return False
    turns = quaternion.matrix(np.array([shape["quaternion"] for shape in solid]))
    if not meshes and (np.abs(turns[0].T @ turns).max(axis=2) > 1.0 - 1e-9).all():
        return False
    for frame in (folder.frame(step) for step in {folder.steps[0], folder.steps[-1]}):
        triangles = _solid(folder, frame, row)
        low, high = triangles.min(axis=(0, 1)), triangles.max(axis=(0, 1))
        grains = frame.position[: folder.grains]
        within = ((low <= grains) & (grains <= high)).all(axis=1)
        if 2 * np.count_nonzero(within) >= folder.grains and (high > low).all() and _is_hollow(triangles, low, high):
            return True
    return False


def _is_hollow(triangles: np.ndarray, low: np.ndarray, high: np.ndarray) -> bool:
    """Whether the triangles (m, 3, 3) leave the space around the middle of their bounds empty."""
    corners = (triangles.reshape(-1, 3) - 0.5 * (low + high)) / (0.5 * (high - low))
    surface = Surface(corners, np.arange(len(corners)).reshape(-1, 3))
    middle = np.broadcast_to(-surface.middle, (len(triangles), 3))
    return bool(surface.closest(middle, np.arange(len(triangles))).distance.min() > HOLLOW)


def _solid(folder: Folder, frame: Frame, row: int) -> np.ndarray:
    """The corners (m, 3, 3) of the triangles of the large body `row` without its planes."""
    return _triangles(joined([part for _, part in _parts(folder, frame, row)]))


def _triangles(surface: vtkPolyData) -> np.ndarray:
    """The corners (m, 3, 3) of the triangles of a surface."""
    source = vtkTriangleFilter()
    source.SetInputData(surface)
    source.Update()
    data = source.GetOutput()
    cells = vtk_to_numpy(data.GetPolys().GetConnectivityArray()).reshape(-1, 3)
    return vtk_to_numpy(data.GetPoints().GetData()).astype(float)[cells]


def joined(parts: Sequence[vtkPolyData]) -> vtkPolyData:
    """Several surfaces as one."""
    whole = vtkAppendPolyData()
    for part in (vtkPolyData(), *parts):
        whole.AddInputData(part)
    whole.Update()
    return whole.GetOutput()


@dataclass(frozen=True)
class Wall:
    """A rectangle that bounds the grains; for a plane, it is larger than the scene."""

    center: np.ndarray  #: (3,) [m]
    normal: np.ndarray  #: (3,) unit vector towards the grains
    first: np.ndarray  #: (3,) half of one edge [m]; normal, first and second are right-handed
    second: np.ndarray  #: (3,) half of the other edge [m]

    def corners(self) -> np.ndarray:
        """The corners (4, 3), counterclockwise as seen from the grains [m]."""
        first, second = self.first, self.second
        return self.center + np.array([first + second, second - first, -first - second, first - second])

    def covers(self, points: np.ndarray) -> bool:
        """Whether all points (k, 3) lie in the prism over the rectangle."""
        away = points - self.center
        return all((np.abs(away @ half) <= (1 + 1e-9) * (half @ half)).all() for half in (self.first, self.second))


def planes(folder: Folder, frame: Frame, row: int, box: np.ndarray) -> list[np.ndarray]:
    """The planes of the large body `row` as polygons (k, 3), as seen from their open side.

    A plane is cut at the `room` of the box (2, 3), and where another plane of the body stands in front of it.
    """
    return _cut(_planes(folder, frame, row, box), box)


def walls(folder: Folder, frame: Frame, box: np.ndarray) -> list[np.ndarray]:
    """The walls around the grains as polygons (k, 3), as seen from inside.

    Walls are the planes of all large bodies. If a large body has boxes that stand beside the scene, `box` (2, 3), the
    faces of these boxes towards the middle of the scene are walls too. The polygons are cut like those of `planes`, and
    also where a wall of another body stands in front of them.
    """
    rows = range(len(folder.large))
    return _cut([wall for kind in (_planes, _box_walls) for row in rows for wall in kind(folder, frame, row, box)], box)


def room(box: np.ndarray) -> np.ndarray:
    """The part of space (2, 3) in which walls are drawn: MARGIN beyond the scene on all sides [m]."""
    beyond = MARGIN * float(np.linalg.norm(box[1] - box[0]))
    return box + np.array([[-beyond], [beyond]])


def _planes(folder: Folder, frame: Frame, row: int, box: np.ndarray) -> list[Wall]:
    place, turn = _pose(folder, frame, row)
    size = 4 * float(np.linalg.norm(box[1] - box[0]))
    found = []
    for shape in folder.large[row]["shapes"]:
        if shape["kind"] == "Plane":
            normal = quaternion.rotate(turn, np.array(shape["normal"]))
            point = place + quaternion.rotate(turn, np.array(shape["center"]))
            first = np.cross(normal, np.eye(3)[np.argmin(np.abs(normal))])
            first *= size / np.linalg.norm(first)
            center = box.mean(axis=0) - normal * (normal @ (box.mean(axis=0) - point))
            found.append(Wall(center, normal, first, np.cross(normal, first)))
    return found


def _box_walls(folder: Folder, frame: Frame, row: int, box: np.ndarray) -> list[Wall]:
    place, turn = _pose(folder, frame, row)
    found: list[Wall] = []
    if len(folder.large[row]["shapes"]) == 1 or is_shell(folder, row):
        return found
    for shape, part in _parts(folder, frame, row):
        if shape["kind"] == "Box" and _is_wall(part, box):
            center = place + quaternion.rotate(turn, np.array(shape["center"]))
            axes = quaternion.matrix(quaternion.multiply(turn, np.array(shape["quaternion"]))).T
            half = np.array(shape["half_extents"])
            way = axes @ (box.mean(axis=0) - center)
            k = int(np.argmax(np.abs(way) - half))
            normal = np.sign(way[k]) * axes[k]
            first, second = half[k - 2] * axes[k - 2], np.sign(way[k]) * half[k - 1] * axes[k - 1]
            found.append(Wall(center + half[k] * normal, normal, first, second))
    return found


def _cut(found: Sequence[Wall], box: np.ndarray) -> list[np.ndarray]:
    """The parts of walls, as polygons (k, 3), that lie in the `room` of a box (2, 3) and behind no other wall."""
    low, high = room(box)
    sides = [(axis, low) for axis in np.eye(3)] + [(-axis, high) for axis in np.eye(3)]
    polygons = []
    for wall in found:
        polygon = wall.corners()
        for normal, point in sides:
            polygon = _before(polygon, normal, point)
        for other in found:
            behind = _clip(polygon, -other.normal, other.center)
            if other is not wall and len(behind) and other.covers(behind):
                polygon = _before(polygon, other.normal, other.center)
        polygons.append(polygon)
    return [polygon for polygon in polygons if len(polygon)]


def _before(polygon: np.ndarray, normal: np.ndarray, point: np.ndarray) -> np.ndarray:
    """The part of a convex polygon (k, 3) in front of a plane.

    A polygon that lies in the plane up to rounding is kept whole.
    """
    height = (polygon - point) @ normal
    if len(polygon) and np.ptp(height) < 1e-9 * np.ptp(polygon):
        return polygon if height[0] >= -1e-9 * np.ptp(polygon) else polygon[:0]
    return _clip(polygon, normal, point)


def polygon_data(polygons: Sequence[np.ndarray]) -> vtkPolyData:
    """Polygons as one surface."""
    if not polygons:
        return vtkPolyData()
    return polydata(np.concatenate(polygons), "polys", np.cumsum([len(p) for p in polygons]))


def outlines(polygons: Sequence[np.ndarray]) -> vtkPolyData:
    """The edges of polygons."""
    if not polygons:
        return vtkPolyData()
    closed = [np.concatenate([p, p[:1]]) for p in polygons]
    return polydata(np.concatenate(closed), "lines", np.cumsum([len(p) for p in closed]))


def _clip(polygon: np.ndarray, normal: np.ndarray, point: np.ndarray) -> np.ndarray:
    """The part of a convex polygon where normal . (x - point) >= 0 (Sutherland and Hodgman, 1974)."""
    height = (polygon - point) @ normal
    kept = []
    for k in range(len(polygon)):
        here, there = height[k - 1], height[k]
        if here * there < 0:
            kept.append(polygon[k - 1] + here / (here - there) * (polygon[k] - polygon[k - 1]))
        if there >= 0:
            kept.append(polygon[k])
    return np.array(kept).reshape(-1, 3)


def _pose(folder: Folder, frame: Frame, row: int) -> tuple[np.ndarray, np.ndarray]:
    return frame.position[folder.grains + row], frame.quaternion[folder.grains + row]


def _surface(shape: Mapping[str, Any]) -> vtkPolyData:
    """The surface of a shape of a large body, in the frame of the shape."""
    if shape["kind"] == "Sphere":
        ball = vtkSphereSource()
        ball.SetRadius(shape["radius"])
        ball.SetThetaResolution(32)
        ball.SetPhiResolution(24)
        ball.Update()
        return ball.GetOutput()
    if shape["kind"] == "Box":
        x, y, z = np.array(shape["half_extents"]) * 2
        block = vtkCubeSource()
        block.SetXLength(x)
        block.SetYLength(y)
        block.SetZLength(z)
        block.Update()
        return block.GetOutput()
    if shape["kind"] == "Mesh":
        corners = np.array(shape["vertices"])[np.array(shape["triangles"])]
        return polydata(corners.reshape(-1, 3), "polys", 3 * np.arange(1, len(corners) + 1))
    if shape["kind"] == "Capsule":
        core = vtkCylinderSource()
        core.SetRadius(shape["radius"])
        core.SetHeight(2 * shape["half_length"])
        core.SetResolution(32)
        core.SetCapsuleCap(True)
        return _along_z(core)
    raise FolderError(f"no surface is known for the shape {shape['kind']}")


def _along_z(source: vtkCylinderSource) -> vtkPolyData:
    """The surface of a source whose axis is y, turned so that its axis is z."""
    turn = vtkTransform()
    turn.RotateX(90)
    return _moved(source, turn)


def _moved(source: Any, transform: vtkTransform) -> vtkPolyData:
    source.Update()
    moved = vtkTransformFilter()
    moved.SetInputConnection(source.GetOutputPort())
    moved.SetTransform(transform)
    moved.Update()
    return moved.GetOutput()


def _placed(surface: vtkPolyData, shape: Mapping[str, Any], place: np.ndarray, turn: np.ndarray) -> vtkPolyData:
    """The surface of a shape, moved into the frame of the body and then into the world frame."""
    inner = np.array(shape.get("quaternion", (1.0, 0.0, 0.0, 0.0)))
    matrix = np.eye(4)
    matrix[:3, :3] = quaternion.matrix(quaternion.multiply(turn, inner))
    matrix[:3, 3] = place + quaternion.rotate(turn, np.array(shape["center"]))
    transform = vtkTransform()
    transform.SetMatrix(matrix.ravel())
    still = vtkTrivialProducer()
    still.SetOutput(surface)
    return _moved(still, transform)
