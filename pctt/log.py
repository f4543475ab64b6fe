"""Phases of a run. They are PETSc log events, which ``-log_view`` shows; their seconds are kept for our own reports."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Iterable, Iterator
from contextlib import contextmanager

from petsc4py import PETSc

_seconds: dict[str, float] = defaultdict(float)


@contextmanager
def phase(name: str) -> Iterator[None]:
    """Log a phase as the event ``name``, and add its wall seconds on this rank to the account of ``name``."""
    start = time.perf_counter()
    with PETSc.Log.Event(name):
        try:
            yield
        finally:
            _seconds[name] += time.perf_counter() - start


def move_seconds(seconds: float, source: str, target: str) -> None:
    """Move seconds from the account of one phase to that of another."""
    _seconds[source] -= seconds
    _seconds[target] += seconds


def take_seconds(names: Iterable[str]) -> dict[str, float]:
    """The seconds on the accounts of the phases; the accounts are empty afterwards."""
    return {name: _seconds.pop(name, 0.0) for name in names}
