"""Seconds per phase of settled mixer steps, for each size and number of ranks: run/study measure_steps [N ...],
default 4 8. Writes results/measure_steps.json."""

from __future__ import annotations

import statistics
import sys

from measure import record, results, say_machine

STEPS, RANKS = 3, (1, 2)
PHASES = ("search", "assembly", "solve", "advance", "output")


def main(sizes: list[int]) -> None:
    about = say_machine()
    print(f"medians of {STEPS} steps, pdip to 1e-4, BiCGStab with block Jacobi; seconds")
    heads = " ".join(f"{phase:>9}" for phase in PHASES)
    print(f"{'n':>3} {'ranks':>5} {'contacts':>9} {'Newton':>7} {'Krylov':>7} {heads} {'total':>9} {'spread':>15}")
    rows: list[dict] = []
    for n in sizes:
        for ranks in RANKS:
            _, steps = results(ranks, "-scene_n", n, "-restart", "settled", "-steps", STEPS)
            row: dict = {"n": n, "ranks": ranks}
            for name in ("contacts", "newton_its", "ksp_its", "seconds"):
                row[name] = statistics.median(line[name] for line in steps)
            row |= {phase: statistics.median(line["phases"].get(phase, 0.0) for line in steps) for phase in PHASES}
            least, most = (pick(line["seconds"] for line in steps) for pick in (min, max))
            rows.append(row | {"spread": [least, most]})
            cells = " ".join(f"{row[phase]:9.3f}" for phase in PHASES)
            counts = f"{row['contacts']:9.0f} {row['newton_its']:7.0f} {row['ksp_its']:7.0f}"
            print(f"{n:3d} {ranks:5d} {counts} {cells} {row['seconds']:9.2f} {least:7.2f}-{most:.2f}", flush=True)
        print(f"    n = {n}: 1 rank / 2 ranks = {rows[-2]['seconds'] / rows[-1]['seconds']:.2f}")
    record("measure_steps", about, rows)


if __name__ == "__main__":
    main([int(word) for word in sys.argv[1:]] or [4, 8])
