"""Draws the table of docs/cluster.md as a figure, so that both say the same: docs/cluster.png.

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


if __name__ == "__main__":
    parser("table_plots", __doc__).parse_args()
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(figsize=(7, 4.4), layout="constrained")
    cluster(axes)
    axes.grid(alpha=0.3)
    axes.legend(fontsize=7)
    figure.savefig(DOCS / "cluster.png", dpi=100)
    print(DOCS / "cluster.png")
