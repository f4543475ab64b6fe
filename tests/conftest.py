"""What all tests share: those on several ranks, and how many workers share the files."""

from __future__ import annotations

import dataclasses
import fcntl
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


@pytest.fixture(scope="session", autouse=True)
def one_compiles():
    """Workers and ranks need the same loops at the same time. One of them compiles a loop, and the others wait for its
    machine code, file by file of loops."""
    from numba.core.dispatcher import Dispatcher

    from dem.machine_code import MachineCode

    compile, held = Dispatcher.compile, set()

    def compile_alone(self, signature):
        source = self.py_func.__code__.co_filename
        if source in held or not isinstance(self._cache, MachineCode):
            return compile(self, signature)
        with open(source) as file:  # closing it unlocks
            fcntl.flock(file, fcntl.LOCK_EX)
            held.add(source)
            try:
                return compile(self, signature)
            finally:
                held.remove(source)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Dispatcher, "compile", compile_alone)
        yield


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
