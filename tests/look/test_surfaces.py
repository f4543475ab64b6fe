"""The surfaces of large bodies: walls, shells that are seen from inside, and tools."""

from __future__ import annotations

import handmade
import numpy as np
import pytest

from dem import quaternion
from dem.mesh import Mesh
from dem.shapes import Box, Plane, described
from pctt.folder import Folder

pytest.importorskip("pctt.look.surfaces", reason="vtk 9.4 is not installed (extra `pictures`)")

from pctt import export  # noqa: E402
from pctt.look import surfaces  # noqa: E402


@pytest.fixture
def scene(tmp_path):
    """`scene(*shapes)`: a hand-made folder whose large body has these shapes, as a Scene, and its frame."""

    def made(*shapes):
        folder = Folder(handmade.write(tmp_path / "run", [described(shape) for shape in shapes]))
        folder.require_frames()
        frame = folder.frame(1)
        return surfaces.Scene(folder, [frame]), frame

    return made


def polygons(data):
    """The corners of the cells, and their normals by the order of the corners."""
    place = surfaces.points(data)
    cells = [[data.GetCell(k).GetPointId(j) for j in range(data.GetCell(k).GetNumberOfPoints())]
             for k in range(data.GetNumberOfCells())]  # fmt: skip
    corners = [place[cell] for cell in cells]
    return corners, [np.cross(p[1] - p[0], p[2] - p[1]) for p in corners]


def planks(count, radius, half_length):
    """A drum of flat boxes about the y axis."""
    made = []
    for angle in 2 * np.pi * np.arange(count) / count:
        turn = quaternion.exponential(np.array([0, -angle, 0]))
        center = quaternion.rotate(turn, np.array([radius, 0, 0])) + [0.5, 0.5, 0.5]
        made.append(Box((0.05, half_length, radius * np.tan(np.pi / count)), tuple(center), tuple(turn)))
    return made


DRUM = Mesh.revolved([(0, -2), (3, -2), (3, 3), (0, 3)], 24, center=(0.5, 0.5, 0.5))


def test_a_drum_around_the_grains_is_seen_from_inside(scene):
    made, frame = scene(DRUM)
    assert made.tools(frame).GetNumberOfCells() == made.walls(frame).GetNumberOfCells() == 0
    corners, normals = polygons(made.shells(frame))
    assert len(corners) == len(DRUM.triangles)
    inwards = [np.array([0.5, 0.5, 1.0]) - p.mean(axis=0) for p in corners]
    assert (np.einsum("ij,ij->i", normals, inwards) > 0).all()
    np.testing.assert_allclose(made.box, [[-2.5, -2.5, -1.5], [3.5, 3.5, 3.5]], atol=1e-6)
    assert export.large(made, frame).GetNumberOfCells() == len(DRUM.triangles)


def test_a_drum_of_boxes_shows_their_inner_sides(scene):
    made, frame = scene(*planks(12, 3.0, 2.5))
    assert made.tools(frame).GetNumberOfCells() == made.shells(frame).GetNumberOfCells() == 0
    place = surfaces.points(made.walls(frame))
    assert made.walls(frame).GetNumberOfCells() == 12
    assert (np.linalg.norm(place[:, [0, 2]] - 0.5, axis=1) < 3.2).all()


@pytest.mark.parametrize(
    "tool",
    [
        Mesh.revolved([(0, -0.2), (0.4, -0.2), (0.4, 0.2), (0, 0.2)], 12, center=(2.5, 0, 0)),
        Mesh.revolved([(0, -3), (3, -3), (3, -2.9), (0, -2.9)], 12),
    ],
    ids=["wheel beside the grains", "plate below them"],
)
def test_other_meshes_are_tools(tool, scene):
    made, frame = scene(tool)
    assert made.shells(frame).GetNumberOfCells() == 0
    assert made.tools(frame).GetNumberOfCells() == len(tool.triangles)


def test_boxes_about_the_grains_end_where_they_meet(scene):
    """The ends are wider than the room between the sides, and a low side does not cut them."""
    ends = [Box((0.5, 5, 1.25), (x, 0.75, 1.25)) for x in (-1.6, 2.6)]
    sides = [Box((1.6, 0.5, high / 2), (0.5, y, high / 2)) for y, high in ((-1.6, 3), (2.6, 0.5))]
    made, frame = scene(*ends, *sides)
    assert made.tools(frame).GetNumberOfCells() == 0
    beyond = surfaces.MARGIN * np.linalg.norm(made.box[1] - made.box[0])
    corners, _ = polygons(made.walls(frame))
    for end, x in zip(corners[:2], (-1.1, 2.1)):
        np.testing.assert_allclose(end[:, 0], x)
        np.testing.assert_allclose([end[:, 1].min(), end[:, 1].max()], [-1.1, made.box[1, 1] + beyond])
    for side, y in zip(corners[2:], (-1.1, 2.1)):
        np.testing.assert_allclose(side[:, 1], y)
        np.testing.assert_allclose([side[:, 0].min(), side[:, 0].max()], [-1.1, 2.1])


def test_planes_are_cut_by_each_other_and_to_the_scene(scene):
    normals, centers = ([0, 0, 1], [1, 0, 0], [-1, 0, 0], [0, -1, 0]), ([0, 0, 0], [-1.1, 0, 0], [2.1, 0, 0], [0, 9, 0])
    made, frame = scene(*map(Plane, normals, centers))
    beyond = surfaces.MARGIN * np.linalg.norm(made.box[1] - made.box[0])
    low, high = made.box + np.array([[-beyond], [beyond]])
    (floor, *sides), ways = polygons(made.walls(frame))
    assert len(sides) == 2  # the fourth is far away
    np.testing.assert_allclose(floor.min(axis=0), [-1.1, low[1], 0], atol=1e-12)
    np.testing.assert_allclose(floor.max(axis=0), [min(2.1, high[0]), high[1], 0], atol=1e-12)
    for side, x, way, normal in zip(sides, (-1.1, 2.1), (1, -1), ways[1:]):
        np.testing.assert_allclose(side.min(axis=0), [x, low[1], 0], atol=1e-12)
        np.testing.assert_allclose(side.max(axis=0), [x, high[1], high[2]], atol=1e-12)
        assert normal[0] * way > 0  # seen from the open side
