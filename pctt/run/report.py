"""What a run says: a line per step and tables at the end, by rank 0."""

from __future__ import annotations

import math
import os
import shutil
import sys
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from statistics import median
from typing import Any

import numpy as np
from mpi4py import MPI

from pctt.ccp.result import FIXED_POINT, RELAXATION, Status
from pctt.folder import totals

#: What is worth a warning: Coulomb residuals of the relaxation above the first, closing work above the second part of
#: the impulses' energy, overlaps above the third of the radius of the smallest grain.
LARGE_OPENING, LARGE_CLOSING_WORK, LARGE_OVERLAP = 1e-3, 0.5, 0.05

#: Tolerances above it are warned of, and why.
LOOSE, LOOSE_BECAUSE = 2e-3, "forces of dense beds are too small by 5 to 20 % at such tolerances"

#: Statuses of steps in which nothing is left to be done.
SOLVED = {Status.CONVERGED.value, Status.SQUEEZED.value}

#: Why conic does not solve a step of Coulomb's law.
NOT_THE_LAW = (
    "no Newton systems: for Coulomb's law conic has a linear solver of its own, so apgd takes the steps; add -law "
    "relaxation, or leave out -ksp_type and -pc_type"
)

def jump_advice(program: bool) -> str:
    """What helps against jumps of energy; a smaller tolerance does not."""
    dt, stiffness = (option_name(field, program) for field in ("dt", "stiffness"))
    return f"What helps: a smaller {dt}, a {stiffness}, or a tool of bounded force or torque (docs/mechanics.md)"


def residual(line: Mapping[str, Any]) -> float:
    """Of the law that a step was solved for."""
    return line["natural_residual" if line.get("law", RELAXATION) == RELAXATION else "coulomb_residual"]


def columns(compared: bool) -> str:
    """The heads of the columns of `step_line`."""
    compare = " compare" * compared
    return (
        "  step    time s  contacts   iters  Krylov  residual"
        f"  seconds: total  search  assembly   solve{compare}  output"
    )


def option_name(field: str, program: bool) -> str:
    """The name of an option of `Settings` as the program has it, or Python."""
    return f"-{'ccp_tol' if field == 'tol' else field}" if program else f"{field}="


def remedy(field: str, program: bool) -> str:
    """How an option of `Settings` has to change that overlaps are smaller."""
    return f"a {'larger' if field == 'stiffness' else 'smaller'} {option_name(field, program)}"


def stiffness_line(stiffness: np.ndarray, overlap: float, steps: float) -> str:
    """The stiffnesses [N/m] of contacts, and the parts of a half thickness that bodies may overlap by as springs, and
    by the length of steps."""
    if np.isinf(stiffness).all():
        return "rigid contacts"
    least, most = (f"{value:.2g}" for value in (stiffness.min(), stiffness.max()))
    words = f"contacts of {least} N/m" if least == most else f"contacts of {least} to {most} N/m"
    by = f"weight, tools and falls make overlaps of up to {100 * overlap:.2g} % of a radius"
    return f"{words}: {by}, steps of up to {100 * steps:.2g} %"


def step_line(line: Mapping[str, Any]) -> str:
    """One step as a row under `columns`, with a remark where its solver needed help."""
    phases = line["phases"]
    names = ("search", "assembly", "solve", "output")
    search, assembly, solve, output = (phases.get(name, 0.0) for name in names)
    compare = f" {phases['compare']:7.2f}" if "compare" in phases else ""
    remark = "" if line["converged"] else f"  {_shortfall(line)}"
    if line["fallbacks"]:
        remark += f"  ({line['fallbacks']} Newton systems by a fallback)"
    if line.get("law") == FIXED_POINT:
        remark += f"  (Coulomb residual {line['coulomb_residual']:.1e} by {line['cone_problems']} cone problems)"
    if line["solver"] != line["asked_solver"]:
        remark += f"  (by {line['solver']})"
    if line.get("hard_problem"):
        remark += f"  (hard problem kept: {line['hard_problem']})"
    return (
        f"{line['step']:6d} {line['time']:9.3f} {line['contacts']:9d} {line['iterations']:7d}"
        f" {line['ksp_its']:7d}  {residual(line):8.1e} {line['seconds']:15.2f} {search:7.2f}"
        f" {assembly:9.2f} {solve:7.2f}{compare} {output:7.2f}{remark}"
    )


def _shortfall(line: Mapping[str, Any]) -> str:
    """Why a step is not converged, with the residuals of both laws where Coulomb's is asked for."""
    if line["status"] == Status.SQUEEZED.value:
        return f"SQUEEZED: {line['reason']}"
    if line["law"] == RELAXATION:
        return f"NOT CONVERGED: {line['reason']}"
    residuals = f"Coulomb residual {line['coulomb_residual']:.1e}, natural residual {line['natural_residual']:.1e}"
    return f"NOT CONVERGED: {residuals}: {line['reason']}"


def jump_words(line: Mapping[str, Any], program: bool) -> str:
    """What is said at once of the first step with a jump of energy; the program has other names of options than
    Python."""
    return (
        f"step {line['step']}: the kinetic energy rises by {line['energy_jump']:.3g} J to"
        f" {line['kinetic_energy [J]']:.3g} J, tenfold or out of nothing. {jump_advice(program)}. Later "
        "jumps are in the figure energy_jump of their steps"
    )


def unsolved_words(line: Mapping[str, Any]) -> str:
    """What is said at once of the first step from Python that is not solved; of the program every row says it."""
    return f"step {line['step']}: {_shortfall(line)}. Later ones have converged=False among their figures"


class Progress:
    """Prints the messages of a run on the first rank, and on a terminal a passing line about the present step."""

    def __init__(self, comm: MPI.Comm, quiet: bool = False):
        self._active = comm.rank == 0 and not quiet
        # under mpiexec standard output looks like a terminal even if it goes to a file
        started = any(name in os.environ for name in ("OMPI_COMM_WORLD_SIZE", "PMI_SIZE", "PMIX_RANK"))
        self._active = self._active and sys.stdout is not None  # closed by the shell
        self._live = self._active and not started and sys.stdout.isatty()
        self._begun, self._first, self._tenth = time.perf_counter(), -1, 0

    def say(self, text: str = "") -> None:
        self._print("\r\033[K" * self._live + text + "\n")

    def _print(self, text: str) -> None:
        """Without room for what a run says, it goes on in silence: its files have all that it finds."""
        if self._active:
            try:
                sys.stdout.write(text)
                sys.stdout.flush()
            except OSError as error:
                self._active = self._live = False
                sys.stderr.write(f"pctt.run: says no more, as it cannot write there ({error.strerror})\n")
                sys.stdout = open(os.devnull, "w")  # noqa: SIM115 - else what is left fails at the end

    def doing(self, done: int, now: float, end: int) -> None:
        """After so many steps, at a time ``now`` [s] of the simulation, the next one begins, unless it is the end."""
        if self._first < 0:
            self._first, self._begun = done, time.perf_counter()
        if self._live and done < end:
            spent, made = time.perf_counter() - self._begun, done - self._first
            left = f", {remaining(spent, made, end - self._first)}" if made else ""
            line = f"step {done + 1}, time {now:.3f} s ({made + 1} of {end - self._first}){left} ..."
            self._print(f"\r\033[K{line[: shutil.get_terminal_size().columns - 1]}")

    def passed(self, done: int, now: float, end: float) -> None:
        """As `doing` for a run from Python: where no line passes, in a notebook or a file, there is one for each tenth
        of the way, or of each thousand steps if nobody knows the ``end``."""
        known = math.isfinite(end)
        self.doing(done, now, int(end) if known else done)
        spent, made, whole = time.perf_counter() - self._begun, done - self._first, end - self._first
        tenth = int(10 * made / max(whole, 1)) if known else made // 1000
        if tenth > self._tenth and not (self._live and known and done < end):
            self._tenth = tenth
            left = f", {remaining(spent, made, int(whole))}" if known and done < end else ""
            self.say(f"time {now:.3f} s: {made}{f' of {whole:.0f}' * known} steps in {spent:.0f} s{left}")


def remaining(spent: float, done: int, steps: int) -> str:
    """The time that is left, if steps go on to take as long as those that are done."""
    left = max(0, round(spent / done * steps - spent))
    minutes, seconds = divmod(left, 60)
    hours, minutes = divmod(minutes, 60)
    if hours:
        return f"about {hours} h {minutes:02d} min left"
    return f"about {minutes} min {seconds:02d} s left" if minutes else f"about {seconds} s left"


def ending(
    steps: Sequence[Mapping[str, Any]], tol: float, closing_work: float, figures: Mapping[str, float],
    worst: Mapping[str, float], cause: str,
) -> str:  # fmt: skip
    """What steps have taken and shown: the phases, the law, jumps, forces, the numbers of the scene's analysis, and the
    worst overlap of the run. ``tol`` and ``closing_work`` are those of the settings, ``cause`` is that of
    `OverlapWatch`."""
    outside = steps[-1]["record"].get("grains_outside")
    said = [phase_table(steps), law_line(steps, tol), jumps_line(steps), forces_line(steps, closing_work)]
    width = max(map(len, figures), default=0)
    said += [f"{name:{width}}  {value + 0.0:.6g}" for name, value in figures.items()]
    said += [overlap_line(worst, cause)]
    said += [f"{outside:.0f} grains have left the domain of the scene"] if outside else []
    return "\n".join(filter(None, said))


def compare_table(summary: Mapping[str, Mapping[str, Any]]) -> str:
    """The compared preconditioners over all systems of the run, the losers too, and what they really were."""
    entries = {name: name if s["type"] == name else f"{name}:{s['type']}" for name, s in summary.items()}
    width = max(map(len, ["preconditioner", *entries.values()]))
    head = (
        f"{'preconditioner':{width}}  systems  converged  its mean   its max"
        "  set-up s   solve s  residual/asked  what it was"
    )
    rows = [
        f"{entries[name]:{width}} {s['systems']:8d} {s['converged']:10d} {s['ksp_its_mean']:9.1f}"
        f" {s['ksp_its_max']:9d} {s['setup_s']:9.3f} {s['solve_s']:9.3f} {s['excess_max']:15.2g}  {s['what']}".rstrip()
        for name, s in summary.items()
    ]
    return "\n".join([head, "-" * len(head), *rows])


def phase_table(steps: Sequence[Mapping[str, Any]]) -> str:
    """Seconds of each phase over the run and in a median step, and what the steps came to."""
    run = totals(steps)
    names, whole = [*run["phases"], "total"], run["seconds"] or 1.0
    columns = [[line["phases"].get(name, 0.0) for line in steps] for name in run["phases"]]
    columns.append([line["seconds"] for line in steps])
    head = f"{'phase':14}  seconds   share  median step s"
    rows = [
        f"{name:14} {sum(column):8.2f} {sum(column) / whole:7.1%} {median(column):14.3f}"
        for name, column in zip(names, columns)
    ]
    failed, (least, most) = run["not_converged"], run["contacts"]
    figures = (
        f"{run['steps']} steps, {least} to {most} contacts, {run['iterations']} iterations ({run['newton_its']} Newton"
        f" steps), {run['ksp_its']} Krylov iterations, worst residual {max(map(residual, steps)):.1e}, "
        + (f"{failed} NOT CONVERGED" if failed else "all converged")
        + (f" ({run['squeezed']} of them squeezed)" if run["squeezed"] else "")
    )
    return "\n".join([head, "-" * len(head), *rows, figures])


def law_line(steps: Sequence[Mapping[str, Any]], tol: float) -> str:
    """A line about the law that the steps obey, and its residual, and what it means if the relaxation is far from
    Coulomb's law."""
    laws = Counter(line["law"] for line in steps)
    counted = ", ".join(f"{name} in {count} steps" for name, count in laws.most_common())
    worst = max(line["coulomb_residual"] for line in steps)
    said = f"law of contact: {counted}; Coulomb residual at most {worst:.1e}"
    if RELAXATION not in laws or worst <= max(LARGE_OPENING, 10 * tol):
        return said
    relaxed = "this run solved the relaxed law of friction, in which sliding contacts open by dt mu |v_t|"
    return f"{said}; {relaxed}; add -law coulomb for Coulomb's law (docs/ccp.md)"


def jumps_line(steps: Sequence[Mapping[str, Any]]) -> str:
    """A warning of jumps of energy; empty without."""
    jumps = [line for line in steps if line.get("energy_jump", 0.0) > 0.0]
    if not jumps:
        return ""
    worst = max(jumps, key=lambda line: line["energy_jump"])
    said = f"WARNING: {len(jumps)} jumps of energy, the largest of {worst['energy_jump']:.3g} J in step {worst['step']}"
    return f"{said}; means are without these steps. {jump_advice(True)}"


def forces_line(steps: Sequence[Mapping[str, Any]], limit: float) -> str:
    """A line about the accuracy of the forces on bodies, with a warning where they may be far off; ``limit`` is
    ``-ccp_closing_work``."""
    kind = max(("closing_work", "opening_work"), key=lambda kind: max(line[kind] for line in steps))
    worst, middle = max(steps, key=lambda line: line[kind]), median(line[kind] for line in steps)
    said = f"{kind.replace('_', ' ')} {middle:.1e} (median), {worst[kind]:.1e} at most, in step {worst['step']}"
    if worst[kind] <= LARGE_CLOSING_WORK:
        return said
    hint = f"-ccp_closing_work {LARGE_CLOSING_WORK}" if limit > LARGE_CLOSING_WORK else "a smaller -ccp_tol"
    return f"WARNING: {said}: forces on bodies may be far off; try {hint} (docs/accuracy.md)"


def overlap_line(worst: Mapping[str, float], cause: str = "dt") -> str:
    """The worst overlap of a run, and what to do about one that is not small."""
    overlap, radius = worst["overlap [m]"], worst["smallest_radius [m]"]
    line = f"worst overlap {overlap:.2g} m, {overlap / radius:.1%} of the smallest radius, at step {worst['step']}"
    if overlap <= LARGE_OVERLAP * radius:
        return line
    return f"WARNING: {line}; try {remedy(cause or 'dt', True)}"
