"""All preconditioners on the same Newton systems of a settled mixer step, every EVERY-th of them: run/study
measure_preconditioners [N [EVERY [NAMES [options of pctt.run]]]]. Writes results/measure_preconditioners_nN.json."""

from __future__ import annotations

import sys

from measure import record, results, say_machine

NAMES = "none,ilu,ilu-shifted,pbjacobi,sor,icc-shifted,gamg,hypre,cholesky,tt"


def main(n: int, every: int, names: str, options: list[str]) -> None:
    about = say_machine()
    run = ["-scene_n", n, "-restart", "settled", "-steps", 1, "-compare", names, "-compare_every", every]
    run += ["-ccp_closing_work", "inf"]
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
    words = sys.argv[1:]
    options = words[2:]
    names = options.pop(0) if options and not options[0].startswith("-") else NAMES
    main(int(words[0]) if words else 4, int(words[1]) if len(words) > 1 else 1, names, options)
