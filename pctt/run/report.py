"""What a run says: a line per step and tables at the end, by rank 0."""

from __future__ import annotations

import os
import sys
from collections.abc import Mapping, Sequence
from typing import Any

COLUMNS = (
    "  step    time s  contacts  Newton  Krylov  residual"
    "  seconds: total  search  assembly   solve  output"
)


def step_line(line: Mapping[str, Any]) -> str:
    """One step as a row under COLUMNS, with a remark where its solver needed help."""
    phases = line["phases"]
    names = ("search", "assembly", "solve", "output")
    search, assembly, solve, output = (phases.get(name, 0.0) for name in names)
    remark = "" if line["converged"] else f"  NOT CONVERGED: {line['reason']}"
    if line["fallbacks"]:
        remark += f"  ({line['fallbacks']} Newton systems by a fallback)"
    if line["solver"] != line["asked_solver"]:
        remark += f"  (by {line['solver']})"
    if line.get("hard_problem"):
        remark += f"  (hard problem kept: {line['hard_problem']})"
    return (
        f"{line['step']:6d} {line['time']:9.3f} {line['contacts']:9d} {line['iterations']:7d}"
        f" {line['ksp_its']:7d}  {line['natural_residual']:8.1e} {line['seconds']:15.2f} {search:7.2f}"
        f" {assembly:9.2f} {solve:7.2f} {output:7.2f}{remark}"
    )


class Progress:
    """Prints the lines of the steps; on a terminal also what is being done at the moment."""

    def __init__(self, active: bool):
        self._active = active
        # under mpiexec standard output looks like a terminal even where it goes to a file
        self._live = active and sys.stdout.isatty() and not _under_mpiexec()

    def say(self, text: str = "") -> None:
        if self._active:
            clear = "\r\033[K" if self._live else ""
            print(clear + text, flush=True)

    def doing(self, text: str) -> None:
        """A transient line, on a terminal only."""
        if self._live:
            print(f"\r\033[K{text} ...", end="", flush=True)


def _under_mpiexec() -> bool:
    return any(name in os.environ for name in ("OMPI_COMM_WORLD_SIZE", "PMI_SIZE", "PMIX_RANK"))


def compare_table(summary: Mapping[str, Mapping[str, float]], labels: Mapping[str, str]) -> str:
    """The compared preconditioners over all systems of the run, the losers too."""
    width = max(len("preconditioner"), *(len(label) for label in labels.values()))
    head = (
        f"{'preconditioner':{width}}  systems  converged  its mean   its max"
        "  set-up s   solve s  worst residual"
    )
    rows = [
        f"{labels[name]:{width}} {s['systems']:8d} {s['converged']:10d} {s['ksp_its_mean']:9.1f}"
        f" {s['ksp_its_max']:9d} {s['setup_s']:9.3f} {s['solve_s']:9.3f} {s['true_residual_max']:15.1e}"
        for name, s in summary.items()
    ]
    return "\n".join([head, "-" * len(head), *rows])


def phase_table(steps: Sequence[Mapping[str, Any]]) -> str:
    """Median seconds per step of each phase."""
    names = list(dict.fromkeys(name for line in steps for name in line["phases"]))
    medians = {name: _median([line["phases"].get(name, 0.0) for line in steps]) for name in names}
    total = _median([line["seconds"] for line in steps])
    cells = ", ".join(f"{name} {value:.3f}" for name, value in medians.items())
    return f"median seconds per step: {total:.3f} ({cells})"


def figure_table(figures: Mapping[str, float]) -> str:
    """A line per number of the scene's analysis."""
    width = max(map(len, figures), default=0)
    return "\n".join(f"{name:{width}}  {value:.6g}" for name, value in figures.items())


def _median(values: Sequence[float]) -> float:
    ordered = sorted(values)
    middle = len(ordered) // 2
    return ordered[middle] if len(ordered) % 2 else 0.5 * (ordered[middle - 1] + ordered[middle])
