"""What a settled mixer step costs, its parts and its Newton systems:

    run/study measure steps [N ...]                                       seconds per phase, 1 and 2 ranks; default 4 8
    run/study measure preconditioners [N [-every K] [-names A,B]] [...]    what is not known goes to pctt.run

Writes results/measure_steps.json or results/measure_preconditioners_nN.json.
"""

from __future__ import annotations

import argparse
import statistics

from shared import record, results, say_machine

STEPS, RANKS = 40, (1, 2)
PHASES = ("search", "assembly", "solve", "advance", "output")
NAMES = "none,ilu,ilu-shifted,pbjacobi,sor,icc-shifted,gamg,hypre,cholesky,tt"


def steps(sizes: list[int]) -> None:
    """Seconds per phase of settled mixer steps, for each size and number of ranks."""
    about = say_machine()
    print(f"medians of {STEPS} steps by default settings; seconds")
    heads = " ".join(f"{phase:>9}" for phase in PHASES)
    print(f"{'n':>3} {'ranks':>5} {'contacts':>9} {'iterations':>10} {heads} {'total':>9} {'spread':>15}")
    rows: list[dict] = []
    for n in sizes:
        for ranks in RANKS:
            _, lines = results(ranks, "-scene_n", n, "-restart", "settled", "-steps", STEPS)
            row: dict = {"n": n, "ranks": ranks}
            for name in ("contacts", "iterations", "seconds"):
                row[name] = statistics.median(line[name] for line in lines)
            row |= {phase: statistics.median(line["phases"].get(phase, 0.0) for line in lines) for phase in PHASES}
            least, most = (pick(line["seconds"] for line in lines) for pick in (min, max))
            rows.append(row | {"spread": [least, most]})
            cells = " ".join(f"{row[phase]:9.4f}" for phase in PHASES)
            counts = f"{row['contacts']:9.0f} {row['iterations']:10.0f}"
            print(f"{n:3d} {ranks:5d} {counts} {cells} {row['seconds']:9.4f} {least:7.3f}-{most:.3f}", flush=True)
        print(f"    n = {n}: 1 rank / 2 ranks = {rows[-2]['seconds'] / rows[-1]['seconds']:.2f}")
    record("measure_steps", about, rows)


def preconditioners(n: int, every: int, names: str, options: list[str]) -> None:
    """All preconditioners on the same Newton systems of a settled mixer step, every EVERY-th of them."""
    about = say_machine()
    run = ["-scene_n", n, "-restart", "settled", "-steps", 1, "-compare", names, "-compare_every", every]
    run += ["-dt", 0.025, "-ccp_tol", 1e-4, "-ccp_closing_work", "inf"]
    summary, (step,) = results(1, *run, *options)
    print(
        f"mixer n = {n}: {step['contacts']} contacts, {step['newton_its']} Newton steps to natural residual "
        f"{step['natural_residual']:.1e}, every {every}. system, 1 rank"
    )
    rows = [{"name": name, **figures, "solves": step["compare"][name]} for name, figures in summary["compare"].items()]
    base = next(row for row in rows if row["name"] == "pbjacobi")
    total = base["setup_s"] + base["solve_s"]
    heads = " ".join(f"{head:>9}" for head in ("its mean", "its max", "set-up s", "solve s", "total s", "/pbjacobi"))
    print(f"{'':14} {'solved':>8} {heads}")
    for row in sorted(rows, key=lambda row: row["setup_s"] + row["solve_s"]):
        row["total_s"] = row["setup_s"] + row["solve_s"]
        solved = f"{row['converged']}/{row['systems']}"
        print(
            f"{row['name']:14} {solved:>8} {row['ksp_its_mean']:9.1f} {row['ksp_its_max']:9d} {row['setup_s']:9.3f} "
            f"{row['solve_s']:9.3f} {row['total_s']:9.3f} {row['total_s'] / total:9.2f}"
        )
    print("\niterations / seconds of each system; in brackets the true residual of one that was not solved")
    for row in rows:
        print(f"{row['name']:14} " + " ".join(f"{cell(*solve):>22}" for solve in row["solves"]))
    record(f"measure_preconditioners_n{n}", about, rows)


def cell(converged: bool, iterations: int, seconds: float, residual: float) -> str:
    return f"{iterations} / {seconds:.2f}" + f" ({residual:.0e})" * (not converged)


if __name__ == "__main__":
    words = argparse.ArgumentParser("run/study measure", description=__doc__, allow_abbrev=False,
                                    formatter_class=argparse.RawDescriptionHelpFormatter)  # fmt: skip
    kinds = words.add_subparsers(dest="what", required=True)
    kinds.add_parser("steps").add_argument("n", type=int, nargs="*", default=[4, 8], help="sizes of the mixer (4 8)")
    of_pcs = kinds.add_parser("preconditioners", allow_abbrev=False)
    of_pcs.add_argument("n", type=int, nargs="?", default=4, help="size of the mixer (4)")
    of_pcs.add_argument("-every", type=int, default=1, help="every K-th Newton system (1)")
    of_pcs.add_argument("-names", default=NAMES, help="with commas between")
    given, more = words.parse_known_args()
    if given.what == "steps":
        steps(given.n)
    else:
        preconditioners(given.n, given.every, given.names, more)
