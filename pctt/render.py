"""``python -m pctt.render DIR``: pictures of the recorded steps of a run and a film of them, without a display."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping, Sequence
from functools import partial
from io import BytesIO
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from mpi4py import MPI

from pctt.folder import Folder, Frame
from pctt.look.program import add_steps, chosen, made_folder, parser, positive, run, whole
from pctt.options import OptionError, made, refuse_bad

if TYPE_CHECKING:
    from pctt.look.stage import Paint

SAMPLE = 12  # frames that decide the camera and the range of the colours
FILMS = ("mp4", "gif", "none")
# title of the colour bar, colour map, part of the map that is used
COLOURS: dict[str, tuple[str, str, tuple[float, float]]] = {
    "speed": ("speed\n[m/s]", "viridis", (0.12, 1.0)),
    "force": ("contact\nforce [N]", "YlOrRd", (0.0, 0.95)),
    "id": ("body id", "turbo", (0.05, 0.95)),
    "size": ("diameter\n[m]", "viridis", (0.12, 1.0)),
    "material": ("material", "turbo", (0.1, 0.85)),
}


def arguments() -> argparse.Namespace:
    line = parser("render", (__doc__ or "").partition(": ")[2])
    add_steps(line)
    line.add_argument("-color", choices=COLOURS, default="speed", help="the quantity that colours the grains")
    line.add_argument(
        "-range", type=float, nargs=2, metavar=("LOW", "HIGH"), help="ends of the colour bar; without: from the data"
    )
    line.add_argument("-azimuth", type=float, default=-60.0, help="camera around the vertical, from x [degrees]")
    line.add_argument("-elevation", type=float, default=25.0, help="camera above the horizon, below 90 [degrees]")
    line.add_argument("-zoom", type=positive(float), default=1.0, help="1 shows the whole scene")
    line.add_argument("-size", type=_size, default="1280x960", metavar="WxH", help="size of a picture [pixels]")
    line.add_argument("-opacity", type=float, default=1.0, help="opacity of large bodies such as blades, 0 to 1")
    line.add_argument("-cut", action="store_true", help="leave out the grains in the half nearer to the camera")
    line.add_argument("-film", choices=FILMS, default="mp4", help="film of the pictures, if there are several")
    line.add_argument("-fps", type=positive(float), default=20.0, help="pictures of the film per second")
    line.add_argument("-output", metavar="DIR", help="folder to write to; without: pictures/ in the output folder")
    given = line.parse_args()
    if not -90 < given.elevation < 90:
        line.error(f"argument -elevation: {given.elevation:g}: allowed is a number between -90 and 90")
    if not isfinite(given.azimuth):
        line.error(f"argument -azimuth: {given.azimuth:g}: allowed is a finite number")
    if not 0 <= given.opacity <= 1:
        line.error(f"argument -opacity: {given.opacity:g}: allowed is a number from 0 to 1")
    if given.range and given.color == "material":
        line.error("argument -range: allowed with -color speed, force, size and id, not with material")
    if given.range and not given.range[0] < given.range[1]:
        line.error(f"argument -range: {given.range[0]:g} {given.range[1]:g}: allowed are two numbers that rise")
    return given


def _size(text: str) -> tuple[int, int]:
    try:
        width, height = map(int, text.split("x"))
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text}: allowed is WIDTHxHEIGHT, such as 1280x960") from None
    if min(width, height) < 32 or width % 2 or height % 2:
        raise argparse.ArgumentTypeError(f"{text}: allowed are even numbers from 32")
    return width, height


def main(comm: MPI.Comm) -> None:
    given = arguments()
    folder = Folder(given.folder)
    folder.require_frames()
    steps = chosen(folder.steps, given)
    target = made_folder(Path(given.output) if given.output else folder.path / "pictures")

    from pctt.look import stage  # imported here, because it needs vtk and -help does not

    sample = [folder.frame(steps[k]) for k in np.unique(np.linspace(0, len(steps) - 1, SAMPLE).astype(int))]
    width, height = given.size
    view = stage.View(given.azimuth, given.elevation, given.zoom, width, height, given.opacity, given.cut)
    theatre = stage.Stage(folder, sample, view, _paint(folder, sample, given.color, given.range))
    pictures = [target / f"{step:06d}.png" for step in steps]
    for step, picture in list(zip(steps, pictures))[comm.rank :: comm.size]:
        frame = folder.frame(step)
        Picture(theatre.draw(frame, _value(given.color, folder, frame))).save(picture)
    comm.Barrier()
    if comm.rank == 0:
        print(f"{len(pictures)} pictures: {target}/{pictures[0].name} to {pictures[-1].name}")
        if len(pictures) > 1 and given.film != "none":
            film = target / f"film.{given.film}"
            {"mp4": write_mp4, "gif": write_gif}[given.film](film, pictures, given.fps)
            print(f"film: {film}")


class Picture:
    """``pixels`` (height, width, 3), 0 to 255; a notebook shows them."""

    def __init__(self, pixels: np.ndarray):
        self.pixels = pixels

    def _repr_png_(self) -> bytes:
        """The picture as a file in PNG format."""
        from PIL import Image

        file = BytesIO()
        Image.fromarray(np.ascontiguousarray(self.pixels)).save(file, format="png", compress_level=4)
        return file.getvalue()

    def save(self, path: str | Path) -> None:
        """Write a PNG file, whole or not at all; FolderError if that fails."""
        with whole(Path(path)) as temporary:
            temporary.write_bytes(self._repr_png_())


def picture(folder: Folder, color: str, view: Mapping[str, Any]) -> Picture:
    """The first recorded step, seen as the fields of `pctt.look.stage.View` say. OptionError for a bad one."""
    from pctt.look import stage, surfaces

    if color not in COLOURS:
        raise OptionError(f"color {color!r}: allowed is one of {', '.join(COLOURS)}")
    seen = made(stage.View, view)
    refuse_bad(seen)
    sharp = seen.zoom > 0 and min(seen.width, seen.height) >= 32
    if not (sharp and -90 < seen.elevation < 90 and isfinite(seen.azimuth)):
        raise OptionError(f"{seen}: allowed are elevation between -90 and 90, zoom above 0, width and height from 32")
    frame = folder.frame(folder.steps[0])
    theatre = stage.Stage(folder, [frame], seen, _paint(folder, [frame], color))
    pixels = theatre.draw(frame, _value(color, folder, frame))
    surfaces.is_shell.cache_clear()  # it would keep the folder
    return Picture(pixels)


def _paint(folder: Folder, sample: list[Frame], colour: str, given: Sequence[float] | None = None) -> Paint:
    """The meaning of a colour in the frames of a sample, with the ends of its range or without."""
    from pctt.look import stage

    title, name, ends = COLOURS[colour]
    low, high = given or _range(colour, [_value(colour, folder, frame) for frame in sample])
    names = [folder.materials[k] for k in _materials(folder)] if colour == "material" else []
    return stage.Paint(title, low, high, name, ends, names)


def _value(colour: str, folder: Folder, frame: Frame) -> np.ndarray:
    """The values (grains,) that give the colours of the grains."""
    values = {
        "speed": lambda: frame.speed,
        "force": frame.load,
        "id": lambda: np.arange(folder.grains),
        "size": lambda: 2 * folder.radius,
        "material": lambda: np.searchsorted(_materials(folder), folder.material),
    }
    return values[colour]()[: folder.grains].astype(float)


def _materials(folder: Folder) -> np.ndarray:
    """The numbers of the materials of the grains, in rising order."""
    return np.unique(folder.material[: folder.grains])


def _range(colour: str, values: list[np.ndarray]) -> tuple[float, float]:
    """The lowest and the highest value of the colours.

    Ids use the range of all ids, materials get equal parts of the range, and sizes use the smallest and the largest
    size. Speeds and forces begin at 0 and end at a round number that at most one grain in a hundred exceeds. So a few
    fast grains do not leave the others in one colour.
    """
    together = np.concatenate(values)
    if colour == "material":
        return -0.5, together.max(initial=0.0) + 0.5
    if colour == "id":
        return 0.0, max(together.max(initial=0.0), 1.0)
    if colour == "size":
        low, high = float(together.min(initial=np.inf)), float(together.max(initial=0.0))
        return (low, high) if low < 0.999 * high else (0.0, high or 1.0)
    high = float(np.quantile(together, 0.99)) or 1.0
    step = 10 ** np.floor(np.log10(high))
    return 0.0, step * min(k for k in (1, 2, 4, 6, 8, 10) if k * step >= high)  # a quarter has few digits


def write_mp4(path: Path, pictures: list[Path], fps: float) -> None:
    """Write a film in H.264. Browsers and presentation programs play it."""
    import imageio_ffmpeg
    from PIL import Image

    with whole(path) as temporary, Image.open(pictures[0]) as first:
        kind = ["-f", "mp4"]  # the temporary name does not end in .mp4
        writer = imageio_ffmpeg.write_frames(
            str(temporary), first.size, fps=fps, quality=7, macro_block_size=2, output_params=kind
        )
        writer.send(None)
        for picture in pictures:
            with Image.open(picture) as image:
                writer.send(image.convert("RGB").tobytes())
        writer.close()


def write_gif(path: Path, pictures: list[Path], fps: float) -> None:
    """Write a film that repeats; its palette is that of the first picture."""
    from PIL import Image

    images = [Image.open(picture).convert("RGB") for picture in pictures]
    palette = images[0].quantize(255)
    first, *others = [image.quantize(palette=palette, dither=Image.Dither.NONE) for image in images]
    with whole(path) as temporary:
        first.save(temporary, format="gif", save_all=True, append_images=others, duration=round(1000 / fps), loop=0)


#: The command pctt-render; its exit status.
program = partial(run, main, "render")


if __name__ == "__main__":
    sys.exit(program())
