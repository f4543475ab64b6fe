"""Pictures and films. A black or white picture would mean that nothing was drawn."""

from __future__ import annotations

import handmade
import numpy as np
import pytest

from pctt.folder import Folder

vtk = pytest.importorskip("vtkmodules.vtkCommonCore", reason="vtk is not installed (extra `pictures`)")
image = pytest.importorskip("PIL.Image", reason="pillow is not installed (extra `pictures`)")
if vtk.vtkVersion.GetVTKMajorVersion() * 100 + vtk.vtkVersion.GetVTKMinorVersion() < 904:
    pytest.skip("vtk before 9.4 does not draw without a display", allow_module_level=True)

SIZE = ("-size", "320x240")


@pytest.fixture
def render(show):
    """`render(*options)` draws; skipped where this machine has no driver."""

    def run(*options, folder, status=0):
        from ctypes.util import find_library

        if not (find_library("EGL") or find_library("OSMesa")):
            pytest.skip("no EGL and no OSMesa")
        return show("render", *SIZE, *options, folder=folder, status=status)

    return run


def pixels(path):
    with image.open(path) as picture:
        return np.asarray(picture.convert("RGB")).astype(int)


def test_a_film_of_all_steps(render, folder, tmp_path):
    pytest.importorskip("imageio_ffmpeg", reason="imageio-ffmpeg is not installed (extra `pictures`)")
    done = render("-output", tmp_path, folder=folder)
    assert done.stderr == ""
    assert sorted(path.name for path in tmp_path.iterdir()) == [*(f"00000{k}.png" for k in range(1, 5)), "film.mp4"]
    pictures = [pixels(tmp_path / f"00000{k}.png") for k in (1, 4)]
    for picture in pictures:
        assert picture.shape == (240, 320, 3)
        assert picture.std() > 20
        assert (picture == 255).all(axis=2).mean() > 0.2  # the background
    assert np.abs(pictures[1] - pictures[0]).max(axis=2).mean() > 5  # they have fallen
    assert (tmp_path / "film.mp4").read_bytes()[4:8] == b"ftyp"


def test_a_gif_of_some_steps(render, folder, tmp_path):
    render("-output", tmp_path, "-first", 2, "-film", "gif", "-fps", 5, folder=folder)
    with image.open(tmp_path / "film.gif") as film:
        assert film.n_frames == 3
        assert film.info["duration"] == 200


def test_colours_follow_the_values(render, tmp_path):
    """From above, at the ends of the range: the fast sphere yellow, the box at rest dark."""
    made = handmade.write(tmp_path / "made", handmade.FLOOR)
    render("-elevation", 89, "-azimuth", -90, "-range", 0, 5, folder=made)
    picture = pixels(made / "pictures" / "000001.png")
    stage = picture[:, : int(0.86 * 320)]
    red, green, blue = np.moveaxis(stage, 2, 0)
    yellow = (blue < 100) & (np.minimum(red, green) > 120)
    dark = (green < 70) & (blue > red)
    assert yellow.sum() > 500
    assert dark.sum() > 500
    # the box is to the right of the sphere (x to the right), and 0.4 x 1.6 seen from above
    assert np.flatnonzero(dark.any(axis=0)).mean() > np.flatnonzero(yellow.any(axis=0)).mean() + 20
    rows, columns = np.flatnonzero(dark.sum(axis=1) > 5), np.flatnonzero(dark.sum(axis=0) > 20)
    assert np.ptp(rows) / np.ptp(columns) == pytest.approx(1.6 / 0.4, rel=0.35)


def test_the_cut_leaves_out_the_nearer_half(render, folder, tmp_path):
    for name, options in {"whole": (), "half": ("-cut",)}.items():
        render("-output", tmp_path / name, "-first", 4, *options, folder=folder)
    whole, half = (pixels(tmp_path / name / "000004.png")[:, :275] for name in ("whole", "half"))
    coloured = [(np.ptp(picture, axis=2) > 40).sum() for picture in (whole, half)]
    assert 0 < coloured[1] < 0.9 * coloured[0]


def test_walls_before_the_grains_hide_nothing(render, tmp_path):
    """Thick boxes about the grains are drawn from inside alone, so the sphere is seen through the nearest."""
    wall = {"kind": "Box", "half_extents": [4, 0.5, 2], "center": [0, -1.5, 2], "quaternion": [1, 0, 0, 0]}
    made = handmade.write(tmp_path / "made", [*handmade.FLOOR, wall])
    render("-azimuth", -90, "-elevation", 10, "-range", 0, 5, folder=made)
    picture = pixels(made / "pictures" / "000001.png")[:, :275]
    assert ((picture[..., 2] < 100) & (picture[..., :2].min(axis=2) > 120)).sum() > 300


def test_materials_have_a_legend_with_their_names(render, tmp_path):
    """Those of the grains: the box is of steel, sphere and capsule are of glass; nobody sees the floor's."""
    from pctt import render as program

    made = handmade.write(tmp_path / "made", handmade.FLOOR)
    read = Folder(made)
    read.require_frames()
    assert [read.materials[k] for k in program._materials(read)] == ["steel", "glass"]
    assert program._value("material", read, read.frame(1)).tolist() == [1, 0, 1]
    render("-color", "material", "-elevation", 89, folder=made)
    legend = pixels(made / "pictures" / "000001.png")[:, 276:]
    coloured = (np.ptp(legend, axis=2) > 60).any(axis=1)
    assert np.count_nonzero(np.diff(coloured.astype(int)) == 1) == 2  # two labels, one below the other


def test_boxes_about_the_scene_end_where_they_meet(tmp_path):
    """The ends are wider than the room between the sides, and a low wall of another body does not cut them."""
    from pctt.look import surfaces

    def wall(half, center):
        return {"kind": "Box", "half_extents": half, "center": center, "quaternion": [1, 0, 0, 0]}

    ends = [wall([0.5, 3, 1], [x, 0, 1]) for x in (-1.6, 2.6)]
    sides = [wall([1.6, 0.5, high / 2], [0.5, y, high / 2]) for y, high in ((-1.6, 2), (1.6, 0.5))]
    read = Folder(handmade.write(tmp_path / "made", [*ends, *sides]))
    read.require_frames()
    box = np.array([[-1.0, -1, 0], [2, 1, 1]])
    beyond = surfaces.MARGIN * np.linalg.norm(box[1] - box[0])
    polygons = surfaces.walls(read, read.frame(1), box)
    for end, x in zip(polygons[:2], (-1.1, 2.1)):
        np.testing.assert_allclose(end.min(axis=0), [x, -1.1, 0], atol=1e-12)
        np.testing.assert_allclose(end.max(axis=0), [x, 1 + beyond, 1 + beyond], atol=1e-12)
    for side, y in zip(polygons[2:], (-1.1, 1.1)):
        np.testing.assert_allclose(side.min(axis=0), [-1.1, y, 0], atol=1e-12)
        np.testing.assert_allclose(side[:, 0].max(), 2.1, atol=1e-12)


def test_planes_are_cut_by_each_other_and_to_the_scene(tmp_path):
    from pctt.look import surfaces

    normals, centers = ([0, 0, 1], [1, 0, 0], [-1, 0, 0], [0, -1, 0]), ([0, 0, 0], [-1.1, 0, 0], [2.1, 0, 0], [0, 9, 0])
    walls = [{"kind": "Plane", "normal": normal, "center": center} for normal, center in zip(normals, centers)]
    read = Folder(handmade.write(tmp_path / "made", walls))
    read.require_frames()
    box = np.array([[-1.0, -1, 0], [2, 1, 1]])
    beyond = surfaces.MARGIN * np.linalg.norm(box[1] - box[0])
    floor, *sides = surfaces.planes(read, read.frame(1), 0, box)
    assert len(sides) == 2  # the fourth is far away
    np.testing.assert_allclose(floor.min(axis=0), [-1.1, -1 - beyond, 0], atol=1e-12)
    np.testing.assert_allclose(floor.max(axis=0), [2.1, 1 + beyond, 0], atol=1e-12)
    for side, x, way in zip(sides, (-1.1, 2.1), (1, -1)):
        np.testing.assert_allclose(side.min(axis=0), [x, -1 - beyond, 0], atol=1e-12)
        np.testing.assert_allclose(side.max(axis=0), [x, 1 + beyond, 1 + beyond], atol=1e-12)
        assert np.cross(side[1] - side[0], side[2] - side[1])[0] * way > 0  # seen from the open side
