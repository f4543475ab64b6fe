"""``python -m pctt.render DIR``: pictures of the recorded steps of a run and a film of them, without a display."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields
from functools import partial
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from mpi4py import MPI

from pctt.disk import whole
from pctt.folder import Folder, Frame
from pctt.look.program import View, checked, chosen, described_steps, made_folder, parser, run
from pctt.options import POSITIVE, OptionError, made, nearest, refuse_bad

PALETTE = ["-vf", "split[a][b];[a]palettegen[p];[b][p]paletteuse=dither=none"]  # of a GIF, of its own colours
SAMPLE = 12  # frames that decide the camera and the range of the colours
SIZE = ("WIDTHxHEIGHT with even numbers from 32, such as 1280x960", lambda size: not any(n < 32 or n % 2 for n in size))
BODIES = "colours of large bodies, as matplotlib knows them, such as blade=orange,box=none; none: not shown"
# title of the colour bar, colour map, part of the map that is used
COLOURS: dict[str, tuple[str, str, tuple[float, float]]] = {
    "speed": ("speed\n[m/s]", "viridis", (0.12, 1.0)),
    "force": ("contact\nforce [N]", "YlOrRd", (0.0, 0.95)),
    "id": ("body id", "turbo", (0.05, 0.95)),
    "size": ("diameter\n[m]", "viridis", (0.12, 1.0)),
    "material": ("material", "turbo", (0.1, 0.85)),
}


def arguments() -> tuple[argparse.Namespace, View]:
    """The command line, and the view that it describes."""
    line = parser("render", (__doc__ or "").partition(": ")[2], "pictures")
    line.add_argument("-color", choices=COLOURS, default="speed", help="the quantity that colours the grains")
    line.add_argument("-range", type=float, nargs=2, metavar=("LOW", "HIGH"), help="of the colours; without: from data")
    for field in fields(View)[:4]:
        line.add_argument(f"-{field.name}", type=float, default=field.default, help=field.metadata["help"])
    line.add_argument("-bodies", type=_bodies, default={}, metavar="NAME=COLOR,...", help=BODIES)
    line.add_argument("-cut", action="store_true", help=fields(View)[4].metadata["help"])
    line.add_argument("-size", type=checked(_size, SIZE), default="1280x960", metavar="WxH", help="in pixels")
    line.add_argument("-film", choices=("mp4", "gif", "none"), default="mp4", help="film of several pictures")
    line.add_argument("-fps", type=checked(float, POSITIVE), default=20.0, help="pictures of the film per second")
    given = line.parse_args()
    if given.range and (given.color == "material" or not given.range[0] < given.range[1]):
        low, high = given.range
        line.error(f"-range {low:g} {high:g}: allowed are two numbers that rise, and not with -color material")
    width, height = given.size
    view = View(
        given.azimuth, given.elevation, given.zoom, given.opacity, given.cut, width, height, given.bodies
    )  # fmt: skip
    try:
        refuse_bad(view)
    except OptionError as error:
        line.error(f"-{error}")
    return given, view


def _bodies(text: str) -> dict[str, str]:
    pairs = [pair.partition("=") for pair in text.split(",")]
    for name, _, colour in pairs:
        if not (name and colour):
            raise argparse.ArgumentTypeError(f"{text}: allowed is NAME=COLOR, and more behind commas")
    return {name: colour for name, _, colour in pairs}


def _size(text: str) -> tuple[int, ...]:
    width, height = map(int, text.split("x"))
    return width, height


def main(comm: MPI.Comm) -> None:
    given, view = arguments()
    folder = Folder(given.folder)
    folder.require_frames()
    steps = chosen(folder.steps, given)
    target = made_folder(given.output or folder.path / "pictures")
    sample = [folder.frame(steps[k]) for k in np.unique(np.linspace(0, len(steps) - 1, SAMPLE).astype(int))]
    draw = _stage(folder, sample, view, given.color, given.range)
    pictures = [target / f"{step:06d}.png" for step in steps]
    for step, picture in list(zip(steps, pictures))[comm.rank :: comm.size]:
        draw(folder.frame(step)).save(picture)
    comm.Barrier()
    if comm.rank == 0:
        print(f"{described_steps(folder, steps)}: {target}/{pictures[0].name} to {pictures[-1].name}")
        if len(pictures) > 1 and given.film != "none":
            film = target / f"film.{given.film}"
            write_film(film, pictures, given.fps)
            print(f"film: {film}")


class Picture:
    """``pixels`` (height, width, 3), 0 to 255; a notebook shows them."""

    def __init__(self, pixels: np.ndarray):
        self.pixels = pixels

    def __repr__(self) -> str:
        return f"<Picture of {self.pixels.shape[1]} x {self.pixels.shape[0]} pixels, which save(file) writes as PNG>"

    def _repr_png_(self) -> bytes:
        """The picture as a file in PNG format."""
        from PIL import Image

        file = BytesIO()
        Image.fromarray(np.ascontiguousarray(self.pixels)).save(file, format="png", compress_level=4)
        return file.getvalue()

    def save(self, path: str | Path) -> None:
        """Write a PNG file, whole or not at all; FileError if that fails. OptionError for another suffix."""
        if Path(path).suffix.lower() != ".png":
            raise OptionError(f"save({str(path)!r}): allowed is a name that ends with .png")
        with whole(Path(path)) as temporary:
            temporary.write_bytes(self._repr_png_())


def picture(folder: Folder, color: str, view: Mapping[str, Any]) -> Picture:
    """The first recorded step, seen as the fields of `pctt.look.program.View` say. OptionError for a bad one."""
    if color not in COLOURS:
        raise OptionError(f"color {color!r}: allowed is one of {', '.join(COLOURS)}{nearest(color, COLOURS)}")
    seen, frame = made(View, view), folder.frame(folder.steps[0])
    refuse_bad(seen)
    return _stage(folder, [frame], seen, color)(frame)


def _stage(
    folder: Folder, sample: list[Frame], view: View, colour: str, given: Sequence[float] | None = None
) -> Callable[[Frame], Picture]:
    """What draws frames of a folder. The sample decides the camera, and the ends of the colours that are not given."""
    from pctt.look.stage import Paint, Stage  # imported here, because it needs vtk and -help does not

    kinds = np.unique(np.concatenate([frame.table.material[: frame.table.grains] for frame in sample]))
    values: dict[str, Callable[[Frame], np.ndarray]] = {
        "speed": lambda frame: frame.speed,
        "force": lambda frame: frame.load(),
        "id": lambda frame: frame.table.id,
        "size": lambda frame: 2 * frame.table.radius,
        "material": lambda frame: np.searchsorted(kinds, frame.table.material),
    }

    def value(frame: Frame) -> np.ndarray:
        return values[colour](frame)[: frame.table.grains].astype(float)

    title, name, ends = COLOURS[colour]
    names = [folder.materials[k] for k in kinds] if colour == "material" else []
    low, high = given or ends_of(colour, np.concatenate([value(frame) for frame in sample]))
    stage = Stage(folder, sample, view, Paint(title, low, high, name, ends, names))
    return lambda frame: Picture(stage.draw(frame, value(frame)))


def ends_of(colour: str, values: np.ndarray) -> tuple[float, float]:
    """The lowest and the highest value of the colours.

    Ids and materials use the range from 0, and sizes the least range with all of them whose quarters are round numbers,
    which fit beside the bar. Speeds and forces begin at 0 and end at a round number that at most one grain in a hundred
    exceeds. So a few fast grains do not leave the others in one colour.
    """
    low, high = (values.min(), values.max()) if len(values) else (0.0, 0.0)
    if colour in ("id", "material"):
        return 0.0, max(high, 1.0)
    if colour == "size":
        return _round_ends(low, high) if low < 0.999 * high else (0.0, high or 1.0)
    high = (float(np.quantile(values, 0.99)) if len(values) else 0.0) or 1.0
    step = 10 ** np.floor(np.log10(high))
    return 0.0, step * min(k for k in (1, 2, 4, 6, 8, 10) if k * step >= high)  # a quarter has few digits


def _round_ends(low: float, high: float) -> tuple[float, float]:
    """The ends of four steps of 1, 2 or 5 times a power of ten that hold both."""
    power = 10.0 ** np.floor(np.log10((high - low) / 4))
    steps = power * np.array([1, 2, 5, 10, 20])
    first = np.floor(low / steps * (1 + 1e-9)) * steps
    k = np.argmax(first + 4 * steps >= high * (1 - 1e-9))
    return float(first[k]), float(first[k] + 4 * steps[k])


def write_film(path: Path, pictures: list[Path], fps: float) -> None:
    """Write a film: .mp4 in H.264, which browsers and presentation programs play, or .gif, which repeats."""
    import imageio_ffmpeg
    from PIL import Image

    kind: dict[str, Any] = {"quality": 7, "output_params": ["-f", "mp4"]}  # the temporary name does not end in it
    if path.suffix == ".gif":
        kind = {"codec": "gif", "pix_fmt_out": "pal8", "output_params": ["-f", "gif", *PALETTE]}
    kind["ffmpeg_log_level"] = "error"  # its warnings are of colours that are alike
    with whole(path) as temporary, Image.open(pictures[0]) as first:
        writer = imageio_ffmpeg.write_frames(str(temporary), first.size, fps=fps, macro_block_size=2, **kind)
        writer.send(None)
        for picture in pictures:
            with Image.open(picture) as image:
                writer.send(image.convert("RGB").tobytes())
        writer.close()


#: The command pctt-render; its exit status.
program = partial(run, main, "render")


if __name__ == "__main__":
    sys.exit(program())
