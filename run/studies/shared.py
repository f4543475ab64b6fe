"""What the studies share: their command line, the machine, settled states and their cone problems, tables, results."""

from __future__ import annotations

import argparse
import json
import math
import multiprocessing
import os
import platform
import re
import statistics
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import petsc4py
import scipy

ROOT = Path(__file__).resolve().parents[2]
PYTHON, MPIEXEC = ROOT / ".venv/bin/python", ROOT / ".venv/bin/mpiexec"
Row = dict[str, Any]

# -- beginning and end ------------------------------------------------------------------------------------------


def parser(name: str, about: str | None) -> argparse.ArgumentParser:
    """Of the command line of a study; ``about`` is its docstring."""
    form = argparse.RawDescriptionHelpFormatter
    return argparse.ArgumentParser(f"run/study {name}", description=about, formatter_class=form, allow_abbrev=False)


def listed(kind: Callable[[str], Any] = str, known: Sequence[str] = ()) -> Callable[[str], list[Any]]:
    """The argparse type of words with commas between, each of them ``known`` if there is such a list."""

    def read(text: str) -> list[Any]:
        words = [kind(word) for word in text.split(",") if word]
        for word in words:
            if known and word not in known:
                raise argparse.ArgumentTypeError(f"{word}: allowed are {', '.join(known)}")
        return words

    read.__name__ = "list"
    return read


def called_from(path: str | Path) -> Path:
    """A path of the command line, which is relative to the folder where run/study was called."""
    return Path(os.path.normpath(Path(os.environ.get("CALLED_FROM", ".")) / path))


def say_machine() -> Row:
    """Print and return what the figures are measured on."""
    lines = Path("/proc/cpuinfo").read_text().splitlines()
    about: Row = {"cpu": next((line.split(":")[1].strip() for line in lines if line.startswith("model name")), "?")}
    about |= {"cores": os.cpu_count(), "OMP_NUM_THREADS": os.environ.get("OMP_NUM_THREADS", "1")}
    about |= {"petsc4py": petsc4py.__version__, "python": platform.python_version()}
    about |= {"numpy": np.__version__, "scipy": scipy.__version__}
    print(", ".join(f"{name} {value}" for name, value in about.items()), flush=True)
    return about


def record(name: str, about: Row, rows: list[Row]) -> None:
    """Write results/NAME.json."""
    Path("results").mkdir(exist_ok=True)
    path = Path("results") / f"{name}.json"
    path.write_text(json.dumps({"machine": about, "rows": rows}, indent=1) + "\n")
    print(path)


def commit() -> str:
    """The commit of the checkout, "dirty" if files have changed since."""
    words = ["git", "describe", "--always", "--dirty"]
    return subprocess.run(words, cwd=ROOT, capture_output=True, text=True, check=False).stdout.strip()


def replace_section(page: Path, head: str, text: str) -> None:
    """Write the text of a section of a page, which goes from its head to the next of that level, if there is one."""
    before, _, after = page.read_text("utf-8").partition(head)
    following = re.search("^## ", after, re.MULTILINE)
    rest = after[following.start() :] if following else ""
    page.write_text((before + head + text + rest).rstrip() + "\n", "utf-8")
    print(page)


def replace_table(page: Path, head: str, table: str) -> None:
    """Write the first table of a page after its `head`, and the first commit that it names there."""
    before, found, after = page.read_text("utf-8").partition(head)
    after = re.sub("(?<=commit )[0-9a-f]{7,}", commit(), after, count=1)
    after = re.sub(r"(^\|.*\n)+", table + "\n", after, count=1, flags=re.MULTILINE)
    page.write_text(before + found + after, "utf-8")
    print(page)


class Table:
    """Prints rows as they come, below a line of heads.

    ``columns``: per head the name of the figure in the row, or a function of the row, and a format such as "9.3f".
    """

    def __init__(self, **columns: tuple[str | Callable[[Row], Any], str]):
        self.columns = columns
        print("  ".join(self._text(head.replace("_", " "), form) for head, (_, form) in columns.items()))

    @staticmethod
    def _text(text: str, form: str) -> str:
        """As wide as numbers of this format, on the right if it does not begin with "<"."""
        width = form.strip("<defgs").partition(".")[0]
        return f"{text:{form[0] if form[0] == '<' else '>'}{width}}"

    def add(self, row: Row, more: str = "") -> None:
        """Print a row, and what more there is to say of it."""
        cells = []
        for of, form in self.columns.values():
            value = of(row) if callable(of) else row.get(of, "")
            cells.append(self._text(value, form) if isinstance(value, str) else f"{value:{form}}")
        print("  ".join([*cells, more]).rstrip(), flush=True)


def markdown(heads: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    """A table of Markdown."""
    lines = [heads, ["---"] * len(heads), *rows]
    return "\n".join(f"| {' | '.join(map(str, line))} |" for line in lines)


@contextmanager
def figure(name: str | Path, panels: int, rows: int = 1) -> Iterator[Any]:
    """Axes side by side, row by row, saved as results/NAME.png, or at a path; without matplotlib nothing is drawn."""
    try:
        import matplotlib as mpl
    except ImportError:
        print("no matplotlib: no figure")
        yield []
        return
    mpl.use("agg")
    from matplotlib import pyplot

    size = 6.4 * panels, 4.8 * rows
    drawing, axes = pyplot.subplots(rows, panels, figsize=size, layout="constrained", squeeze=False)
    yield axes.ravel()
    Path("results").mkdir(exist_ok=True)
    path = name if isinstance(name, Path) else Path("results") / f"{name}.png"
    drawing.savefig(path, dpi=150)
    pyplot.close(drawing)
    print(path)


def reduce_colours(picture: Path, target: Path | None = None) -> None:
    """Save a picture, or a copy of it, with 256 colours, which makes it a third as large."""
    from PIL import Image

    with Image.open(picture) as image:
        image.convert("RGB").quantize(256).save(target or picture, optimize=True)


# -- runs and processes -----------------------------------------------------------------------------------------


def results(ranks: int, *options: object) -> tuple[Row, list[Row]]:
    """Run pctt.run with these options; its summary.json, and the lines of its steps.jsonl."""
    with tempfile.TemporaryDirectory() as folder:
        command = [MPIEXEC, "-n", ranks, PYTHON, "-m", "pctt.run", *options, "-output", folder]
        subprocess.run([*map(str, command)], check=True, stdout=subprocess.DEVNULL)
        lines = (Path(folder) / "steps.jsonl").read_text().splitlines()
        return json.loads((Path(folder) / "summary.json").read_text()), [json.loads(line) for line in lines]


def settled_steps(scene: str, n: int, steps: int, *options: object, ranks: int = 1) -> tuple[Row, list[Row]]:
    """`results` of steps from the settled state of a scene."""
    words = ("-scene", scene, "-scene_n", n, "-restart", "settled", "-steps", steps)
    return results(ranks, *words, *options)


def lines_of(command: Sequence[object], seconds: float | None = None) -> tuple[list[Row], str]:
    """The lines of JSON that a process writes, and why it failed; empty if it did not. It is ended after so long."""
    words = [*map(str, command)]
    try:
        done = subprocess.run(words, capture_output=True, text=True, timeout=seconds, check=False)
        said, failure = done.stdout, ""
        if done.returncode:
            failure = ": ".join(["failed", *done.stderr.strip().splitlines()[-1:]])
    except subprocess.TimeoutExpired as over:
        said, failure = (over.stdout or b"").decode(), "out of time"
    return [json.loads(line) for line in said.splitlines() if line.startswith(("{", "["))], failure


def in_new_process(work: Callable[..., Any], *arguments: Any) -> Any:
    """What a function gives in a process where nothing else takes memory or time."""
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        return pool.submit(work, *arguments).result()


def keep_to_one_core() -> None:
    """This process and all that it starts."""
    os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    os.environ["OMP_NUM_THREADS"] = "1"


def median_seconds(do: Callable[[], object], repeat: int = 5) -> float:
    """Median time of a few runs, after one that does not count."""
    do()
    seconds = []
    for _ in range(repeat):
        start = time.perf_counter()
        do()
        seconds.append(time.perf_counter() - start)
    return statistics.median(seconds)


def medians(rows: Sequence[Mapping[str, Any]], *names: str) -> dict[str, float]:
    """Of these figures of some rows; 0 counts where a row has none."""
    return {name: statistics.median(row.get(name, 0.0) for row in rows) for name in names}


# -- settled states, from several starts ------------------------------------------------------------------------


def settled(scene: Any, seed: int | None = None, moved: float = 0.0, **settings: Any) -> Any:
    """The `pctt.Simulation` of a scene from its settled state, on one rank. With a seed every grain is moved by up to
    so much per axis [m], so that the courses of several starts part."""
    from mpi4py import MPI

    from pctt.simulation import Simulation

    sim = Simulation(scene, restart="settled", **{"comm": MPI.COMM_SELF, **settings})
    if seed is not None:
        grains = sim.world.grains
        way = np.random.default_rng(seed).uniform(-1.0, 1.0, grains.position.shape)
        grains.position += moved * way[grains.id]
    return sim


def next_problem(sim: Any, contacts: Any = None) -> Any:
    """The `pctt.ccp.ConeProblem` of the next step of a simulation, of these contacts if they are known."""
    from dem.contact import find_contacts
    from dem.step.system import ContactSystem
    from dem.unconstrained import unconstrained
    from pctt.run.stepper import cone_problem

    world, settings = sim.world, sim.settings
    free = unconstrained(world, settings.dt)
    if contacts is None:
        contacts = find_contacts(world, settings.delta, free)
    return cone_problem(ContactSystem(world, contacts, free, settings.recovery_speed), world.comm)


FIELDS = dict.fromkeys(("dt", "tol", "closing_work", "closing_speed", "stiffness"), float)


def settings_of(words: str) -> dict[str, Any]:
    """Fields of `pctt.Settings` of `dt=.01,tol=1e-3`, or `default`; ValueError for a name or a value that there is
    not."""
    if words in ("default", ""):
        return {}
    pairs = [word.partition("=")[::2] for word in words.split(",")]
    if bad := [name for name, _ in pairs if name not in FIELDS]:
        raise ValueError(f"{bad[0]}: allowed are {', '.join(FIELDS)}")
    return {name: FIELDS[name](value) for name, value in pairs}


def spread(values: Sequence[float]) -> tuple[float, float]:
    """Mean, and its standard error; NaN of one value."""
    error = statistics.stdev(values) / math.sqrt(len(values)) if len(values) > 1 else math.nan
    return statistics.fmean(values), error


def at_least_one(text: str) -> int:
    """The argparse type of a number of starts."""
    if int(text) < 1:
        raise argparse.ArgumentTypeError(f"{text}: allowed are 1 and more")
    return int(text)
