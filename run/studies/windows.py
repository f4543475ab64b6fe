"""What a time step changes of the forces that users measure, from the same states:

    run/study windows [CASE ...] [--states M] [--settings SETTINGS ...] [--small SETTINGS]

A case is a scene and its figure as in `time_steps`: mixer8, blade4, shear4, ... A run of it by small steps (--small:
1 ms to 2e-4) is kept every 0.15 s. From each of these states every setting goes on for 0.1 s, and its figure of the
last 0.08 s is compared with that of small steps from the same state. The courses have not yet parted then, so that the
mean difference is known to half a per cent where means of whole runs scatter by some per cent. What the bed would do
later, if its packing changed, is not in it: `time_steps` has that. States of a run by larger steps would mislead: small
steps need a while to forget them. SETTINGS are fields of `pctt.Settings`, dt=0.01,tol=1e-3, or `default`; the solver is
`apgd`. For each of them the table has

- the time step, and CPU seconds per simulated second;
- the worst overlap after a step, in % of a radius;
- the figure, and its mean difference from that of small steps with the standard error of the states, in %;
- iterations and contacts of a step.

Writes results/windows.json.
"""

from __future__ import annotations

import math
import statistics
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
import shared
from shared import Row, Table, settings_of, settled, spread
from time_steps import CASES, Case, records_of

FIRST, APART = 0.15, 0.15  # [s] from where the stretch of a figure begins to the first state, and from one to the next
LASTS, FORGETS = 0.1, 0.02  # [s] a window, and what of its start is in no figure
SMALL = "dt=.001,tol=2e-4,closing_work=inf"
SETTINGS = (
    "default", "dt=.001,tol=1e-3,closing_work=inf", "dt=.0025,tol=1e-3,closing_work=inf", "dt=.0025,tol=2e-3",
    "dt=.005,tol=5e-4,closing_work=.3", "dt=.01,tol=5e-4,closing_work=inf", "dt=.01,tol=1e-3",
    "dt=.025,tol=3e-4,closing_work=inf",
)  # fmt: skip


def _nothing(words: object) -> None:
    """In the place of a simulation's print."""


def keep_states(case: Case, states: int, folder: Path, words: str) -> list[Path]:
    """Files of states of a run by these settings."""
    files = [folder / f"{k}.h5" for k in range(states)]
    with settled(case.scene, 1, 1e-5, solver="apgd", say=_nothing, **settings_of(words)) as sim:
        begun = sim.time + case.after + FIRST
        for k, file in enumerate(files):
            sim.run(until=begun + k * APART)
            sim.save(file)
    return files


def window(case: Case, file: Path, words: str) -> Row:
    """Of one setting from one state."""
    from pctt.simulation import Simulation

    settings: dict[str, Any] = {"solver": "apgd", **settings_of(words)}
    with Simulation(case.scene, restart=file, say=_nothing, **settings) as sim:
        begun, before, dt = sim.time, time.process_time(), sim.settings.dt
        rows = [sim.step() for _ in range(math.ceil(LASTS / dt - 1e-9))]
        spent = (time.process_time() - before) / (sim.time - begun)
    late = [row for row in rows if row["time"] > begun + FORGETS + 1e-9]
    return {
        "dt": dt,
        "figure": case.figure(records_of(late)),
        "overlap": 100 / case.scene.radius * max(row["worst_overlap [m]"] for row in rows),
        "iterations": statistics.fmean(row["iterations"] for row in rows),
        "contacts": statistics.fmean(row["contacts"] for row in rows),
        "cpu": spent,
    }


def compare(name: str, states: int, choices: list[str], about: Row, rows: list[Row]) -> None:
    """All settings from the states of a case, added to the rows."""
    case, small = CASES[name], np.empty(0)
    print(f"{name}, {states} states; figure in {case.unit or '1'}")
    table = Table(
        settings=("settings", "<40"), dt_ms=(lambda row: 1e3 * row["dt"], "6.2f"), CPU_s_per_s=("cpu", "11.2f"),
        overlap=("overlap", "7.2f"), figure=("figure", "9.4g"), off=("off", "6.1f"), error=("error", "5.1f"),
        its=("iterations", "5.0f"), contacts=("contacts", "8.0f"),
    )  # fmt: skip
    with tempfile.TemporaryDirectory() as folder:
        files = keep_states(case, states, Path(folder), choices[0])
        for words in choices:
            found = [window(case, file, words) for file in files]
            values = np.array([each["figure"] for each in found])
            small = small if len(small) else values
            off, error = spread(list(values - small))
            part = 100 / abs(statistics.fmean(small))
            mean = {key: statistics.fmean(each[key] for each in found) for key in found[0]}
            rows.append({"case": name, "settings": words, **mean, "off": part * off, "error": part * error})
            rows[-1]["overlap"] = max(each["overlap"] for each in found)
            table.add(rows[-1])
            shared.record("windows", about, rows)


def main() -> None:
    line = shared.parser("windows", __doc__)
    line.add_argument("case", nargs="*", default=["mixer8"], help=f"of {', '.join(CASES)} (mixer8)")
    line.add_argument("--states", type=shared.at_least_one, default=8, help="from which all settings go on (8)")
    line.add_argument("--settings", nargs="+", default=SETTINGS, help="see above")
    line.add_argument("--small", default=SMALL, help=f"what all are compared with ({SMALL})")
    given = line.parse_args()
    if unknown := [name for name in given.case if name not in CASES]:
        line.error(f"{unknown[0]}: allowed are {', '.join(CASES)}")
    choices = [given.small, *given.settings]
    try:
        _ = [settings_of(words) for words in choices]
    except ValueError as error:
        line.error(f"--settings {error}")
    shared.keep_to_one_core()
    about, rows = shared.say_machine(), []
    for name in given.case:
        compare(name, given.states, choices, about, rows)


if __name__ == "__main__":
    main()
