"""What a time step changes of the torque on the paddle of a settled mixer, from the same states:

    run/study windows [N] [--states M] [--settings SETTINGS ...]

A run of the stirred mixer is kept every 0.15 s. From each of these states every setting goes on for 0.1 s, and its mean
torque over the last 0.08 s is compared with that of steps of 1 ms to 2e-4 from the same state. The courses have not yet
parted then, so that the mean difference is known to half a per cent where means of whole runs scatter by some per cent.
What the bed would do later, if its packing changed, is not in it. SETTINGS are fields of `pctt.Settings` as those of
`compare_liggghts`; the solver is `apgd`. For each of them the table has

- CPU seconds per simulated second;
- the worst overlap at the start of a step, in % of a radius;
- the mean torque, and its mean difference from that of small steps with the standard error of the states, in %;
- iterations and contacts of a step.

Writes results/windows.json.
"""

from __future__ import annotations

import statistics
import tempfile
import time
from pathlib import Path
from typing import Any

import shared
from shared import Row, Table, settings_of, settled, spread

from dem.scenes import Mixer

FIRST, APART = 0.3, 0.15  # [s] from the start to the first state, and from one to the next
LASTS, FORGETS = 0.1, 0.02  # [s] a window, and what of its start is in no mean
SMALL = "dt=.001,tol=2e-4,closing_work=inf"
SETTINGS = (
    "default", "dt=.001,tol=1e-3,closing_work=inf", "dt=.0025,tol=1e-3,closing_work=inf", "dt=.0025,tol=2e-3",
    "dt=.004,tol=1.5e-3,closing_work=inf", "dt=.005,tol=5e-4,closing_work=.3", "dt=.01,tol=5e-4,closing_work=inf",
    "dt=.01,tol=1.5e-3",
)  # fmt: skip


def _nothing(words: object) -> None:
    """In the place of a simulation's print."""


def keep_states(n: int, states: int, folder: Path) -> list[Path]:
    """Files of states of a run by the default settings."""
    files = [folder / f"{k}.h5" for k in range(states)]
    with settled(Mixer(n=n), 1, 1e-5, solver="apgd", say=_nothing) as sim:
        sim.run(until=sim.time + FIRST)
        for file in files:
            sim.run(until=sim.time + APART)
            sim.save(file)
    return files


def window(n: int, file: Path, words: str) -> Row:
    """Of one setting from one state."""
    from pctt.simulation import Simulation

    settings: dict[str, Any] = {"solver": "apgd", **settings_of(words)}
    radius, rows, torque, spent = Mixer(n=n).radius, [], [], 0.0
    with Simulation(Mixer(n=n), restart=file, say=_nothing, **settings) as sim:
        begun = sim.time
        while sim.time < begun + LASTS - 1e-9:
            before = time.process_time()
            rows.append(sim.step())
            spent += time.process_time() - before
            if sim.time > begun + FORGETS + 1e-9:
                torque.append(-1e-3 * sim.body("mixer").torque[2])
    return {
        "torque": statistics.fmean(torque),
        "overlap": 100 / radius * max(row["worst_overlap [m]"] for row in rows),
        "iterations": statistics.fmean(row["iterations"] for row in rows),
        "contacts": statistics.fmean(row["contacts"] for row in rows),
        "cpu": spent / LASTS,
    }


def main() -> None:
    line = shared.parser("windows", __doc__)
    line.add_argument("n", type=int, nargs="?", default=8, help="size of the mixer (8)")
    line.add_argument("--states", type=shared.at_least_one, default=8, help="from which all settings go on (8)")
    line.add_argument("--settings", nargs="+", default=SETTINGS, help="see above")
    given = line.parse_args()
    try:
        _ = [settings_of(words) for words in given.settings]
    except ValueError as error:
        line.error(f"--settings {error}")
    shared.keep_to_one_core()
    about, rows = shared.say_machine(), []
    table = Table(
        settings=("settings", "<40"), CPU_s_per_s=("cpu", "11.2f"), overlap=("overlap", "7.2f"),
        torque_kN_m=("torque", "11.2f"), off=("off", "6.1f"), error=("error", "5.1f"), its=("iterations", "5.0f"),
        contacts=("contacts", "8.0f"),
    )  # fmt: skip
    with tempfile.TemporaryDirectory() as folder:
        files = keep_states(given.n, given.states, Path(folder))
        small: list[float] = []
        for words in (SMALL, *given.settings):
            found = [window(given.n, file, words) for file in files]
            small = small or [each["torque"] for each in found]
            off, error = spread([each["torque"] - other for each, other in zip(found, small)])
            mean = {name: statistics.fmean(each[name] for each in found) for name in found[0]}
            part = 100 / statistics.fmean(small)
            rows.append({"n": given.n, "settings": words, **mean, "off": part * off, "error": part * error})
            rows[-1]["overlap"] = max(each["overlap"] for each in found)
            table.add(rows[-1])
            shared.record("windows", about, rows)


if __name__ == "__main__":
    main()
