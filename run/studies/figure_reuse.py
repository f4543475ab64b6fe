"""How much faster trains are set up that start from the last ones, against the number of contacts, over time steps
of settled mixers: run/study figure_reuse [N ...] [-steps K] [-newton K] [-rank R] [-scaling block|none], default
4 8 and 31 steps. Writes results/figure_reuse.json and .png."""

from __future__ import annotations

import argparse
from typing import Any

import numpy as np
from mpi4py import MPI
from newton_systems import Replay, replay_steps, set_up, settled, train_pc
from shared import figure, record, say_machine

LEVELS = ("none", "newton", "trains")
WHAT = ("first Newton step", "whole PDIP")
BIN = 0.05  # of log10 Nc


class Watch:
    """A preconditioner per level of reuse, all set up for every Newton system; a row per time step."""

    def __init__(self, n: int, options: dict[str, Any]):
        self.n, self.rows = n, list[dict[str, Any]]()
        self.pcs = {level: train_pc(MPI.COMM_WORLD, reuse=level, **options)[0] for level in LEVELS}

    def __call__(self, replay: Replay) -> None:
        seconds: dict[str, list[float]] = {level: [] for level in LEVELS}
        refused = dict.fromkeys(LEVELS, 0)
        for pc in self.pcs.values():
            pc.reset()
        for k, (matrix, _) in enumerate(replay.matrices()):
            for turn in range(len(LEVELS)):
                level = LEVELS[(k + turn) % len(LEVELS)]  # each is the first, with a cold cache, as often as the others
                done = set_up(self.pcs[level], matrix)
                seconds[level].append(done["setup_s"])
                refused[level] += done["rank"] == 1
        row: dict[str, Any] = {"n": self.n, "contacts": replay.contacts, "newton_steps": len(replay.systems)}
        row |= {level: {WHAT[0]: s[0], WHAT[1]: sum(s), "refused": refused[level]} for level, s in seconds.items()}
        row |= {f"{level} {what}": row["none"][what] / row[level][what] for level in LEVELS[1:] for what in WHAT}
        self.rows.append(row)

    def destroy(self) -> None:
        for pc in self.pcs.values():
            pc.destroy()


def main(given: argparse.Namespace) -> None:
    about = say_machine()
    rows: list[dict[str, Any]] = []
    ratios = [f"{level} {what}" for what in WHAT for level in LEVELS[1:]]
    print("seconds of set-up without reuse / with reuse within a time step (newton) and from step to step (trains)")
    heads = " ".join(f"{name:>24}" for name in ratios)
    print(f"{'n':>3} {'step':>5} {'contacts':>9} {'Newton':>7} {'none s':>8} {heads}")
    for n in given.n:
        options = {"rank": given.rank, "eps": 1e-2, "scaling": given.scaling}
        watch = Watch(n, options)
        replay_steps(settled(n), given.steps, watch, given.newton)
        watch.destroy()
        # the first step of a run has nothing to start from
        for step, row in enumerate(watch.rows[1:], start=2):
            cells = " ".join(f"{row[name]:24.2f}" for name in ratios)
            print(f"{n:3d} {step:5d} {row['contacts']:9d} {row['newton_steps']:7d} {row['none'][WHAT[1]]:8.2f} {cells}")
        cells = " ".join(f"{np.median([row[name] for row in watch.rows[1:]]):24.2f}" for name in ratios)
        print(f"{n:3d} {'median of the steps':>32} {cells}", flush=True)
        rows += watch.rows
    record("figure_reuse", about, rows)
    draw([row for n in given.n for row in [row for row in rows if row["n"] == n][1:]])


def draw(rows: list[dict[str, Any]]) -> None:
    """Ratios against log10 Nc, means over bins, paper's figure."""
    bins = np.round(np.log10([row["contacts"] for row in rows]) / BIN) * BIN
    with figure("figure_reuse", len(WHAT)) as axes:
        for ax, what in zip(axes, WHAT):
            for level in LEVELS[1:]:
                ratio = np.array([row[f"{level} {what}"] for row in rows])
                places = np.unique(bins)
                points = ax.plot([row["contacts"] for row in rows], ratio, ".", alpha=0.4)
                mean = [ratio[bins == place].mean() for place in places]
                ax.plot(10**places, mean, "o-", color=points[0].get_color(), label=f"-pc_tt_reuse {level}")
            ax.axhline(1, color="grey", lw=0.5)
            ax.set(xscale="log", xlabel="contacts Nc", ylabel="set-up without / with reuse", title=what, ylim=(0, None))
            ax.legend()


if __name__ == "__main__":
    words = argparse.ArgumentParser("run/study figure_reuse", description=__doc__)
    words.add_argument("n", type=int, nargs="*", default=[4, 8], help="sizes of the mixer (4 8)")
    words.add_argument("-steps", type=int, default=31, help="time steps of each, the first not counted (31)")
    words.add_argument("-newton", type=int,
                       help="Newton systems of a time step, which APGD then makes (the whole PDIP)")  # fmt: skip
    words.add_argument("-rank", type=int, default=10, help="cap of the ranks (10)")
    words.add_argument("-scaling", choices=("block", "none"), default="block", help="-pc_tt_scaling (block)")
    main(words.parse_args())
