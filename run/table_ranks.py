"""Average ranks and set-up seconds of trains over the Newton systems of one settled step; see run/table_ranks."""

from __future__ import annotations

import argparse
from typing import Any

import numpy as np
from measure import record, say_machine
from mpi4py import MPI
from newton_systems import Replay, replay_steps, set_up, settled, train_pc

# (eps, cap): average ranks of matrix and inverse, seconds of compression and inversion per PDIP solve
PAPER = {
    (1e-2, 10): (4.6, 4.4, 10), (1e-2, 100): (10.5, 6.7, 25), (1e-2, 1000): (10.5, 6.7, 25),
    (1e-3, 10): (8.7, 8.5, 16), (1e-3, 100): (59.3, 45.2, 1244), (1e-3, 1000): (65.2, 46.4, 1317),
    (1e-4, 10): (9.1, 9.0, 16), (1e-4, 100): (68.6, 58.1, 2740), (1e-4, 1000): (113.3, 91.2, 8157),
}  # fmt: skip
HEAD = ("scaling", "eps", "cap", "ranks S/X", "paper", "error", "residual", "positive", "compress s", "invert s")


def figures(replay: Replay, eps: float, cap: int, scaling: str, every: int, limit: float) -> dict[str, Any]:
    """Averages over the systems, and seconds per PDIP solve: means times all its Newton steps."""
    pc, train = train_pc(MPI.COMM_WORLD, eps=eps, max_rank=cap, scaling=scaling, keep=False)
    for k, (matrix, _) in enumerate(replay.matrices()):
        spent = sum(row["setup_s"] for row in train.rows)
        if k % every == 0 and spent < limit:
            set_up(pc, matrix)
    pc.destroy()
    rows = [row for row in train.rows if "inverse_rank" in row]
    mean = {name: float(np.mean([row[name] for row in rows])) for name in ("matrix_rank", "inverse_rank", "error")}
    mean["residual"] = float(np.median([row["residual"] for row in rows]))
    steps = len(replay.systems)
    seconds = {name: steps * float(np.mean([row[name] for row in rows])) for name in ("compress_s", "invert_s")}
    seconds["setup_s"] = steps * float(np.mean([row["setup_s"] for row in train.rows]))
    positive = sum(row["positive"] for row in rows)
    return {
        "scaling": scaling, "eps": eps, "cap": cap, "contacts": replay.contacts, "newton_steps": steps,
        "set_ups": len(train.rows), "positive": positive, **mean, **seconds,
        "paper": dict(zip(("matrix_rank", "inverse_rank", "seconds"), PAPER.get((eps, cap), ()))),
    }  # fmt: skip


def line(row: dict[str, Any]) -> str:
    paper = row["paper"]
    theirs = f"{paper['matrix_rank']}/{paper['inverse_rank']} {paper['seconds']} s" if paper else "-"
    ranks = f"{row['matrix_rank']:.1f}/{row['inverse_rank']:.1f}"
    positive = f"{row['positive']}/{row['set_ups']}"
    return (
        f"{row['scaling']:8} {row['eps']:8.0e} {row['cap']:8d} {ranks:>12} {theirs:>18} {row['error']:10.3g} "
        f"{row['residual']:10.3g} {positive:>10} {row['compress_s']:10.2f} {row['invert_s']:10.2f}"
    )


def main(given: argparse.Namespace) -> None:
    about = say_machine()
    rows: list[dict[str, Any]] = []

    def look(replay: Replay) -> None:
        print(f"mixer n = {given.n}: {replay.contacts} contacts, {len(replay.systems)} Newton steps, 1 rank")
        print("means over the Newton steps (residual: median); seconds per PDIP solve; paper: ranks and seconds")
        print("{:8} {:>8} {:>8} {:>12} {:>18} {:>10} {:>10} {:>10} {:>10} {:>10}".format(*HEAD))
        for scaling in ("block", "none"):
            for cap in given.caps:
                every = given.every if cap <= 10 else max(given.every, len(replay.systems) // 3)
                for eps in (1e-2, 1e-3, 1e-4):
                    rows.append(figures(replay, eps, cap, scaling, every, given.seconds))
                    print(line(rows[-1]), flush=True)

    replay_steps(settled(given.n), 1, look)
    record(f"table_ranks_n{given.n}", about, rows)


if __name__ == "__main__":
    words = argparse.ArgumentParser("run/table_ranks", description=__doc__.partition(";")[0])
    words.add_argument("n", type=int, nargs="?", default=8, help="size of the mixer (8; the paper's is 16)")
    words.add_argument("-caps", default="10,100", type=lambda text: [int(word) for word in text.split(",")],
                       help="caps of the ranks, with commas between (10,100)")  # fmt: skip
    words.add_argument("-every", type=int, default=1, help="take every k-th Newton system (caps over 10: three in all)")
    words.add_argument("-seconds", type=float, default=300, help="after which a configuration takes no more systems")
    main(words.parse_args())
