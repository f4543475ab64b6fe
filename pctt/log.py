"""Phases of a run. They are PETSc log events, which ``-log_view`` shows; their seconds are kept for our own reports."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Iterable
from functools import cache

from petsc4py import PETSc

_seconds: dict[str, float] = defaultdict(float)


class Phase:
    """What ``with`` begins and ends, again and again. (The context manager of a generator takes four times as long.)"""

    def __init__(self, name: str):
        self.name, self._event, self._starts = name, PETSc.Log.Event(name), list[float]()

    def __enter__(self) -> None:
        self._starts.append(time.perf_counter())
        self._event.begin()

    def __exit__(self, *exception: object) -> None:
        self._event.end()
        _seconds[self.name] += time.perf_counter() - self._starts.pop()


@cache
def phase(name: str) -> Phase:
    """Log a phase as the event ``name``, and add its wall seconds on this rank to the account of ``name``: ``with
    phase(name):``."""
    return Phase(name)


def move_seconds(seconds: float, source: str, target: str) -> None:
    """Move seconds from the account of one phase to that of another."""
    _seconds[source] -= seconds
    _seconds[target] += seconds


def take_seconds(names: Iterable[str]) -> dict[str, float]:
    """The seconds on the accounts of the phases; the accounts are empty afterwards."""
    return {name: _seconds.pop(name, 0.0) for name in names}
