"""What the measuring scripts share: the machine, a run of the program, the record of the result."""

from __future__ import annotations

import json
import os
import platform
import statistics
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import petsc4py
import scipy


def machine() -> dict[str, object]:
    """What the figures were measured on."""
    lines = Path("/proc/cpuinfo").read_text().splitlines()
    cpu = next((line.split(":")[1].strip() for line in lines if line.startswith("model name")), "?")
    versions = {"python": platform.python_version(), "numpy": np.__version__, "scipy": scipy.__version__}
    threads = os.environ.get("OMP_NUM_THREADS", "1")
    petsc = petsc4py.__version__
    return {"cpu": cpu, "cores": os.cpu_count(), "OMP_NUM_THREADS": threads, "petsc4py": petsc, **versions}


def say_machine() -> dict[str, object]:
    about = machine()
    print(", ".join(f"{name} {value}" for name, value in about.items()), flush=True)
    return about


def results(ranks: int, *options: object) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """Run pctt.run with these options; its summary.json, and the lines of its steps.jsonl."""
    with tempfile.TemporaryDirectory() as folder:
        command = [".venv/bin/mpiexec", "-n", str(ranks), ".venv/bin/python", "-m", "pctt.run"]
        command += [*map(str, options), "-output", folder]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
        lines = (Path(folder) / "steps.jsonl").read_text().splitlines()
        return json.loads((Path(folder) / "summary.json").read_text()), [json.loads(line) for line in lines]


def record(name: str, about: dict[str, object], rows: list[dict]) -> None:
    """Write results/NAME.json."""
    Path("results").mkdir(exist_ok=True)
    path = Path("results") / f"{name}.json"
    path.write_text(json.dumps({"machine": about, "rows": rows}, indent=1) + "\n")
    print(path)


class Counter:
    """Counts the calls of methods of a class while it is entered."""

    def __init__(self, of: type, *names: str):
        self.of, self.calls, self.originals = of, 0, {name: getattr(of, name) for name in names}

    def __enter__(self) -> Counter:
        for name, original in self.originals.items():
            setattr(self.of, name, self._counted(original))
        return self

    def _counted(self, original: Callable[..., Any]) -> Callable[..., Any]:
        def method(*arguments: Any) -> Any:
            self.calls += 1
            return original(*arguments)

        return method

    def __exit__(self, *exception: object) -> None:
        for name, original in self.originals.items():
            setattr(self.of, name, original)


def exponent(x: Sequence[float], y: Sequence[float]) -> float:
    """Of y ~ x^p, by least squares of the logarithms; NaN for less than two points."""
    return float(np.polyfit(np.log(x), np.log(y), 1)[0]) if len(x) > 1 else np.nan


def median_seconds(do: Callable[[], object], repeat: int = 5) -> float:
    """Median time of a few runs, after one that does not count."""
    do()
    seconds = []
    for _ in range(repeat):
        start = time.perf_counter()
        do()
        seconds.append(time.perf_counter() - start)
    return statistics.median(seconds)


@contextmanager
def figure(name: str, panels: int, rows: int = 1) -> Iterator[Any]:
    """Axes side by side, row by row, saved as results/NAME.png; without matplotlib nothing is drawn."""
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
    path = Path("results") / f"{name}.png"
    drawing.savefig(path, dpi=150)
    pyplot.close(drawing)
    print(path)
