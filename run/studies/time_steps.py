"""Errors of forces, overlaps and seconds over time step, tolerance, closing work and stiffness, scene by scene:

    run/study time_steps [CASE ...] [--starts M] [--settings SETTINGS ...]

A case is a scene from its settled state and one figure that its users measure, of a stretch of time:

    mixer4, mixer8, mixer16  the mean torque on the paddle
    blade4                   the mean force on the blade at more than 0.7 of its top speed
    shear4                   the ratio of shear to normal stress in the same stretch
    drum8                    the mean torque that turns the drum
    silo6                    the flow out of the silo

SETTINGS begin with the time step as a multiple of the scene's default; fields of `pctt.Settings` may follow:
`2,tol=1e-3,projection=1`. Starts are the settled state with every grain moved by up to 1e-4 of a radius, another way in
every start, so that the courses part. The solver is `apgd`. For each setting the table has

- CPU seconds per simulated second on one core, without start-up: median of the starts;
- the worst overlap after any step but those of the first 0.05 s, in % of a radius;
- the figure, its standard error as the starts show it, and how far it is off that of the smallest step;
- iterations a step, and steps that are not solved; of a setting that ends before its time it says why.

Writes results/time_steps.json and .png.
"""

from __future__ import annotations

import argparse
import math
import multiprocessing
import os
import statistics
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from compare_liggghts import settings_of, spread
from mpi4py import MPI
from shared import figure, record, say_machine

from dem.experiment import Experiment
from dem.scenes import Blade, Drum, Mixer, Shear, Silo
from dem.time_step import recommended
from dem.together import SceneError
from pctt.simulation import Simulation

MOVED = 1e-4  # of a radius
FORGETS = 0.05  # [s] from the start, not part of overlaps
SETTINGS = (
    "6", "3", "2", "1", ".5", ".25,tol=1e-4", "1,tol=1e-3", "1,tol=1e-4", "1,tol=1e-4,closing_work=.05",
    "1,stiffness=1e8", "1,stiffness=inf", "2,projection=1", "3,projection=1",
)  # fmt: skip
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
    return Case(Mixer(n=n), 0.5, 0.1, mean("torque_mixer_z [N m]", -1e-3), "kN m")


CASES = {
    "mixer4": torque(4),
    "mixer8": torque(8),
    "mixer16": torque(16),
    "blade4": Case(Blade(n=4), 1.5, 0.5, mean("draft_force [N]", 1e-3), "kN"),
    "shear4": Case(Shear(n=4), 1.5, 0.5, friction, ""),
    "drum8": Case(Drum(), 2.0, 1.0, mean("drum_torque [N m]", -1e3), "mN m"),
    "silo6": Case(Silo(), 1.0, 0.25, flow, "kg/s"),
}
UNASKED = [name for name in CASES if name != "mixer16"]  # which takes an hour


class Course(NamedTuple):
    """What a run shows."""

    figure: float
    overlap: float  #: the worst, as a part of a radius
    cpu: float  #: per simulated second [s]
    iterations: float  #: a step
    unsolved: int
    dt: float  #: [s]
    stiffness: float  #: [N/m]


def settings_for(words: str, scene: Experiment) -> dict[str, Any]:
    """Of `2,tol=1e-3`; ValueError for a name or value that there is not."""
    factor, _, others = words.partition(",")
    return {"dt": float(factor) * recommended(scene.build()), **settings_of(others or "default")}


def opened(case: Case, seed: int, settings: dict[str, Any]) -> Simulation:
    """The settled scene with spheres moved."""
    sim = Simulation(case.scene, restart="settled", comm=MPI.COMM_SELF, solver="apgd", **settings)
    grains = sim.world.grains
    moved = np.random.default_rng(seed).uniform(-1.0, 1.0, grains.position.shape)
    grains.position += MOVED * case.scene.radius * moved[grains.id]
    return sim


def course(name: str, seed: int, words: str) -> Course:
    """Steps of a simulation; a step of another one first, which loads compiled loops."""
    case = CASES[name]
    settings = settings_for(words, case.scene)
    with opened(case, seed, settings) as first:
        first.step()
    with opened(case, seed, settings) as sim:
        begun, before = sim.time, time.process_time()
        rows = [sim.step() for _ in range(math.ceil(case.seconds / settings["dt"] - 1e-9))]
        spent, stiffness = (time.process_time() - before) / (sim.time - begun), float(sim.world.pairs.stiffness.max())
    late = [row for row in rows if row["time"] - begun > case.after]
    records = {key: np.array([row[key] for row in late]) for key, value in late[0].items() if np.isscalar(value)}
    overlap = max(row["worst_overlap [m]"] for row in rows if row["time"] - begun > FORGETS)
    unsolved = sum(not row["converged"] for row in rows)
    iterations = statistics.fmean(row["iterations"] for row in rows)
    radius = case.scene.radius
    return Course(case.figure(records), overlap / radius, spent, iterations, unsolved, settings["dt"], stiffness)


def row(name: str, words: str, starts: int) -> dict[str, Any]:
    """Of the starts of one setting, each in a process of its own."""
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        found = [pool.submit(course, name, seed, words).result() for seed in range(starts)]
    value, error = spread([each.figure for each in found])
    return {
        "case": name,
        "settings": words,
        "dt": found[0].dt,
        "stiffness": found[0].stiffness,
        "cpu": statistics.median(each.cpu for each in found),
        "overlap": 100 * max(each.overlap for each in found),
        "figure": value,
        "error": error,
        "iterations": statistics.fmean(each.iterations for each in found),
        "unsolved": sum(each.unsolved for each in found),
    }


def shown(name: str, words: str, starts: int) -> list[dict[str, Any]]:
    """The row, printed; none where grains would pass through others unseen, or contacts have no solution."""
    try:
        found = row(name, words, starts)
    except SceneError as error:
        print(f"{words:28} ended: {error}", flush=True)
        return []
    show(found)
    return [found]


def show(row: dict[str, Any]) -> None:
    print(
        f"{row['settings']:28} {1e3 * row['dt']:6.2f} ms {row['cpu']:7.2f} {row['overlap']:6.2f} {row['figure']:9.4g} "
        f"+- {row['error']:7.2g} {row['iterations']:5.0f} {row['unsolved']:3d}  k {row['stiffness']:.2g}",
        flush=True,
    )


def draw(cases: list[list[dict[str, Any]]]) -> None:
    """Error of the figure over CPU seconds, a panel for each case."""
    with figure("time_steps", min(len(cases), 3), -(-len(cases) // 3)) as panels:
        for axes, rows in zip(panels, cases):
            limit = min(rows, key=lambda row: row["dt"])["figure"]
            plain = sorted((row for row in rows if "," not in row["settings"]), key=lambda row: row["dt"])
            groups = {"time steps": plain, "projection": [row for row in rows if "projection" in row["settings"]]}
            groups["rigid"] = [row for row in rows if "stiffness=inf" in row["settings"]]
            groups["tolerances"] = [row for row in rows if row["settings"].startswith("1,tol")]
            for (label, chosen), style in zip(groups.items(), ("o-", "^", "x", ".")):
                off = [100 * (row["figure"] / limit - 1) for row in chosen]
                bars = [100 * row["error"] / abs(limit) for row in chosen]
                axes.errorbar([row["cpu"] for row in chosen], off, bars, fmt=style, capsize=2, label=label)
            for row in plain:
                axes.annotate(f"{1e3 * row['dt']:.3g} ms", (row["cpu"], 100 * (row["figure"] / limit - 1)), (4, 4),
                              textcoords="offset points", fontsize=7)  # fmt: skip
            axes.axhspan(-3, 3, color="0.92", zorder=0)
            axes.set(xscale="log", xlabel="CPU s per simulated s", ylabel="off, %")
            axes.set_title(f"{rows[0]['case']}: {limit:.4g} {CASES[rows[0]['case']].unit}")
            axes.legend(fontsize=7)


def main() -> None:
    parser = argparse.ArgumentParser(
        prog="run/study time_steps", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("case", nargs="*", default=UNASKED, help=f"of {', '.join(CASES)}; mixer16 only if named")
    parser.add_argument("--starts", type=int, default=3)
    parser.add_argument("--settings", nargs="+", default=SETTINGS, help="see above")
    words = parser.parse_args()
    if unknown := [name for name in words.case if name not in CASES]:
        parser.error(f"{unknown[0]}: allowed are {', '.join(CASES)}")
    if words.starts < 1:
        parser.error(f"--starts {words.starts}: allowed are 1 and more")
    try:
        for setting in words.settings:
            settings_for(setting, Mixer(n=1))
    except ValueError as error:
        parser.error(f"--settings {error}")
    os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    os.environ["OMP_NUM_THREADS"] = "1"
    about, cases = say_machine(), []
    for name in words.case:
        print(f"{name}, {words.starts} starts of {CASES[name].seconds:g} s")
        print(f"{'dt over default, settings':28} {'dt':>9} {'CPU s/s':>7} overlap {CASES[name].unit:>8} {'its':>16}")
        cases.append([])
        for setting in words.settings:
            cases[-1] += shown(name, setting, words.starts)
        record("time_steps", about, [each for rows in cases for each in rows])
    draw(cases)


if __name__ == "__main__":
    main()
