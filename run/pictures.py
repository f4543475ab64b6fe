"""Draws the README's pictures of the three scenes anew; see run/pictures."""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import tempfile
from pathlib import Path

# steps from the settled state to the picture, and options of pctt.render
PICTURES = {
    "mixer": (1, ("-color", "force", "-range", "0", "20000", "-cut", "-size", "960x720")),
    "blade": (10, ("-color", "speed", "-size", "800x560")),
    "shear": (10, ("-color", "speed", "-size", "800x560")),
}


def draw(scene: str, n: int, target: Path) -> None:
    """Simulate the steps of a scene on $RANKS ranks (2) and draw the last."""
    steps, look = PICTURES[scene]
    with tempfile.TemporaryDirectory() as folder:
        run = ["-scene", scene, "-scene_n", n, "-restart", "settled", "-ccp_type", "apgd", "-steps", steps]
        mpiexec = [".venv/bin/mpiexec", "-n", os.environ.get("RANKS", "2")]
        # the last step is recorded always, and no other is a multiple of so many
        python(*run, "-output_every", 10**7, "-output", folder, module="run", before=mpiexec)
        python(folder, *look, module="render")
        (picture,) = Path(folder, "pictures").glob("*.png")
        shutil.copyfile(picture, target)
    print(target, flush=True)


def python(*words: object, module: str, before: list[str] | None = None) -> None:
    subprocess.run([*(before or []), ".venv/bin/python", "-m", f"pctt.{module}", *map(str, words)], check=True)


if __name__ == "__main__":
    words = argparse.ArgumentParser("run/pictures", description=__doc__.partition(";")[0])
    words.add_argument("scenes", nargs="*", metavar="SCENE", help=f"of {', '.join(PICTURES)}; none: all")
    words.add_argument("-n", type=int, default=8, help="size of the scenes (8)")
    words.add_argument("-output", type=Path, default=Path("docs"), metavar="DIR", help="where to write (docs)")
    given = words.parse_args()
    unknown = set(given.scenes) - set(PICTURES)
    if unknown:
        words.error(f"{' '.join(sorted(unknown))}: allowed is {', '.join(PICTURES)}")
    given.output.mkdir(parents=True, exist_ok=True)
    for name in given.scenes or PICTURES:
        draw(name, given.n, given.output / f"{name}.png")
