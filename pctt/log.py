"""Phases of a run. They are PETSc log events, which ``-log_view`` shows; their seconds are kept for our own reports."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Iterable

from petsc4py import PETSc

_seconds: dict[str, float] = defaultdict(float)
_events: dict[str, PETSc.LogEvent] = {}


class phase:  # noqa: N801 - it is used as a function
    """Log a phase as the event ``name``, and add its wall seconds on this rank to the account of ``name``: ``with
    phase(name):``. (The context manager of a generator takes four times as long.)"""

    def __init__(self, name: str):
        self.name = name

    def __enter__(self) -> None:
        if self.name not in _events:
            _events[self.name] = PETSc.Log.Event(self.name)
        self._start = time.perf_counter()
        _events[self.name].begin()

    def __exit__(self, *exception: object) -> None:
        _events[self.name].end()
        _seconds[self.name] += time.perf_counter() - self._start


def move_seconds(seconds: float, source: str, target: str) -> None:
    """Move seconds from the account of one phase to that of another."""
    _seconds[source] -= seconds
    _seconds[target] += seconds


def take_seconds(names: Iterable[str]) -> dict[str, float]:
    """The seconds on the accounts of the phases; the accounts are empty afterwards."""
    return {name: _seconds.pop(name, 0.0) for name in names}
