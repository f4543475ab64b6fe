"""Bodies as surfaces of VTK: grains and large bodies, planes cut to the size of the scene."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from vtkmodules.util.numpy_support import numpy_to_vtk, numpy_to_vtkIdTypeArray
from vtkmodules.vtkCommonCore import vtkPoints
from vtkmodules.vtkCommonDataModel import vtkCellArray, vtkPolyData
from vtkmodules.vtkCommonTransforms import vtkTransform
from vtkmodules.vtkFiltersCore import vtkAppendPolyData, vtkTriangleFilter
from vtkmodules.vtkFiltersGeneral import vtkTransformPolyDataFilter
from vtkmodules.vtkFiltersSources import vtkCubeSource, vtkSphereSource

from dem import quaternion
from dem.bodies import BOX, SPHERE
from pctt.look.folder import Folder, FolderError, Frame

MARGIN = 0.06  # how far planes go beyond the bodies, in diagonals of the scene


def bounds(folder: Folder, frames: Sequence[Frame]) -> np.ndarray:
    """Lowest and highest corner (2, 3) of the scene in these frames [m]: grains, and large bodies but for planes."""
    radius = np.linalg.norm(folder.size[: folder.grains], axis=1)[:, None]
    corners = []
    for frame in frames:
        place = frame.position[: folder.grains]
        corners += [(place - radius).min(axis=0), (place + radius).max(axis=0)]
        for solid in (finite(folder, frame, row) for row in range(len(folder.large))):
            if solid.GetNumberOfPoints():
                corners += list(np.reshape(solid.GetBounds(), (3, 2)).T)
    return np.array([np.min(corners, axis=0), np.max(corners, axis=0)])


def polydata(points: np.ndarray, cells: str = "", ends: np.ndarray | None = None) -> vtkPolyData:
    """Points (n, 3), and all of them in turn as `verts`, `lines` or `polys`; a cell ends before each of `ends`."""
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


def unit(kind: int) -> vtkPolyData:
    """The surface of a grain whose `extent` (n, 3) is (1, 1, 1)."""
    if kind not in (SPHERE, BOX):
        raise FolderError(f"no surface is known for grains of shape {kind}")
    source = _ball(0.5) if kind == SPHERE else vtkCubeSource()
    source.Update()
    return source.GetOutput()


def extent(shape: np.ndarray, size: np.ndarray) -> np.ndarray:
    """Widths (n, 3) of grains along their own axes [m]."""
    return 2 * np.where((shape == SPHERE)[:, None], size[:, :1], size)


def finite(folder: Folder, frame: Frame, row: int) -> vtkPolyData:
    """The surface of the large body `row`, but for its planes."""
    place, turn = _pose(folder, frame, row)
    shapes = [shape for shape in folder.large[row]["shapes"] if shape["kind"] != "Plane"]
    return joined([_placed(_surface(shape), shape, place, turn) for shape in shapes])


def joined(parts: Sequence[vtkPolyData]) -> vtkPolyData:
    """Several surfaces as one."""
    whole = vtkAppendPolyData()
    for part in (vtkPolyData(), *parts):
        whole.AddInputData(part)
    whole.Update()
    return whole.GetOutput()


def planes(folder: Folder, frame: Frame, row: int, box: np.ndarray) -> list[np.ndarray]:
    """The planes of the large body `row` as polygons (k, 3) seen from their open side, cut where another plane of the
    body is before them and at MARGIN beyond `box`."""
    place, turn = _pose(folder, frame, row)
    halves = [
        (quaternion.rotate(turn, np.array(shape["normal"])), place + quaternion.rotate(turn, np.array(shape["center"])))
        for shape in folder.large[row]["shapes"]
        if shape["kind"] == "Plane"
    ]
    diagonal = float(np.linalg.norm(box[1] - box[0]))
    low, high = box[0] - MARGIN * diagonal, box[1] + MARGIN * diagonal
    sides = [(axis, low) for axis in np.eye(3)] + [(-axis, high) for axis in np.eye(3)]
    polygons = []
    for normal, point in halves:
        first = np.cross(normal, np.eye(3)[np.argmin(np.abs(normal))])
        first /= np.linalg.norm(first)
        second = np.cross(normal, first)
        center = box.mean(axis=0)
        center = center - normal * (normal @ (center - point))
        polygon = center + 4 * diagonal * np.array([first + second, second - first, -first - second, first - second])
        for other, through in (*halves, *sides):
            if abs(other @ normal) < 1 - 1e-9:
                polygon = _clip(polygon, other, through)
        if len(polygon):
            polygons.append(polygon)
    return polygons


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


def _ball(radius: float) -> vtkSphereSource:
    source = vtkSphereSource()
    source.SetRadius(radius)
    source.SetThetaResolution(32)
    source.SetPhiResolution(24)
    return source


def _surface(shape: Mapping[str, Any]) -> vtkPolyData:
    """A shape of a large body in its own frame."""
    if shape["kind"] == "Sphere":
        source = _ball(shape["radius"])
    elif shape["kind"] == "Box":
        source = vtkCubeSource()
        source.SetXLength(2 * shape["half_extents"][0])
        source.SetYLength(2 * shape["half_extents"][1])
        source.SetZLength(2 * shape["half_extents"][2])
    else:
        raise FolderError(f"no surface is known for the shape {shape['kind']}")
    triangles = vtkTriangleFilter()
    triangles.SetInputConnection(source.GetOutputPort())
    triangles.Update()
    return triangles.GetOutput()


def _placed(surface: vtkPolyData, shape: Mapping[str, Any], place: np.ndarray, turn: np.ndarray) -> vtkPolyData:
    """The surface of a shape moved into the body frame and with it into the world."""
    inner = np.array(shape.get("quaternion", (1.0, 0.0, 0.0, 0.0)))
    matrix = np.eye(4)
    matrix[:3, :3] = quaternion.matrix(quaternion.multiply(turn, inner))
    matrix[:3, 3] = place + quaternion.rotate(turn, np.array(shape["center"]))
    transform = vtkTransform()
    transform.SetMatrix(matrix.ravel())
    moved = vtkTransformPolyDataFilter()
    moved.SetInputData(surface)
    moved.SetTransform(transform)
    moved.Update()
    return moved.GetOutput()
