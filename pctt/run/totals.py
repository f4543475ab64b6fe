"""Figures of a whole run, from those of its steps."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from functools import reduce
from typing import Any

MAXIMA = ("natural_residual", "coulomb_residual", "peak_memory")
Totals = dict[str, Any]  #: empty before the first step


def of(lines: Iterable[Mapping[str, Any]]) -> Totals:
    """The totals of steps, given by their figures."""
    return reduce(add, lines, {})


def add(before: Totals, line: Mapping[str, Any]) -> Totals:
    """The totals with one more step."""
    contacts = line["contacts"]
    least, most = before.get("contacts", [contacts, contacts])
    overlap = {"overlap [m]": line["worst_overlap"], "step": line["step"]}
    spent, phases = before.get("phases", {}), line["phases"]
    return {
        "steps": before.get("steps", 0) + 1,
        "first_step": before.get("first_step", line["step"]),
        "last_step": line["step"],
        "time": line["time"],
        "contacts": [min(least, contacts), max(most, contacts)],
        **{name: before.get(name, 0) + line[name] for name in ("newton_its", "ksp_its", "fallbacks", "seconds")},
        "not_converged": before.get("not_converged", 0) + (not line["converged"]),
        **{name: max(before.get(name, 0), line[name]) for name in MAXIMA},
        "worst_overlap": max(before.get("worst_overlap", overlap), overlap, key=lambda worst: worst["overlap [m]"]),
        "phases": {name: spent.get(name, 0.0) + phases.get(name, 0.0) for name in {**spent, **phases}},
    }
