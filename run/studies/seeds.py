"""Runs of a scene that differ in their seed alone: the means of what they print at their end, with standard errors.

    run/study seeds SEED,SEED,... -scene NAME [options of python -m pctt.run]

An error of NaN is that of one run. Writes results/seeds.json.
"""

from __future__ import annotations

from shared import Row, Table, listed, parser, record, results, say_machine, spread


def main() -> None:
    words = parser("seeds", __doc__)
    words.add_argument("seeds", type=listed(int), metavar="SEED,...", help="values of -scene_seed")
    given, options = words.parse_known_args()
    about, runs = say_machine(), []
    for seed in given.seeds:
        summary, _ = results(1, *options, "-output_every", 0, "-scene_seed", seed)
        runs.append(summary)
        print(f"seed {seed}: {summary['not_converged']} of {summary['steps']} steps missed the tolerance", flush=True)
    table = Table(figure=("figure", "<26s"), mean=("mean", "10.4g"), error=("error", "10.2g"), of=("values", "<s"))
    rows: list[Row] = []
    for figure in runs[0]["analysis"]:
        values = [run["analysis"][figure] for run in runs]
        mean, error = spread(values)
        rows.append({"figure": figure, "mean": mean, "error": error, "values": " ".join(f"{v:.4g}" for v in values)})
        table.add(rows[-1])
    record("seeds", about | {"options": " ".join(options), "seeds": given.seeds}, rows)


if __name__ == "__main__":
    main()
