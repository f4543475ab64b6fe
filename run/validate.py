"""Checks against closed forms and published laws; see run/validate."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

RUNS = Path("results/validation")
OUTLETS, FRICTIONS = (4.5, 5.5, 6.5), (0.1, 0.3, 0.6)

#: The runs of each check: names and options of ``python -m pctt.run``.
JOBS: dict[str, dict[str, Sequence[object]]] = {
    "column": {"column": ("run/validation/column.py", "-steps", 240)},
    "silo": {
        f"silo_{outlet:g}": (
            *("silo", "-scene_n", 6, "-scene_filling", 0.7, "-scene_half_angle", 90, "-scene_outlet", outlet),
            *("-steps", steps),
        )
        for outlet, steps in zip(OUTLETS, (520, 350, 280))
    },
    "heap": {
        f"heap_{friction:g}": ("run/validation/heap.py", "-scene_friction", friction, "-steps", 500)
        for friction in FRICTIONS
    },
    "drum": {"drum": ("drum", "-steps", 700)},
}


def run(name: str, options: Sequence[object]) -> None:
    """Make a run in its folder, unless it is there already with the same options."""
    folder, mark = RUNS / name, RUNS / f"{name}.options"
    words = " ".join(map(str, options))
    if mark.exists() and mark.read_text() == words:
        print(f"{name}: kept as it is in {folder}", flush=True)
        return
    command = [".venv/bin/python", "-m", "pctt.run", "-scene", *map(str, options), "-ccp_type", "apgd"]
    command += ["-output", str(folder), "-overwrite", "-output_every", "5", "-checkpoint_every", "1000", "-quiet"]
    subprocess.run(command, check=True, env={**os.environ, "OMP_NUM_THREADS": "1"})
    mark.write_text(words)
    seconds = sum(json.loads(line)["seconds"] for line in (folder / "steps.jsonl").read_text().splitlines())
    print(f"{name}: {seconds:.0f} s", flush=True)


def main(names: Sequence[str]) -> None:
    RUNS.mkdir(parents=True, exist_ok=True)
    jobs = [job for name in names or JOBS for job in JOBS.get(name, {}).items()]
    with ThreadPoolExecutor(max(1, min(len(jobs), os.cpu_count() or 1))) as pool:
        list(pool.map(lambda job: run(*job), jobs))


if __name__ == "__main__":
    main(sys.argv[1:])
