"""Checks against closed forms and published laws; see run/validate."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from pathlib import Path
from typing import Any

from shared import PYTHON, figure, markdown, record, say_machine
from validation import benchmarks, closed_forms, impacts, laws, packings, structures
from validation.panels import PANELS
from validation.rows import Row

from pctt.folder import Folder

RUNS, PAGE = Path("results/validation"), Path("docs/validation.md")
PICTURES = {
    Path("docs/validation.png"): ("silo", "heap", "drum", "column"),
    Path("docs/published.png"): ("mankoc", "dosta", "collapse", "packing", "intrusion"),
}
TEXT = Path("run/studies/validation/page.md")  # of the page, with the places of the figures
OUTLETS, FULL_OUTLETS = (4.5, 5.5, 6.5), (5.5, 6.4)
FRICTIONS = (0.1, 0.3, 0.6)
SEEDS = (1, 2, 3, 4)  # a bed of the silo for each outlet and each of them, and of the heap for each friction
FEW_SEEDS = (1, 2)  # of Mankoc's silo for each outlet
#: Height over radius and diameters to a radius of the columns that collapse: seconds and seeds of their runs.
COLUMNS = {(0.6, 8): (1.2, (1, 2)), (1.2, 8): (1.4, (1, 2)), (2.4, 8): (1.6, (1,)), (0.6, 12): (1.3, (1,))}

#: The runs of each check: names and options of ``python -m pctt.run``.
JOBS: dict[str, dict[str, Sequence[object]]] = {
    "silo": {
        f"silo_{outlet:g}_{seed}": (
            *("silo", "-scene_n", 6, "-scene_filling", 0.7, "-scene_half_angle", 90, "-scene_outlet", outlet),
            *("-scene_seed", seed, "-dt", 0.0025, "-seconds", seconds),
        )
        for outlet, seconds in zip(OUTLETS, (2.6, 1.75, 1.4))
        for seed in SEEDS
    },
    "mankoc": {
        f"mankoc_{outlet:g}_{seed}": (
            *("silo", "-scene_n", 8, "-scene_filling", 1.2, "-scene_half_angle", 90, "-scene_outlet", outlet),
            *("-scene_seed", seed, "-seconds", 1.9, "-output_every", 0),
        )
        for outlet in FULL_OUTLETS
        for seed in FEW_SEEDS
    },
    "heap": {
        f"heap_{friction:g}_{seed}": (
            *("run/studies/validation/heap.py", "-scene_friction", friction, "-scene_seed", seed),
            *("-seconds", 4.5),
        )
        for friction in reversed(FRICTIONS)  # the longest first
        for seed in SEEDS
    },
    "drum": {"drum": ("drum", "-scene_n", 8, "-seconds", 3.2)},
    "column": {"column": ("run/studies/validation/column.py", "-seconds", 1.2)},
    "dosta": {
        "dosta_large": (
            *("run/studies/validation/dosta_silo.py", "-scene_outlet", 15, "-scene_n", 19, "-scene_filling", 0.45),
            *("-seconds", 0.78, "-output_every", 0),
        ),
        "dosta_small": ("run/studies/validation/dosta_silo.py", "-seconds", 1.2, "-output_every", 0),
        "dosta_drum": ("run/studies/validation/dosta_drum.py", "-seconds", 2.5, "-output_every", 0),
    },
    "collapse": {
        f"collapse_{aspect:g}_{wide}_{seed}": (
            *("run/studies/validation/collapse.py", "-scene_aspect", aspect, "-scene_width", wide),
            *("-scene_seed", seed, "-seconds", seconds),
        )
        for (aspect, wide), (seconds, seeds) in COLUMNS.items()
        for seed in seeds
    },
    "intrusion": {
        f"intrusion_{seed}": (
            *("run/studies/validation/intrusion.py", "-scene_seed", seed, "-seconds", 1.55, "-output_every", 0),
        )
        for seed in SEEDS[:3]
    },
}

#: What reads the runs of each check: rows of the table, and what the figure shows.
CHECKS: dict[str, Callable[[], tuple[list[Row], dict[str, Any]]]] = {
    "closed_forms": lambda: (closed_forms.rows(), {}),
    "impacts": lambda: (impacts.rows(), {}),
    "tops": lambda: (structures.tops(), {}),
    "structures": lambda: (structures.rows(), {}),
    "silo": lambda: laws.silo({D: [RUNS / f"silo_{D:g}_{seed}" for seed in SEEDS] for D in OUTLETS}),
    "drum": lambda: laws.drum(RUNS / "drum"),
    "heap": lambda: laws.heap({mu: [RUNS / f"heap_{mu:g}_{seed}" for seed in SEEDS] for mu in FRICTIONS}),
    "column": lambda: laws.column(RUNS / "column"),
    "mankoc": lambda: benchmarks.mankoc(
        {D: [RUNS / f"mankoc_{D:g}_{seed}" for seed in FEW_SEEDS] for D in FULL_OUTLETS}
    ),
    "dosta": lambda: benchmarks.dosta(*(RUNS / f"dosta_{name}" for name in ("small", "large", "drum"))),
    "collapse": lambda: benchmarks.collapse(
        [
            (wide, [RUNS / f"collapse_{aspect:g}_{wide}_{seed}" for seed in seeds])
            for (aspect, wide), (_, seeds) in COLUMNS.items()
        ]
    ),
    "intrusion": lambda: benchmarks.intrusion([RUNS / f"intrusion_{seed}" for seed in SEEDS[:3]]),
    "packing": packings.rows,
}


def run(name: str, options: Sequence[object], keep: bool) -> None:
    """Make a run in its folder, and a note of its seconds of processor; or `keep` one of the same options."""
    folder, mark = RUNS / name, RUNS / f"{name}.json"
    words = " ".join(map(str, options))
    if keep and mark.exists() and json.loads(mark.read_text())["options"] == words:
        print(f"{name}: kept as it is in {folder}", flush=True)
        return
    command = [str(PYTHON), "-m", "pctt.run", "-ccp_type", "apgd", "-output", str(folder)]
    command += ["-overwrite", "-output_every", "5", "-checkpoint_every", "1000", "-quiet", "-scene", *map(str, options)]
    started = subprocess.Popen(command, env={**os.environ, "OMP_NUM_THREADS": "1"})
    _, status, used = os.wait4(started.pid, 0)
    if status:
        raise subprocess.CalledProcessError(os.waitstatus_to_exitcode(status), command)
    seconds = used.ru_utime + used.ru_stime
    mark.write_text(json.dumps({"options": words, "seconds": round(seconds)}) + "\n")
    print(f"{name}: {seconds:.0f} s", flush=True)


def _seconds(name: str) -> float:
    """Seconds of processor that a run took."""
    return json.loads((RUNS / f"{name}.json").read_text())["seconds"]


def table(rows: list[Row]) -> str:
    """The rows in Markdown."""
    lines = []
    for row in rows:
        reference, unit = row["reference"], f" {row['unit']}" if row["unit"] else ""
        error = f" +- {row['error']:.2g}" if row.get("error") else ""
        if not isinstance(reference, list):
            expected = f"{reference:.4g}{unit}"
            off = f"{row['deviation']:.1e}" if reference == 0.0 else f"{100 * row['deviation']:+.2g} %"
            off = "exact" if abs(row["deviation"]) < 1e-8 else off
        elif reference[1] is None:
            expected, off = f"above {reference[0]:g}{unit}", f"{row['deviation']:+.2g} errors"
        else:
            expected = f"[{reference[0]:g}, {reference[1]:g}]{unit}"
            off = "inside" if row["deviation"] == 0.0 else f"{100 * row['deviation']:+.2g} %"
        found, off = f"{row['found']:.4g}{error}{unit}", off if row["agrees"] else f"**{off}**"
        lines.append([row["check"], row["quantity"], expected, found, off, row["source"]])
    for before, line in reversed(list(pairwise(lines))):  # what repeats stands in its first row
        line[0], line[5] = line[0] * (line[0] != before[0]), line[5] * (line[5] != before[5])
    return markdown(["", "quantity", "reference", "found", "deviation", "source"], lines)


def solved(missed: int, steps: int) -> str:
    """A sentence on the steps that missed the tolerance."""
    if not missed:
        return f"All {steps} steps were solved to the tolerance."
    why = "the [notebook](notebook_ccp.md#coulombs-law) says why"
    return f"{missed} of the {steps} steps did not reach the tolerance; {why}."


def draw(picture: Path, names: Sequence[str], shown: dict[str, dict[str, Any]]) -> None:
    """A panel for each check of a picture."""
    with figure(picture, (len(names) + 1) // 2, 2) as panels:
        for panel, name in zip(panels, names):
            PANELS[name](panel, shown[name])
            panel.grid(alpha=0.3)
            panel.legend(fontsize="small", frameon=False)
        for panel in panels[len(names) :]:
            panel.set_axis_off()


def main(names: Sequence[str]) -> None:
    known = tuple(CHECKS)
    keep, names = "-keep" in names, [name for name in names if name != "-keep"]
    if unknown := set(names) - set(known):
        sys.exit(f"run/validate: {unknown.pop()}: allowed are -keep, {', '.join(known)}")
    chosen = names or known
    about = say_machine()
    RUNS.mkdir(parents=True, exist_ok=True)
    jobs = [job for name in chosen for job in JOBS.get(name, {}).items()]
    with ThreadPoolExecutor(max(1, min(len(jobs), os.cpu_count() or 1))) as pool:
        list(pool.map(lambda job: run(*job, keep), jobs))
    rows: list[Row] = []
    shown = {}
    for name in chosen:
        found, shown[name] = CHECKS[name]()
        rows += found
    print(table(rows))
    record("validate", about, rows)
    for picture, names in PICTURES.items():
        if set(names) <= set(chosen):
            draw(picture, names, shown)
    if chosen is known:
        names = [name for jobs in JOBS.values() for name in jobs]
        seconds = sum(map(_seconds, names)) + time.process_time()
        files = [RUNS / name / "steps.jsonl" for name in names]
        lines = [json.loads(line) for file in files for line in file.read_text().splitlines()]
        missed = sum(not line["converged"] for line in lines)
        about["minutes"] = seconds / 60
        text = TEXT.read_text("utf-8").format(
            cpu_minutes=seconds / 60, cpu=about["cpu"], table=table(rows),
            beds=len(SEEDS), bodies={name: Folder(RUNS / name).summary["bodies"] for name in names},
            rubs=shown["column"]["rubs"], scatter=shown["heap"]["scatter"], solved=solved(missed, len(lines)),
            outlets=", ".join(f"{outlet:g}" for outlet in OUTLETS),
        )  # fmt: skip
        PAGE.write_text(text, "utf-8")
        print(PAGE)


if __name__ == "__main__":
    main(sys.argv[1:])
