"""Pictures of a scene, drawn by VTK without a display."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from ctypes.util import find_library
from dataclasses import dataclass

import matplotlib
import numpy as np
import vtkmodules.vtkRenderingFreeType  # noqa: F401 - VTK needs it to draw text
import vtkmodules.vtkRenderingUI  # noqa: F401 - VTK needs it for windows on a display
from vtkmodules.util.numpy_support import numpy_to_vtk, vtk_to_numpy
from vtkmodules.vtkCommonCore import vtkLogger, vtkLookupTable
from vtkmodules.vtkCommonDataModel import vtkPolyData
from vtkmodules.vtkFiltersCore import vtkFeatureEdges
from vtkmodules.vtkFiltersSources import vtkCubeSource
from vtkmodules.vtkRenderingAnnotation import vtkLegendBoxActor, vtkScalarBarActor
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
from dem.bodies import BOX, CAPSULE, SPHERE
from pctt.disk import FileError
from pctt.folder import Folder, Frame
from pctt.look import surfaces
from pctt.look.program import View

INK = (0.1, 0.1, 0.1)
STAGE = 0.86  # part of the width for the scene; the rest is for the colour bar
REACH = 0.06  # how far bodies darken each other, in diagonals of the scene


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

    Walls and shells such as drums are drawn on the side of the grains only, so no wall hides the grains.
    """

    def __init__(self, folder: Folder, frames: Sequence[Frame], view: View, paint: Paint):
        own = view.colours([body["name"] for body in folder.large])
        hidden = {row for row, colour in own.items() if not colour[3]}
        self._window, self.scene, self.view = _window(view), surfaces.Scene(folder, frames, hidden), view
        self._renderer = vtkRenderer(background=(1, 1, 1), use_fxaa=True)
        self._renderer.SetUseDepthPeeling(min(view.opacity, *(colour[3] for colour in own.values()), 1.0) < 1)
        self._shade()
        self._window.SetNumberOfLayers(2)
        margin = vtkRenderer(viewport=(STAGE, 0, 1, 1), layer=1)  # over what goes on there of the floor
        for renderer in (self._renderer, margin):
            self._window.AddRenderer(renderer)
        vtkLightKit().AddLightsToRenderer(self._renderer)
        colours = _lookup_table(paint)
        self._spheres = vtkOpenGLSphereMapper(scale_array="radius")  # round at any size, and thousands cost little
        self._boxes = _glyphs(surfaces.made(vtkCubeSource()))
        self._cylinders = _glyphs(surfaces.cylinder(0.5, 1.0, caps=False))
        self._facets = vtkPolyDataMapper()
        for mapper in (self._spheres, self._boxes, self._cylinders, self._facets):
            mapper.SetScalarModeToUsePointFieldData()
            mapper.SelectColorArray("value")
            mapper.SetLookupTable(colours)
            mapper.UseLookupTableScalarRangeOn()
            self._add(mapper, ambient=0.2, specular=0.15, specular_power=20)
        self._walls, self._shells, self._tools, self._edges = (vtkPolyDataMapper() for _ in range(4))
        for mapper in (self._walls, self._shells, self._tools, self._edges):
            mapper.SetResolveCoincidentTopologyToPolygonOffset()
        self._walls.SetRelativeCoincidentTopologyPolygonOffsetParameters(4, 8)  # behind their edges
        for mapper, colour, properties in (
            (self._walls, (0.88, 0.89, 0.91, 1.0), {"ambient": 0.75, "diffuse": 0.25, "backface_culling": True}),
            (self._shells, (0.72, 0.75, 0.80, 1.0), {"ambient": 0.3, "backface_culling": True}),
            (self._tools, (0.58, 0.63, 0.70, view.opacity), {"ambient": 0.3}),
        ):
            _colour_bodies(mapper, [own.get(row, colour) for row in range(len(folder.large))])
            self._add(mapper, **properties)
        self._edges.ScalarVisibilityOff()
        self._add(self._edges, color=(0.50, 0.52, 0.55), lighting=False, line_width=view.height / 600)
        letters = vtkTextProperty(font_size=round(view.height / 36), color=INK)
        self._stamp = vtkTextActor(position=(0.03 * view.width, 0.03 * view.height), text_property=letters)
        self._renderer.AddViewProp(self._stamp)
        margin.AddViewProp(_legend(colours, paint) if paint.names else _colour_bar(colours, paint.title, letters))
        self._aim(frames)

    def draw(self, frame: Frame, value: np.ndarray) -> np.ndarray:
        """The picture (height, width, 3) of a frame; ``value`` (grains,) gives the colours of the grains."""
        table, scene = frame.table, self.scene
        place, turn = (a[: table.grains] for a in (frame.position, frame.quaternion))
        shape, extent = table.shape[: table.grains], surfaces.extent(scene.folder.path, table)
        shown = np.ones(table.grains, dtype=bool)
        if self.view.cut:
            shown = (place - scene.box.mean(axis=0)) @ _towards_camera(self.view, level=True) <= 0
        ball, block, long = (np.flatnonzero(shown & (shape == kind)) for kind in (SPHERE, BOX, CAPSULE))
        # a capsule is a cylinder and two balls
        core = extent - [0, 0, 1] * extent[:, :1]
        tip = quaternion.rotate(turn[long], np.array([0, 0, 0.5]) * core[long])
        balls = surfaces.members(frame)
        of_form, member, radius = (column[shown[balls[0]]] for column in balls)
        rows = np.concatenate([ball, long, long])
        centers = np.concatenate([place[ball], place[long] - tip, place[long] + tip, member])
        radii = np.concatenate([extent[rows, 0] / 2, radius]).astype(np.float32)
        _show(self._spheres, centers, {"value": value[np.concatenate([rows, of_form])], "radius": radii})
        for mapper, rows, widths in ((self._boxes, block, extent), (self._cylinders, long, core)):
            _show(mapper, place[rows], {"value": value[rows], "extent": widths[rows], "turn": turn[rows]})
        grain, corners = surfaces.faces(frame)
        grain, corners = grain[shown[grain]], corners[shown[grain]]
        facets = surfaces.polydata(corners, "polys", 3)
        surfaces.add_arrays(facets.GetPointData(), {"value": np.repeat(value[grain], 3)})
        self._facets.SetInputDataObject(facets)
        walls = scene.walls(frame)
        self._walls.SetInputDataObject(walls)
        self._edges.SetInputDataObject(surfaces.made(vtkFeatureEdges(coloring=False), walls))
        self._shells.SetInputDataObject(scene.shells(frame))
        self._tools.SetInputDataObject(scene.tools(frame))
        self._stamp.SetInput(f"t = {frame.time:.3f} s")
        self._renderer.ResetCameraClippingRange()
        image = surfaces.made(vtkWindowToImageFilter(input=self._window, read_front_buffer=False))
        width, height, _ = image.GetDimensions()
        return vtk_to_numpy(image.GetPointData().GetScalars()).reshape(height, width, -1)[::-1, :, :3]

    def _add(self, mapper: vtkMapper, **properties: object) -> None:
        """Add what a mapper draws to the scene, with properties of vtkProperty."""
        actor = vtkActor(mapper=mapper)
        for name, value in properties.items():
            setattr(actor.GetProperty(), name, value)
        self._renderer.AddActor(actor)

    def _shade(self) -> None:
        """Let corners and what lies below others be darker: ambient occlusion in screen space."""
        size = np.linalg.norm(self.scene.box[1] - self.scene.box[0])
        self._renderer.SetUseSSAO(True)
        self._renderer.SetSSAORadius(REACH * size)
        self._renderer.SetSSAOBias(0.02 * REACH * size)
        self._renderer.SetSSAOKernelSize(64)
        self._renderer.SetSSAOBlur(True)

    def _aim(self, frames: Sequence[Frame]) -> None:
        """Put the camera as near as possible, so that it still sees the scene of all frames."""
        walls = [surfaces.points(self.scene.walls(frame)) for frame in frames]
        corners = np.concatenate([np.stack(np.meshgrid(*self.scene.box.T), axis=-1).reshape(-1, 3), *walls])
        ahead = _towards_camera(self.view)
        right = np.cross((0, 0, 1), ahead) / np.cos(np.radians(self.view.elevation))
        up = np.cross(ahead, right)
        camera, center = self._renderer.GetActiveCamera(), self.scene.box.mean(axis=0)
        slope = np.tan(np.radians(camera.GetViewAngle() / 2))
        wide = slope * STAGE * self.view.width / self.view.height
        for _ in range(5):  # perspective moves the middle of the picture away from the middle of the box
            x, y, depth = np.array([right, up, ahead]) @ (corners - center).T
            distance = 1.05 * (depth + np.maximum(np.abs(x) / wide, np.abs(y) / slope)).max()
            across, upright = x * distance / (distance - depth), y * distance / (distance - depth)
            center = center + 0.5 * ((across.min() + across.max()) * right + (upright.min() + upright.max()) * up)
        camera.SetFocalPoint(center)
        camera.SetPosition(center + distance / self.view.zoom * ahead)
        camera.SetViewUp(up)
        camera.SetWindowCenter(1 - STAGE, 0)  # the scene is in the middle of its part of the width


def _window(view: View) -> vtkRenderWindow:
    """A window without a display; FileError if VTK would end the process because it lacks a driver."""
    vtkLogger.SetStderrVerbosity(vtkLogger.VERBOSITY_ERROR)  # without a display VTK warns that it tries X, then EGL
    window = vtkRenderWindow()
    if window.GetClassName() == "vtkOSOpenGLRenderWindow" and not find_library("OSMesa"):
        raise FileError(
            "vtk found no display, no EGL driver and no OSMesa; on Debian: apt-get install libosmesa6, "
            "or libegl1 libgl1-mesa-dri"
        )
    window.SetOffScreenRendering(True)
    window.SetMultiSamples(0)
    window.SetSize(view.width, view.height)
    return window


def _glyphs(source: vtkPolyData) -> vtkGlyph3DMapper:
    by, turned = vtkGlyph3DMapper.SCALE_BY_COMPONENTS, vtkGlyph3DMapper.QUATERNION
    arrays = {"scale_array": "extent", "orientation_array": "turn"}
    return vtkGlyph3DMapper(source_data=source, scale_mode=by, orientation_mode=turned, **arrays)


def _show(mapper: vtkMapper, places: np.ndarray, columns: Mapping[str, np.ndarray]) -> None:
    data = surfaces.polydata(places.astype(np.float32), "verts", 1)  # the mapper of spheres needs float32
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


def _colour_bodies(mapper: vtkMapper, colours: Sequence[tuple[float, ...]]) -> None:
    """Let cells have the colour (red, green, blue, alpha) of the row that is their ``body``."""
    table = vtkLookupTable(number_of_table_values=max(len(colours), 1), table_range=(0, max(len(colours) - 1, 1)))
    for row, colour in enumerate(colours):
        table.SetTableValue(row, *colour)
    mapper.SetScalarModeToUseCellFieldData()
    mapper.SelectColorArray("body")
    mapper.SetLookupTable(table)
    mapper.UseLookupTableScalarRangeOn()


def _colour_bar(colours: vtkLookupTable, title: str, letters: vtkTextProperty) -> vtkScalarBarActor:
    texts = {"title_text_property": letters, "label_text_property": letters, "unconstrained_font_size": True}
    labels = {"title": f"{title}\n ", "number_of_labels": 5, "label_format": "%.5g", "maximum_number_of_colors": 256}
    place = {"position": (0.15, 0.2), "width": 0.8, "height": 0.6, "bar_ratio": 0.25}
    return vtkScalarBarActor(lookup_table=colours, **labels, **texts, **place)


def _legend(colours: vtkLookupTable, paint: Paint) -> vtkLegendBoxActor:
    """The title, and below it a box of its colour before each name; the letters fill the width."""
    rows = len(paint.names) + 1
    place = {"position": (0.02, 0.4), "position2": (0.96, 0.05 * rows)}
    box = vtkLegendBoxActor(number_of_entries=rows, border=False, padding=2, **place)
    box.SetEntry(0, vtkPolyData(), paint.title, INK)
    for row, name in enumerate(paint.names):
        box.SetEntry(row + 1, surfaces.made(vtkCubeSource()), name, colours.GetTableValue(row)[:3])
    return box
