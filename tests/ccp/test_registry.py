"""The registry of the solvers, and what is made from it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from problems import from_graph, heap

from pctt import ccp
from pctt.ccp import Limits

DOCS = Path(__file__).resolve().parents[2] / "docs" / "solvers.md"


def table():
    """The solvers as a Markdown table."""
    lines = ["| `-ccp_type` | method | needs | iterations | source |", "|" + "---|" * 5]
    for solver in ccp.SOLVERS.values():
        cells = [f"`{solver.name}`", solver.help, solver.needs, f"{solver.iterations:,}", solver.source]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def test_the_documentation_has_the_table_of_the_registry():
    assert table() in DOCS.read_text(), f"the new table:\n{table()}"


@pytest.mark.parametrize("name", ccp.SOLVERS)
def test_the_default_limit_is_that_of_the_registry(name, monkeypatch):
    """A limit that is asked for goes before it."""
    known, graph = heap(contacts=5, bodies=3)
    seen = []

    def function(problem, guess, limits, options, *newton):
        seen.append(limits.max_it)
        return ccp.Result(np.zeros_like(guess), ccp.Status.STALLED, "nothing done", 1.0, 0)

    solver = ccp.SOLVERS[name]
    monkeypatch.setitem(ccp.SOLVERS, name, type(solver)(**{**vars(solver), "function": function}))
    for limits in (Limits(fallback=False), Limits(max_it=0, fallback=False), Limits(max_it=7, fallback=False)):
        ccp.solve(from_graph(known, graph), type=name, limits=limits, law=ccp.RELAXATION)
    assert seen == [solver.iterations, 0, 7]
