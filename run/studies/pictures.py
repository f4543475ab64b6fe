"""Draws the pictures of README and docs anew; needs no display, but the extra `pictures`.

    run/study pictures [mixer blade shear drum silo ...] [-n N] [-output DIR]    # scenes: DIR/NAME.png
    run/study pictures examples [poisson drum ...]         # docs/examples/*.png, by the commands in the files

Default are all scenes at the sizes below, and docs. A settled state that is not in ~/.cache/pctt is made first, which
takes minutes. $RANKS (1) is the number of ranks. What a picture in docs took goes to docs/gallery.json: CPU seconds of
the simulation, without settling and drawing (of examples that draw by themselves: with it).
"""

from __future__ import annotations

import ast
import base64
import json
import os
import resource
import shlex
import subprocess
import tempfile
from pathlib import Path

from shared import MPIEXEC, PYTHON, ROOT, parser, reduce_colours

from pctt.scenes import SCENES

EXAMPLES = ROOT / "docs" / "examples"
GALLERY = ROOT / "docs" / "gallery.json"

# size, steps to the picture, from the settled state if there is one, and options of pctt.render
PICTURES = {
    "mixer": (8, 1, ("-color", "force", "-range", "0", "5000", "-cut", "-size", "960x720")),
    "blade": (8, 10, ("-color", "speed", "-size", "800x560")),
    "shear": (8, 10, ("-color", "speed", "-size", "800x560")),
    "drum": (8, 440, ("-color", "speed", "-size", "800x640")),
    "silo": (4, 60, ("-color", "speed", "-size", "560x720")),
    "belt": (6, 40, ("-color", "material", "-size", "640x480")),
    "wheel": (6, 400, ("-color", "speed", "-elevation", "12", "-size", "640x480")),
    "incline": (8, 1000, ("-color", "speed", "-elevation", "10", "-size", "640x480")),
    "plane_shear": (8, 1000, ("-color", "speed", "-elevation", "10", "-size", "640x480")),
    "triaxial": (6, 500, ("-color", "force", "-size", "800x640")),
}
# the step that is drawn of an example with a film
STEPS = {
    "drum": 240, "hopper": 120, "incline": 60, "blade": 160, "bucket": 1140, "conveyor": 200, "feeder": 1500,
    "vibrated": 1500, "wheel": 1000, "ballast": 1600, "dig": 400,
}  # fmt: skip


def draw(scene: str, n: int | None, target: Path) -> None:
    """Simulate the steps of a scene and draw the last."""
    own, steps, look = PICTURES[scene]
    with tempfile.TemporaryDirectory() as folder:
        run = ["-m", "pctt.run", "-scene", scene, "-scene_n", n or own]
        if SCENES[scene].settling_time:
            python(*run, "-settle", folder=folder)
            run += ["-restart", "settled"]
        # the last step is recorded always, and no other is a multiple of so many
        run += ["-ccp_type", "apgd", "-steps", steps, "-output_every", 10**7, "-output", folder + "/run"]
        seconds = python(*run)
        python("-m", "pctt.render", folder + "/run", *look)
        (picture,) = Path(folder, "run", "pictures").glob("*.png")
        keep(picture, target, f"scenes/{scene}", seconds)


def commands(example: Path) -> list[list[str]]:
    """The commands that the head of an example tells, as words."""
    text = (ast.get_docstring(ast.parse(example.read_text())) or "").replace("\\\n", "")
    lines = [line.strip().removeprefix("mpiexec -n 2 ") for line in text.splitlines()]
    return [shlex.split(line, comments=True)[1:] for line in lines if line.startswith("python ")]


def draw_example(name: str) -> None:
    """Run the commands of an example in a folder of their own, and keep its picture."""
    seconds = 0.0
    with tempfile.TemporaryDirectory() as folder:
        for words in commands(EXAMPLES / f"{name}.py"):
            if words[1] == "pctt.render":
                words += ["-first", str(STEPS[name]), "-last", str(STEPS[name])]
            took = python(*(word.replace("docs/examples", str(EXAMPLES)) for word in words), folder=folder)
            seconds += took if words[1] != "pctt.render" else 0.0
        picture = Path(folder, f"{name}.png")
        if name in STEPS:
            picture = Path(folder, name, "pictures", f"{STEPS[name]:06d}.png")
        keep(picture, EXAMPLES / f"{name}.png", f"examples/{name}", seconds)


def draw_notebook(name: str) -> None:
    """Run the cells of a notebook as one program, and keep the picture that is stored in it."""
    cells = json.loads((EXAMPLES / f"{name}.ipynb").read_text())["cells"]
    cells = [cell for cell in cells if cell["cell_type"] == "code"]
    outputs = [output.get("data", {}) for cell in cells for output in cell["outputs"]]
    with tempfile.TemporaryDirectory() as folder:
        picture = Path(folder, "picture.png")
        picture.write_bytes(base64.b64decode(next(data["image/png"] for data in outputs if "image/png" in data)))
        seconds = python("-c", "\n".join("".join(cell["source"]) for cell in cells), folder=folder)
        keep(picture, EXAMPLES / f"{name}.png", f"examples/{name}", seconds)


def keep(picture: Path, target: Path, name: str, seconds: float) -> None:
    """Put a small copy of a picture into its place, and what it took into the list of the gallery."""
    reduce_colours(picture, target)
    print(f"{target}: {seconds:.1f} CPU s", flush=True)
    if target.is_relative_to(GALLERY.parent):
        took = {**json.loads(GALLERY.read_text()), name: round(seconds, 1)}
        GALLERY.write_text(json.dumps(took, indent=1, sort_keys=True) + "\n")


def python(*words: object, folder: str | Path = ROOT) -> float:
    """Run Python with these words, simulations on $RANKS ranks; CPU seconds of all ranks."""
    line = [str(PYTHON), *map(str, words)]
    if words[1] == "pctt.run" and int(os.environ.get("RANKS", "1")) > 1:
        line = [str(MPIEXEC), "-n", os.environ["RANKS"], *line]
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run(line, check=True, cwd=folder, stdout=subprocess.DEVNULL)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def pictured() -> list[str]:
    """The examples whose heads tell how to make a picture, and notebooks."""
    drawn = [
        path for path in EXAMPLES.glob("*.py")
        if any(words[1] == "pctt.render" or words[-1].endswith(".png") for words in commands(path))
    ]  # fmt: skip
    return sorted(path.stem for path in [*drawn, *EXAMPLES.glob("*.ipynb")])


if __name__ == "__main__":
    words = parser("pictures", __doc__)
    words.add_argument("names", nargs="*", metavar="WHAT", help=f"of {', '.join(PICTURES)}; or examples [NAME ...]")
    words.add_argument("-n", type=int, help="size of the scenes; without: that of the pictures in docs")
    words.add_argument("-output", type=Path, default=ROOT / "docs", metavar="DIR", help="where to write scenes (docs)")
    given = words.parse_args()
    examples = given.names[:1] == ["examples"]
    names, known = (given.names[1:], pictured()) if examples else (given.names, list(PICTURES))
    if unknown := set(names) - set(known):
        words.error(f"{' '.join(sorted(unknown))}: allowed is {', '.join(known)}")
    given.output.mkdir(parents=True, exist_ok=True)
    for name in names or known:
        if examples:
            draw_example(name) if (EXAMPLES / f"{name}.py").exists() else draw_notebook(name)
        else:
            draw(name, given.n, given.output / f"{name}.png")
