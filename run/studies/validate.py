"""Checks against closed forms and published laws; see run/validate."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
from shared import PYTHON, figure, markdown, record, say_machine
from validation import laws
from validation.rows import Row

RUNS, PAGE, PICTURE = Path("results/validation"), Path("docs/validation.md"), Path("docs/validation.png")
TEXT = Path("run/studies/validation/page.md")  # of the page, with the places of the figures
OUTLETS = (4.5, 5.5, 6.5)
FRICTIONS = (0.1, 0.3, 0.6)
SEEDS = (1, 2, 3, 4)  # a bed of the silo for each outlet and each of them, and of the heap for each friction

#: The runs of each check: names and options of ``python -m pctt.run``.
JOBS: dict[str, dict[str, Sequence[object]]] = {
    "silo": {
        f"silo_{outlet:g}_{seed}": (
            *("silo", "-scene_n", 6, "-scene_filling", 0.7, "-scene_half_angle", 90, "-scene_outlet", outlet),
            *("-scene_seed", seed, "-dt", 0.005, "-seconds", seconds),
        )
        for outlet, seconds in zip(OUTLETS, (2.6, 1.75, 1.4))
        for seed in SEEDS
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
}

#: What reads the runs of each check: rows of the table, and what the figure shows.
CHECKS: dict[str, Callable[[], tuple[list[Row], dict[str, Any]]]] = {
    "silo": lambda: laws.silo({D: [RUNS / f"silo_{D:g}_{seed}" for seed in SEEDS] for D in OUTLETS}),
    "drum": lambda: laws.drum(RUNS / "drum"),
    "heap": lambda: laws.heap({mu: [RUNS / f"heap_{mu:g}_{seed}" for seed in SEEDS] for mu in FRICTIONS}),
    "column": lambda: laws.column(RUNS / "column"),
}


def run(name: str, options: Sequence[object], keep: bool) -> None:
    """Make a run in its folder, and a note of its seconds of processor; or `keep` one of the same options."""
    folder, mark = RUNS / name, RUNS / f"{name}.json"
    words = " ".join(map(str, options))
    if keep and mark.exists() and json.loads(mark.read_text())["options"] == words:
        print(f"{name}: kept as it is in {folder}", flush=True)
        return
    command = [str(PYTHON), "-m", "pctt.run", "-scene", *map(str, options), "-ccp_type", "apgd", "-output", str(folder)]
    command += ["-overwrite", "-output_every", "5", "-checkpoint_every", "1000", "-quiet"]
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
        elif reference[1] is None:
            expected, off = f"above {reference[0]:g}{unit}", f"{row['deviation']:+.2g} errors"
        else:
            expected = f"[{reference[0]:g}, {reference[1]:g}]{unit}"
            off = "inside" if row["deviation"] == 0.0 else f"{100 * row['deviation']:+.2g} %"
        found, off = f"{row['found']:.4g}{error}{unit}", off if row["agrees"] else f"**{off}**"
        lines.append([row["check"], row["quantity"], expected, found, off, row["source"]])
    return markdown(["", "quantity", "reference", "found", "deviation", "source"], lines)


def solved(missed: int, steps: int) -> str:
    """A sentence on the steps that missed the tolerance."""
    if not missed:
        return f"All {steps} steps were solved to the tolerance."
    why = "the [notebook](notebook_ccp.md#coulombs-law) says why"
    return f"{missed} of the {steps} steps did not reach the tolerance; {why}."


def draw(shown: dict[str, dict[str, Any]]) -> None:
    """A panel for each check."""
    silo, heap, drum, column = (shown[name] for name in ("silo", "heap", "drum", "column"))
    with figure(PICTURE, 2, 2) as panels:
        if not len(panels):
            return
        one, two, three, four = panels
        wide = np.linspace(-silo["level"] / silo["slope"], 7.0)
        one.plot(wide, silo["slope"] * wide + silo["level"], color="C7", label="Beverloo's law, fitted")
        one.plot(silo["outlet"], silo["flow"] ** 0.4, "o", color="C0", label=["silo"] + [None] * (len(SEEDS) - 1))
        one.set(xlabel="outlet [sphere diameters]", ylabel="flow$^{2/5}$ [(kg/s)$^{2/5}$]")
        for mu, angle, z in zip(heap["friction"], heap["angle"], heap["height"]):
            label = f"friction {mu:g}: {angle:.1f} $\\pm$ {heap['error']:.1f} degrees"
            (line,) = two.plot(1e3 * heap["x"], 1e3 * z.mean(axis=0), "o-", markersize=3, label=label)
            low, high = 1e3 * z.min(axis=0), 1e3 * z.max(axis=0)
            two.fill_between(1e3 * heap["x"], low, high, color=line.get_color(), alpha=0.15)
        two.set(xlabel="distance from the edge [mm]", ylabel="surface, mean and range of beds [mm]", ylim=(0.0, None))
        three.plot(drum["time"], drum["angle"], linewidth=0.9, label="drum")
        three.axhspan(20.9, 32.8, color="C7", alpha=0.25, label="glass beads, mu(I)")
        three.axhline(drum["mean"], color="C0", linestyle=":", label=f"mean, {drum['mean']:.1f} degrees")
        three.set(xlabel="time [s]", ylabel="angle of the bed [degrees]")
        height, law = 1e3 * column["height"], column["law"]
        for stress, style, label in (
            (column["weight"], "C7--", "weight above"),
            (law, "C0-", "vertical stress, Janssen"),
            (column["vertical"], "C0o", "vertical stress"),
            (column["ratio"] * law, "C1-", "wall's pressure, Janssen"),
            (column["pressure"], "C1o", "wall's pressure"),
        ):
            four.plot(stress, height, style, label=label)
        four.set(xlabel="stress [Pa]", ylabel="height [mm]")
        for panel in panels:
            panel.grid(alpha=0.3)
            panel.legend(fontsize="small", frameon=False)


def main(names: Sequence[str]) -> None:
    known = ("closed_forms", *JOBS)
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
    if "closed_forms" in chosen:
        from validation import closed_forms

        rows += closed_forms.rows()
    shown = {}
    for name in [name for name in chosen if name in CHECKS]:
        found, shown[name] = CHECKS[name]()
        rows += found
    print(table(rows))
    record("validate", about, rows)
    if chosen is known:
        draw(shown)
        seconds = sum(_seconds(name) for jobs in JOBS.values() for name in jobs)
        files = [RUNS / name / "steps.jsonl" for jobs in JOBS.values() for name in jobs]
        lines = [json.loads(line) for file in files for line in file.read_text().splitlines()]
        missed = sum(not line["converged"] for line in lines)
        cores = min(2, os.cpu_count() or 1)
        about["minutes"] = seconds / 60 / cores
        text = TEXT.read_text("utf-8").format(
            minutes=about["minutes"], cores=cores, cpu=about["cpu"], table=table(rows), beds=len(SEEDS),
            rubs=shown["column"]["rubs"], scatter=shown["heap"]["scatter"], solved=solved(missed, len(lines)),
            outlets=", ".join(f"{outlet:g}" for outlet in OUTLETS),
        )  # fmt: skip
        PAGE.write_text(text, "utf-8")
        print(PAGE)


if __name__ == "__main__":
    main(sys.argv[1:])
