"""Meshes and drums as surfaces: what is a tool, and what a shell that is seen from inside."""

from __future__ import annotations

import handmade
import numpy as np
import pytest

from dem import quaternion
from dem.mesh import Mesh
from dem.shapes import Box, described
from pctt.folder import Folder

pytest.importorskip("vtkmodules.vtkCommonCore", reason="vtk is not installed (extra `pictures`)")

from pctt import export  # noqa: E402
from pctt.look import surfaces  # noqa: E402


def scene(tmp_path, *shapes):
    folder = Folder(handmade.write(tmp_path / "run", [described(shape) for shape in shapes]))
    folder.require_frames()
    frame = folder.frame(1)
    return folder, frame, surfaces.bounds(folder, [frame])


def planks(count, radius, half_length, **place):
    """A drum of flat boxes about the y axis."""
    made = []
    for angle in 2 * np.pi * np.arange(count) / count:
        turn = quaternion.exponential(np.array([0, -angle, 0]))
        center = quaternion.rotate(turn, np.array([radius, 0, 0])) + [0.5, 0.5, 0.5]
        made.append(Box((0.05, half_length, radius * np.tan(np.pi / count)), tuple(center), tuple(turn)))
    return made


def triangles(data):
    return data.GetNumberOfCells()


def test_a_drum_around_the_grains_is_seen_from_inside(tmp_path):
    drum = Mesh.revolved([(0, -2), (3, -2), (3, 3), (0, 3)], 24, center=(0.5, 0.5, 0.5))
    folder, frame, box = scene(tmp_path, drum)
    assert surfaces.finite(folder, frame, 0, box).GetNumberOfPoints() == 0
    shell = surfaces.shell(folder, frame, 0)
    assert triangles(shell) == len(drum.triangles)
    corners = surfaces._triangles(shell)
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    inwards = np.array([0.5, 0.5, 1.0]) - corners.mean(axis=1)
    assert (np.einsum("ij,ij->i", normal, inwards) > 0).all()
    np.testing.assert_allclose(box, [[-2.5, -2.5, -1.5], [3.5, 3.5, 3.5]], atol=1e-6)


def test_a_drum_of_boxes_is_no_container(tmp_path):
    folder, frame, box = scene(tmp_path, *planks(12, 3.0, 2.5))
    assert surfaces.walls(folder, frame, box) == []
    assert surfaces.finite(folder, frame, 0, box).GetNumberOfPoints() == 0
    shell = surfaces._triangles(surfaces.shell(folder, frame, 0))
    assert len(shell) >= 12 * 2
    inner = np.linalg.norm(shell.mean(axis=1)[:, [0, 2]] - 0.5, axis=1)
    assert (inner < 3.0).any()


@pytest.mark.parametrize(
    "tool",
    [
        Mesh.revolved([(0, -0.2), (0.4, -0.2), (0.4, 0.2), (0, 0.2)], 12, center=(2.5, 0, 0)),
        Mesh.revolved([(0, -3), (3, -3), (3, -2.9), (0, -2.9)], 12),
    ],
    ids=["wheel beside the grains", "plate below them"],
)
def test_other_meshes_are_tools(tmp_path, tool):
    folder, frame, box = scene(tmp_path, tool)
    assert triangles(surfaces.shell(folder, frame, 0)) == 0
    assert triangles(surfaces.finite(folder, frame, 0, box)) == len(tool.triangles)


def test_a_container_of_boxes_keeps_its_walls(tmp_path):
    sides = [Box((0.1, 2, 2), (x, 0.75, 0.5)) for x in (-1.1, 2.6)]
    sides += [Box((2, 0.1, 2), (0.75, y, 0.5)) for y in (-1.1, 2.6)]
    folder, frame, box = scene(tmp_path, *sides)
    assert triangles(surfaces.shell(folder, frame, 0)) == 0
    assert len(surfaces.walls(folder, frame, box)) == 4


def test_meshes_are_exported_whole(tmp_path):
    drum = Mesh.revolved([(0, -2), (3, -2), (3, 3), (0, 3)], 24)
    folder, frame, box = scene(tmp_path, drum)
    assert triangles(export.large(folder, frame, box)) == len(drum.triangles)
