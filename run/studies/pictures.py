"""Draws the pictures of README and docs anew; needs no display, but the extra `pictures`.

    run/study pictures [mixer blade shear drum silo] [-n N] [-output DIR]    # from their settled states: DIR/NAME.png
    run/study pictures examples                            # docs/examples/*.png, by the commands in the files

Default are the five scenes, 8 (silo: 4) and docs. A settled state that is not in ~/.cache/pctt is made first, which
takes minutes. $RANKS (2) is the number of ranks.
"""

from __future__ import annotations

import ast
import os
import shlex
import subprocess
import tempfile
from pathlib import Path

from shared import MPIEXEC, PYTHON, ROOT, parser

EXAMPLES = ROOT / "docs" / "examples"

# size, steps from the settled state to the picture, and options of pctt.render
PICTURES = {
    "mixer": (8, 1, ("-color", "force", "-range", "0", "5000", "-cut", "-size", "960x720")),
    "blade": (8, 10, ("-color", "speed", "-size", "800x560")),
    "shear": (8, 10, ("-color", "speed", "-size", "800x560")),
    "drum": (8, 440, ("-color", "speed", "-size", "800x640")),
    "silo": (4, 60, ("-color", "speed", "-size", "560x720")),
}
# the step that is drawn of an example with a film
STEPS = {"drum": 240, "hopper": 120, "incline": 60, "blade": 160, "bucket": 260}
COLOURS = 256  # of a picture, which makes it a third as large


def draw(scene: str, n: int | None, target: Path) -> None:
    """Simulate the steps of a scene and draw the last."""
    own, steps, look = PICTURES[scene]
    with tempfile.TemporaryDirectory() as folder:
        run = ["-scene", scene, "-scene_n", n or own, "-restart", "settled", "-ccp_type", "apgd", "-steps", steps]
        # the last step is recorded always, and no other is a multiple of so many
        python("-m", "pctt.run", *run, "-output_every", 10**7, "-output", folder)
        python("-m", "pctt.render", folder, *look)
        (picture,) = Path(folder, "pictures").glob("*.png")
        keep(picture, target)


def commands(example: Path) -> list[list[str]]:
    """The commands that the head of an example tells, as words."""
    text = ast.get_docstring(ast.parse(example.read_text())) or ""
    lines = [line.strip() for line in text.splitlines() if line.strip().startswith("python ")]
    return [shlex.split(line, comments=True)[1:] for line in lines]


def draw_example(name: str) -> None:
    """Run the commands of an example in a folder of their own, and keep its picture."""
    with tempfile.TemporaryDirectory() as folder:
        for words in commands(EXAMPLES / f"{name}.py"):
            if words[1] == "pctt.render":
                words += ["-first", str(STEPS[name]), "-last", str(STEPS[name])]
            python(*(word.replace("docs/examples", str(EXAMPLES)) for word in words), folder=folder)
        picture = Path(folder, f"{name}.png")
        if name in STEPS:
            picture = Path(folder, name, "pictures", f"{STEPS[name]:06d}.png")
        keep(picture, EXAMPLES / f"{name}.png")


def keep(picture: Path, target: Path) -> None:
    """Put a small copy of a picture into its place."""
    from PIL import Image

    with Image.open(picture) as image:
        image.convert("RGB").quantize(COLOURS).save(target, optimize=True)
    print(target, flush=True)


def python(*words: object, folder: str | Path = ROOT) -> None:
    """Run Python with these words, simulations on $RANKS ranks."""
    line = [str(PYTHON), *map(str, words)]
    if words[1] == "pctt.run":
        line = [str(MPIEXEC), "-n", os.environ.get("RANKS", "2"), *line]
    subprocess.run(line, check=True, cwd=folder)


def pictured() -> list[str]:
    """The examples whose heads tell how to make a picture."""
    return sorted(path.stem for path in EXAMPLES.glob("*.py") if path.stem in STEPS or commands(path))


if __name__ == "__main__":
    words = parser("pictures", __doc__)
    known = [*PICTURES, "examples"]
    words.add_argument("scenes", nargs="*", metavar="WHAT", help=f"of {', '.join(known)}; none: all scenes")
    words.add_argument("-n", type=int, help="size of the scenes; without: that of the pictures in docs")
    words.add_argument("-output", type=Path, default=ROOT / "docs", metavar="DIR", help="where to write scenes (docs)")
    given = words.parse_args()
    unknown = set(given.scenes) - set(known)
    if unknown:
        words.error(f"{' '.join(sorted(unknown))}: allowed is {', '.join(known)}")
    given.output.mkdir(parents=True, exist_ok=True)
    for name in given.scenes or PICTURES:
        if name == "examples":
            for example in pictured():
                draw_example(example)
        else:
            draw(name, given.n, given.output / f"{name}.png")
