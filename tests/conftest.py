"""What all tests share: those on several ranks, and how many workers share the files."""

from __future__ import annotations

import dataclasses
import os

import numpy as np
import pytest

from dem.compiled import set_threads

pytest_plugins = ["several_ranks"]
MOST_WORKERS = 8  # files go to workers whole, and there is no more work than that


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_auto_num_workers() -> int:
    """`-n auto` of pytest-xdist: a worker for each core that this process may use."""
    return min(len(os.sched_getaffinity(0)), MOST_WORKERS)


@pytest.fixture
def threads(request, monkeypatch):
    """Compiled loops run on as many threads as the parameter says, which need not have cores of their own."""
    monkeypatch.setattr("numba.config.NUMBA_NUM_THREADS", 2)
    set_threads(request.param)
    yield request.param
    set_threads(1)


@pytest.fixture
def double(monkeypatch):
    """APGD in double precision from the first iteration: rounding alone is left between two ways to compute it."""
    from pctt import ccp  # not before tests begin: it starts PETSc
    from pctt.ccp.first_order.apgd import APGD

    @dataclasses.dataclass(frozen=True)
    class Double(APGD):
        single: float = np.inf

    monkeypatch.setitem(ccp.SOLVERS, "apgd", dataclasses.replace(ccp.SOLVERS["apgd"], options=Double))
