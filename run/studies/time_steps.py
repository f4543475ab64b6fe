"""Errors of forces, overlaps and seconds over time step, tolerance, closing work and stiffness, scene by scene:

    run/study time_steps [CASE ...] [--starts M] [--settings SETTINGS ...]

A case is a scene from its settled state and one figure that its users measure, of a stretch of time:

    mixer4, mixer8, mixer16  the mean torque on the paddle
    blade4                   the mean force on the blade at more than 0.7 of its top speed
    shear4                   the ratio of shear to normal stress in the same stretch
    drum8                    the mean torque that turns the drum
    silo6                    the flow out of the silo

SETTINGS begin with the time step as a multiple of the scene's default; fields of `pctt.Settings` may follow:
`2,tol=1e-3,stiffness=inf`. Starts are the settled state with every grain moved by up to 1e-4 of a radius, another way
in every start, so that the courses part. The solver is `apgd`. For each setting the table has

- CPU seconds per simulated second on one core, without start-up: median of the starts;
- the worst overlap after any step but those of the first 0.1 s, in % of a radius;
- the figure, its standard error as the starts show it, and how far it is off that of the smallest step;
- iterations a step, and steps that are not solved; of a setting that ends before its time it says why.

Writes results/time_steps.json and .png. With --page it makes the table of docs/choose.md instead, in an hour: some
settings of all cases, beside steps of a tenth (drum, silo: a quarter) to 2e-4 without closing work.
"""

from __future__ import annotations

import math
import statistics
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import shared
from shared import Row, Table, settings_of, settled

from dem.experiment import Experiment
from dem.start.time_step import recommended
from dem.together import SceneError
from pctt.scenes import Blade, Drum, Mixer, Shear, Silo

MOVED = 1e-4  # of a radius
FORGETS = 0.1  # [s] from the start, not part of overlaps
SETTINGS = ("6", "3", "2", "1", ".5", ".25,tol=2e-4", "1,tol=1e-3", "1,tol=1e-4", "1,stiffness=inf")
Records = dict[str, np.ndarray]


@dataclass(frozen=True)
class Case:
    """A scene from its settled state, and the figure that its users measure."""

    scene: Experiment
    seconds: float  #: simulated
    after: float  #: when the stretch of the figure begins [s]
    figure: Callable[[Records], float]
    unit: str


def mean(name: str, factor: float = 1.0) -> Callable[[Records], float]:
    return lambda records: factor * float(records[name].mean())


def friction(records: Records) -> float:
    return float(records["shear_stress [Pa]"].mean() / records["normal_stress [Pa]"].mean())


def flow(records: Records) -> float:
    return float(np.polyfit(records["time"], records["discharged [kg]"], 1)[0])


def torque(n: int) -> Case:
    """Its mean over half a second scatters by a tenth; three seconds of the largest take an hour."""
    return Case(Mixer(n=n), 3.0 if n < 16 else 0.5, FORGETS, mean("torque_mixer_z [N m]", -1e-3), "kN m")


CASES = {
    "mixer4": torque(4),
    "mixer8": torque(8),
    "mixer16": torque(16),
    "blade4": Case(Blade(n=4), 1.5, 0.5, mean("draft_force [N]", 1e-3), "kN"),
    "shear4": Case(Shear(n=4), 1.5, 0.5, friction, ""),
    "drum8": Case(Drum(), 2.0, 1.0, mean("drum_torque [N m]", -1e3), "mN m"),
    "silo6": Case(Silo(), 1.0, 0.25, flow, "kg/s"),
}
FINE = "tol=2e-4,closing_work=inf"
ON_PAGE = {  # the figure by its name, starts, and settings, of which the first one is what others are off
    "mixer4": ("mixer n = 4, torque", 12, (f".1,{FINE}", "1", "1.5,tol=1e-3")),
    "mixer8": ("mixer n = 8, torque", 4, (f".1,{FINE},stiffness=1.8e8", "1", "1,tol=2e-5,closing_work=inf", "2.5")),
    "mixer16": ("mixer n = 16, torque", 2, (f".1,{FINE}", "1")),
    "blade4": ("blade n = 4, draft force", 24, (f".1,{FINE},stiffness=1.8e8", "1")),
    "shear4": ("shear n = 4, stress ratio", 12, (f".1,{FINE}", "1", "1,tol=1e-3")),
    "drum8": ("drum n = 8, torque", 3, (f".25,{FINE}", "1", "2")),
    "silo6": ("silo n = 6, flow", 4, (f".25,{FINE}", "1", "2")),
}
UNASKED = [name for name in CASES if name != "mixer16"]  # which takes an hour


class Course(NamedTuple):
    """What a run shows; figures of the table but for `figure`."""

    figure: float
    overlap: float  #: the worst, % of a radius
    cpu: float  #: per simulated second [s]
    iterations: float  #: a step
    unsolved: int
    dt: float  #: [s]
    stiffness: float  #: [N/m]


def settings_for(words: str, scene: Experiment) -> dict[str, Any]:
    """Of `2,tol=1e-3`; ValueError for a name or value that there is not."""
    factor, _, others = words.partition(",")
    return {"dt": float(factor) * recommended(scene.build()), **settings_of(others)}


def records_of(rows: list[Row]) -> Records:
    """The numbers of steps as arrays, by their names."""
    return {key: np.array([row[key] for row in rows]) for key, value in rows[0].items() if np.isscalar(value)}


def course(name: str, seed: int, words: str) -> Course:
    """Steps of a simulation; a step of another one first, which loads compiled loops."""
    case, radius = CASES[name], CASES[name].scene.radius
    settings = {"solver": "apgd", **settings_for(words, case.scene)}
    with settled(case.scene, seed, MOVED * radius, **settings) as first:
        first.step()
    with settled(case.scene, seed, MOVED * radius, **settings) as sim:
        begun, before = sim.time, time.process_time()
        rows = [sim.step() for _ in range(math.ceil(case.seconds / settings["dt"] - 1e-9))]
        spent, stiffness = (time.process_time() - before) / (sim.time - begun), float(sim.world.pairs.stiffness.max())
    late = [row for row in rows if row["time"] - begun > case.after]
    overlap = 100 / radius * max(row["worst_overlap [m]"] for row in rows if row["time"] - begun > FORGETS)
    unsolved = sum(not row["converged"] for row in rows)
    iterations = statistics.fmean(row["iterations"] for row in rows)
    return Course(case.figure(records_of(late)), overlap, spent, iterations, unsolved, settings["dt"], stiffness)


def of_starts(name: str, words: str, starts: int) -> Row:
    """Of the starts of one setting, each in a process of its own."""
    found = [shared.in_new_process(course, name, seed, words) for seed in range(starts)]
    value, error = shared.spread([each.figure for each in found])
    row: Row = {"case": name, "settings": words, **found[0]._asdict(), "figure": value, "error": error}
    row |= {"cpu": statistics.median(each.cpu for each in found), "overlap": max(each.overlap for each in found)}
    row["iterations"] = statistics.fmean(each.iterations for each in found)
    return row | {"unsolved": sum(each.unsolved for each in found)}


def draw(cases: list[list[Row]]) -> None:
    """Error of the figure over CPU seconds, a panel for each case."""
    with shared.figure("time_steps", min(len(cases), 3), -(-len(cases) // 3)) as panels:
        for axes, rows in zip(panels, cases):
            limit = min(rows, key=lambda row: row["dt"])["figure"]
            plain = sorted((row for row in rows if "," not in row["settings"]), key=lambda row: row["dt"])
            groups = {"time steps": plain, "rigid": [row for row in rows if "stiffness=inf" in row["settings"]]}
            groups["tolerances"] = [row for row in rows if row["settings"].startswith("1,tol")]
            for (label, chosen), style in zip(groups.items(), ("o-", "x", ".")):
                off = [100 * (row["figure"] / limit - 1) for row in chosen]
                bars = [100 * np.nan_to_num(row["error"]) / abs(limit) for row in chosen]  # one start has no error
                axes.errorbar([row["cpu"] for row in chosen], off, bars, fmt=style, capsize=2, label=label)
            for row in plain:
                axes.annotate(f"{1e3 * row['dt']:.3g} ms", (row["cpu"], 100 * (row["figure"] / limit - 1)), (4, 4),
                              textcoords="offset points", fontsize=7)  # fmt: skip
            axes.axhspan(-3, 3, color="0.92", zorder=0)
            axes.set(xscale="log", xlabel="CPU s per simulated s", ylabel="off, %")
            axes.set_title(f"{rows[0]['case']}: {limit:.4g} {CASES[rows[0]['case']].unit}")
            axes.legend(fontsize=7)


def write_page(cases: dict[str, list[Row]]) -> None:
    """The table of docs/choose.md."""
    lines = []
    for name, (fine, *rows) in cases.items():
        begins = f"{ON_PAGE[name][0]}, {ON_PAGE[name][1]} starts"
        for row in rows:
            factor, _, others = row["settings"].partition(",")
            step = f"{1e3 * row['dt']:.2g} ms"
            words = ", ".join([f"**{step}**" if factor == "1" else step, *others.replace(",", ", ").split(", ")])
            error = 100 * math.hypot(row["error"], fine["error"]) / abs(fine["figure"])
            off = f"{100 * (row['figure'] / fine['figure'] - 1):+.1f} ± {error:.1f}"
            lines.append([begins, words.rstrip(", "), f"{row['cpu']:.2g}", f"{row['overlap']:.1f}", off])
            begins = ""
    heads = ["scene, figure", "step, settings", "CPU s per s", "worst overlap, % of a radius", "figure off, %"]
    page, head = shared.ROOT / "docs" / "choose.md", "# Choose dt and the tolerance\n"
    shared.replace_table(page, head, shared.markdown(heads, lines))


def rows_of(name: str, starts: int, settings: Sequence[str]) -> list[Row]:
    """The rows of a case, which are printed as they come; of a setting that ends before its time there is none."""
    print(f"{name}, {starts} starts of {CASES[name].seconds:g} s; figure in {CASES[name].unit or '1'}")
    table = Table(
        settings=("settings", "<28"), dt_ms=(lambda row: 1e3 * row["dt"], "6.2f"), CPU_s_per_s=("cpu", "11.2f"),
        overlap=("overlap", "7.2f"), figure=("figure", "9.4g"), error=("error", "7.2g"),
        its=("iterations", "5.0f"), unsolved=("unsolved", "8d"), stiffness=("stiffness", "9.2g"),
    )  # fmt: skip
    rows = []
    for words in settings:
        try:
            rows.append(of_starts(name, words, starts))
            table.add(rows[-1])
        except SceneError as error:  # noqa: PERF203 - grains would pass others unseen, or there is no solution
            print(f"{words:28} ended: {error}", flush=True)
    return rows


def main() -> None:
    line = shared.parser("time_steps", __doc__)
    line.add_argument("case", nargs="*", default=UNASKED, help=f"of {', '.join(CASES)}; mixer16 only if named")
    line.add_argument("--starts", type=shared.at_least_one, default=3, help="of each setting (3)")
    line.add_argument("--settings", nargs="+", default=SETTINGS, help="see above")
    line.add_argument("--page", action="store_true", help="make the table of docs/choose.md; no other words")
    given = line.parse_args()
    if given.page and len(sys.argv) > 2:
        line.error("--page: allowed are no other words with it")
    if unknown := [name for name in given.case if name not in CASES]:
        line.error(f"{unknown[0]}: allowed are {', '.join(CASES)}")
    try:
        _ = [settings_for(words, Mixer(n=1)) for words in given.settings]
    except ValueError as error:
        line.error(f"--settings {error}")
    shared.keep_to_one_core()
    about, cases = shared.say_machine(), dict[str, list[Row]]()
    for name in ON_PAGE if given.page else given.case:
        cases[name] = rows_of(name, *(ON_PAGE[name][1:] if given.page else (given.starts, given.settings)))
        shared.record("time_steps", about, [row for rows in cases.values() for row in rows])
    if given.page:
        write_page(cases)
    else:
        draw([*cases.values()])


if __name__ == "__main__":
    main()
