"""Pictures and films. A black or white picture would mean that nothing was drawn."""

from __future__ import annotations

import re

import handmade
import numpy as np
import pytest

from pctt import render as program
from pctt.look.program import View
from pctt.options import OptionError

pytest.importorskip("pctt.look.surfaces", reason="vtk 9.4 is not installed (extra `pictures`)")
image = pytest.importorskip("PIL.Image", reason="pillow is not installed (extra `pictures`)")

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
    render("-output", tmp_path, "-first", 3, "-film", "gif", "-fps", 5, folder=folder)
    with image.open(tmp_path / "film.gif") as film:
        assert film.n_frames == 2
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
    sides = [([4, 0.5, 2], [0, y, 2]) for y in (-1.5, 3)] + [([0.5, 4, 2], [x, 0, 2]) for x in (-2, 4)]
    walls = [{"kind": "Box", "half_extents": h, "center": c, "quaternion": [1, 0, 0, 0]} for h, c in sides]
    made = handmade.write(tmp_path / "made", [*handmade.FLOOR, *walls])
    render("-azimuth", -90, "-elevation", 10, "-range", 0, 5, folder=made)
    picture = pixels(made / "pictures" / "000001.png")[:, :275]
    assert ((picture[..., 2] < 100) & (picture[..., :2].min(axis=2) > 120)).sum() > 300


def test_materials_have_a_legend_with_their_names(render, tmp_path):
    """Those of the grains: the box is of steel, sphere and capsule are of glass; nobody sees the floor's."""
    made = handmade.write(tmp_path / "made", handmade.FLOOR)
    render("-color", "material", "-elevation", 89, folder=made)
    legend = pixels(made / "pictures" / "000001.png")[:, 276:]
    _, counts = np.unique(legend[np.ptp(legend, axis=2) > 60], axis=0, return_counts=True)
    assert (counts > 10).sum() == 2  # two boxes, and the soft edges of letters


@pytest.mark.parametrize(
    ("colour", "values", "ends"),
    [
        ("speed", [*np.linspace(0.0, 1.9, 1000), 500.0], (0.0, 2.0)),  # an outlier does not leave the others in one
        ("size", [0.1, 0.2, 0.5], (0.1, 0.5)),
        ("size", [0.0080251, 0.0159742], (0.008, 0.016)),  # 0.0080251 has no room beside the bar
        ("size", [0.0119, 0.0121, 0.0125], (0.0118, 0.0126)),
        ("size", [9.9, 10.1], (9.9, 10.1)),
        ("size", [0.2, 0.2], (0.0, 0.2)),
        ("force", [0.0, 0.0], (0.0, 1.0)),
        ("material", [0, 1, 2], (0.0, 2.0)),
        ("id", [0], (0.0, 1.0)),
    ],
)
def test_ends_of_the_colours(colour, values, ends):
    assert program.ends_of(colour, np.array(values, dtype=float)) == pytest.approx(ends, rel=1e-12)


def test_bodies_have_the_colours_that_are_given():
    """By matplotlib's names; what is transparent hides nothing."""
    found = View(bodies={"blade": "orange", "box": "none", "lid": ("b", 0.5)}).colours(["box", "blade", "lid"])
    assert found == {1: (1.0, pytest.approx(165 / 255), 0.0, 1.0), 0: (0.0,) * 4, 2: (0.0, 0.0, 1.0, 0.5)}
    for bodies, words in (
        ({"blad": "red"}, "bodies: there is no large body 'blad'; allowed is one of box, blade; did you mean blade?"),
        ({"blade": "ornge"}, "bodies: the colour 'ornge' of 'blade'; allowed is one that matplotlib knows"),
    ):
        with pytest.raises(OptionError, match=re.escape(words)):
            View(bodies=bodies).colours(["box", "blade"])


def test_a_body_is_drawn_in_its_colour_or_not_at_all(render, folder, tmp_path):
    pure = []
    for name, bodies in {"alone": "box=none,mixer=red", "hidden": "mixer=none"}.items():
        render("-output", tmp_path / name, "-first", 4, "-cut", "-bodies", bodies, folder=folder)
        red, green, blue = np.moveaxis(pixels(tmp_path / name / "000004.png")[:, :275], 2, 0)
        pure.append(np.count_nonzero((red > 100) & (green < 40) & (blue < 40)))
    assert pure[0] > 100
    assert pure[1] == 0
    done = render("-bodies", "mixr=red", folder=folder, status=2)
    assert "there is no large body 'mixr'; allowed is one of box, mixer; did you mean mixer?" in done.stderr
    assert "mixer: allowed is NAME=COLOR" in render("-bodies", "mixer", folder=folder, status=2).stderr
