"""The paper's tables 1 and 2: average ranks of trains and of their inverses, and seconds of compression and
inversion per PDIP solve, for eps 1e-2, 1e-3, 1e-4, with and without block scaling: run/study table_ranks [N]
[-caps 10,100,1000] [-every K] [-seconds S] [-uncapped], default the settled mixer of n = 8 and caps 10,100.
Writes results/table_ranks_nN.json."""

from __future__ import annotations

import argparse
from typing import Any

import numpy as np
from mpi4py import MPI
from newton_systems import Replay, replay_steps, set_up, settled, train_pc
from shared import record, say_machine

# (eps, cap): average ranks of matrix and inverse, seconds of compression and inversion per PDIP solve
PAPER = {
    (1e-2, 10): (4.6, 4.4, 10), (1e-2, 100): (10.5, 6.7, 25), (1e-2, 1000): (10.5, 6.7, 25),
    (1e-3, 10): (8.7, 8.5, 16), (1e-3, 100): (59.3, 45.2, 1244), (1e-3, 1000): (65.2, 46.4, 1317),
    (1e-4, 10): (9.1, 9.0, 16), (1e-4, 100): (68.6, 58.1, 2740), (1e-4, 1000): (113.3, 91.2, 8157),
}  # fmt: skip
EPS = (1e-2, 1e-3, 1e-4)
HEAD = ("scaling", "eps", "cap", "ranks S/X", "paper", "error", "residual", "positive", "compress s", "invert s")


def figures(replay: Replay, eps: float, cap: int, scaling: str, every: int, limit: float) -> dict[str, Any]:
    """Averages over the systems, and seconds per PDIP solve: means times all its Newton steps."""
    pc, train = train_pc(MPI.COMM_WORLD, eps=eps, rank=cap, scaling=scaling, reuse="steps")
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


def uncapped(replay: Replay, scaling: str) -> list[dict[str, Any]]:
    """Average ranks that each eps asks for, of a Newton system of the middle and of its inverse as dense matrices: by
    the singular values of their unfoldings, as TT-SVD takes them (paper, Algorithm 1)."""
    matrix = replay.matrix(replay.systems[len(replay.systems) // 2])
    pc, train = train_pc(MPI.COMM_WORLD, rank=2, scaling=scaling, reuse="steps")
    set_up(pc, matrix)
    slots, hierarchy = train.made.slots, train.made.hierarchy
    assert slots is not None
    assert hierarchy is not None
    size, block = slots.size, slots.block
    blocks = np.zeros((size, size, block, block))
    blocks[slots.rows, slots.columns] = slots.load(matrix, matrix.getValuesCSR())
    dense = blocks.transpose(0, 2, 1, 3).reshape(size * block, -1)
    dense += (scaling == "block") * np.eye(len(dense))  # the diagonal is not among the blocks
    pc.destroy()
    modes = hierarchy.modes
    values = [unfolding_values(A, modes) for A in (dense, np.linalg.inv(dense))]
    return [
        {"scaling": scaling, "eps": eps, "modes": modes, "contacts": replay.contacts, "matrix_rank": ranks[0],
         "inverse_rank": ranks[1], "full_rank": [len(v) for v in values[0]]}
        for eps in EPS
        for ranks in [[[needed_rank(v, eps / np.sqrt(len(modes) - 1)) for v in each] for each in values]]
    ]  # fmt: skip


def unfolding_values(A: np.ndarray, modes: tuple[int, ...]) -> list[np.ndarray]:
    """Singular values of each unfolding of a square matrix, ascending; accurate to 1e-8 of the largest."""
    found = []
    for k in range(1, len(modes)):
        rows, rest = int(np.prod(modes[:k])), int(np.prod(modes[k:]))
        unfolding = A.reshape(rows, rest, rows, rest).transpose(0, 2, 1, 3).reshape(rows * rows, -1)
        gram = unfolding @ unfolding.T if len(unfolding) <= unfolding.shape[1] else unfolding.T @ unfolding
        found.append(np.sqrt(np.maximum(np.linalg.eigvalsh(gram), 0)))
    return found


def needed_rank(values: np.ndarray, delta: float) -> int:
    """The least rank that leaves out at most ``delta`` of the norm; values ascending."""
    left_out = np.sqrt(np.cumsum(values**2))
    return len(values) - int(np.searchsorted(left_out, delta * left_out[-1], side="right"))


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

    def look_without_cap(replay: Replay) -> None:
        print(f"mixer n = {given.n}: {replay.contacts} contacts; ranks at each bond that eps asks for, and full ranks")
        print(f"{'scaling':8} {'eps':>8} {'matrix':>20} {'inverse':>20} {'full':>20} {'paper, cap 1000':>18}")
        for scaling in given.scalings:
            for row in uncapped(replay, scaling):
                rows.append(row)
                ranks = [str(row[name]) for name in ("matrix_rank", "inverse_rank", "full_rank")]
                theirs = "{}/{}".format(*PAPER[row["eps"], 1000][:2])
                print(f"{scaling:8} {row['eps']:8.0e} {ranks[0]:>20} {ranks[1]:>20} {ranks[2]:>20} {theirs:>18}")

    def look(replay: Replay) -> None:
        print(f"mixer n = {given.n}: {replay.contacts} contacts, {len(replay.systems)} Newton steps, 1 rank")
        print("means over the Newton steps (residual: median); seconds per PDIP solve; paper: ranks and seconds")
        print("{:8} {:>8} {:>8} {:>12} {:>18} {:>10} {:>10} {:>10} {:>10} {:>10}".format(*HEAD))
        for scaling in given.scalings:
            for cap in given.caps:
                every = given.every if cap <= 10 else max(given.every, len(replay.systems) // 3)
                for eps in EPS:
                    rows.append(figures(replay, eps, cap, scaling, every, given.seconds))
                    print(line(rows[-1]), flush=True)

    replay_steps(settled(given.n), 1, look_without_cap if given.uncapped else look)
    record(f"table_ranks_n{given.n}" + "_uncapped" * given.uncapped, about, rows)


if __name__ == "__main__":
    words = argparse.ArgumentParser("run/study table_ranks", description=__doc__)
    words.add_argument("n", type=int, nargs="?", default=8, help="size of the mixer (8; the paper's is 16)")
    words.add_argument("-caps", default="10,100", type=lambda text: [int(word) for word in text.split(",")],
                       help="caps of the ranks, with commas between (10,100)")  # fmt: skip
    words.add_argument("-scalings", default="block,none", type=lambda text: text.split(","), help="(block,none)")
    words.add_argument("-every", type=int, default=1, help="take every k-th Newton system (caps over 10: three in all)")
    words.add_argument("-seconds", type=float, default=300, help="after which a configuration takes no more systems")
    words.add_argument("-uncapped", action="store_true",
                       help="instead: the ranks that each eps asks for, from dense matrices (n <= 4)")  # fmt: skip
    main(words.parse_args())
