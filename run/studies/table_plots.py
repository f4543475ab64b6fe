"""Draws tables of docs as figures, so that both say the same: docs/cluster.png, docs/kernels.png.

    run/study table_plots
"""

from __future__ import annotations

import math
import re
from typing import Any

from shared import ROOT, parser

DOCS = ROOT / "docs"


def table(page: str, head: str) -> tuple[list[str], list[list[str]]]:
    """The head and the rows of the table of a page whose head begins like this."""
    lines = (DOCS / page).read_text().splitlines()
    first = next(i for i, line in enumerate(lines) if line.startswith(head))
    cells = []
    for line in lines[first:]:
        if not line.startswith("|"):
            break
        cells.append([cell.strip(" `*") for cell in line.strip("|").split("|")])
    return cells[0], cells[2:]


def seconds(cell: str) -> float:
    """The sum of the numbers of a cell before a bracket; NaN if there is none."""
    found = re.findall(r"\d[\d,]*(?:\.\d+)?", cell.partition("(")[0].partition(">")[0])
    return sum(float(one.replace(",", "")) for one in found) if found else math.nan


def cluster(axes: Any) -> None:
    """Milliseconds of a step against ranks, by the model."""
    heads, rows = table("cluster.md", "| ranks | n = 8 |")
    ranks = [seconds(row[0]) for row in rows]
    for k, label in enumerate(heads[1:], 1):
        axes.plot(ranks, [seconds(row[k]) for row in rows], "o-", label=label)
    axes.set(xscale="log", yscale="log", xlabel="ranks", ylabel="ms of a step, by the model")


def kernels(axes: Any) -> None:
    """Seconds of set-up and solution of each way, for each kernel."""
    heads, rows = table("trains.md", "| kernel, CG to 1e-8 |")
    for k, mark in enumerate("oxsvd*", 1):
        axes.plot([seconds(row[k]) for row in rows], range(len(rows))[::-1], mark, label=heads[k])
    axes.set_yticks(range(len(rows))[::-1], [row[0] for row in rows], fontsize=7)
    axes.set(xscale="log", xlabel="CPU s of set-up and solution; missing: not solved in 60 s")


if __name__ == "__main__":
    parser("table_plots", __doc__).parse_args()
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    for draw in (cluster, kernels):
        figure, axes = plt.subplots(figsize=(7, 4.4), layout="constrained")
        draw(axes)
        axes.grid(alpha=0.3)
        axes.legend(fontsize=7)
        figure.savefig(DOCS / f"{draw.__name__}.png", dpi=100)
        print(DOCS / f"{draw.__name__}.png")
