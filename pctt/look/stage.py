"""Pictures of a scene, drawn by VTK without a display."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from ctypes.util import find_library
from dataclasses import dataclass

import matplotlib
import numpy as np
import vtkmodules.vtkRenderingFreeType  # noqa: F401 - VTK needs it to draw text
import vtkmodules.vtkRenderingUI  # noqa: F401 - VTK needs it for windows on a display
from vtkmodules.util.numpy_support import numpy_to_vtk, vtk_to_numpy
from vtkmodules.vtkCommonCore import vtkLogger, vtkLookupTable, vtkVersion
from vtkmodules.vtkCommonDataModel import vtkPolyData
from vtkmodules.vtkRenderingAnnotation import vtkScalarBarActor
from vtkmodules.vtkRenderingCore import (
    vtkActor,
    vtkGlyph3DMapper,
    vtkLightKit,
    vtkMapper,
    vtkPolyDataMapper,
    vtkRenderer,
    vtkRenderWindow,
    vtkTextActor,
    vtkTextProperty,
    vtkWindowToImageFilter,
)
from vtkmodules.vtkRenderingOpenGL2 import vtkOpenGLSphereMapper

from dem import quaternion
from dem.bodies import BOX, SPHERE
from pctt.folder import Folder, FolderError, Frame
from pctt.look import surfaces

WALL = (0.88, 0.89, 0.91)
EDGE = (0.50, 0.52, 0.55)
TOOL = (0.58, 0.63, 0.70)
SHELL = (0.72, 0.75, 0.80)
STAGE = 0.86  # part of the width for the scene; the rest is for the colour bar


@dataclass(frozen=True)
class View:
    """How a scene is shown."""

    azimuth: float = -60.0  #: of the camera about the vertical, from the x axis [degrees]
    elevation: float = 25.0  #: of the camera above the horizon, between -90 and 90 [degrees]
    zoom: float = 1.0  #: with 1 the whole scene fits into the picture
    width: int = 1280  #: [pixels]
    height: int = 960  #: [pixels]
    opacity: float = 1.0  #: of large bodies without their planes, 0 to 1
    cut: bool = False  #: leave out the grains in the half that is nearer to the camera


@dataclass(frozen=True)
class Paint:
    """The meaning of the colours of the grains."""

    title: str
    low: float
    high: float
    map: str  #: name of a colour map of matplotlib
    ends: tuple[float, float] = (0.0, 1.0)  #: the part of the map that is used
    names: Sequence[str] = ()  #: of the values 0, 1, ...; with names, a legend takes the place of the bar


class Stage:
    """Draws frames of one folder, all with the same camera. The ``frames`` given at first fit into the picture.

    Planes, drums and other shells are drawn on the side of the grains only, so no wall hides the grains.
    """

    def __init__(self, folder: Folder, frames: Sequence[Frame], view: View, paint: Paint):
        self._window = _window(view)
        self.folder, self.box, self.view = folder, surfaces.bounds(folder, frames), view
        self._renderer, margin = vtkRenderer(), vtkRenderer()
        self._renderer.SetViewport(0, 0, STAGE, 1)
        margin.SetViewport(STAGE, 0, 1, 1)
        for renderer in (self._renderer, margin):
            renderer.SetBackground(1, 1, 1)
        self._renderer.SetUseFXAA(True)
        self._renderer.SetUseDepthPeeling(view.opacity < 1)
        vtkLightKit().AddLightsToRenderer(self._renderer)
        colours = _lookup_table(paint)
        self._spheres = vtkOpenGLSphereMapper()  # round at any size, and thousands cost little
        self._spheres.SetScaleArray("radius")
        self._boxes, self._cylinders = _glyphs(surfaces.cube()), _glyphs(surfaces.cylinder())
        for mapper in (self._spheres, self._boxes, self._cylinders):
            self._add_grains(mapper, colours)
        self._walls, self._edges, self._tools, self._shells = map(self._add_surface, (WALL, EDGE, TOOL, SHELL))
        faces, edges, tools = (actor.GetProperty() for actor in (self._walls, self._edges, self._tools))
        faces.BackfaceCullingOn()
        self._shells.GetProperty().BackfaceCullingOn()
        self._shells.GetProperty().SetAmbient(0.3)
        self._walls.GetMapper().SetRelativeCoincidentTopologyPolygonOffsetParameters(4, 8)  # walls behind their edges
        faces.SetAmbient(0.75)
        faces.SetDiffuse(0.25)
        edges.LightingOff()
        edges.SetLineWidth(view.height / 600)
        tools.SetOpacity(view.opacity)
        tools.SetAmbient(0.3)
        self._stamp = _stamp(view)
        self._renderer.AddViewProp(self._stamp)
        for prop in _legend(colours, paint, view) if paint.names else [_colour_bar(colours, paint.title, view)]:
            margin.AddViewProp(prop)
        walls = [polygon for frame in frames for polygon in surfaces.walls(folder, frame, self.box)]
        self._aim(np.concatenate([np.stack(np.meshgrid(*self.box.T), axis=-1).reshape(-1, 3), *walls]))
        self._window.AddRenderer(self._renderer)
        self._window.AddRenderer(margin)

    def draw(self, frame: Frame, value: np.ndarray) -> np.ndarray:
        """The picture (height, width, 3) of a frame; ``value`` (grains,) gives the colours of the grains."""
        folder = self.folder
        place, turn = (a[: folder.grains] for a in (frame.position, frame.quaternion))
        shape, extent = folder.shape[: folder.grains], surfaces.extent(folder)
        shown = np.ones(folder.grains, dtype=bool)
        if self.view.cut:
            shown = (place - self.box.mean(axis=0)) @ _towards_camera(self.view, level=True) <= 0
        ball, block, long = (np.flatnonzero(shown & (shape == kind)) for kind in (SPHERE, BOX, surfaces.CAPSULE))
        # a capsule is a cylinder and two balls
        core = extent - [0, 0, 1] * extent[:, :1]
        tip = quaternion.rotate(turn[long], np.array([0, 0, 0.5]) * core[long])
        rows = np.concatenate([ball, long, long])
        centers = np.concatenate([place[ball], place[long] - tip, place[long] + tip])
        _show(self._spheres, centers, {"value": value[rows], "radius": extent[rows, 0].astype(np.float32) / 2})
        for mapper, rows, widths in ((self._boxes, block, extent), (self._cylinders, long, core)):
            _show(mapper, place[rows], {"value": value[rows], "extent": widths[rows], "turn": turn[rows]})
        large = range(len(folder.large))
        polygons = surfaces.walls(folder, frame, self.box)
        self._walls.GetMapper().SetInputDataObject(surfaces.polygon_data(polygons))
        self._edges.GetMapper().SetInputDataObject(surfaces.outlines(polygons))
        self._tools.GetMapper().SetInputDataObject(
            surfaces.joined([surfaces.finite(folder, frame, row, self.box) for row in large])
        )
        self._shells.GetMapper().SetInputDataObject(
            surfaces.joined([surfaces.shell(folder, frame, row) for row in large])
        )
        self._stamp.SetInput(f"t = {frame.time:.3f} s")
        self._renderer.ResetCameraClippingRange()
        return self._image()

    def _add_grains(self, mapper: vtkMapper, colours: vtkLookupTable) -> None:
        mapper.SetScalarModeToUsePointFieldData()
        mapper.SelectColorArray("value")
        mapper.SetLookupTable(colours)
        mapper.UseLookupTableScalarRangeOn()
        actor = vtkActor()
        actor.SetMapper(mapper)
        actor.GetProperty().SetAmbient(0.2)
        actor.GetProperty().SetSpecular(0.15)
        actor.GetProperty().SetSpecularPower(20)
        self._renderer.AddActor(actor)

    def _add_surface(self, rgb: tuple[float, float, float]) -> vtkActor:
        actor = vtkActor()
        mapper = vtkPolyDataMapper()
        mapper.SetResolveCoincidentTopologyToPolygonOffset()
        actor.SetMapper(mapper)
        actor.GetProperty().SetColor(rgb)
        self._renderer.AddActor(actor)
        return actor

    def _aim(self, points: np.ndarray) -> None:
        """Put the camera as near as possible, so that it still sees all points (n, 3)."""
        camera = self._renderer.GetActiveCamera()
        center = self.box.mean(axis=0)
        corners = points - center
        ahead = _towards_camera(self.view)
        right = np.cross((0, 0, 1), ahead)
        right /= np.linalg.norm(right)
        up = np.cross(ahead, right)
        slope = np.tan(np.radians(camera.GetViewAngle() / 2))
        wide = slope * STAGE * self.view.width / self.view.height
        for _ in range(5):  # perspective moves the middle of the picture away from the middle of the box
            x, y, depth = corners @ right, corners @ up, corners @ ahead
            distance = 1.05 * (depth + np.maximum(np.abs(x) / wide, np.abs(y) / slope)).max()
            across, upright = x * distance / (distance - depth), y * distance / (distance - depth)
            shift = 0.5 * ((across.min() + across.max()) * right + (upright.min() + upright.max()) * up)
            corners, center = corners - shift, center + shift
        camera.SetFocalPoint(center)
        camera.SetPosition(center + distance / self.view.zoom * ahead)
        camera.SetViewUp(0, 0, 1)

    def _image(self) -> np.ndarray:
        grab = vtkWindowToImageFilter()
        grab.SetInput(self._window)
        grab.ReadFrontBufferOff()
        grab.Update()
        image = grab.GetOutput()
        width, height, _ = image.GetDimensions()
        return vtk_to_numpy(image.GetPointData().GetScalars()).reshape(height, width, -1)[::-1, :, :3]


def _window(view: View) -> vtkRenderWindow:
    """A window without a display; FolderError if VTK would end the process because it lacks a driver."""
    version = vtkVersion.GetVTKVersion()
    if not os.environ.get("DISPLAY"):
        if tuple(map(int, version.split(".")[:2])) < (9, 4):
            raise FolderError(f"vtk {version} cannot draw without a display: pip install 'vtk>=9.4', or set DISPLAY")
        vtkLogger.SetStderrVerbosity(vtkLogger.VERBOSITY_ERROR)  # VTK warns that it tries X first, then EGL
    window = vtkRenderWindow()
    if window.GetClassName() == "vtkOSOpenGLRenderWindow" and not find_library("OSMesa"):
        raise FolderError(
            "vtk found no display, no EGL driver and no OSMesa; on Debian: apt-get install libosmesa6, "
            "or libegl1 libgl1-mesa-dri"
        )
    window.SetOffScreenRendering(True)
    window.SetMultiSamples(0)
    window.SetSize(view.width, view.height)
    return window


def _glyphs(source: vtkPolyData) -> vtkGlyph3DMapper:
    mapper = vtkGlyph3DMapper()
    mapper.SetSourceData(source)
    mapper.SetScaleArray("extent")
    mapper.SetScaleModeToScaleByVectorComponents()
    mapper.SetOrientationArray("turn")
    mapper.SetOrientationModeToQuaternion()
    return mapper


def _show(mapper: vtkMapper, points: np.ndarray, columns: Mapping[str, np.ndarray]) -> None:
    data = surfaces.polydata(points.astype(np.float32), "verts")  # the mapper of spheres needs float32
    surfaces.add_arrays(data.GetPointData(), columns)
    mapper.SetInputDataObject(data)


def _towards_camera(view: View, level: bool = False) -> np.ndarray:
    """Unit vector to the camera; if ``level``, its horizontal direction."""
    azimuth, elevation = np.radians([view.azimuth, 0.0 if level else view.elevation])
    flat = np.cos(elevation)
    return np.array([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)])


def _lookup_table(paint: Paint) -> vtkLookupTable:
    table = vtkLookupTable()
    colours = matplotlib.colormaps[paint.map](np.linspace(*paint.ends, len(paint.names) or 256), bytes=True)
    table.SetTable(numpy_to_vtk(np.ascontiguousarray(colours), deep=True))
    table.SetTableRange(paint.low, paint.high)
    return table


def _colour_bar(colours: vtkLookupTable, title: str, view: View) -> vtkScalarBarActor:
    bar = vtkScalarBarActor()
    bar.SetLookupTable(colours)
    bar.SetTitle(f"{title}\n ")
    bar.SetNumberOfLabels(5)
    bar.SetLabelFormat("%.5g")
    bar.UnconstrainedFontSizeOn()
    for text in (bar.GetTitleTextProperty(), bar.GetLabelTextProperty()):
        _plain(text, view)
    bar.SetMaximumNumberOfColors(256)
    bar.SetPosition(0.15, 0.2)
    bar.SetWidth(0.8)
    bar.SetHeight(0.6)
    bar.SetBarRatio(0.25)
    return bar


def _legend(colours: vtkLookupTable, paint: Paint, view: View) -> list[vtkTextActor]:
    """The title, and below it each name on its colour. The letters are so small that the longest name has room."""
    size = min(view.height / 36, 1.6 * (1 - STAGE) * view.width / max(map(len, paint.names)))
    lines = []
    for row, text in enumerate([paint.title, *paint.names]):
        line = vtkTextActor()
        line.SetInput(text if row == 0 else f" {text} ")
        style = line.GetTextProperty()
        _plain(style, view)
        style.SetFontSize(max(round(size), 1))
        line.SetPosition(0.0, 0.75 * view.height - 2.2 * row * size)
        if row > 0:
            rgb = np.array(colours.GetTableValue(row - 1)[:3])
            style.SetBackgroundColor(rgb)
            style.SetBackgroundOpacity(1.0)
            style.SetColor(np.full(3, 0.1 if rgb @ (0.3, 0.6, 0.1) > 0.45 else 1.0))
        lines.append(line)
    return lines


def _stamp(view: View) -> vtkTextActor:
    stamp = vtkTextActor()
    _plain(stamp.GetTextProperty(), view)
    stamp.SetPosition(0.03 * view.width, 0.03 * view.height)
    return stamp


def _plain(text: vtkTextProperty, view: View) -> None:
    text.SetFontFamilyToArial()
    text.SetFontSize(round(view.height / 36))
    text.SetColor(0.1, 0.1, 0.1)
    text.BoldOff()
    text.ItalicOff()
    text.ShadowOff()
